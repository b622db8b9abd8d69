"""The loss L_i in a Gaussian splatting loop: start inside the hull, stay inside it, drop what leaves it.

The loop is as simple as possible and uses this package's rasteriser; any renderer with gradients will do. It is
too short for the loss to help: the saved view has 23.2 dB with the loss and 23.4 without. What helps here is the
start in the hull.

    python examples/03_l_i_in_a_splat_loop.py
    python examples/03_l_i_in_a_splat_loop.py --weight 0     # without the loss
"""

import torch
import tyro

import visdom_plugin as vd
from visdom_plugin.losses import composite_target, mask_loss
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.metrics import psnr, whiten

WHITE = torch.ones(3)
RATES = {"means": 2e-3, "log_scales": 1e-2, "quaternions": 2e-3, "opacity_logits": 5e-2, "sh": 1e-2}


def main(steps: int = 300, count: int = 3000, downscale: float = 2, weight: float = 0.01) -> None:
    """Trains `count` Gaussians on four views; `weight` is that of L_i."""
    scene = vd.load("builtin:figure", views=4, downscale=downscale)
    hull, batches, views = vd.carve(scene), DataManager(scene.train, seed=0), scene.train
    hook = vd.VisDomGaussianRegularizer(hull, views.cameras, images=views.images, weight=weight)
    xyz, rgb = hook.initial_points(count)  # in the hull, with the photographs' colours
    parameters = {
        "means": xyz,
        "log_scales": torch.full((count, 3), (hull.volume / count) ** (1 / 3) / 2).log(),
        "quaternions": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "opacity_logits": torch.zeros(count),
        "sh": ((rgb - 0.5) / 0.28209479)[:, None],
    }
    groups = [{"params": [p.requires_grad_()], "lr": RATES[name]} for name, p in parameters.items()]
    optimiser = torch.optim.Adam(groups, eps=1e-15)

    def render(camera):
        return rasterise(Gaussians(**parameters), camera, WHITE, near=0.1)

    for step in range(1, steps + 1):
        view = batches.view_batch(step)
        picture = render(view.camera)
        loss = (picture.rgb - composite_target(view.image, view.mask, WHITE)).abs().mean()
        loss = loss + 0.1 * mask_loss(picture.alpha, view.mask)
        loss = loss + sum(hook.loss(render).values())  # L_i, seen from between two cameras
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        outside = hook.after_step(Gaussians(**parameters), step=step)  # (N,) bool every 50th step, or None
        if outside is not None:
            parameters["opacity_logits"].data[outside] = -10.0  # a trainer that can would remove them

    picture = render(scene.test.cameras[0])
    found = psnr(picture.rgb.detach(), whiten(scene.test.images[0], scene.test.masks[0]))
    print(f"PSNR of an unseen view: {found:.2f} dB")
    vd.save_image("splats.png", picture)


if __name__ == "__main__":
    tyro.cli(main)
