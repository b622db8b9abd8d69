"""SplatFields lite and its variants: what each sets, side by side.

The VisDom paper names no settings of its own for SplatFields. `full` is the original's published schedule for
synthetic objects, its networks' sizes included, but for its first stage, a whole 3DGS whose points it takes over.
Its hull lies in the masks of all views, one of which need not see a point; of the authors' own two rules one asks
all views to see it, and one none. `quick` is the same method on 600 steps, with planes of 96 x 96 made by a
network a quarter as wide; the field learns faster, and on a random background, which shows what is transparent.
"""

from __future__ import annotations

from dataclasses import replace

from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.splats.splatfields.config import SplatFieldsConfig
from visdom_plugin.registry import MethodSpec

FULL = SplatFieldsConfig(hull=VisibleDomain(k="n-1", agreement=1.0))

SPEC = MethodSpec(
    "splatfields-lite",
    "visdom_plugin.methods.splats.splatfields.method:SplatFieldsLite",
    quick=replace(
        FULL,
        steps=600,
        background="random",
        initial_points=6_000,
        max_gaussians=10_000,
        densify_from=60,
        densify_until=360,
        densify_every=30,
        noise_size=6,
        plane_channels=8,
        decoder_width=8,
        mlp_depth=3,
        lr_field=4e-3,
        lr_field_final=4e-4,
        lr_field_steps=600,
    ),
    full=FULL,
    hook="gaussian",
    description="SplatFields: a neural field predicts the Gaussians' attributes",
    aliases=("splatfields",),
)
