"""What lies beside a photograph: its mask, ignored pixels and depth, brought into the photograph's frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from datamodules.capture import Frame
from datamodules.files import images, masks
from datamodules.files.paths import printable, read_file
from datamodules.views import orientation
from datamodules.views.find_files import loose_key
from datamodules.views.photograph_files import Photograph, Reading
from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.scene import NO_MASKS

ChooseTurns = Callable[[], tuple[int, bool]]
"""For files that fit their photograph turned and not: which way most do, and whether that is clear."""
_MASK_WORDS = ("mask", "matte", "alpha", "seg", "segmentation", "silhouette")


class FoundMask(NamedTuple):
    """A view's mask in its photograph's frame, at the file's own size."""

    opacity: np.ndarray | None
    """(H, W) float32; None where there is no mask."""
    unknown: np.ndarray | None
    """(H, W) bool, True where the mask's file says that nothing is known; None where it never does."""
    path: Path
    remarks: tuple[str, ...] = ()
    """How it was understood, where that is not plain."""
    colourful: bool | None = None
    """Of a mask's file, as `masks.Mask` has it; None where the alpha channel is the mask."""


def read_mask(reading: Reading, file: Frame, photo: Photograph, choose_turns: ChooseTurns) -> FoundMask:
    """The mask of a view, from its file or the photograph's alpha channel, turned over where that is asked for."""
    found = _find_mask(reading, file, photo, choose_turns)
    if found.opacity is not None and reading.request.invert_masks:
        return found._replace(opacity=1 - found.opacity)
    return found


def _find_mask(reading: Reading, file: Frame, photo: Photograph, choose_turns: ChooseTurns) -> FoundMask:
    source, alpha = reading.request.mask_source, None
    if photo.alpha and source != "folder":
        alpha = masks.decode_alpha(images.decode_any(photo.data, photo.path))
        alpha = alpha and alpha._replace(opacity=photo.turn(alpha.opacity))
    if source == "alpha" or (file.mask is None and source != "folder"):
        return FoundMask(None if alpha is None else alpha.opacity, None, photo.path)
    if file.mask is None:
        return FoundMask(None, None, photo.path)
    found, path, remarks = _read_turned(reading, file.mask, photo, "mask", choose_turns)
    if alpha is not None:
        masks.refuse_two(found, alpha, path, photo.path)
    return FoundMask(found.opacity, found.unknown, path, remarks, found.colourful)


def read_ignored(
    reading: Reading, file: Frame, photo: Photograph, mask: FoundMask, choose_turns: ChooseTurns
) -> np.ndarray | None:
    """(H, W) bool at the photograph's size, True where nothing is known; None where everything is."""
    ignore = None if mask.unknown is None else resize(mask.unknown.astype(np.float32), *photo.size) > 0
    for relative, black_is_unknown in ((file.ignore, True), (file.excluded, False)):
        if relative is not None:
            found = _read_turned(reading, relative, photo, "mask of ignored pixels", choose_turns)[0]
            unknown = found.opacity <= 0.5 if black_is_unknown else found.opacity > 0
            unknown = unknown if found.unknown is None else unknown | found.unknown
            unknown = resize(unknown.astype(np.float32), *photo.size) > 0
            ignore = unknown if ignore is None else ignore | unknown
    return ignore if ignore is not None and ignore.any() else None


def read_depth(
    reading: Reading, file: Frame, full: tuple[int, int], target: tuple[int, int]
) -> Tensor | None:
    """(H, W) float32 monocular depth at the target's size; None where the view has none.

    Args:
        full: width and height that the camera says.
        target: width and height that are wanted.

    Raises:
        SceneError: the file is damaged, or has another shape than the camera.
    """
    path = None if file.depth is None else reading.find(file.depth)
    if path is None or not path.is_file():
        return None
    data = read_file(path)
    decoded = images.decode_depth(data, path) if path.suffix.lower() == ".npy" else None
    size = images.read_header(data, path).size if decoded is None else decoded.shape[::-1]
    if abs(size[0] * full[1] - size[1] * full[0]) > max(full):
        raise SceneError(
            f"the depth map is {size[0]} x {size[1]}, another shape than its image's {full[0]} x {full[1]}",
            where=path,
            todo="make the depth map from the image, or remove it",
            topic="depth",
        )
    depth = images.decode_depth(data, path) if decoded is None else decoded
    return torch.from_numpy(images.shrink_nearest(depth, *target))


