"""One training run: everything that changes from step to step, how it is validated, saved and restored."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.detectors.catalog import config_to_dict, name_of, options_since, tensors_since
from beambox.detectors.contract import AnyModel, model_of, module_of
from beambox.detectors.weights import save_weights
from beambox.infer.precision import PRECISIONS
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
from beambox.train.dataset import TrainingBatch, TrainingDataset, make_loader
from beambox.train.devices import choose_precision
from beambox.train.folder import BEST, LAST, PREVIOUS, keep_older
from beambox.train.log import RunLog, Timer, duration
from beambox.train.optim import Ema, adam, apply_schedule
from beambox.train.signals import catch_signals
from beambox.train.validate import Validator

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = ["ModelWithLoss", "Run", "random_seed"]


class ModelWithLoss(nn.Module):
    """Network and loss as one module, so that one forward pass of it is all that mixed precision and DDP see."""

    def __init__(self, detector: AnyModel) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, work: TrainingBatch) -> dict[str, Tensor]:
        """Return the named losses of a batch."""
        labels = work.batch.labels
        assert labels is not None, "training frames have labels"
        predictions = self.detector(work.batch, work.grid, labels)
        with torch.autocast(work.batch.points.device.type, enabled=False):
            return self.detector.loss(predictions, labels)


def random_seed(seed: int, step: int, rank: int) -> int:
    """Seed of what a network draws at random in a step, such as dropout and the regions of a second stage."""
    return (seed * 1_000_003 + step) * 4096 + rank


def _settle_strides(detector: nn.Module) -> None:
    """Give kernels of one cell, whose order in memory has two descriptions, the one their gradients have.

    DDP lays its buckets out by the parameters' strides and would copy every gradient that is described otherwise.
    """
    for parameter in detector.parameters():
        if parameter.dim() == 4 and parameter.shape[2:] == (1, 1):
            parameter.data = parameter.data.as_strided(parameter.shape, (parameter.shape[1], 1, 1, 1))


class Run:
    """A detector in training: everything that changes from step to step, and how to save and restore it."""

    def __init__(
        self, recipe: Recipe, detector: AnyModel, dataset: TrainingDataset, fabric: Fabric, folder: Path
    ) -> None:
        self.recipe, self.detector, self.dataset, self.fabric, self.folder = recipe, detector, dataset, fabric, folder
        optim = recipe.optim
        per_epoch = len(dataset.source) / optim.batch
        self.total = optim.iterations or max(1, round((optim.epochs or 0) * per_epoch))
        self.per_epoch = per_epoch
        self.step = 0
        self.best: float | None = None
        self.validated = 0
        """Step of the last validation that is over."""
        self.notes: list[str] = []
        """What to say before the first step."""
        self.validator: Validator | None = None
        network = module_of(detector)
        network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # torch's overloads lack it
        if recipe.sync_batchnorm and fabric.world_size > 1 and fabric.device.type == "cuda":
            network = nn.SyncBatchNorm.convert_sync_batchnorm(network)
        if fabric.world_size > 1:
            _settle_strides(network)
        work = ModelWithLoss(model_of(network))
        self.module, self.optimizer = fabric.setup(work, adam(network.parameters(), optim))
        self.ema = Ema(network, recipe.ema.decay) if recipe.ema else None
        self.names = {parameter: name for name, parameter in network.named_parameters()}
        if recipe.compile:
            for layer in self.detector.dense:
                layer.compile(dynamic=False)  # every step has maps of the same size

    @property
    def dtype(self) -> torch.dtype:
        """What the network computes in."""
        return PRECISIONS[choose_precision(self.recipe.precision, self.fabric.device.type)]

    @property
    def result(self) -> AnyModel:
        """The detector that is validated and exported: the average where there is one."""
        return model_of(self.ema.module) if self.ema else self.detector

    def train_step(self, work: TrainingBatch, timer: Timer) -> tuple[dict[str, Tensor], float]:
        """Make one optimiser step; returns the losses, with ``total``, and the learning rate.

        Raises:
            BeamboxError: if the loss or a gradient is NaN or infinite, with the parts of the loss; the weights are then
                as they were.
        """
        # Only layers that draw random numbers (dropout) need it; it makes them a function of the step, for resuming.
        torch.manual_seed(random_seed(self.recipe.seed, self.step, self.fabric.global_rank))
        lr = apply_schedule(self.optimizer.optimizer, self.recipe.optim, self.step, self.total)
        with timer.measure("forward"):
            losses = self.module(work.to(self.fabric.device))
            total = torch.stack(list(losses.values())).sum()
        if self.fabric.world_size == 1 and not bool(torch.isfinite(total)):
            raise BeamboxError(self._not_finite("the loss", losses, work))
        with timer.measure("backward"):
            self.fabric.backward(total)
        with timer.measure("optim"):
            norm = self.fabric.clip_gradients(
                self.module, self.optimizer, max_norm=self.recipe.optim.clip or math.inf, error_if_nonfinite=False
            )
            scaled = self.fabric.strategy.precision.state_dict()  # float16: its scaler leaves out such steps
            if norm is not None and not scaled and not bool(torch.isfinite(norm)):
                # gradients are the same in all processes, so all of them end here
                raise BeamboxError(self._not_finite("the gradient", losses, work))
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            if self.ema:
                self.ema.update()
        self.step += 1
        return {**{name: value.detach() for name, value in losses.items()}, "total": total.detach()}, lr

    def _not_finite(self, what: str, losses: Mapping[str, Tensor], work: TrainingBatch) -> str:
        details = ", ".join(f"{name} {value.item():.4g}" for name, value in losses.items())
        of = [n for p, n in self.names.items() if p.grad is not None and not bool(torch.isfinite(p.grad).all())]
        where = f", of {of[0]} and {len(of) - 1} more" if of else ""
        return (
            f"{what} is not finite at step {self.step} ({details}{where}) on frames {', '.join(work.batch.frame_ids)}; "
            "the weights were not changed; the last checkpoint is from an earlier step; look at these frames or lower "
            "optim.lr"
        )

    def identity(self) -> dict[str, Any]:
        """Name and config of the detector, as plain values."""
        return {"name": name_of(self.detector), "config": config_to_dict(self.detector.config)}

    def save(self) -> None:
        """Write the checkpoint ``last.safetensors`` (the first process); the one before stays as ``previous``."""
        if self.fabric.global_rank != 0:
            return
        tensors = {f"model.{name}": value for name, value in self.detector.state_dict().items()}
        tensors |= optimizer_state(self.optimizer.optimizer, self.names)
        state: dict[str, Any] = {
            "best": self.best,
            "validated": self.validated,
            "precision": self.fabric.strategy.precision.state_dict(),
        }
        if self.ema:
            tensors |= {f"ema.{name}": value for name, value in self.ema.module.state_dict().items()}
            state["ema_updates"] = self.ema.updates
        plain = self.recipe.model_dump(mode="json")
        with keep_older(self.folder):
            Checkpoint(tensors, self.step, plain, self.identity(), state).save(self.folder / LAST)

    def restore(self) -> list[str]:
        """Go back to the last checkpoint; returns the parts of the recipe that have changed since.

        Where ``last.safetensors`` is damaged, the one before it is taken.

        Raises:
            BeamboxError: if there is none, or it is of another detector.
        """
        path = self.folder / LAST
        try:
            saved = load_checkpoint(path)
        except BeamboxError as error:
            if not (self.folder / PREVIOUS).is_file():
                raise
            self.notes.append(f"warning: {error}; going on with {PREVIOUS}, the checkpoint before it")
            path = self.folder / PREVIOUS
            saved = load_checkpoint(path)
        own = self.identity()
        if saved.detector["name"] != own["name"]:
            raise BeamboxError(f"{path} is of the detector {saved.detector['name']}, the recipe is of {own['name']}")
        tensors = tensors_since(self.detector, saved.tensors)
        restore_module(module_of(self.detector), part(tensors, "model."), str(path))
        restore_optimizer(self.optimizer.optimizer, self.names, part(tensors, "optim."))
        if self.ema and "ema_updates" in saved.state:
            restore_module(self.ema.module, part(tensors, "ema."), str(path))
            self.ema.updates = saved.state["ema_updates"]
        if saved.state["precision"]:
            self.fabric.strategy.precision.load_state_dict(saved.state["precision"])
        self.step, self.best = saved.step, saved.state["best"]
        self.validated = saved.state.get("validated", saved.step)
        now, then = self.recipe.model_dump(mode="json"), saved.recipe
        for plain in (now, then):
            plain["detector"]["options"] = options_since(own["name"], plain["detector"]["options"])
        return [key for key in now if now[key] != then.get(key)]

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Inside, the batch norms of ``result`` hold exact statistics of training batches, the same in every process.

        The batches are those of the last steps, so what is measured is a function of the weights, the seed and the
        step. All processes enter together.
        """
        with measured_statistics(module_of(self.result), self._measure):
            yield

    def _measure(self) -> None:
        first = max(0, self.step - self.recipe.batchnorm_batches)
        if first == self.step:
            return
        network, seed, rank = ModelWithLoss(self.result), self.recipe.seed, self.fabric.global_rank
        numbered = enumerate(make_loader(self.dataset, first, self.step, self.recipe.workers), first)

        def forward(work: tuple[int, TrainingBatch]) -> None:
            torch.manual_seed(random_seed(seed, work[0], rank))  # a second stage draws its regions
            with self.fabric.autocast():
                network(work[1].to(self.fabric.device))

        gather = self.fabric.all_gather if self.fabric.world_size > 1 else None
        measure_statistics(module_of(self.result), numbered, forward, gather)  # pyright: ignore[reportArgumentType]

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
        start = time.perf_counter()
        score = self.validator(self.result, self.fabric.global_rank, self.fabric.world_size)
        better = not math.isnan(score.value) and (self.best is None or score.value >= self.best)
        if better:  # the later of equals: it has learnt for longer
            self.best = score.value
            self.export(BEST, {"validation": score.table})
        self.validated = self.step
        log.info(f"validation after step {self.step}: {score.text}{'  (best so far)' if better else ''}")
        log.info(f"  took {duration(time.perf_counter() - start)}")
        log.record(self.step, {f"validation/{name}": value for name, value in score.scalars.items()})
        if log.shows_pictures:
            log.curves(self.step, score.curves)
            for name, picture in self.validator.pictures(score):
                log.picture(self.step, name, picture)
        self.fabric.barrier()

    def validation_due(self) -> bool:
        """Whether a validation on the way belongs to this step and is not over: a kill may have come between."""
        every = self.recipe.validation.every if self.recipe.validation else 0
        return every > 0 and 0 < self.step < self.total and self.step % every == 0 and self.validated < self.step

    def loop(self, log: RunLog) -> bool:
        """Train to the end; False where a signal stopped it before."""
        recipe, timer, waiting = self.recipe, Timer(), Timer()
        sums: dict[str, Tensor] = {}
        since, mark = time.perf_counter(), self.step
        with catch_signals() as stopped:
            batches = make_loader(self.dataset, self.step, self.total, recipe.workers)
            self.module.train()
            if self.validation_due():
                with self.measured():
                    self.validate(log)
            while self.step < self.total and not self.should_stop(stopped()):
                with timer.measure("data"):
                    work = next(batches)
                losses, lr = self.train_step(work, timer)
                sums = {name: sums.get(name, 0) + value for name, value in losses.items()}
                log.progress(self.step)
                if self.step % recipe.log_every == 0 or self.step == self.total:
                    steps = self.step - mark
                    means = {name: self.fabric.all_reduce(v / steps).item() for name, v in sums.items()}  # pyright: ignore
                    log.losses(self.step, means, lr, timer.shares(), (time.perf_counter() - since) / steps)
                    sums, since, mark = {}, time.perf_counter(), self.step
                with waiting.measure("other"):
                    if self.step % recipe.save_every == 0 and self.step < self.total:
                        self.save_on_the_way(log)
                    if self.validation_due():
                        with self.measured():
                            self.validate(log)
                since += waiting.seconds.pop("other")
        return self.step == self.total

    def save_on_the_way(self, log: RunLog) -> None:
        """Write a checkpoint; where the disk is full, training goes on, and the next one may find room."""
        try:
            self.save()
        except BeamboxError as error:
            log.info(f"warning: {error}; training goes on")

    def should_stop(self, stop: bool) -> bool:
        """Whether to stop: where there are several processes they ask each other every 10 steps, to stop together."""
        if self.fabric.world_size == 1:
            return stop
        if self.step % 10:
            return False
        return bool(self.fabric.all_reduce(torch.tensor(float(stop), device=self.fabric.device), reduce_op="sum") > 0)  # pyright: ignore
