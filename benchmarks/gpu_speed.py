"""What the machine can do at best, how long each stage of a detector takes, and how fast training steps go."""

from __future__ import annotations

import math
import statistics
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from gpu_items import Item, Setting
from gpu_same import full_width, recipe_of, settle
from torch import Tensor, nn


def timed(work: Callable[[], Any], device: str, runs: int, warmup: int = 3) -> float:
    """Return the median time of some runs in seconds, by the device's own clock."""
    for _ in range(warmup):
        work()
    times = []
    for _ in range(runs):
        if device == "cuda":
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            work()
            end.record()
            end.synchronize()
            times.append(start.elapsed_time(end) / 1e3)
        else:
            began = time.perf_counter()
            work()
            times.append(time.perf_counter() - began)
    return statistics.median(times)


def peaks(setting: Setting) -> list[Item]:
    """Matrix products, a convolution and a copy, on random data."""
    device, quick = setting.device, setting.quick
    n, runs = (256, 2) if quick else (8192, 10)

    def product(dtype: torch.dtype, tf32: bool = False) -> dict[str, Any]:
        torch.backends.cuda.matmul.allow_tf32 = tf32
        a, b = (torch.randn(n, n, device=device).to(dtype) for _ in range(2))
        seconds = timed(lambda: a @ b, device, runs)
        return {"tflops": round(2 * n**3 / seconds / 1e12, 2)}

    def convolution(dtype: torch.dtype, tf32: bool = False) -> dict[str, Any]:
        torch.backends.cudnn.allow_tf32 = tf32
        batch, height, width = (1, 64, 64) if quick else (8, 248, 216)
        x = torch.randn(batch, 128, height, width, device=device, dtype=dtype).to(memory_format=torch.channels_last)
        w = torch.randn(128, 128, 3, 3, device=device, dtype=dtype).to(memory_format=torch.channels_last)
        seconds = timed(lambda: nn.functional.conv2d(x, w, padding=1), device, runs)
        return {"tflops": round(2 * batch * height * width * 128 * 128 * 9 / seconds / 1e12, 2)}

    def copy() -> dict[str, Any]:
        source = torch.randint(0, 127, (2**22 if quick else 2**32,), dtype=torch.int8, device=device)
        target = torch.empty_like(source)
        seconds = timed(lambda: target.copy_(source), device, runs)
        return {"gbps": round(2 * source.numel() / seconds / 1e9, 1)}

    def launch() -> dict[str, Any]:
        x = torch.zeros(32, device=device)

        def many() -> None:
            for _ in range(200):
                x.add_(1.0)

        return {"microseconds": round(timed(many, device, 3) / 200 * 1e6, 2)}

    found = [
        ("bfloat16", lambda: product(torch.bfloat16)),
        ("tf32", lambda: product(torch.float32, True)),
        ("float32", lambda: product(torch.float32)),
        ("convolution bfloat16", lambda: convolution(torch.bfloat16)),
        ("convolution tf32", lambda: convolution(torch.float32, True)),
        ("copy", copy),
        ("launch", launch),
    ]
    return found


class Marks:
    """Moments on the device's clock, each with the name of what has just ended."""

    def __init__(self, device: str) -> None:
        self.device, self.marks = device, []

    def __call__(self, name: str) -> None:
        """Note that something ended."""
        if self.device == "cuda":
            event: Any = torch.cuda.Event(enable_timing=True)
            event.record()
        else:
            event = time.perf_counter()
        self.marks.append((name, event))

    def stages(self) -> dict[str, float]:
        """Return milliseconds by name."""
        if self.device == "cuda":
            torch.cuda.synchronize()
        spent: dict[str, float] = {}
        for (_, before), (name, after) in zip(self.marks, self.marks[1:]):
            took = before.elapsed_time(after) if self.device == "cuda" else 1e3 * (after - before)
            spent[name] = spent.get(name, 0.0) + took
        return spent


@contextmanager
def watched(model: nn.Module, marks: Marks) -> Iterator[None]:
    """Mark where each of a model's parts begins and ends; what happens between is named after the part that follows."""
    handles = []
    for name, part in model.named_children():
        handles += [part.register_forward_pre_hook(lambda *_, n=name: marks(f"before {n}"))]
        handles += [part.register_forward_hook(lambda *_, n=name: marks(n))]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


