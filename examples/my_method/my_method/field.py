import torch

from visdom_plugin.methods.fields import common
from visdom_plugin.nerf.frame import frame_of
from visdom_plugin.nerf.optimiser import FieldOptimiser
from visdom_plugin.nerf.rendering.volume import composite, weights_from_density
from visdom_plugin.training.protocols import StepOutput


class Field:
    def __init__(self, config):
        self.config, self.total_steps, self.radius = config, config.steps, config.radius

    def setup(self, views, hooks, *, hull, device, seed):
        self.hooks, self.origin, self.frame = hooks, views.origin, frame_of(views.cameras)
        self.grid = torch.nn.Parameter(torch.zeros(1, 4, *3 * [self.config.resolution], device=device))
        self.optimiser = FieldOptimiser([({"grid": self.grid}, 0.0)], betas=(0.9, 0.99), eps=1e-15)

    def pixels_per_step(self, step):
        return self.config.rays

    def look(self, points):
        at = (points.to(self.grid.device) / self.radius).flip(-1).reshape(1, -1, 1, 1, 3)
        values = torch.nn.functional.grid_sample(self.grid, at, padding_mode="border", align_corners=True)
        return torch.exp(20 * values[0, 0, :, 0, 0] - 1), (10 * values[0, 1:, :, 0, 0]).T.sigmoid()

    def trace(self, origins, directions, background, hooks, training=False):
        nearest = -(self.frame.to_local(origins) * directions).sum(-1).float()
        near, far = (nearest - self.radius).clamp_min(0), (nearest + self.radius).clamp_min(0)
        o, d, near, far, hit = common.bound_rays(origins, directions, near, far, self.frame, hooks)
        t = near[:, None] + (far - near)[:, None] * torch.linspace(0, 1, self.config.samples + 1).to(near)
        density, rgb = self.look(o[:, None] + (t[:, 1:] + t[:, :-1])[..., None] / 2 * d[:, None])
        weights = weights_from_density(density.reshape(len(t), -1), t)[0] * (hit | training)[:, None]
        return composite(weights, rgb.reshape(len(t), -1, 3), t, background)

    def train_step(self, batch, step):
        white = torch.ones(3, device=self.grid.device)
        rgb, alpha, _ = self.trace(batch.origins, batch.directions, white, self.hooks, training=True)
        losses = {"colour": (rgb - common.photograph_on(white, batch, alpha)).square().mean()}
        return StepOutput(losses | {"mask": self.config.mask_weight * common.silhouette_loss(alpha, batch)})

    def optimise(self, step, output):
        self.optimiser.step(learning_rate=0.02)

    def render(self, camera, background):
        hooks = self.hooks if self.config.vd.hull_at_inference else []
        return common.render_image(camera, lambda *x: self.trace(*x, background, hooks), self.frame, 20000)

    def state_dict(self):
        return self.optimiser.state_dict()

    def load_state_dict(self, state):
        self.optimiser.load_state_dict(state)

    def export(self, folder):
        density, colour = lambda x: self.look(x)[0], lambda x, _: self.look(x)[1]
        mesh = common.mesh_density(density, colour, self.frame, self.radius, origin=self.origin)
        return common.export_mesh(folder / "mesh.ply", mesh)
