"""Detect and track through a stream, write the boxes, and measure: latency, and sweeps dropped to keep up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.data.formats.columns import library
from beambox.io import replacing
from beambox.stream.messages import Kind, kinds
from beambox.stream.source import Arrival
from beambox.structures import Detections, Frame
from beambox.track.tracker import Tracker
from beambox.track.tracks import Tracks

__all__ = ["Report", "in_real_time", "recording_writer", "run_stream", "untracked"]

Detect = Callable[[Frame], Detections]
Write = Callable[[Arrival, Tracks], None]
GAP = 5.0
"""Seconds without a sweep, or back in time, after which objects are forgotten."""


@dataclass
class Report:
    """What a stream took."""

    done: int = 0
    dropped: int = 0
    unreadable: list[str] = field(default_factory=list)
    objects: int = 0
    seconds: list[float] = field(default_factory=list)
    """From taking a sweep up to its boxes written."""
    started: float = field(default_factory=time.perf_counter)

    def text(self) -> str:
        """Say it in a line."""
        wall = time.perf_counter() - self.started
        details = f"{self.done} sweeps in {wall:.1f} s, {self.dropped} dropped, {len(self.unreadable)} unreadable"
        if self.seconds:
            middle, high, most = np.percentile(self.seconds, (50, 95, 100)) * 1000
            details += f"; latency {middle:.0f} ms median, {high:.0f} ms 95 %, {most:.0f} ms at most"
        return details


def run_stream(
    sweeps: Iterable[Arrival],
    detect: Detect,
    tracker: Tracker | None,
    write: Write,
    *,
    score_threshold: float = 0.0,
    notice: Callable[[str], None] = lambda text: None,
) -> Report:
    """Go through sweeps as they come; one that cannot be read is left out and counted.

    Args:
        sweeps: in order of time.
        detect: frame -> detections in its own frame.
        tracker: gives identities; None writes detections as they are.
        write: takes each sweep with its objects.
        score_threshold: leave out lower detections.
        notice: told about sweeps that cannot be read, and of gaps.

    Returns:
        The measurements; see also :func:`in_real_time`, which counts what it drops there.
    """
    report = Report()
    last: int | None = None
    for sweep in sweeps:
        begin = time.perf_counter()
        try:
            found = detect(sweep.read())
        except BeamboxError as error:
            report.unreadable.append(sweep.name)
            notice(f"left out: {error}")
            continue
        found = found[found.scores >= score_threshold]
        if tracker is None:
            tracks = untracked(found, sweep.stamp / 1e9)
        else:
            if last is not None and not 0 <= (sweep.stamp - last) / 1e9 <= GAP:
                notice(f"{sweep.name}: {(sweep.stamp - last) / 1e9:+.1f} s after the sweep before: tracks begin anew")
                tracker.reset()
            tracks = tracker.update(found, sweep.stamp / 1e9)
        last = sweep.stamp
        write(sweep, tracks)
        report.done += 1
        report.objects += len(tracks)
        report.seconds.append(time.perf_counter() - begin)
    return report


def untracked(found: Detections, seconds: float) -> Tracks:
    """Return detections as objects without identity and velocity."""
    count = len(found)
    zeros = torch.zeros(count)
    return Tracks(found, torch.zeros(count, dtype=torch.int64), torch.zeros(count, 3), zeros, zeros, seconds)


def in_real_time(
    sweeps: Iterable[Arrival], on_drop: Callable[[Arrival], None], *, speed: float = 1.0
) -> Iterator[Arrival]:
    """Let sweeps arrive as they were recorded; whoever is slower gets the newest, the older ones are dropped.

    Args:
        sweeps: in order of time.
        on_drop: told about each sweep that nobody took in time.
        speed: 2 plays twice as fast.
    """
    waiting: list[Arrival] = []
    faults: list[BaseException] = []
    changed, ended, stopped = threading.Condition(), threading.Event(), threading.Event()

    def play() -> None:
        first: tuple[float, int] | None = None
        try:
            for sweep in sweeps:
                first = first or (time.monotonic(), sweep.time)
                due = first[0] + (sweep.time - first[1]) / 1e9 / speed
                if stopped.wait(max(0.0, due - time.monotonic())):
                    return
                with changed:
                    for old in waiting:
                        on_drop(old)
                    waiting[:] = [sweep]
                    changed.notify()
        except BaseException as error:  # carried over to whoever takes the sweeps
            faults.append(error)
        finally:
            ended.set()
            with changed:
                changed.notify()

    player = threading.Thread(target=play, name="player", daemon=True)
    player.start()
    try:
        while True:
            with changed:
                while not waiting and not ended.is_set():
                    changed.wait(0.1)
                if not waiting:
                    break
                sweep = waiting.pop()
            yield sweep
        if faults:
            raise faults[0]
    finally:
        stopped.set()
        player.join(timeout=10)


@contextmanager
def recording_writer(out: Path, options: Mapping[str, object], *, lifetime: float = 0.25) -> Iterator[Write]:
    """Open an MCAP file for boxes; it appears under its name once it is complete.

    Args:
        out: the .mcap file.
        options: what made the boxes; kept in the file's metadata.
        lifetime: seconds for which viewers show a box that nothing replaces.

    Yields:
        What writes the objects of a sweep, under its stamp, frame id and a topic below its own.

    Raises:
        BeamboxError: if the ending is another, or a library is not installed.
    """
    if out.suffix.lower() != ".mcap":
        raise BeamboxError(f'boxes are written into a .mcap file, got "{out.name}"')
    mcap = library("mcap.writer", out, "recordings")
    every = kinds(out)
    with replacing(out) as stream:
        writer = mcap.Writer(stream)
        writer.start(profile="ros2", library=f"beambox {__version__}")
        writer.add_metadata("beambox", {"version": __version__, **{key: str(value) for key, value in options.items()}})
        schemas = [writer.register_schema(one.schema, one.schema_encoding, one.definition) for one in every]
        channels: dict[tuple[str, str], int] = {}

        def channel(sweep: Arrival, kind: Kind, schema: int) -> int:
            key = (sweep.topic, kind.topic)
            if key not in channels:
                topic = f"{sweep.topic.rstrip('/')}/beambox/{kind.topic}"
                channels[key] = writer.register_channel(topic, kind.encoding, schema, {"source_topic": sweep.topic})
            return channels[key]

        def write(sweep: Arrival, tracks: Tracks) -> None:
            stamp = divmod(sweep.stamp, 1_000_000_000)
            for kind, schema in zip(every, schemas):
                content = kind.encode(tracks, stamp, sweep.frame_id, lifetime)
                writer.add_message(channel(sweep, kind, schema), sweep.time, content, sweep.stamp)

        yield write
        writer.finish()
