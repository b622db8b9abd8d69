"""Files about the project agree: the version, with a dated section of the changelog, the Pythons, the paper."""

import importlib.util
import json
import re
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import visdom_plugin
from visdom_plugin.cli.commands import check
from visdom_plugin.training.runs.run_directory import find_versions

ROOT = Path(__file__).parents[2]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
CHANGES = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.fixture
def installed():
    """Commands and runs name the version that was installed."""
    if version("visdom-plugin") != visdom_plugin.__version__:
        pytest.skip("the installed metadata is of another version: pip install -e . --no-deps")


def test_the_version_stands_alike_in_all_places(installed, capsys):
    sections = re.findall(r"^## \[([\d.]+)\](?: - (\d{4}-\d\d-\d\d))?$", CHANGES, re.M)
    assert check.main(["--version"]) == 0
    found = {
        re.search(r'^version = "([^"]+)"$', PROJECT, re.M).group(1),
        visdom_plugin.__version__,
        str(CITATION["version"]),
        find_versions()["visdom-plugin"],
        capsys.readouterr().out.split()[-1],
        sections[0][0],
    }
    assert found == {visdom_plugin.__version__}
    assert sections[0][1] == str(CITATION["date-released"])


def test_sections_of_the_changelog_are_in_order_and_none_is_empty_but_the_coming_one():
    sections = re.split(r"^## ", CHANGES, flags=re.M)[1:]
    assert sections[0].startswith("[Unreleased]")
    numbers = [tuple(map(int, re.match(r"\[(\d+)\.(\d+)\.(\d+)\]", text).groups())) for text in sections[1:]]
    assert numbers == sorted(numbers, reverse=True) and len(set(numbers)) == len(numbers)
    assert all(len(text.splitlines()) > 5 for text in sections[1:])


def test_a_run_says_which_version_made_it(installed, tmp_path):
    out = tmp_path / "run"
    scene = visdom_plugin.load(downscale=10)
    visdom_plugin.train("ingp", scene, out=out, steps=1, report=False, quiet=True, device="cpu")
    made = json.loads((out / "run.json").read_text())["versions"]["visdom-plugin"]
    assert made == visdom_plugin.__version__


def read_for_index(base: str) -> str:
    spec = importlib.util.spec_from_file_location("setup_of_the_project", ROOT / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.readme_for_index((ROOT / "README.md").read_text(encoding="utf-8"), base, "1.2.3")


def test_the_readme_of_a_package_index_links_to_nothing_that_is_not_there():
    relative = re.compile(r"\]\((?!https?:|#)")
    code = re.compile(r"^```.*?^```$|`[^`\n]*`", re.M | re.S)
    assert relative.search((ROOT / "README.md").read_text(encoding="utf-8"))
    bare, linked = (code.sub("", read_for_index(base)) for base in ("", "https://forge.org/us/it/"))
    assert not relative.search(bare) and "![" not in bare and "# visdom-plugin" in bare
    assert not relative.search(linked)
    assert re.search(r"!\[[^\]]+\]\(https://forge\.org/us/it/raw/v1\.2\.3/docs/pictures/[\w.]+\)", linked)
    paths = re.findall(r"\(https://forge\.org/us/it/(?:raw|blob)/v1\.2\.3/([^)#\s]+)", linked)
    assert len(paths) > 10 and all((ROOT / path).exists() for path in paths)


def minors(lowest: str, highest: str) -> list[str]:
    return [f"3.{minor}" for minor in range(int(lowest), int(highest) + 1)]


def supported() -> list[str]:
    lowest, above = re.search(r'^requires-python = ">=3\.(\d+),<3\.(\d+)"$', PROJECT, re.M).groups()
    return minors(lowest, str(int(above) - 1))


def test_readme_classifiers_and_workflow_name_the_pythons_of_requires_python():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert minors(*re.search(r"^Python 3\.(\d+) to 3\.(\d+)\.", readme, re.M).groups()) == supported()
    assert re.findall(r'"Programming Language :: Python :: (3\.\d+)"', PROJECT) == supported()
    jobs = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8"))["jobs"]
    assert jobs["tests"]["strategy"]["matrix"]["python"] == supported()
    assert jobs["wheel"]["strategy"]["matrix"]["python"] == [supported()[0], supported()[-1]]


def test_the_citation_is_of_this_release_and_this_paper():
    def field(name: str) -> str:
        return re.search(rf'^{name} = "([^"]+)"$', PROJECT, re.M).group(1)

    assert (CITATION["title"], CITATION["version"]) == (field("name"), field("version"))
    assert CITATION["license"] == field("license")
    assert CITATION["preferred-citation"]["url"] == field("Paper")
