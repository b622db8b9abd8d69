"""What the viewer shows of a scene and its runs, as numbers that a browser draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.harmonics import C0
from visdom_plugin.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix

if TYPE_CHECKING:
    from torch import Tensor

    from visdom_plugin.export.meshes import Mesh
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.scene import Scene
    from visdom_plugin.splat.gaussians import Gaussians
    from visdom_plugin.training.evaluate import Renderer


@dataclass
class Reconstruction:
    """One run, or a file of Gaussians. It changes while it trains."""

    label: str
    renderer: Renderer
    device: torch.device
    gaussians: Callable[[], tuple[Gaussians, Tensor] | None]
    """Gaussians and the origin (3,) of their frame, where it has any."""
    mesh: Callable[[], Mesh | None]
    """Its mesh, where it has no Gaussians."""
    refresh: Callable[[], int | None] = lambda: None
    """Takes over the newest state on disk; the step, or None where nothing is new."""


@dataclass(frozen=True)
class Subject:
    """All there is to see."""

    scene: Scene
    hull: Hull | None
    runs: tuple[Reconstruction, ...] = ()
    path: Path | None = None
    """Of the first run or file."""
    path_file: Path = Path("camera_path.json")
    """Where a camera path is saved."""


def splat_arrays(gaussians: Gaussians, offset: np.ndarray) -> dict[str, np.ndarray]:
    """centers (N, 3) moved by `offset`, covariances (N, 3, 3), rgbs (N, 3), opacities (N, 1), float32.

    Colours are those seen on average from all sides: browsers draw no harmonics here.
    """
    g = gaussians.detach().to("cpu", torch.float64)
    axes = matrix_from_quaternion(g.quaternions) * g.log_scales.exp()[:, None, :]
    arrays = {
        "centers": g.means + torch.as_tensor(offset),
        "covariances": axes @ axes.mT,
        "rgbs": (0.5 + C0 * g.sh[:, 0]).clamp(0, 1),
        "opacities": g.opacity_logits.sigmoid()[:, None],
    }
    return {name: value.float().numpy() for name, value in arrays.items()}


def pose_of(camera: Cameras, middle: np.ndarray) -> dict[str, Any]:
    """wxyz and position of one camera in the viewer's frame, whose origin is at `middle`."""
    motion = camera.world_from_camera.double().cpu()
    turn = quaternion_from_matrix(motion[:3, :3])
    return {"wxyz": turn.numpy(), "position": motion[:3, 3].numpy() - middle}


def camera_from(
    wxyz: np.ndarray, position: np.ndarray, fov: float, size: tuple[int, int], middle: np.ndarray
) -> Cameras:
    """The camera () of a browser's view.

    Args:
        fov: vertical, radians.
        size: (width, height).
    """
    width, height = size
    focal = height / 2 / np.tan(fov / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = matrix_from_quaternion(torch.tensor(np.asarray(wxyz), dtype=torch.float64))
    motion[:3, 3] = torch.tensor(np.asarray(position, np.float64) + middle)
    return Cameras(K, motion, torch.tensor(width), torch.tensor(height))


def nearest_view(cameras: Cameras, camera: Cameras) -> int:
    """The view that looks most alike: nearby, and in a similar direction."""
    centres = cameras.centres.double().cpu()
    distance = (centres - camera.centres).norm(dim=-1)
    away = distance / (centres - centres.mean(0)).norm(dim=-1).mean().clamp_min(1e-9)
    return int((away - cameras.forward.double().cpu() @ camera.forward).argmin())
