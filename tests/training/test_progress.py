"""The bar on a terminal, the lines elsewhere."""

from __future__ import annotations

import io

from visdom_plugin.training.progress import Progress


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _show(stream, **keywords) -> str:
    with Progress(10, 4, stream=stream, **keywords) as progress:
        for done in range(5, 11):
            progress.show(done, 0.25, 21.5, every=0)
    return stream.getvalue()


def test_a_terminal_gets_a_bar_with_loss_and_psnr():
    text = _show(_Terminal())
    assert "training" in text and "10/10" in text and "loss 0.2500  train PSNR 21.50" in text


def test_a_file_gets_one_plain_line_each_time():
    lines = _show(io.StringIO()).splitlines()
    assert len(lines) == 6 and lines[-1] == "step 10/10  loss 0.2500  train PSNR 21.50  0 s left"
    assert "\x1b" not in "".join(lines)


def test_quiet_is_quiet_on_both():
    assert _show(io.StringIO(), quiet=True) == _show(_Terminal(), quiet=True) == ""


def test_lines_keep_their_distance_but_the_last_always_comes():
    stream = io.StringIO()
    with Progress(100, stream=stream) as progress:
        for done in range(1, 101):
            progress.show(done, 1.0, every=1000)
    assert [line.split()[1] for line in stream.getvalue().splitlines()] == ["100/100"]
