"""What is shown of a run while it trains costs a share of the time, and leaves no trace in what is trained."""

import io

import pytest
import torch

from tests.training import fake
from tests.training.fake import FakeConfig, log_of, same, state_of
from visdom_plugin.errors import PluginError
from visdom_plugin.figures.contact_sheet import read_png
from visdom_plugin.render import Render
from visdom_plugin.training import live
from visdom_plugin.training.progress import Progress


class Clock:
    """Seconds that pass only when something is drawn."""

    def __init__(self):
        self.now = 0.0

    def monotonic(self):
        return self.now


class Slow:
    """A renderer that takes as many seconds as it has pixels, times a factor."""

    def __init__(self, clock, per_pixel):
        self.clock, self.per_pixel, self.widths = clock, per_pixel, []

    def render(self, camera, background):
        width, height = int(camera.width), int(camera.height)
        self.clock.now += self.per_pixel * width * height
        self.widths.append(width)
        alpha = torch.ones(height, width)
        return Render(alpha[..., None] * torch.rand(3), alpha, alpha)


@pytest.mark.parametrize("per_pixel", [1e-6, 1e-5, 1e-3])
def test_drawing_takes_its_share_of_the_time_and_no_more(tmp_path, monkeypatch, per_pixel):
    clock = Clock()
    monkeypatch.setattr(live, "time", clock)
    method, views = Slow(clock, per_pixel), fake.tiny_views(4, 0, "v_", (300, 200))
    sheets = []
    pictures = live.LivePictures(
        method, views, torch.device("cpu"), tmp_path / "now.png", lambda _, step: sheets.append(step)
    )
    calibration = per_pixel * live.NARROWEST_PX**2 * 200 / 300
    for step in range(1, 101):
        pictures.refresh(step, train_s=step)
        assert pictures.spent_s <= 1.05 * (live.SHARE * step + calibration)
    assert all(live.NARROWEST_PX <= w <= live.WIDEST_PX for w in method.widths[1:])
    # Where a picture of the least size costs more than all the training pays for, there is none.
    assert (
        bool(sheets) == (per_pixel < 1e-3) == (tmp_path / "now.png").exists()
        and len(sheets) == pictures.count
    )


def test_a_run_that_is_looked_at_trains_as_any_other(train, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(live, "SHARE", 100.0)
    config = FakeConfig(steps=30)
    train(config, run_dir=tmp_path / "quiet")
    assert not (tmp_path / "quiet" / live.SHEET).exists()
    train(config, run_dir=tmp_path / "shown", quiet=False)
    sheet = tmp_path / "shown" / live.SHEET
    assert read_png(sheet).std() > 1
    assert capsys.readouterr().err.count(str(sheet)) == 1
    assert same(*(state_of(tmp_path / name) for name in ("quiet", "shown")))
    rows = [
        [{k: v for k, v in r.items() if k != "train_s"} for r in log_of(tmp_path / n)]
        for n in ("quiet", "shown")
    ]
    assert rows[0] == rows[1]


def test_tensorboard_has_the_numbers_of_the_log_and_pictures(train, tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr(live, "SHARE", 100.0)
    config, board = FakeConfig(steps=20), tmp_path / "board"
    record = train(config, tensorboard=board)
    found = EventAccumulator(str(board), {"images": 0, "scalars": 0}).Reload()
    rows = log_of(tmp_path / "run")
    assert [(e.step, e.value) for e in found.Scalars("training/loss")] == [
        (r["step"], pytest.approx(r["loss"], rel=1e-6)) for r in rows
    ]
    (psnr,) = found.Scalars("test/psnr")
    assert psnr.step == 20 and psnr.value == pytest.approx(record["metrics"]["test"]["psnr"], rel=1e-6)
    assert found.Images("training views")
    # Another run into the same folder takes the place of the first.
    train(FakeConfig(steps=5), run_dir=tmp_path / "second", tensorboard=board)
    found = EventAccumulator(str(board), {"scalars": 0}).Reload()
    assert [e.step for e in found.Scalars("training/loss")] == [1, 2, 3, 4, 5]


def test_without_the_package_the_extra_is_named_and_nothing_is_begun(train, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(PluginError, match=r"(?s)tensorboard.*visdom-plugin\[tensorboard\]"):
        train(tensorboard=tmp_path / "board")
    assert not list(tmp_path.iterdir())


def test_a_word_beside_the_progress_is_silent_when_quiet():
    for quiet, said in ((False, "look: here\n"), (True, "")):
        stream = io.StringIO()
        with Progress(3, quiet=quiet, stream=stream) as progress:
            progress.say("look: here")
        assert stream.getvalue() == said
