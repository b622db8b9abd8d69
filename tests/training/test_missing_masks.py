"""Views without a mask: what stands in for it, and that it teaches nothing wrong."""

import math
from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs.gs_go import SPEC
from visdom_plugin.errors import SceneError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.render import Render
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.evaluate import evaluate
from visdom_plugin.training.metrics import NAMES, PROTOCOL
from visdom_plugin.training.missing_masks import fill_masks, outline_views
from visdom_plugin.training.runs.run_directory import hash_views

DOMAIN = VisibleDomain(resolution=48)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def whole():
    return make_scene(SyntheticConfig(size=48, train_views=5, test_views=4))


def strip(views, without):
    """The views with some masks taken away."""
    masks = tuple(torch.ones_like(m) if i in without else m for i, m in enumerate(views.masks))
    origins = tuple("missing" if i in without else "given" for i in range(len(views)))
    return replace(views, masks=masks, mask_origins=origins)


def choose(views, kept):
    parts = ([getattr(views, name)[i] for i in kept] for name in ("images", "masks", "names"))
    return Views(views.cameras[kept], *parts)


@pytest.fixture(scope="module")
def bare(whole):
    return replace(whole, train=strip(whole.train, {4}), test=strip(whole.test, {1}))


@pytest.fixture(scope="module")
def others(whole):
    """The hull of the views that keep their mask."""
    part = choose(whole.train, [0, 1, 2, 3])
    return DOMAIN.carve(part.cameras, part.masks)


def test_nothing_missing_changes_nothing(whole):
    assert fill_masks(whole, "error") is whole and fill_masks(whole, "hull") is whole


def test_missing_masks_are_an_error_unless_asked_for(bare):
    with pytest.raises(
        SceneError, match=r"2 views have no mask: train_004, test_001[\s\S]*--data.missing-masks"
    ):
        fill_masks(bare, "error")
    lonely = replace(bare, train=strip(bare.train, {0, 1, 2, 4}))
    with pytest.raises(SceneError, match="only 1 training view has one"):
        fill_masks(lonely, "hull")


@pytest.mark.parametrize("way", ["hull", "colour"])
def test_the_outline_of_the_others_hull_stands_in_and_does_not_carve(whole, bare, others, way):
    filled = fill_masks(bare, way, DOMAIN)
    _, outline = depth_and_silhouette(others, whole.train.cameras[4])
    assert torch.equal(filled.train.masks[4], outline)
    # The hull holds the object where the others' masks are right.
    assert (whole.train.masks[4] & outline).sum() > 0.95 * whole.train.masks[4].sum()
    assert [filled.train.mask_origin(i) for i in range(5)] == ["given"] * 4 + [way]
    again = DOMAIN.carve(*filled.train.silhouettes())
    assert (again.occupancy == others.occupancy).all() and (again.bounds == others.bounds).all()
    assert filled.train.masks[0] is whole.train.masks[0] and len(filled.train.masks[:]) == 5
    assert filled.test is bare.test
    if way == "colour":
        assert torch.equal(filled.train.ignored(4), ~outline) and filled.train.ignored(0) is None
    else:
        assert not filled.train.ignore
    assert hash_views(filled.train) not in (hash_views(whole.train), hash_views(bare.train))


def test_what_was_ignored_stays_ignored(bare, others):
    ignore = torch.zeros(48, 48, dtype=torch.bool)
    ignore[:, 20:24] = True
    known = replace(bare, train=replace(bare.train, ignore=(ignore, None, None, None, ignore)))
    filled = fill_masks(known, "colour", DOMAIN)
    assert filled.train.ignored(4)[:, 20:24].all() and torch.equal(filled.train.ignored(0), ignore)


class Outline:
    """Draws the hull's outline, or the true silhouettes, in the true colours."""

    def __init__(self, views, masks):
        self._views, self._masks = views, masks

    def render(self, camera, background):
        same = (self._views.cameras.world_from_camera == camera.world_from_camera).flatten(1).all(1)
        i = int(same.nonzero())
        alpha = self._masks[i].float()
        rgb = torch.where(self._masks[i][..., None], self._views.images[i] / 255, background)
        return Render(rgb, alpha, alpha)


