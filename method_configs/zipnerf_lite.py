"""Zip-NeRF and its variants: what each sets, side by side.

`full` is the published size and schedule for one GPU. `quick` keeps every part and is smaller everywhere.
"""

from __future__ import annotations

from visdom_plugin.methods.fields.configs import ZipNerfConfig
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.registry import MethodSpec

SPEC = MethodSpec(
    "zipnerf-lite",
    "visdom_plugin.methods.fields.zipnerf_lite:ZipNerfLite",
    quick=ZipNerfConfig(
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
    ),
    full=ZipNerfConfig(),
    hook="sampler",
    description="Zip-NeRF",
    variants={"mask": {"background": "random"}, "vd": {"background": "random"}},
    # The interval inside the hull is a fraction of the whole.
    quick_variants={"vd": {"samples": (12, 12, 14)}},
    aliases=("zipnerf",),
)
