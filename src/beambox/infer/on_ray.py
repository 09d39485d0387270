"""The shards of a job as tasks of Ray, on whichever machines its cluster has; they share a file system.

Each task does what `beambox detect --shard i/n --skip-existing` does. Ray starts a task again whose process or machine
died; the journals (:mod:`beambox.infer.journal`) see to it that no sweep is lost and none is there twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from beambox.checks import BeamboxError, import_library
from beambox.infer.inputs import Sweep
from beambox.infer.jobs import MOST_FAULTS, Job, Tally, expect_unfinished, run_job

__all__ = ["need_ray", "run_on_ray"]

TRIES = 5
"""How often Ray starts a part again whose process died."""


def need_ray() -> Any:
    """Import Ray.

    Raises:
        BeamboxError: if it is not installed.
    """
    return import_library("ray", "ray", "--ray", "or start --shard i/n on each machine")


def run_on_ray(sweeps: Sequence[Sweep], job: Job, parts: int, *, skip_existing: bool = False, gpus: float = 0) -> Tally:
    """Detect in all sweeps of a job, in so many parts, as tasks of one core (and ``gpus``) each.

    The cluster is the one that Ray finds (``RAY_ADDRESS``, or one on this machine), else one is started here.

    Args:
        sweeps: all there are; their paths and the job's folder must be the same on every machine.
        job: what to do; its shard is not looked at.
        parts: tasks; a few per core even out what differs between sweeps.
        skip_existing: leave out what is done already.
        gpus: of each task.

    Raises:
        BeamboxError: if Ray is not installed, a part fails, or there are results already and they are not to be
            skipped; what is written stays and is whole.
    """
    ray = need_ray()
    shards = [replace(job, shard=(k, parts)) for k in range(parts)]
    if not skip_existing:
        for shard in shards:
            expect_unfinished(shard)
    started = not ray.is_initialized()
    if started:
        ray.init(include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        listed = ray.put(list(sweeps))
        part = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=TRIES)(_part)
        tallies = ray.get([part.remote(listed, shard) for shard in shards])
    except ray.exceptions.RayError as error:
        details = " ".join(str(getattr(error, "cause", None) or error).split())[:300]
        raise BeamboxError(f"a part failed ({details}); go on with the same command and --skip-existing") from None
    finally:
        if started:
            ray.shutdown()
    whole = Tally()
    for one in tallies:
        whole.sweeps, whole.boxes, whole.failed = (
            whole.sweeps + one.sweeps,
            whole.boxes + one.boxes,
            whole.failed + one.failed,
        )
        whole.faults += one.faults[: MOST_FAULTS - len(whole.faults)]
    return whole


def _part(sweeps: list[Sweep], job: Job) -> Tally:
    import torch

    torch.set_num_threads(1)
    return run_job(sweeps, job, skip_existing=True)
