"""GaussianObject from its first to its last step: stages follow each other, and its state is all there is."""

from dataclasses import replace

import pytest
import torch

from method_configs.gaussian_object import SPEC
from tests.methods.short_runs import CPU, advance, copy_of, same, set_up
from visdom_plugin.errors import CheckpointError, SceneError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.repair.gaussian_object import GaussianObject
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.training.runs import checkpoints

COARSE, LOO, TUNING, REPAIR = 12, 12 + 72, 12 + 72 + 6, 12 + 72 + 6 + 10
CUTS = {
    "coarse": 7,
    "the end of the coarse stage": COARSE,
    "a view is left out": COARSE + 4,
    "the view is back": COARSE + 8,
    "the end of the run": COARSE + 12,
    "its twin": COARSE + 15,
    "the next view is left out": COARSE + 18,
    "the end of the last view": LOO,
    "fine-tuning": LOO + 3,
    "the end of fine-tuning": TUNING,
    "repair, just before other views": TUNING + 4,
    "repair": TUNING + 6,
    "repair is over": TUNING + 8,
    "the end": REPAIR,
}


def start(scene, hull, config, hooks=None):
    return set_up(GaussianObject, config, scene, hull, hooks)


@pytest.fixture(scope="module")
def straight(scene, hull, small):
    """The state at each cut of a run without interruption, and the method at its end."""
    torch.manual_seed(1)
    method, states, done = start(scene, hull, small), {}, 0
    assert method.total_steps == REPAIR
    for step in CUTS.values():
        advance(method, scene, range(done, step))
        states[step], done = copy_of(method), step
    return method, states


@pytest.mark.parametrize("where", CUTS)
def test_a_run_killed_in_any_stage_goes_on_as_if_it_had_not_been(
    where, straight, scene, hull, small, tmp_path
):
    _, states = straight
    cut, steps = CUTS[where], list(CUTS.values())
    torch.manual_seed(2)
    checkpoints.save(tmp_path, cut, states[cut], {})
    resumed = start(scene, hull, small)
    resumed.load_state_dict(checkpoints.load(tmp_path, cut).tensors)
    assert same(copy_of(resumed), states[cut])
    if cut < REPAIR:
        until = steps[steps.index(cut) + 1]
        advance(resumed, scene, range(cut, until))
        assert same(copy_of(resumed), states[until])


def test_the_curve_is_marked_where_stages_begin_networks_or_not(scene):
    config = replace(SPEC.quick, hull=VisibleDomain(resolution=48), initial_points=300)
    coarse, loo, tuning = (
        config.steps,
        4 * (2 * config.loo.steps - config.loo.view_returns),
        config.lora.steps,
    )
    method = set_up(
        GaussianObject, config, scene, config.hull.carve(scene.train.cameras, scene.train.masks), hooks=[]
    )
    starts = {"leave-one-out": coarse, "fine-tuning": coarse + loo, "repair": coarse + loo + tuning}
    marked = {f"{stage} begins": [step] for stage, step in starts.items()}
    assert method.events() == method.coarse.events() | marked and method.coarse.events()


def test_the_coarse_stage_is_3dgs_go(straight, scene, hull, small):
    _, states = straight
    coarse = set_up(GsGo, small, scene, hull)
    advance(coarse, scene, range(7))
    assert same(
        {k.removeprefix("stage."): v for k, v in states[7].items() if k != "steps_done"}, copy_of(coarse)
    )


def test_every_stage_leaves_what_the_next_ones_need_and_no_more(straight):
    _, states = straight
    left = {step: {k.split(".")[1] for k in state if k.startswith("left.")} for step, state in states.items()}
    assert left[7] == set() and left[COARSE] == {"coarse"}
    assert left[LOO] == {"coarse", "renders", "noise", "networks"}
    assert left[TUNING] == {"coarse", "lora", "networks"}
    assert left[TUNING + 8] == left[REPAIR] == set()


def test_what_is_shown_is_the_coarse_model_until_the_repair_and_then_the_repaired_one(
    straight, scene, tmp_path
):
    method, states = straight
    assert method.summary()["stage"] == 4
    coarse, repaired = (states[step] for step in (TUNING, REPAIR))
    assert torch.equal(coarse["left.coarse.means"], coarse["stage.run.means"])
    assert method.summary()["gaussians"] == len(repaired["stage.run.means"])
    assert [path.name for path in method.export(tmp_path)] == ["point_cloud.ply"]


def test_a_finished_run_is_shown_without_the_networks(straight, scene, hull, small):
    method, states = straight
    lost = replace(small, weights=replace(small.weights, folder=small.weights.folder / "gone"))
    again = start(scene, hull, lost)
    again.load_state_dict(states[REPAIR])
    shown = [m.render(scene.train.cameras[0], torch.ones(3)).rgb for m in (method, again)]
    assert torch.equal(*shown)


def test_other_networks_than_those_of_the_run_are_refused(straight, scene, hull, small, tmp_path):
    import shutil

    _, states = straight
    other = tmp_path / "other"
    shutil.copytree(small.weights.folder, other)
    path = other / "stable-diffusion-v1-5" / "unet" / "diffusion_pytorch_model.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))
    method = start(scene, hull, replace(small, weights=replace(small.weights, folder=other)))
    with pytest.raises(CheckpointError, match="other networks"):
        method.load_state_dict(states[LOO + 3])


def test_one_view_cannot_be_left_out(scene, hull, small):
    with pytest.raises(SceneError, match="leaves out one training view"):
        GaussianObject(small).setup(scene.train.take([0]), [], hull=hull, device=CPU, seed=0)
