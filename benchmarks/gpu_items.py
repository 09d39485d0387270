"""The process in which one group of benchmarks/gpu.py runs: its items one by one, each reported as a line of JSON."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MARK = "@@beambox "
DETECTORS = ("pointpillars", "second", "voxel_rcnn", "dennet", "kassd", "hcnet")
NEEDED = ("torch", "triton", "numpy", "numba", "safetensors", "pydantic", "pydantic_core", "annotated_types")
NEEDED += ("typing_inspection", "typer", "rich", "yaml", "PIL", "matplotlib")
FOR_TRAINING = ("lightning_fabric", "lightning_utilities", "tensorboard")
FOR_TESTS = ("pytest", "hypothesis", "shapely", "scipy")
LOST = 3
"""Exit code of a process that can do nothing more with its device."""

Item = tuple[str, Callable[[], dict[str, Any]]]


def missing_packages() -> list[str]:
    """Name the modules that cannot be found."""
    return [name for name in (*NEEDED, *FOR_TRAINING, *FOR_TESTS) if importlib.util.find_spec(name) is None]


@dataclass(frozen=True)
class Setting:
    """What every item is told."""

    device: str
    quick: bool
    frames: Path
    """File of simulated sweeps."""

    def batch(self, size: int) -> Any:
        """Return a batch of simulated sweeps, on the CPU, with labels."""
        from beambox.structures import Batch

        return Batch.of([self.load()[i % len(self.load())] for i in range(size)])

    def load(self) -> list[Any]:
        """Read the sweeps."""
        import numpy as np
        import torch

        from beambox.structures import Frame, Labels

        with np.load(self.frames) as stored:
            count = sum(name.startswith("points") for name in stored)
            frames = []
            for i in range(count):
                names = tuple(str(name) for name in stored[f"names{i}"])
                labels = Labels(torch.from_numpy(stored[f"boxes{i}"]), names)
                frames.append(Frame(torch.from_numpy(stored[f"points{i}"]), id=f"{i:06d}", labels=labels))
        return frames


def tell(item: str, **details: Any) -> None:
    """Report; without anything told, that the item begins."""
    print(MARK + json.dumps({"item": item, **details}), flush=True)


def run(items: Sequence[Item], skip: Sequence[str], device: str) -> int:
    """Run items; return the exit code."""
    for name, work in items:
        if name in skip:
            continue
        tell(name)
        start = time.perf_counter()
        try:
            details = work()
            synchronize(device)
        except Exception as error:
            traceback.print_exc()
            first = next((line for line in str(error).splitlines() if line.strip()), "")
            tell(name, error=f"{type(error).__name__}: {first[:300]}")
            try:
                synchronize(device)
            except Exception:
                return LOST
        else:
            tell(name, **details, took=round(time.perf_counter() - start, 2))
    return 0


def synchronize(device: str) -> None:
    """Wait for the device: an error of a kernel shows here at the latest."""
    import torch

    if device == "cuda":
        torch.cuda.synchronize()


def environment(setting: Setting) -> list[Item]:
    """What this machine is."""

    def versions() -> dict[str, Any]:
        import platform
        from importlib.metadata import PackageNotFoundError, version

        import torch

        details: dict[str, Any] = {"python": platform.python_version(), "cores": os.cpu_count()}
        for name in ("torch", "triton", "numpy", "numba", "pydantic", "lightning-fabric"):
            try:
                details[name] = version(name)
            except PackageNotFoundError:
                details[name] = None
        details["threads"] = torch.get_num_threads()
        if setting.device == "cuda":
            properties = torch.cuda.get_device_properties(0)
            details |= {"gpu": properties.name, "memory_gb": round(properties.total_memory / 1e9, 1)}
            details |= {"multiprocessors": properties.multi_processor_count, "cuda": torch.version.cuda}
        return details

    def package() -> dict[str, Any]:
        import beambox

        return {"beambox": beambox.__version__}

    return [("versions", versions), ("import beambox", package)]


def frames(setting: Setting) -> list[Item]:
    """Simulate the sweeps that the other groups look at."""

    def simulate() -> dict[str, Any]:
        import numpy as np

        from beambox.simulate import simulate_frame

        start = time.perf_counter()
        stored: dict[str, Any] = {}
        for i in range(2 if setting.quick else 8):
            frame = simulate_frame(1, i)
            assert frame.labels is not None
            stored |= {f"points{i}": frame.points.numpy(), f"boxes{i}": frame.labels.boxes.numpy()}
            stored[f"names{i}"] = np.array(frame.labels.names)
        setting.frames.parent.mkdir(parents=True, exist_ok=True)
        np.savez(setting.frames, **stored)
        points = [len(value) for name, value in stored.items() if name.startswith("points")]
        return {"sweeps": len(points), "points": points, "simulated_s": round(time.perf_counter() - start, 1)}

    return [("simulate", simulate)]


def items_of(group: str, setting: Setting) -> list[Item]:
    """List the items of a group."""
    kind, _, name = group.partition(":")
    if kind == "environment":
        return environment(setting)
    if kind == "frames":
        return frames(setting)
    if kind == "ops":
        import gpu_ops

        return gpu_ops.GROUPS[name](setting)
    if kind == "same":
        import gpu_same

        return gpu_same.items(name, setting)
    if kind == "tests":
        import gpu_same

        return gpu_same.tests(setting)
    import gpu_speed

    if kind == "peaks":
        return gpu_speed.peaks(setting)
    if kind == "speed":
        return [*gpu_speed.latency(name, setting), *gpu_speed.training(name, setting)]
    raise SystemExit(f"no group is called {group}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--group", required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--frames", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--skip", nargs="*", default=[])
    arguments = parser.parse_args()
    setting = Setting(arguments.device, arguments.quick, arguments.frames)
    sys.exit(run(items_of(arguments.group, setting), arguments.skip, arguments.device))


if __name__ == "__main__":
    main()
