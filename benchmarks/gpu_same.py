"""Detectors on the device against the CPU with the same weights: outputs, losses, gradients, detections; and tests."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as xml
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from gpu_items import Item, Setting
from gpu_ops import error
from torch import Tensor, nn

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = {"pointpillars": "pointpillars-kitti", "voxel_rcnn": "voxel_rcnn-kitti", "dennet": "dennet-kitti"}


def recipe_of(name: str) -> Any:
    """Return a detector's recipe for KITTI, with all the width it has."""
    from beambox.train.config import read_recipe

    return read_recipe(f"{name}-kitti-3class")


def full_width(name: str) -> nn.Module:
    """Build a detector as its recipe for KITTI has it, with random weights that let a sweep through."""
    from beambox.detectors.catalog import build

    torch.manual_seed(0)
    recipe = recipe_of(name)
    return build(recipe.detector.name, recipe.detector.options)


def settle(model: Any, batch: Any) -> None:
    """Give batch norms the statistics of a batch, so that random weights neither fade out nor explode."""
    norms = [layer for layer in model.modules() if isinstance(layer, nn.modules.batchnorm._BatchNorm)]
    former = [layer.momentum for layer in norms]
    for layer in norms:
        layer.momentum = 1.0
    model.train()
    with torch.no_grad():
        model(batch)
    for layer, momentum in zip(norms, former):
        layer.momentum = momentum
    model.eval()


