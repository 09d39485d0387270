"""The training loop: draw, forward, backward, step; validate, keep the best, and go on exactly where a run stopped."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.data.database import ObjectDatabase
from beambox.data.mixture import MixedSource
from beambox.detectors.catalogue import build, config_to_dict, name_of, tensors_since
from beambox.detectors.weights import fill, read_weights, save_weights
from beambox.train.batchnorm import measure_statistics, measured_statistics
from beambox.train.checkpoint import (
    Checkpoint,
    load_checkpoint,
    optimizer_state,
    part,
    restore_module,
    restore_optimizer,
)
from beambox.train.config import Recipe
from beambox.train.devices import make_fabric
from beambox.train.feed import Feed, TrainingBatch, stream
from beambox.train.log import Clock, RunLog, duration
from beambox.train.optim import Ema, adam, apply_schedule
from beambox.train.sources import Change, open_database, open_source
from beambox.train.validate import Score, Validator

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = ["Outcome", "Run", "train"]

LAST, BEST, FINAL, OBJECTS = "last.safetensors", "best.safetensors", "final.safetensors", "objects.npz"


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    step: int
    """Optimiser steps made."""
    finished: bool
    """False where it was interrupted."""
    weights: Path | None
    """The weights to use: the best by validation, else the last; None where interrupted before any were written."""
    score: float | None
    """Validation score of the best weights, percent."""


class TrainStep(nn.Module):
    """Network and loss as one module, so that one forward pass of it is all that mixed precision and DDP see."""

    def __init__(self, detector: Any) -> None:
        super().__init__()
        self.detector: Any = detector

    def forward(self, work: TrainingBatch) -> dict[str, Tensor]:
        """Return the named losses of a batch."""
        predictions = self.detector(work.batch, work.grid, work.batch.labels)
        with torch.autocast(work.batch.points.device.type, enabled=False):
            return self.detector.loss(predictions, work.batch.labels)


def random_seed(seed: int, step: int, rank: int) -> int:
    """Seed of what a network draws at random in a step, such as dropout and the regions of a second stage."""
    return (seed * 1_000_003 + step) * 4096 + rank


class Run:
    """A detector in training: everything that changes from step to step, and how to save and restore it."""

    def __init__(self, recipe: Recipe, detector: Any, feed: Feed, fabric: Fabric, folder: Path) -> None:
        self.recipe, self.detector, self.feed, self.fabric, self.folder = recipe, detector, feed, fabric, folder
        optim = recipe.optim
        per_epoch = len(feed.source) / optim.batch
        self.total = optim.iterations or max(1, round((optim.epochs or 0) * per_epoch))
        self.per_epoch = per_epoch
        self.step = 0
        self.best: float | None = None
        self.validator: Validator | None = None
        detector.to(memory_format=torch.channels_last)
        if recipe.sync_batchnorm and fabric.world_size > 1 and fabric.device.type == "cuda":
            detector = nn.SyncBatchNorm.convert_sync_batchnorm(detector)
        self.module, self.optimizer = fabric.setup(TrainStep(detector), adam(detector.parameters(), optim))
        self.ema = Ema(detector, recipe.ema.decay) if recipe.ema else None
        self.names = {parameter: name for name, parameter in detector.named_parameters()}
        if recipe.compile:
            for layer in self.detector.dense:
                layer.compile(dynamic=False)  # every step has maps of the same size

    @property
    def result(self) -> nn.Module:
        """The module that is validated and exported: the average where there is one."""
        return self.ema.module if self.ema else self.detector

    def advance(self, work: TrainingBatch, clock: Clock) -> tuple[dict[str, Tensor], float]:
        """Make one optimiser step; returns the losses, with ``total``, and the learning rate.

        Raises:
            BeamboxError: if the loss is NaN or infinite, with its parts.
        """
        # Only layers that draw random numbers (dropout) need it; it makes them a function of the step, for resuming.
        torch.manual_seed(random_seed(self.recipe.seed, self.step, self.fabric.global_rank))
        lr = apply_schedule(self.optimizer.optimizer, self.recipe.optim, self.step, self.total)
        with clock.measure("forward"):
            losses = self.module(work.to(self.fabric.device))
            total = torch.stack(list(losses.values())).sum()
        if not bool(torch.isfinite(total)):
            told = ", ".join(f"{name} {value.item():.4g}" for name, value in losses.items())
            raise BeamboxError(
                f"the loss is not finite at step {self.step} ({told}) on frames {', '.join(work.batch.frame_ids)}; "
                f"the last checkpoint is from an earlier step; look at these frames or lower optim.lr"
            )
        with clock.measure("backward"):
            self.fabric.backward(total)
        with clock.measure("optim"):
            if self.recipe.optim.clip is not None:
                clip = self.recipe.optim.clip
                self.fabric.clip_gradients(self.module, self.optimizer, max_norm=clip, error_if_nonfinite=False)
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            if self.ema:
                self.ema.update()
        self.step += 1
        return {**{name: value.detach() for name, value in losses.items()}, "total": total.detach()}, lr

    def identity(self) -> dict[str, Any]:
        """Name and config of the detector, as plain values."""
        return {"name": name_of(self.detector), "config": config_to_dict(self.detector.config)}

    def save(self) -> None:
        """Write the checkpoint ``last.safetensors`` (by the first process alone)."""
        if self.fabric.global_rank != 0:
            return
        tensors = {f"model.{name}": value for name, value in self.detector.state_dict().items()}
        tensors |= optimizer_state(self.optimizer.optimizer, self.names)
        state: dict[str, Any] = {"best": self.best, "precision": self.fabric.strategy.precision.state_dict()}
        if self.ema:
            tensors |= {f"ema.{name}": value for name, value in self.ema.module.state_dict().items()}
            state["ema_updates"] = self.ema.updates
        plain = self.recipe.model_dump(mode="json")
        Checkpoint(tensors, self.step, plain, self.identity(), state).save(self.folder / LAST)

    def restore(self) -> list[str]:
        """Go back to the state of ``last.safetensors``; returns the parts of the recipe that have changed since.

        Raises:
            BeamboxError: if there is none, or it is of another detector.
        """
        path = self.folder / LAST
        saved = load_checkpoint(path)
        own = self.identity()
        if saved.detector["name"] != own["name"]:
            raise BeamboxError(f"{path} is of the detector {saved.detector['name']}, the recipe is of {own['name']}")
        tensors = tensors_since(self.detector, saved.tensors)
        restore_module(self.detector, part(tensors, "model."), str(path))
        restore_optimizer(self.optimizer.optimizer, self.names, part(tensors, "optim."))
        if self.ema and "ema_updates" in saved.state:
            restore_module(self.ema.module, part(tensors, "ema."), str(path))
            self.ema.updates = saved.state["ema_updates"]
        if saved.state["precision"]:
            self.fabric.strategy.precision.load_state_dict(saved.state["precision"])
        self.step, self.best = saved.step, saved.state["best"]
        now = self.recipe.model_dump(mode="json")
        return [key for key in now if now[key] != saved.recipe.get(key)]

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Inside, the batch norms of ``result`` hold exact statistics of training batches, the same in every process.

        The batches are those of the last steps, so what is measured is a function of the weights, the seed and the
        step. All processes enter together.
        """
        with measured_statistics(self.result, self._measure):
            yield

    def _measure(self) -> None:
        first = max(0, self.step - self.recipe.batchnorm_batches)
        if first == self.step:
            return
        network, seed, rank = TrainStep(self.result), self.recipe.seed, self.fabric.global_rank
        numbered = enumerate(stream(self.feed, first, self.step, self.recipe.workers), first)

        def forward(work: tuple[int, TrainingBatch]) -> None:
            torch.manual_seed(random_seed(seed, work[0], rank))  # a second stage draws its regions
            with self.fabric.autocast():
                network(work[1].to(self.fabric.device))

        gather = self.fabric.all_gather if self.fabric.world_size > 1 else None
        measure_statistics(self.result, numbered, forward, gather)  # pyright: ignore[reportArgumentType]

    def export(self, name: str, scores: Mapping[str, Any]) -> Path:
        """Write the weights a user loads, with a card of where they come from (by the first process alone)."""
        if self.fabric.global_rank != 0:
            return self.folder / name
        recipe = self.recipe.model_dump(mode="json", exclude={"workers", "threads", "log_every", "save_every"})
        card = {"name": self.recipe.name, "step": self.step, "recipe": recipe, "beambox": __version__, **scores}
        save_weights(self.folder / name, self.result, card)
        return self.folder / name

    def validate(self, log: RunLog) -> None:
        """Score the present weights, whose statistics are measured, and export them if they are the best so far."""
        if self.validator is None:
            return
        if self.fabric.global_rank == 0:
            start = time.perf_counter()
            score: Score = self.validator(self.result)
            better = not math.isnan(score.value) and (self.best is None or score.value > self.best)
            if better:
                self.best = score.value
                self.export(BEST, {"validation": score.table})
            log.say(f"validation after step {self.step}: {score.text}{'  (best so far)' if better else ''}")
            log.say(f"  took {duration(time.perf_counter() - start)}")
            log.record(self.step, {f"validation/{name}": value for name, value in score.scalars.items()})
        self.fabric.barrier()

    def loop(self, log: RunLog) -> bool:
        """Train to the end; False where a signal stopped it before."""
        recipe, clock, waiting = self.recipe, Clock(), Clock()
        sums: dict[str, Tensor] = {}
        since, mark = time.perf_counter(), self.step
        with stopping() as stopped:
            batches = stream(self.feed, self.step, self.total, recipe.workers)
            self.module.train()
            while self.step < self.total and not self.agree(stopped()):
                with clock.measure("data"):
                    work = next(batches)
                losses, lr = self.advance(work, clock)
                sums = {name: sums.get(name, 0) + value for name, value in losses.items()}
                log.progress(self.step)
                if self.step % recipe.log_every == 0 or self.step == self.total:
                    steps = self.step - mark
                    means = {name: self.fabric.all_reduce(v / steps).item() for name, v in sums.items()}  # pyright: ignore
                    log.losses(self.step, means, lr, clock.shares(), (time.perf_counter() - since) / steps)
                    sums, since, mark = {}, time.perf_counter(), self.step
                with waiting.measure("other"):
                    if self.step % recipe.save_every == 0 and self.step < self.total:
                        self.save()
                    if recipe.validation and self.step % recipe.validation.every == 0 and self.step < self.total:
                        with self.measured():
                            self.validate(log)
                since += waiting.seconds.pop("other")
        return self.step == self.total

    def agree(self, stop: bool) -> bool:
        """Whether to stop: where there are several processes they ask each other every 10 steps, to stop together."""
        if self.fabric.world_size == 1:
            return stop
        if self.step % 10:
            return False
        return bool(self.fabric.all_reduce(torch.tensor(float(stop), device=self.fabric.device), reduce_op="sum") > 0)  # pyright: ignore


