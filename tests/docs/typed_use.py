"""A trainer's use of the public names, every value with the type that a type checker must find for it."""

import numpy as np
from torch import Tensor
from typing_extensions import assert_type

from visdom_plugin import (
    Cameras,
    EmptyHullError,
    Hull,
    Rays,
    Render,
    Run,
    Scene,
    Views,
    VisDomError,
    VisDomGaussianRegularizer,
    VisDomSampler,
    VisibleDomain,
    carve,
    check,
    load,
    open_run,
    save_image,
    train,
)
from visdom_plugin.losses import mask_loss


def carve_arrays(K: np.ndarray, motion: np.ndarray, masks: list[Tensor]) -> Hull:
    cameras = Cameras.from_matrices(K, motion, width=64, height=48, convention="opencv")
    assert_type(cameras, Cameras)
    try:
        return VisibleDomain(k=3).carve(cameras, masks)
    except EmptyHullError as error:
        refused: VisDomError = error
        raise refused from None


def bound(hull: Hull, rays: Rays) -> Tensor:
    near, far, hit = VisDomSampler(hull)(rays.origins, rays.directions, 0.0, 9.0)
    assert_type(near, Tensor)
    assert_type(hit, Tensor)
    return far - near


def regularise(hull: Hull, views: Views, render: Render) -> Tensor:
    hook = VisDomGaussianRegularizer(hull, views.cameras)
    xyz, rgb = hook.initial_points(20_000)
    assert_type(rgb, Tensor)
    losses = hook.loss(lambda camera: render)
    assert_type(losses, dict[str, Tensor])
    return xyz.sum() + mask_loss(render.alpha, render.alpha) + sum(losses.values())


def test_cameras(scene: Scene) -> Cameras:
    return scene.test.cameras


def reconstruct(folder: str) -> dict[str, float]:
    scene = load(folder, views=4)
    assert_type(scene, Scene)
    assert_type(carve(scene), Hull)
    todo: list[str] = [finding.todo for finding in check(scene)]
    run = train("3dgs-go+vd", scene, out="run", steps=len(todo))
    assert_type(run, Run)
    save_image("view.png", run.render(scene.test.cameras[0]))
    return open_run("run").evaluate()
