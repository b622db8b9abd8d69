"""The benchmark that looks for silences: its arithmetic, and a command that is known to be silent."""

import sys

import pytest

from benchmarks.system.first_words import Piece, last_line, silences, watch


def test_silences_are_between_two_pieces_with_the_work_in_them_and_what_stood_on_the_screen():
    said = [
        Piece(0.5, 0.4, "reading\n"),
        Piece(3.5, 1.4, "\r\x1b[Kcarving: 1 s"),
        Piece(3.6, 1.5, "\x1b[?25l"),
        Piece(9.0, 1.75, "done\n"),
        Piece(9.1, 1.8, ""),
    ]
    first, second = silences(said, 2.0)
    assert (first.at, first.seconds, first.screen) == (0.5, 3.0, "reading")
    assert first.worked == pytest.approx(1.0)
    assert second.screen == "carving: 1 s" and second.seconds == pytest.approx(5.4)
    assert second.worked == 0.25
    assert [silence.seconds for silence in silences([Piece(4.0, 3.0, "late")], 2.0)] == [4.0]


def test_the_last_line_is_what_a_terminal_shows():
    assert last_line("a\nb: 1 s\r\x1b[Kb: 2 s") == "b: 2 s"
    assert last_line("\x1b[32mgreen\x1b[0m\n\n") == "green"


@pytest.mark.parametrize("terminal", [True, False])
def test_a_silent_command_is_heard(terminal):
    code = "import time; print('soon', flush=True)\nwhile time.process_time() < 0.8: pass\nprint('now')"
    (silence,) = silences(watch([sys.executable, "-c", code], terminal), 0.5)
    assert silence.screen == "soon" and 0.4 < silence.worked < 1.2
