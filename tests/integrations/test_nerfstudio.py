"""The adapter inside the real nerfstudio: data parser, collider, losses, splatfacto's arithmetic, on the CPU."""

from __future__ import annotations

import importlib.metadata
import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio", reason="nerfstudio is not installed: see scripts/nerfstudio_env.sh")

import yaml
from nerfstudio.model_components.scene_colliders import NearFarCollider

from datamodules import load
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.hooks.configs import RegularizerConfig, SamplerConfig
from visdom_plugin.hooks.regularizer import outside_loss
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.integrations.nerfstudio import fields, methods, splats
from visdom_plugin.integrations.nerfstudio.dataparser import METADATA, VisdomDataParserConfig
from visdom_plugin.integrations.nerfstudio.frame import similarity_of
from visdom_plugin.integrations.nerfstudio.rays import bound_model_rays

from ..datamodules.prepared_writer import write_prepared

HULL = VisibleDomain(resolution=48)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_prepared(load(None, views=4, downscale=8), tmp_path_factory.mktemp("scene") / "scene")


@pytest.fixture(scope="module")
def parser(folder, tmp_path_factory):
    cache = tmp_path_factory.mktemp("cache")
    return VisdomDataParserConfig(data=folder, background="alpha", cache=cache).setup()


@pytest.fixture(scope="module")
def train(parser):
    return parser.get_dataparser_outputs("train")


@pytest.fixture(autouse=True)
def no_perceptual_weights(monkeypatch):
    """Nerfstudio's models would download weights for a metric that no test looks at."""
    import torchmetrics.image.lpip as lpip

    class Nothing(torch.nn.Module):
        def __init__(self, **_):
            super().__init__()

        def forward(self, *_):
            return torch.zeros(())

    monkeypatch.setattr(lpip, "LearnedPerceptualImagePatchSimilarity", Nothing)


def pixel_rays(outputs, camera=0):
    """All rays of a camera, as nerfstudio makes them."""
    return outputs.cameras.generate_rays(camera_indices=camera, keep_shape=True).flatten()


# The data parser


def test_nerfstudios_own_inverse_gives_the_poses_back(train):
    """`transform_poses_to_original_space` is what its exporters and renderers trust."""
    views = train.metadata[METADATA].views
    back = train.transform_poses_to_original_space(train.cameras.camera_to_worlds, "opengl")
    world = views.cameras.world_from_camera[:, :3] * torch.tensor([1.0, -1, -1, 1]).double()
    assert torch.allclose(back.double(), world, atol=1e-5)


def test_nerfstudios_rays_are_ours(train):
    known = train.metadata[METADATA]
    for i in range(len(known.views)):
        bundle, ours = pixel_rays(train, i), rays_of(known.views.cameras[i])
        assert torch.allclose(
            known.frame.points_to_world(bundle.origins), ours.origins.reshape(-1, 3), atol=1e-5
        )
        turned = known.frame.directions_to_world(bundle.directions)
        assert torch.allclose(turned, ours.directions.reshape(-1, 3), atol=1e-5)


def test_test_views_reach_neither_training_nor_the_frame(folder, parser, train, tmp_path):
    blind = shutil.copytree(folder, tmp_path / "blind")
    for path in [*blind.glob("images/*"), *blind.glob("masks/*")]:
        if path.stem not in {Path(name).stem for name in train.metadata[METADATA].views.names}:
            path.unlink()
    config = VisdomDataParserConfig(data=blind, cache=tmp_path / "cache")
    again = config.setup().get_dataparser_outputs("train")
    with pytest.raises(SystemExit):
        config.setup().get_dataparser_outputs("test")
    assert torch.equal(again.cameras.camera_to_worlds, train.cameras.camera_to_worlds)
    test = parser.get_dataparser_outputs("test")
    assert METADATA not in test.metadata and METADATA in train.metadata
    assert torch.equal(test.dataparser_transform, train.dataparser_transform)
    assert test.dataparser_scale == train.dataparser_scale
    assert set(test.image_filenames).isdisjoint(train.image_filenames)


