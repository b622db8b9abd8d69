"""Lists of views by hand: each word means one view, or is refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datamodules.views.splits import parse_positions
from datamodules.views.view_lists import read_list
from visdom_plugin.errors import ConfigError

NUMBERED = sorted((f"{i}.png" for i in range(1, 13)), key=lambda name: name[:-4])
"""1, 10, 11, 12, 2, ...: numbers are names and positions of different views."""
SPACED = ["my view 1.png", "my view 2.png", "plain.png", "été.png"]


def _of_file(tmp_path, text, names, encoding="utf-8"):
    path = tmp_path / "list.txt"
    path.write_bytes(text.encode(encoding))
    return read_list(str(path), names, "--train-list")


@given(st.lists(st.integers(0, 11), min_size=1, unique=True), st.sampled_from([" ", "\n", ", ", "\r\n"]))
def test_a_file_of_positions_means_what_it_means_as_the_scenes_own(tmp_path_factory, positions, between):
    path = tmp_path_factory.mktemp("lists") / "sparse_3.txt"
    path.write_bytes(b"\xef\xbb\xbf" + between.join(map(str, positions)).encode())
    assert read_list(str(path), NUMBERED, "--train-list") == positions
    if "," not in between:
        assert parse_positions(path.read_bytes(), 12, path) == positions


@pytest.mark.parametrize("position", range(12))
def test_a_number_with_two_meanings_is_refused_with_both(position, tmp_path):
    word = str(position)
    for text in (word, f"2.png,{word}"):
        if f"{word}.png" not in NUMBERED:
            assert read_list(text, NUMBERED, "--train-list")[-1] == position
            continue
        with pytest.raises(ConfigError, match=f"{word} could be .* {word}.png, or position {word}") as caught:
            read_list(text, NUMBERED, "--train-list")
        # What it advises works, for either meaning.
        for name in (f"{word}.png", NUMBERED[position]):
            assert name in caught.value.todo
            assert read_list(name, NUMBERED, "--train-list") == [NUMBERED.index(name)]
        assert _of_file(tmp_path, word, NUMBERED) == [position]


def test_a_number_with_leading_zeros_in_a_file_is_no_position_where_it_names_another_view(tmp_path):
    names = [f"{i:03d}.png" for i in range(1, 6)]
    with pytest.raises(ConfigError, match=r"003 could be .* 003.png, or position 3, which is 004.png"):
        _of_file(tmp_path, "003\n001", names)
    assert _of_file(tmp_path, "3\n1", names) == [3, 1]


def test_numbers_with_one_meaning_are_taken(tmp_path):
    far = ["1034.png", "1035.png", "1036.png"]
    for text in ("1036,1034", "2,0", "1036,0"):
        assert read_list(text, far, "--train-list") == [2, 0]
        assert _of_file(tmp_path, text.replace(",", "\n"), far) == [2, 0] if text != "1036,0" else True
    assert read_list("12", NUMBERED, "--train-list") == [NUMBERED.index("12.png")]
    padded = [f"{i:03d}.png" for i in range(5)]
    for text in ("003,1", "3,001"):
        assert read_list(text, padded, "--train-list") == [3, 1]
        assert _of_file(tmp_path, text, padded) == [3, 1]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_names_with_blanks_and_a_byte_order_mark_are_read_from_files(encoding, tmp_path):
    for text in ("my view 2.png\nété.png\n", "my view 2, été", "my view 2.png\r\n\r\n été.png \r\n"):
        assert _of_file(tmp_path, text, SPACED, encoding) == [1, 3]
    assert _of_file(tmp_path, "été plain.png", SPACED, encoding) == [3, 2]
    with pytest.raises(ConfigError, match="'my view 9'"):
        _of_file(tmp_path, "plain\nmy view 9", SPACED, encoding)


def test_names_may_lack_folder_and_ending_where_one_view_is_meant():
    names = ["images/a.png", "images/b.JPG", "left/c.png", "right/c.png"]
    assert read_list("b,a.png,left/c", names, "--train-list") == [1, 0, 2]
    for word in ("c", "c.png"):
        with pytest.raises(ConfigError, match=f"names '{word}', which is no view"):
            read_list(f"a,{word}", names, "--train-list")
