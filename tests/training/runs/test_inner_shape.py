"""Gaussians that start in the shape inside the hull: found once, kept beside the hull, which stays as it is."""

import json
from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.scene import SyntheticConfig, make_scene
from method_configs import corgs_lite, gs_go
from tests.methods.short_runs import set_up
from visdom_plugin import registry
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.inside import shape
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import build, train
from visdom_plugin.training.runs.saved_hulls import find_hull

CPU = torch.device("cpu")
DOMAIN = VisibleDomain(resolution=40)
PRESETS = {p.name: p for spec in (gs_go.SPEC, corgs_lite.SPEC) for p in spec.presets().values()}


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=40))


def settings(name, **changes):
    small = replace(PRESETS[name].quick, steps=2, initial_points=300, hull=replace(DOMAIN))
    return replace(small, **{"initial_shape": "inside"} | changes)


@pytest.fixture
def searches(monkeypatch):
    """The settings of every search for a shape."""
    made, search = [], shape.shape_inside

    def noted(hull, cameras, masks, ignore=(), config=None, images=None):
        made.append(config)
        return search(hull, cameras, masks, ignore, config, images)

    monkeypatch.setattr(shape, "shape_inside", noted)
    return made


@pytest.mark.parametrize("name", ["3dgs-go", "3dgs-go+mask", "3dgs-go+vd", "corgs-lite", "corgs-lite+vd"])
def test_every_variant_starts_inside_the_shape(name, scene):
    config = settings(name)
    method, hull, _ = build(PRESETS[name], config, scene.train, device=CPU, seed=0)
    splats = method.splats if hasattr(method, "splats") else method.sets[0]
    assert hull.inner.voxels < hull.voxels and not (hull.inner.occupancy & ~hull.occupancy).any()
    assert hull.inner.contains(splats.means.double(), margin_voxels=1).all()
    method, hull, _ = build(
        PRESETS[name], replace(config, initial_shape="hull"), scene.train, device=CPU, seed=0
    )
    splats = method.splats if hasattr(method, "splats") else method.sets[0]
    assert hull.inner is None and not inner_of(hull, scene).contains(splats.means).all()


def inner_of(hull, scene):
    return shape.shape_inside(hull, *scene.train.silhouettes())


def test_the_hook_goes_by_the_hull(scene):
    config = settings("3dgs-go+vd")
    hull = DOMAIN.carve(*scene.train.silhouettes())
    with_inner = replace(hull, inner=inner_of(hull, scene))
    plain, inside = (
        set_up(PRESETS["3dgs-go+vd"].load(), config, scene, h).hooks[0] for h in (hull, with_inner)
    )
    generators = [torch.Generator().manual_seed(3) for _ in range(2)]
    drawn = [hook._draw(g)[1] for hook, g in zip((plain, inside), generators, strict=True)]
    assert torch.equal(*drawn) and not torch.equal(plain.initial_points(50)[0], inside.initial_points(50)[0])


def test_a_shift_moves_the_shape_with_its_hull(scene):
    hull = DOMAIN.carve(*scene.train.silhouettes())
    hull = replace(hull, inner=inner_of(hull, scene))
    moved = hull.relative_to((1.0, -2.0, 3.0))
    assert moved.inner == hull.inner.relative_to((1.0, -2.0, 3.0))


def test_a_run_keeps_the_shape_and_does_not_search_again(scene, searches, tmp_path, monkeypatch):
    config = settings("3dgs-go+vd", inside=InsideConfig(radius=1.5))
    monkeypatch.setattr(registry, "find", lambda name: PRESETS[name])
    tiny = replace(scene, test=scene.test.take([0]))

    def run():
        return train("3dgs-go+vd", config, tiny, data_manager=DataManager, run_dir=tmp_path, quiet=True)

    record = run()
    assert searches == [InsideConfig(radius=1.5)]
    assert record["config"]["initial_shape"] == "inside" and record["config"]["inside"]["radius"] == 1.5
    hull, inner = (Hull.load(tmp_path / "hull" / name) for name in ("hull.npz", "inside.npz"))
    assert inner == shape.shape_inside(hull, *scene.train.silhouettes(), config=config.inside)
    assert (tmp_path / "hull" / "inside.ply").is_file()
    path = tmp_path / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"status": "interrupted"}))
    del searches[:]
    assert run()["metrics"]["test"] == record["metrics"]["test"] and not searches


@pytest.mark.parametrize("without", [None, 1])
def test_photographs_have_their_say_each_of_its_own_view(without):
    views = make_scene(SyntheticConfig(size=48, train_views=5)).train
    if without is not None:
        views = replace(views, mask_origins=tuple("missing" if i == without else "given" for i in range(5)))
    config = settings("3dgs-go+vd", inside=InsideConfig(photo_weight=0.4, photo_tolerance=0.1))
    hull = find_hull(config, views, None)
    left = views.take([i for i in range(5) if i != without])
    alone = shape.shape_inside(hull, *left.silhouettes())
    assert hull.inner == shape.shape_inside(
        hull, *left.silhouettes(), config=config.inside, images=left.images
    )
    assert hull.inner.voxels < alone.voxels


@pytest.mark.parametrize(
    ("views", "k", "why"), [([0, 2], 2, "from 2 views"), ([0, 1, 2, 3], 1, "of kind visdom with K = 1")]
)
def test_where_there_is_no_such_shape_the_log_says_why_and_the_hull_is_the_start(
    views, k, why, scene, caplog
):
    config, views = settings("3dgs-go+vd", hull=replace(DOMAIN, k=k)), scene.train.take(views)
    starts = []
    for initial_shape in ("inside", "hull"):
        one = replace(config, initial_shape=initial_shape)
        method, hull, _ = build(PRESETS["3dgs-go+vd"], one, views, device=CPU, seed=0)
        assert hull.inner is None
        starts.append(method.splats.means)
    assert torch.equal(*starts)
    said = [
        r.message for r in caplog.records if "goes by the hull alone, not by the shape inside it" in r.message
    ]
    assert len(said) == 1 and why in said[0]
