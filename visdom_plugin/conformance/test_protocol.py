"""Tests of what any trainer relies on."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import torch

from visdom_plugin.conformance.report import require
from visdom_plugin.conformance.subject import CPU, copy_state, difference, scene
from visdom_plugin.render import Render
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.protocols import Method, StepOutput
from visdom_plugin.training.run import choose_batches

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")),
]


def test_the_schedule_has_a_length(subject):
    total = getattr(subject.start(), "total_steps", None)
    require(
        isinstance(total, int) and not isinstance(total, bool) and total >= 1,
        f"total_steps is {total!r}",
        Method,
        "set self.total_steps to a whole number, 1 or more, in __init__",
    )


def test_losses_are_named_finite_scalars(subject):
    for step, losses in enumerate(subject.trained.losses):
        for name, value in losses.items():
            require(
                isinstance(name, str) and value.shape == () and value.is_floating_point(),
                f"train_step({step}) returned {name!r} of shape {tuple(value.shape)} and {value.dtype}",
                StepOutput,
                "name scalar tensors, as in StepOutput({'colour': error.mean()})",
            )
            require(
                bool(value.isfinite()),
                f"train_step({step}) returned {name!r} = {float(value)}",
                StepOutput,
                "keep logarithms and divisions away from 0; leave a loss that does not apply out of the dict",
            )


def test_batches_are_left_as_they_were(subject):
    method = subject.start()
    batch = choose_batches(method, DataManager(scene().train, 0))(0)
    before = copy.deepcopy(batch)
    method.train_step(batch, 0)
    changed = [
        name
        for name, value in vars(before).items()
        if isinstance(value, torch.Tensor) and not torch.equal(value, getattr(batch, name))
    ]
    require(
        not changed,
        f"train_step changed the batch's {', '.join(changed)}",
        Method.train_step,
        "leave out operations in place (those that end in _) on what the batch holds, or clone it first",
    )


def test_renders_have_the_promised_shapes_and_ranges(subject):
    camera = scene().test.cameras[0]
    height, width = int(camera.height), int(camera.width)
    render = subject.trained.method.render(camera, torch.ones(3))
    shapes = {"rgb": (height, width, 3), "alpha": (height, width), "depth": (height, width)}
    for name, shape in shapes.items():
        value = getattr(render, name)
        require(
            tuple(value.shape) == shape and value.is_floating_point() and bool(value.isfinite().all()),
            f"render().{name} has shape {tuple(value.shape)}, {value.dtype}, "
            f"{int((~value.isfinite()).sum())} values that are no numbers; wanted: {shape}, finite floats",
            Render,
            "rows first: (height, width, ...)",
        )
        require(
            not value.requires_grad, f"render().{name} has a gradient", Method.render, "use torch.no_grad()"
        )
    low, high = float(render.alpha.min()), float(render.alpha.max())
    require(
        low >= 0 and high <= 1 + 1e-5,
        f"render().alpha is in [{low:.4g}, {high:.4g}], not in [0, 1]",
        Render,
        "alpha is the share of the light that the method's content stops",
    )
    require(
        float(render.depth.min()) >= 0,
        f"render().depth goes down to {float(render.depth.min()):.4g}",
        Render,
        "depth is measured along the camera's z axis, which looks forward; it is 0 where alpha is",
    )


def test_the_background_shows_where_nothing_is(subject):
    camera, method = scene().test.cameras[0], subject.trained.method
    white, other = torch.ones(3), torch.tensor([0.1, 0.5, 0.0])
    one, two = (method.render(camera, background) for background in (white, other))
    wanted = (1 - one.alpha)[..., None] * (white - other)
    error = float((one.rgb - two.rgb - wanted).abs().max())
    require(
        error < 1e-3,
        f"on another background, render().rgb changes by up to {error:.3g} more or less than (1 - alpha) of it",
        Render,
        "rgb = foreground + (1 - alpha) * background; do not clamp rgb",
    )


def test_rendering_leaves_no_trace(subject):
    n, method = subject.short, subject.start()
    cameras = scene().test.cameras
    subject.run(method, 0, n // 2)
    before = copy_state(method)
    for i in range(2):
        method.render(cameras[i], torch.ones(3))
    changed = difference(before, copy_state(method))
    require(
        not changed,
        f"render() changed the method's state: {changed}",
        Method.render,
        "render from what is there",
    )
    states = subject.run(method, n // 2, n).states
    changed = difference(subject.trained.states[n], states[n])
    require(
        not changed,
        f"training that was looked at on the way goes on otherwise: {changed}",
        Method.render,
        "let render() write to nothing that train_step reads",
    )


def test_exported_files_can_be_read(subject, tmp_path):
    written = subject.trained.method.export(tmp_path)
    for path in written:
        require(
            Path(path).is_file() and tmp_path in Path(path).parents,
            f"export() names {path}, which is no file in the folder it was given",
            Method.export,
            "write into the folder, and return the paths of the files written",
        )
        try:
            read_back(Path(path))
        except Exception as error:
            require(
                False,
                f"{Path(path).name} cannot be read back: {type(error).__name__}: {error}",
                Method.export,
                "write standard formats; trimesh reads meshes and point clouds, numpy arrays",
            )


def read_back(path: Path) -> None:
    """Raises whatever is wrong with a file of a known format, and ValueError for an empty one."""
    if path.stat().st_size == 0:
        raise ValueError("the file is empty")
    if path.suffix in (".ply", ".obj", ".glb", ".stl", ".off"):
        import trimesh

        found = trimesh.load(path, process=False)
        if not np.isfinite(found.bounds).all():
            raise ValueError("it has no finite bounds")
    elif path.suffix in (".npy", ".npz"):
        np.load(path, allow_pickle=False)
    elif path.suffix == ".safetensors":
        from safetensors.torch import load_file

        load_file(path)


@pytest.mark.parametrize("device", DEVICES)
def test_devices_and_dtypes_are_respected(subject, device):
    target = torch.device(device)
    method = subject.trained.method if target == CPU else subject.start(device=target)
    data = DataManager(scene().train, 0, device=target)
    if target != CPU:
        output = method.train_step(choose_batches(method, data)(0), 0)
        require(
            all(v.device.type == device for v in output.losses.values()),
            f"losses are on {[str(v.device) for v in output.losses.values()]}, the method on {device}",
            Method.train_step,
            "make tensors on the device that setup() was given",
        )
        output.total.backward()
        method.optimise(0, output)
    shown = {}
    for dtype in (torch.float64, torch.float32):
        camera = scene().test.cameras[0].to(target, dtype)
        try:
            shown[dtype] = method.render(camera, torch.ones(3, dtype=dtype, device=target))
        except RuntimeError as error:
            require(
                False,
                f"render() fails on {device} with a camera and background of {dtype}: {error}",
                Method.render,
                "turn the camera's tensors into the method's dtype first",
            )
        require(
            shown[dtype].rgb.device.type == device,
            f"render().rgb is on {shown[dtype].rgb.device}, the method on {device}",
            Method.render,
            "return what is rendered on the device that setup() was given",
        )
    gap = (shown[torch.float64].rgb.double() - shown[torch.float32].rgb.double()).abs().median()
    require(
        float(gap) < 1e-3,
        f"the same camera in float32 and float64 shows colours that differ by {float(gap):.3g}",
        Method.render,
        "turn the camera's tensors into the method's dtype first",
    )
