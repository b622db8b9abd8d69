from __future__ import annotations

import pytest

from tests.training import fake
from visdom_plugin import registry


@pytest.fixture
def scene():
    return fake.tiny_scene()


@pytest.fixture
def train(monkeypatch, tmp_path, scene):
    """train(config, ...) of the fake method into tmp_path / "run"."""
    from visdom_plugin.training import run

    monkeypatch.setattr(registry, "installed", fake.fake_registry)

    def call(config=None, *, scene=scene, **keywords):
        keywords = {"run_dir": tmp_path / "run", "quiet": True, "data_manager": fake.FakeManager} | keywords
        return run.train(fake.NAME, config or fake.FakeConfig(), scene, **keywords)

    return call
