"""Tiny networks and a short schedule of all four stages."""

from dataclasses import replace

import pytest

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs.gaussian_object import SPEC
from tests.methods.repair.tiny_networks import write_networks
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.repair.configs import LeaveOneOutConfig, LoraConfig
from visdom_plugin.methods.repair.weights import PACKAGES, WeightsConfig


@pytest.fixture(scope="session")
def networks_folder(tmp_path_factory):
    for name in PACKAGES:
        pytest.importorskip(name, reason=f"{name} is not installed: pip install 'visdom-plugin[diffusion]'")
    return write_networks(tmp_path_factory.mktemp("networks"))


@pytest.fixture(scope="session")
def scene():
    return make_scene(SyntheticConfig(size=64))


@pytest.fixture(scope="session")
def small(networks_folder):
    """12 coarse steps, 18 for each of the 4 views left out, 6 of fine-tuning and 10 of repair."""
    return replace(
        SPEC.quick,
        steps=12,
        initial_points=300,
        sh_every=4,
        densify_from=2,
        densify_until=8,
        densify_every=3,
        floater_every=0,
        opacity_reset_every=0,
        hull=VisibleDomain(resolution=48),
        vd=RegularizerConfig(enabled=True, prune_every=4),
        image_size=64,
        weights=WeightsConfig(folder=networks_folder),
        loo=LeaveOneOutConfig(steps=12, view_returns=6, kept_steps=4),
        lora=LoraConfig(steps=6, rank=2, noise_steps=2, noise_decay=0.5),
        repair=replace(
            SPEC.quick.repair,
            steps=10,
            until=8,
            refresh_every=4,
            ddim_steps=3,
            densify_from=2,
            densify_until=9,
            densify_every=3,
            domain=True,
        ),
    )


@pytest.fixture(scope="session")
def hull(scene, small):
    return small.hull.carve(scene.train.cameras, scene.train.masks)