def test_bare_methods_see_white_outside_the_masks(folder, tmp_path):
    from nerfstudio.data.datasets.base_dataset import InputDataset

    outputs = VisdomDataParserConfig(data=folder, cache=tmp_path).setup().get_dataparser_outputs("train")
    dataset, views = InputDataset(outputs), outputs.metadata[METADATA].views
    for i in range(len(views)):
        image = dataset.get_image_float32(i)
        expected = torch.where(views.masks[i][..., None], views.images[i].float() / 255, 1.0)
        assert torch.allclose(image, expected)


def test_a_users_mistake_ends_with_status_2(tmp_path, capsys):
    parser = VisdomDataParserConfig(data=tmp_path / "nothing").setup()
    with pytest.raises(SystemExit) as stop:
        parser.get_dataparser_outputs("train")
    assert stop.value.code == 2 and "no such folder" in capsys.readouterr().err


# The collider, the background, the losses


@pytest.fixture(scope="module")
def hook(train):
    views = train.metadata[METADATA].views
    hull = HULL.carve(views.cameras, views.masks)
    return SamplerConfig(enabled=True).build(hull, views)


@pytest.mark.parametrize("at_inference", [False, True])
def test_collider_confines_training_and_by_default_nothing_else(train, hook, at_inference):
    frame = train.metadata[METADATA].frame
    collider = fields.HullCollider(NearFarCollider(0.05, 1000.0), hook, frame, at_inference)
    bundle = pixel_rays(train)
    bounds = bound_model_rays(
        hook,
        frame,
        bundle.origins,
        bundle.directions,
        torch.full_like(bundle.origins[:, 0], 0.05),
        torch.full_like(bundle.origins[:, 0], 1000.0),
    )
    assert 0.05 < bounds.hit.float().mean() < 0.95
    seen = collider.train()(pixel_rays(train))
    assert torch.equal(seen.nears, bounds.near[:, None]) and torch.equal(seen.fars, bounds.far[:, None])
    seen = collider.eval()(pixel_rays(train))
    if at_inference:
        assert torch.equal(seen.fars, bounds.far[:, None])
    else:
        assert (seen.nears == 0).all() and (seen.fars == 1000).all()


def test_background_is_random_in_training_and_white_after():
    renderer = fields.RandomThenWhite()
    rgb, weights = torch.rand(6, 5, 3), torch.rand(6, 5, 1) / 5
    photograph = torch.rand(6, 4)
    opacity = weights.sum(-2)
    drawn = renderer.train()(rgb, weights)
    shown, target = renderer.blend_background_for_loss_computation(drawn, opacity, photograph)
    behind = (target - photograph[:, :3] * photograph[:, 3:]) / (1 - photograph[:, 3:])
    assert behind.std() > 0.1
    assert torch.allclose(shown, (weights * rgb).sum(-2) + behind * (1 - opacity), atol=1e-4)
    white = renderer.eval()(rgb.clone(), weights)
    assert torch.allclose(white, (weights * rgb).sum(-2) + 1 - opacity, atol=1e-6)
    assert torch.allclose(
        renderer.blend_background(photograph), photograph[:, :3] * photograph[:, 3:] + 1 - photograph[:, 3:]
    )


def test_silhouette_loss_is_the_cross_entropy():
    opacity, photograph = torch.rand(50, 1) * 0.9 + 0.05, torch.rand(50, 4).round()
    loss = fields.silhouette_loss(opacity, photograph)
    by_hand = [
        -np.log(a) if m else -np.log(1 - a)
        for a, m in zip(opacity[:, 0].tolist(), photograph[:, 3], strict=True)
    ]
    assert loss.item() == pytest.approx(np.mean(by_hand), rel=1e-5)
    with pytest.raises(ConfigError, match="without"):
        fields.silhouette_loss(opacity, photograph[:, :3])


def test_silhouette_loss_leaves_mixed_precision(monkeypatch):
    """On CUDA torch raises for a cross entropy of probabilities under autocast."""
    plain, seen = fields.mask_loss, []

    def watched(alpha, mask):
        seen.append((torch.is_autocast_enabled("cpu"), alpha.dtype, mask.dtype))
        return plain(alpha, mask)

    monkeypatch.setattr(fields, "mask_loss", watched)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        fields.silhouette_loss(torch.rand(5, 1).bfloat16(), torch.rand(5, 4).round())
    assert seen == [(False, torch.float32, torch.float32)]


# Whole models