@contextmanager
def stopping() -> Iterator[Callable[[], bool]]:
    """Turn the first SIGINT or SIGTERM into a flag; a second one acts as usual."""
    caught: list[int] = []
    former: dict[int, Any] = {}

    def note(number: int, _: FrameType | None) -> None:
        caught.append(number)
        signal.signal(number, former[number])

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            former[number] = signal.signal(number, note)
    except ValueError:  # not in the main thread, where signals do not arrive
        pass
    try:
        yield lambda: bool(caught)
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def train(
    recipe: Recipe, data: Path | None, out: Path, resume: bool = False, shared_objects: Path | None = None
) -> Outcome:
    """Train a detector.

    Args:
        recipe: what to do.
        data: folder that ``{data}`` stands for in the recipe.
        out: folder of the run; gets ``last.safetensors`` (to go on from), ``best.safetensors`` and
            ``final.safetensors`` (weights to use), ``log.jsonl`` and ``tensorboard/``.
        resume: go on from ``last.safetensors`` instead of starting afresh.
        shared_objects: object database to use, and to cut first where it is not there; by default the run's own.

    Raises:
        BeamboxError: for anything in the recipe, the data or the folder that cannot be used.
    """
    if (out / LAST).exists() and not resume:
        raise BeamboxError(f"{out} holds a run already; go on with it by --resume, or give another --out")
    if recipe.threads:
        torch.set_num_threads(recipe.threads)
    fabric = make_fabric(recipe.precision)
    reuse = resume or shared_objects is not None
    run = assemble(recipe, data, out, fabric, shared_objects or out / OBJECTS, reuse)
    changed = run.restore() if resume else []
    log = RunLog(out, run.total, run.step, active=fabric.global_rank == 0)
    try:
        introduce(run, log)
        if resume:
            log.say(f"going on after step {run.step}")
        if changed:
            log.say(f"note: the recipe has changed since, so the run is not the one it would have been: {changed}")
        finished = run.loop(log)
        run.save()
        if finished:
            with run.measured():
                run.validate(log)
                final = run.export(FINAL, {})
            run.save()
            best = out / BEST
            log.say(f"finished; weights: {best if run.best is not None else final}")
            return Outcome(run.step, True, best if run.best is not None else final, run.best)
        log.say(f"interrupted after step {run.step} of {run.total}; the same command with --resume goes on from there")
        return Outcome(run.step, False, out / BEST if run.best is not None else None, run.best)
    finally:
        log.close()


