"""VisDom GS: the best we know of for Gaussians from 4 to 12 photographs. FINDINGS.md has what each part gives.

It is `3dgs-go+vd` whose Gaussians start in the smoothest full shape inside the hull.
"""

from __future__ import annotations

from dataclasses import replace

from method_configs import gs_go
from visdom_plugin.registry import MethodSpec

_PAPER = gs_go.SPEC.presets()["3dgs-go+vd"]
_INSIDE = {"initial_shape": "inside"}

SPEC = MethodSpec(
    "visdom-gs",
    _PAPER.target,
    quick=replace(_PAPER.quick, **_INSIDE),
    full=replace(_PAPER.full, **_INSIDE),
    description="Gaussians that start in the smoothest shape inside the visible domain",
)
