"""Settings of the splatting methods out of range are named before anything is built."""

import subprocess
import sys
from dataclasses import fields, replace

import pytest

from method_configs import corgs_lite, gs_go
from visdom_plugin.cli import options
from visdom_plugin.errors import ConfigError
from visdom_plugin.methods.splats.configs import CorgsConfig, GsGoConfig
from visdom_plugin.methods.splats.fsgs.config import FsgsConfig
from visdom_plugin.methods.splats.splatfields.config import SplatFieldsConfig
from visdom_plugin.splat.set_config import GaussianSetConfig

SHARED = {
    "steps": -1,
    "initial_points": 0,
    "max_gaussians": 0,
    "sh_degree": 4,
    "sh_every": 0,
    "ssim_weight": 1.5,
    "mask_weight": -0.1,
    "lr_means": 0.0,
    "lr_means_final": float("nan"),
    "lr_means_steps": 0,
    "lr_sh": -1.0,
    "lr_opacity": float("inf"),
    "lr_scale": 0.0,
    "lr_rotation": 0.0,
    "densify_from": -1,
    "densify_until": -1,
    "densify_every": 0,
    "densify_gradient": -1e-4,
    "densify_scale": 0.0,
    "prune_opacity": 1.0,
}
BOTH = {"dropout": 1.0, "virtual_weight": -1.0}
OWN = {
    GsGoConfig: {
        "depth_weight": -1.0,
        "prune_large_from": -1,
        "prune_radius": 0.0,
        "prune_radius_px": 0.0,
        "prune_scale": 0.0,
        "opacity_reset_every": -1,
        "floater_every": -1,
        "floater_sigmas": (1.0, -1.0),
    },
    CorgsConfig: {
        "opacity_reset_from": -1,
        "opacity_reset_every": -1,
        "pseudo_from": -1,
        "pseudo_until": -1,
        "pseudo_every": -1,
        "pseudo_weight": -1.0,
        "co_prune_every": -1,
        "co_prune_extents": 0.0,
        "co_prune_world": 0.0,
    },
    FsgsConfig: {
        "opacity_reset_from": -1,
        "opacity_reset_every": -1,
        "unpool_until": -1,
        "unpool_distance": 0.0,
        "unpool_scale": -1.0,
        "unpool_split_distance": 0.0,
        "depth_weight": -1.0,
        "depth_weight_late": -1.0,
        "depth_until": -1,
        "pseudo_from": -1,
        "pseudo_until": -1,
        "pseudo_every": -1,
        "pseudo_weight": -1.0,
        "pseudo_ramp": -1,
    },
    SplatFieldsConfig: {
        "noise_channels": 0,
        "noise_size": 0,
        "plane_channels": 0,
        "decoder_width": 0,
        "mlp_depth": 0,
        "mlp_width": 0,
        "lr_field": 0.0,
        "lr_field_final": -1.0,
        "lr_field_steps": 0,
        "mask_l1_weight": -1.0,
        "norm_weight": -1.0,
        "moran_weight": -1.0,
    },
}
WRONG = [
    (kind, name, value) for kind, own in OWN.items() for name, value in (SHARED | BOTH | own).items()
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "value"), WRONG, ids=lambda x: getattr(x, "__name__", str(x)))
def test_a_setting_out_of_range_is_named_with_its_range(kind, name, value):
    with pytest.raises(ConfigError, match=rf"{name} = .*out of range") as refused:
        replace(kind(), **{name: value})
    assert kind.__name__ in refused.value.where and "choose" in refused.value.todo


@pytest.mark.parametrize("kind", list(OWN))
def test_every_number_has_a_range(kind):
    numbers = {f.name for f in fields(kind) if "int" in str(f.type) or "float" in str(f.type)}
    assert numbers == set(SHARED) | set(BOTH) | set(OWN[kind])
    assert {f.name for f in fields(GaussianSetConfig)} - {"background"} == set(SHARED)


def test_what_is_switched_off_is_in_range():
    replace(
        corgs_lite.SPEC.quick, pseudo_every=0, co_prune_every=0, opacity_reset_every=0, co_prune_world=None
    )
    replace(gs_go.SPEC.quick, floater_every=0, opacity_reset_every=0, depth_weight=0.0, densify_gradient=0.0)


@pytest.mark.parametrize(
    "words",
    [
        ["method:corgs", "--method.co-prune-extents", "-1"],
        ["method:corgs-lite+vd", "--method.ssim-weight", "2"],
        ["method:3dgs-go", "--method.densify-every", "0"],
        ["method:fsgs", "--method.depth-network", "my_depth"],
    ],
)
def test_the_command_line_refuses_it_too(words):
    name = words[1].removeprefix("--method.").replace("-", "_")
    with pytest.raises(ConfigError, match=f"{name} = .*out of range") as refused:
        options.parse([*words, "--device", "cpu"])
    assert words[1] in refused.value.where


def test_settings_load_without_torch():
    code = (
        "import sys\n"
        "from method_configs import corgs_lite, fsgs_lite, gs_go, splatfields_lite\n"
        "print([m for m in ('torch', 'numba', 'cv2', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
