"""Messages for poses in the wrong convention, in the terms of the program or the file that holds them.

With C the right camera-to-world matrix in OpenCV axes and F = diag(1, -1, -1, 1): a transforms.json holds C F, a
COLMAP model inv(C). A rigid motion of the whole world changes nothing in how well views fit each other.
"""

from __future__ import annotations

from typing import NamedTuple


class PoseFault(NamedTuple):
    """One wrong way to hold poses."""

    what: str
    todo: str


class PoseFaults(NamedTuple):
    """A sentence for each wrong way, in the terms of where the poses are from."""

    turned: PoseFault
    """Right once the camera's y and z axes are turned round."""
    inverse: PoseFault
    """Right once inverted."""
    inverse_turned: PoseFault
    """Right once inverted, and the camera's y and z axes turned round then."""
    world_turned: PoseFault
    """Right once the world's y and z axes are turned round (shows in single views alone)."""


IN_MEMORY = PoseFaults(
    PoseFault(
        "the poses have OpenGL axes (y up, z backward)",
        'pass convention="opengl" to Cameras.from_matrices',
    ),
    PoseFault("the poses are world-to-camera matrices", "pass their inverses, world_from_camera"),
    PoseFault(
        "the poses are world-to-camera matrices with OpenGL axes",
        'pass their inverses and convention="opengl" to Cameras.from_matrices',
    ),
    PoseFault("the pose has the world's y and z axes turned round", "negate its second and third row"),
)
"""Of cameras that a program handed over, which are camera-to-world with OpenCV axes."""
_COLMAP = PoseFaults(
    PoseFault(
        "the model's images.txt (or .bin) holds OpenGL axes (y up, z backward) where COLMAP wants OpenCV's",
        "negate the second and third row of each world-to-camera matrix (R | t)",
    ),
    PoseFault(
        "the model's images.txt (or .bin) holds camera-to-world poses where COLMAP wants world-to-camera",
        "invert each pose: R' = transpose of R, t' = -R' t",
    ),
    PoseFault(
        "the model's images.txt (or .bin) holds camera-to-world poses with OpenGL axes (y up, z backward) where "
        "COLMAP wants world-to-camera with OpenCV's",
        "negate the second and third column of each R, then invert each pose: R' = transpose of R, t' = -R' t",
    ),
    PoseFault(
        "the model's pose has the world's y and z axes turned round",
        "negate the second and third column of its R",
    ),
)
_ON_DISK = PoseFaults(
    PoseFault(
        "the poses on disk have the cameras' y and z axes turned round",
        "compare the axes (x right, y up or down, z forward or backward) with what the format wants",
    ),
    PoseFault(
        "the poses on disk are inverted: camera-to-world and world-to-camera are exchanged",
        "invert them",
    ),
    PoseFault(
        "the poses on disk are inverted and have the cameras' y and z axes turned round",
        "invert them, and compare their axes with what the format wants",
    ),
    PoseFault("the pose on disk has the world's y and z axes turned round", "turn them back"),
)


def _of_transforms(file: str) -> PoseFaults:
    return PoseFaults(
        PoseFault(
            f"{file} holds OpenCV axes (y down, z forward) where the format wants OpenGL's",
            "negate the second and third column of each transform_matrix",
        ),
        PoseFault(
            f"{file} holds world-to-camera matrices with OpenCV axes where the format wants camera-to-world with "
            "OpenGL's",
            "invert each transform_matrix, then negate its second and third column",
        ),
        PoseFault(
            f"{file} holds world-to-camera matrices where the format wants camera-to-world",
            "invert each transform_matrix",
        ),
        PoseFault(
            f"{file} has the world's y and z axes turned round in this pose",
            "negate the second and third row of its transform_matrix",
        ),
    )


_OF_LAYOUT = {
    **dict.fromkeys(("prepared", "mip360", "colmap"), _COLMAP),
    **dict.fromkeys(("nerfstudio", "instant-ngp"), _of_transforms("transforms.json")),
    "blender": _of_transforms("transforms_train.json"),
    **dict.fromkeys(("omni3d", "llff", "actorshq"), _ON_DISK),
}


def pose_faults(layout: str | None) -> PoseFaults:
    """The sentences for a scene's layout; those of cameras in memory for one that is no layout on disk."""
    return _OF_LAYOUT.get(layout or "", IN_MEMORY)
