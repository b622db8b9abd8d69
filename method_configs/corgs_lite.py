"""CoR-GS lite and its variants: what each sets, side by side.

`full` is the published schedule for captures all round a scene. `quick` is the same method on 400 steps, with
pseudo views between the cameras: few cameras rarely stand all round, and where they do the ellipse is no better.
"""

from __future__ import annotations

from visdom_plugin.methods.splats.configs import CorgsConfig
from visdom_plugin.registry import MethodSpec

SPEC = MethodSpec(
    "corgs-lite",
    "visdom_plugin.methods.splats.corgs_lite:CorgsLite",
    quick=CorgsConfig(
        steps=400,
        initial_points=5_000,
        max_gaussians=8_000,
        sh_degree=1,
        sh_every=150,
        lr_means_steps=600,
        densify_from=40,
        densify_until=240,
        densify_every=20,
        opacity_reset_from=81,
        opacity_reset_every=80,
        pseudo_views="between",
        pseudo_from=60,
        pseudo_until=400,
        co_prune_every=40,
    ),
    full=CorgsConfig(),
    hook="gaussian",
    description="CoR-GS: two sets of Gaussians that check each other",
    aliases=("corgs",),
)
