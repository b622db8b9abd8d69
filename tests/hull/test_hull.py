"""The grid, its mesh, its points and its files."""

import contextlib
import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from visdom_plugin.errors import CheckpointError, ConfigError, EmptyHullError
from visdom_plugin.hull.grid.components import choose_pieces, erase_pieces, find_pieces
from visdom_plugin.hull.grid.mesh import is_closed, mesh_grid
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import cast, cast_with_torch


def ball(n: int = 40, radius: float = 0.7) -> Hull:
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return Hull.from_grid(x**2 + y**2 + z**2 < radius**2, [[-1] * 3, [1] * 3])


@given(st.integers(0, 10**9), st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_mesh_of_any_grid_is_closed_and_outward(seed, fill):
    random = np.random.default_rng(seed)
    grid = random.random(random.integers(1, 12, 3)) < fill
    vertices, faces = mesh_grid(grid)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert is_closed(faces)
    if grid.any():
        assert mesh.is_watertight and mesh.is_winding_consistent
        assert mesh.volume > 0
        # The surface passes between voxel centres: each inside one is inside, no outside one is.
        winding = [winding_number(vertices[faces], c) for c in np.argwhere(np.pad(grid, 1)) - 0.5]
        assert np.allclose(winding, 1, atol=1e-6)
        empty = np.argwhere(~np.pad(grid, 1))[::7] - 0.5
        assert np.allclose([winding_number(vertices[faces], c) for c in empty], 0, atol=1e-6)
    else:
        assert len(faces) == len(vertices) == 0


def winding_number(triangles, point) -> float:
    """Solid angle over 4 pi (van Oosterom and Strackee 1983)."""
    a, b, c = (triangles[:, i] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    numerator = (a * np.cross(b, c)).sum(1)
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (a * c).sum(1) * lb
    return float(2 * np.arctan2(numerator, below).sum() / (4 * np.pi))


def test_is_closed_sees_a_missing_and_a_turned_face():
    _, faces = mesh_grid(np.ones((2, 2, 2), bool))
    turned = faces.copy()
    turned[3] = turned[3, ::-1]
    assert is_closed(faces) and not is_closed(faces[1:]) and not is_closed(turned)


def test_volume_and_area_of_a_ball_and_a_box():
    hull = ball(80)
    assert hull.volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.01)
    vertices, faces = hull.to_mesh()
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(hull.volume, rel=0.01)
    assert np.allclose(hull.centre, 0, atol=1e-9) and hull.radius == pytest.approx(0.7, abs=hull.voxel_size)
    grid = np.zeros((20, 30, 40), bool)
    grid[2:12, 5:25, 10:40] = True
    box = Hull.from_grid(grid, [[1, 2, 3], [3, 5, 7]])
    assert box.volume == pytest.approx(1.0 * 2.0 * 3.0)
    # Edges are bevelled by half a voxel.
    assert 21 < box.surface_area < 22
    assert np.allclose(box.extent, [[1.2, 2.5, 4], [2.2, 4.5, 7]])


@given(st.integers(0, 10**9))
@settings(max_examples=30, deadline=None)
def test_contains_is_the_voxel_of_the_point(seed):
    random = np.random.default_rng(seed)
    shape = random.integers(1, 9, 3)
    grid = random.random(shape) < 0.5
    low = random.normal(size=3)
    hull = Hull(grid, np.stack([low, low + shape * 0.25]))
    points = low + (random.random((7, 50, 3)) * 1.4 - 0.2) * shape * 0.25
    wanted = np.zeros(points.shape[:2], bool)
    for index in np.ndindex(*wanted.shape):
        voxel = np.floor((points[index] - low) / 0.25).astype(int)
        wanted[index] = (voxel >= 0).all() and (voxel < shape).all() and grid[tuple(voxel.clip(0, shape - 1))]
    assert np.array_equal(hull.contains(points), wanted)
    assert np.array_equal(hull.contains(torch.from_numpy(points)).numpy(), wanted)


def test_contains_with_a_margin_reaches_beyond_the_grid():
    hull = Hull.from_grid(np.ones((2, 2, 2)), [[0, 0, 0], [2, 2, 2]])
    points = torch.tensor([[2.5, 1, 1], [3.5, 1, 1], [-0.9, -0.9, -0.9]])
    assert hull.contains(points).tolist() == [False] * 3
    assert hull.contains(points, margin_voxels=1).tolist() == [True, False, True]
    assert hull.contains(points, margin_voxels=1.5).tolist() == [True, True, True]


@pytest.mark.parametrize("reach", [1, 2, 5])
def test_a_margin_is_a_maximum_filter(reach):
    from scipy.ndimage import maximum_filter

    grid = np.random.default_rng(reach).random((9, 6, 4)) < 0.02
    wanted = maximum_filter(np.pad(grid, reach), size=2 * reach + 1, mode="constant")
    centres = np.stack(np.meshgrid(*(np.arange(n) + 0.5 - reach for n in wanted.shape), indexing="ij"), -1)
    hull = Hull(grid, np.array([[0.0, 0, 0], grid.shape]))
    assert np.array_equal(hull.contains(centres, margin_voxels=reach), wanted)


def test_points_on_the_surface_are_uniform_and_repeatable():
    hull = ball()
    points = hull.sample_points(20_000, torch.Generator().manual_seed(1))
    again = hull.sample_points(20_000, torch.Generator().manual_seed(1))
    assert points.shape == (20_000, 3) and torch.equal(points, again)
    assert not torch.equal(points, hull.sample_points(20_000, torch.Generator().manual_seed(2)))
    assert (points.norm(dim=-1) - 0.7).abs().max() < hull.voxel_size
    assert points.mean(0).abs().max() < 0.02
    vertices, faces = hull.to_mesh()
    centres, area = vertices[faces].mean(1), trimesh.Trimesh(vertices, faces, process=False).area_faces
    share = area[centres[:, 2] > 0.35].sum() / area.sum()
    assert (points[:, 2] > 0.35).float().mean() == pytest.approx(share, abs=0.015)


def test_points_inside_are_uniform_and_repeatable():
    hull = ball()
    points = hull.sample_inside(20_000, torch.Generator().manual_seed(1))
    assert torch.equal(points, hull.sample_inside(20_000, torch.Generator().manual_seed(1)))
    assert hull.contains(points).all() and points.mean(0).abs().max() < 0.02
    assert points.norm(dim=-1).mean() == pytest.approx(0.75 * 0.7, rel=0.02)


def test_an_empty_hull_answers():
    hull = Hull(np.zeros((4, 4, 4), bool), np.array([[0.0, 0, 0], [1, 1, 1]]))
    assert hull.volume == 0 and hull.radius == 0 and hull.surface_area == 0 and len(hull.to_mesh()[1]) == 0
    assert hull.sample_points(5).shape == hull.sample_inside(5).shape == (0, 3)
    assert not hull.contains(torch.rand(9, 3)).any() and np.allclose(hull.centre, 0.5)


def test_from_grid_takes_numbers_of_any_kind_and_copies_them():
    box = [[0, 0, 0], [1, 1, 2]]
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        values = torch.tensor([[[0.4, 0.6]]], dtype=dtype, requires_grad=True)
        assert Hull.from_grid(values, torch.tensor(box)).occupancy.tolist() == [[[False, True]]]
    corners = [torch.tensor([0.1, 0, 0], dtype=torch.float64), np.array([1, 1, 2])]
    for dtype in (bool, np.uint8, np.int64):
        grid = np.array([[[0, 1]]], dtype)
        hull = Hull.from_grid(grid, corners)
        grid[:] = 0
        assert hull.occupancy.tolist() == [[[False, True]]] and hull.bounds[0, 0] == 0.1
    turned = np.asfortranarray(np.arange(24).reshape(2, 3, 4) > 20)
    assert np.array_equal(Hull.from_grid(turned, box).occupancy, turned)


@pytest.mark.parametrize(
    ("array", "bounds", "said"),
    [
        (np.ones((2, 2)), [[0] * 3, [1] * 3], "not shape"),
        (np.ones((1, 2, 2, 2)), [[0] * 3, [1] * 3], "not shape"),
        (np.ones((0, 2, 2)), [[0] * 3, [1] * 3], "not shape"),
        (np.full((2, 2, 2), "a"), [[0] * 3, [1] * 3], "real numbers"),
        (np.full((2, 2, 2), np.nan), [[0] * 3, [1] * 3], "8 voxels"),
        (torch.full((2, 2, 2), torch.inf), [[0] * 3, [1] * 3], "8 voxels"),
        (np.full((2, 2, 2), 0.3), [[0] * 3, [1] * 3], "0.3"),
        (np.zeros((2, 2, 2), bool), [[0] * 3, [1] * 3], "no voxel"),
        (np.ones((2, 2, 2)), [[0] * 3, [0] * 3], "lower < upper"),
        (np.ones((2, 2, 2)), [[1] * 3, [0] * 3], "lower < upper"),
        (np.ones((2, 2, 2)), [[0] * 3, [np.nan] * 3], "lower < upper"),
        (np.ones((2, 2, 2)), [0, 0, 0, 1, 1, 1], "two corners"),
        (np.ones((2, 2, 2)), [[0, 0], [1, 1, 1]], "two corners"),
        (np.ones((2, 2, 2)), None, "two corners"),
    ],
)
def test_grids_and_boxes_that_cannot_be_a_hull_are_named(tmp_path, array, bounds, said):
    with pytest.raises((ConfigError, EmptyHullError), match=said):
        Hull.from_grid(array, bounds)
    if isinstance(array, np.ndarray) and said != "two corners":
        np.savez(tmp_path / "foreign.npz", occupancy=array, bounds=bounds)
        with pytest.raises((ConfigError, EmptyHullError), match=r"foreign\.npz"):
            Hull.load(tmp_path / "foreign.npz")


def test_load_takes_a_grid_made_elsewhere(tmp_path):
    grid = np.random.default_rng(0).random((5, 6, 7)).astype(np.float32)
    box = [[-1, -2, -3], [4, 4, 4]]
    np.savez_compressed(tmp_path / "foreign.npz", occupancy=grid, bounds=box)
    assert Hull.load(tmp_path / "foreign.npz") == Hull.from_grid(grid > 0.5, box)
    np.save(tmp_path / "grid.npy", grid)
    with pytest.raises(CheckpointError, match="occupancy="):
        Hull.load(tmp_path / "grid.npy")


def test_save_and_load_round_trip(tmp_path):
    random = np.random.default_rng(0)
    hull = Hull.from_grid(
        random.random((5, 6, 7)) < 0.5, [[-1, -2, -3], [4, 4, 4]], {"k": 3, "kind": "visdom"}
    )
    hull.save(tmp_path / "deep" / "hull.npz")
    back = Hull.load(tmp_path / "deep" / "hull.npz")
    assert back == hull and back.summary == hull.summary and back.occupancy.dtype == bool
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["hull.npz"]


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "hull.npz"
    ball(12).save(path)
    whole = path.read_bytes()
    for size in (0, 1, 50, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(CheckpointError):
            Hull.load(path)
    for at in range(30, len(whole), 97):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :])
        with contextlib.suppress(CheckpointError):
            assert Hull.load(path) == ball(12)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(CheckpointError):
        Hull.load(path)
    with pytest.raises(CheckpointError, match="no such"):
        Hull.load(tmp_path / "nothing.npz")


