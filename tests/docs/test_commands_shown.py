"""Commands in README.md and docs/ have only options that there are; tables have a command, numbers have a page."""

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


FINDINGS = sorted((ROOT / "docs/findings").glob("*.md"))
SAID = r"not\s+kept|cannot be repeated|commands of all tables are at the end|in\s+these\s+runs"
"""How a page says that its tables are earlier measurements, or where else their command stands."""


def unexplained(text: str) -> list[str]:
    """Headings below which there is a table and neither a command nor a word on why there is none."""
    whole = re.search(r"commands of all tables are at the end", text)
    parts = re.split(r"^(?=##+ )", re.sub(r"^```.*?^```$", "```", text, flags=re.M | re.S), flags=re.M)
    tables = [part for part in parts if re.search(r"^\|", part, re.M)]
    return [p.splitlines()[0] for p in tables if not (whole or "```" in p or re.search(SAID, p))]


@pytest.mark.parametrize("page", FINDINGS, ids=lambda p: p.stem)
def test_a_table_of_the_findings_has_its_command_or_says_why_not(page):
    assert unexplained(page.read_text(encoding="utf-8")) == []


def test_a_table_without_a_command_is_found():
    table = "\n| a |\n| --- |\n| 1 |\n"
    text = f"# A\n## B\n{table}\n```\n# run\n```\n## C\n{table}\n### D\n{table}\nThe script was not\nkept.\n"
    assert unexplained(text) == ["## C"]


def drifted(readme: str, root: Path) -> list[str]:
    """Numbers in a row of the README that no number of the page rounds to that the row links to."""
    found = []
    for row in re.findall(r"^\|.*docs/findings/.*$", readme, re.M):
        cell = re.sub(r"`[^`]*`", "", row.split("|")[2])
        pages = re.findall(r"\((docs/findings/\w+\.md)", cell)
        text = " ".join((root / page).read_text(encoding="utf-8") for page in pages)
        there = {float(n.replace(",", "")) for n in re.findall(r"\d[\d,]*(?:\.\d+)?", text)}
        for number in re.findall(r"\d[\d,]*(?:\.\d+)?", re.sub(r"\]\([^)]*\)|\^\d", "", cell)):
            digits, value = len(number.partition(".")[2]), float(number.replace(",", ""))
            if value not in {round(n, digits) for n in there}:
                found.append(f"{number}: {row.split('|')[1].strip()}")
    return found


def test_numbers_of_the_readme_are_those_of_the_pages_that_it_links_to():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(re.findall(r"^\|.*docs/findings/", readme, re.M)) >= 7
    assert drifted(readme, ROOT) == []
    assert drifted(readme.replace("222 of 225", "223 of 225"), ROOT) == ["223: a check before training"]
