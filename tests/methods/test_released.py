"""The authors' recipe as presets: what they set, and the settings of ours that exist for them."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from method_configs import gs_go, zipnerf_lite
from tests.methods.fields.test_nerf_methods import HULL, SMALL, start
from visdom_plugin import registry
from visdom_plugin.cli import options
from visdom_plugin.cli.commands import table
from visdom_plugin.cli.runs import default_run_dir
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.losses import mask_loss
from visdom_plugin.methods.fields.zipnerf_lite import ZipNerfLite
from visdom_plugin.training.batches import DataManager

from .fields.test_nerf_methods import hull, scene  # noqa: F401  # fixtures

NAMES = ("3dgs-go+vd:released", "3dgs-go+vd:released-omni3d-4", "zipnerf-lite+vd:released")


@pytest.mark.parametrize("name", NAMES)
def test_the_command_line_takes_them_literally(name):
    request = options.parse([f"method:{name}", "--budget", "full"])
    assert request.preset is registry.find(name) and request.config == request.preset.full
    assert ":" not in str(default_run_dir("scene", 4, name, 0))


def test_tables_take_them_literally(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"  - {{label: row {i}, method: {name}}}\n" for i, name in enumerate(NAMES))
    parts = ("k", "agreement", "resolution", "components", "bounds_scale", "bounds_capture_radii")
    varies = f"[{', '.join('hull.' + part for part in parts)}]"
    Path("t.yaml").write_text(
        f"title: T\nmetrics: [psnr]\nvaries: {varies}\nrows:\n{rows}columns: [{{label: c}}]\n"
    )
    assert table.main(["t.yaml", "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "3 jobs, 3 runs" in shown
    assert not any(":" in line.split("  ")[-1] for line in shown.splitlines() if line.startswith("run "))


def test_a_hull_for_the_loss_alone_can_be_given_to_any_preset(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("method: 3dgs-go+vd\nsettings: {vd: {loss_hull: {k: 2}}}\n")
    config = options.parse(["--config", str(file)]).config
    assert config.vd.loss_hull == VisibleDomain(k=2)
    assert config == replace(
        config, vd=replace(gs_go.SPEC.presets()["3dgs-go+vd"].quick.vd, loss_hull=VisibleDomain(k=2))
    )


def test_splats_have_what_the_release_sets():
    full = registry.find("3dgs-go+vd:released").full
    assert full.steps == 10_000 and full.sh_degree == 3 and full.floater_every == 500
    assert full.hull == VisibleDomain(
        k="n-1", agreement=1.0, resolution=64, bounds_scale=2.0, components="all", dilate_px=0
    )
    assert (full.vd.views, full.vd.points, full.vd.prune_every, full.vd.every) == (
        "midpoints",
        "voxels",
        0,
        1,
    )
    assert full.vd.loss_hull == VisibleDomain(
        k=4, agreement=1.0, resolution=512, bounds_capture_radii=2.0, components="largest", dilate_px=0
    )
    assert (full.mask_weight, full.vd.weight) == (0.1, 0.01)
    reversed_weights = registry.find("3dgs-go+vd:released-omni3d-4").full
    assert (reversed_weights.mask_weight, reversed_weights.vd.weight) == (0.01, 1.0)
    assert replace(reversed_weights, mask_weight=0.1, vd=full.vd) == full
    assert gs_go.SPEC.presets()["3dgs-go+vd"].full.floater_every == 0


def test_fields_have_what_the_release_sets():
    full = registry.find("zipnerf+vd:released").full
    assert full.hull == gs_go.RELEASED_LOSS_HULL
    vd = full.vd
    assert (vd.interval, vd.epsilon_capture_radii, vd.front_share) == ("first_hit", 0.2, 0.5)
    assert (vd.missing, vd.hull_at_inference) == ("full", False)
    assert (vd.virtual_views, vd.virtual_weight) == ("midpoints", 0.1)
    assert full.rays * (1 + vd.virtual_rays) == 8_192
    assert (full.steps, round(full.few_views_share * full.steps), full.few_views) == (25_000, 6_000, 4)
    assert (full.lr, full.lr_final, full.lr_warm_up, full.lr_delay) == (0.01, 0.001, 5_000, 1e-8)
    assert (full.samples, full.near, full.far, full.spacing_power) == ((24, 24, 64), 0.0, 5.0, 1.0)
    assert (full.hash_decay, full.distortion_weight, full.interlevel_weight) == (10.0, 0.005, 0.01)
    assert (full.mask_weight, full.proposal_mask_share, full.mask_clamp) == (0.1, 0.1, 0.001)
    assert (full.background, full.view_degree) == ("white", 4)
    # Nothing would pull on a field that starts emptier than the clamp.
    quick = registry.find("zipnerf+vd:released").quick
    assert quick.density_bias == full.density_bias > math.log(quick.mask_clamp)
    assert zipnerf_lite.SPEC.presets()["zipnerf-lite+vd"].full.background == "random"


@pytest.mark.parametrize(("views", "steps"), [(3, 60), (4, 60), (5, 240)])
def test_few_views_train_for_a_share_of_the_schedule(scene, hull, views, steps):  # noqa: F811
    few = replace(SMALL[ZipNerfLite], few_views_share=0.25, vd=SamplerConfig())
    whole = scene.train.take([*range(len(scene.train)), 0][:views])
    method = ZipNerfLite(few)
    method.setup(
        replace(whole, names=list("abcdef")[:views]), [], hull=hull, device=torch.device("cpu"), seed=0
    )
    assert method.total_steps == steps and method.config.steps == 240


def test_proposals_may_follow_the_masks(scene, hull):  # noqa: F811
    batch = DataManager(scene.train, 0).pixel_batch(0, 64)
    plain, clamped, shared = (
        start(ZipNerfLite, scene, hull, replace(SMALL[ZipNerfLite], **changes))
        for changes in ({}, {"mask_clamp": 0.2}, {"proposal_mask_share": 0.5})
    )
    seen = []
    look = shared._see
    shared._see = lambda *a: seen.append(look(*a)) or seen[-1]
    losses = [float(m.train_step(batch, 0).losses["mask"].detach()) for m in (plain, clamped, shared)]
    alphas = [level.weights.sum(-1) for level in seen[0][0]]
    parts = [float(mask_loss(a.detach(), batch.mask)) for a in alphas]
    assert losses[0] == pytest.approx(0.1 * parts[2], rel=1e-5)
    assert losses[1] == pytest.approx(
        0.1 * float(mask_loss(alphas[2].detach(), batch.mask, clamp=0.2)), rel=1e-5
    )
    assert losses[2] == pytest.approx(0.1 * (0.5 * parts[0] + 0.5 * parts[1] + parts[2]), rel=1e-5)


def test_samples_may_be_evenly_spaced(scene, hull):  # noqa: F811
    even = start(ZipNerfLite, scene, hull, replace(SMALL[ZipNerfLite], spacing_power=1.0), hooks=[])
    rays = (
        scene.train.cameras[0].centres.float().expand(5, 3),
        torch.nn.functional.normalize(torch.randn(5, 3)),
    )
    bounded = even.bound(*rays, [])
    squares = even._mean_squares()[0]
    level, _, _ = even._look("coarse", bounded, torch.full((5,), 0.001), None, 12, 1.0, None, squares)
    expected = bounded.near[:, None] + level.s * (bounded.far - bounded.near)[:, None]
    torch.testing.assert_close(level.t, expected)
    assert HULL.bounds_scale == 1.0
