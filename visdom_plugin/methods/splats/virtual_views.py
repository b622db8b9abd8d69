"""Views between the training cameras, taught by photographs that are warped over the shape inside the hull."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.camera_paths import draw_between
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.photo_warp import PhotoWarp
from visdom_plugin.render import Render
from visdom_plugin.scene import Views

BANK = 64
"""Views to draw from, warped when first drawn."""


class VirtualViews:
    """A bank of views between training cameras; a set of Gaussians is drawn towards what they should show.

    Args:
        shape: the shape inside the hull, or the hull.
        views: the training views, of which those whose masks are given are warped. Ignored pixels are not.
    """

    def __init__(self, shape: Hull, views: Views):
        given = [i for i in range(len(views)) if views.mask_origin(i) == "given"]
        masks = []
        for i in given:
            ignored = views.ignored(i)
            masks.append(views.masks[i] if ignored is None else views.masks[i] & ~ignored)
        cameras = views.cameras[given].to("cpu")
        self.warp = PhotoWarp(shape, cameras, [views.images[i] for i in given], masks)
        self.cameras, self.device = cameras, views.cameras.width.device
        self.look_at = torch.as_tensor(shape.centre).to(cameras.world_from_camera)
        self._bank: dict[int, tuple[Cameras, Tensor, Tensor, Tensor]] = {}

    def loss(self, render: Callable[[Cameras], Render], background: Tensor, generator: Generator) -> Tensor:
        """Mean absolute difference of one view to its photographs, where they are trusted, and to the background
        beside the shape; scalar.

        Args:
            render: draws the current Gaussians from one camera on `background` (3,).
            generator: CPU generator that draws the view.
        """
        camera, rgb, trust, silhouette = self._view(int(torch.randint(BANK, (), generator=generator)))
        drawn = render(camera.to(background.device)).rgb
        rgb, trust, silhouette = (x.to(drawn.device) for x in (rgb, trust, silhouette))
        target = torch.where(silhouette[..., None], rgb.float() / 255, background)
        weight = torch.where(silhouette, trust.float() / 255, 1.0)
        return ((drawn - target).abs().mean(-1) * weight).mean()

    def _view(self, index: int) -> tuple[Cameras, Tensor, Tensor, Tensor]:
        """Camera, colours and trust in 0..255, silhouette."""
        if index not in self._bank:
            camera = draw_between(self.cameras, self.look_at, torch.Generator().manual_seed(index))
            seen = self.warp.draw(camera)
            colours, trust = ((255 * x).round().byte() for x in (seen.rgb, seen.trust))
            self._bank[index] = camera, colours, trust, seen.silhouette
        return self._bank[index]
