"""nerfacc's occupancy grid with cells that the hull closes, and rays that end at the hull.

Needs nerfacc 0.5.3 (`pip install -e ".[nerfacc]"`). nerfacc samples with CUDA kernels only: without a GPU
the rays are sampled evenly between their limits.

    python examples/05_nerfacc_estimator.py
"""

import nerfacc
import torch
import tyro

import visdom_plugin as vd
from visdom_plugin.integrations.nerfacc import confine, ray_limits
from visdom_plugin.losses import mask_loss
from visdom_plugin.training.batches import DataManager

CELLS, STEP, FAR = 48, 0.02, 8.0


def main(steps: int = 60, rays: int = 400, downscale: float = 4) -> None:
    """Fits a grid of densities to the masks of four views."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    scene = vd.load("builtin:watering-can", views=4, downscale=downscale)
    hull, batches = vd.carve(scene, resolution=128), DataManager(scene.train, seed=0, device=device)
    sampler = vd.VisDomSampler(hull, cameras=scene.train.cameras)
    low, high = (torch.as_tensor(x, dtype=torch.float32, device=device) for x in hull.extent)

    estimator = nerfacc.OccGridEstimator([*low.tolist(), *high.tolist()], resolution=CELLS).to(device)
    open_cells = confine(estimator, hull)  # cells beside the hull stay closed for good
    grid = torch.zeros(1, 1, CELLS, CELLS, CELLS, device=device, requires_grad=True)
    optimiser = torch.optim.Adam([grid], 0.3)

    def density(x):
        where = ((x - low) / (high - low) * 2 - 1)[None, None, None]
        raw = torch.nn.functional.grid_sample(grid, where, align_corners=True).reshape(-1)
        return torch.nn.functional.softplus(raw) * ((x > low) & (x < high)).all(-1)

    for step in range(steps):
        batch = batches.pixel_batch(step, rays)
        limits = ray_limits(sampler, batch.origins, batch.directions, near_plane=0.1)  # t_min and t_max
        estimator.update_every_n_steps(step, lambda x: density(x)[:, None] * STEP)
        if device == "cuda":
            ray, start, end = estimator.sampling(
                batch.origins, batch.directions, render_step_size=STEP, **limits
            )
        else:
            edges = torch.linspace(0, 1, 33) * (limits["t_max"].clamp(max=FAR) - limits["t_min"])[:, None]
            edges = edges + limits["t_min"][:, None]
            start, end, ray = edges[:, :-1].flatten(), edges[:, 1:].flatten(), torch.arange(rays * 32) // 32
        sigma = density(batch.origins[ray] + ((start + end) / 2)[:, None] * batch.directions[ray])
        depth = torch.zeros(rays, device=device).index_add(0, ray, sigma * (end - start))
        loss = mask_loss(1 - torch.exp(-depth), batch.mask)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    print(f"{open_cells} of {CELLS**3} cells may be occupied, {int(estimator.binaries.sum())} are")
    print(f"mask loss {loss.item():.3f}")


if __name__ == "__main__":
    tyro.cli(main)
