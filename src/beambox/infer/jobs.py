"""Detecting over very many sweeps: shards for machines, workers for cores, what is done already left out."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from beambox.checks import BeamboxError
from beambox.infer.inputs import Sweep
from beambox.infer.journal import Journal, done_in, need_pyarrow, write_parquet
from beambox.infer.results import FORMATS, choose_formats

__all__ = ["TABLES", "Job", "Tally", "choose_kinds", "expect_unfinished", "parse_shard", "remaining", "run_job"]

MOST_FAULTS = 5
TABLES = ("jsonl", "parquet")
"""Formats with the boxes of many sweeps in one file."""


@dataclass(frozen=True)
class Job:
    """What every worker does; picklable."""

    model: str
    options: Mapping[str, Any]
    """Of :func:`beambox.infer.predictor.load`."""
    out: Path
    kinds: Sequence[str] = ("jsonl",)
    """jsonl or parquet, or formats of one file per sweep."""
    score_threshold: float = 0.0
    shard: tuple[int, int] = (0, 1)
    """Which part of how many, counted from 0."""


@dataclass
class Tally:
    """What a worker did."""

    sweeps: int = 0
    boxes: int = 0
    failed: int = 0
    """Sweeps that could not be read; they are tried again next time."""
    faults: list[str] = field(default_factory=list)
    """What was wrong with the first of them."""


def parse_shard(text: str) -> tuple[int, int]:
    """Read ``i/n``, counted from 1 as in 1/10 to 10/10.

    Raises:
        BeamboxError: if it is something else.
    """
    first, slash, last = text.partition("/")
    if slash and first.strip().isdecimal() and last.strip().isdecimal() and 1 <= int(first) <= int(last):
        return int(first) - 1, int(last)
    raise BeamboxError(f'--shard takes i/n with i from 1 to n, such as 3/10; got "{text}"')


def choose_kinds(words: str) -> list[str]:
    """Read ``"kitti,json"`` or ``"jsonl"``: formats of one file per sweep, or of many sweeps in one.

    Raises:
        BeamboxError: for an unknown format, none, or both sorts together.
    """
    names = [word.strip().lower() for word in words.split(",") if word.strip()]
    if not set(names) & set(TABLES):
        return choose_formats(words)
    if set(names) - set(TABLES):
        raise BeamboxError(f"{' and '.join(TABLES)} hold many sweeps in one file; write other formats by another run")
    return list(dict.fromkeys(names))


def remaining(sweeps: Sequence[Sweep], job: Job, skip_existing: bool) -> list[Sweep]:
    """Return the sweeps of the job's shard that are not done yet.

    A sweep is done where a journal of the folder holds it, or its files are there in all formats.
    """
    number, total = job.shard
    mine = list(sweeps[number::total])
    if not skip_existing:
        return mine
    if any(kind in TABLES for kind in job.kinds):
        done = done_in(job.out)
        return [sweep for sweep in mine if sweep.name not in done]
    return [
        sweep for sweep in mine if not all((job.out / f"{sweep.name}{FORMATS[kind]}").exists() for kind in job.kinds)
    ]


def run_job(sweeps: Sequence[Sweep], job: Job, workers: int = 1, *, skip_existing: bool = False) -> Tally:
    """Detect in the sweeps of a shard and write; several workers are processes of one thread each.

    Args:
        sweeps: all there are; the shard takes its part of them.
        job: what to do.
        workers: processes; as many as there are cores is best, as threads on one sweep gain less.
        skip_existing: leave out what is done already.

    Raises:
        BeamboxError: if a worker fails, or a library is not installed, or a journal has sweeps already and they are not
            to be skipped; what is written stays and is whole.
    """
    if "parquet" in job.kinds:
        need_pyarrow()
    expect_unfinished(job, skip_existing)
    sweeps = remaining(sweeps, job, skip_existing)
    if workers <= 1:
        tally = _work(sweeps, job, 0, 1)
    else:
        tally = _spread(sweeps, job, min(workers, max(1, len(sweeps))))
    if "parquet" in job.kinds:
        journals = sorted(job.out.glob(f"{_part(job)}*.jsonl"))
        write_parquet(journals, job.out / f"{_part(job)}.parquet")
    return tally


def expect_unfinished(job: Job, skip_existing: bool = False) -> None:
    """Refuse a shard whose journals hold sweeps already, unless these are to be skipped.

    Waits for what a killed run left behind to end.
    """
    for path in sorted(job.out.glob(f"{_part(job)}*.jsonl")):
        with Journal(path) as journal:
            if journal.done and not skip_existing:
                raise BeamboxError(f"{path} holds sweeps already: go on with --skip-existing, or give another folder")


def _part(job: Job) -> str:
    number, total = job.shard
    return f"part-{number + 1:05d}-of-{total:05d}"


def _spread(sweeps: Sequence[Sweep], job: Job, workers: int) -> Tally:
    context = multiprocessing.get_context("spawn")
    results = context.SimpleQueue()
    processes = [
        context.Process(target=_worker, args=(list(sweeps[k::workers]), job, k, workers, results), daemon=True)
        for k in range(workers)
    ]
    for process in processes:
        process.start()
    whole, faults = Tally(), []
    try:
        for process in processes:
            process.join()
    finally:
        for process in processes:
            if process.is_alive():
                process.terminate()
    while not results.empty():
        one = results.get()
        if isinstance(one, str):
            faults.append(one)
            continue
        whole.sweeps += one.sweeps
        whole.boxes += one.boxes
        whole.failed += one.failed
        whole.faults += one.faults[:MOST_FAULTS]
    ended = [process.exitcode for process in processes if process.exitcode]
    if faults or ended:
        details = faults[0] if faults else f"exit status {ended[0]}"
        raise BeamboxError(f"a worker failed ({details}); go on with the same command and --skip-existing")
    return whole


def _worker(sweeps: list[Sweep], job: Job, number: int, workers: int, results: Any) -> None:
    import torch

    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        results.put(_work(sweeps, job, number, workers))
    except (BeamboxError, OSError) as error:
        results.put(str(error))


def _work(sweeps: list[Sweep], job: Job, number: int, workers: int) -> Tally:
    from beambox.infer.predictor import load

    tally = Tally()
    if not sweeps:
        return tally
    detector = load(job.model, **job.options)
    if not any(kind in TABLES for kind in job.kinds):
        _each(sweeps, job, detector, tally, None)
        return tally
    suffix = f"-worker-{number + 1}" if workers > 1 else ""
    with Journal(job.out / f"{_part(job)}{suffix}.jsonl") as journal:
        _each(sweeps, job, detector, tally, journal)
    return tally


def _each(sweeps: list[Sweep], job: Job, detector: Any, tally: Tally, journal: Journal | None) -> None:
    from beambox.infer.results import write_results

    parent = os.getppid()
    for sweep in sweeps:
        if os.getppid() != parent:
            return  # whoever started this worker was killed
        if journal is not None and sweep.name in journal.done:
            continue
        try:
            frame = detector.read(sweep)
        except BeamboxError as error:
            tally.failed += 1
            tally.faults += [str(error)] if len(tally.faults) < MOST_FAULTS else []
            continue
        found = detector.detect([frame])[0]
        found = found[found.scores >= job.score_threshold]
        if journal is None:
            write_results(job.out, frame, found, job.kinds, job.model, sweep.name)
        else:
            journal.append(sweep.name, found)
        tally.sweeps += 1
        tally.boxes += len(found)
