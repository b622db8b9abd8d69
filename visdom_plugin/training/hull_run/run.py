"""One run that carves a hull, measures it against the true surface and writes a run directory."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import TypedDict

from visdom_plugin.atomic_files import finite
from visdom_plugin.errors import VisDomError
from visdom_plugin.hull.hull import Hull
from visdom_plugin.scene import Scene
from visdom_plugin.training.hull_run.config import METHOD, HullRunConfig
from visdom_plugin.training.runs.config_io import as_plain
from visdom_plugin.training.runs.run_directory import Record, RunDir, describe_data, find_versions
from visdom_plugin.training.runs.saved_hulls import write_hull

log = logging.getLogger(__name__)

DISTANCES = ("chamfer_sym", "chamfer_target_to_hull", "chamfer_hull_to_target", "chamfer_floor")
VOLUMES = ("iou", "covered", "target_volume")


class Measured(TypedDict):
    """A carved hull and its numbers."""

    metrics: Record
    """What run.json holds."""
    hull: Hull
    hull_s: float
    """Seconds."""


def measure_hull(scene: Scene, config: HullRunConfig, *, seed: int = 0) -> Measured:
    """Carves the training views' hull and measures it.

    Chamfer distances are means over points of squared distances, in square scene units (the paper prints 1000
    times that): `chamfer_sym` is the sum of both directions, `chamfer_floor` what two independent draws on the
    target itself give, below which nothing can be told.

    Args:
        seed: of the points drawn.

    Returns:
        Metrics that need the target are None where the scene has no mesh, and `metrics["target"]["missing"]` is
        True.

    Raises:
        EmptyHullError: nothing is left.
    """
    from visdom_plugin.hull.queries.surface_distance import compare_points, draw_on_surface, overlap

    began = time.monotonic()
    hull = config.hull.carve(*scene.train.silhouettes())
    hull_s = time.monotonic() - began
    test: dict[str, float | None] = dict.fromkeys((*DISTANCES, *VOLUMES))
    test |= {"volume": hull.volume, "surface_area": hull.surface_area, "voxels": hull.voxels}
    target: dict[str, object] = {
        "missing": scene.mesh is None,
        "samples": config.samples,
        "units": scene.units,
    }
    if scene.mesh is not None:
        vertices, faces = (x.numpy() for x in scene.mesh)
        truth, again = (draw_on_surface(vertices, faces, config.samples, seed, i) for i in (0, 1))
        found = compare_points(truth, draw_on_surface(*hull.to_mesh(), config.samples, seed, 2))
        test |= {
            "chamfer_sym": found.symmetric,
            "chamfer_target_to_hull": found.target_to_hull,
            "chamfer_hull_to_target": found.hull_to_target,
            "chamfer_floor": compare_points(truth, again).symmetric,
        }
        test |= overlap(hull, vertices, faces)
    metrics = {
        "test": test,
        "per_view": {},
        "target": target,
        "protocol": {"definition": "chamfer: mean of squared distances, scene units"},
    }
    return {"metrics": metrics, "hull": hull, "hull_s": hull_s}


def carve_run(
    config: HullRunConfig,
    scene: Scene,
    *,
    run_dir: Path,
    seed: int = 0,
    overwrite: bool = False,
    request: Record | None = None,
    budget: str | None = None,
) -> Record:
    """`measure_hull` into a run directory; nothing is done where it is finished already.

    Returns:
        run.json's content, with `already_finished` added.

    Raises:
        CheckpointError: when `run_dir` belongs to another run or another process.
        EmptyHullError: nothing is left; no directory then.
    """
    identity = {
        "method": METHOD,
        "scene": scene.name,
        "seed": seed,
        "config": as_plain(config),
        "data": describe_data(scene, request or {}),
    }
    with RunDir.open(run_dir, finite(identity), overwrite=overwrite) as run:
        if run.record["status"] == "finished":
            return run.record | {"already_finished": True}
        run.update(status="running", budget=budget, device="cpu", versions=find_versions())
        try:
            began = time.monotonic()
            found = measure_hull(scene, config, seed=seed)
            seconds = time.monotonic() - began
            write_hull(found["hull"], run.path / "hull")
        except KeyboardInterrupt:
            run.update(status="interrupted")
            raise
        except VisDomError:
            run.discard()
            raise
        except BaseException as error:
            run.update(status="failed", error=f"{type(error).__name__}: {error}")
            raise
        if found["metrics"]["target"]["missing"]:
            log.warning("no target: %s", NO_TARGET)
        timing = {"hull_s": found["hull_s"], "eval_s": seconds - found["hull_s"]}
        run.update(status="finished", timing=timing, metrics=finite(found["metrics"]))
        return run.record | {"already_finished": False}


NO_TARGET = (
    "the true surface of this scene is not known, so that there are no distances; put it beside the data as "
    "mesh.ply or meshes/<name>_<frame>.ply, or pass --method.target FILE"
)
