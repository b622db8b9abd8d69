"""Files about the project say the same: versions of Python, the release, the licence, the paper."""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


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
