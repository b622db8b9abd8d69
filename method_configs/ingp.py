"""Instant-NGP and its variants: what each sets, side by side.

`full` is the published size and schedule. `quick` keeps every part and is smaller everywhere.
"""

from __future__ import annotations

from visdom_plugin.methods.fields.configs import IngpConfig
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.registry import MethodSpec

SPEC = MethodSpec(
    "ingp",
    "visdom_plugin.methods.fields.ingp:Ingp",
    quick=IngpConfig(
        steps=800,
        max_rays=1024,
        samples_per_step=1 << 14,
        step_length=0.012,
        missing_step_length=0.096,
        grid=HashLayout(8, 2, base_resolution=16, max_resolution=256, log2_table_size=16),
        hidden=32,
        view_degree=2,
        density_bias=-3.0,
        occupancy_resolution=64,
        occupancy_warm_up=64,
        occupancy_fraction=0.06,
        lr_warm_up=50,
    ),
    full=IngpConfig(),
    hook="sampler",
    description="Instant-NGP",
    # The vanilla variant sees photographs on white. Those that use masks see them on random colours, too: a
    # photograph with alpha is what Instant-NGP is made for. docs/findings/fields.md has what it brings.
    variants={"mask": {"background": "random"}, "vd": {"background": "random"}},
)
