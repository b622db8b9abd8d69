"""The page that shows Gaussians without a server: the viewer of splat-transform, looking at the object."""

from __future__ import annotations

import html
import json
import math
import re
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from visdom_plugin.atomic_files import appearing
from visdom_plugin.export.splat_transform import splat_transform
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.ply import write_gaussians

_TITLE = "<title>SuperSplat Viewer</title>"
_SETTINGS = re.compile(r'\bsettings: (?=(\{"version":))')
_FOV_DEG, _SHAPE = 60.0, 9 / 16
"""Of the first view along the page's longer side, and the shorter side against it."""
_ROOM = 1.1
"""Between the object and the borders of the page."""
_OUTLIERS = 0.01
"""Share of the Gaussians on each side that the first view need not show."""
_ASIDE = (1.0, -0.6, -1.0)
"""Where the first view is from, where there are no cameras: y is down."""


def write_page(
    path: Path, gaussians: Gaussians, *, title: str | None = None, eye: Tensor | None = None
) -> None:
    """Writes the page; it appears whole or not at all.

    The object is moved to the middle and made of size 1 in it, so that nothing depends on the scene's unit.

    Args:
        gaussians: in a frame whose y points down where the page has its top.
        title: of the page, by default the file's name.
        eye: (3,) the first view is from there, in the Gaussians' frame.

    Raises:
        ConfigError: as `splat_transform`.
    """
    middle, size = _measure(gaussians)
    direction = torch.tensor(_ASIDE, dtype=torch.float64) if eye is None else eye.double() - middle
    direction = direction / direction.norm().clamp(min=1e-12)
    with tempfile.TemporaryDirectory() as folder, appearing(path) as part:
        plain = Path(folder) / f"{path.stem}.ply"
        write_gaussians(plain, _normalise(gaussians, middle, size))
        splat_transform(plain, part, asked=path)
        page = part.read_text(encoding="utf-8")
        part.write_text(_look_at_object(page, title or path.stem, direction), encoding="utf-8")


def _look_at_object(page: str, title: str, direction: Tensor) -> str:
    """The viewer's page with a title, a white background and a first view of a ball of radius 1.

    What is not where splat-transform 2 puts it stays as it is.
    """
    page = page.replace(_TITLE, f"<title>{html.escape(title)}</title>", 1)
    found = _SETTINGS.search(page)
    if found is None:
        return page
    settings, end = json.JSONDecoder().raw_decode(page, found.start(1))
    # The viewer's angle is that of the page's longer side.
    away = _ROOM / math.sin(math.atan(_SHAPE * math.tan(math.radians(_FOV_DEG / 2))))
    x, y, z = (float(v) * away for v in direction)
    # It turns a file by half a turn about z.
    camera = {"initial": {"position": [-x, -y, z], "target": [0, 0, 0], "fov": _FOV_DEG}}
    settings |= {"background": {"color": [1, 1, 1]}, "cameras": [camera]}
    return page[: found.start(1)] + json.dumps(settings) + page[end:]


def _measure(gaussians: Gaussians) -> tuple[Tensor, float]:
    """The middle (3,) float64 of the Gaussians, and the radius about it, but for a few outliers."""
    means = gaussians.means.detach().cpu().double()
    if not len(means):
        return torch.zeros(3, dtype=torch.float64), 1.0
    ordered = means.sort(0).values
    out = int(_OUTLIERS * len(means))
    middle = (ordered[out] + ordered[-1 - out]) / 2
    radii = (means - middle).norm(dim=1).sort().values
    return middle, float(radii[-1 - out]) or 1.0


def _normalise(gaussians: Gaussians, middle: Tensor, size: float) -> Gaussians:
    values = gaussians.detach().tensors()
    means = (values["means"].cpu().double() - middle) / size
    scales = values["log_scales"].cpu() - math.log(size)
    return Gaussians(**values | {"means": means.float(), "log_scales": scales})
