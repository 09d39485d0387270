"""Train a recipe on a borrowed machine for as long as there is: packed data in, a checkpoint in small files out.

    python benchmarks/gpu_train.py pointpillars-kitti-3class --data kitti.pack --minutes 8 --out OUT
    python benchmarks/gpu_train.py pointpillars-kitti-3class --data kitti.pack --minutes 8 --out OUT --resume OLD

Data is a file of benchmarks/pack_frames.py, or a folder in KITTI's layout. `--simulate N` adds N simulated sweeps, made
first by all cores. The run is the project's own (`beambox.train`), with its augmentation and its data workers; only its
length is the clock's: the schedule counts in steps, so the number of steps is set anew from the measured pace until the
end, and the learning rate comes down in time. Under OUT, none over 15 MiB, lie

    NAME.safetensors        the weights to use, float16, with exact batch-norm statistics (at the end)
    checkpoint.0 .1 ...     the state of the run (every `--save-every` seconds, and at the end): what --resume takes
    gpu_train.json          pace, losses, where the time went
    train.log               what the run printed

Weights stay float32 in the checkpoint, the optimiser's moments and the average of the weights travel as bfloat16.
`--whole-minutes` is the training time of all sittings together, where there will be more than one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pack_frames import unpack
from torch import Tensor

from beambox.train import loop
from beambox.train.checkpoint import Checkpoint, load_checkpoint
from beambox.train.config import Recipe, SourceSection, read_recipe

PART = 15 * 2**20
"""Bytes of a file that is brought back at most."""
SETTLING = 10
"""Steps before the pace is measured: compiling, choosing algorithms, filling queues."""


@dataclass
class Timer:
    """How long this sitting may last, and what it has found out."""

    end: float
    """Moment (monotonic, s) at which everything has to be written."""
    whole: float | None
    """Seconds of training in all sittings; None where this is the only one."""
    before: float
    """Seconds of training in earlier sittings."""
    out: Path
    save_every: float
    pace: float | None = None
    """Seconds a step."""
    began: float | None = None
    """When the first step of this sitting began."""
    losses: list[tuple[int, float]] | None = None

    def trained(self) -> float:
        """Seconds of training so far, all sittings."""
        return self.before + (0.0 if self.began is None else time.monotonic() - self.began)

    def finishing(self) -> float:
        """Seconds to keep for exact statistics (a forward pass of 60 steps, new data workers) and for writing."""
        return 30.0 + 40 * (self.pace or 0.2)

    def left(self) -> float:
        """Seconds of training left in this sitting."""
        return self.end - time.monotonic() - self.finishing()

    def left_of_all(self) -> float:
        """Seconds of training left in all sittings."""
        return self.left() if self.whole is None else max(self.left(), self.whole - self.trained())


class TimedRun(loop.Run):
    """A run whose length follows the clock."""

    clock: Timer
    """Set on the class: the run is built by ``train``."""
    _marks: tuple[int, float] | None = None
    _saved: float = 0.0

    def train_step(self, work: Any, clock: Any) -> Any:
        """Make a step; then set the number of steps to what the time left allows."""
        ours = self.clock
        now = time.monotonic()
        if ours.began is None:
            ours.began, ours.losses, self._saved = now, [], now
            self.total = 10**7  # until the pace is known
        details = super().train_step(work, clock)
        if self._marks is None and self.step - self._first >= SETTLING:
            self._synchronize()
            self._marks = (self.step, time.monotonic())
        if self._marks is not None and (self.step - self._marks[0]) % 20 == 0 and self.step > self._marks[0]:
            self._replan(float(details[0]["total"]))
        if self.clock.left() <= 0:
            self.total = self.step
        return details

    def _replan(self, loss: float) -> None:
        assert self._marks is not None
        step, moment = self._marks
        self.clock.pace = (time.monotonic() - moment) / (self.step - step)
        self.total = self.step + max(1, int(self.clock.left_of_all() / self.clock.pace))
        assert self.clock.losses is not None
        self.clock.losses.append((self.step, round(loss, 4)))
        if time.monotonic() - self._saved > self.clock.save_every:
            self.save()

    def _synchronize(self) -> None:
        if self.fabric.device.type == "cuda":
            torch.cuda.synchronize()

    def restore(self) -> list[str]:
        """Go back to the state of the last sitting."""
        changed = super().restore()
        self._first = self.step
        return changed

    _first: int = 0

    def save(self) -> None:
        """Write the state, and a copy in small files where it will be fetched."""
        super().save()
        bring_home(self.folder / loop.LAST, self.clock.out)
        self._saved = time.monotonic()

    def export(self, name: str, scores: Mapping[str, Any]) -> Path:
        """Write the weights; half as large where they will be fetched."""
        from beambox.detectors.weights import save_weights

        path = super().export(name, scores)
        card = {"name": self.recipe.name, "step": self.step, **scores}
        save_weights(self.clock.out / f"{self.recipe.name}.safetensors", self.result, card, half=True)
        return path


def light(name: str, tensor: Tensor) -> Tensor:
    """Turn what need not be exact into bfloat16."""
    exact = name.startswith("model.") or tensor.dtype != torch.float32 or tensor.dim() == 0
    return tensor if exact else tensor.bfloat16()


def bring_home(last: Path, out: Path) -> None:
    """Write a checkpoint as small files."""
    saved = load_checkpoint(last)
    saved.tensors = {name: light(name, tensor) for name, tensor in saved.tensors.items()}
    draft = last.with_name("light.safetensors")
    saved.save(draft)
    data = draft.read_bytes()
    draft.unlink()
    parts = [data[at : at + PART] for at in range(0, len(data), PART)]
    for old in out.glob("checkpoint.*"):
        if not old.name.endswith(".part") and int(old.suffix[1:]) >= len(parts):
            old.unlink()
    for place, part in enumerate(parts):
        draft = out / f"checkpoint.{place}.part"
        draft.write_bytes(part)
        draft.replace(out / f"checkpoint.{place}")


def take_along(old: Path, folder: Path) -> None:
    """Join a checkpoint of small files, for ``train(resume=True)``."""
    parts = sorted(old.glob("checkpoint.[0-9]*"), key=lambda path: int(path.suffix[1:]))
    if not parts:
        raise SystemExit(f"--resume: {old} holds no files checkpoint.0, checkpoint.1, ...")
    folder.mkdir(parents=True, exist_ok=True)
    joined = folder / "joined.safetensors"
    joined.write_bytes(b"".join(part.read_bytes() for part in parts))
    saved: Checkpoint = load_checkpoint(joined)
    joined.unlink()
    saved.tensors = {n: t.float() if t.dtype == torch.bfloat16 else t for n, t in saved.tensors.items()}
    saved.save(folder / loop.LAST)


def data_folder(arguments: argparse.Namespace, scratch: Path) -> Path:
    """Unpack and simulate."""
    given: Path = arguments.data
    if given.is_dir():
        folder = given
    else:
        folder = scratch / "data"
        splits = unpack(given, folder)
        print(f"unpacked {given.name}: {', '.join(splits)}", flush=True)
    return folder


def simulated(arguments: argparse.Namespace, data: Path, scratch: Path) -> tuple[SourceSection, float]:
    """Make sweeps with all cores; returns the source and sweeps per second."""
    from beambox.simulate import write_dataset

    start = time.monotonic()
    folder = scratch / "simulated"
    layout = arguments.layout.replace("{data}", str(data))
    write_dataset(folder, arguments.simulate, workers=arguments.workers, layout=layout, seed=11, val_share=0.0)
    rate = arguments.simulate / (time.monotonic() - start)
    print(f"simulated {arguments.simulate} sweeps, {rate:.1f} a second", flush=True)
    section = SourceSection(kind="kitti", path=str(folder), split="train", objects=False)
    return section, rate


def adapt(recipe: Recipe, arguments: argparse.Namespace, extra: SourceSection | None) -> Recipe:
    """Fit a recipe to the sitting: its own data, all cores, no validation, a length that the clock sets."""
    data = list(recipe.data)
    if extra is not None:
        share = arguments.simulated_share
        data = [s.model_copy(update={"weight": (s.weight or 1.0) * (1 - share) / len(data)}) for s in data]
        data.append(extra.model_copy(update={"weight": share}))
    optim = recipe.optim.model_copy(update={"epochs": None, "iterations": 10**7})
    change = {"data": tuple(data), "optim": optim, "workers": arguments.workers, "save_every": 10**9, "log_every": 100}
    if not arguments.validate:
        change["validation"] = None
    return recipe.model_copy(update=change)


def pace_of_data(recipe: Recipe, data: Path, scratch: Path, seconds: float) -> dict[str, float]:
    """Measure how many sweeps per second one core prepares, augmentation and object sampling included."""
    from beambox.train.devices import make_fabric

    run = loop.build_run(recipe, data, scratch / "pace", make_fabric("float32"), scratch / "pace.npz", False)
    _ = run.dataset[0]
    torch.set_num_threads(1)
    start, step = time.perf_counter(), 1
    while time.perf_counter() - start < seconds:
        _ = run.dataset[step]
        step += 1
    rate = (step - 1) * recipe.optim.batch / (time.perf_counter() - start)
    return {"sweeps_per_second_per_core": round(rate, 2)}


class Tee:
    """Writes to the terminal and to a file."""

    def __init__(self, *streams: Any) -> None:
        self.streams = streams

    def write(self, text: str) -> int:
        """Write."""
        for make_loader in self.streams:
            make_loader.write(text)
            make_loader.flush()
        return len(text)

    def flush(self) -> None:
        """Nothing is held back."""

    def isatty(self) -> bool:
        """A file is none."""
        return False


def sitting(arguments: argparse.Namespace, scratch: Path) -> dict[str, Any]:
    """Do everything; returns what is to be reported."""
    began = time.monotonic()
    out: Path = arguments.out
    recipe = read_recipe(arguments.recipe, arguments.change or [])
    data = data_folder(arguments, scratch)
    details: dict[str, Any] = {"recipe": recipe.name, "workers": arguments.workers, "batch": recipe.optim.batch}
    extra = None
    if arguments.simulate:
        extra, details["simulated_per_second"] = simulated(arguments, data, scratch)
    recipe = adapt(recipe, arguments, extra)
    if arguments.measure_data:
        return details | pace_of_data(recipe, data, scratch, arguments.measure_data)
    details["prepared_s"] = round(time.monotonic() - began, 1)
    before = 0.0
    run_folder = scratch / "run"
    if arguments.resume:
        take_along(arguments.resume, run_folder)
        former = arguments.resume / "gpu_train.json"
        before = json.loads(former.read_text())["trained_s"] if former.exists() else 0.0
    whole = None if arguments.whole_minutes is None else 60 * arguments.whole_minutes
    clock = Timer(arguments.began + 60 * arguments.minutes, whole, before, out, arguments.save_every)
    TimedRun.clock = clock
    loop.Run = TimedRun
    outcome = loop.train(recipe, data, run_folder, resume=bool(arguments.resume))
    details |= {"step": outcome.step, "finished": outcome.finished, "trained_s": round(clock.trained(), 1)}
    details |= {"seconds_per_step": None if clock.pace is None else round(clock.pace, 4), "losses": clock.losses}
    if torch.cuda.is_available():
        details |= {"gpu": torch.cuda.get_device_name(), "peak_mb": round(torch.cuda.max_memory_allocated() / 1e6, 1)}
    return details


def main() -> None:
    began = time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipe", help="name or file")
    parser.add_argument("--data", type=Path, required=True, help="packed file, or a folder in KITTI's layout")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=8.0, help="of everything, from the start of this program")
    parser.add_argument("--whole-minutes", type=float, help="of training, in all sittings")
    parser.add_argument("--resume", type=Path, help="folder with checkpoint.0 ... of an earlier sitting")
    parser.add_argument("--simulate", type=int, default=0, help="sweeps to simulate")
    parser.add_argument("--simulated-share", type=float, default=0.5, help="share of the drawn frames")
    parser.add_argument("--layout", default="random", help="of the simulated streets; mixed:{data} takes the labels'")
    parser.add_argument("--workers", type=int, default=max(1, min(14, (os.cpu_count() or 2) - 2)))
    parser.add_argument("--save-every", type=float, default=90.0, help="seconds")
    parser.add_argument("--validate", action="store_true", help="keep the recipe's validation")
    parser.add_argument(
        "--measure-data", type=float, metavar="SECONDS", help="only measure how fast one core prepares data"
    )
    parser.add_argument("--set", action="append", dest="change", help="change a value of the recipe: optim.lr=0.001")
    arguments = parser.parse_args()
    arguments.began = began
    arguments.out.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="beambox-train-", ignore_cleanup_errors=True) as scratch,
        (arguments.out / "train.log").open("a", encoding="utf-8") as log,
        contextlib.redirect_stdout(Tee(sys.stdout, log)),
    ):
        details = sitting(arguments, Path(scratch))
        details["seconds"] = round(time.monotonic() - began, 1)
        (arguments.out / "gpu_train.json").write_text(json.dumps(details, indent=1), encoding="utf-8")
        print(json.dumps({key: value for key, value in details.items() if key != "losses"}), flush=True)


if __name__ == "__main__":
    main()
