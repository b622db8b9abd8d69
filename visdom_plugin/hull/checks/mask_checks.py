"""Faults that masks show by themselves: wrong size, empty, full, cut off, speckled, or the same one twice."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from visdom_plugin.hull.checks.findings import Finding, Name

CUT_SHARE = 0.2
"""An object is cut off in earnest when the frame's border crosses it along this part of its length; less, such as
a foot or a handle's end, is noted."""
_INVERTED_BORDER = 0.5
_SPECKS, _SPECK_SHARE = 8, 0.02
"""So many pixels that differ from all eight neighbours, and so many per pixel of outline, are noise: thin and
perforated objects reach a quarter of that."""


def check_sizes(sizes: np.ndarray, masks: Sequence[np.ndarray], names: Name) -> list[Finding]:
    """Masks of another size than their cameras' images.

    Args:
        sizes: (N, 2) width and height that the cameras say.
        masks: N arrays (H, W).
    """
    found = []
    for view, mask in enumerate(masks):
        width, height = (int(s) for s in sizes[view])
        if mask.shape != (height, width):
            shape = " x ".join(map(str, mask.shape[::-1]))
            found.append(
                Finding(
                    "size",
                    f"the mask of {names[view]} is {shape} but its camera's image is {width} x {height}",
                    (view,),
                    "certain",
                    mask.size / (width * height),
                    "make the mask at the size of the image",
                )
            )
    return found


def check_content(masks: Sequence[np.ndarray], names: Name) -> list[Finding]:
    """Masks that are empty, full or speckled."""
    found = []
    for view, mask in enumerate(masks):
        share = float(mask.mean())
        if share == 0:
            todo = "mask the object, check the threshold that reads the mask, or leave the view out"
            said = Finding(
                "empty", f"the mask of {names[view]} has no foreground pixel", (view,), "certain", 0.0, todo
            )
        elif share == 1:
            todo = "mask the object: no pixel of this mask is background"
            said = Finding(
                "full", f"the mask of {names[view]} is all foreground", (view,), "certain", 1.0, todo
            )
        else:
            specks, per_outline = count_specks(mask)
            if specks < _SPECKS or per_outline < _SPECK_SHARE:
                continue
            said = Finding(
                "speckled",
                f"the mask of {names[view]} is speckled: {specks} single pixels differ from all around them, "
                f"{per_outline:.1%} of its outline",
                (view,),
                "certain" if per_outline > 2 * _SPECK_SHARE else "likely",
                per_outline,
                "clean it: a median filter of 3 pixels, or save masks as PNG, never as JPEG",
            )
        found.append(said)
    return found


def check_border(masks: Sequence[np.ndarray], names: Name) -> list[Finding]:
    """Objects that the border of the image cuts off; those it only grazes share one note."""
    found, grazed, most = [], [], 0.0
    for view, mask in enumerate(masks):
        share = 0.0 if mask.all() else border_contact(mask)
        if 0 < share < CUT_SHARE:
            grazed.append(view)
            most = max(most, share)
        elif share:
            found.append(
                Finding(
                    "border",
                    f"the mask of {names[view]} runs along the border of the image for {share:.0%} of the "
                    "object's length: the object is cut off",
                    (view,),
                    "certain",
                    share,
                    "use a view that shows the whole object, or see that other views show the missing part",
                )
            )
    if grazed:
        what = f"the border of the image cuts a little off the object in {names.all_of(grazed)}: along up to "
        what += f"{most:.0%} of its length"
        todo = "nothing, as long as other views show the missing part"
        found.append(Finding("border", what, tuple(grazed), "certain", most, todo, note=True))
    return found


def find_repeated(arrays: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs of positions whose arrays are equal in shape and content; the first against each later one."""
    first: dict[tuple[tuple[int, ...], bytes], int] = {}
    pairs = []
    for view, array in enumerate(arrays):
        key = (array.shape, hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).digest())
        if key in first:
            pairs.append((first[key], view))
        else:
            first[key] = view
    return pairs


def border_share(mask: np.ndarray) -> float:
    """Share of a mask's (H, W) border pixels that are foreground."""
    return float(_ring(mask).astype(bool).mean())


def look_inverted(mask: np.ndarray, unknown: np.ndarray | None = None) -> bool:
    """Whether most of the image's border is foreground, as in a mask that marks the background.

    Args:
        mask: (H, W).
        unknown: (H, W) bool, True where nothing is known: what lies beside such pixels is border as well.
    """
    if unknown is None:
        return border_share(mask) > _INVERTED_BORDER
    out = np.pad(unknown, 1, constant_values=True)
    beside = out[:-2, 1:-1] | out[2:, 1:-1] | out[1:-1, :-2] | out[1:-1, 2:]
    rim = mask[beside & ~unknown]
    return bool(len(rim)) and float(rim.astype(bool).mean()) > _INVERTED_BORDER


def _ring(mask: np.ndarray) -> np.ndarray:
    return np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])


def border_contact(mask: np.ndarray) -> float:
    """Foreground pixels on the image's border, as a share of the object's longest side, at most 1."""
    return min(float(np.count_nonzero(_ring(mask))) / max(object_length(mask), 1), 1.0)


def object_length(mask: np.ndarray) -> int:
    """Longest side, in pixels, of the box around a mask's (H, W) foreground; 0 for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return int(max(np.ptp(rows), np.ptp(columns))) + 1 if len(rows) else 0


def count_specks(mask: np.ndarray) -> tuple[int, float]:
    """Pixels that differ from all eight neighbours: how many, and how many per pixel of outline."""
    # Carving a hull needs this module, and does without OpenCV.
    import cv2

    mask = mask.astype(np.uint8)
    around = cv2.boxFilter(mask, cv2.CV_16S, (3, 3), normalize=False, borderType=cv2.BORDER_REPLICATE)
    specks = int(
        np.count_nonzero((mask == 1) & (around == 1)) + np.count_nonzero((mask == 0) & (around == 8))
    )
    outline = int(np.count_nonzero(mask[1:] != mask[:-1]) + np.count_nonzero(mask[:, 1:] != mask[:, :-1]))
    return specks, specks / max(outline, 1)
