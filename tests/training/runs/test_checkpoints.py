"""A state comes back bit for bit, or not at all."""

from __future__ import annotations

import json

import pytest
import torch

from visdom_plugin.atomic_files import MARK, appearing, remove_parts, write_json
from visdom_plugin.errors import CheckpointError
from visdom_plugin.training.runs import checkpoints


def _state(step: int) -> dict[str, torch.Tensor]:
    draw = torch.Generator().manual_seed(step)
    whole = torch.rand(5, 3, generator=draw)
    return {
        "float": whole,
        "shared": whole[1:],
        "strided": whole.T,
        "empty": torch.zeros(0, 3),
        "scalar": torch.tensor(float("-0.0")),
        "bool": whole[:, 0] > 0.5,
        "long": torch.tensor([2**62, -1]),
        "double": torch.tensor([1e-300, float("inf")], dtype=torch.float64),
    }


def _same(a, b) -> bool:
    return set(a) == set(b) and all(
        a[k].dtype == b[k].dtype and a[k].shape == b[k].shape and torch.equal(a[k], b[k]) for k in a
    )


def test_every_kind_of_tensor_comes_back_and_two_states_are_kept(tmp_path):
    for step in (1, 20, 300):
        checkpoints.save(tmp_path, step, _state(step), {"train_s": 0.5})
    assert checkpoints.list_steps(tmp_path) == [20, 300]
    assert len(list(tmp_path.iterdir())) == 4
    found = checkpoints.load_newest(tmp_path)
    assert found.step == 300 and found.notes == {"train_s": 0.5} and _same(found.tensors, _state(300))


def _cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def _flip(path):
    data = bytearray(path.read_bytes())
    data[-3] ^= 4
    path.write_bytes(bytes(data))


def _lose(path):
    path.unlink()


@pytest.mark.parametrize(
    ("suffix", "damage"),
    # Not a flip in the JSON: one letter changed may leave the same JSON.
    [
        (".safetensors", _cut),
        (".safetensors", _flip),
        (".safetensors", _lose),
        (".json", _cut),
        (".json", _lose),
    ],
)
def test_a_damaged_state_gives_way_to_the_one_before(tmp_path, damage, suffix):
    for step in (1, 2):
        checkpoints.save(tmp_path, step, _state(step), {})
    damage(tmp_path / f"step-00000002{suffix}")
    found = checkpoints.load_newest(tmp_path)
    assert found.step == 1 and _same(found.tensors, _state(1))
    with pytest.raises(CheckpointError):
        checkpoints.load(tmp_path, 2)


def test_without_any_whole_state_there_is_none(tmp_path):
    assert checkpoints.load_newest(tmp_path) is None
    _flip(checkpoints.save(tmp_path, 3, _state(3), {}))
    assert checkpoints.load_newest(tmp_path) is None


def test_a_file_appears_whole_or_the_old_one_stays(tmp_path):
    path = tmp_path / "deep" / "x.json"
    write_json(path, {"a": [1.5, float("nan"), {"b": float("inf")}]})
    assert json.loads(path.read_text()) == {"a": [1.5, None, {"b": None}]}
    before = path.read_bytes()
    with pytest.raises(RuntimeError), appearing(path) as part:
        part.write_bytes(b"half")
        raise RuntimeError
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == ["x.json"]
    (path.parent / f"{MARK}left").write_text("by a killed process")
    (path.parent / f".{MARK}left.tmp").write_text("by a writer inside")
    (tmp_path / f"{MARK}folder").mkdir()
    remove_parts(tmp_path)
    assert [p.name for p in tmp_path.rglob("*")] == ["deep", "x.json"]