def test_a_writer_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def fail(file, **arrays):
        file.write(b"half")
        raise RuntimeError

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(RuntimeError):
        ball(12).save(path)
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_ply_opens_in_trimesh(tmp_path):
    hull = ball(16)
    hull.write_ply(tmp_path / "hull.ply")
    mesh = trimesh.load(tmp_path / "hull.ply", process=False)
    vertices, faces = hull.to_mesh()
    assert np.allclose(mesh.vertices, vertices, atol=1e-6) and np.array_equal(mesh.faces, faces)
    assert mesh.is_watertight and mesh.volume > 0


def test_pickle_and_deepcopy():
    hull = ball(12)
    hull.to_mesh()
    for other in (copy.deepcopy(hull), pickle.loads(pickle.dumps(hull))):
        assert other == hull and not other._derived


def test_a_hull_cannot_be_changed(tmp_path):
    made = ball(12)
    made.save(tmp_path / "hull.npz")
    np.savez(tmp_path / "foreign.npz", occupancy=made.occupancy, bounds=made.bounds)
    own = Hull(made.occupancy.copy(), made.bounds.copy())
    others = [Hull.load(tmp_path / name) for name in ("hull.npz", "foreign.npz")]
    others += [copy.deepcopy(made), copy.copy(made), pickle.loads(pickle.dumps(made)), own]
    for hull in (made, *others):
        voxels, extent, centre = hull.voxels, hull.extent.copy(), hull.centre.copy()
        for array in (hull.occupancy, hull.bounds, *hull.to_mesh()):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 0
        hull.extent[:] = 0
        hull.centre[:] = 9
        assert np.array_equal(hull.extent, extent) and np.array_equal(hull.centre, centre)
        assert hull.voxels == voxels == np.count_nonzero(hull.occupancy) and hull == made


