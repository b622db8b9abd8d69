"""VaxNeRF (Kondo et al. 2021) on Instant-NGP, as the VisDom paper compares with it.

The hull is the traditional one, of which a ball is kept; samples outside it are dropped in training. `vaxnerf`
renders without the hull, `vaxnerf+hull` (the paper's VaxNeRF*) with it; both train the same field, bit for bit.
All else is `ingp`: photographs on white, no silhouette loss. The masks grow by the same pixel as for `ingp+vd`.
"""

from __future__ import annotations

from dataclasses import replace

from method_configs import ingp
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hull.domain import TRAINING_DOMAIN
from visdom_plugin.registry import MethodSpec

SAMPLER = SamplerConfig(enabled=True, epsilon_world=0.0, missing="skip", drop_outside=True)
HULL = replace(TRAINING_DOMAIN, kind="unit-sphere")

SPEC = MethodSpec(
    "vaxnerf",
    ingp.SPEC.target,
    quick=replace(ingp.SPEC.quick, hull=HULL, vd=SAMPLER),
    full=replace(ingp.SPEC.full, hull=HULL, vd=SAMPLER),
    description="VaxNeRF on Instant-NGP: trained inside a traditional hull in a ball, rendered without",
    variants={"hull": {"vd": replace(SAMPLER, hull_at_inference=True)}},
    descriptions={"hull": "the same field, rendered inside the hull, too"},
)