def assemble(recipe: Recipe, data: Path | None, out: Path, fabric: Fabric, objects: Path, reuse: bool) -> Run:
    """Build the detector, the stream of batches and the validation that a recipe asks for.

    Args:
        recipe: what to do.
        data: folder that ``{data}`` stands for.
        out: folder of the run.
        fabric: devices and processes.
        objects: file of the object database, where the recipe samples objects.
        reuse: take that file if it is there already.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        detector = build(recipe.detector.name, recipe.detector.options)
    if recipe.detector.start_from:
        stored = read_weights(recipe.detector.start_from)
        with torch.no_grad():
            fill(detector, stored.tensors, recipe.detector.start_from)
    config = detector.config
    sources = [open_source(section, data) for section in recipe.data]
    weights = tuple(section.weight for section in recipe.data if section.weight is not None)
    database = None
    if recipe.augment and recipe.augment.sample:
        if fabric.global_rank == 0:
            open_database(recipe, data, objects, reuse, lambda text: print(text, flush=True))
        fabric.barrier()
        database = ObjectDatabase.load(objects)
    feed = Feed(
        MixedSource(sources, weights or None),
        Change(recipe.augment, database, recipe.seed),
        config.classes,
        config.grid,
        recipe.optim.batch,
        recipe.window,
        seed=recipe.seed,
        rank=fabric.global_rank,
        world=fabric.world_size,
    )
    run = Run(recipe, detector, feed, fabric, out)
    if recipe.validation:
        run.validator = Validator(recipe.validation, open_source(recipe.validation.source, data))
    return run


def introduce(run: Run, log: RunLog) -> None:
    """Say what is about to happen."""
    recipe, fabric = run.recipe, run.fabric
    count = sum(parameter.numel() for parameter in run.detector.parameters())
    log.say(f"beambox {__version__}: {recipe.name}, seed {recipe.seed}, {count / 1e6:.2f} M parameters")
    precision = type(fabric.strategy.precision).__name__
    log.say(
        f"{fabric.world_size} x {fabric.device.type}, {precision}, {torch.get_num_threads()} threads; "
        f"{len(run.feed.source)} frames an epoch, {run.per_epoch:.0f} steps an epoch, {run.total} steps"
    )
