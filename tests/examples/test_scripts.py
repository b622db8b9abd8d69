"""The numbered examples: short, described, and they run; and the notebook from photographs to a picture."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from visdom_plugin.prepare.demo import DemoConfig, write_demo

EXAMPLES = Path(__file__).parents[2] / "examples"
NOTEBOOK = EXAMPLES / "07_photographs_to_picture.ipynb"
QUICK = {
    "01_hull_from_arrays": ({"resolution": 32}, "train_005: ", ["hull.ply"]),
    "02_bounds_in_a_nerf": (
        {"steps": 2, "rays": 50, "downscale": 10},
        "PSNR of an unseen view: ",
        ["nerf.png"],
    ),
    "03_l_i_in_a_splat_loop": (
        {"steps": 2, "count": 200, "downscale": 5},
        "PSNR of an unseen view: ",
        ["splats.png"],
    ),
    "04_gsplat_companion": ({"steps": 8, "count": 200, "downscale": 5}, "200 Gaussians became ", []),
    "05_nerfacc_estimator": ({"steps": 17, "rays": 50, "downscale": 10}, " cells may be occupied, ", []),
    "06_table": (
        {"steps": 2, "downscale": 10, "out": Path("two")},
        "| in the visible domain |",
        ["two/table.html"],
    ),
}
"""Settings that take seconds, words of what is printed, files that are written."""
NEEDS = {"04_gsplat_companion": "gsplat", "05_nerfacc_estimator": "nerfacc"}


@pytest.mark.parametrize("name", QUICK)
def test_an_example_runs(name, tmp_path, monkeypatch, capsys):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.chdir(tmp_path)
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    settings, said, files = QUICK[name]
    assert not module.main(**settings)
    assert said in capsys.readouterr().out
    assert all((tmp_path / file).is_file() for file in files)


def test_examples_are_short_and_say_what_they_are_for_and_how_they_are_called():
    scripts = sorted(EXAMPLES.glob("*.py"))
    assert [path.stem for path in scripts] == list(QUICK)
    for path in scripts:
        source = path.read_text(encoding="utf-8")
        said = ast.get_docstring(ast.parse(source))
        assert f"    python examples/{path.name}" in said and len(said.splitlines()[0]) < 116
        assert len(source.splitlines()) - len(said.splitlines()) <= 60, path.name
        shown = re.findall(rf"python examples/{path.name}(.*?)(?:#.*)?$", said, re.M)
        for line in filter(str.strip, shown):
            options = {
                w.lstrip("-").removeprefix("no-").replace("-", "_") for w in line.split() if w[:2] == "--"
            }
            assert options <= set(re.findall(r"(\w+): [\w| ]+ = ", source)), line


def test_the_readme_lists_every_example_in_order_without_a_gap():
    there = [path.name for path in sorted([*EXAMPLES.glob("*.py"), *EXAMPLES.glob("*.ipynb")])]
    packages = [f"{path.parent.name}/" for path in sorted(EXAMPLES.glob("*/pyproject.toml"))]
    listed = re.findall(r"^\| `([^`]+)` \|", (EXAMPLES / "README.md").read_text(encoding="utf-8"), re.M)
    assert listed == there + packages
    assert [int(name[:2]) for name in there] == list(range(1, len(there) + 1))


def test_a_script_takes_its_settings_from_the_command_line(tmp_path):
    command = [
        sys.executable,
        str(EXAMPLES / "01_hull_from_arrays.py"),
        "--resolution",
        "32",
        "--out",
        "mine.ply",
    ]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert "mine.ply: a mesh" in said and (tmp_path / "mine.ply").is_file()


def test_the_notebook_holds_no_output():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert {cell["cell_type"] for cell in cells} == {"markdown", "code"}
    assert all(not c["outputs"] and c["execution_count"] is None for c in cells if c["cell_type"] == "code")


@pytest.mark.slow
def test_the_notebook_goes_from_photographs_to_pictures(tmp_path, monkeypatch):
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    # The same photographs, fewer and smaller.
    write_demo(tmp_path / "photos", DemoConfig(views=6, size=(960, 720), samples=1))
    namespace: dict[str, object] = {}
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        code = "".join(cell["source"])
        if cell["cell_type"] != "code" or code == "!visdom-prepare --demo photos":
            continue
        if code.startswith("!visdom-prepare "):
            words = shlex.split(code)[1:]
            subprocess.run(
                [sys.executable, "-m", "visdom_plugin.cli.commands.prepare", *words, "--size", "300"],
                check=True,
            )
            continue
        code = code.replace("SETTINGS = {}", 'SETTINGS = {"steps": 3, "report": False, "quiet": True}')
        exec(compile(code, str(NOTEBOOK), "exec"), namespace)
    assert len(namespace["frames"]) == 4 and namespace["run"].metrics["psnr"] > 5
    assert (tmp_path / "hull.ply").is_file()
