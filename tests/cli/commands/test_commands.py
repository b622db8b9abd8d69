"""The commands as a user types them: what they print, write and return."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from tests.training import fake
from visdom_plugin.cli import convert, entry, runs
from visdom_plugin.cli.commands import evaluate, export, methods, prepare, render, report, train
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.scene import Views
from visdom_plugin.training.runs.run_directory import hash_views

ROOT = Path(__file__).resolve().parents[3]
TRAIN = ["method:fake", "--method.steps", "12", "--out", "run"]


@pytest.fixture
def trained(fakes, capsys):
    assert train.main([*TRAIN, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    return Path("run")


def test_training_ends_with_a_table_and_where_the_pictures_are(fakes, capsys):
    assert train.main([*TRAIN[:-2], "--views", "6", "--downscale", "2", "--seed", "3"]) == 0
    out, err = capsys.readouterr()
    run = Path("runs/ball/4/fake/3")
    ((path, keywords),) = fakes
    assert path is None and keywords.items() >= {"views": 6, "downscale": 2.0, "seed": 3}.items()
    assert "fake on the built-in scene, budget quick, chosen for device" in err.splitlines()[0]
    assert "data: ball, 4 training views, 3 test views" in err
    assert f"visdom-view {run} " in err.splitlines()[-3] and "visdom-export" in err.splitlines()[-1]
    for words in ("fake on ball, 3 test views", "PSNR", "dB", "SSIM", "silhouette IoU", "opacity outside"):
        assert words in out, words
    for name in ("renders/test_sheet.png", "renders/test", "export", "run.json"):
        assert str(run / name) in out and (run / name).exists()
    assert "LPIPS" not in out
    record = json.loads((run / "run.json").read_text())
    assert record["config"]["steps"] == 12 and record["budget"] == "quick" and record["seed"] == 3
    assert (record["data"]["path"], record["data"]["downscale"]) == (None, 2.0)


def test_the_same_command_again_says_that_the_run_is_finished(trained, capsys):
    assert train.main(TRAIN) == 0
    out, err = capsys.readouterr()
    assert "finished already" in err and "PSNR" in out and "step " not in err


@pytest.mark.parametrize("command", [convert, evaluate, export, prepare, render, report, train])
def test_a_command_that_needs_words_answers_none_with_an_example(command, capsys):
    assert command.main([]) == entry.USER_ERROR
    out, err = capsys.readouterr()
    assert out == "" and re.match(
        r"error: no [\w, ]+ named\n  what to do: (for example: )?visdom-\w+ \S+", err
    )


def test_a_missing_word_is_answered_with_an_example(capsys):
    with pytest.raises(SystemExit) as end:
        render.main(["--path", "orbit"])
    assert end.value.code == entry.USER_ERROR
    assert capsys.readouterr().err.splitlines()[-1].startswith("for example: visdom-render runs/")


def test_another_command_on_the_same_directory_is_refused_with_the_way_out(trained, capsys):
    assert train.main([*TRAIN, "--method.lr", "0.5"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.splitlines()[-5:] == [
        "error: the run directory holds another run (there -> now):",
        "    config.lr: 0.05 -> 0.5",
        "  where: run",
        "  what to do: --out run-2 keeps both, --overwrite replaces what is there",
        "  more: docs/guide/troubleshooting.md#other-run",
    ]
    assert train.main([*TRAIN[:-1], "run-2", "--method.lr", "0.5", "--quiet"]) == 0
    assert train.main([*TRAIN, "--method.lr", "0.25"]) == 2 and "--out run-3 keeps" in capsys.readouterr().err
    assert train.main([*TRAIN, "--downscale", "2"]) == 2
    error = capsys.readouterr().err
    assert "data.downscale: 1.0 -> 2.0" in error and "hashes" not in error
    assert train.main([*TRAIN, "--method.lr", "0.5", "--overwrite", "--quiet"]) == 0


def test_show_config_prints_yaml_and_trains_nothing(fakes, capsys):
    assert train.main([*TRAIN, "--show-config"]) == 0
    out, _ = capsys.readouterr()
    Path("my.yaml").write_text(out)
    assert not fakes and not Path("run").exists()
    assert train.main(["--config", "my.yaml", "--show-config"]) == 0
    assert capsys.readouterr().out == out
    assert train.main(["--config", "my.yaml", "--out", "run", "--quiet"]) == 0
    assert json.loads(Path("run/run.json").read_text())["config"]["steps"] == 12


def test_eval_gives_the_same_numbers_again_and_renews_the_pictures(trained, capsys):
    record = json.loads((trained / "run.json").read_text())
    (trained / "renders" / "test_sheet.png").unlink()
    assert evaluate.main([str(trained)]) == 0
    again = json.loads((trained / "run.json").read_text())
    assert again["metrics"] == record["metrics"] and again["config"] == record["config"]
    assert (trained / "renders" / "test_sheet.png").exists()
    assert "PSNR" in capsys.readouterr().out


def test_eval_of_changed_data_is_refused(trained, capsys, monkeypatch):
    import datamodules

    other = fake.tiny_scene()
    other.train.images[0][5, 5] ^= 1
    monkeypatch.setattr(datamodules, "load", lambda *a, **k: other)
    assert evaluate.main([str(trained)]) == 2
    assert "not the one this run was trained on" in capsys.readouterr().err
    record = json.loads((trained / "run.json").read_text())
    record["data"]["path"] = "/gone"
    with pytest.raises(Exception, match="--data DIR"):
        runs.load_again(record, trained, None)


@pytest.mark.parametrize("command", [evaluate.main, render.main])
def test_a_directory_that_is_no_run_is_said(fakes, capsys, tmp_path, command):
    (tmp_path / "a" / "b").mkdir(parents=True)
    assert command(["a"]) == 2 and "has no run.json" in capsys.readouterr().err
    (tmp_path / "a" / "b" / "run.json").write_text("{")
    assert command(["a"]) == 2 and "one level too high: a/b" in capsys.readouterr().err
    assert command(["a/b"]) == 2 and "run.json cannot be read" in capsys.readouterr().err
    (tmp_path / "a" / "b" / "run.json").write_text('{"schema": 99}')
    assert command(["a/b"]) == 2 and "schema 99" in capsys.readouterr().err
    assert command(["nowhere"]) == 2 and "no such folder" in capsys.readouterr().err


def test_render_writes_a_video_that_plays(trained, capsys):
    assert render.main([str(trained), "--frames", "7"]) == 0
    target = capsys.readouterr().out.strip()
    assert target == "run/renders/orbit.mp4"
    video = cv2.VideoCapture(target)
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == 7 and frames[0].shape == (20, 24, 3)
    assert frames[0][0, 0].min() > 240 and frames[0][10, 12].min() < 230


@pytest.mark.parametrize(("path", "count"), [("orbit", 5), ("between", 5), ("train", 4), ("test", 3)])
def test_render_writes_pictures_of_every_path(trained, path, count):
    words = ["--path", path, "--frames", "5", "--format", "png", "--out", "frames", "--quiet"]
    assert render.main([str(trained), *words]) == 0
    assert sorted(p.name for p in Path("frames").iterdir()) == [f"{i:04d}.png" for i in range(count)]


def _frames(run, count, *words):
    return render.main([str(run), "--frames", str(count), "--format", "png", "--quiet", *words])


def test_pictures_of_a_longer_path_do_not_stay(trained, capsys):
    folder = trained / "renders" / "orbit_frames"
    assert _frames(trained, 5) == 0
    (folder / "0004.txt").write_text("mine")
    assert _frames(trained, 2) == 0
    assert sorted(p.name for p in folder.iterdir()) == ["0000.png", "0001.png", "0004.txt"]
    # In a folder that somebody chose they may be somebody's.
    assert _frames(trained, 3, "--out", "mine") == _frames(trained, 3, "--out", "mine") == 0
    before = {p: p.read_bytes() for p in Path("mine").iterdir()}
    assert _frames(trained, 2, "--out", "mine", "--path", "between") == 2
    assert "beyond the 2 of this path: 0002.png" in capsys.readouterr().err
    assert before == {p: p.read_bytes() for p in Path("mine").iterdir()} and len(before) == 3


def test_pictures_of_test_views_leave_those_of_the_evaluation_alone(trained):
    evaluated = {p.name: p.read_bytes() for p in (trained / "renders" / "test").iterdir()}
    assert _frames(trained, 2, "--path", "test") == 0
    assert evaluated == {p.name: p.read_bytes() for p in (trained / "renders" / "test").iterdir()}
    assert len(list((trained / "renders" / "test_frames").iterdir())) == len(evaluated) == 3


def test_what_cannot_be_rendered_is_said_before_anything_is(trained, capsys, monkeypatch):
    import datamodules
    from visdom_plugin.training import evaluate as evaluation

    scene = fake.tiny_scene()
    empty = replace(scene, test=scene.test.take([]))
    wide = fake.tiny_views(1, 30, "wide_", (30, 20))
    both = [[*getattr(scene.test, name), *getattr(wide, name)] for name in ("images", "masks", "names")]
    cameras = Cameras.stack([*(scene.test.cameras[i] for i in range(3)), wide.cameras[0]])
    mixed = replace(scene, test=Views(cameras, *both))
    monkeypatch.setattr(evaluation, "render_on_white", None)

    def fails(words, says):
        assert render.main([str(trained), *words]) == 2
        err = capsys.readouterr().err
        assert says in err and "what to do" in err and "Traceback" not in err

    for name in ("video", "video.webm", "folder/", "."):
        fails(["--out", name], "says no format")
        fails(["--out", name, "--format", "mp4"], "ends in .mp4")
    fails(["--out", "one.png"], "do not fit into one file")
    fails(["--out", "video.gif", "--fps", "60"], "at most 50 frames")
    fails(["--path", "orbot"], "did you mean 'orbit'")
    record = json.loads((trained / "run.json").read_text())
    for changed, says in ((empty, "there are no test views"), (mixed, "differ in size")):
        monkeypatch.setattr(datamodules, "load", lambda *a, scene=changed, **k: scene)
        record["data"]["hashes"]["test_views"] = hash_views(changed.test)
        (trained / "run.json").write_text(json.dumps(record))
        fails(["--path", "test"], says)
    assert not (trained / "renders" / "test.mp4").exists()


def test_the_path_between_views_begins_and_ends_at_views():
    scene = fake.tiny_scene()
    cameras, _ = render.cameras_along("between", 7, scene, None)
    ends = scene.train.cameras.world_from_camera[[0, -1]]
    assert (cameras.world_from_camera[[0, -1]] - ends).abs().max() < 1e-9 and len(cameras) == 7


def test_methods_lists_names_descriptions_and_aliases(fakes, capsys):
    assert methods.main([]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "method:fake       one colour per view (also method:pretend)",
        "method:fake+fast  the same, larger steps",
    ]


def test_the_doctor_names_what_is_there_and_warns_of_two_opencvs(fakes, capsys, monkeypatch):
    from visdom_plugin.cli import methods_doctor
    from visdom_plugin.registry import Skipped

    assert methods.main(["--doctor"]) == 0
    out = capsys.readouterr().out
    for name in (
        "python: ",
        "torch: ",
        "cuda: ",
        "numba: ",
        "gsplat: ",
        "opencv: opencv",
        "method fake: from tests",
    ):
        assert name in out
    known = fake.fake_registry()
    known.skipped.append(Skipped("strange", "1.2", "x:y", "ImportError: no", "mend it", "Traceback"))
    monkeypatch.setattr(
        methods_doctor, "opencv_distributions", lambda: [("opencv-python", "4"), ("opencv-x", "5")]
    )
    warnings = [line for line in methods_doctor.examine(known) if line.startswith("warning")]
    assert (
        "pip uninstall opencv-python opencv-x" in warnings[0]
        and "strange 1.2 (x:y) was skipped" in warnings[1]
    )


def test_bugs_pass_through_with_a_hint_and_signals_give_130(capsys):
    def bug(argv):
        raise KeyError("x")

    def stop(argv):
        raise KeyboardInterrupt

    with pytest.raises(KeyError):
        entry.run(bug, [])
    assert "a bug" in capsys.readouterr().err
    assert entry.run(stop, []) == 130 and capsys.readouterr().err == "interrupted\n"


def test_an_interrupted_training_says_that_the_same_command_resumes(fakes, capsys, caplog, monkeypatch):
    import os

    step_of = fake.FakeMethod.train_step

    def interrupted_step(self, batch, step):
        if step == 4:
            os.kill(os.getpid(), signal.SIGINT)
        return step_of(self, batch, step)

    with monkeypatch.context() as patch:
        patch.setattr(fake.FakeMethod, "train_step", interrupted_step)
        assert train.main([*TRAIN, "--quiet"]) == 130
    again = f"visdom-train {shlex.join([*TRAIN, '--quiet'])}"
    assert capsys.readouterr().err == f"interrupted; go on with: {again}\n"
    assert train.main([*TRAIN]) == 0
    assert "resumed after step 5" in capsys.readouterr().err
    assert "the run goes on at step 5 of 12" in caplog.text


@pytest.mark.parametrize("words", [["--vews", "3"], ["--seed", "many"], ["--budget", "huge"], ["a", "b"]])
def test_unknown_options_and_values_exit_2_and_name_the_word(fakes, capsys, words):
    with pytest.raises(SystemExit) as caught:
        train.main(["method:fake", *words])
    out, err = capsys.readouterr()
    assert caught.value.code == 2 and words[0] in out + err and "Traceback" not in err


def test_help_of_a_method_shows_its_settings_and_budget(fakes, capsys):
    with pytest.raises(SystemExit) as caught:
        train.main(["method:fake", "--help", "--budget", "full"])
    out = capsys.readouterr().out
    assert caught.value.code == 0
    for words in (
        "one colour per view",
        "--method.steps INT",
        "(default: 80)",
        "How much noise",
        "--data",
        "budget full",
    ):
        assert words in out, words


def test_help_lists_the_built_in_methods_and_imports_nothing_heavy():
    code = (
        "import sys\n"
        "from visdom_plugin.cli.commands.train import main\n"
        "vd = 'method:3dgs-go+vd'\n"
        "for words in (['--help'], [vd, '--help'], [vd, '--device', 'cpu', '--show-config']):\n"
        "    try: main(words)\n"
        "    except SystemExit as done: assert not done.code\n"
        "heavy = {'torch', 'numba', 'cv2', 'trimesh', 'skimage', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in ("method:3dgs-go:", "method:3dgs-go+mask:", "method:3dgs-go+vd:", "--method.hull.k"):
        assert name in done.stdout, name


@pytest.mark.parametrize("fault", ["ENOSPC", "EROFS", "EEXIST", "ENOTDIR", "EISDIR", "ENAMETOOLONG"])
def test_a_full_disk_or_a_wrong_path_is_not_called_a_bug(capsys, fault):
    import errno
    import os

    code = getattr(errno, fault)

    def fail(argv):
        raise OSError(code, os.strerror(code), "run/log.jsonl")

    assert entry.run(fail, []) == 2
    err = capsys.readouterr().err
    assert os.strerror(code) in err and "run/log.jsonl" in err and "bug" not in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["method:fake", "--views", "4,6"], "--views is '4,6', and it takes one whole number"),
        (["method:fake", "--views=many"], "--views is 'many'"),
        (["method:fake", "nowhere"], "there is no such folder"),
        (["nowhere"], "no method is named"),
        (["method:fake", "scene", "--data", "other"], "two scenes: scene and other"),
    ],
)
def test_slips_are_answered_in_our_own_words(fakes, capsys, words, says):
    assert train.main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and says in error and "Python" not in error


def test_method_and_scene_may_stand_as_plain_words(fakes, capsys, tmp_path):
    (tmp_path / "scene").mkdir()
    words = ["--method.steps", "12", "--out", "run", "--quiet"]
    assert train.main(["fake", str(tmp_path / "scene"), *words]) == 0
    ((path, _),) = fakes
    assert path == tmp_path / "scene"
    record = json.loads(Path("run/run.json").read_text())
    assert record["method"] == "fake" and record["data"]["path"] == str(tmp_path / "scene")


@pytest.mark.parametrize("command", [train.main, evaluate.main, render.main, methods.main])
def test_every_command_says_its_version(capsys, command):
    assert command(["--version"]) == 0
    assert re.fullmatch(r"visdom-plugin \d+\.\d+\S*\n", capsys.readouterr().out)


@pytest.mark.parametrize("words", [["train", "method:ingp"], ["check"], ["hull"]])
def test_a_mistake_in_the_scenes_name_needs_no_heavy_import(words):
    name, *method = words
    code = (
        "import sys\n"
        f"from visdom_plugin.cli.commands.{name} import main\n"
        f"assert main([*{method}, '/no/such/folder']) == 2\n"
        "heavy = {'torch', 'numba', 'cv2', 'skimage', 'scipy'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
