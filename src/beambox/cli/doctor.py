"""`beambox doctor`: why does nothing work, or why are there no detections."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.cli import options

if TYPE_CHECKING:
    from pathlib import Path

    from beambox.infer.doctor import Diagnosis, Finding
    from beambox.infer.predictor import Detector

__all__ = ["command"]

MARKS = {"good": "ok ", "note": " - ", "bad": " ! "}


def command(
    inputs: Annotated[list[str] | None, typer.Argument(metavar="[INPUT]", help="A sweep to examine.")] = None,
    model: Annotated[str, typer.Option("--model", "-m", metavar="M", help="Weights to compare with, and to try.")] = "",
    fields: options.FieldsOption = "",
    device: options.DeviceOption = "auto",
) -> None:
    """Look at the installation, and at a sweep in which nothing is found.

    Examples:
      beambox doctor
      beambox doctor scan.bin
      beambox doctor scan.pcd --model run/best.safetensors

    A sweep is compared with what the weights were trained on: axes, height of the sensor, range, number of points,
    intensity. Each difference comes with the option of `beambox detect` that mends it; with weights at hand, both ways
    are tried.
    """
    if not inputs:
        from beambox.infer.environment import environment

        report(environment())
        return
    options.expect_there(inputs, model)

    from beambox.detectors.pointpillars import KITTI_PILLARS
    from beambox.infer.doctor import diagnose
    from beambox.infer.inputs import find_sweeps
    from beambox.infer.predictor import load
    from beambox.infer.sensor_profile import SensorProfile
    from beambox.zoo import DEFAULT, shipped

    name = model or (DEFAULT if DEFAULT in shipped() else "")
    detector = load(name, device=device, view="full", fields=fields or None) if name else None
    sensor_profile = (
        SensorProfile(KITTI_PILLARS) if detector is None else SensorProfile.of(detector.card, detector.grid)
    )
    for sweep in find_sweeps(inputs):
        print(f"{sweep.path}, compared with {name or 'KITTI'}:")
        diagnosis = diagnose(sweep.path, sensor_profile, fields or None)
        report(diagnosis.findings)
        if detector is not None:
            try_out(sweep.path, detector, diagnosis)
        if diagnosis.options:
            words = ["beambox", "detect", str(sweep.path), "--model", name or "M", *diagnosis.options]
            print("Try:  " + shlex.join(words))
        else:
            print("Nothing about the points explains missing detections.")


def report(findings: Iterable[Finding]) -> None:
    """Print one line a finding, and below it the option that mends it."""
    for finding in findings:
        print(f" {MARKS[finding.level]} {finding.about}: {finding.text}")
        if finding.option:
            print(f"      -> {shlex.join(finding.option)}")


def try_out(path: Path, detector: Detector, diagnosis: Diagnosis) -> None:
    """Detect as given and with the remedies, and tell how many detections are sure."""
    from beambox.infer.doctor import Finding

    def sure() -> str:
        found = detector(path)
        return f"{int((found.scores >= 0.3).sum())} (of {len(found)})"

    text = f"detections with a score of at least 0.3: {sure()} as given"
    if diagnosis.options:
        before = detector.alignment, detector.intensity_scale
        try:
            detector.alignment, detector.intensity_scale = diagnosis.alignment, diagnosis.intensity_scale
            text += f", {sure()} with the options below"
        finally:
            detector.alignment, detector.intensity_scale = before
    report([Finding("trial", "note", text)])
