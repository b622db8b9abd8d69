"""3DGS-GO and its variants: what each sets, side by side.

`full` is the published schedule. `quick` is the same method on 600 steps: every event keeps its place in the
schedule, and positions move faster so that they cover the same way.
"""

from __future__ import annotations

from dataclasses import replace

from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import TRAINING_DOMAIN
from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.registry import Preset

FULL = GsGoConfig()

QUICK = GsGoConfig(
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
    opacity_reset_every=120,
    floater_every=60,
)

MASK = {"mask_weight": 0.1}

# What the hull knows replaces what statistics guess: Gaussians outside it are removed, and the base method's
# removal of stray ones, which eats thin parts, is off. FINDINGS.md has the numbers.
VD = MASK | {
    "hull": TRAINING_DOMAIN,
    "vd": RegularizerConfig(enabled=True),
    "floater_every": 0,
}


def _preset(suffix: str, description: str, changes: dict) -> Preset:
    return Preset(
        name=f"3dgs-go{suffix}",
        description=description,
        target="visdom_plugin.methods.splats.gs_go:GsGo",
        quick=replace(QUICK, **changes),
        full=replace(FULL, **changes),
    )


PRESETS = [
    _preset("", "GaussianObject's coarse stage, initialised from its own hull", {}),
    _preset("+mask", "3DGS-GO with the paper's silhouette weight 0.1", MASK),
    _preset("+vd", "3DGS-GO in the visible domain: hull points, mask loss, L_i between the cameras", VD),
]
