"""Hulls of a run are carved once: its method's, and the reference of its metrics where that is another."""

import json

import pytest
import torch

from tests.training.fake import FakeConfig, fake_registry
from visdom_plugin.errors import EmptyHullError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.training import run as runs

CPU = torch.device("cpu")
OWN = VisibleDomain(dilate_px=1, resolution=24)


@pytest.fixture
def carved(monkeypatch):
    """The domains carved, in order."""
    domains, carve = [], VisibleDomain.carve

    def noted(domain, cameras, masks, ignore=()):
        domains.append(domain)
        # The default one at a size that costs nothing.
        return carve(VisibleDomain(dilate_px=domain.dilate_px, resolution=24), cameras, masks, ignore)

    monkeypatch.setattr(VisibleDomain, "carve", noted)
    return domains


def measure_again(config, scene, path):
    preset = fake_registry().find("fake")
    method, hull, _ = runs.restore(preset, config, scene.train, path, device=CPU, seed=0)
    return runs.evaluate_again(method, config, hull, scene, device=CPU, run_dir=path), hull


def test_a_finished_run_carves_nothing_again(train, carved, scene, tmp_path):
    record = train(FakeConfig(hull=OWN))
    assert carved == [OWN, VisibleDomain()]
    again, hull = measure_again(FakeConfig(hull=OWN), scene, tmp_path / "run")
    assert len(carved) == 2 and again["metrics"] == record["metrics"]
    assert hull == Hull.load(tmp_path / "run" / "hull" / "hull.npz")
    reference = Hull.load(tmp_path / "run" / "hull" / "reference.npz")
    assert reference.voxels < hull.voxels


def test_the_reference_is_the_methods_own_hull_where_they_are_the_same(train, carved, scene, tmp_path):
    config = FakeConfig(hull=VisibleDomain())
    train(config)
    measure_again(config, scene, tmp_path / "run")
    assert carved == [VisibleDomain()]
    assert not (tmp_path / "run" / "hull" / "reference.npz").exists()


def test_a_run_that_goes_on_keeps_its_hull_and_its_carving_time(train, carved, tmp_path):
    record = train(FakeConfig(hull=OWN))
    path = tmp_path / "run" / "run.json"
    path.write_text(json.dumps(record | {"status": "interrupted"}))
    resumed = train(FakeConfig(hull=OWN))
    assert len(carved) == 2 and resumed["status"] == "finished"
    assert resumed["timing"]["hull_s"] == record["timing"]["hull_s"] > 0


def test_a_damaged_hull_is_carved_again_and_said(train, carved, scene, tmp_path, caplog):
    record = train(FakeConfig(hull=OWN))
    (tmp_path / "run" / "hull" / "reference.npz").write_bytes(b"PK")
    again, _ = measure_again(FakeConfig(hull=OWN), scene, tmp_path / "run")
    assert len(carved) == 3 and "carved again" in caplog.text
    assert again["metrics"] == record["metrics"]
    measure_again(FakeConfig(hull=OWN), scene, tmp_path / "run")
    assert len(carved) == 3


def test_without_a_reference_its_metric_is_left_out(train, monkeypatch, tmp_path):
    def empty(domain, cameras, masks, ignore=()):
        raise EmptyHullError("nothing is left")

    monkeypatch.setattr(VisibleDomain, "carve", empty)
    record = train()
    assert record["metrics"]["test"]["outside_hull_mass"] is None
    assert not (tmp_path / "run" / "hull" / "reference.npz").exists()
