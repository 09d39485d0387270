"""What a training run tells: lines on the console, a JSON-lines file, TensorBoard, and where the time went."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from beambox.checks import how_to_install, printable

__all__ = ["RunLog", "Timer", "duration"]


class Timer:
    """Adds up the wall time of the parts of a step (on a GPU: until the work is queued, not until it is done)."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Count the time inside the ``with`` under a name."""
        start = time.perf_counter()
        yield
        self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - start

    def shares(self) -> str:
        """Tell each part's share, as ``4 % data, 40 % forward``, and start anew."""
        total = sum(self.seconds.values()) or 1.0
        details = ", ".join(f"{100 * spent / total:.0f} % {part}" for part, spent in self.seconds.items())
        self.seconds = {}
        return details


def duration(seconds: float) -> str:
    """Write a time as ``2 h 05 min``, ``3 min 20 s`` or ``12 s``."""
    whole = max(0, round(seconds))
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 60} min {whole % 60:02d} s" if whole >= 60 else f"{whole} s"


class RunLog:
    """The voice of one run; silent in all processes but the first of a distributed run."""

    def __init__(self, folder: Path, total: int, first: int, active: bool = True, tensorboard: bool = True) -> None:
        """Open the log.

        Args:
            folder: the run's; gets ``log.jsonl`` and ``tensorboard/``.
            total: steps of the run.
            first: step at which it starts or goes on.
            active: False silences it.
            tensorboard: write TensorBoard scalars where the package is installed.
        """
        self.active, self.total, self.first = active, total, first
        self.started = time.perf_counter()
        self._console = Console(file=sys.stdout, soft_wrap=True, highlight=False)
        self._file: IO[bytes] | None = None
        self._lost = False
        self._board: Any = None
        self._bar: Progress | None = None
        self._heading: tuple[str, ...] = ()
        if not active:
            return
        folder.mkdir(parents=True, exist_ok=True)
        self._file = (folder / "log.jsonl").open("ab", buffering=0)  # nothing held back that a full disk could hurt
        if tensorboard:
            self._board = self._open_board(folder / "tensorboard", first)
        if self._console.is_terminal:
            columns = (TextColumn("step"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task("train", total=total, completed=first)
            self._bar.start()

    def _open_board(self, folder: Path, first: int) -> Any:
        try:
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError:
            self.info(f"no TensorBoard log: tensorboard is not installed ({how_to_install('train')})")
            return None
        return SummaryWriter(str(folder), purge_step=first)

    @property
    def shows_pictures(self) -> bool:
        """Whether pictures and curves go anywhere."""
        return self._board is not None

    def curves(self, step: int, curves: Mapping[str, tuple[int, Sequence[float]]]) -> None:
        """Write precision-recall curves for TensorBoard: (objects, precisions at recalls from 0 to 1) by name."""
        for name, (objects, heights) in curves.items():
            precision = np.clip(np.asarray(heights, dtype=np.float64), 1e-6, 1.0)
            recall = np.linspace(0.0, 1.0, len(precision))
            hits = recall * objects
            false = hits * (1 - precision) / precision
            counts = (hits, false, np.zeros_like(hits), objects - hits)
            # TensorBoard's thresholds rise, so its recalls fall
            rows = [values[::-1].copy() for values in (*counts, precision, recall)]
            self._to_board(lambda board: board.add_pr_curve_raw(f"validation/{name}", *rows, step, len(precision)))  # noqa: B023

    def picture(self, step: int, name: str, picture: Any) -> None:
        """Write a picture (an image of Pillow) for TensorBoard."""
        pixels = np.asarray(picture.convert("RGB"))  # (height, width, 3)
        self._to_board(lambda board: board.add_image(f"validation/{name}", pixels, step, dataformats="HWC"))

    def _to_board(self, write: Callable[[Any], None]) -> None:
        if self._board is None:
            return
        try:
            write(self._board)
        except OSError as error:
            self._warn_lost(error)

    def _warn_lost(self, error: OSError) -> None:
        if not self._lost:
            self.info(f"warning: the log cannot be written ({error.strerror or error}); training goes on")
        self._lost = True

    def info(self, text: str) -> None:
        """Print a line; a full disk behind the console is no reason to stop."""
        if not self.active:
            return
        try:
            self._console.print(printable(text), markup=False)
            if not self._console.is_terminal:
                sys.stdout.flush()
        except BrokenPipeError:
            raise
        except OSError:
            pass

    def progress(self, step: int) -> None:
        """Move the bar, where there is one."""
        if self._bar is not None:
            self._bar.update(self._task, completed=step)

    def losses(self, step: int, losses: Mapping[str, float], lr: float, times: str, seconds: float) -> None:
        """Print one line of the table of losses, and record it.

        Args:
            step: steps made so far.
            losses: means since the last line; ``total`` among them.
            lr: learning rate of the last step.
            times: where the time went.
            seconds: wall time of a step.
        """
        if not self.active:
            return
        if tuple(losses) != self._heading:
            self._heading = tuple(losses)
            names = "".join(f"{name[:9]:>10}" for name in losses)
            self.info(f"{'step':>8}{names}{'lr':>10}{'s/step':>8}  left")
        left = duration(seconds * (self.total - step))
        values = "".join(f"{value:>10.4f}" for value in losses.values())
        self.info(f"{step:>8}{values}{lr:>10.2e}{seconds:>8.3f}  {left} (time: {times})")
        self.record(step, {**{f"loss/{name}": value for name, value in losses.items()}, "lr": lr, "s/step": seconds})

    def record(self, step: int, values: Mapping[str, float]) -> None:
        """Write numbers to the files, without printing; where the disk is full they are lost, and training goes on."""
        try:
            if self._file is not None:
                self._file.write((json.dumps({"step": step, **values}) + "\n").encode())
            if self._board is not None:
                for name, value in values.items():
                    self._board.add_scalar(name, value, step)
        except OSError as error:
            self._warn_lost(error)

    def close(self) -> None:
        """End the bar and close the files."""
        if self._bar is not None:
            self._bar.stop()
        for each in (self._board, self._file):
            with suppress(OSError):
                if each is not None:
                    each.close()
