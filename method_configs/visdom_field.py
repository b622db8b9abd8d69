"""VisDom field: the best radiance field we know of for few photographs. docs/findings/few_views.md has the gain.

It is `ingp+vd` with a soft prior that the hull is empty beside the smoothest full shape inside it.
"""

from __future__ import annotations

from dataclasses import replace

from method_configs import ingp
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.methods.fields.configs import IngpConfig
from visdom_plugin.registry import MethodSpec

PAPER = ingp.SPEC.presets()["ingp+vd"]
QUICK, FULL = (
    replace(config, prior_weight=0.05, inside=InsideConfig(radius=1.0))
    for config in (PAPER.quick, PAPER.full)
    if isinstance(config, IngpConfig)
)

SPEC = MethodSpec(
    "visdom-field",
    PAPER.target,
    quick=QUICK,
    full=FULL,
    description="Instant-NGP in the visible domain, drawn towards the smoothest shape inside it",
)
