"""The table at the end of benchmarks/gpu.py."""

from __future__ import annotations

from typing import Any

from gpu_items import DETECTORS

Report = dict[str, Any]


def items(report: Report, group: str) -> dict[str, Any]:
    """Return what a group reported."""
    return report["groups"].get(group, {}).get("items", {})


def table(report: Report) -> str:
    """Write the numbers for a terminal."""
    lines = ["", *machine(report), "", *correctness(report), "", *speed(report), "", *steps(report), *faults(report)]
    return "\n".join(lines) + f"\n{report.get('seconds', '?')} s in all\n"


def machine(report: Report) -> list[str]:
    """What it ran on, and what that can do at best."""
    details = items(report, "environment").get("versions", {})
    named = ", ".join(f"{k} {v}" for k, v in details.items() if k not in ("took",))
    best = items(report, "peaks")
    rates = [f"{name} {item['tflops']} TFLOP/s" for name, item in best.items() if "tflops" in item]
    rates += [f"copy {best['copy']['gbps']} GB/s"] if "gbps" in best.get("copy", {}) else []
    rates += [f"launch {best['launch']['microseconds']} us"] if "microseconds" in best.get("launch", {}) else []
    return [named, "measured at best: " + (", ".join(rates) or "not measured")]


def correctness(report: Report) -> list[str]:
    """How many items agreed with their references."""
    lines = [f"{'against the references':28} {'agree':>7} {'of':>5}  largest relative error"]
    for name, group in report["groups"].items():
        if not name.startswith(("ops:", "same:", "tests")):
            continue
        details = group.get("items", {})
        judged = {k: v for k, v in details.items() if "ok" in v or "error" in v}
        good = sum(v.get("ok") is True for v in judged.values())
        worst = max((v["worst"] for v in details.values() if "worst" in v), default=None)
        shown = "" if worst is None else f"{worst:.1e}"
        passed = [f"{v['passed']} tests passed, {len(v['failed'])} failed" for v in details.values() if "passed" in v]
        lines.append(f"{name:28} {good:7} {len(judged):5}  {shown}{'; '.join(passed)}{group.get('skipped', '')}")
    return lines


def speed(report: Report) -> list[str]:
    """Latency, share of the peaks, launches and waits."""
    best = items(report, "peaks")
    rate = (
        best.get("bfloat16", {}).get("tflops") if report["device"] == "cuda" else best.get("float32", {}).get("tflops")
    )
    copy = best.get("copy", {}).get("gbps")
    lines = [
        f"{'points to boxes, ms':14} {'batch 1':>9} {'batch 8':>9} {'float32':>9} {'GFLOP':>8} {'GB':>7} "
        f"{'of peak':>8} {'of copy':>8} {'launches':>9} {'waits':>6} {'kernels':>8} {'MB':>7}"
    ]
    for name in DETECTORS:
        details = items(report, f"speed:{name}")
        main = "bfloat16" if "bfloat16 batch 1" in details else "float32"
        one, eight, plain = (details.get(k, {}) for k in (f"{main} batch 1", f"{main} batch 8", "float32 batch 1"))
        work, launches, waits = (details.get(k, {}) for k in ("work, batch 1", "launches, batch 1", "waits, batch 1"))
        ms = one.get("ms")
        peak = f"{100 * work['gflop'] / ms / rate:.1f} %" if ms and rate and "gflop" in work else ""
        moved = f"{100 * work['gb'] / ms * 1e3 / copy:.1f} %" if ms and copy and "gb" in work else ""
        cells = (ms, eight.get("ms"), plain.get("ms"), work.get("gflop"), work.get("gb"))
        shown = [("" if c is None else f"{c:.2f}").rjust(w) for c, w in zip(cells, (9, 9, 9, 8, 7))]
        reads = waits.get("count", sum(work.get("host_reads", {}).values()) if work else "")
        count = launches.get("launches", work.get("torch_operations", ""))
        lines.append(
            f"{name:19} {' '.join(shown)} {peak:>8} {moved:>8} {count:>9} {reads:>6} "
            f"{launches.get('kernels_ms', ''):>8} {one.get('peak_mb', ''):>7}"
        )
    for name in DETECTORS:
        details = items(report, f"speed:{name}")
        for key in ("bfloat16 batch 1", "float32 batch 1"):
            stages = details.get(key, {}).get("stages")
            if stages:
                lines.append(f"{name}, {key}: " + ", ".join(f"{k} {v:.2f}" for k, v in stages.items() if v >= 0.005))
                break
    return lines


def steps(report: Report) -> list[str]:
    """Training."""
    lines = [f"{'training':14} {'steps/s':>8} {'sweeps/s':>9} {'batch':>6} {'peak MB':>9}  ms"]
    for name in DETECTORS:
        for key, details in items(report, f"speed:{name}").items():
            if "steps_per_s" in details:
                parts = ", ".join(f"{k} {v}" for k, v in details["stages_ms"].items())
                lines.append(
                    f"{name:14} {details['steps_per_s']:8} {details['sweeps_per_s']:9} {details['batch']:6} "
                    f"{details.get('peak_mb', ''):>9}  {parts} ({key})"
                )
    return lines


def faults(report: Report) -> list[str]:
    """All that failed, and why."""
    lines = []
    for name, group in report["groups"].items():
        for item, details in group.get("items", {}).items():
            if "error" in details:
                lines.append(f"FAILED {name}: {item}: {details['error']}")
            elif details.get("ok") is False:
                shown = {
                    k: details[k]
                    for k in ("worst", "limit", "wrong", "of", "count", "matched", "failed")
                    if k in details
                }
                lines.append(f"FAILED {name}: {item}: {shown}")
    return ["", *lines] if lines else ["", "nothing failed"]
