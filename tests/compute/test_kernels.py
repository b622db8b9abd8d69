"""Machine code on disk follows every function and constant that it was compiled from, and nothing else."""

import importlib
import re
import shutil
import sys
from pathlib import Path

import numba
import pytest

from visdom_plugin.compute.kernels import _StampedFile

SOURCES = {
    "__init__": "",
    "sizes": "TILE = 3\nUNUSED = 1\n",
    "parts": """
        from llvmlite import ir
        from numba import types
        from numba.extending import intrinsic
        from visdom_plugin.compute.kernels import fast_overload, kernel

        @kernel()
        def twice(x):
            return 2 * x

        @kernel()
        def unused(x):
            return x

        def _constant(builder):
            return ir.Constant(ir.DoubleType(), 7.0)

        @intrinsic
        def seven(typing_context):
            def generate(context, builder, signature, arguments):
                return _constant(builder)
            return types.float64(), generate

        def third(x):
            raise NotImplementedError

        @fast_overload(third)
        def _third(x):
            return lambda x: x / 3
    """,
    "middle": """
        from workshop import parts
        from visdom_plugin.compute.kernels import kernel

        @kernel(inline="never")
        def middle(x):
            return parts.twice(x) + parts.seven()
    """,
    "caller": """
        from visdom_plugin.compute.kernels import kernel
        from workshop.middle import middle
        from workshop.parts import third
        from workshop.sizes import TILE

        @kernel()
        def call(x):
            return middle(x) + third(x) + TILE
    """,
}


class Workshop:
    """A package in a folder, imported anew at each call, as another process would."""

    def __init__(self, folder: Path):
        self.folder = folder / "workshop"
        self.folder.mkdir()
        for name, text in SOURCES.items():
            (self.folder / f"{name}.py").write_text(re.sub(r"(?m)^ {8}", "", text))

    def change(self, name: str, old: str, new: str) -> None:
        path = self.folder / f"{name}.py"
        text = path.read_text()
        assert text.count(old) == 1
        path.write_text(text.replace(old, new))

    def call(self, x: float) -> tuple[float, bool]:
        """The result, and whether machine code was loaded rather than compiled."""
        for name in [name for name in sys.modules if name.split(".")[0] == "workshop"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        kernel = importlib.import_module("workshop.caller").call
        result = kernel(x)
        hits, misses = (sum(found.values()) for found in (kernel.stats.cache_hits, kernel.stats.cache_misses))
        assert hits + misses == 1
        return result, hits == 1


@pytest.fixture
def workshop(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = Workshop(tmp_path)
    yield made
    for name in [name for name in sys.modules if name.split(".")[0] == "workshop"]:
        del sys.modules[name]


def test_unchanged_kernels_are_loaded(workshop):
    assert workshop.call(6.0) == (24.0, False)
    assert workshop.call(6.0) == (24.0, True)


@pytest.mark.parametrize(
    "name, old, new, result",
    [
        ("parts", "2 * x", "4 * x", 36.0),
        ("parts", "7.0", "9.0", 26.0),
        ("parts", "x / 3", "x / 2", 25.0),
        ("middle", "+ parts", "- parts", 10.0),
        ("sizes", "TILE = 3", "TILE = 4", 25.0),
        ("middle", 'inline="never"', 'inline="always"', 24.0),
    ],
    ids=["callee's callee", "helper of an intrinsic", "overload", "callee", "constant", "option"],
)
def test_a_change_in_another_file_compiles_the_caller_again(workshop, name, old, new, result):
    workshop.call(6.0)
    workshop.change(name, old, new)
    assert workshop.call(6.0) == (result, False)
    assert workshop.call(6.0) == (result, True)


@pytest.mark.parametrize(
    "name, old, new", [("parts", "return x\n", "return -x\n"), ("sizes", "UNUSED = 1", "UNUSED = 2")]
)
def test_what_the_caller_does_not_reach_leaves_its_code_alone(workshop, name, old, new):
    workshop.call(6.0)
    workshop.change(name, old, new)
    assert workshop.call(6.0) == (24.0, True)


def test_where_the_package_cannot_be_written_the_users_cache_is_taken(workshop, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    (workshop.folder / "__pycache__").write_text("no folder")
    assert workshop.call(6.0) == (24.0, False)
    assert workshop.call(6.0) == (24.0, True)
    assert list((tmp_path / "home").rglob("caller.call*.nbc"))
    workshop.change("parts", "2 * x", "4 * x")
    assert workshop.call(6.0) == (36.0, False)


def test_data_of_other_code_are_not_taken_for_ones_own(tmp_path):
    """Two processes save at once: one's index, the other's index and data, the one's data."""
    old, new = (_StampedFile(str(tmp_path), "kernel", stamp) for stamp in ("old", "new"))
    old.save("key", "old code")
    (data,) = tmp_path.glob("*.nbc")
    shutil.copy(data, tmp_path / "late")
    new.save("key", "new code")
    assert (new.load("key"), old.load("key")) == ("new code", None)
    shutil.move(tmp_path / "late", data)
    assert new.load("key") is None


def test_kernels_are_made_in_one_place():
    root = Path(__file__).parents[2]
    makers = re.compile(r"^from numba\S* import .*\b(extending|n?jit|overload|cfunc|\w*vectorize)\b")
    found = {
        path.relative_to(root).as_posix()
        for package in ("visdom_plugin", "datamodules", "method_configs")
        for path in (root / package).rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if makers.search(line)
    }
    assert found == {"visdom_plugin/compute/kernels.py"}
