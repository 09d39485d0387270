"""Check and time beambox on a GPU, in one command of at most 8 minutes, on a machine that need not have it installed.

    python benchmarks/gpu.py --minutes 6 --out OUT

writes OUT/gpu.json (after every item, so that what was measured survives an interruption) and OUT/gpu.log, and prints a
table. Items run in groups, each group in a process of its own with a time limit: a kernel that fails, hangs or poisons
the device loses its own item and is reported; its group goes on in a new process with the next one. `--only` takes some
groups, `--list` names them. `--device cpu --quick` runs everything once and small, to try the script without a GPU.
What the packages on such a machine must be is told in benchmarks/README.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gpu_items import DETECTORS, MARK, missing_packages
from gpu_table import table

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Group:
    """Items that run in one process."""

    name: str
    """``kind`` or ``kind:detector``."""
    seconds: float
    """Time limit."""
    phase: int
    """Groups of one phase run side by side, phases one after the other; what is timed has a phase of its own."""
    results: list[dict[str, Any]] = field(default_factory=list)


def plan() -> list[Group]:
    """All groups, the most telling first."""
    ops = ("scatter", "boxes", "sparse_conv", "attention", "density", "voxels")
    groups = [Group("environment", 60, 0), Group("frames", 90, 0)]
    groups += [Group(f"ops:{name}", 120, 1) for name in ops]
    groups += [Group(f"same:{name}", 150, 1) for name in DETECTORS]
    groups += [Group("peaks", 45, 2)]
    groups += [Group(f"speed:{name}", 60, 3 + i) for i, name in enumerate(DETECTORS)]
    groups += [Group("tests", 180, 40)]
    return groups


class Session:
    """Runs groups, collects what they report, and writes it down as it comes."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.arguments = arguments
        self.out: Path = arguments.out
        self.out.mkdir(parents=True, exist_ok=True)
        self.end = time.monotonic() + 60 * arguments.minutes
        self.began = time.monotonic()
        self.lock = threading.Lock()
        self.threads = os.cpu_count() or 1
        self.report: dict[str, Any] = {
            "command": sys.argv[1:],
            "device": arguments.device,
            "quick": arguments.quick,
            "missing_packages": missing_packages(),
            "groups": {},
        }
        self.log = (self.out / "gpu.log").open("w", encoding="utf-8")
        self.frames = Path(tempfile.mkdtemp(prefix="beambox-gpu-")) / "frames.npz"

    def left(self) -> float:
        """Seconds that may still be used."""
        return self.end - time.monotonic()

    def say(self, text: str) -> None:
        """Write a line to the terminal and the log."""
        with self.lock:
            print(f"{time.monotonic() - self.began:6.1f} s  {text}", flush=True)
            self.log.write(text + "\n")
            self.log.flush()

    def write(self) -> None:
        """Bring the report to disk."""
        with self.lock:
            self.report["seconds"] = round(time.monotonic() - self.began, 1)
            draft = self.out / "gpu.json.part"
            draft.write_text(json.dumps(self.report, indent=1), encoding="utf-8")
            draft.replace(self.out / "gpu.json")

    def run(self, groups: list[Group]) -> None:
        """Run all groups, phase after phase."""
        for phase in sorted({group.phase for group in groups}):
            beside = [group for group in groups if group.phase == phase]
            lanes = min(len(beside), self.arguments.lanes)
            self.threads = max(1, (os.cpu_count() or 1) // lanes)
            waiting = list(beside)

            def work(waiting: list[Group] = waiting) -> None:
                while waiting:
                    try:
                        group = waiting.pop(0)
                    except IndexError:
                        return
                    self.group(group)

            threads = [threading.Thread(target=work) for _ in range(lanes)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()

    def group(self, group: Group) -> None:
        """Run one group, in a new process after each item that took the process with it."""
        limit = group.seconds * (10 if self.arguments.device == "cpu" else 1)
        details: dict[str, Any] = {"items": {}}
        with self.lock:
            self.report["groups"][group.name] = details
        if self.left() < 10:
            details["skipped"] = "no time left"
            self.say(f"{group.name}: no time left")
            self.write()
            return
        start = time.monotonic()
        deadline = min(start + limit, self.end)
        for attempt in range(4):
            lost = self.process(group, details, deadline)
            if lost is None:
                break
            details["items"][lost["item"]] = {"error": lost["error"]}
            self.say(f"{group.name}: {lost['item']}: {lost['error']}")
            if time.monotonic() > deadline - 10 or attempt == 3:
                break
        details["seconds"] = round(time.monotonic() - start, 1)
        failed = [name for name, item in details["items"].items() if "error" in item or item.get("ok") is False]
        self.say(
            f"{group.name}: {len(details['items'])} items in {details['seconds']} s"
            + (f", FAILED: {', '.join(failed)}" if failed else "")
        )
        self.write()

    def process(self, group: Group, details: dict[str, Any], deadline: float) -> dict[str, str] | None:
        """Run what is left of a group in a process; return the item it was lost on, if it was."""
        command = [sys.executable, str(Path(__file__).with_name("gpu_items.py")), "--group", group.name]
        command += ["--device", self.arguments.device, "--frames", str(self.frames), "--skip", *details["items"]]
        command += ["--quick"] * self.arguments.quick
        paths = [str(ROOT / "src"), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), "PYTHONUNBUFFERED": "1"}
        environment.setdefault("OMP_NUM_THREADS", str(self.threads))  # groups side by side share the cores
        child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, errors="replace"
        )
        late = threading.Timer(max(1.0, deadline - time.monotonic()), child.kill)
        late.start()
        current, last = "start", ""
        assert child.stdout is not None
        for line in child.stdout:
            if not line.startswith(MARK):
                last = line.strip() or last
                with self.lock:
                    self.log.write(f"[{group.name}] {line}")
                continue
            heard = json.loads(line[len(MARK) :])
            current = heard.pop("item")
            if heard:
                details["items"][current] = heard
                if "error" in heard:
                    self.say(f"{group.name}: {current}: {heard['error']}")
                self.write()
        code = child.wait()
        timed_out = not late.is_alive()
        late.cancel()
        if code == 0:
            return None
        why = "time limit" if timed_out else f"the process ended with code {code}: {last[-300:]}"
        if current in details["items"] and not timed_out:
            current = f"after {current}"
        return {"item": current, "error": why}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("gpu-out"), help="folder for gpu.json and gpu.log")
    parser.add_argument("--minutes", type=float, default=8.0, help="stop after so long")
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--quick", action="store_true", help="once and small, to try the script")
    parser.add_argument("--only", nargs="*", metavar="GROUP", help="some, by name (speed:dennet) or kind (speed)")
    parser.add_argument(
        "--lanes", type=int, default=max(1, min(8, (os.cpu_count() or 2) // 2)), help="processes at once"
    )
    parser.add_argument("--list", action="store_true", help="name the groups and stop")
    arguments = parser.parse_args()
    groups = plan()
    if arguments.only:
        wanted = {"environment", "frames"}.union(*(word.split(",") for word in arguments.only))
        wanted |= {"speed"} if wanted & {"latency", "train"} else set()
        groups = [g for g in groups if g.name in wanted or g.name.split(":")[0] in wanted]
    if arguments.list:
        print("\n".join(group.name for group in groups))
        return
    session = Session(arguments)
    if session.report["missing_packages"]:
        session.say(f"packages missing here: {' '.join(session.report['missing_packages'])}; see benchmarks/README.md")
    try:
        session.run(groups)
    finally:
        session.write()
        text = table(session.report)
        print(text)
        session.log.write(text)
        session.log.close()


if __name__ == "__main__":
    main()
