"""CoR-GS lite and its variants: what each sets, side by side.

`full` is the published schedule for captures all round a scene. `quick` is the same method on 400 steps, with
pseudo views between the cameras: few cameras rarely stand all round, and where they do the ellipse is no better.
"""

from __future__ import annotations

from dataclasses import replace

from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import TRAINING_DOMAIN
from visdom_plugin.methods.splats.configs import CorgsConfig
from visdom_plugin.registry import Preset

FULL = CorgsConfig()

QUICK = CorgsConfig(
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
)

MASK = {"mask_weight": 0.1}

# As with 3DGS-GO: one pixel of dilation keeps the unanimity of few views from eating thin parts of the hull.
VD = MASK | {"hull": TRAINING_DOMAIN, "vd": RegularizerConfig(enabled=True)}


def _preset(suffix: str, description: str, changes: dict) -> Preset:
    return Preset(
        name=f"corgs-lite{suffix}",
        description=description,
        target="visdom_plugin.methods.splats.corgs_lite:CorgsLite",
        quick=replace(QUICK, **changes),
        full=replace(FULL, **changes),
    )


_ALL = [
    _preset("", "CoR-GS: two sets of Gaussians that check each other, started in GaussianObject's hull", {}),
    _preset("+mask", "CoR-GS with the paper's silhouette weight 0.1 for both sets", MASK),
    _preset("+vd", "CoR-GS in the visible domain: hull points, mask loss, L_i for each set", VD),
]

PRESETS = {preset.name: preset for preset in _ALL} | {
    preset.name.replace("corgs-lite", "corgs"): preset for preset in _ALL
}
"""By name, and by the alias `corgs`."""