TINY = {
    "implementation": "torch",
    "num_levels": 4,
    "max_res": 64,
    "log2_hashmap_size": 10,
    "num_proposal_samples_per_ray": (16, 8),
    "num_nerf_samples_per_ray": 8,
    "camera_optimizer": methods.CameraOptimizerConfig(mode="off"),
}


def build(config, train, masks=True):
    torch.manual_seed(0)
    return config.setup(
        scene_box=train.scene_box,
        num_train_data=len(train.image_filenames),
        metadata=train.metadata if masks else {},
        device="cpu",
        grad_scaler=None,
        seed_points=None,
    )


def step(model, train, batch):
    torch.manual_seed(1)
    bundle = pixel_rays(train)[batch["chosen"]]
    outputs = model(bundle)
    return outputs, model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))


@pytest.fixture(scope="module")
def batch(train):
    views = train.metadata[METADATA].views
    chosen = torch.randperm(views.masks[0].numel(), generator=torch.Generator().manual_seed(0))[:200]
    rgba = torch.cat([views.images[0].float() / 255, views.masks[0].float()[..., None]], -1)
    return {"chosen": chosen, "image": rgba.reshape(-1, 4)[chosen]}


def test_with_the_hooks_off_it_is_nerfacto(train, batch):
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    off = fields.NerfactoVdConfig(
        **TINY, vd=SamplerConfig(enabled=False), mask_weight=0, background_color="white"
    )
    results = []
    for config in (NerfactoModelConfig(**TINY, background_color="white"), off):
        model = build(config, train)
        outputs, losses = step(model, train, batch)
        sum(losses.values()).backward()
        results.append((outputs["rgb"], losses, [p.grad for p in model.field.parameters()]))
    (rgb, losses, gradients), (other_rgb, other_losses, other_gradients) = results
    assert torch.equal(rgb, other_rgb) and losses.keys() == other_losses.keys()
    assert all(torch.equal(losses[k], other_losses[k]) for k in losses)
    pairs = list(zip(gradients, other_gradients, strict=True))
    assert any(a is not None for a, _ in pairs)
    assert all((a is None and b is None) or torch.equal(a, b) for a, b in pairs)


def test_samples_of_training_rays_lie_in_the_hulls_band(train, batch):
    model = build(fields.NerfactoVdConfig(**TINY, hull=HULL), train).train()
    outputs, losses = step(model, train, batch)
    assert "mask_loss" in losses
    assert losses["mask_loss"].item() == pytest.approx(
        0.1 * fields.silhouette_loss(outputs["accumulation"], batch["image"]).item()
    )
    hook, frame = model.collider.hook, model.collider.frame
    bundle = model.collider(pixel_rays(train)[batch["chosen"]])
    hit = bound_model_rays(
        hook, frame, bundle.origins, bundle.directions, bundle.nears[:, 0] * 0, bundle.fars[:, 0] * 0 + 1e3
    ).hit
    samples = outputs["ray_samples_list"][-1].frustums
    middle = (samples.origins + samples.directions * (samples.starts + samples.ends) / 2)[hit]
    box = hook.hull.extent + np.array([[-1], [1]]) * (hook.epsilon_world + 1e-4)
    inside = frame.points_to_world(middle).numpy()
    assert 0.05 < hit.float().mean() < 0.95
    assert ((inside > box[0]) & (inside < box[1])).all()


def test_another_data_parser_is_told(train, capsys):
    with pytest.raises(SystemExit) as stop:
        build(fields.NerfactoVdConfig(**TINY), train, masks=False)
    assert stop.value.code == 2 and "ns-train nerfacto-vd visdom" in capsys.readouterr().err


def test_instant_ngp_takes_the_colliders_bounds(train):
    config = fields.InstantNgpVdConfig(
        hull=HULL, grid_resolution=8, grid_levels=1, log2_hashmap_size=10, max_res=64
    )
    model = build(config, train).train()
    seen = {}

    def sampling(**given):
        seen.update(given)
        n = len(given["rays_o"])
        return torch.arange(n), given["t_min"], given["t_max"]

    model.occupancy_grid.sampling = sampling
    bundle = model.collider(pixel_rays(train))
    model.sampler(
        ray_bundle=bundle,
        render_step_size=0.01,
        near_plane=0.05,
        far_plane=1e3,
        alpha_thre=0.0,
        cone_angle=0.0,
    )
    assert torch.equal(seen["t_min"], bundle.nears[:, 0]) and torch.equal(seen["t_max"], bundle.fars[:, 0])
    assert (seen["t_max"] < 100).any()


