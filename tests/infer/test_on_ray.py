"""The shards of a job on a local Ray of two processes: every sweep once, also where a process is killed."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from beambox.checks import BeamboxError
from beambox.infer.inputs import Sweep, find_sweeps
from beambox.infer.jobs import Job, run_job
from beambox.infer.journal import done_in, rows_in
from beambox.infer.on_ray import run_on_ray
from oracles.command_line import beambox
from oracles.paths import ROOT
from oracles.tiny_detector import street, tiny_weights

OPTIONS = {"device": "cpu", "precision": "float32"}


def rows(folder: Path) -> list[str]:
    return sorted(json.dumps(row) for path in folder.glob("*.jsonl") for row in rows_in(path))


@pytest.mark.slow
def test_two_processes_of_ray_do_what_one_does(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    (tmp_path / "in").mkdir()
    for k in range(6):
        street(k)[::5].tofile(tmp_path / "in" / f"{k:06d}.bin")
    (tmp_path / "in" / "000006.bin").write_bytes(b"abc")
    sweeps: list[Sweep] = find_sweeps([tmp_path / "in"])
    weights = str(tiny_weights(tmp_path))
    path = os.pathsep.join((str(ROOT / "src"), str(ROOT / "tests"), *filter(None, sys.path)))
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, runtime_env={"env_vars": {"PYTHONPATH": path}})
    try:
        tally = run_on_ray(sweeps, Job(weights, OPTIONS, tmp_path / "ray"), 3)
        assert (tally.sweeps, tally.failed) == (6, 1) and "000006.bin" in tally.faults[0]
        with pytest.raises(BeamboxError, match="holds sweeps already"):
            run_on_ray(sweeps, Job(weights, OPTIONS, tmp_path / "ray"), 3)
        again = run_on_ray(sweeps, Job(weights, OPTIONS, tmp_path / "ray"), 3, skip_existing=True)
        assert (again.sweeps, again.failed) == (0, 1)
        with pytest.raises(BeamboxError, match=r"a part failed .*--skip-existing"):
            run_on_ray(sweeps, Job("no-such-weights", OPTIONS, tmp_path / "none"), 1)
    finally:
        ray.shutdown()
    run_job(sweeps, Job(weights, OPTIONS, tmp_path / "one"))
    assert rows(tmp_path / "ray") == rows(tmp_path / "one") and len(rows(tmp_path / "one")) > 20
    assert len(done_in(tmp_path / "ray")) == 6 and len(list((tmp_path / "ray").glob("*.jsonl"))) == 3


def test_without_ray_and_with_shards_it_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    street().tofile(tmp_path / "scan.bin")
    words = ("detect", tmp_path / "scan.bin", "--model", "pointpillars-sim", "--out", tmp_path / "out", "--ray", "4")
    ran = beambox(capsys, *words)
    assert (
        ran.status == 2
        and '--ray needs the library ray, which is not installed: python -m pip install ".[ray]"' in ran.err
    )
    ran = beambox(capsys, *words, "--workers", "2")
    assert ran.status == 2 and "leave out --shard and --workers" in ran.err
    assert not (tmp_path / "out").exists()