class Subject:
    """A detector as it is used for inference, and sweeps that lie on its device."""

    def __init__(self, name: str, setting: Setting, precision: str) -> None:
        from beambox.infer.predictor import Detector

        model = full_width(name).to(setting.device)
        settle(model, setting.batch(1).to(setting.device))
        self.setting = setting
        self.detector = Detector(model, device=setting.device, precision=precision)

    def once(self, batch: Any) -> Any:
        """Points to boxes on the CPU."""
        with torch.inference_mode():
            found = self.detector.model.decode(self.detector.predict(batch))
            return [one.to("cpu") for one in found]

    def stages(self, batch: Any) -> dict[str, float]:
        """Time the stages of one pass."""
        marks = Marks(self.setting.device)
        with torch.inference_mode(), watched(self.detector.model, marks):
            marks("start")
            predictions = self.detector.predict(batch)
            marks("rest of the network")
            found = self.detector.model.decode(predictions)
            _ = [one.to("cpu") for one in found]
            marks("decode")
        return marks.stages()


@contextmanager
def replaced(function: Callable[..., Any], other: Callable[..., Any]) -> Iterator[None]:
    """Put another function in the place of one, in every module of the package that holds it."""
    holders = [m for name, m in list(sys.modules.items()) if name.startswith("beambox.")]
    places = [(m, name) for m in holders for name, held in vars(m).items() if held is function]
    for module, name in places:
        setattr(module, name, other)
    try:
        yield
    finally:
        for module, name in places:
            setattr(module, name, function)


def work_of(subject: Subject, batch: Any) -> dict[str, Any]:
    """Count multiplications and bytes of one pass, those of our own kernels included."""
    from torch.utils.flop_counter import FlopCounterMode

    from beambox.ops import sparse_conv
    from beambox.ops.neighborhood import neighborhood_attention as attend
    from beambox.ops.sparse_conv.pairs import input_rows
    from oracles.launches import Launches

    own = {"flop": 0.0, "bytes": 0.0}
    convolve = sparse_conv._convolve

    def counted_convolve(features: Tensor, weight: Tensor, bias: Any, pairs: Any) -> Tensor:
        out = convolve(features, weight, bias, pairs)
        table = pairs.kept(input_rows)
        own["flop"] += 2.0 * int((table >= 0).sum()) * weight[0, 0, 0].numel()
        own["bytes"] += sum(t.numel() * t.element_size() for t in (features, weight, out, table))
        return out

    def counted_attend(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int = 7) -> Tensor:
        own["flop"] += 4.0 * q.numel() * window * window
        own["bytes"] += 4.0 * q.numel() * q.element_size()
        return attend(q, k, v, bias, window)

    with replaced(convolve, counted_convolve), replaced(attend, counted_attend):
        with FlopCounterMode(display=False) as counter:
            subject.once(batch)
        dense = counter.get_total_flops()
    with Launches() as launches:
        subject.once(batch)
    return {
        "gflop": round((dense + own["flop"]) / 1e9, 3),
        "gflop_own_kernels": round(own["flop"] / 1e9, 3),
        "gb": round((launches.bytes + own["bytes"]) / 1e9, 4),
        "torch_operations": sum(launches.operations.values()),
        "host_reads": dict(launches.reads),
    }


