"""Zip-NeRF and its variants: what each sets, side by side.

`full` is the published size and schedule for one GPU. `quick` keeps every part and is smaller everywhere.
"""

from __future__ import annotations

from dataclasses import replace

from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hull.domain import TRAINING_DOMAIN
from visdom_plugin.methods.fields.configs import ZipNerfConfig
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.registry import Preset

FULL = ZipNerfConfig()

QUICK = ZipNerfConfig(
    steps=500,
    rays=512,
    # The object, all there is to see, lies between the cameras.
    far=3.0,
    samples=(32, 32, 16),
    test_samples=(24, 24, 12),
    coarse_grid=HashLayout(4, 1, base_resolution=16, max_resolution=128, log2_table_size=15),
    fine_grid=HashLayout(5, 1, base_resolution=16, max_resolution=256, log2_table_size=15),
    grid=HashLayout(6, 4, base_resolution=16, max_resolution=512, log2_table_size=15),
    hidden=32,
    bottleneck=31,
    colour_hidden=32,
    colour_layers=2,
    view_degree=1,
    density_bias=-6.0,
    lr=0.01,
    lr_final=0.001,
    lr_warm_up=50,
)

MASK = {"mask_weight": 0.1, "background": "random"}
VD = MASK | {"hull": TRAINING_DOMAIN, "vd": SamplerConfig(enabled=True), "samples": (12, 12, 14)}


def _preset(suffix: str, description: str, changes: dict) -> Preset:
    full = {k: v for k, v in changes.items() if k != "samples"}
    return Preset(
        name=f"zipnerf-lite{suffix}",
        description=description,
        target="visdom_plugin.methods.fields.zipnerf_lite:ZipNerfLite",
        quick=replace(QUICK, **changes),
        full=replace(FULL, **full),
    )


_ALL = [
    _preset("", "Zip-NeRF on photographs composited on white", {}),
    _preset("+mask", "Zip-NeRF with the paper's silhouette loss, weight 0.1", MASK),
    _preset("+vd", "Zip-NeRF with rays confined to the visible domain, and the silhouette loss", VD),
]

PRESETS = {preset.name: preset for preset in _ALL} | {
    preset.name.replace("zipnerf-lite", "zipnerf"): preset for preset in _ALL
}
"""By name, and by the alias `zipnerf`."""
