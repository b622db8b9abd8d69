"""The functions of `visdom_plugin` that do what the commands do."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from PIL import Image

import visdom_plugin as vd
from visdom_plugin.cli.commands import evaluate as eval_command
from visdom_plugin.cli.commands import train as train_command
from visdom_plugin.workflow.wording import name_arguments

TINY = ("--downscale", "10", "--steps", "3")


@pytest.fixture(scope="module")
def scene():
    return vd.load(views=4, downscale=10)


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("workflow") / "run"
    return vd.train("3dgs-go+vd", scene, out=out, steps=3, report=False, quiet=True, device="cpu")


def test_importing_the_package_and_naming_a_function_that_is_not_used_loads_no_torch():
    code = "import sys, visdom_plugin as vd; dir(vd); print('torch' in sys.modules, 'tyro' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said == "False False\n"


def test_a_scene_is_checked_carved_trained_drawn_and_measured(scene, run, tmp_path):
    assert vd.check(scene) == vd.check(scene.train) == []
    hull = vd.carve(scene, resolution=32, k=2)
    assert hull.shape == vd.carve(scene.train, resolution=32, k=2).shape and hull.summary["k"] == 2
    assert run.record["config"]["steps"] == 3 and run.step == 3 and run.hull is not None
    again = vd.open_run(run.path)
    assert again.scene.train.names == scene.train.names
    assert again.evaluate() == run.metrics and run.metrics["psnr"] > 5
    camera = scene.test.cameras[0]
    picture = again.render(camera)
    assert torch.equal(picture.rgb, run.render(camera).rgb) and picture.rgb.shape == (20, 20, 3)
    black = run.render(camera, background=(0, 0, 0))
    torch.testing.assert_close(picture.rgb - black.rgb, (1 - picture.alpha)[..., None].expand(-1, -1, 3))
    assert len(run.orbit(3)) == 3
    kept = vd.save_image(tmp_path / "view.png", picture)
    assert Image.open(kept).getpixel((0, 0)) == tuple(
        (picture.rgb[0, 0].clamp(0, 1) * 255).round().int().tolist()
    )
    mask = Image.open(vd.save_image(tmp_path / "mask.png", scene.test.masks[0]))
    assert set(mask.convert("L").tobytes()) == {0, 255}
    photograph = Image.open(vd.save_image(tmp_path / "photo.png", scene.test.images[0]))
    assert photograph.tobytes() == scene.test.images[0].numpy().tobytes()


def test_a_run_of_a_command_goes_on_here_and_the_other_way_round(scene, run, tmp_path, capsys):
    out = tmp_path / "run"
    words = [
        "method:3dgs-go+vd",
        *TINY[:2],
        "--method.steps",
        "3",
        "--device",
        "cpu",
        "--quiet",
        "--no-report",
    ]
    assert train_command.main([*words, "--out", str(out)]) == 0
    before = (out / "run.json").read_text()
    same = vd.train("3dgs-go+vd", scene, out=out, steps=3, report=False, quiet=True, device="cpu")
    assert (out / "run.json").read_text() == before and same.metrics == run.metrics
    assert train_command.main([*words, "--out", str(run.path)]) == 0
    assert eval_command.main([str(run.path), "--quiet"]) == 0
    assert vd.open_run(run.path).record["data"] == json.loads(before)["data"]


def test_views_of_ones_own_train_and_are_needed_to_open_the_run(scene, tmp_path):
    views = replace(scene.train.take([0, 1, 2]), names=("a", "b", "c"))
    mine = vd.Scene("mine", views, scene.test.take([]))
    run = vd.train("ingp", mine, out=tmp_path / "run", steps=2, report=False, quiet=True, device="cpu")
    assert run.metrics == {} and run.hull is None
    assert torch.equal(
        vd.open_run(run.path, scene=mine).render(views.cameras[0]).rgb, run.render(views.cameras[0]).rgb
    )
    with pytest.raises(vd.VisDomError, match="the scene given is not the one this run was trained on"):
        vd.open_run(run.path, scene=scene)


def test_a_folder_is_found_again_with_its_options(tmp_path, monkeypatch):
    from datamodules.layouts import transforms  # noqa: F401  (the layout that is written)
    from visdom_plugin.cli.commands import export

    monkeypatch.chdir(tmp_path)
    first = vd.train(
        "ingp", vd.load(downscale=10), out="first", steps=2, report=False, quiet=True, device="cpu"
    )
    assert export.main([str(first.path), "--format", "dataset", "--out", "folder", "--quiet"]) == 0
    scene = vd.load("folder", data_format="nerfstudio", train_list=[0, 2, "train_003"])
    assert len(scene.train) == 3 and scene.source["train_list"] == "0,2,train_003,"
    vd.train("ingp", scene, out="second", steps=2, report=False, quiet=True, device="cpu")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert vd.open_run(tmp_path / "second").scene.train.names == scene.train.names


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda s, r: vd.load(train_lst="all"), "did you mean 'train_list'"),
        (lambda s, r: vd.load(downscale="x"), "downscale cannot be 'x'"),
        (lambda s, r: vd.load(train_list=[0, 1]), "where: train_list\n"),
        (lambda s, r: vd.load("nowhere"), "name the folder of a scene"),
        (lambda s, r: vd.carve(s, kk=2), "carve has no setting 'kk'; did you mean 'k'"),
        (lambda s, r: vd.train("3dgsgo", s), "did you mean '3dgs-go'"),
        (lambda s, r: vd.train("ingp", s, step=3), "did you mean 'steps'"),
        (lambda s, r: vd.train("ingp", s, budget="fast"), "budget cannot be 'fast'"),
        (lambda s, r: vd.train("ingp", s, device="gpu"), "device cannot be 'gpu'"),
        (lambda s, r: vd.train("3dgs-go+vd", s, out=r.path, steps=4), "overwrite replaces what is there"),
        (lambda s, r: r.render(s.test.cameras), "render takes one camera, and was given 16"),
        (lambda s, r: r.orbit(0), "frames is 0"),
        (lambda s, r: vd.open_run(r.path.parent), "one level too high"),
        (lambda s, r: vd.carve("builtin:duck"), "carve takes a scene, and was given 'builtin:duck'"),
        (lambda s, r: vd.check(None), "check takes a scene"),
        (lambda s, r: vd.train("ingp", "builtin:duck"), "train takes a scene"),
        (lambda s, r: vd.train("ingp", s, seed="a"), "seed cannot be 'a'"),
        (lambda s, r: vd.save_image("view.jpg", s.test.images[0]), "writes PNG, not 'view.jpg'"),
        (lambda s, r: vd.save_image("v.png", torch.zeros(3, 5, 6)), "permute(1, 2, 0)"),
        (lambda s, r: vd.save_image("v.png", torch.full((5, 6, 3), 255.0)), "numbers reach 255"),
        (lambda s, r: vd.save_image("v.png", torch.full((5, 6), torch.nan)), "numbers reach nan"),
    ],
)
def test_errors_name_arguments_and_the_nearest_name(call, said, scene, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(vd.VisDomError) as error:
        call(scene, run)
    assert said in str(error.value) and "--" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_an_error_keeps_its_topic():
    with pytest.raises(vd.VisDomError) as error:
        vd.load("nowhere")
    assert error.value.topic == "no-scene" and "folder of a scene" in error.value.todo


def test_inverted_masks_are_refused_as_by_the_command(tmp_path):
    scene = vd.load(downscale=2)
    views = replace(scene.train, masks=[~mask for mask in scene.train.masks])
    with pytest.raises(vd.VisDomError, match="or pass invert_masks"):
        vd.train("ingp", replace(scene, train=views), out=tmp_path / "run", steps=2)


def test_commands_that_an_error_spells_out_keep_their_options():
    text = "pass --train-list all, or run `visdom-check --out X`; --method.hull.k 2 does as well"
    assert name_arguments(text) == "pass train_list all, or run `visdom-check --out X`; hull.k 2 does as well"
    assert name_arguments("visdom-hull DIR --diagnose; --out free") == "visdom-hull DIR --diagnose; out free"
