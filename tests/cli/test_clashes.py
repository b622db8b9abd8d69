"""Two options of which one would win without a word are refused, and so is one that nothing reads."""

import pytest

from visdom_plugin.cli.commands import check, export, hull, prepare, render, table, train

CLASHES = {
    "list and number": (train, "method:ingp --views 3 --train-list 0,1,2,3", "--train-list, which lists 4"),
    "list of all": (check, "--views 3 --train-list all", "leave out --views"),
    "misses": (hull, "--agreement 0.9 --max-misses 1", "both say how many views may miss"),
    "misses of a method": (
        train,
        "method:ingp --method.hull.agreement=0.9 --method.hull.max-misses=1",
        "--agreement and --max-misses",
    ),
    "boxes": (hull, "--bounds-scale 2 --bounds 0 0 0 1 1 1", "only automatic bounds are scaled"),
    "no K": (hull, "--kind traditional -k 2", "--kind traditional"),
    "pieces": (hull, "--components all --min-component-fraction 0.1", "no piece is dropped"),
    "two K": (train, "method:ingp --k 3 --method.hull.k 2", "K is given twice"),
    "a ball of no use": (hull, "--sphere-radius 1", "add --kind unit-sphere"),
    "two things to make": (prepare, "--print-board b.pdf --demo d", "what is to be made"),
    "photographs beside a board": (prepare, "photos --print-board b.pdf", "would not be read"),
    "paper of no board": (prepare, "photos --paper a3", "add --print-board"),
    "info and a file": (export, ". --info --out x.ply", "nothing is written"),
    "pictures' speed": (render, "run --format png --fps 9", "pictures have no speed"),
    "options of no table": (table, "--edition smoke", "no table is named"),
    "resources of no cluster": (table, "smoke --slurm s.yaml", "add --executor slurm"),
}


@pytest.mark.parametrize("case", CLASHES)
def test_contradictions_are_refused_before_anything_is_read(case, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command, words, said = CLASHES[case]
    assert command.main(words.split()) == 2
    err = capsys.readouterr().err
    assert said in err and "what to do" in err
    assert not any(tmp_path.iterdir())


def test_a_list_of_as_many_views_does_not_contradict(capsys):
    """The built-in scene has no lists, which is said, and nothing of the numbers."""
    assert check.main(["--views", "4", "--train-list", "0,1,2,3"]) == 2
    assert "is drawn, not read from files" in capsys.readouterr().err
