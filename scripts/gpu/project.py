"""Every name of this project that a part uses, in one place; each is imported when it is first asked for."""

from __future__ import annotations

from importlib import import_module

_HOME = {
    "Cameras": "visdom_plugin",
    "VisDomGaussianRegularizer": "visdom_plugin",
    "VisDomSampler": "visdom_plugin",
    "VisibleDomain": "visdom_plugin",
    "Gaussians": "visdom_plugin.splat.gaussians",
    "HashLayout": "visdom_plugin.nerf.encoding.hash_layout",
    "OccupancyGrid": "visdom_plugin.nerf.sampling.occupancy_grid",
    "SyntheticConfig": "datamodules.synthetic.config",
    "DataManager": "visdom_plugin.training.batches",
    "build": "visdom_plugin.training.run",
    "cast": "visdom_plugin.hull.queries.raycast",
    "choose_batches": "visdom_plugin.training.run",
    "composite_packed": "visdom_plugin.nerf.rendering.volume_packed",
    "count_votes": "visdom_plugin.hull.carving.votes",
    "depth_and_silhouette": "visdom_plugin.hull.queries.raycast",
    "disparity_loss": "visdom_plugin.losses",
    "encode": "visdom_plugin.nerf.encoding.hash_grid",
    "encode_mean": "visdom_plugin.nerf.encoding.hash_grid",
    "evaluate": "visdom_plugin.training.evaluate",
    "find": "visdom_plugin.registry",
    "gather_silhouettes": "visdom_plugin.hull.carving.votes",
    "Grid": "visdom_plugin.hull.carving.votes",
    "initial_table": "visdom_plugin.nerf.encoding.hash_grid",
    "load": "datamodules",
    "make_scene": "datamodules.synthetic.scene",
    "march_occupied": "visdom_plugin.nerf.sampling.occupancy_grid",
    "mask_loss": "visdom_plugin.losses",
    "offsets_of": "visdom_plugin.nerf.rendering.volume_packed",
    "outside_loss": "visdom_plugin.hooks.regularizer",
    "photometric_loss": "visdom_plugin.losses",
    "rasterise": "visdom_plugin.splat.rasterise",
    "rays_of": "visdom_plugin.geometry.cameras",
    "ssim": "visdom_plugin.ssim",
}
"""Name to its module, or to "module:name" where it is called otherwise there."""


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(name)
    module, _, other = _HOME[name].partition(":")
    return getattr(import_module(module), other or name)
