"""Zip-NeRF and its variants: what each sets, side by side.

`full` is the published size and schedule for one GPU. `quick` keeps every part and is smaller everywhere.

`+vd:released` is what the VisDom authors' published code runs, corrected where it plainly errs; docs/released.md
says what of it is left out. For 4 views of bonsai and kitchen it has `--method.view-degree 1` besides.
"""

from __future__ import annotations

from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.fields.configs import ZipNerfConfig
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.registry import MethodSpec

RELEASED: dict[str, object] = {
    "hull": VisibleDomain(k=4, agreement=1.0, bounds_capture_radii=2.0, resolution=512, components="largest"),
    "vd": SamplerConfig(
        enabled=True,
        epsilon_capture_radii=0.2,
        front_share=0.5,
        interval="first_hit",
        virtual_views="midpoints",
        virtual_rays=1.0,
    ),
    "background": "white",
    # With as many rays of virtual views, 8,192 in all.
    "rays": 4_096,
    "steps": 25_000,
    "few_views_share": 0.24,
    "samples": (24, 24, 64),
    "near": 0.0,
    "far": 5.0,
    "spacing_power": 1.0,
    "hash_decay": 10.0,
    "distortion_weight": 0.005,
    "proposal_mask_share": 0.1,
    "mask_clamp": 0.001,
    "lr": 0.01,
    "lr_final": 0.001,
    "lr_warm_up": 5_000,
}
# A fiftieth of the steps, and half of the samples, as the other variants. All the steps at 4 views, too: a quarter
# of so few teaches nothing.
RELEASED_QUICK: dict[str, object] = {
    "rays": 256,
    "steps": 500,
    "few_views_share": 1.0,
    "samples": (12, 12, 32),
    "test_samples": (24, 24, 32),
    # As dense at the start as the full size: below `mask_clamp` opacity has no gradient, and a field as empty as
    # that of the other quick variants may never leave it.
    "density_bias": -1.0,
    "lr_warm_up": 100,
}

SPEC = MethodSpec(
    "zipnerf-lite",
    "visdom_plugin.methods.fields.zipnerf_lite:ZipNerfLite",
    quick=ZipNerfConfig(
        steps=1000,
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
    variants={
        "mask": {"background": "random"},
        "vd": {"background": "random"},
        "vd:released": RELEASED,
    },
    # The interval inside the hull is a fraction of the whole, and no fog is needed to begin with. A bare field
    # that is as empty stays empty.
    quick_variants={"vd": {"samples": (12, 12, 14), "density_bias": -8.0}, "vd:released": RELEASED_QUICK},
    descriptions={"vd:released": "Zip-NeRF in the visible domain, as the VisDom authors' release runs it"},
    aliases=("zipnerf",),
)
