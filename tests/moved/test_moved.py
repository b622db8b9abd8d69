"""What the pages of version 0.1 imported still imports, and says where it is now."""

import importlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from visdom_plugin.moved import MOVED

ROOT = Path(__file__).parents[2]
NEEDS = {"visdom_plugin.integrations.gsplat": "gsplat", "visdom_plugin.integrations.nerfacc": "nerfacc"}


@pytest.mark.parametrize("old", MOVED)
def test_an_old_place_is_the_module_of_the_new_one(old):
    new = MOVED[old]
    host = "nerfstudio" if "nerfstudio" in new else NEEDS.get(new)
    if host is not None and importlib.util.find_spec(host) is None:
        pytest.skip(f"{host} is not installed")
    for name in [n for n in sys.modules if n == old]:
        del sys.modules[name]
    with pytest.warns(DeprecationWarning, match=re.escape(f"{old} is now {new}; the old name goes with")):
        found = importlib.import_module(old)
    assert found is importlib.import_module(new) and found.__spec__.name == found.__name__ == new
    assert importlib.util.find_spec(new).origin


def test_the_lines_of_the_old_pages_run_and_warn_where_they_stand(tmp_path):
    script = tmp_path / "old.py"
    script.write_text(
        "from visdom_plugin.cameras import rays_of\n"
        "from visdom_plugin.nerf.volume import composite, weights_from_density\n"
        "from visdom_plugin.methods import radiance\n"
        "from datamodules.synthetic import SyntheticConfig, make_scene\n"
        "print(len(make_scene(SyntheticConfig(size=16, test_views=0)).train), rays_of, radiance)\n"
    )
    done = subprocess.run([sys.executable, "-W", "always", str(script)], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("4 ")
    warned = re.findall(rf"{re.escape(str(script))}:(\d): DeprecationWarning: (\S+) is now", done.stderr)
    # An import asks a package for each name twice.
    assert sorted({(int(line), name.rpartition(".")[2]) for line, name in warned}) == [
        (1, "cameras"),
        (2, "volume"),
        (3, "radiance"),
        (4, "SyntheticConfig"),
        (4, "make_scene"),
    ]


def test_the_changelog_has_every_old_place():
    told = dict(re.findall(r"^\| `([\w.]+)` \| `([\w.]+)` \|", (ROOT / "CHANGELOG.md").read_text(), re.M))
    packages = {"visdom_plugin.hooks.adapters", "visdom_plugin.hosts", "visdom_plugin.hosts.nerfstudio"}
    assert {old: told.get(old) for old in MOVED if old not in packages} == {
        old: new for old, new in MOVED.items() if old not in packages
    }


def test_our_own_code_uses_no_old_place():
    old = re.compile(
        "|".join(rf"\b{re.escape(name)}\b(?!\.py)" for name in [*MOVED, "datamodules.synthetic import"])
    )
    for folder in (
        "visdom_plugin",
        "method_configs",
        "datamodules",
        "examples",
        "benchmarks",
        "scripts",
        "docs",
    ):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".md", ".ipynb") and path.parent.name != "moved":
                assert not old.search(path.read_text(encoding="utf-8")), path