def tensors(value: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Walk through the tensors of nested predictions."""
    if isinstance(value, Tensor):
        yield name, value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for entry in dataclasses.fields(value):
            yield from tensors(getattr(value, entry.name), f"{name}.{entry.name}".strip("."))
    elif isinstance(value, tuple | list):
        for place, one in enumerate(value):
            yield from tensors(one, f"{name}.{place}")


def exactly() -> None:
    """Compute float32 as float32, so that differences are faults and not the matrix units' rounding."""
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = False


def model_of(name: str, setting: Setting, shipped: bool) -> Any:
    """Return a detector in evaluation mode on the CPU: shipped weights, or random ones at full width."""
    if shipped:
        from beambox.detectors.weights import load_weights
        from beambox.zoo import shipped as files

        return load_weights(files()[SHIPPED[name]], "cpu").eval()
    model = full_width(name)
    settle(model, setting.batch(1))
    return model


def agreement(actual: Any, want: Any) -> dict[str, Any]:
    """Compare detections of one sample: each of ours has its nearest reference of the same class."""
    details: dict[str, Any] = {"count": [len(actual), len(want)]}
    if not len(actual) or not len(want):
        return details | {"ok": len(actual) == len(want)}
    actual = actual.to("cpu")
    distance = (actual.boxes[:, None] - want.boxes[None]).abs().amax(dim=2)
    distance = torch.where(actual.class_ids[:, None] == want.class_ids[None], distance, torch.inf)
    nearest, row = distance.min(dim=1)
    same = nearest < 1e-2
    details["matched"] = int(same.sum())
    details["boxes"] = float(nearest[same].max()) if bool(same.any()) else None
    details["scores"] = float((actual.scores - want.scores[row])[same].abs().max()) if bool(same.any()) else None
    return details | {"ok": len(actual) == len(want) and bool(same.all())}


def detections(name: str, setting: Setting, shipped: bool) -> dict[str, Any]:
    """Compare predictions and detections of one sweep in float32."""
    exactly()
    model = model_of(name, setting, shipped)
    batch = setting.batch(1)
    with torch.inference_mode():
        want = model(batch)
        found = model.decode(want)
        there = model.to(setting.device)
        actual = there(batch.to(setting.device))
        ours = there.decode(actual)
    errors = {
        part: error(a, b)
        for (part, a), (_, b) in zip(tensors(actual), tensors(want))
        if a.is_floating_point() and a.shape == b.shape
    }
    details = agreement(ours[0], found[0])
    first = [value for part, value in errors.items() if not part.startswith(("rois", "refined", "levels"))]
    return {**details, "worst": max(first, default=0.0), "limit": 1e-3, "errors": errors} | {
        "ok": details["ok"] and max(first, default=0.0) < 1e-3
    }


def lower_precision(name: str, setting: Setting, shipped: bool) -> dict[str, Any]:
    """Tell how far bfloat16 is from float32 on the device: for information, nothing fails."""
    from beambox.infer.predictor import Detector

    model = model_of(name, setting, shipped)
    batch = setting.batch(1).to(setting.device)
    found = {}
    for precision in ("float32", "bfloat16"):
        detector = Detector(model, device=setting.device, precision=precision)
        with torch.inference_mode():
            found[precision] = detector.model.decode(detector.predict(batch))[0].to("cpu")
    details = agreement(found["bfloat16"], found["float32"])
    details.pop("ok")
    return details


def learnt(model: Any, batch: Any, grid: Any) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Return the losses and gradients of one training pass."""
    model.zero_grad(set_to_none=True)
    torch.manual_seed(7)  # on every device, regions are drawn by the CPU's generator
    takes_labels = "labels" in inspect.signature(model.forward).parameters
    predictions = model(batch, grid, labels=batch.labels) if takes_labels else model(batch, grid)
    named = model.loss(predictions, batch.labels)
    torch.stack(list(named.values())).sum().backward()
    gradients = {k: p.grad.detach().cpu().clone() for k, p in model.named_parameters() if p.grad is not None}
    return {k: float(v.detach()) for k, v in named.items()}, gradients


def losses(name: str, setting: Setting, dtype: torch.dtype) -> dict[str, Any]:
    """Compare losses and gradients of a training pass over a window ahead.

    In float32 rounding may change the order of proposals, and with it the regions that a second stage learns from;
    so its parameters are judged in float64 alone, where such ties do not occur.
    """
    exactly()
    model = full_width(name).train().to(dtype)
    for layer in model.modules():
        if isinstance(layer, nn.Dropout):
            layer.p = 0.0
    whole, batch = model.config.grid, setting.batch(1)
    cells = tuple(min(n, 256) // 8 * 8 for n in whole.size[:2])
    grid = whole.window((0, (whole.size[1] - cells[1]) // 2 // 8 * 8), cells)
    batch = dataclasses.replace(batch, points=batch.points.to(dtype))
    want, theirs = learnt(model, batch, grid)
    actual, ours = learnt(model.to(setting.device), batch.to(setting.device), grid)
    tight = dtype == torch.float64
    judged = [k for k in theirs if tight or not k.startswith("roi_")]
    off = {k: abs(actual[k] - want[k]) / max(abs(want[k]), 1e-6) for k in want if tight or not k.startswith("roi_")}
    # Where a gradient is the difference of large terms (weights before a batch norm), rounding is all there is.
    norms = {k: float(theirs[k].norm()) for k in judged}
    wrong = {k: error(ours[k], theirs[k]) for k in judged if norms[k] > 1e-3 * max(norms.values())}
    worst = sorted(wrong, key=lambda k: -wrong[k])[:5]
    limit = 1e-4 if tight else 5e-2
    return {
        "ok": max(off.values()) < limit and set(ours) == set(theirs) and max(wrong.values()) < limit,
        "worst": max(wrong.values()),
        "limit": limit,
        "losses": {k: [actual[k], want[k]] for k in want},
        "gradients": {k: wrong[k] for k in worst},
    }


def items(name: str, setting: Setting) -> list[Item]:
    """Compare one detector."""
    pairs: list[Item] = []
    if name in SHIPPED:
        pairs += [("shipped weights", lambda: detections(name, setting, True))]
        pairs += [("shipped weights in bfloat16", lambda: lower_precision(name, setting, True))]
    for dtype in (torch.float64, torch.float32):
        pairs += [(f"losses and gradients, {dtype}", lambda d=dtype: losses(name, setting, d))]
    return [*pairs, ("random weights, full width", lambda: detections(name, setting, False))]


def tests(setting: Setting) -> list[Item]:
    """Run the project's own tests of kernels on the device."""

    def kernels() -> dict[str, Any]:
        files = sorted(str(path) for path in (ROOT / "tests/ops/interpreted").glob("triton_*.py"))
        variables = {"BEAMBOX_BACKEND": "triton", "TRITON_INTERPRET": "0" if setting.device == "cuda" else "1"}
        return pytest(files[:1] if setting.quick else files, variables, setting)

    def suite() -> dict[str, Any]:
        if setting.quick:
            return pytest([str(ROOT / "tests/ops/test_dispatch.py")], {}, setting)
        return pytest([str(ROOT / "tests" / part) for part in ("ops", "layers", "detectors", "infer")], {}, setting)

    return [("kernels", kernels), ("ops, layers, detectors, infer", suite)]


def pytest(paths: list[str], variables: dict[str, str], setting: Setting) -> dict[str, Any]:
    """Run tests; return how many passed, and the names of those that did not."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={report}", *paths]
        if not setting.quick and __import__("importlib.util").util.find_spec("xdist"):
            command += ["-n", str(max(1, (os.cpu_count() or 2) * 3 // 4))]
        done = subprocess.run(
            command, cwd=ROOT, env={**os.environ, **variables}, capture_output=True, text=True, check=False, timeout=150
        )
        print(done.stdout[-8000:], done.stderr[-3000:])
        if not report.exists():
            return {"ok": False, "told": (done.stdout + done.stderr)[-500:]}
        cases = list(xml.parse(report).iter("testcase"))
    failed = []
    for case in cases:
        fault = case.find("failure") if case.find("failure") is not None else case.find("error")
        if fault is not None:
            text = re.sub(r"\s+", " ", fault.get("message") or "")
            failed.append(f"{case.get('classname')}::{case.get('name')}: {text[:200]}")
    skipped = sum(case.find("skipped") is not None for case in cases)
    details = {"ok": not failed and bool(cases), "passed": len(cases) - len(failed) - skipped, "skipped": skipped}
    return details | {"failed": failed[:60]}