def resize(soft: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average where the picture gets smaller, else the nearest value."""
    if soft.shape[0] >= height and soft.shape[1] >= width:
        return images.shrink(soft, width, height)
    return images.shrink_nearest(soft, width, height)


def refuse_unmasked(reading: Reading, file: Frame, photo: Photograph) -> None:
    """Raises SceneError about a view that has no mask, with what there is in its place."""
    if file.ignore is not None:
        raise SceneError(
            f"the photograph has no foreground mask: {file.ignore} says which pixels to ignore",
            where=photo.path,
            cause="mask_path has nerfstudio's meaning here",
            todo="pass --mask-path foreground if these files are white on the object",
            topic="mask-missing",
        )
    source, folder = reading.request.mask_source, reading.request.masks or reading.mask_folder
    lacks, missing = [], folder is not None and not (reading.root / folder).is_dir()
    if source != "alpha" and folder is not None:
        lacks.append(
            f"there is no folder {folder}" if missing else f"there is no file of its name in {folder}"
        )
    if source != "folder":
        lacks.append("its alpha channel is opaque everywhere" if photo.alpha else "it has no alpha channel")
    others = _other_folders(reading.root, file)
    if beside := _beside(photo.path):
        raise SceneError(
            f"the photograph {printable(file.name)} has no foreground mask: {', and '.join(lacks)}",
            where=photo.path,
            cause=f"masks among the photographs: {printable(beside.name)} is one by its name",
            todo=f"move such files to {folder or 'masks'}/",
            topic="mask-missing",
        )
    raise SceneError(
        f"the photograph {printable(file.name)} has no foreground mask: {', and '.join(lacks)}",
        where=reading.root if missing else photo.path,
        cause=f"masks in another folder: {list_some(others)} has a file of this name" if others else None,
        todo=f"pass --masks {others[0]} if its files are white (or opaque) on the object"
        if others
        else NO_MASKS,
        topic="mask-missing",
    )


def _beside(path: Path) -> Path | None:
    """A file in the photograph's folder that is called like a mask of it."""
    names = [f"{path.stem}{link}{word}" for link in "_-." for word in _MASK_WORDS]
    names += [f"{word}{link}{path.stem}" for link in "_-." for word in _MASK_WORDS]
    wanted = {loose_key(f"{name}.png") for name in names}
    found = (p for p in sorted(path.parent.iterdir()) if p.suffix.lower() in images.ENDINGS)
    return next((p for p in found if loose_key(p.name) in wanted), None)


def _other_folders(root: Path, file: Frame) -> list[str]:
    """Folders, below the root or beside the photograph, that hold a picture of its name and could hold masks."""
    image = PurePosixPath(file.image)
    known = ("images", "depth", "normal", "ignore", "sparse")
    places = dict.fromkeys(p for folder in (root, (root / image).parent) for p in sorted(folder.iterdir()))
    folders = [p for p in places if p.is_dir() and not p.name.lower().startswith(known)]
    return [
        folder.relative_to(root).as_posix()
        for folder in folders
        if folder.name != image.parts[0]
        and any(
            loose_key(p.name) == loose_key(image.name)
            for p in folder.iterdir()
            if p.suffix.lower() in images.ENDINGS
        )
    ]


class SideFile(NamedTuple):
    """A file beside a photograph whose header has been read."""

    data: bytes
    path: Path
    turns: list[orientation.Turns]
    """Ways in which it can be turned to fit its photograph."""


def open_side_file(reading: Reading, relative: str, photo: Photograph, what: str) -> SideFile:
    """Reads the header of a mask or of ignored pixels.

    Args:
        what: what the file is, for messages.

    Raises:
        SceneError: it is missing or damaged, or has another shape than its photograph.
    """
    path = reading.find(relative)
    data = read_file(path)
    header = images.read_header(data, path)
    ways = orientation.possible_turns(photo.orientation, photo.turned, header.orientation)
    ways = [turns for turns in ways if masks.fits(orientation.turned_size(header.size, turns), photo.size)]
    if ways:
        return SideFile(data, path, ways)
    width, height = header.size
    sideways = masks.fits((height, width), photo.size)
    raise SceneError(
        f"the {what} is {width} x {height} but its image is {photo.size[0]} x {photo.size[1]}",
        where=path,
        cause=f"the {what} or the image was turned by a quarter, and says nothing of it"
        if sideways
        else f"the {what} was made of another image: one cropped, or not undistorted as this one is",
        todo=f"turn the {what} by a quarter"
        if sideways
        else f"make the {what} from the image, at any size of the same shape; where the image was undistorted, "
        "the same way",
        topic="size",
    )


def score_turns(reading: Reading, mask: str, photo: Photograph) -> list[list[float]]:
    """`outline_contrast` in each way that a mask's size allows, as a row; no row where there is but one way."""
    other = open_side_file(reading, mask, photo, "mask")
    if len(other.turns) == 1:
        return []
    image, opacity = photo.decode(), masks.decode_mask(other.data, other.path).opacity
    return [[orientation.outline_contrast(image, orientation.apply(opacity, turns)) for turns in other.turns]]


def _read_turned(
    reading: Reading, relative: str, photo: Photograph, what: str, choose_turns: ChooseTurns
) -> tuple[masks.Mask, Path, tuple[str, ...]]:
    """A mask's pixels in its photograph's frame, its file, and what is to be said of how they were turned."""
    other = open_side_file(reading, relative, photo, what)
    way, clear = choose_turns() if len(other.turns) > 1 else (0, True)
    turns, remarks = other.turns[way], []
    if not clear:
        remarks.append(
            f"photographs with EXIF orientation {photo.orientation}, whose masks may be turned against them: "
            "neither sizes nor outlines tell; the pixels are taken as they are stored"
        )
    elif turns and photo.orientation > 1:
        remarks.append(
            f"masks turned to match their photographs, which have EXIF orientation {photo.orientation}"
        )
    elif turns:
        remarks.append(f"masks turned by their EXIF orientation {turns[0]}")
    found = masks.decode_mask(other.data, other.path)
    if found.labelled:
        void = "" if found.unknown is None else "; their value for void is unknown, as in ignore/"
        remarks.append(f"label images read as masks: 0 is background, every other value is object{void}")
    unknown = None if found.unknown is None else orientation.apply(found.unknown, turns)
    turned = found._replace(opacity=orientation.apply(found.opacity, turns), unknown=unknown)
    return turned, other.path, tuple(remarks)
