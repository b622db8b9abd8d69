"""Masks by rembg, with a model made here: it finds bright what is bright."""

import numpy as np
import pytest

from visdom_plugin.errors import ConfigError
from visdom_plugin.prepare.masks.rembg import cut_with_rembg

pytest.importorskip("rembg", reason="the extra rembg is not installed")
onnx = pytest.importorskip("onnx", reason="onnx, which writes the model, is not installed")


@pytest.fixture
def models(tmp_path):
    """A folder with u2net.onnx: the mean of the three channels, at rembg's 320 x 320."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("ReduceMean", ["image"], ["mask"], axes=[1], keepdims=1)],
        "brightness",
        [helper.make_tensor_value_info("image", kind, [1, 3, 320, 320])],
        [helper.make_tensor_value_info("mask", kind, [1, 1, 320, 320])],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(tmp_path / "u2net.onnx"))
    return tmp_path


def test_masks_are_the_networks(models):
    image = np.full((90, 160, 3), 20, np.uint8)
    image[20:70, 40:120] = 230
    (mask,) = cut_with_rembg([image], ["a.png"], str(models), "u2net")
    truth = image[..., 0] > 100
    assert mask.shape == truth.shape and (mask != truth).mean() < 0.01


def test_a_file_that_is_no_model_is_named(models):
    (models / "u2net.onnx").write_bytes(b"half a mod")
    with pytest.raises(ConfigError, match="cannot open u2net") as refused:
        cut_with_rembg([], [], str(models), "u2net")
    assert "download it again" in str(refused.value)


def test_a_model_that_rembg_does_not_know_is_named(models):
    (models / "u2net.onnx").rename(models / "mine.onnx")
    with pytest.raises(ConfigError, match="cannot open mine"):
        cut_with_rembg([], [], str(models), "mine")