def counted(subject: Subject, batch: Any) -> dict[str, Any]:
    """Count launches and waits of one pass with the profiler, and name the longest kernels."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        subject.once(batch)
        torch.cuda.synchronize()
    calls: Counter[str] = Counter()
    kernels: Counter[str] = Counter()
    home = 0
    for event in profiler.events():
        if event.device_type == torch.autograd.DeviceType.CUDA:
            kernels[event.name] += event.time_range.elapsed_us()
            home += "DtoH" in event.name
        elif event.name.startswith("cu"):
            calls[event.name] += 1
    launches = sum(count for name, count in calls.items() if "LaunchKernel" in name)
    waits = {name: count for name, count in calls.items() if "Synchronize" in name}
    return {
        "launches": launches,
        "waits": waits,
        "copies_to_the_cpu": home,
        "kernels_ms": round(sum(kernels.values()) / 1e3, 3),
        "longest_kernels_us": {name[:90]: round(us, 1) for name, us in kernels.most_common(15)},
    }


def waiting_places(subject: Subject, batch: Any) -> dict[str, Any]:
    """Name the lines that wait for the device."""
    with warnings.catch_warnings(record=True) as details:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            subject.once(batch)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    places = Counter(
        "/".join(w.filename.split("/")[-3:]) + f":{w.lineno}" for w in details if "synchroniz" in str(w.message).lower()
    )
    return {"count": sum(places.values()), "places": dict(places.most_common(40))}


def latency(name: str, setting: Setting) -> list[Item]:
    """Points to boxes at batch 1 and 8."""
    held: dict[str, Subject] = {}
    on_gpu = setting.device == "cuda"
    runs = 1 if setting.quick else 24

    def subject(precision: str) -> Subject:
        if precision not in held:
            held[precision] = Subject(name, setting, precision)
        return held[precision]

    def pass_of(precision: str, size: int) -> dict[str, Any]:
        of = subject(precision)
        batch = setting.batch(size).to(setting.device)
        of.once(batch)
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        seconds = timed(lambda: of.once(batch), setting.device, runs, 0 if setting.quick else 5)
        details: dict[str, Any] = {"ms": round(1e3 * seconds, 3), "points": len(batch.points)}
        if on_gpu:
            details["peak_mb"] = round(torch.cuda.max_memory_allocated() / 1e6, 1)
        all_stages = [of.stages(batch) for _ in range(max(1, runs // 3))]
        names = list(all_stages[0])
        details["stages"] = {n: round(statistics.median(s.get(n, 0.0) for s in all_stages), 3) for n in names}
        return details

    def counts(precision: str, size: int) -> dict[str, Any]:
        return work_of(subject(precision), setting.batch(size).to(setting.device))

    precisions = ("bfloat16", "float32") if on_gpu else ("float32",)
    items: list[Item] = [(f"{precisions[0]} batch 1", lambda: pass_of(precisions[0], 1))]
    items += [("work, batch 1", lambda: counts(precisions[0], 1))]
    if on_gpu:
        items += [("launches, batch 1", lambda: counted(subject("bfloat16"), setting.batch(1).to("cuda")))]
        items += [("waits, batch 1", lambda: waiting_places(subject("bfloat16"), setting.batch(1).to("cuda")))]
    if not setting.quick:
        items += [(f"{precisions[0]} batch 8", lambda: pass_of(precisions[0], 8))]
        if on_gpu:
            items += [("float32 batch 1", lambda: pass_of("float32", 1))]
            items += [("launches, batch 8", lambda: counted(subject("bfloat16"), setting.batch(8).to("cuda")))]
    return items


def training(name: str, setting: Setting) -> list[Item]:
    """Steps a second on sweeps that lie on the device already: what the data must keep up with."""
    from beambox.train.dataset import TrainingBatch
    from beambox.train.loop import ModelWithLoss
    from beambox.train.optim import adam

    on_gpu = setting.device == "cuda"

    def steps(precision: str, size: int) -> dict[str, Any]:
        recipe = recipe_of(name)
        model: Any = full_width(name)
        model = model.to(setting.device).to(memory_format=torch.channels_last).train()
        step, optimizer = ModelWithLoss(model), adam(model.parameters(), recipe.optim)
        work = TrainingBatch(setting.batch(size), None)
        spent: dict[str, list[float]] = {"forward and loss": [], "backward": [], "optimizer": []}
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        losses: list[float] = []
        runs = 1 if setting.quick else 6
        begin = 0.0
        for run in range(-(0 if setting.quick else 2), runs):
            if run == 0:
                _wait(on_gpu)
                begin = time.perf_counter()
            marks = Marks(setting.device)
            marks("start")
            there = work.to(setting.device)
            with torch.autocast(setting.device, dtype=torch.bfloat16, enabled=precision == "bfloat16"):
                total = torch.stack(list(step(there).values())).sum()
            marks("forward and loss")
            total.backward()
            marks("backward")
            torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            marks("optimizer")
            losses.append(float(total.detach()))
            if run >= 0:
                for part, took in marks.stages().items():
                    spent[part].append(took)
        _wait(on_gpu)
        seconds = (time.perf_counter() - begin) / runs
        details: dict[str, Any] = {"steps_per_s": round(1 / seconds, 3), "sweeps_per_s": round(size / seconds, 2)}
        details |= {"batch": size, "stages_ms": {part: round(statistics.median(t), 2) for part, t in spent.items()}}
        details |= {"losses": [round(value, 4) for value in (losses[0], losses[-1])]}
        details["ok"] = all(math.isfinite(value) for value in losses)
        if on_gpu:
            details["peak_mb"] = round(torch.cuda.max_memory_allocated() / 1e6, 1)
        return details

    size = 1 if setting.quick else recipe_of(name).optim.batch
    precision = "bfloat16" if on_gpu else "float32"
    return [(f"training, {precision} batch {size}", lambda: steps(precision, size))]


def _wait(on_gpu: bool) -> None:
    if on_gpu:
        torch.cuda.synchronize()
