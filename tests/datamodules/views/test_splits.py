"""Which views train and test: the same for whoever asks, and an error that says how to get the others."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datamodules.request import Request
from datamodules.views.splits import choose, every_eighth
from visdom_plugin.errors import SceneError


def _names(count):
    return [f"v{i:02d}.png" for i in range(count)]


@given(st.data(), st.integers(2, 20), st.sampled_from(["rule", "file", "hand"]))
def test_training_views_are_the_same_whether_test_views_are_asked_for_or_not(
    tmp_path_factory, data, count, how
):
    root, names = tmp_path_factory.mktemp("split"), _names(count)
    held = data.draw(st.lists(st.integers(0, count - 1), min_size=1, max_size=count - 1, unique=True))
    listed = ",".join(names[i] for i in held) if how == "hand" else None
    if how == "file":
        (root / "sparse_test.txt").write_text("\n".join(map(str, held)))
    pools = every_eighth(range(count))
    free = set(pools.train) - (set(held) if how != "rule" else set())
    if not free:
        return
    views = data.draw(st.integers(1, len(free)))
    with_test, without = (
        choose(root, names, Request(views=views, test=test, test_list=listed), pools)
        for test in (True, False)
    )
    assert with_test.train == without.train and set(without.train) <= free
    assert without.test == [] and len(with_test.test) > 0


@pytest.mark.parametrize("count", [2, 4, 9])
def test_who_needs_no_test_view_gets_all_views_but_those_listed_for_testing(count, tmp_path):
    names, pools = _names(count), every_eighth(range(count))
    found = choose(tmp_path, names, Request(views=count, test=False), pools)
    assert found.train == list(range(count)) and f"all {count} views train" in found.rule and found.all_train
    (tmp_path / "sparse_test.txt").write_text("1")
    assert 1 not in choose(tmp_path, names, Request(views=count - 1, test=False), pools).train
    assert 1 not in choose(tmp_path, names, Request(views=count, test=False), pools).train


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_as_few_views_as_are_wanted_all_train(count, tmp_path):
    names, pools = _names(count), every_eighth(range(count))
    for request in (Request(), Request(views=4), Request(views=count), Request(views=4, hold_out=False)):
        found = choose(tmp_path, names, request, pools)
        assert found.train == list(range(count)) and found.test == [] and found.all_train
    if count > 1:
        listed = choose(tmp_path, names, Request(views=4, test_list="0"), pools)
        assert listed.train == list(range(1, count)) and listed.test == [0]


def test_all_views_can_be_asked_for_in_a_word(tmp_path):
    names, pools = _names(9), every_eighth(range(9))
    found = choose(tmp_path, names, Request(views=4, train_list="all"), pools)
    assert found.train == list(range(9)) and found.test == []
    found = choose(tmp_path, names, Request(train_list="all", test_list="v02,5"), pools)
    assert found.train == [0, 1, 3, 4, 6, 7, 8] and found.test == [2, 5]
    assert not found.all_train
    found = choose(tmp_path, names, Request(views=4), pools)
    assert len(found.test) == 2 and not found.all_train
    assert choose(tmp_path, names, Request(views=8, test=False), pools).all_train


def test_the_advice_to_list_views_that_test_works(tmp_path):
    names, pools = _names(10), every_eighth(range(10))
    with pytest.raises(SceneError, match="8 of the 10 views are for training") as caught:
        choose(tmp_path, names, Request(views=9), pools)
    listed = re.search(r"--train-list (\S+)", caught.value.todo).group(1)
    assert len(choose(tmp_path, names, Request(train_list=listed), pools).train) == 9
    assert "--views with 1 to 8" in caught.value.todo
