"""A method set up and trained for a few steps on a small scene."""

import torch

from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import choose_batches

CPU = torch.device("cpu")


def set_up(method_class, config, scene, hull, hooks=None, seed=0):
    """The method before its first step; by default with the hook of its config."""
    method = method_class(config)
    hooks = [config.vd.build(hull, scene.train)] if hooks is None else hooks
    method.setup(scene.train, hooks, hull=hull, device=CPU, seed=seed)
    return method


def advance(method, scene, steps):
    """Trains the given steps; returns the loss of each."""
    batches, history = choose_batches(method, DataManager(scene.train, seed=0)), []
    for step in steps:
        output = method.train_step(batches(step), step)
        output.total.backward()
        method.optimise(step, output)
        history.append(float(output.total.detach()))
    return history


def copy_of(method):
    """The state now."""
    return {k: v.clone() for k, v in method.state_dict().items()}


def same(a, b):
    """Whether two states agree in every bit."""
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