# Splatfacto, with a rasteriser of our own in the place of the one that needs CUDA


def blobs(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **_):
    """Alpha and colour of isotropic blobs, drawn one over the other without order; (1, H, W, C)."""
    local = means @ viewmats[0, :3, :3].mT + viewmats[0, :3, 3]
    pixel = local @ Ks[0].mT
    uv = pixel[:, :2] / pixel[:, 2:].clamp_min(0.01)
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    away = (u[..., None] - uv[:, 0]) ** 2 + (v[..., None] - uv[:, 1]) ** 2
    clear = 1 - opacities * torch.exp(-0.5 * away)
    alpha = 1 - clear.prod(-1, keepdim=True)
    return alpha.expand(height, width, 3)[None] * 0.5, alpha[None], {"means2d": uv[None], "width": width}


@pytest.fixture
def splat_model(train, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self, *_, **__: self)
    monkeypatch.setattr("nerfstudio.models.splatfacto.rasterization", blobs)
    config = splats.SplatfactoVdConfig(
        hull=HULL,
        initial_points=60,
        sh_degree=0,
        vd=RegularizerConfig(enabled=True, prune_every=3, weight=0.5),
    )
    with torch.compiler.set_stance("force_eager"):
        model = build(config, train).train()
        model.optimizers = {
            name: torch.optim.Adam([{"params": [p], "name": name}], lr=1e-3)
            for name, p in model.gauss_params.items()
        }
        yield model


def splat_batch(train):
    views = train.metadata[METADATA].views
    rgba = torch.cat([views.images[0], 255 * views.masks[0].byte()[..., None]], -1)
    return {"image": rgba}


def test_splats_start_inside_the_hull_with_its_colours(splat_model):
    world = splat_model.frame.points_to_world(splat_model.means.detach())
    assert splat_model.num_points == 60 and splat_model.hook.hull.contains(world, margin_voxels=1).all()
    xyz, rgb = splat_model.hook.initial_points(60, torch.Generator().manual_seed(0))
    assert torch.allclose(world, xyz.double(), atol=1e-5)
    assert torch.allclose(splat_model.colors.detach(), rgb, atol=1e-4)


def test_splats_pay_for_opacity_beside_the_hull(splat_model, train):
    """L_i is taken at a full view between the training cameras, at the weight of the settings."""
    camera = train.cameras[:1]
    outputs = splat_model(camera)
    left_behind = splat_model.info
    losses = splat_model.get_loss_dict(outputs, splat_batch(train))
    assert {"main_loss", "mask_loss", "visdom_outside"} <= losses.keys()
    assert splat_model.info is left_behind and splat_model._get_downscale_factor() == 4
    view = splat_model.hook._draw(torch.Generator().manual_seed(splat_model.step))[0]
    alpha = splat_model.render_opacity(view)
    assert alpha.shape == (int(view.height), int(view.width))
    silhouette = depth_and_silhouette(splat_model.hook.hull, view)[1]
    expected = 0.5 * outside_loss(alpha, silhouette)
    assert expected > 0 and torch.allclose(losses["visdom_outside"], expected)
    losses["visdom_outside"].backward()
    assert splat_model.opacities.grad.abs().sum() > 0


def test_splats_outside_go_with_their_optimisers_state(splat_model, train):
    outputs = splat_model(train.cameras[:1])
    sum(splat_model.get_loss_dict(outputs, splat_batch(train)).values()).backward()
    for optimiser in splat_model.optimizers.values():
        optimiser.step()
    moments = splat_model.optimizers["opacities"].state[splat_model.opacities]["exp_avg"].clone()
    with torch.no_grad():
        splat_model.means[7:20] += 5.0
    kept = torch.ones(60, dtype=torch.bool)
    kept[7:20] = False
    before = splat_model.opacities.detach().clone()
    splat_model.prune_outside(1)
    assert splat_model.num_points == 60
    splat_model.prune_outside(3)
    assert splat_model.num_points == 47 and torch.equal(splat_model.opacities, before[kept])
    assert all(len(p) == 47 for p in splat_model.gauss_params.values())
    state = splat_model.optimizers["opacities"].state[splat_model.gauss_params["opacities"]]
    assert torch.equal(state["exp_avg"], moments[kept])


