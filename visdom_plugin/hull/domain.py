"""The visible domain of a capture, from its settings to the carved hull."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.hull.wording import wording

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from torch import Tensor

    from visdom_plugin.geometry.cameras import Cameras
    from visdom_plugin.hull.carving.votes import Masks
    from visdom_plugin.hull.hull import Hull

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class VisibleDomain(HullSettings):
    """Space that enough views see and whose views agree that it may be object.

    A voxel stays when it is inside the mask of at least `agreement` of the views that see its centre, and at
    least `k` views see it. A view sees a point that is in front of the camera and inside the image. Occlusion is
    ignored.

    Kinds: "visdom" is that rule. "traditional" is the same without `k`: one view is enough. "unit-sphere" is
    the traditional hull inside a ball. "released-go" is GaussianObject's published script: inside at least N - 1
    of the N masks, visibility not counted (points behind a camera are never inside its mask here).

    Automatic bounds are a cube of resolution ** 3 voxels around the space that can satisfy the rule, found from
    cameras and masks alone. The traditional hull, and "visdom" with k = 1, reach as far as any single camera
    sees; their cube holds the visible domain (of `k`, of 3 where that is 1, or of the largest smaller one that
    leaves any) and all camera centres. The default
    ball is centred on the visible domain's box and reaches its corners, and the cube holds the ball.

    The settings are the fields of `HullSettings`.
    """

    def carve(
        self, cameras: Cameras, masks: Masks, ignore: Sequence[Tensor | np.ndarray | None] = ()
    ) -> Hull:
        """Carves the hull.

        Masks on a CUDA device are voted there voxel by voxel; all others are carved block by block on the CPU,
        with the same result.

        Args:
            cameras: (N,) Cameras.
            masks: N tensors or arrays (H, W) bool, True on the object, or one (N, H, W).
            ignore: N tensors or arrays (H, W) bool or None, True where nothing is known, or empty. Such a pixel
                rules nothing out and asks for nothing; but at least two views (one where K is 1) must know a
                voxel to be inside their masks.

        Returns:
            Hull. Its summary tells rule, bounds, pieces and seconds.

        Raises:
            EmptyHullError: when nothing is left, with the cause where it could be established.
            SceneError: when masks and cameras do not fit each other: in number or size; because all cameras stand
                at one point; because focal lengths in another unit explain the masks; or, with automatic bounds,
                because the hull covers little of the masks, or is degenerate, and would be sound with poses of
                another convention.
        """
        # Settings stand on every command line: torch and numba are loaded when a hull is carved, the check, which
        # needs OpenCV, when it is asked.
        from visdom_plugin.hull.carving.carve import carve_silhouettes, describe_pieces
        from visdom_plugin.hull.carving.keep_rule import describe_rule
        from visdom_plugin.hull.carving.votes import gather_silhouettes
        from visdom_plugin.hull.checks.causes.intrinsics import may_be_other_units
        from visdom_plugin.hull.checks.coverage import looks_sound
        from visdom_plugin.hull.checks.degenerate import stand_at_one_point
        from visdom_plugin.hull.checks.mask_checks import look_inverted

        log.info("carving the hull")
        silhouettes = gather_silhouettes(cameras, masks, ignore, dilate_px=self.dilate_px)
        if stand_at_one_point(cameras):
            from visdom_plugin.hull.checks.explain_failure import explain_one_point

            raise explain_one_point(self, cameras, silhouettes)
        if may_be_other_units(cameras):
            try:
                from visdom_plugin.hull.checks.explain_failure import refuse_other_unit
            except ImportError:
                log.info("without OpenCV nobody looks whether focal lengths are in another unit than pixels")
            else:
                refuse_other_unit(cameras, silhouettes)
        settings = self._in_bounds(cameras)
        if self.k == "auto" and self.kind != "released-go":
            from visdom_plugin.hull.checks.covisibility import advise_k
            from visdom_plugin.hull.outlines.distance_fields import draw_outlines

            advice = advise_k(draw_outlines(cameras, silhouettes))
            log.info("k=auto takes %s", advice.why)
            settings = replace(settings, k=advice.k)
        hull = carve_silhouettes(settings, cameras, silhouettes, device=getattr(masks[0], "device", "cpu"))
        if hull is None:
            from visdom_plugin.hull.checks.explain_failure import explain_empty

            raise explain_empty(settings, cameras, silhouettes)
        hull = replace(hull, summary=hull.summary | {"k_asked": self.k})
        misfit = None
        if not looks_sound(settings, cameras, silhouettes, hull):
            from visdom_plugin.hull.checks.explain_failure import find_misfit

            misfit = find_misfit(settings, cameras, silhouettes, hull)
        if misfit is not None:
            log.warning(misfit)
        elif not hull.summary["bounds_closed"]:
            log.warning(
                "the views leave the hull open: it is cut off at %s .. %s; more views from other sides, a "
                "larger k or explicit bounds would close it",
                *hull.bounds.round(4).tolist(),
            )
        if strays := hull.summary.get("components_strays"):
            log.warning(
                "%d of %d pieces explain no mask: where the other views have unknown pixels, two views that agree "
                "by chance keep them; components=explain, the default, drops such pieces",
                strays,
                hull.summary["components"],
            )
        known = silhouettes.demanding()
        inverted = [i for i in range(len(known)) if look_inverted(known.mask(i), silhouettes.unknown_in(i))]
        if 2 * len(inverted) > len(silhouettes):
            log.warning(
                "%d of %d masks are foreground along most of the image's border: they may mark the background; %s",
                len(inverted),
                len(silhouettes),
                wording().look,
            )
        made = hull.summary
        log.info(
            "hull: %s%s; %d of %s voxels of %.4g; %s; %.2f s",
            "" if self.kind == "visdom" else f"{self.kind}, ", describe_rule(made), hull.voxels,
            "x".join(map(str, hull.shape)), hull.voxel_size, describe_pieces(made),
            made["seconds"] + made["bounds_seconds"],
        )  # fmt: skip
        return hull

    def _in_bounds(self, cameras: Cameras) -> VisibleDomain:
        """The same settings, with the cube of `bounds_capture_radii` as bounds where one is asked for."""
        if self.bounds_capture_radii is None:
            return self
        from visdom_plugin.geometry.local_frame import capture_ball

        centre, radius = (x.cpu().double().numpy() for x in capture_ball(cameras))
        low, high = ((centre + sign * self.bounds_capture_radii * radius).tolist() for sign in (-1, 1))
        return replace(self, bounds=(tuple(low), tuple(high)), bounds_capture_radii=None)


TRAINING_DOMAIN = VisibleDomain(dilate_px=1)
"""How the hull of the hooks is carved in all our methods: one pixel of dilation keeps the unanimity of few views
from eating thin parts. docs/findings/gaussians.md has the numbers."""
