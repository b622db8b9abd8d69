"""The photograph beside a render: what is unknown of it is white, and no error."""

from dataclasses import replace

import cv2
import numpy as np
import torch

from tests.training import fake
from visdom_plugin.render import Render
from visdom_plugin.report.gather import _keep_view
from visdom_plugin.training.evaluate import draw_truth


def test_ignored_pixels_are_white_and_without_error(tmp_path):
    views = fake.tiny_scene().train
    height, width = views.masks[0].shape
    ignore = torch.zeros(height, width, dtype=torch.bool)
    ignore[:, : width // 3] = True
    part = replace(views, ignore=tuple(ignore for _ in range(len(views))))
    for measured in (True, False):
        truth = draw_truth(part, 0, measured)
        assert (truth[ignore.numpy()] == 255).all()
        assert np.array_equal(truth[~ignore.numpy()], draw_truth(views, 0, measured)[~ignore.numpy()])
    black = Render(torch.zeros(height, width, 3), torch.ones(height, width), torch.ones(height, width))
    kept = _keep_view(tmp_path, 0, part, 0, black)
    error = cv2.imread(str(tmp_path / kept["files"]["error"]))
    none, some = error[:, : width // 4], error[:, width // 2 :]
    assert none.max() < 40 and some.max() > 200
