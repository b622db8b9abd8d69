"""A scene on disk and what nerfstudio's data parser makes of it."""

from __future__ import annotations

import pytest
import torch

from datamodules import load
from tests.datamodules.layouts.prepared_writer import write_prepared


@pytest.fixture(scope="package")
def folder(tmp_path_factory):
    return write_prepared(load(None, views=4, downscale=8), tmp_path_factory.mktemp("scene") / "scene")


@pytest.fixture(scope="package")
def parser(folder, tmp_path_factory):
    from visdom_plugin.integrations.nerfstudio.dataparser import VisdomDataParserConfig

    cache = tmp_path_factory.mktemp("cache")
    return VisdomDataParserConfig(data=folder, background="alpha", cache=cache).setup()


@pytest.fixture(scope="package")
def train(parser):
    return parser.get_dataparser_outputs("train")


@pytest.fixture(autouse=True)
def no_perceptual_weights(monkeypatch):
    """Nerfstudio's models would download weights for a metric that no test looks at."""
    import torchmetrics.image.lpip as lpip

    class Nothing(torch.nn.Module):
        def __init__(self, **_):
            super().__init__()

        def forward(self, *_):
            return torch.zeros(())

    monkeypatch.setattr(lpip, "LearnedPerceptualImagePatchSimilarity", Nothing)
