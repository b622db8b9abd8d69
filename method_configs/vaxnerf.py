"""VaxNeRF (Kondo et al. 2021) on Instant-NGP, as the VisDom paper compares with it.

The hull is the traditional one, of which a ball is kept; samples outside it are dropped in training. `vaxnerf`
renders without the hull, `vaxnerf+hull` (the paper's VaxNeRF*) with it; both train the same field, bit for bit.
All else is `ingp`: photographs on white, no silhouette loss. The masks grow by the same pixel as for `ingp+vd`.
"""

from __future__ import annotations

from dataclasses import replace

from method_configs.ingp import FULL, QUICK
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hull.domain import TRAINING_DOMAIN
from visdom_plugin.registry import Preset

SAMPLER = SamplerConfig(enabled=True, epsilon_world=0.0, missing="skip", drop_outside=True)
HULL = replace(TRAINING_DOMAIN, kind="unit-sphere")


def _preset(suffix: str, description: str, sampler: SamplerConfig) -> Preset:
    return Preset(
        name=f"vaxnerf{suffix}",
        description=description,
        target="visdom_plugin.methods.fields.ingp:Ingp",
        quick=replace(QUICK, hull=HULL, vd=sampler),
        full=replace(FULL, hull=HULL, vd=sampler),
    )


PRESETS = [
    _preset(
        "", "VaxNeRF on Instant-NGP: trained inside a traditional hull in a ball, rendered without", SAMPLER
    ),
    _preset(
        "+hull", "the same field, rendered inside the hull, too", replace(SAMPLER, hull_at_inference=True)
    ),
]
