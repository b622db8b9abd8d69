"""The printed board: true size on paper, found again where it was printed."""

from __future__ import annotations

import re

import numpy as np
import pytest

from visdom_plugin.cli.commands.prepare import main
from visdom_plugin.figures.canvas import drawing
from visdom_plugin.prepare.board import PAPERS, corner_points, draw_board, find_corners, print_board
from visdom_plugin.prepare.settings import BoardSettings


@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize(
    "settings", [BoardSettings(), BoardSettings((5, 6), 30, 22, "6X6_250")], ids=["usual", "own"]
)
def test_a_print_has_the_board_at_true_size(paper, settings):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    per_inch = 200
    with drawing():
        figure = draw_board(settings, paper)
        figure.set_dpi(per_inch)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        page = np.array(canvas.buffer_rgba())[..., 0].copy()
    found = find_corners(page, settings)
    assert len(found.ids) == (settings.squares[0] - 1) * (settings.squares[1] - 1)
    points = corner_points(settings)[found.ids] * 1000
    per_mm = per_inch / 25.4
    # x to the right and y up the page; one offset for all. Agg rounds edges to whole pixels.
    away = found.uv - points[:, :2] * np.array([per_mm, -per_mm])
    assert np.abs(away - away.mean(0)).max() < 0.8
    assert np.abs(away.mean(0)[0] - page.shape[1] / 2) < 1


def test_the_pdf_has_the_papers_size_and_is_the_same_each_time(tmp_path):
    for name in ("one.pdf", "two.pdf"):
        assert main(["--print-board", str(tmp_path / name), "--paper", "letter"]) == 0
    one, two = ((tmp_path / n).read_bytes() for n in ("one.pdf", "two.pdf"))
    assert one == two and one.startswith(b"%PDF")
    box = [float(x) for x in re.search(rb"/MediaBox \[([^\]]*)\]", one)[1].split()]
    assert box == pytest.approx([0, 0, 612, 792], abs=0.1)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--square-mm", "40", "--marker-mm", "30"], "does not fit on a4"),
        (["--marker-mm", "30"], "do not fit into squares"),
        (["--dictionary", "4X4_5"], "did you mean '4X4_50'"),
        (["--squares", "9", "12", "--square-mm", "20", "--marker-mm", "15"], "needs 54 markers"),
        (["--squares", "2", "2"], "3 to 60"),
    ],
)
def test_boards_that_cannot_be(words, said, tmp_path, capsys):
    assert main(["--print-board", str(tmp_path / "board.pdf"), *words]) == 2
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_another_ending_is_refused(tmp_path, capsys):
    assert main(["--print-board", str(tmp_path / "board.png")]) == 2
    assert ".pdf" in capsys.readouterr().err


def test_a_board_is_the_same_as_its_print(tmp_path):
    print_board(tmp_path / "b.pdf", BoardSettings(), "a4")
    assert [p.name for p in tmp_path.iterdir()] == ["b.pdf"]
