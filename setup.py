"""Setup: the README for a package index, where links into the tree lead nowhere.

VISDOM_README_BASE=https://HOST/OWNER/visdom-plugin makes them, and the pictures, absolute, at the release's tag.
Without it, links keep their words and pictures are left out.
"""

import os
import posixpath
import re
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent
_CODE = r"^```.*?^```$|`[^`\n]*`"
_LINK = re.compile(rf"{_CODE}|(!?)\[([^\]]*)\]\((?!\w+:|#)([^)\s]+)\)", re.M | re.S)


def readme_for_index(text: str, base: str, version: str) -> str:
    """The README with absolute links below `base`, or, for "", without links into the tree."""

    def link(found: re.Match) -> str:
        mark, words, path = found.groups()
        if path is None:
            return found[0]
        if not base:
            return "" if mark else words
        # Forges show a file under blob/, and hand it out under raw/.
        place = posixpath.join(base.rstrip("/"), "raw" if mark else "blob", f"v{version}", path)
        return f"{mark}[{words}]({place})"

    return _LINK.sub(link, text)


if __name__ == "__main__":
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    setup(
        long_description=readme_for_index(
            (ROOT / "README.md").read_text(encoding="utf-8"),
            os.environ.get("VISDOM_README_BASE", ""),
            re.search(r'^version = "([^"]+)"$', project, re.M)[1],
        ),
        long_description_content_type="text/markdown",
    )
