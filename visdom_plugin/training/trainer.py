"""The loop: batch, losses, backward, optimiser, log, checkpoint; resumable at any step."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import torch

from visdom_plugin.errors import PluginError, VisDomError
from visdom_plugin.render import quantise
from visdom_plugin.scene import Views
from visdom_plugin.training import metrics
from visdom_plugin.training.progress import Progress
from visdom_plugin.training.protocols import Batch, Method, StepOutput
from visdom_plugin.training.runs import checkpoints
from visdom_plugin.training.runs.run_directory import Record, RunDir

log = logging.getLogger(__name__)

LOGGED = 100
"""Lines in log.jsonl over the whole schedule."""
SNAPSHOTS = "snapshots"
"""Folder of a run directory with the states kept on the way."""
CUDA_CHECK_EVERY = 20
"""On CUDA, reading the loss stalls the device: NaN is looked for on every n-th step and before saving."""


class TrainingError(VisDomError):
    """The optimisation went wrong."""


class Trainer:
    """Runs a method that was set up, from its newest checkpoint to the end of its schedule.

    On the CPU the state after step n is a pure function of config, data and seed, for a fixed number of
    threads (`OMP_NUM_THREADS`): when checkpoints are taken, and how often the run was killed, leaves no trace.
    """

    def __init__(
        self,
        method: Method,
        batch_of: Callable[[int], Batch],
        run: RunDir,
        *,
        device: torch.device,
        quiet: bool = False,
        checkpoint_seconds: float = 30,
        train_psnr: Callable[[int], float] | None = None,
        watch: Callable[[Record], str | None] = lambda _: None,
        snapshots: int = 0,
    ):
        """
        Args:
            batch_of: the batch of a step, a pure function.
            run: opened run directory.
            checkpoint_seconds: time between two checkpoints; one is always taken at the end.
            train_psnr: PSNR of a training view for the progress line, a function of the step; used where the
                method's steps give no metric "psnr" of their own.
            watch: is handed each line of the log; what it returns is said beside the progress.
            snapshots: how many states, evenly spaced over the schedule up to its end, are kept beside the
                checkpoints.
        """
        self.method, self.batch_of, self.run_dir = method, batch_of, run
        self.device, self.quiet, self.checkpoint_seconds = device, quiet, checkpoint_seconds
        self.train_psnr, self.watch = train_psnr, watch
        self.snapshots = snapshots
        self.folder = run.path / "checkpoints"
        self.step, self.train_s = 0, 0.0
        self.stopped = False
        self.resumed_from: int | None = None

    def run(self) -> bool:
        """Trains to the end; False when a signal asked it to stop (the state is saved then).

        Raises:
            TrainingError: when the loss is no longer finite.
        """
        self._resume()
        total = self.method.total_steps
        keep_at = {round(total * (i + 1) / self.snapshots) for i in range(self.snapshots)}
        log_every = max(1, total // LOGGED)
        check_every = CUDA_CHECK_EVERY if self.device.type == "cuda" else 1
        loss = psnr = None
        saved = time.monotonic()
        with (
            _signals(self._stop),
            Progress(total, self.step, quiet=self.quiet) as progress,
        ):
            while self.step < total and not self.stopped:
                began = time.monotonic()
                output = self.method.train_step(self.batch_of(self.step), self.step)
                total_loss = _check_output(output, self.method).total
                due = (self.step + 1) % log_every == 0 or self.step + 1 == total
                save = began - saved >= self.checkpoint_seconds or self.step + 1 == total or self.stopped
                if due or save or (self.step + 1) % check_every == 0:
                    loss = float(total_loss.detach())
                    if not abs(loss) < float("inf"):
                        self._fail(output)
                total_loss.backward()
                self.method.optimise(self.step, output)
                self.step += 1
                self.train_s += time.monotonic() - began
                if due:
                    psnr = self._measure_psnr(output, log_every)
                    row = {"step": self.step, "loss": loss}
                    row |= {f"loss_{k}": float(v.detach()) for k, v in output.losses.items()}
                    row |= summarise(self.method)
                    row |= {"psnr": psnr, "train_s": round(self.train_s, 3)}
                    self.run_dir.log(row)
                if self.step in keep_at:
                    self._save_to(self.run_dir.path / SNAPSHOTS, kept=None)
                if save:
                    self._save()
                    saved = time.monotonic()
                progress.show(self.step, loss, psnr, summarise(self.method))
                if due and (said := self.watch(row)) is not None:
                    progress.say(said)
        if self.stopped and self.step < total:
            self._save()
            return False
        return True

    def _resume(self) -> None:
        found = checkpoints.load_newest(self.folder)
        if found is not None:
            self.method.load_state_dict(found.tensors)
            self.step = self.resumed_from = found.step
            self.train_s = float(found.notes.get("train_s", 0))
            log.info("the run goes on at step %d of %d", self.step, self.method.total_steps)
        for step in checkpoints.list_steps(self.folder):
            if found is None or step > found.step:
                checkpoints.remove(self.folder, step)
        self.run_dir.truncate_log(self.step)

    def _save(self) -> None:
        self._save_to(self.folder, kept=checkpoints.KEPT)

    def _save_to(self, folder: Path, kept: int | None) -> None:
        if self.step not in checkpoints.list_steps(folder):
            notes = {"train_s": self.train_s, "total_steps": self.method.total_steps}
            checkpoints.save(folder, self.step, self.method.state_dict(), notes, kept=kept)

    def _measure_psnr(self, output: StepOutput, log_every: int) -> float | None:
        own = output.metrics.get("psnr")
        if own is not None:
            return float(own)
        # A whole render costs several steps of some methods: every fifth line has one.
        if self.train_psnr is None or (self.step // log_every) % 5:
            return None
        value = self.train_psnr(self.step)
        return value if value == value and value != float("inf") else None

    def _fail(self, output: StepOutput) -> None:
        parts = ", ".join(f"{k} {float(v.detach()):.4g}" for k, v in output.losses.items())
        raise TrainingError(
            f"the loss is no longer a finite number at step {self.step} ({parts})",
            where=self.run_dir.path,
            cause="learning rates too high for this scene's scale, or a broken pose among the training views",
            todo="try smaller learning rates, e.g. with --config; the last good state is in checkpoints/",
        )

    def _stop(self) -> None:
        self.stopped = True


def summarise(method: Method) -> dict[str, int]:
    """What a method says of its model as it is now, {"gaussians": 6000}; nothing where it has no `summary`."""
    return getattr(method, "summary", dict)()


def events_of(method: Method) -> dict[str, list[int]]:
    """What a method marks in its training curve, see `protocols.Method`; nothing where it has no `events`."""
    return getattr(method, "events", dict)()


def _check_output(output: object, method: Method) -> StepOutput:
    if isinstance(output, StepOutput):
        return output
    raise PluginError(
        f"train_step returned a {type(output).__name__}, not a StepOutput",
        where=f"{type(method).__module__}.{type(method).__qualname__}",
        cause="a method written for visdom-plugin 0.1.0, whose train_step returned the losses alone",
        todo="return visdom_plugin.training.protocols.StepOutput(losses), and take it in optimise(step, output)",
    )


@contextmanager
def _signals(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM call `stop` once; a second Ctrl-C interrupts at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def view_psnr(method: Method, views: Views, device: torch.device) -> Callable[[int], float]:
    """PSNR on white of one training view, another for every call's step."""
    from visdom_plugin.training.evaluate import render_on_white

    def measure(step: int) -> float:
        i = step % len(views)
        rgb, _ = render_on_white(method, views.cameras[i], device)
        x, y, ignore = (
            quantise(rgb),
            metrics.whiten(views.images[i], views.masks[i]),
            views.ignored(i),
        )
        return metrics.psnr(x, y) if ignore is None else metrics.psnr(x[~ignore], y[~ignore])

    return measure
