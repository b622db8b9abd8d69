"""VisDom GS: the best we know of for Gaussians from 4 to 12 photographs.

It is `3dgs-go+vd` with five switches on; L_i on every second step pays for the virtual views.
docs/findings/few_views.md has what was tried on the way.
"""

from __future__ import annotations

from dataclasses import replace

from method_configs import gs_go
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.registry import MethodSpec

PAPER = gs_go.SPEC.presets()["3dgs-go+vd"]


def improve(paper: GsGoConfig) -> GsGoConfig:
    """The paper's settings with the switches on."""
    vd = replace(paper.vd, points="shell", every=2)
    inside = InsideConfig(photo_weight=0.15)
    return replace(paper, initial_shape="inside", inside=inside, vd=vd, virtual_weight=0.2, dropout=0.2)


QUICK, FULL = (improve(config) for config in (PAPER.quick, PAPER.full) if isinstance(config, GsGoConfig))

SPEC = MethodSpec(
    "visdom-gs",
    PAPER.target,
    quick=QUICK,
    # Twice the steps and Gaussians, for pictures of 400 x 400; every event keeps its place in the schedule.
    standard=replace(
        QUICK,
        steps=1_200,
        initial_points=12_000,
        max_gaussians=20_000,
        sh_every=400,
        lr_means_steps=1_800,
        densify_from=120,
        densify_until=720,
        densify_every=60,
        prune_large_from=240,
        opacity_reset_every=240,
    ),
    standard_views=6,
    full=FULL,
    description="Gaussians that start in the smoothest shape inside the visible domain",
)
