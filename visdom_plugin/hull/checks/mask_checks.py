"""Faults that masks show by themselves: wrong size, empty, full, cut off, speckled, or the same one twice."""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from visdom_plugin.hull.checks.findings import Finding, Name, Sure, spell_range

CUT_SHARE = 0.2
"""An object is cut off in earnest when the frame's border crosses it along this part of its length; less, such as
a foot or a handle's end, is noted."""
_INVERTED_BORDER = 0.5
_SPECKS, _SPECK_SHARE = 8, 0.02
"""So many pixels that differ from all eight neighbours, and so many per pixel of outline, are noise: thin and
perforated objects reach a quarter of that."""


def check_sizes(sizes: np.ndarray, masks: Sequence[np.ndarray], names: Name) -> list[Finding]:
    """Masks of another size than their cameras' images, one finding for all that are alike.

    Args:
        sizes: (N, 2) width and height that the cameras say.
        masks: N arrays (H, W).
    """
    alike = defaultdict(list)
    for view, mask in enumerate(masks):
        wanted = tuple(int(s) for s in sizes[view])
        if mask.shape[::-1] != wanted:
            alike[mask.shape[::-1], wanted].append(view)
    return [
        Finding(
            "size",
            f"{names.masks_of(views, 'is', 'are')} {is_[0]} x {is_[1]} but the camera's image is "
            f"{wanted[0]} x {wanted[1]}",
            tuple(views),
            "certain",
            math.prod(is_) / math.prod(wanted),
            "make masks at the size of their images",
        )
        for (is_, wanted), views in alike.items()
    ]


def check_content(masks: Sequence[np.ndarray], names: Name) -> list[Finding]:
    """Masks that are empty, full or speckled, one finding of each kind."""
    empty, full, specks = [], [], {}
    for view, mask in enumerate(masks):
        share = float(mask.mean())
        if share == 0:
            empty.append(view)
        elif share == 1:
            full.append(view)
        else:
            count, per_outline = count_specks(mask)
            if count >= _SPECKS and per_outline >= _SPECK_SHARE:
                specks[view] = count, per_outline
    found = []
    if empty:
        what = names.masks_of(empty, "has no foreground pixel", "have no foreground pixel")
        todo = "mask the object, check the threshold that reads the mask, or leave the view out"
        found.append(Finding("empty", what, tuple(empty), "certain", 0.0, todo))
    if full:
        what = names.masks_of(full, "is all foreground", "are all foreground")
        todo = "mask the object: no pixel of such a mask is background"
        found.append(Finding("full", what, tuple(full), "certain", 1.0, todo))
    if specks:
        views = tuple(specks)
        counts, shares = zip(*specks.values(), strict=True)
        what = (
            f"{names.masks_of(views, 'is', 'are')} speckled: {spell_range(counts, 'd')} single pixels differ "
        )
        what += f"from all around them, {spell_range(shares, '.1%')} of the outline"
        sure: Sure = "certain" if max(shares) > 2 * _SPECK_SHARE else "likely"
        todo = "clean it: a median filter of 3 pixels, or save masks as PNG, never as JPEG"
        found.append(Finding("speckled", what, views, sure, max(shares), todo))
    return found


def check_border(masks: Sequence[np.ndarray], names: Name) -> list[Finding]:
    """Objects that the border of the image cuts off, in one finding; those it only grazes share one note."""
    found, cut, grazed, most = [], {}, [], 0.0
    for view, mask in enumerate(masks):
        share = 0.0 if mask.all() else border_contact(mask)
        if 0 < share < CUT_SHARE:
            grazed.append(view)
            most = max(most, share)
        elif share:
            cut[view] = share
    if cut:
        views, shares = tuple(cut), tuple(cut.values())
        what = f"{names.masks_of(views, 'runs', 'run')} along the border of the image for "
        what += f"{spell_range(shares, '.0%')} of the object's length: the object is cut off"
        todo = "use views that show the whole object, or see that other views show the missing part"
        found.append(Finding("border", what, views, "certain", max(shares), todo))
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
