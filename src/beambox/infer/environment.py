"""What beambox runs on: versions, processors, backends, and for each that cannot run, why."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import torch

from beambox import __version__
from beambox.checks import how_to_install
from beambox.infer.doctor import Finding
from beambox.infer.precision import bfloat16_reason
from beambox.ops.dispatch import can_run_numba, can_run_triton, pinned
from beambox.zoo import shipped

__all__ = ["environment"]

_OPTIONAL = (
    (".pcd", "pypcd4", "formats"),
    (".ply", "plyfile", "formats"),
    (".las, .laz", "laspy", "formats"),
    ("recordings", "rosbags", "recordings"),
    ("training", "lightning_fabric", "train"),
)


def environment() -> list[Finding]:
    """Look at the machine and the installation."""
    cores = os.cpu_count() or 1
    threads = torch.get_num_threads()
    findings = [
        Finding("beambox", "good", f"{__version__} on Python {platform.python_version()}, {platform.platform()}"),
        Finding("torch", "good", f"{torch.__version__}; {threads} threads on {cores} CPU cores"),
        Finding("packages", "good", ", ".join(f"{name} {_version(name)}" for name in ("numpy", "numba", "triton"))),
        _gpu(),
    ]
    findings += list(_backends())
    findings += [_precision(torch.device("cuda" if torch.cuda.is_available() else "cpu"))]
    for what, package, extra in _OPTIONAL:
        if find_spec(package) is None:
            text = f"cannot be read: {package} is not installed; {how_to_install(extra)}"
            findings.append(Finding(what, "note", text if extra != "train" else text.replace("be read", "be run")))
    names = ", ".join(shipped()) or "none in this installation"
    findings.append(Finding("weights", "good" if shipped() else "note", names))
    return findings


def _gpu() -> Finding:
    if torch.cuda.is_available():
        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
        return Finding("GPU", "good", f"{', '.join(names)}; CUDA {torch.version.cuda}")
    if torch.version.cuda is None:
        return Finding("GPU", "note", "not used: this torch was built for the CPU alone")
    return Finding("GPU", "note", f"not used: torch was built for CUDA {torch.version.cuda} but finds no GPU or driver")


def _backends() -> Iterator[Finding]:
    """Ask each backend whether it could run on this machine's best device."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    on_cpu, on_best = torch.zeros(1), torch.zeros(1, device=device)
    for name, reason in (("numba", can_run_numba(on_cpu)), ("triton", can_run_triton(on_best))):
        yield Finding(f"{name} backend", "note" if reason else "good", f"not used: {reason}" if reason else "used")
    pin = pinned()
    if pin:
        yield Finding("BEAMBOX_BACKEND", "note", f"pins every operation to {pin}")


def _precision(device: torch.device) -> Finding:
    reason = bfloat16_reason(device)
    if reason is None:
        return Finding("precision", "good", f"bfloat16 on {device.type}")
    return Finding("precision", "note", f"float32 on {device.type}: {reason}")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"
