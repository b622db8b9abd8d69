"""Meshes survive their file formats, and depth that is rendered from a known surface fuses to that surface."""

import numpy as np
import pytest
import torch
import trimesh

from visdom_plugin.export import meshes
from visdom_plugin.export.fusion import fuse, surround
from visdom_plugin.export.upright import upright
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.render import Render


def ring(count=4, distance=4.0, height=1.0, size=80) -> Cameras:
    angle = torch.arange(count, dtype=torch.float64) * 2 * torch.pi / count
    at = torch.stack([distance * angle.cos(), distance * angle.sin(), torch.full_like(angle, height)], -1)
    zero = torch.zeros(count, 3, dtype=torch.float64)
    pose = look_at_camera(at, zero, torch.tensor([0.0, 0, 1], dtype=torch.float64))
    K = torch.tensor([[size * 1.2, 0, size / 2], [0, size * 1.2, size / 2], [0, 0, 1]], dtype=torch.float64)
    side = torch.full((count,), size)
    return Cameras(K.expand(count, 3, 3), pose, side, side)


class Ball:
    """A red ball of radius 1 at `centre`, drawn exactly."""

    def __init__(self, centre=(0.0, 0.0, 0.0)):
        self.centre = torch.tensor(centre, dtype=torch.float64)

    def render(self, camera, background):
        rays = rays_of(camera.to(dtype=torch.float64))
        offset = rays.origins - self.centre
        b = (offset * rays.directions).sum(-1)
        root = b * b - (offset * offset).sum(-1) + 1
        hit = root > 0
        t = torch.where(hit, -b - root.clamp_min(0).sqrt(), 0)
        depth = t * (rays.directions @ camera.forward.double())
        alpha = hit.double()
        red = torch.tensor([1.0, 0, 0], dtype=torch.float64)
        return Render(alpha[..., None] * red, alpha, depth)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.1)])
def test_a_ball_fuses_to_a_ball(centre):
    ball = Ball(centre)
    bounds = np.array([[-1.5] * 3, [1.5] * 3])
    mesh = fuse(ball, ring(), bounds, resolution=48)
    assert mesh is not None
    radius = np.linalg.norm(mesh.vertices - centre, axis=1)
    assert abs(radius.mean() - 1) < 0.01 and np.abs(radius - 1).max() < 0.08
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert surface.is_watertight and abs(surface.volume / (4 / 3 * np.pi) - 1) < 0.03
    assert (mesh.rgb == [255, 0, 0]).all()


def test_nothing_to_see_is_no_surface():
    far = Ball((50.0, 0, 0))
    assert fuse(far, ring(), np.array([[-1.0] * 3, [1.0] * 3]), resolution=16) is None


def test_surrounding_cameras_look_at_the_object_from_all_round():
    cameras = ring()
    centre = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    around = surround(cameras, centre, 40, 64)
    offsets = around.centres - centre
    distance = (cameras.centres - centre).norm(dim=-1).mean()
    assert torch.allclose(offsets.norm(dim=-1), distance.expand(40))
    assert torch.allclose(around.forward, -offsets / distance, atol=1e-9)
    assert offsets.mean(0).norm() < 0.05 * distance


def square() -> meshes.Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5], [6, 5, 5], [5, 6, 5.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    return meshes.Mesh(vertices, faces, np.arange(21, dtype=np.uint8).reshape(7, 3) * 12)


def test_small_pieces_go_with_their_vertices():
    kept = meshes.largest_pieces(square(), 0.6)
    assert len(kept.faces) == 2 and np.array_equal(kept.vertices, square().vertices[:4])
    assert np.array_equal(kept.rgb, square().rgb[:4])
    assert len(meshes.largest_pieces(square(), 0.5).faces) == 3


def test_crop_leaves_whole_faces():
    kept = meshes.crop(square(), lambda x: x[:, 0] > -1)
    assert len(kept.faces) == 3
    kept = meshes.crop(square(), lambda x: x[:, 1] < 0.5)
    assert len(kept.faces) == 0


def test_smoothing_keeps_the_volume():
    rough = trimesh.creation.icosphere(4)
    noise = np.random.default_rng(0).normal(0, 0.01, rough.vertices.shape)
    mesh = meshes.Mesh(rough.vertices + noise, np.asarray(rough.faces))
    still = meshes.smooth(mesh, 5)
    spread = [np.linalg.norm(m.vertices, axis=1).std() for m in (mesh, still)]
    assert spread[1] < 0.5 * spread[0]
    assert abs(np.linalg.norm(still.vertices, axis=1).mean() - 1) < 0.005
    assert meshes.smooth(mesh, 0) is mesh


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
@pytest.mark.parametrize("shift", [0.0, 5e6])
def test_formats_are_read_back_by_trimesh(tmp_path, suffix, shift):
    mesh = square()._replace(vertices=square().vertices + np.array([shift, 0, 0]))
    path = tmp_path / f"a.{suffix}"
    meshes.write_mesh(path, mesh)
    back = trimesh.load(path, process=False, force="mesh", maintain_order=True)
    assert np.allclose(np.asarray(back.vertices), mesh.vertices, rtol=0, atol=1e-6)
    assert np.array_equal(np.asarray(back.faces), mesh.faces)
    if suffix != "glb":  # of which trimesh drops the colours beside a material
        assert np.array_equal(np.asarray(back.visual.vertex_colors)[:, :3], mesh.rgb)


def test_glb_is_valid_for_another_reader(tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    meshes.write_mesh(tmp_path / "a.glb", square())
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    primitive = document.meshes[0].primitives[0]
    accessor = document.accessors[primitive.attributes.POSITION]
    assert accessor.count == 7 and document.accessors[primitive.indices].count == 9
    place = np.array(document.nodes[0].translation)
    assert np.allclose(place + accessor.min, square().vertices.min(0), atol=1e-6)
    assert document.extensionsUsed == ["KHR_materials_unlit"]
    colour = document.bufferViews[document.accessors[primitive.attributes.COLOR_0].bufferView]
    data = document.binary_blob()[colour.byteOffset : colour.byteOffset + colour.byteLength]
    linear = np.frombuffer(data, "<u2").reshape(7, 4) / 65535
    assert (linear[:, 3] == 1).all()
    # The standard's formula from linear to sRGB.
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)[:, :3]
    assert np.array_equal((srgb * 255).round(), square().rgb)


@pytest.mark.parametrize(("up", "axis"), [("-y", [0, -1, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1])])
def test_upright_brings_up_to_an_axis_and_the_middle_to_the_origin(up, axis):
    tilt = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    )[0]
    tilt = tilt * torch.linalg.det(tilt)
    flat = ring()
    pose = flat.world_from_camera.clone()
    middle = torch.tensor([3.0, -2, 7], dtype=torch.float64)
    pose[:, :3, :3] = tilt @ pose[:, :3, :3]
    pose[:, :3, 3] = pose[:, :3, 3] @ tilt.mT + middle
    motion = upright(Cameras(flat.intrinsics, pose, flat.width, flat.height), middle, up)
    assert torch.allclose(motion[:3, :3] @ motion[:3, :3].mT, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert torch.linalg.det(motion[:3, :3]) > 0
    assert torch.allclose(
        motion[:3, :3] @ middle + motion[:3, 3], torch.zeros(3, dtype=torch.float64), atol=1e-9
    )
    above = tilt @ torch.tensor([0.0, 0, 1], dtype=torch.float64)
    assert torch.allclose(motion[:3, :3] @ above, torch.tensor(axis, dtype=torch.float64), atol=1e-9)
