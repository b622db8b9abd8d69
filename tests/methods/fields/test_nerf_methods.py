"""The radiance fields: what they learn, that their state is all there is, and what the hook changes."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import trimesh

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs import ingp, zerorf_lite, zipnerf_lite
from tests.methods.short_runs import advance, copy_of, set_up
from visdom_plugin import registry
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hooks.protocols import RayBounds
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.fields import common
from visdom_plugin.methods.fields.common import bound_rays, mesh_density
from visdom_plugin.methods.fields.ingp import Ingp
from visdom_plugin.methods.fields.marched import MarchedField
from visdom_plugin.methods.fields.zerorf_lite import ZeroRfLite
from visdom_plugin.methods.fields.zipnerf_lite import ZipNerfLite
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.nerf.frame import Frame, frame_of
from visdom_plugin.training.batches import DataManager

HULL = VisibleDomain(resolution=48, dilate_px=1)
SMALL = {
    Ingp: replace(
        ingp.SPEC.quick,
        steps=240,
        max_rays=256,
        samples_per_step=1 << 12,
        step_length=0.03,
        missing_step_length=0.2,
        grid=HashLayout(4, 2, base_resolution=8, max_resolution=64, log2_table_size=12),
        occupancy_resolution=32,
        occupancy_warm_up=32,
        occupancy_every=8,
        lr_warm_up=10,
        mask_weight=0.1,
        hull=HULL,
        vd=SamplerConfig(enabled=True),
    ),
    ZipNerfLite: replace(
        zipnerf_lite.SPEC.quick,
        steps=240,
        rays=128,
        samples=(12, 12, 8),
        test_samples=(24, 16, 12),
        density_bias=-2.0,  # few steps would not get far from a space as empty as the preset's
        coarse_grid=HashLayout(3, 1, base_resolution=8, max_resolution=32, log2_table_size=12),
        fine_grid=HashLayout(3, 1, base_resolution=8, max_resolution=64, log2_table_size=12),
        grid=HashLayout(4, 4, base_resolution=8, max_resolution=128, log2_table_size=12),
        lr_warm_up=10,
        mask_weight=0.1,
        hull=HULL,
        vd=SamplerConfig(enabled=True),
    ),
    ZeroRfLite: replace(
        zerorf_lite.SPEC.quick,
        steps=240,
        first_rays=128,
        rays=256,
        step_length=0.08,
        missing_step_length=0.3,
        noise_resolution=2,
        width=4,
        channels=8,
        hidden=32,
        occupancy_resolution=16,
        occupancy_every=8,
        mask_weight=0.1,
        hull=HULL,
        vd=SamplerConfig(enabled=True),
    ),
}
METHODS = pytest.mark.parametrize("method_class", list(SMALL), ids=lambda c: c.__name__)


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48))


@pytest.fixture(scope="module")
def hull(scene):
    return HULL.carve(scene.train.cameras, scene.train.masks)


def start(method_class, scene, hull, config=None, hooks=None, seed=0):
    return set_up(method_class, config or SMALL[method_class], scene, hull, hooks, seed)


@pytest.fixture(scope="module", params=list(SMALL), ids=lambda c: c.__name__)
def trained(request, scene, hull):
    method = start(request.param, scene, hull)
    history = advance(method, scene, range(240))
    return method, history


def test_it_learns_what_the_photographs_show(trained, scene):
    method, history = trained
    assert sum(history[-8:]) < 0.6 * sum(history[:8])
    render = method.render(scene.train.cameras[0], torch.ones(3))
    mask = scene.train.masks[0]
    truth = torch.where(mask[..., None], scene.train.images[0].float() / 255, 1.0)
    assert (render.rgb - truth).square().mean() < 0.5 * (1 - truth).square().mean()
    assert render.alpha[mask].mean() > 3 * render.alpha[~mask].mean()


def test_renders_obey_their_definition(trained, scene):
    method, _ = trained
    camera = scene.test.cameras[0]
    white, black = (method.render(camera, torch.full((3,), x)) for x in (1.0, 0.0))
    assert white.rgb.shape == (48, 48, 3) and white.alpha.shape == white.depth.shape == (48, 48)
    assert not white.rgb.requires_grad
    assert ((white.alpha >= 0) & (white.alpha <= 1 + 1e-5)).all()
    torch.testing.assert_close(
        white.rgb - black.rgb, (1 - white.alpha)[..., None].expand(-1, -1, 3), atol=1e-5, rtol=0
    )
    # Where it is opaque, the depth along z points at the object: inside the hull's box, a voxel more or less.
    opaque = white.alpha > 0.9
    assert opaque.any()
    rays = rays_of(camera)
    along = rays.directions @ camera.forward
    points = (rays.origins + (white.depth / along)[..., None] * rays.directions)[opaque]
    low, high = method.hooks[0].hull.extent
    near = torch.as_tensor(low - 0.3 * (high - low)), torch.as_tensor(high + 0.3 * (high - low))
    assert ((points > near[0]) & (points < near[1])).all(-1).float().mean() > 0.95


@METHODS
def test_a_resumed_run_equals_the_uninterrupted_one(method_class, scene, hull):
    straight = start(method_class, scene, hull)
    advance(straight, scene, range(19))
    saved = copy_of(straight)
    advance(straight, scene, range(19, 34))
    resumed = start(method_class, scene, hull)
    resumed.load_state_dict(saved)
    advance(resumed, scene, range(19, 34))
    assert straight.state_dict().keys() == resumed.state_dict().keys()
    for name, value in straight.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


class Bystander:
    """A sampler that leaves all bounds as they are."""

    def bound(self, origins, directions, near, far):
        return RayBounds(near, far, torch.ones_like(near, dtype=torch.bool))


@METHODS
def test_a_sampler_that_bounds_nothing_changes_nothing(method_class, scene, hull):
    config = replace(SMALL[method_class], vd=SamplerConfig())
    plain = start(method_class, scene, hull, config, hooks=[])
    # The frame's scale is a power of two here, so that bounds survive the way to the world frame and back.
    plain.frame = plain.frame._replace(scale=0.25)
    twin = start(method_class, scene, hull, config, hooks=[Bystander()])
    twin.frame = plain.frame
    advance(plain, scene, range(12))
    advance(twin, scene, range(12))
    for name, value in plain.state_dict().items():
        assert torch.equal(value, twin.state_dict()[name]), name


@METHODS
def test_training_samples_stay_within_the_hooks_bounds(method_class, scene, hull, monkeypatch):
    method = start(method_class, scene, hull)
    batch = DataManager(scene.train, seed=0).pixel_batch(0, 200)
    bounds = method.hooks[0].bound(
        batch.origins,
        batch.directions,
        torch.full((200,), method.config.near / method.frame.scale),
        torch.full((200,), 3 / frame_of(scene.train.cameras).scale),
    )
    rays = method.bound(batch.origins, batch.directions, method.hooks)
    assert torch.equal(rays.hit, bounds.hit) and 20 < int(rays.hit.sum()) < 180
    own_near, own_far = method.own_bounds(batch.origins, batch.directions)
    near = torch.maximum(bounds.near * method.frame.scale, own_near)
    torch.testing.assert_close(rays.near[rays.hit], near[rays.hit])
    assert (rays.far[rays.hit] <= bounds.far[rays.hit] * method.frame.scale + 1e-5).all()
    length, own = rays.far - rays.near, own_far - own_near
    torch.testing.assert_close(length[~rays.hit], own[~rays.hit])
    # A cube no larger than the object leaves less to cut.
    most = 0.7 if method_class is ZeroRfLite else 0.5
    assert length[rays.hit].mean() < most * own[rays.hit].mean()


@METHODS
def test_bounds_of_training_pixels_are_asked_for_once_and_are_those_of_their_rays(
    method_class, scene, hull, monkeypatch
):
    monkeypatch.setattr(common, "PIXELS_AT_ONCE", 1000)
    method = start(method_class, scene, hull)
    asked = []
    bound = method.hooks[0].bound
    monkeypatch.setattr(method.hooks[0], "bound", lambda *rays: asked.append(1) or bound(*rays))
    data = DataManager(scene.train, seed=0)
    for step in range(2):
        batch = data.pixel_batch(step, 200)
        found = method.training_rays(batch)
        assert len(asked) == -(-sum(m.numel() for m in scene.train.masks) // 1000)
        expected = bound_rays(
            batch.origins,
            batch.directions,
            *method.own_bounds(batch.origins, batch.directions),
            method.frame,
            [SimpleNamespace(bound=bound)],
        )
        assert all(map(torch.equal, found, expected))


def test_other_samplers_are_asked_at_every_step(scene, hull):
    method = start(Ingp, scene, hull)
    asked = []
    rays = SimpleNamespace(
        bound=lambda o, d, near, far: asked.append(1) or Bystander().bound(o, d, near, far)
    )
    method = start(Ingp, scene, hull, hooks=[*method.hooks, rays])
    asked.clear()
    advance(method, scene, range(3))
    assert len(asked) == 3


def test_hull_at_inference_shows_background_beside_the_hull(trained, scene):
    method, _ = trained
    camera = scene.test.cameras[1]
    free = method.render(camera, torch.ones(3))
    config = method.config
    method.config = replace(config, vd=replace(config.vd, hull_at_inference=True))
    try:
        bound = method.render(camera, torch.ones(3))
    finally:
        method.config = config
    rays = rays_of(camera)
    hit = method.hooks[0].bound(rays.origins, rays.directions, 0.0, 1e3).hit
    assert (bound.alpha[~hit] == 0).all() and (bound.rgb[~hit] == 1).all()
    assert (free.alpha[~hit] > 0).any() or isinstance(method, MarchedField), "the free render is bound, too"


def test_the_mesh_lies_in_the_input_frame(trained, scene, tmp_path):
    method, _ = trained
    (path,) = method.export(tmp_path)
    mesh = trimesh.load(path, process=False)
    low, high = method.hooks[0].hull.extent
    inside = ((mesh.vertices > low - 0.3) & (mesh.vertices < high + 0.3)).all(1)
    assert Path(path).name == "mesh.ply" and len(mesh.faces) > 200
    assert inside.mean() > 0.8
    assert mesh.visual.vertex_colors[:, :3].std(0).max() > 10, "the mesh has one colour"
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume > 0, "faces look inwards"


def test_a_mesh_of_a_known_field_is_its_surface_whatever_the_resolution():
    """A ball of density 1000, its colour its position, and a speck too small to be kept."""
    centre = torch.tensor([0.1, -0.2, 0.05])
    frame = Frame(torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64), 0.25)

    def density_of(points):
        ball = torch.sigmoid(200 * (0.3 - (points - centre).norm(dim=-1)))
        speck = (points - 0.85).abs().amax(-1) < 0.02
        return 1000 * ball + 1000 * speck

    def colour_of(points, directions):
        # Seen from outside: against the normal.
        assert ((points - centre) * directions).sum(-1).max() < 0
        return 0.8 * points + 0.5

    for resolution in (40, 90):
        vertices, faces, rgb = mesh_density(density_of, colour_of, frame, 1.0, resolution=resolution)
        local = (torch.from_numpy(vertices) - frame.centre) * frame.scale
        assert ((local - centre).norm(dim=-1) - 0.3).abs().max() < 0.03
        mesh = trimesh.Trimesh(vertices, faces)
        assert mesh.is_watertight and mesh.volume == pytest.approx(4.19 * 1.2**3, rel=0.2)
        assert abs(torch.from_numpy(rgb) / 255 - (0.8 * local + 0.5)).max() < 0.01
    assert mesh_density(lambda p: torch.zeros(len(p)), colour_of, frame, 1.0) is None

    def hollow(points):
        return density_of(points) * ((points - centre).norm(dim=-1) > 0.15)

    vertices, faces, _ = mesh_density(hollow, colour_of, frame, 1.0, resolution=64)
    assert trimesh.Trimesh(vertices, faces).body_count == 1
    local = (torch.from_numpy(vertices) - frame.centre) * frame.scale
    assert ((local - centre).norm(dim=-1) - 0.3).abs().max() < 0.03


@METHODS
def test_seeds_repeat_and_differ(method_class, scene, hull):
    states = []
    for seed in (0, 0, 1):
        method = start(method_class, scene, hull, seed=seed)
        advance(method, scene, range(4))
        states.append(method.state_dict())
    assert all(torch.equal(v, states[1][k]) for k, v in states[0].items())
    assert any(not torch.equal(v, states[2][k]) for k, v in states[0].items())


def test_variants_differ_only_in_what_they_name():
    for name in ("ingp", "zipnerf-lite", "zerorf-lite"):
        bare, mask, vd = (registry.find(name + suffix) for suffix in ("", "+mask", "+vd"))
        for budget in ("quick", "full"):
            base = getattr(bare, budget)
            kept = {f: getattr(base, f) for f in ("mask_weight", "background")}
            assert replace(getattr(mask, budget), **kept) == base
            kept |= {"hull": None, "vd": base.vd}
            if budget == "quick" and name == "zipnerf-lite":
                kept |= {"samples": base.samples, "density_bias": base.density_bias}
            assert replace(getattr(vd, budget), **kept) == base
            assert base.mask_weight == 0 and base.background == "white" and not base.vd.enabled
    assert registry.find("zipnerf+vd") is registry.find("zipnerf-lite+vd")


@pytest.mark.parametrize(
    ("method_class", "wrong"),
    [
        (Ingp, {"occupancy_resolution": 0}),
        (Ingp, {"view_degree": 9}),
        (Ingp, {"step_length": float("nan")}),
        (ZipNerfLite, {"samples": (1, 8, 8)}),
        (ZipNerfLite, {"far": 0.01}),
        (Ingp, {"hull": None}),
        (ZipNerfLite, {"hull": None}),
    ],
)
def test_settings_out_of_range_are_named_before_anything_is_built(method_class, wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        replace(SMALL[method_class], **wrong)
