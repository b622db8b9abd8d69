"""visdom-check, as a user types it."""

import json
import logging
import shlex
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts.layout_writers import write_colmap
from tests.datamodules.layouts.prepared_writer import write_prepared
from tests.hull.checks.faults import FAULTS, capture_of
from visdom_plugin.cli import options
from visdom_plugin.cli.commands import train
from visdom_plugin.cli.commands.check import check_views, main, warn_of_faults
from visdom_plugin.cli.output.reports import training_command
from visdom_plugin.figures.check_sheet import draw_check
from visdom_plugin.scene import Scene, Views


@pytest.fixture(scope="module")
def sound():
    return load(None, views=4, downscale=2)


@pytest.fixture(scope="module")
def folder(sound, tmp_path_factory):
    return write_prepared(sound, tmp_path_factory.mktemp("check") / "scene")


def spoil(folder, tmp_path, change):
    """A copy of the scene with the second training view's mask file changed."""
    copy = tmp_path / "scene"
    shutil.copytree(folder, copy)
    path = copy / "masks" / "train_001.png"
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert cv2.imwrite(str(path), change(mask))
    return copy


def test_a_sound_scene_exits_with_0(folder, capsys):
    assert main([str(folder), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["clean"] and report["findings"] == [] and report["k"] == 3
    assert [n["kind"] for n in report["notes"]] == ["border"]
    assert sorted(report["covisibility"]) == ["1", "2", "3"]
    assert list(report["covisibility"]["3"]) == report["views"]


def test_the_built_in_scene_is_sound(capsys):
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert "4 views, nothing wrong" in shown and "K = 3" in shown


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("inverted", lambda m: 255 - m),
        ("empty", lambda m: 0 * m),
        ("full", lambda m: 0 * m + 255),
        ("size", lambda m: m[:-10]),
        ("view", lambda m: m[:, ::-1]),
    ],
)
def test_findings_exit_with_1_and_name_the_view(folder, tmp_path, kind, change, capsys):
    spoilt = spoil(folder, tmp_path, change)
    assert main([str(spoilt), "--json"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["kind"] == kind and any("train_001" in name for name in finding["views"])
    assert finding["todo"] and finding["sure"] in ("certain", "likely", "possible")
    assert main([str(spoilt), "--quiet"]) == 1
    assert capsys.readouterr().out == ""
    assert main([str(spoilt)]) == 1
    shown = capsys.readouterr().out
    assert "1 finding" in shown and shown.count("docs/guide/troubleshooting.md#findings") == 1


def test_masks_that_are_photographs_or_grey_are_findings(folder, tmp_path, capsys):
    spoilt = spoil(folder, tmp_path, lambda m: cv2.GaussianBlur(m, (0, 0), 15))
    assert main([str(spoilt), "--json"]) == 1
    (finding,) = (f for f in json.loads(capsys.readouterr().out)["findings"] if f["kind"] == "mask-grey")
    assert finding["views"] == ["train_001.png"] and "neither black nor white" in finding["what"]
    shutil.copy(spoilt / "images/train_001.png", spoilt / "masks/train_001.png")
    assert main([str(spoilt), "--json"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert (finding["kind"], finding["sure"]) == ("mask-grey", "certain")
    assert main([str(spoilt)]) == 1 and "scene: cannot be read, 1 finding" in capsys.readouterr().out
    assert "is a photograph" in finding["what"] and "alpha channel" in finding["todo"]


def test_sheet_and_report_are_written(folder, tmp_path, capsys):
    spoilt = spoil(folder, tmp_path, lambda m: np.roll(m, 12, 1))
    out = tmp_path / "report"
    assert main([str(spoilt), "--out", str(out), "--json"]) == 1
    assert sorted(p.name for p in out.iterdir()) == ["check.json", "check.png"]
    assert json.loads((out / "check.json").read_text()) == json.loads(capsys.readouterr().out)
    assert cv2.imread(str(out / "check.png")).std() > 10


def test_the_sheet_is_red_where_a_mask_disagrees(sound):
    def redness(capture):
        grey = tuple(torch.full_like(i, 128) for i in capture.images)
        views = Views(capture.cameras, grey, capture.masks, capture.names)
        found = check_views(views, capture.masks)
        sheet = draw_check(views, capture.masks, found).astype(int)
        # Below the lines of text, one of which has the colours of the legend.
        pixels = sheet[48 + 18 * max(1, len(found.findings)) :]
        return int((pixels[..., 0] - pixels[..., 1:].max(-1) > 120).sum())

    capture = capture_of(sound.train)
    assert redness(capture) < 30
    assert redness(FAULTS["mirrored_mask"](capture, 1).capture) > 500


def test_the_legend_is_whole_for_a_single_view(sound):
    def blue_words(views):
        found = check_views(views, views.masks)
        sheet = draw_check(views, views.masks, found).astype(int)
        # The legend's line, of which the last part is blue; its background is dark grey.
        line = next(i for i in range(len(sheet)) if (sheet[i] - (255, 214, 0) == 0).all(-1).any())
        return int((sheet[line : line + 12, ..., 2] - sheet[line : line + 12, ..., 0] > 100).sum())

    whole = blue_words(sound.train)
    assert whole > 100 and blue_words(sound.train.take([0])) == whole


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "no such folder"),
        (["one", "--data", "two"], "two scenes"),
        (["-k", "0"], "k is 0"),
        (["--views", "99"], "train_views"),
    ],
)
def test_mistakes_exit_with_2_and_a_message(words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--json"]) == 2
    shown = capsys.readouterr()
    assert said in shown.err
    assert shown.out == "" and "Traceback" not in shown.err


def test_a_sound_scene_ends_with_the_command_that_trains_on_it(folder, capsys):
    assert main([str(folder), "--downscale", "2"]) == 0
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == f"next: visdom-train method:visdom-gs --data {folder} --downscale 2"
    assert main([str(folder), "--quiet"]) == 0 and capsys.readouterr().err == ""
    # Of two views the usual K = 3 leaves nothing.
    two = ",".join(load(folder, test=False).train.names[::2])
    assert main([str(folder), "--train-list", two]) == 0
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"--train-list {two} --k 2")


def test_where_all_views_were_checked_the_command_leaves_some_to_test_on(tmp_path, capsys):
    views = make_scene(SyntheticConfig(size=(64, 48), train_views=9, test_views=0)).train
    scene = write_colmap(views, tmp_path / "s")
    for count, wanted in (("9", "6"), ("8", "6"), ("5", "5")):
        main([str(scene), "--views", count])
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith("next") and f"--views {wanted}" in last
        common = options.parse(shlex.split(last)[2:]).common
        assert len(load(scene, views=common.views).test)


@pytest.mark.parametrize(("longest", "factor"), [(200, 2), (799, 2), (800, 4), (1500, 4), (4032, 16)])
def test_the_command_to_train_with_makes_large_pictures_small(tmp_path, longest, factor):
    scene = tmp_path / "my scene"
    scene.mkdir()
    asked = options.parse(["method:visdom-gs", str(scene), "--downscale", "2", "--train-list", "a,b"]).common
    words = shlex.split(training_command(scene, options.read_options(asked), longest))
    common = options.parse(words[1:]).common
    assert (words[0], common.data, common.downscale) == ("visdom-train", scene, factor)
    assert common.train_list == "a,b"


def test_training_is_warned(sound, caplog):
    def scene_of(capture):
        views = Views(capture.cameras, capture.images, capture.masks, capture.names)
        return Scene("spoilt", views, views)

    capture = capture_of(sound.train)
    with caplog.at_level(logging.WARNING):
        warn_of_faults(scene_of(capture))
        assert caplog.text == ""
        warn_of_faults(scene_of(FAULTS["same_view"](capture, 2).capture))
    assert "certain" in caplog.text and "what to do" in caplog.text


def test_masks_that_are_certainly_inverted_stop_training_and_can_be_turned_over(folder, tmp_path, capsys):
    spoilt = tmp_path / "spoilt"
    shutil.copytree(folder, spoilt)
    for path in (spoilt / "masks").iterdir():
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    run = ["method:ingp", "--data", str(spoilt), "--out", str(tmp_path / "run"), "--quiet"]
    assert train.main(run) == 2
    error = capsys.readouterr().err
    assert "all masks are foreground along most" in error and "or pass --invert-masks" in error
    assert not (tmp_path / "run").exists()
    assert main([str(spoilt), "--invert-masks", "--quiet"]) == main([str(folder), "--quiet"]) == 0
    assert train.main([*run[:2], str(folder), *run[3:], "--invert-masks"]) == 2
    assert "leave out --invert-masks" in capsys.readouterr().err


def test_help_needs_no_heavy_import():
    code = (
        "import sys\n"
        "from visdom_plugin.cli.commands.check import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'torch', 'numba', 'cv2', 'skimage', 'scipy'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--data.missing-masks" in done.stdout
