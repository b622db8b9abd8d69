"""ZeroRF and its variants: what each sets, side by side.

`full` is the published size and schedule. `quick` keeps every part and is smaller everywhere.
"""

from __future__ import annotations

from visdom_plugin.methods.fields.configs import ZeroRfConfig
from visdom_plugin.registry import MethodSpec

SPEC = MethodSpec(
    "zerorf-lite",
    "visdom_plugin.methods.fields.zerorf_lite:ZeroRfLite",
    quick=ZeroRfConfig(
        steps=500,
        first_rays=256,
        rays=1024,
        rays_grow_at=(25, 50),
        step_length=0.03,
        missing_step_length=0.12,
        noise_resolution=5,
        width=8,
        occupancy_resolution=64,
        occupancy_every=16,
        occupancy_warm_up=64,
        occupancy_fraction=0.06,
    ),
    full=ZeroRfConfig(),
    hook="sampler",
    description="ZeroRF",
    aliases=("zerorf",),
)
