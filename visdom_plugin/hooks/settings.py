"""Settings of the hooks as plain data; free of heavy imports, so that command lines can show them at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class SamplerSettings:
    """A band around the hull outside which VisDomSampler allows no samples."""

    epsilon_camera_distances: float = 0.03
    """Half width of the band, in mean distances from the training cameras to the hull's centre (the paper's 0.2
    for cameras at distance 1)."""
    epsilon_hull_radii: float | None = None
    """The same in radii of the hull, in place of camera distances."""
    epsilon_world: float | None = None
    """The same in units of the scene."""
    epsilon_capture_radii: float | None = None
    """The same in largest distances of a training camera from their mean, the unit of the VisDom authors' release
    (0.2); give one of these three at most."""
    front_share: float = 1.0
    """How much of epsilon the band reaches in front of the first hit; behind the last it is the whole. The
    release has 0.5: 0.1 in front, 0.2 behind."""
    interval: Literal["first_hit", "entry_exit"] = "entry_exit"
    """Around the first hit, as the paper writes, or from before the first to behind the last."""
    missing: Literal["full", "skip"] = "full"
    """Rays that miss the hull: sampled over the method's full range, or not at all."""
    hull_at_inference: bool = False
    """Novel views, too, are sampled inside the band only, and rays that miss show the background."""
    drop_outside: bool = False
    """Of the samples in the band, those at points outside the hull count nothing (VaxNeRF; Instant-NGP only)."""
    virtual_views: Literal["none", "between", "midpoints"] = "none"
    """Rays of views that nobody photographed train the field to be empty where they miss the hull. "between": 64
    places on the way between random pairs of training cameras, that swing round the hull; "midpoints": halfway
    between each camera and its two nearest ones, as in the VisDom authors' release. Photographs are not needed for
    it: such a ray adds no colour loss, and is sampled over the method's full range, not in the band."""
    virtual_weight: float = 0.1
    """Weight of the cross entropy between the opacity along these rays and 0; 0.1 is the release's, that of its
    silhouette loss."""
    virtual_rays: float = 0.25
    """How many of them there are in a step, for each ray of the photographs. The release draws its batch from all
    views alike, 1 to 2 for each, of which those that meet the hull are wasted; here all miss it."""


@dataclass(frozen=True)
class RegularizerSettings:
    """Points to start from, and the loss L_i on views between cameras, of VisDomGaussianRegularizer."""

    weight: float = 0.01
    """lambda_3, the weight of L_i (the paper's value)."""
    every: int = 1
    """Add L_i on every n-th step."""
    start: int = 0
    """First step with L_i."""
    views_per_step: int = 1
    """Interpolated views per loss."""
    views: Literal["between", "midpoints"] = "between"
    """Where these views stand: anywhere on the way between random pairs of training cameras, swinging round the
    hull; or halfway between each camera and its two nearest ones, each as often as the others (the VisDom authors'
    release)."""
    bank: int = 64
    """Views "between" to draw from, made once, so that the hull's silhouette is cast once for each; 0 draws a new
    view every time."""
    points: Literal["surface", "volume", "shell", "voxels"] = "volume"
    """Where initial points lie: on the hull's surface; anywhere inside it, where the object is; inside it, most
    of them near the surface, so that thin parts have enough; or in the middles of its voxels, all of them where
    that are no more than asked for (the release)."""
    prune_every: int = 50
    """Remove Gaussians whose centres lie outside the hull on every n-th step; 0 leaves them to L_i."""
    prune_margin_voxels: float = 2.0
    """How far outside the hull a centre may lie before it is removed, in voxels of the hull's grid."""
