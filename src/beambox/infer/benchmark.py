"""How long detection takes, stage by stage: warmed up, synchronised with the device, with the spread of the runs."""

from __future__ import annotations

import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from beambox import __version__
from beambox.checks import BeamboxError, MissingFileError
from beambox.detectors.catalog import build
from beambox.detectors.contract import module_of
from beambox.infer.peaks import machine_peaks
from beambox.infer.predictor import Detector
from beambox.io import read_yaml
from beambox.structures import Batch

__all__ = ["STAGES", "Report", "measure", "untrained"]

STAGES = ("load", "voxelise", "network", "post-process")
"""Read and prepare the points and bring them to the device; gather them into cells, up to the first layer; the layers;
scores, boxes and suppression, back on the CPU."""


@dataclass(frozen=True)
class Report:
    """Times of every stage and run, and what they were measured on."""

    milliseconds: dict[str, list[float]]
    """One list per stage, one entry per run."""
    setting: dict[str, Any]
    """Versions, device, precision, threads, numbers of points and runs, load of the machine."""
    peak_memory: float | None
    """Most memory held, MB: of the GPU where it was used, else of the process; None where it cannot be told."""
    peaks: dict[str, float] = field(default_factory=dict)
    """What the machine reaches at best, as :func:`beambox.infer.peaks.machine_peaks` measures it."""

    def of(self, stages: Sequence[str]) -> list[float]:
        """Return the sum of some stages, one entry per run."""
        return [sum(times) for times in zip(*(self.milliseconds[stage] for stage in stages))]

    @property
    def throughput(self) -> float:
        """Sweeps a second."""
        return 1000 * self.setting["batch"] / statistics.fmean(self.of(STAGES))

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values; times in milliseconds a pass."""
        stages = {stage: {**summary(self.milliseconds[stage]), "share": self.share(stage)} for stage in STAGES}
        return {
            **self.setting,
            "unit": "ms",
            "stages": stages,
            "total": summary(self.of(STAGES)),
            "sweeps_per_second": round(self.throughput, 3),
            "peak_memory_mb": None if self.peak_memory is None else round(self.peak_memory, 1),
            "machine": self.peaks,
        }

    def share(self, stage: str) -> float:
        """Return a stage's part of the whole, 0 to 1, from the medians."""
        medians = {name: statistics.median(times) for name, times in self.milliseconds.items()}
        return round(medians[stage] / sum(medians.values()), 4)

    def table(self) -> str:
        """Write the numbers for a terminal."""
        names = ("mean", "median", "p90", "p99", "min")
        rows = [(stage, summary(self.milliseconds[stage])) for stage in STAGES] + [("total", summary(self.of(STAGES)))]
        lines = ["ms            " + "".join(f"{name:>9}" for name in (*names, "share"))]
        lines += [f"{stage:<14}" + "".join(f"{row[name]:9.2f}" for name in names) for stage, row in rows]
        for place, stage in enumerate(STAGES, 1):
            lines[place] += f"{self.share(stage):9.0%}"
        memory = "" if self.peak_memory is None else f", peak memory {self.peak_memory:,.0f} MB"
        lines += [f"{self.throughput:.2f} sweeps/s{memory}"]
        if self.peaks:
            lines += [
                "this machine at best: convolution {convolution_gflops:,.0f} GFLOP/s, matrix product "
                "{product_gflops:,.0f} GFLOP/s, copy {copy_gbs:,.1f} GB/s".format(**self.peaks)
            ]
        return "\n".join(lines)

    def kassd_table(self) -> str:
        """Write the three parts that KASSD reports (section on speed, Table 7): means of the runs.

        Gathering points into cells counts as preprocessing, where the published code does it.
        """
        parts = (
            ("load + preprocess", ("load", "voxelise"), 2.3),
            ("network", ("network",), 42.9),
            ("post-processing", ("post-process",), 0.7),
            ("sum", STAGES, 45.9),
        )
        lines = [f"mean of {self.setting['runs']} runs, ms   here   KASSD's (its GPU is not stated)"]
        lines += [f"{name:<22}{statistics.fmean(self.of(stages)):9.2f}{theirs:9.1f}" for name, stages, theirs in parts]
        return "\n".join(lines)


