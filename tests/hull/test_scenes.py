"""Automatic bounds on real captures of very different scale and origin."""

import os
from pathlib import Path

import numpy as np
import pytest

from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.grid.mesh import is_closed

ROOT = os.environ.get("VISDOM_SCENES")
pytestmark = [
    pytest.mark.scenes,
    pytest.mark.skipif(not ROOT, reason="VISDOM_SCENES does not name the folder of real scenes"),
]

OBJECT_BOUNDS = {
    "blowtorch": [[-0.76274, 1.1332, 1.6457], [0.97448, 2.2554, 2.6536]],
    "middlebury_temple": [[-0.090594, 0.0018445, -0.022596], [0.042852, 0.18786, 0.072144]],
    "mother_child": [[-0.58798, -0.40656, 0.20271], [1.0695, 3.1344, 2.4704]],
    "studio_human": [[-4.2922, -7.879, 17.939], [4.4215, 10.015, 29.609]],
    "synthetic_lego": [[-0.73143, -1.221, -0.90426], [0.72786, 1.2349, 1.1023]],
    "vgg_dinosaur": [[-0.059795, -0.1092, 0.39336], [0.055021, 0.04276, 0.58466]],
}
"""Hull of all views at 64^3, with half a voxel of slack; from each scene's SOURCE.md."""


@pytest.mark.parametrize("views", [4, 6, 9])
@pytest.mark.parametrize("name", sorted(OBJECT_BOUNDS))
def test_bounds_and_coverage(name, views):
    import datamodules

    train = datamodules.load(Path(ROOT) / name, views=views, downscale=1).train
    low, high = np.array(OBJECT_BOUNDS[name])
    size = high - low
    hull = VisibleDomain(resolution=128).carve(train.cameras, train.masks)
    assert is_closed(hull.to_mesh()[1])
    # The object's box, less the slack of its own 64^3 grid, lies in the hull's, which is not much larger. From
    # 4 views of the temple the space that is inside all masks is 1.3 times as deep as that box.
    assert (hull.extent[0] < low + 0.15 * size).all() and (hull.extent[1] > high - 0.15 * size).all()
    most = 1.35 if (name, views) == ("middlebury_temple", 4) else 1.1
    assert (hull.extent[1] - hull.extent[0] < most * size).all()
    assert (hull.bounds[1] - hull.bounds[0]).max() < 1.15 * (hull.extent[1] - hull.extent[0]).max()
    assert hull.summary["bounds_closed"]
    assert min(c.covered for c in measure_coverage(hull, train.cameras, train.masks)) > 0.965
