"""Every option that a command in README.md or docs/ is shown with is one that the command has."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULES = dict(
    re.findall(
        r'^(visdom-\w+) = "([\w.]+):main"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.M
    )
)
KEPT = ("ablation", "--leave-one-out")
"""Words that decide which options there are, beside a method's name."""
STAND_INS = ("method:my-method+vd", "method:$m", "method:NAME")
"""For a method that is not there, or any."""


def shown(page: Path) -> list[list[str]]:
    """The commands in a page's blocks, as words."""
    found = []
    for language, block in re.findall(
        r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S
    ):
        if language not in ("", "bash"):
            continue
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True) if "visdom-" in line else []
            while words and not re.match(r"visdom-(?!plugin)", words[0]):
                words.pop(0)  # an assignment, or another command before it
            if words:
                found.append(words)
    return found


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = {" ".join(words): words for page in PAGES for words in shown(page)}


@pytest.mark.parametrize("words", COMMANDS.values(), ids=COMMANDS)
def test_the_options_shown_are_there(words, capsys):
    name, *rest = words
    options = {w.partition("=")[0] for w in rest if re.match("--?[a-z]", w) and w not in KEPT}
    methods = [w if w not in STAND_INS else "method:ingp+vd" for w in rest if w.startswith("method:")]
    with pytest.raises(SystemExit) as end:
        import_module(MODULES[name]).main([*(w for w in rest if w in KEPT), *methods, "--help"])
    assert end.value.code == 0
    said = set(re.findall(r"(?<![\w-])--?[\w.-]+", capsys.readouterr().out))
    assert options <= said, options - said


def test_commands_are_found():
    assert len(COMMANDS) > 20 and set(MODULES) <= {words[0] for words in COMMANDS.values()}
