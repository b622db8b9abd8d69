"""The one door to data: recognises a folder's layout and loads it."""

from __future__ import annotations

from pathlib import Path

from visdom_plugin.errors import SceneError
from visdom_plugin.scene import Scene

_LAYOUT = "sparse/0 (COLMAP model), images, masks, sparse_<N>.txt, sparse_test.txt"


def load(
    path: str | Path | None,
    *,
    views: int | None = None,
    downscale: float = 1,
    seed: int = 0,
    test: bool = True,
) -> Scene:
    """Opens a scene.

    Args:
        path: the scene's folder; None is the built-in scene.
        views: number of training views; None takes the smallest the data offers (4 for the built-in scene).
        downscale: >= 1, how much smaller than the photographs to work.
        seed: of the built-in scene's noise; real data does not depend on it.
        test: False leaves the test views out, for callers that do not evaluate.

    Returns:
        Scene with train and test views, cameras float64 on the CPU.

    Raises:
        SceneError: for every fault of the data, a missing folder or an unknown layout.
        ConfigError: for `views` or `downscale` out of range.
    """
    if path is None:
        from datamodules.synthetic import SyntheticConfig, make_scene

        wanted = {} if views is None else {"train_views": views}
        return make_scene(
            SyntheticConfig(downscale=downscale, seed=seed, **wanted, **({} if test else {"test_views": 0}))
        )
    root = Path(path)
    try:
        root = root.expanduser()
        exists, is_folder = root.exists(), root.is_dir()
    except (OSError, ValueError, RuntimeError):
        exists = is_folder = False
    if not is_folder:
        raise SceneError(
            "this is a file, not a folder" if exists else "there is no such folder",
            where=root,
            todo="pass --data with the folder of a scene, or leave it out for the built-in scene",
        )
    from datamodules import prepared

    if prepared.matches(root):
        return prepared.load_prepared(root, views=views, downscale=downscale, test=test)
    raise SceneError(
        "this folder is not a scene of a known layout",
        where=root,
        cause=_guess(root),
        todo=f"pass a folder with {_LAYOUT}",
    )


def _guess(root: Path) -> str:
    inside = [p.name for p in sorted(root.iterdir()) if p.is_dir()]
    for name in inside:
        if (root / name / "sparse").is_dir():
            return f"one level too high: {root / name} looks like a scene"
    if root.name in ("images", "masks", "sparse", "0"):
        return "one level too deep: the scene is the folder above"
    return f"it holds none of {_LAYOUT}" if any(root.iterdir()) else "it is empty"
