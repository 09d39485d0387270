"""Measure several programs in turn: each in a process of its own, asked line by line, so that a busy machine harms all.

A side's process prints `ready TEXT` and then answers each line of its input with one line.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


class Side:
    """The parent's end of one process.

    Raises:
        SystemExit: if the process ends before it is ready.
    """

    def __init__(self, name: str, command: Sequence[str], threads: int, extra_path: Sequence[Path] = ()) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "PYTHONWARNINGS": "ignore"}
        environment.setdefault("GOMP_SPINCOUNT", "10000")  # as the command line sets it
        paths = [str(ROOT / "src"), *(str(path) for path in extra_path), environment.get("PYTHONPATH", "")]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        self.name = name
        self.process = subprocess.Popen(
            [sys.executable, *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        word, _, self.details = self._line().partition(" ")
        if word != "ready":
            raise SystemExit(f"{name} could not start; see above")

    def _line(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:  # a library may print lines of its own
            if line.startswith(("ready", "answer")):
                return line.strip().removeprefix("answer ")
        return ""

    def ask(self, question: str) -> str:
        """Send one line and return the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(question + "\n")
        self.process.stdin.flush()
        answer = self._line()
        if not answer:
            raise SystemExit(f"{self.name} ended; see above")
        return answer


def serve(details: str, answers: Mapping[str, Callable[[str], str]]) -> None:
    """Be one side until the input ends: the first word of a line names the answer, the rest is its argument."""
    print(f"ready {details}", flush=True)
    for line in sys.stdin:
        word, _, rest = line.strip().partition(" ")
        print("answer", answers[word](rest), flush=True)


def timed(run: Callable[[], object]) -> str:
    """Run and return seconds by the clock and of the processors, as one line."""
    start, busy = time.perf_counter(), time.process_time()
    run()
    return f"{time.perf_counter() - start} {time.process_time() - busy}"
