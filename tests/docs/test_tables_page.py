"""What docs/tables.md shows can be typed: its table is planned, and each of its commands is, too."""

import re
import shlex
from pathlib import Path

import pytest

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts.prepared_writer import write_prepared
from visdom_plugin.cli.commands import table
from visdom_plugin.tables.spec import load_table

PAGE = (Path(__file__).parents[2] / "docs/tables.md").read_text(encoding="utf-8")
(SHOWN,) = re.findall(r"^```yaml\n(.*?)^```$", PAGE, re.M | re.S)
COMMANDS = [
    shlex.split(line, comments=True)
    for block in re.findall(r"^```\n(.*?)^```$", PAGE, re.M | re.S)
    for line in block.splitlines()
    if line.startswith("visdom-table")
]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The page's reader has the table in a file, and a scene."""
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(SHOWN, encoding="utf-8")
    write_prepared(make_scene(SyntheticConfig(size=(32, 24), test_views=1)), tmp_path / "my_scene")
    return tmp_path


def test_the_table_shown_is_planned(here, capsys):
    for name in ("mine.yaml", "mine.yaml:smoke"):
        assert table.main([name, "--dry-run"]) == 0, capsys.readouterr().err
    said = capsys.readouterr().out
    assert "run   " in said and "no data" in said


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_each_command_shown_can_be_given(words, here, capsys):
    words = words[1:]
    if any(word.startswith("mip360=") for word in words):
        for column in load_table("main").columns:
            for scene in column.scenes:
                (here / column.root / scene).mkdir(parents=True)
        words = [re.sub(r"=/data/", f"={here}/", word) for word in words]
    if words and "--dry-run" not in words:
        words.append("--dry-run")
    status, (listed, said) = table.main(words), capsys.readouterr()
    # The folders made for a data root are empty, and a dry run says so.
    assert status == ("--root" in words) and ("no COLMAP model" in said) == (status == 1), said
    assert listed


def test_the_page_shows_commands():
    assert len(COMMANDS) >= 5
