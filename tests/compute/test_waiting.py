"""Phases of many parts: how far they are."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from visdom_plugin.compute import waiting


@pytest.fixture
def shown(monkeypatch):
    """What the screen was told to show, as functions."""
    texts = []
    monkeypatch.setattr(waiting.screen, "begin", texts.append)
    monkeypatch.setattr(waiting.screen, "end", texts.remove)
    return texts


def test_a_phase_of_parts_tells_how_many_are_done_and_the_seconds_left(shown, monkeypatch):
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with waiting.counting("cutting masks", 12) as count:
        assert shown[0]() == "cutting masks: 0 of 12, 0 s"
        now = 102.0
        assert [count(part) for part in "ab"] == ["a", "b"]
        assert shown[0]() == "cutting masks: 2 of 12, 2 s"
        now = 104.0
        count(None)
        assert shown[0]() == "cutting masks: 3 of 12, 4 s, about 12 s left"
    assert not shown


def test_parts_are_counted_from_all_threads(shown):
    with waiting.counting("parts", 500) as count, ThreadPoolExecutor(8) as pool:
        assert list(pool.map(count, range(500))) == list(range(500))
        assert shown[0]().startswith("parts: 500 of 500")


def test_the_phase_ends_with_an_error(shown):
    with pytest.raises(KeyError), waiting.counting("parts", 2):
        raise KeyError
    assert not shown
