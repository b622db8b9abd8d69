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
    assert found.train == list(range(count)) and "no view is held out" in found.rule
    with pytest.raises(SceneError, match=f"{count + 1} training views are wanted"):
        choose(tmp_path, names, Request(views=count + 1, test=False), pools)
    (tmp_path / "sparse_test.txt").write_text("1")
    assert 1 not in choose(tmp_path, names, Request(views=count - 1, test=False), pools).train
    with pytest.raises(SceneError, match=f"{count} training views are wanted"):
        choose(tmp_path, names, Request(views=count, test=False), pools)


def test_the_advice_to_list_all_views_works(tmp_path):
    names, pools = _names(4), every_eighth(range(4))
    with pytest.raises(SceneError, match="3 of the 4 views are for training") as caught:
        choose(tmp_path, names, Request(views=4), pools)
    listed = re.search(r"--train-list (\S+)", caught.value.todo).group(1)
    assert choose(tmp_path, names, Request(train_list=listed), pools).train == [0, 1, 2, 3]
    assert "--leave-one-out" in caught.value.todo and "--views with 1 to 3" in caught.value.todo
