from __future__ import annotations

import pytest

from tests.training import fake
from visdom_plugin import registry


@pytest.fixture
def fakes(monkeypatch, tmp_path):
    """The fake methods are the only ones, the tiny scene the only data, tmp_path the working directory."""
    import datamodules

    monkeypatch.setattr(registry, "installed", fake.fake_registry)
    loads = []

    def load(path, **keywords):
        loads.append((path, keywords))
        return fake.tiny_scene()

    monkeypatch.setattr(datamodules, "load", load, raising=False)
    monkeypatch.chdir(tmp_path)
    return loads
