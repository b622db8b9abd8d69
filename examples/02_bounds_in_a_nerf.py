"""The visible domain in a small NeRF: three lines of it are ours.

A network maps positions to density and colour. With the hull, training rays are sampled inside the visible
domain, and the mask loss clears what lies outside. `--no-hull` trains the same network without it. This network is
so small and smooth that it hardly makes fog, and so it gains nothing (23.8 dB with the hull, 24.0 without). A hash
grid, as in `method:ingp`, gains 9 dB (docs/findings/methods.md).

    python examples/02_bounds_in_a_nerf.py
    python examples/02_bounds_in_a_nerf.py --no-hull
"""

from itertools import pairwise

import torch
import tyro

import visdom_plugin as vd
from visdom_plugin.geometry.cameras import look_at_point, rays_of
from visdom_plugin.losses import composite_target, mask_loss
from visdom_plugin.nerf.rendering.volume import composite, weights_from_density
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.metrics import psnr, whiten

NEAR, FAR, SAMPLES, WHITE = 2.0, 8.0, 48, torch.ones(3)


def main(steps: int = 1000, rays: int = 512, downscale: float = 2, hull: bool = True) -> None:
    """Trains on four views and measures one that was not seen; `hull` confines the rays."""
    torch.manual_seed(0)
    scene = vd.load("builtin:duck", views=4, downscale=downscale)
    centre, batches = look_at_point(scene.train.cameras).float(), DataManager(scene.train, seed=0)
    layers = [(torch.nn.Linear(n, m), torch.nn.ReLU()) for n, m in pairwise((39, 96, 96, 4))]
    network = torch.nn.Sequential(*sum(layers, ())[:-1])
    sampler = vd.VisDomSampler(vd.carve(scene), cameras=scene.train.cameras) if hull else None  # ours

    def draw(origins, directions, near, far):
        near, far = (torch.as_tensor(x)[..., None] for x in (near, far))
        t = torch.linspace(0, 1, SAMPLES + 1) + (torch.rand(len(origins), 1) - 0.5) / SAMPLES
        t = near + t.clamp(0, 1) * (far - near)
        points = origins[:, None] + (t[:, 1:] + t[:, :-1])[..., None] / 2 * directions[:, None]
        x = (points - centre) / 1.5
        raw = network(torch.cat([x, *(f(2**i * x) for i in range(6) for f in (torch.sin, torch.cos))], -1))
        weights, _ = weights_from_density(8 * torch.nn.functional.softplus(raw[..., 0] - 1), t)
        return composite(weights, raw[..., 1:].sigmoid(), t, WHITE)

    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    for step in range(steps):
        batch = batches.pixel_batch(step, rays)
        bounds = (NEAR, FAR)
        if sampler is not None:
            bounds = sampler(batch.origins, batch.directions, NEAR, FAR)[:2]  # ours
        rgb, opacity, _ = draw(batch.origins, batch.directions, *bounds)
        loss = (rgb - composite_target(batch.rgb, batch.mask, WHITE)).square().mean()
        loss = loss + 0.1 * mask_loss(opacity, batch.mask)  # ours
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    with torch.no_grad():  # novel views keep near and far
        origins, directions = (x.reshape(-1, 3).float() for x in rays_of(scene.test.cameras[3]))
        rgb = draw(origins, directions, NEAR, FAR)[0].reshape(scene.test.images[3].shape)
    print(f"PSNR of an unseen view: {psnr(rgb, whiten(scene.test.images[3], scene.test.masks[3])):.2f} dB")
    vd.save_image("nerf.png", rgb)


if __name__ == "__main__":
    tyro.cli(main)
