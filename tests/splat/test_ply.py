"""Point clouds survive the way to disk and back; damaged ones are refused with a reason."""

import numpy as np
import pytest
import torch

from tests.splat.twin import make_gaussians
from visdom_plugin.errors import SceneError
from visdom_plugin.splat.ply import read_ply, write_gaussians


@pytest.mark.parametrize("n", [0, 1, 50])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip_is_exact(tmp_path, n, degree):
    gaussians = make_gaussians(n=n, degree=degree, dtype=torch.float32)
    write_gaussians(tmp_path / "a.ply", gaussians)
    back = read_ply(tmp_path / "a.ply")
    for name, value in gaussians.tensors().items():
        assert torch.equal(getattr(back, name), value.detach()), name
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_layout_is_that_of_3dgs(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    gaussians = make_gaussians(n=5, dtype=torch.float32).detach()
    write_gaussians(tmp_path / "a.ply", gaussians)
    data = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [*(f"f_rest_{i}" for i in range(45)), "opacity", "scale_0", "scale_1", "scale_2"]
    assert list(data.dtype.names) == names + [f"rot_{i}" for i in range(4)]
    # All 15 coefficients of red come first.
    assert np.array_equal(data["f_rest_14"].ravel(), gaussians.sh[:, 15, 0].numpy())
    assert np.array_equal(data["f_rest_15"].ravel(), gaussians.sh[:, 1, 1].numpy())
    assert np.array_equal(data["rot_0"].ravel(), gaussians.quaternions[:, 0].numpy())


def test_other_order_types_and_extra_properties_are_read(tmp_path):
    names = ["extra", "rot_3", "rot_2", "rot_1", "rot_0", "opacity", "f_dc_2", "f_dc_1", "f_dc_0"]
    names += ["scale_2", "scale_1", "scale_0", "z", "y", "x"]
    table = np.arange(2 * len(names), dtype="<f8").reshape(2, -1)
    header = "ply\nformat binary_little_endian 1.0\ncomment of no matter\nelement vertex 2\n"
    header += "".join(f"property double {n}\n" for n in names)
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + table.tobytes() + b"\x01\x00\x00\x00\x00")
    gaussians = read_ply(tmp_path / "a.ply")
    assert gaussians.means.tolist() == [[14, 13, 12], [29, 28, 27]]
    assert gaussians.quaternions[0].tolist() == [4, 3, 2, 1]
    assert gaussians.sh.shape == (2, 1, 3) and gaussians.opacity_logits.tolist() == [5, 20]


def damage(change):
    def broken(tmp_path):
        write_gaussians(tmp_path / "a.ply", make_gaussians(n=9, dtype=torch.float32))
        data = change((tmp_path / "a.ply").read_bytes())
        (tmp_path / "a.ply").write_bytes(data)
        return tmp_path / "a.ply"

    return broken


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda folder: folder / "none.ply", "cannot read"),
        (lambda folder: folder, "cannot read"),
        (damage(lambda d: d[:-1]), "ends after"),
        (damage(lambda d: d[:300]), "header is cut off"),
        (damage(lambda d: b""), "not a PLY"),
        (damage(lambda d: d.replace(b"binary_little", b"binary_big_xy")), "little endian"),
        (damage(lambda d: d.replace(b"vertex 9", b"vertex x")), "'x'"),
        (damage(lambda d: d.replace(b"vertex 9", b"vertex -1")), "'-1'"),
        (damage(lambda d: d.replace(b"vertex 9", b"vertex 99999999999999")), "ends after"),
        (damage(lambda d: d.replace(b"float opacity", b"float opasity")), "lacks opacity"),
        (damage(lambda d: d.replace(b"float opacity", b"flot opacity")), "not understood"),
        (damage(lambda d: d.replace(b"property float f_rest_44\n", b"")), "44 f_rest"),
    ],
)
def test_damage_is_refused(tmp_path, make, message):
    with pytest.raises(SceneError, match=message):
        read_ply(make(tmp_path))
