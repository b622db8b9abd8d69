"""A companion of gsplat's DefaultStrategy: four lines more in a trainer like gsplat's simple_trainer.py.

Needs gsplat (`pip install -e ".[cuda]"`). Here this package's rasteriser draws, so no GPU is
needed. On CUDA leave `render` out, and gsplat's rasteriser draws.

    python examples/04_gsplat_companion.py
"""

import torch
import tyro
from gsplat import DefaultStrategy

import visdom_plugin as vd
from visdom_plugin.integrations.gsplat import VisDomStrategy, info_of
from visdom_plugin.losses import composite_target, mask_loss
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.training.batches import DataManager

WHITE = torch.ones(3)


def draw(p, camera):
    """A view of gsplat's parameters."""
    sh = torch.cat([p["sh0"], p["shN"]], 1)
    return rasterise(
        Gaussians(p["means"], p["scales"], p["quats"], p["opacities"], sh), camera, WHITE, near=0.1
    )


def main(steps: int = 200, count: int = 2000, downscale: float = 2) -> None:
    """Trains Gaussians on four views; gsplat splits and removes them."""
    scene = vd.load("builtin:chair", views=4, downscale=downscale)
    hook = vd.VisDomGaussianRegularizer(vd.carve(scene), scene.train.cameras, images=scene.train.images)
    companion = VisDomStrategy(hook, render=lambda params, camera: draw(params, camera).alpha)

    xyz, rgb = companion.initial_points(count)
    colours = {"sh0": ((rgb - 0.5) / 0.28209479)[:, None], "shN": torch.zeros(count, 3, 3)}
    start = {"means": xyz, "scales": torch.full((count, 3), -3.5), **colours}
    start |= {"quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), "opacities": torch.full((count,), -2.2)}
    params = torch.nn.ParameterDict(start)
    optimizers = {name: torch.optim.Adam([p], lr=5e-3, eps=1e-15) for name, p in params.items()}
    strategy = DefaultStrategy(refine_start_iter=steps // 2, refine_every=steps // 4)
    state = companion.initialize_state(strategy.initialize_state(scene_scale=1.0))  # new

    batches = DataManager(scene.train, seed=0)
    for step in range(steps):
        view = batches.view_batch(step)
        picture = draw(params, view.camera)
        info = info_of(picture)  # what gsplat's rasterization() returns as its third value
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (picture.rgb - composite_target(view.image, view.mask, WHITE)).abs().mean()
        loss = loss + 0.1 * mask_loss(picture.alpha, view.mask)  # new
        loss = loss + companion.step_pre_backward(params, optimizers, state, step, info)  # new
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, info)
        companion.step_post_backward(params, optimizers, state, step, info)  # new
    print(f"{count} Gaussians became {len(params['means'])}; loss {loss.item():.4f}")


if __name__ == "__main__":
    tyro.cli(main)