def test_a_summary_is_the_hulls_own():
    given = {"k": 3}
    hull = Hull(np.ones((2, 2, 2), bool), np.array([[0.0] * 3, [1] * 3]), given)
    given["k"] = 4
    assert hull.summary == {"k": 3}


def test_a_giver_of_bounds_keeps_them():
    box = np.array([[0.0, 0, 0], [1, 1, 1]])
    hull = Hull(np.ones((2, 2, 2), bool), box)
    box[:] = 7
    assert hull.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]


def test_a_hull_with_something_replaced_knows_nothing_of_the_old_one():
    hull = ball(12)
    before = hull.centre
    moved = replace(hull, bounds=hull.bounds + 1)
    assert np.allclose(moved.centre, before + 1) and np.allclose(hull.centre, before)


def test_torch_may_write_nothing_and_says_nothing(recwarn):
    hull = ball(12)
    points = torch.zeros(3, 3)
    assert hull.contains(points).all() and hull.contains(points, margin_voxels=1).all()
    assert (
        cast_with_torch(hull, points, torch.eye(3)).hit.all() and cast(hull, points, torch.eye(3)).hit.all()
    )
    assert hull.sample_inside(4).shape == hull.sample_points(4).shape == (4, 3)
    assert not [w for w in recwarn if "writable" in str(w.message)]