# The commands


def test_the_page_of_the_docs_trains_measures_and_resumes(tmp_path, monkeypatch):
    """`ns-train`, `ns-eval` and `--load-dir`, as typed, on the built-in scene."""
    from nerfstudio.scripts import eval as evaluating
    from nerfstudio.scripts import train as training

    page = Path(__file__).parents[2] / "docs/nerfstudio.md"
    (block,) = re.findall(r"```bash\n(.*?)```", page.read_text(), re.S)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = shlex.split(block.replace("\\\n", " "))

    def call(entrypoint, *words):
        monkeypatch.setattr(sys, "argv", list(words))
        entrypoint()

    run = tmp_path / "out/tiny/nerfacto-vd/now"
    call(training.entrypoint, *words)
    assert [p.name for p in run.glob("nerfstudio_models/*")] == ["step-000000002.ckpt"]
    transform = json.loads((run / "dataparser_transforms.json").read_text())
    frame = similarity_of(load(None, views=4, downscale=8).train.cameras)
    assert np.allclose(transform["transform"], frame.transform, atol=1e-6)
    assert transform["scale"] == frame.scale
    call(
        evaluating.entrypoint,
        "ns-eval",
        "--load-config",
        str(run / "config.yml"),
        "--output-path",
        "eval.json",
    )
    results = json.loads(Path("eval.json").read_text())["results"]
    assert 3 < results["psnr"] < 40 and 0 < results["ssim"] < 1
    at = words.index("visdom")
    again = ["--load-dir", str(run / "nerfstudio_models"), "--timestamp", "later"]
    call(training.entrypoint, *words[:at], *again, *words[at:])
    later = run.parent / "later/nerfstudio_models"
    assert [p.name for p in later.iterdir()] == ["step-000000005.ckpt"]
    counts = []
    for checkpoint in (run / "nerfstudio_models/step-000000002.ckpt", later / "step-000000005.ckpt"):
        adam = torch.load(checkpoint, weights_only=False)["optimizers"]["fields"]["state"]
        counts.append({int(state["step"]) for state in adam.values()})
    assert counts == [{3}, {6}]


# What nerfstudio finds


def test_nerfstudio_finds_the_methods_and_the_data_parser():
    from nerfstudio.configs.dataparser_configs import all_dataparsers
    from nerfstudio.configs.method_configs import all_methods

    assert isinstance(all_dataparsers["visdom"], VisdomDataParserConfig)
    for name in ("nerfacto-vd", "instant-ngp-vd", "splatfacto-vd"):
        assert all_methods[name].method_name == name
        assert all_methods[name].pipeline.datamanager.dataparser.background == "alpha"
    declared = importlib.metadata.entry_points(group="nerfstudio.method_configs").names
    assert {"nerfacto-vd", "instant-ngp-vd", "splatfacto-vd"} <= set(declared)


def test_sizes_and_schedules_are_nerfstudios():
    """What is written down in `methods` is what nerfstudio trains its own methods with."""
    from nerfstudio.configs.method_configs import all_methods

    for name in ("nerfacto", "instant-ngp", "splatfacto"):
        theirs, ours = all_methods[name], all_methods[f"{name}-vd"]
        assert ours.optimizers == theirs.optimizers
        for field in ("max_num_iterations", "mixed_precision", "steps_per_save", "steps_per_eval_batch"):
            assert getattr(ours, field) == getattr(theirs, field)
        model, base = vars(ours.pipeline.model), vars(theirs.pipeline.model)
        changed = {k for k in base if k != "_target" and model[k] != base[k]}
        assert changed == ({"background_color", "camera_optimizer"} if name == "nerfacto" else set())


@pytest.mark.parametrize("specification", [methods.NERFACTO, methods.INSTANT_NGP, methods.SPLATFACTO])
def test_saved_settings_come_back(specification):
    """Nerfstudio keeps a run's settings as YAML of Python objects, and ns-eval starts from them."""
    config = specification.config
    assert yaml.load(yaml.dump(config), Loader=yaml.Loader) == config
