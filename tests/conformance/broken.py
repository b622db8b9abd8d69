"""Methods that break one promise each; and two that break none, of which the others are made.

Named by VISDOM_METHODS, as a stranger's code is before it is installed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from my_method.field import Field as WholeField

from method_configs import gs_go
from tests.conformance.whole import HULL, built_in, splat_presets
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hooks.protocols import RayBounds
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.registry import MethodSpec, Preset, SamplerMethodConfig

BROKEN: dict[str, str] = {}
"""Name of the broken method to the check that it fails."""
CLASSES: dict[str, tuple[type, type | None]] = {}
"""Name to its class, and the class of its own settings of the hook."""


def breaks(check: str, vd: type | None = None):
    """Registers a class as breaking one check."""

    def take(broken: type) -> type:
        BROKEN[broken.__name__], CLASSES[broken.__name__] = check, (broken, vd)
        return broken

    return take


@dataclass(frozen=True)
class TinyField(SamplerMethodConfig):
    steps: int = 24
    rays: int = 96
    samples: int = 16
    resolution: int = 16
    radius: float = 0.4


@dataclass(frozen=True)
class DroppingField(TinyField):
    """Says of its method that it drops single samples."""

    drops_samples: ClassVar[bool] = True


class Field(WholeField):
    """Whole but for the mesh, which takes longest."""

    settings = TinyField

    def export(self, folder):
        np.save(folder / "grid.npy", self.grid.detach().cpu().numpy())
        return [folder / "grid.npy"]


def changed(output, **losses):
    """A step's output with some losses replaced."""
    return replace(output, losses={**output.losses, **losses})


@breaks("test_the_schedule_has_a_length")
class FractionalLength(Field):
    def __init__(self, config):
        super().__init__(config)
        self.total_steps = config.steps / 7


@breaks("test_losses_are_named_finite_scalars")
class NotANumber(Field):
    def train_step(self, batch, step):
        return changed(super().train_step(batch, step), depth=torch.tensor(float("nan")))


@breaks("test_batches_are_left_as_they_were")
class Painter(Field):
    def train_step(self, batch, step):
        batch.rgb.clamp_(max=0.5)
        return super().train_step(batch, step)


@breaks("test_renders_have_the_promised_shapes_and_ranges")
class DeepDepth(Field):
    def render(self, camera, background):
        shown = super().render(camera, background)
        return replace(shown, depth=shown.depth[..., None])


@breaks("test_the_background_shows_where_nothing_is")
class BlackBackground(Field):
    def render(self, camera, background):
        return super().render(camera, torch.zeros_like(background))


@breaks("test_rendering_leaves_no_trace")
class Watched(Field):
    def render(self, camera, background):
        self.grid.data += 1e-6
        return super().render(camera, background)


@breaks("test_exported_files_can_be_read")
class TornMesh(Field):
    def export(self, folder):
        (folder / "mesh.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vert")
        return [folder / "mesh.ply"]


@breaks("test_devices_and_dtypes_are_respected")
class DoubleOnly(Field):
    def render(self, camera, background):
        camera.world_from_camera @ torch.eye(4, dtype=torch.float64)
        return super().render(camera, background)


@breaks("test_randomness_comes_from_seed_and_step_alone")
class Gambler(Field):
    def train_step(self, batch, step):
        output = super().train_step(batch, step)
        return changed(output, colour=output.losses["colour"] * (1 + torch.rand(())))


@breaks("test_a_resumed_run_equals_the_uninterrupted_one")
class Forgetful(Field):
    def state_dict(self):
        return {"grid": self.grid.detach()}


@breaks("test_the_hook_switched_off_is_the_bare_method")
class HullLover(Field):
    def setup(self, views, hooks, *, hull, device, seed):
        super().setup(views, hooks, hull=hull, device=device, seed=seed)
        if hull is not None:
            self.grid.data -= 0.01


@breaks("test_the_hook_enabled_but_not_there_is_the_hook_switched_off")
class ConfigReader(Field):
    def train_step(self, batch, step):
        output = super().train_step(batch, step)
        return changed(output, colour=(2 if self.config.vd.enabled else 1) * output.losses["colour"])


@breaks("test_rays_are_sampled_within_their_bounds_only")
class HitOnly(Field):
    """Leaves out the rays that miss, but samples the others to their own far end."""

    def setup(self, views, hooks, **rest):
        super().setup(views, [Around(hook, self.open) for hook in hooks], **rest)

    @staticmethod
    def open(bounds, far):
        return bounds._replace(far=torch.where(bounds.hit, far, bounds.far))


@breaks("test_opacity_outside_the_hull_falls")
class Hazy(Field):
    """Shows a haze where nothing is, but only with its hooks, and without the hull at inference."""

    def render(self, camera, background):
        shown = super().render(camera, background)
        hazy = self.hooks and not self.config.vd.hull_at_inference
        haze = 0.8 * (1 - shown.alpha) if hazy else torch.zeros_like(shown.alpha)
        return replace(shown, rgb=shown.rgb - haze[..., None] * background, alpha=shown.alpha + haze)


