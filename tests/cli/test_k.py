"""K has one spelling in all commands, the older ones do as well, and one above the number of views is refused."""

from dataclasses import replace

import pytest

import datamodules
import visdom_plugin as vd
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts.layout_writers import write_colmap
from visdom_plugin.cli import options
from visdom_plugin.cli.commands import check, hull, train
from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.hull.wording import for_commands, wording


@pytest.mark.parametrize("words", [["--k", "2"], ["-k", "2"], ["--k=2"], ["--method.hull.k", "2"]])
def test_training_takes_it_as_the_other_commands_do(words):
    assert options.parse(["method:ingp+vd", *words]).config.hull.k == 2


def test_advice_to_commands_names_options_alone():
    assert wording().set_k.format(k=2) == "VisibleDomain(k=2)" and not wording().poses
    with for_commands():
        assert wording().set_k.format(k=2) == "--k 2" and "visdom-check" in wording().poses


COMMANDS = {
    "check": (check.main, []),
    "hull": (hull.main, []),
    "train": (train.main, ["method:ingp+vd"]),
    "train, with the default K": (train.main, ["method:visdom-gs"]),
}


def refusal(command, words, capsys) -> str:
    main, before = COMMANDS[command]
    assert main([*before, *words]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_one_above_the_views_asked_for_is_refused_before_anything_is_read(command, capsys, monkeypatch):
    monkeypatch.setattr(datamodules, "load", lambda *_, **__: pytest.fail("a scene was read"), raising=False)
    views, k = ("2", "3") if "default" in command else ("4", "5")
    given = [] if "default" in command else ["--k", k]
    for asked in (["--views", views], ["--train-list", ",".join(map(str, range(int(views))))]):
        said = refusal(command, [*given, *asked], capsys)
        assert f"K = {k} is more than the {views} views trained on" in said
        assert f"--views {k} or more; or a smaller K: --k {min(3, int(views))}" in said


@pytest.mark.parametrize("command", [name for name in COMMANDS if "default" not in name])
def test_one_above_the_views_of_a_small_scene_is_refused_before_the_work(
    command, capsys, tmp_path, monkeypatch
):
    scene = write_colmap(
        make_scene(SyntheticConfig(size=(48, 36), train_views=3, test_views=0)).train, tmp_path / "s"
    )
    monkeypatch.chdir(tmp_path)
    said = refusal(command, ["--data", str(scene), "--views", "9", "--k", "4"], capsys)
    assert "K = 4 is more than the 3 views trained on" in said and "--views 4 or more" in said
    assert "carving" not in said and not (tmp_path / "runs").exists()


def test_hulls_without_k_and_k_by_a_rule_ask_for_no_number_of_views():
    HullSettings(k=3).require_views(3)
    for settings in (HullSettings(k="n-1"), HullSettings(k="auto"), HullSettings(k=9, kind="traditional")):
        settings.require_views(2)
    with pytest.raises(ConfigError, match="than the 1 view trained on") as caught:
        HullSettings().require_views(1)
    assert caught.value.todo == "use 3 views or more"


def test_training_from_python_refuses_it_as_well(tmp_path):
    scene = make_scene(SyntheticConfig(size=(48, 36), test_views=1))
    with pytest.raises(ConfigError, match="K = 5 is more than the 4 views"):
        vd.train("ingp+vd", scene, out=tmp_path / "run", hull={"k": 5})
    without = replace(scene.train, mask_origins=("given", "given", "missing", "missing"))
    with pytest.raises(ConfigError, match="K = 3 is more than the 2 views"):
        vd.train("ingp+vd", replace(scene, train=without), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
