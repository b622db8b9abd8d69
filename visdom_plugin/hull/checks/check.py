"""The check: finds what is wrong with a capture from its cameras and masks, before anything is trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.checks.causes.fault_hypotheses import QUIET_PX, Suspicion, find_causes
from visdom_plugin.hull.checks.causes.intrinsics import find_astray, find_other_unit, measure_focal_range
from visdom_plugin.hull.checks.causes.pose_conventions import IN_MEMORY, PoseFaults
from visdom_plugin.hull.checks.causes.turned_view import measure_turn
from visdom_plugin.hull.checks.covisibility import (
    USUAL_K,
    Advice,
    advise_k,
)
from visdom_plugin.hull.checks.degenerate import stand_at_one_point
from visdom_plugin.hull.checks.findings import Finding, Name
from visdom_plugin.hull.checks.mask_checks import (
    check_border,
    check_content,
    check_sizes,
    find_repeated,
    look_inverted,
)
from visdom_plugin.hull.checks.sentences import (
    DISAGREE_PX,
    say_cause,
    say_clustered,
    say_covisibility,
    say_disagreement,
    say_one_point,
    say_too_few,
    share_of_length,
)
from visdom_plugin.hull.foreign import to_numpy
from visdom_plugin.hull.outlines.distance_fields import OBJECT_PX, Outlines, draw_outlines, turn_over
from visdom_plugin.hull.outlines.silhouette_consistency import Coherence, measure_coherence

SPEAKING_PX = 0.5
"""What masks rule out beside each other, on average; less, and they tell nothing of the cameras."""
_RAYS, _BRIEF_VIEWS = 1024, 16


@dataclass(frozen=True)
class Check:
    """The result of `check`."""

    findings: list[Finding]
    """Faults, most serious first."""
    notes: list[Finding]
    """Remarks that do not make the capture faulty."""
    advice: Advice | None
    """The K that the views allow; None when there are not two usable views."""
    fit: Coherence | None
    """How well the usable views fit together once the faults found are undone."""
    usable: tuple[int, ...]
    """Views that `advice` and `fit` speak of."""
    focal_range: tuple[float, float] | None = None
    """Factors of all focal lengths between which the masks fit about as well; None where that was not asked."""


def check(
    cameras: Cameras,
    masks: Sequence[Tensor | np.ndarray],
    images: Sequence[Tensor | np.ndarray] = (),
    names: Sequence[str] | None = None,
    *,
    ignore: Sequence[Tensor | np.ndarray | None] = (),
    k: int | None = None,
    brief: bool = False,
    poses: PoseFaults = IN_MEMORY,
) -> Check:
    """Looks for every fault that shows in cameras and masks, and for photographs that occur twice.

    Args:
        cameras: (N,) cameras.
        masks: N tensors or arrays (H, W), True on the object. They need not fit the cameras: that is a finding.
        images: N tensors or arrays (H, W, 3), or empty to leave them out.
        names: the views' names, for the sentences.
        ignore: N tensors or arrays (H, W) bool or None, True where nothing is known, or empty.
        k: the K that is going to be used; by default it is to be advised.
        brief: a fraction of a second; names a fault but not always its cause, and compares 16 views at most.
        poses: what to say of wrong poses, in the terms of where they are from.
    """
    own = [to_numpy(m).astype(bool) for m in masks]
    unknown = [None if g is None else to_numpy(g).astype(bool) for g in ignore] or [None] * len(own)
    own = [_without(m, g) for m, g in zip(own, unknown, strict=True)]
    names = Name.numbered(len(own)) if names is None else Name(names)
    sizes = torch.stack([cameras.width, cameras.height], -1).cpu().numpy()
    found = check_sizes(sizes, own, names)
    out = {view for f in found for view in f.views}
    filled = [_filled(m, g) for m, g in zip(own, unknown, strict=True)]
    alone = check_content([m if i not in out else np.eye(2, dtype=bool) for i, m in enumerate(filled)], names)
    found += alone
    for view in (view for f in alone if f.kind == "speckled" for view in f.views):
        own[view] = cv2.medianBlur(own[view].astype(np.uint8), 3) > 0
    out |= {view for f in alone if f.kind != "speckled" for view in f.views}
    out |= {i for i, m in enumerate(own) if not m.any()}
    usable = np.array([i for i in range(len(own)) if i not in out], np.int64)
    repeated = _repeated(own, images, out, names)
    if brief and len(usable) > _BRIEF_VIEWS:
        usable = usable[np.arange(_BRIEF_VIEWS) * len(usable) // _BRIEF_VIEWS]
    if len(own) < 2:
        found.append(say_too_few(len(own)))
    if len(usable) < 2:
        notes, found = _split([*found, *repeated])
        return Check(found, notes, None, None, tuple(usable.tolist()))
    chosen = cameras[torch.from_numpy(usable)]
    outlines = draw_outlines(
        chosen, gather_silhouettes(chosen, [own[i] for i in usable], [unknown[i] for i in usable])
    )
    inverted, outlines = _inverted(outlines, own, unknown, usable, names)
    found += inverted
    turned = {v for f in inverted for v in f.views}
    turned_over = [_without(~m, unknown[i]) if i in turned else m for i, m in enumerate(own)]
    found += check_border(turned_over, names)
    units, outlines = find_other_unit(chosen, outlines, faint=True)
    found += units
    causes, fit, left = find_causes(outlines, brief=brief, poses=poses)
    if stand_at_one_point(chosen) and not any(c.kind == "axes" for c in causes):
        notes, found = _split([*found, *repeated, say_one_point(len(chosen))])
        return Check(found, notes, None, fit, tuple(usable.tolist()))
    astray = find_astray(chosen)
    if astray and _views_alone(causes, fit):
        notes, found = _split([*found, *repeated, astray])
        return Check(found, notes, None, fit, tuple(usable.tolist()))
    repeated, causes = _join(repeated, causes, usable, names)
    found += repeated
    single = len(causes) == 1 and not (brief or inverted or units)
    turn = measure_turn(outlines, causes[0]) if single else None
    if turn is not None:
        causes = [causes[0]._replace(detail="")]
    found += [say_cause(c, usable, names, poses, turn) for c in causes]
    ambiguous = any(c.rivals for c in causes)
    if fit.score > DISAGREE_PX and not ambiguous:
        found.append(say_disagreement(fit, usable[left], names))
    rest = outlines.keep(left)
    advice = None
    if left.sum() >= 2 and not any(c.kind in ("axes", "scale", "turned", "order", "swapped") for c in causes):
        kept = Name([names[i] for i in usable[left]])
        advice = advise_k(rest, kept, fit, USUAL_K if k is None else k)
        # Views that do not fit each other seem to have little in common at any K.
        if not causes and fit.score <= DISAGREE_PX:
            found += say_covisibility(advice, usable[left], k, names)
        found += say_clustered(rest, fit, chosen)
    notes, found = _split(found)
    found.sort(key=lambda f: ("certain", "likely", "possible").index(f.sure))
    told = brief or causes or units or fit.score > DISAGREE_PX or left.sum() < 2
    span = None if told else measure_focal_range(rest, fit.score)
    return Check(found, notes, advice, fit, tuple(usable[left].tolist()), span)


def _without(mask: np.ndarray, unknown: np.ndarray | None) -> np.ndarray:
    """What is known to be object."""
    return mask if unknown is None or unknown.shape != mask.shape else mask & ~unknown


def _filled(mask: np.ndarray, unknown: np.ndarray | None) -> np.ndarray:
    """The mask; all foreground where all that is known is."""
    full = unknown is not None and unknown.shape == mask.shape and mask.any() and (mask | unknown).all()
    return np.ones_like(mask) if full else mask


def _split(found: list[Finding]) -> tuple[list[Finding], list[Finding]]:
    return [f for f in found if f.note], [f for f in found if not f.note]


def _repeated(
    masks: Sequence[np.ndarray], images: Sequence[Tensor | np.ndarray], out: set[int], names: Name
) -> list[Finding]:
    """Photographs and masks that occur more than once, one finding for all copies of one."""
    pairs = {p: {"mask"} for p in find_repeated(masks) if not out & set(p)}
    for p in find_repeated([np.asarray(i) for i in images]):
        pairs.setdefault(p, set()).add("photograph")
    groups: dict[tuple[int, tuple[str, ...]], list[int]] = {}
    for (first, later), what in sorted(pairs.items()):
        groups.setdefault((first, tuple(sorted(what))), [first]).append(later)
    return [
        Finding(
            "duplicate",
            f"{names.all_of(views)} have the same {' and the same '.join(what)}, pixel for pixel",
            tuple(views),
            "certain",
            1.0,
            "put the right file in the place of the copy, or leave one of the two views out"
            if len(views) == 2
            else "put the right files in the place of the copies, or leave all but one of these views out",
        )
        for (_, what), views in groups.items()
    ]


def _inverted(
    outlines: Outlines,
    masks: Sequence[np.ndarray],
    unknown: Sequence[np.ndarray | None],
    usable: np.ndarray,
    names: Name,
) -> tuple[list[Finding], Outlines]:
    """Masks that hold the border of their image, and fit the others no worse when turned over."""
    flagged = [k for k, i in enumerate(usable) if look_inverted(masks[i], unknown[i])]
    if not flagged:
        return [], outlines
    rays = max(_RAYS // len(usable), 16)
    fit = measure_coherence(outlines, rays)
    fields = tuple(turn_over(f) if k in flagged else f for k, f in enumerate(outlines.fields))
    turned = replace(outlines, fields=fields)
    after = measure_coherence(turned, rays)
    # A close-up fills its border as well, but it fits as it is and not when turned over.
    if fit.score <= QUIET_PX and after.score > 10 * QUIET_PX:
        return [], outlines
    views = tuple(int(usable[k]) for k in flagged)
    sound = after.score <= DISAGREE_PX and after.power > max(SPEAKING_PX, fit.power)
    whose = "all masks are" if len(views) == len(masks) else f"the mask of {names[views[0]]} is"
    if 1 < len(views) < len(masks):
        whose = f"the masks of {names.all_of(views)} are"
    evidence = f"turned over, the masks fit together to {share_of_length(after.score)} of the object's length"
    said = Finding(
        "inverted",
        f"{whose} foreground along most of the image's border: background is marked"
        + (f"; {evidence}" if sound else ""),
        views,
        "certain" if sound else "likely",
        after.score / OBJECT_PX,
        "invert them: white (True) on the object",
    )
    return [said], turned


def _views_alone(causes: list[Suspicion], fit: Coherence) -> bool:
    """Whether something is wrong, and nothing but single views is there to blame."""
    wrong = bool(causes) or fit.score > DISAGREE_PX or fit.power < SPEAKING_PX
    return wrong and all(c.kind == "view" for c in causes)


def _join(
    repeated: list[Finding], causes: list[Suspicion], usable: np.ndarray, names: Name
) -> tuple[list[Finding], list[Suspicion]]:
    """A view that does not fit because it has another's mask is one fault, not two."""
    pairs = {view: k for k, f in enumerate(repeated) for view in f.views}
    left = []
    for cause in causes:
        view = int(usable[cause.views[0]]) if cause.kind == "view" else None
        if view in pairs and not cause.rivals:
            k = pairs[view]
            repeated[k] = repeated[k]._replace(
                what=f"{repeated[k].what}; {names[view]} is the one that does not fit the others"
            )
        elif not (
            cause.kind == "view" and {int(usable[v]) for v in (*cause.views, *cause.rivals)} & set(pairs)
        ):
            left.append(cause)
    return repeated, left
