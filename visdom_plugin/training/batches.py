"""What training draws from the views: one view per step for splatting, random pixels for radiance fields."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.compute.transfer import send
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import pixel_radius
from visdom_plugin.geometry.pixel_rays import rays_of_pixels
from visdom_plugin.scene import Views
from visdom_plugin.seeding import generator
from visdom_plugin.training.protocols import PixelBatch, ViewBatch


class DataManager:
    """Batches as pure functions of (seed, step), so that a resumed run draws what the first would have drawn.

    Pixels stay uint8 in memory; float copies are made per batch.

    Args:
        views: the training views.
        seed: the run's seed.
        device: where batches come out.
    """

    def __init__(self, views: Views, seed: int, device: torch.device | str = "cpu"):
        self.seed, self.device = seed, torch.device(device)
        self._cameras = views.cameras.to(self.device)
        self._radii = pixel_radius(self._cameras)
        # Views keep what they find out about themselves, such as their size as numbers.
        self._each = [views.cameras[i].to(self.device) for i in range(len(views))]
        self._images = [image.to(self.device) for image in views.images]
        self._masks = [mask.to(self.device) for mask in views.masks]
        self._depths = [None if d is None else d.to(self.device) for d in views.mono_depths]
        ignored = [views.ignored(i) for i in range(len(views))]
        self._counted = [None if g is None or not bool(g.any()) else (~g).to(self.device) for g in ignored]
        self._mask_known = [views.mask_origin(i) not in ("colour", "missing") for i in range(len(views))]
        ends = torch.tensor([0, *(mask.numel() for mask in self._masks)]).cumsum(0)
        self._pixels = int(ends[-1])
        self._starts, self._ends = ends[:-1].to(self.device), ends[1:].to(self.device)
        self._known = None if all(self._mask_known) else torch.tensor(self._mask_known, device=self.device)
        self._drawable: Tensor | None = None
        self._order: tuple[int, list[int]] = -1, []  # of the views in a pass over them
        self._flat: tuple[Tensor, Tensor] | None = None

    def __len__(self) -> int:
        return len(self._images)

    def view_index(self, step: int) -> int:
        """The view of a step: every pass over the views is a permutation of its own."""
        epoch, position = divmod(step, len(self))
        if self._order[0] != epoch:
            order = torch.randperm(len(self), generator=generator(self.seed, "views", epoch))
            self._order = epoch, order.tolist()
        return self._order[1][position]

    def view_batch(self, step: int) -> ViewBatch:
        """The whole view of a step."""
        return self.view(self.view_index(step))

    def view(self, index: int) -> ViewBatch:
        """A whole view by its index."""
        counted = self._counted[index]
        return ViewBatch(
            index,
            self._each[index],
            self._images[index].float().div_(255),
            self._masks[index].float(),
            self._depths[index] if self._depths else None,
            None if counted is None else counted.float(),
            self._mask_known[index],
        )

    def pixel_batch(self, step: int, n: int) -> PixelBatch:
        """`n` pixels drawn with replacement, every pixel of every view alike but for ignored ones.

        Raises:
            SceneError: when all pixels are ignored.
        """
        rgb, mask = self._flat = self._flat or self._flatten()
        draw = generator(self.seed, "pixels", step)
        if self._drawable is None:
            flat = torch.randint(self._pixels, (n,), generator=draw)
        else:
            flat = self._drawable[torch.randint(len(self._drawable), (n,), generator=draw)]
        flat = send(flat, self.device)
        view = torch.searchsorted(self._ends, flat, right=True)
        return PixelBatch(
            *rays_of_pixels(self._cameras, view, flat - self._starts[view]),
            rgb[flat].float() / 255,
            mask[flat].float(),
            self._radii[view],
            None if self._known is None else self._known[view],
            flat,
        )

    def _flatten(self) -> tuple[Tensor, Tensor]:
        if any(c is not None for c in self._counted):
            pairs = zip(self._counted, self._masks, strict=True)
            counted = [torch.ones_like(m, dtype=torch.bool) if c is None else c for c, m in pairs]
            self._drawable = torch.cat([c.reshape(-1) for c in counted]).nonzero()[:, 0].cpu()
            if len(self._drawable) == 0:
                raise SceneError(
                    "every pixel of every training view is ignored",
                    cause="ignore files that are inverted: white is what must be ignored",
                    todo="invert them, or take the folder ignore away",
                )
        rgb = torch.cat([image.reshape(-1, 3) for image in self._images])
        return rgb, torch.cat([mask.reshape(-1) for mask in self._masks])