@pytest.mark.parametrize("way", ["hull", "colour"])
def test_a_test_view_without_a_mask_is_rendered_and_not_measured(whole, bare, others, way, tmp_path, caplog):
    """The means are those of the other views, and nobody is praised for filling the hull."""
    test = fill_masks(bare, way, DOMAIN).test
    assert "test views without a mask, 1 of 4" in caplog.text and "test_001" in caplog.text
    outlines = outline_views(others, whole.test, range(4))
    for masks in (whole.test.masks, outlines):
        method = Outline(whole.test, masks)
        keywords = {"reference_hull": others, "device": CPU}
        found = evaluate(method, test, folder=tmp_path, **keywords)
        wanted = evaluate(method, choose(whole.test, [0, 2, 3]), **keywords)
        assert found["measured_views"] == wanted["measured_views"] == 3 and found["protocol"] == PROTOCOL
        assert repr(found["test"]) == repr(wanted["test"])
        left_out = found["per_view"].pop("test_001")
        assert repr(found["per_view"]) == repr(wanted["per_view"])
        assert left_out.pop("mask_origin") == "missing" and list(left_out) == list(NAMES)
        assert all(math.isnan(value) for value in left_out.values())
        assert (tmp_path / "test" / "test_001.png").exists() and (tmp_path / "test_sheet.png").exists()


def test_masks_that_only_test_views_lack_need_no_hull(whole):
    gap = replace(whole, test=strip(whole.test, {0, 1, 2, 3}))
    with pytest.raises(SceneError, match="4 views have no mask"):
        fill_masks(gap, "error")
    one = replace(gap, train=choose(gap.train, [0]))
    assert fill_masks(one, "colour") is one
    found = evaluate(Outline(gap.test, gap.test.masks), gap.test, reference_hull=None, device=CPU)
    assert found["measured_views"] == 0 and all(map(math.isnan, found["test"].values()))


def train(scene, hull, steps):
    config = replace(SPEC.quick, steps=steps, initial_points=1500, hull=DOMAIN)
    method = GsGo(config)
    method.setup(scene.train, [], hull=hull, device=CPU, seed=0)
    data = DataManager(scene.train, 0)
    for step in range(steps):
        output = method.train_step(data.view_batch(step), step)
        output.total.backward()
        method.optimise(step, output)
    return method


def test_a_view_for_colour_only_gives_no_mask_loss_and_no_lesson_outside(bare, others):
    """What the photograph shows beside the others' hull makes no difference to any step."""
    filled = fill_masks(bare, "colour", DOMAIN)
    images = list(filled.train.images)
    images[4] = torch.where(filled.train.ignored(4)[..., None], 255 - images[4], images[4])
    changed = replace(filled, train=replace(filled.train, images=tuple(images)))
    states = [train(scene, others, 12).state_dict() for scene in (filled, changed)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    method = train(filled, others, 5)
    data = DataManager(filled.train, 0)
    known, unknown = (method.train_step(data.view(i), 5).losses for i in (0, 4))
    assert "mask" in known and "mask" not in unknown


@pytest.mark.slow
def test_a_view_for_colour_only_is_better_than_none(whole):
    """Two of five masks are missing: the colours of those two views help."""
    few = [0, 1, 2]
    domain = replace(DOMAIN, k=3)
    bare = replace(whole, train=strip(whole.train, {3, 4}))
    coloured = fill_masks(bare, "colour", domain)
    left_out = Scene(whole.name, choose(whole.train, few), whole.test)
    hull = domain.carve(*coloured.train.silhouettes())
    scores = {
        name: evaluate(train(scene, hull, 100), whole.test, reference_hull=None, device=CPU)["test"]["psnr"]
        for name, scene in (("colour", coloured), ("left out", left_out))
    }
    assert scores["colour"] > scores["left out"]


def test_without_any_mask_all_commands_say_how_to_make_some(whole):
    nothing = replace(whole, train=strip(whole.train, range(5)), test=strip(whole.test, range(4)))
    with pytest.raises(
        SceneError, match=r"none of the 5 training views has a foreground mask[\s\S]*masks/<ph"
    ):
        nothing.train.silhouettes()
    with pytest.raises(SceneError, match=r"only 0 training views have one: a hull needs two"):
        fill_masks(nothing, "hull")


def test_without_any_mask_photographs_are_trained_on_as_they_are(whole, caplog):
    nothing = replace(whole, train=strip(whole.train, range(5)), test=strip(whole.test, range(4)))
    filled = fill_masks(nothing, "colour").train
    assert not filled.has_masks and set(filled.mask_origins) == {"whole"} and "as they are" in caplog.text
    batch = DataManager(filled, 0).view(2)
    assert batch.mask_known and bool((batch.mask == 1).all()) and batch.weight is None
