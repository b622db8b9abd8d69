"""Example pictures of the troubleshooting page: check.png of the built-in scene with one fault planted in it.

    python scripts/site/figures/findings.py [--out DIR]

The faults are those that the tests plant; a fault that the check does not find ends the script.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from before_after import PICTURES, write_webp

from datamodules import load
from tests.hull.checks.faults import FAULTS, Capture, capture_of, clustered, seen_alone, turned_about
from visdom_plugin import Views
from visdom_plugin.figures.check_sheet import draw_check
from visdom_plugin.hull.checks.check import check
from visdom_plugin.hull.checks.findings import KINDS

MAKES = tuple(f"findings/{kind}.webp" for kind in KINDS)
WIDTH, LARGEST = 620, 2 / 3
"""Of a picture, in pixels; and how large it may be beside check.png."""


def turned(c: Capture) -> Capture:
    """Photographs and masks upside down, poses upright."""
    images, masks = (tuple(x.flip((0, 1)) for x in items) for items in (c.images, c.masks))
    return replace(c, images=images, masks=masks)


def at_one_point(c: Capture) -> Capture:
    """Poses without positions."""
    motions = c.cameras.world_from_camera.clone()
    motions[:, :3, 3] = motions[0, :3, 3]
    return replace(c, cameras=replace(c.cameras, world_from_camera=motions))


def beside_the_middle(c: Capture) -> Capture:
    """Principal points as of pictures of another size."""
    K = c.cameras.intrinsics.clone()
    K[:, 0, 2], K[:, 1, 2] = 0.2 * c.cameras.width, 0.5 * c.cameras.height
    return replace(c, cameras=replace(c.cameras, intrinsics=K))


def all_turned(c: Capture) -> Capture:
    """All cameras turned by a degree, each about an axis of its own."""
    axes = torch.randn(len(c), 3, generator=torch.Generator().manual_seed(0))
    for view, axis in enumerate(torch.nn.functional.normalize(axes)):
        c = turned_about(c, view, axis.tolist(), 1.0)
    return c


def shown_once(c: Capture) -> Capture:
    """A part of the object within the frame of one photograph of nine alone."""
    across = load(None, views=4).mesh[0]
    across = across[across[:, 1] > across[:, 1].max() - 0.2 * (across[:, 1].max() - across[:, 1].min())]
    return seen_alone(capture_of(load(None, views=9, test=False).train), 7, across)


def first(c: Capture) -> Capture:
    """A single view."""
    return Capture(c.cameras[:1], c.images[:1], c.masks[:1], c.names[:1])


def planted(name: str) -> Callable[[Capture], Capture]:
    """One of the tests' faults, in the second view."""
    return lambda capture: FAULTS[name](capture, 1).capture


EXAMPLES: dict[str, Callable[[Capture], Capture]] = {
    "size": planted("wrong_size"),
    "empty": planted("empty"),
    "full": planted("full"),
    "border": planted("cut_off"),
    "speckled": planted("speckled"),
    "inverted": planted("inverted"),
    "duplicate": planted("same_mask"),
    "axes": planted("opengl"),
    "order": planted("shifted_order"),
    "turned": turned,
    "swapped": planted("swapped"),
    "scale": planted("focal_double"),
    "principal": beside_the_middle,
    "centres": at_one_point,
    "view": planted("turned"),
    "disagreement": all_turned,
    "clustered": lambda c: clustered(capture_of(load(None, views=16, test=False).train), 1).capture,
    "covisibility": shown_once,
    "few": first,
}
"""A fault for each kind of finding."""


def main() -> None:
    """Draws all pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=PICTURES)
    parser.add_argument("--only", nargs="*", choices=KINDS, default=KINDS)
    args = parser.parse_args()
    (args.out / "findings").mkdir(parents=True, exist_ok=True)
    sound = capture_of(load(None, views=6, test=False).train)
    for kind, name in zip(KINDS, MAKES, strict=True):
        if kind not in args.only:
            continue
        faulty = EXAMPLES[kind](sound)
        found = check(faulty.cameras, faulty.masks, faulty.images, faulty.names)
        kinds = [f.kind for f in (*found.findings, *found.notes)]
        if kind not in kinds:
            sys.exit(f"{kind}: the check found {kinds}")
        views = Views(faulty.cameras, faulty.images, faulty.masks, faulty.names)
        sheet = draw_check(views, [torch.as_tensor(m) for m in faulty.masks], found)
        lit = np.flatnonzero((sheet != sheet[-1, -1]).any((1, 2)))
        sheet = sheet[: lit[-1] + 8]
        scale = min(WIDTH / sheet.shape[1], LARGEST)
        write_webp(
            cv2.resize(sheet, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA),
            args.out / name,
            75,
        )


if __name__ == "__main__":
    main()
