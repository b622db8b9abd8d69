"""GaussianObject and its variants: what each sets, side by side.

The coarse stage is `3dgs-go`, that of `+vd` is `3dgs-go+vd`. `full` is the published schedule. `quick` has
every stage on a few hundred steps: pictures of 256 x 256 for the networks, which Stable Diffusion was not
trained for, rank 8, two repaired views at a time of 8 DDIM steps.
"""

from __future__ import annotations

from dataclasses import fields

from method_configs import gs_go
from visdom_plugin.methods.repair.configs import (
    GaussianObjectConfig,
    LeaveOneOutConfig,
    LoraConfig,
    RepairConfig,
)
from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.registry import MethodSpec

COARSE = gs_go.SPEC.quick
assert isinstance(COARSE, GsGoConfig)

SPEC = MethodSpec(
    "gaussianobject",
    "visdom_plugin.methods.repair.gaussian_object:GaussianObject",
    quick=GaussianObjectConfig(
        **{f.name: getattr(COARSE, f.name) for f in fields(COARSE)},
        image_size=256,
        loo=LeaveOneOutConfig(steps=480, view_returns=360, kept_steps=40),
        lora=LoraConfig(steps=120, rank=8, noise_steps=40, noise_decay=0.97),
        repair=RepairConfig(
            steps=300,
            until=210,
            poses=2,
            refresh_every=70,
            novel_views="between",
            ddim_steps=8,
            lr_means=1.6e-5,
            densify_gradient=2e-4,
            densify_from=30,
            densify_until=270,
            densify_every=30,
            prune_large_from=60,
            opacity_reset_every=0,
            fewest_gaussians=1_000,
        ),
    ),
    full=GaussianObjectConfig(),
    hook="gaussian",
    description="GaussianObject: 3DGS-GO and its diffusion repair",
    variants={"vd": gs_go.SPEC.variants["vd"]},
)
