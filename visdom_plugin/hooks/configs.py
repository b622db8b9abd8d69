"""Settings of the hooks. Free of heavy imports, so that command lines can show them at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class RegularizerConfig:
    """VisDomGaussianRegularizer: hull points to start from, and the loss L_i on views between the cameras."""

    enabled: bool = False
    """Whether the hook takes part at all; off leaves the base method unchanged."""
    weight: float = 0.01
    """lambda_3, the weight of L_i (the paper's value)."""
    every: int = 1
    """Add L_i on every n-th step."""
    start: int = 0
    """First step with L_i."""
    views_per_step: int = 1
    """Interpolated views per loss."""
    bank: int = 64
    """Views to draw from, made once, so that the hull's silhouette is cast once for each; 0 draws a new view
    every time."""
    points: Literal["surface", "volume"] = "volume"
    """Where initial points lie: on the hull's surface, or anywhere inside it, where the object is."""
    prune_every: int = 50
    """Remove Gaussians whose centres lie outside the hull on every n-th step; 0 leaves them to L_i."""
    prune_margin_voxels: float = 2.0
    """How far outside the hull a centre may lie before it is removed, in voxels of the hull's grid."""

    def build(self, hull, views):
        """The hook for one hull and the training views whose colours the initial points take."""
        from visdom_plugin.hooks.regularizer import VisDomGaussianRegularizer

        return VisDomGaussianRegularizer(
            hull,
            views.cameras,
            images=views.images,
            weight=self.weight,
            every=self.every,
            start=self.start,
            views_per_step=self.views_per_step,
            bank=self.bank,
            points=self.points,
            prune_every=self.prune_every,
            prune_margin_voxels=self.prune_margin_voxels,
        )