def untrained(name: str | Path, *, device: str | None = None, precision: str = "auto") -> Detector:
    """Build a detector without trained weights, to be timed: its parameters are random, its size is as configured.

    Args:
        name: of the catalogue, for its published configuration, or a recipe (a .yaml file), for that one's.
        device: "cpu", "cuda", ...; None takes the GPU where there is one.
        precision: "auto", "float32", "bfloat16" or "float16".

    Raises:
        BeamboxError: if there is no such detector, or the recipe cannot be read.
    """
    if str(name).endswith((".yaml", ".yml")):
        path = Path(name)
        if not path.is_file():
            raise MissingFileError(f"there is no recipe {path}")
        plain = read_yaml(path)
        wanted = plain.get("detector") if isinstance(plain, dict) else None
        if not isinstance(wanted, dict) or "name" not in wanted:
            raise BeamboxError(f"{path} names no detector; expected a recipe with `detector: {{name: ...}}`")
        name, options = str(wanted["name"]), wanted.get("options") or {}
    else:
        options = {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Detector(build(str(name), options), device=device, precision=precision)


def summary(times: Sequence[float]) -> dict[str, float]:
    """Return mean, median, percentiles and minimum."""
    p90, p99 = np.quantile(times, (0.9, 0.99))
    values = {
        "mean": statistics.fmean(times),
        "median": statistics.median(times),
        "p90": float(p90),
        "p99": float(p99),
        "min": min(times),
    }
    return {name: round(value, 4) for name, value in values.items()}


def measure(
    detector: Detector, paths: Sequence[Path], *, runs: int = 50, warmup: int = 20, batch: int = 1, name: str = ""
) -> Report:
    """Time a detector on sweeps, taken in turn.

    Args:
        detector: as it would be used.
        paths: files to read, again in every run (from the system's cache, after the first).
        runs: passes that count.
        warmup: passes before them that do not.
        batch: sweeps in one pass.
        name: what to call the detector in the report.

    Raises:
        BeamboxError: if there is nothing to run, or a sweep cannot be read.
    """
    if not paths or runs < 1 or warmup < 0 or batch < 1:
        raise BeamboxError(
            f"a measurement needs sweeps and at least 1 run and 1 sweep per pass, got {len(paths)} sweeps, "
            f"{runs} runs, {warmup} to warm up, {batch} sweeps per pass"
        )
    if detector.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(detector.device)
    load = busy()
    times: dict[str, list[float]] = {stage: [] for stage in STAGES}
    points = []
    for run in range(-warmup, runs):
        chosen = [paths[(run * batch + k) % len(paths)] for k in range(batch)]
        stages, seen = one_pass(detector, chosen)
        if run >= 0:
            points.append(seen)
            for stage, took in stages.items():
                times[stage].append(took)
    setting = {
        "model": name,
        "beambox": __version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "device": device_name(detector.device),
        "precision": str(detector.dtype).removeprefix("torch."),
        "threads": torch.get_num_threads(),
        "batch": batch,
        "points": round(statistics.fmean(points) / batch),
        "warmup": warmup,
        "runs": runs,
        "load_average": load,
    }
    memory = peak_memory(detector.device)  # before the machine's own peaks are measured
    return Report(times, setting, memory, machine_peaks(detector.device, detector.dtype))


@torch.inference_mode()
def one_pass(detector: Detector, paths: Sequence[Path]) -> tuple[dict[str, float], int]:
    """Detect once; return milliseconds of each stage and the number of points the network was given."""
    clock = _Clock(detector.device)
    frames = [detector.read(path) for path in paths]
    prepared = Batch.of([detector.prepare(frame) for frame in frames]).to(detector.device)
    start = clock.now()
    first_layer: list[float] = []
    with calling(module_of(detector.model), lambda: first_layer.append(clock.now()) if not first_layer else None):
        predictions = detector.predict(prepared)
    done = clock.now()
    detector.finish(predictions, frames)
    end = clock.now()
    voxels = first_layer[0] if first_layer else start
    marks = (clock.zero, start, voxels, done, end)
    return {stage: 1000 * (b - a) for stage, a, b in zip(STAGES, marks, marks[1:])}, len(prepared.points)


@contextmanager
def calling(model: nn.Module, log: Callable[[], None]) -> Iterator[None]:
    """Call ``log`` whenever one of a model's parts is about to run."""
    handles = [part.register_forward_pre_hook(lambda *_: log()) for part in model.children()]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


class _Clock:
    """Wall time, read only once the device has done all it was given."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.zero = self.now()

    def now(self) -> float:
        """Return seconds."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def busy() -> float | None:
    """Return how many processes the machine was running on average in the last minute, where it tells."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def device_name(device: torch.device) -> str:
    """Name the processor that is measured."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    cores = f"{os.cpu_count()} cores"
    described = Path("/proc/cpuinfo")
    if described.exists():
        for line in described.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return f"{line.partition(':')[2].strip()}, {cores}"
    return f"{platform.processor() or platform.machine()}, {cores}"


def peak_memory(device: torch.device) -> float | None:
    """Return the most memory held so far, MB."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    if sys.platform == "win32":
        return None
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 1e6 if sys.platform == "darwin" else most / 1e3  # bytes there, kilobytes elsewhere
