"""3DGS-GO and its variants: what each sets, side by side.

`full` is the published schedule. `quick` is the same method on 600 steps: every event keeps its place in the
schedule, and positions move faster so that they cover the same way.
"""

from __future__ import annotations

from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.registry import MethodSpec

SPEC = MethodSpec(
    "3dgs-go",
    "visdom_plugin.methods.splats.gs_go:GsGo",
    quick=GsGoConfig(
        steps=600,
        initial_points=6_000,
        max_gaussians=10_000,
        sh_degree=1,
        sh_every=200,
        lr_means_steps=900,
        densify_from=60,
        densify_until=360,
        densify_every=30,
        prune_large_from=120,
        # Few Gaussians have to be large ones.
        prune_radius=0.1,
        opacity_reset_every=120,
        floater_every=60,
    ),
    full=GsGoConfig(),
    hook="gaussian",
    description="3DGS-GO, the coarse stage of GaussianObject",
    # What the hull knows replaces what statistics guess: Gaussians outside it are removed, and the base method's
    # removal of stray ones, which eats thin parts, is off. FINDINGS.md has the numbers.
    variants={"vd": {"floater_every": 0}},
)
