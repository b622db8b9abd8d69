"""The built-in methods as the kit meets them: with coarse hulls, few Gaussians or rays, small networks."""

from __future__ import annotations

from dataclasses import replace

from method_configs import (
    corgs_lite,
    fsgs_lite,
    gs_go,
    ingp,
    splatfields_lite,
    visdom_field,
    visdom_gs,
    zerorf_lite,
    zipnerf_lite,
)
from visdom_plugin.hooks.configs import RegularizerConfig, SamplerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.specs import Preset

HULL = VisibleDomain(resolution=48, dilate_px=1)
SMALL_SPLATS = {"steps": 24, "initial_points": 400, "max_gaussians": 600}
SMALL_INGP = {
    "steps": 40,
    "max_rays": 256,
    "samples_per_step": 1 << 12,
    "step_length": 0.03,
    "missing_step_length": 0.2,
    "grid": HashLayout(4, 2, base_resolution=8, max_resolution=64, log2_table_size=12),
    "occupancy_resolution": 32,
}


def splat_presets(
    name: str, target: str, module, *, mask_weight: float = 1.0, weight: float = 0.1, **small
) -> list[Preset]:
    bare = replace(module.SPEC.quick, **SMALL_SPLATS, **small, mask_weight=0.0)
    regularizer = RegularizerConfig(enabled=True, weight=weight, prune_every=10, bank=4)
    # Wide, as the bare methods' hull is: it is the losses' doing that opacity falls.
    vd = replace(bare, mask_weight=mask_weight, hull=HULL, vd=regularizer, lr_opacity=0.1)
    return [Preset(name, "", target, bare, bare), Preset(f"{name}+vd", "", target, vd, vd)]


def field_presets(name: str, target: str, module, **small) -> list[Preset]:
    bare = replace(module.SPEC.quick, **small)
    vd = replace(bare, mask_weight=0.1, background="random", hull=HULL, vd=SamplerConfig(enabled=True))
    return [Preset(name, "", target, bare, bare), Preset(f"{name}+vd", "", target, vd, vd)]


def recipe(name: str, module, small: dict) -> Preset:
    """A method that has no variant without the hook."""
    (whole,) = module.SPEC.presets().values()
    config = replace(whole.quick, **small, hull=HULL)
    return Preset(name, "", whole.target, config, config)


def built_in() -> list[Preset]:
    """Bare and with the hook, where there is a bare variant."""
    found: list[Preset] = []
    found += splat_presets("SmallGsGo", "visdom_plugin.methods.splats.gs_go:GsGo", gs_go)
    found += splat_presets("SmallCorgs", "visdom_plugin.methods.splats.corgs_lite:CorgsLite", corgs_lite)
    found += splat_presets("SmallFsgs", "visdom_plugin.methods.splats.fsgs.method:FsgsLite", fsgs_lite)
    splatfields = "visdom_plugin.methods.splats.splatfields.method:SplatFieldsLite"
    # Bare it starts in the masks' own hull, and has a mask loss; here in the same wide one. A field cannot shrink
    # single Gaussians: in few steps it takes a stronger L_i, beside a mask loss that does not drown it.
    narrow = {
        "noise_size": 2,
        "decoder_width": 4,
        "lr_field": 1e-2,
        "lr_field_final": 1e-3,
        "lr_field_steps": 24,
    }
    found += splat_presets(
        "SmallSplatFields", splatfields, splatfields_lite, mask_weight=0.1, weight=1.0, hull=HULL, **narrow
    )
    found.append(
        recipe("SmallVisdomGs", visdom_gs, SMALL_SPLATS | {"vd": RegularizerConfig(enabled=True, bank=4)})
    )
    found += field_presets("SmallIngp", "visdom_plugin.methods.fields.ingp:Ingp", ingp, **SMALL_INGP)
    found.append(recipe("SmallVisdomField", visdom_field, SMALL_INGP))
    grid = SMALL_INGP["grid"]
    found += field_presets(
        "SmallZipNerf",
        "visdom_plugin.methods.fields.zipnerf_lite:ZipNerfLite",
        zipnerf_lite,
        steps=40,
        rays=128,
        samples=(12, 12, 8),
        test_samples=(12, 12, 8),
        density_bias=-2.0,
        coarse_grid=replace(grid, levels=3, features=1),
        fine_grid=replace(grid, levels=3, features=1),
        grid=replace(grid, features=4),
    )
    found += field_presets(
        "SmallZeroRf",
        "visdom_plugin.methods.fields.zerorf_lite:ZeroRfLite",
        zerorf_lite,
        steps=40,
        first_rays=128,
        rays=256,
        step_length=0.06,
        missing_step_length=0.12,
        noise_resolution=2,
        width=4,
        occupancy_resolution=32,
    )
    return found


WHOLE = (
    "SmallField",
    "SmallGsGo",
    "SmallCorgs",
    "SmallFsgs",
    "SmallSplatFields",
    "SmallVisdomGs",
    "SmallIngp",
    "SmallVisdomField",
    "SmallZipNerf",
    "SmallZeroRf",
)
"""Those that break nothing: the example and the built-in methods, small."""
