"""FSGS lite and its variants: what each sets, side by side.

The VisDom paper names no settings of its own for FSGS. `full` is the original's published schedule, with its
command for captures all round a scene (mip-NeRF 360); in place of its cloud of COLMAP it starts in the hull. Its
thresholds of unpooling are lengths in extents that Gaussians in a hull do not reach, because an object is smaller
than the cameras' ring. `quick` is the same method on 600 steps, with thresholds that some Gaussians reach.
"""

from __future__ import annotations

from visdom_plugin.methods.splats.fsgs.config import FsgsConfig
from visdom_plugin.registry import MethodSpec

SPEC = MethodSpec(
    "fsgs-lite",
    "visdom_plugin.methods.splats.fsgs.method:FsgsLite",
    quick=FsgsConfig(
        steps=600,
        initial_points=6_000,
        max_gaussians=10_000,
        sh_degree=1,
        sh_every=200,
        lr_means_steps=900,
        densify_from=60,
        densify_until=360,
        densify_every=30,
        opacity_reset_from=121,
        opacity_reset_every=120,
        unpool_until=180,
        unpool_distance=0.04,
        unpool_scale=0.01,
        unpool_split_distance=0.08,
        depth_until=570,
        pseudo_views="between",
        pseudo_from=120,
        pseudo_until=570,
        pseudo_every=5,
        pseudo_ramp=30,
    ),
    full=FsgsConfig(),
    hook="gaussian",
    description="FSGS: Gaussians grown where they are far apart, held to monocular depth",
    aliases=("fsgs",),
)