class ToldSo(Field):
    """Renders as it is told to by itself, whatever the settings say."""

    told: bool

    def render(self, camera, background):
        config = self.config
        # A bare config has no hull to be told of.
        told = self.told and config.hull is not None
        self.config = replace(config, vd=replace(config.vd, hull_at_inference=told))
        shown = super().render(camera, background)
        self.config = config
        return shown


@breaks("test_the_hull_has_no_part_in_novel_views_unless_asked_for")
class AlwaysInside(ToldSo):
    told = True


@breaks("test_the_hull_at_inference_bounds_novel_views")
class NeverInside(ToldSo):
    told = False


@breaks("test_the_hull_at_inference_bounds_novel_views")
class ShowsMisses(Field):
    """Bounds the rays of novel views, but shows what is along those that miss the hull."""

    def trace(self, *rays, training=False):
        return super().trace(*rays, training=True)


@breaks("test_samples_outside_the_hull_are_dropped_where_the_setting_is_taken")
class KeepsAll(Field):
    settings = DroppingField


class Around:
    """A sampler whose answers are changed."""

    def __init__(self, hook, change):
        self.hook, self.change = hook, change

    def bound(self, origins, directions, near, far):
        return self.change(self.hook.bound(origins, directions, near, far), far)


@dataclass(frozen=True)
class OwnSampler(SamplerConfig):
    """Settings that build another hook, each of which breaks a promise of hooks."""

    def build(self, hull, views):
        hook = super().build(hull, views)
        changed = type(self).changed
        return type("Own", (), {"bound": lambda _, *rays, **named: changed(self, hook, *rays, **named)})()


class Meddling(OwnSampler):
    def changed(self, hook, origins, directions, near, far):
        far *= 0.999
        return hook.bound(origins, directions, near, far)


class Moody(OwnSampler):
    last = torch.zeros(0)

    def changed(self, hook, origins, directions, near, far):
        asked_again = torch.equal(Moody.last, directions)
        Moody.last = torch.zeros(0) if asked_again else directions.clone()
        near, far, hit = hook.bound(origins, directions, near, far)
        return RayBounds(near, near + 0.99 * (far - near) if asked_again else far, hit)


class Dicing(OwnSampler):
    def changed(self, hook, origins, directions, near, far):
        torch.rand(())
        return hook.bound(origins, directions, near, far)


class Doubling(OwnSampler):
    def changed(self, hook, origins, directions, near, far):
        near, far, hit = hook.bound(origins, directions, near, far)
        return RayBounds(near.double(), far.double(), hit)


for settings, check in (
    (Meddling, "test_the_hook_leaves_what_it_is_handed"),
    (Moody, "test_the_hook_answers_alike_twice"),
    (Dicing, "test_the_hook_draws_no_global_random_numbers"),
    (Doubling, "test_the_hook_keeps_dtype_shape_and_order"),
):
    breaks(check, settings)(type(f"With{settings.__name__}", (Field,), {}))


class Changed:
    """A hook for Gaussians, one of its answers lost."""

    def __init__(self, hook, **changes):
        self.hook, self.changes = hook, changes

    def __getattr__(self, name):
        return self.changes.get(name) or getattr(self.hook, name)


@breaks("test_gaussians_begin_at_the_hooks_points")
class OwnPoints(GsGo):
    def setup(self, views, hooks, *, hull, **rest):
        def elsewhere(n, draw):
            for hook in hooks:
                hook.initial_points(n, draw)
            xyz = hull.sample_inside(n, draw).float()
            return xyz, torch.full_like(xyz, 0.5)

        super().setup(views, [Changed(hook, initial_points=elsewhere) for hook in hooks], hull=hull, **rest)


@breaks("test_the_hooks_losses_take_part")
class LossLoser(GsGo):
    def setup(self, views, hooks, **rest):
        super().setup(views, hooks, **rest)
        self.hooks = [Changed(h, loss=lambda *x, h=h: (h.loss(*x), {})[1]) for h in hooks]


@breaks("test_gaussians_marked_by_the_hook_are_removed")
class Hoarder(GsGo):
    def setup(self, views, hooks, **rest):
        super().setup(views, hooks, **rest)
        self.hooks = [Changed(h, after_step=lambda *x, h=h: (h.after_step(*x), None)[1]) for h in hooks]


def _field_spec(name: str, target: str, settings: type, vd: type | None) -> MethodSpec:
    own = {} if vd is None else {"vd": vd(enabled=True)}
    return MethodSpec(
        name, target, settings(), hook="sampler", variants={"mask": {}, "vd": {"hull": HULL} | own}
    )


def _methods() -> list[MethodSpec | Preset]:
    found: list[MethodSpec | Preset] = [_field_spec("SmallField", "my_method.field:Field", TinyField, None)]
    for name, (broken, vd) in CLASSES.items():
        target = f"{__name__}:{name}"
        globals().setdefault(name, broken)
        found += (
            splat_presets(name, target, gs_go)
            if issubclass(broken, GsGo)
            else [_field_spec(name, target, broken.settings, vd)]
        )
    return found + built_in()


METHODS = _methods()