@given(st.integers(0, 10**9), st.floats(0.02, 0.6))
@settings(max_examples=50, deadline=None)
def test_pieces_are_those_of_26_neighbours(seed, fill):
    from scipy import ndimage

    random = np.random.default_rng(seed)
    grid = random.random(random.integers(1, 20, 3)) < fill
    if random.random() < 0.5:
        grid = np.repeat(grid, 8, axis=2)
    labels, count = ndimage.label(grid, np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    pieces = find_pieces(grid)
    assert sorted(pieces.sizes) == sorted(sizes)
    for policy in ("all", "largest", "drop-small"):
        keep = choose_pieces(pieces.sizes, policy, 0.3)
        left = grid.copy()
        erase_pieces(left, pieces, keep)
        wanted = {
            "all": sizes > 0,
            "largest": sizes == sizes.max(initial=0),
            "drop-small": sizes >= 0.3 * sizes.max(initial=0),
        }
        allowed = grid & np.concatenate([[False], wanted[policy]])[labels]
        if policy == "largest":
            assert left.sum() == sizes.max(initial=0) and not (left & ~allowed).any()
        else:
            assert np.array_equal(left, allowed)


def test_a_hull_says_what_it_is_in_one_line():
    hull = Hull.from_grid(np.ones((2, 3, 4)), [[0, 0, 0], [1, 1.5, 2]])
    assert repr(hull) == "Hull(24 of 2x3x4 voxels, (0, 0, 0) .. (1, 1.5, 2))"
    carved = Hull(hull.occupancy, hull.bounds, {"kind": "visdom", "views": 4, "k": 3, "seconds": 0.2})
    assert repr(carved).endswith("(1, 1.5, 2), kind='visdom', views=4, k=3)")


def test_centre_of_more_planes_than_a_byte_counts():
    grid = np.zeros((600, 3, 5), bool)
    grid[10:590, 1, 2:] = True
    hull = Hull.from_grid(grid, np.array([[0, 0, 0], [600, 3, 5]]))
    assert hull.centre == pytest.approx([300, 1.5, 3.5], abs=1e-12)
