"""Shards, workers, and what a kill leaves: every sweep once, none twice."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.infer.inputs import Sweep, find_sweeps
from beambox.infer.jobs import Job, choose_kinds, parse_shard, run_job
from beambox.infer.journal import Journal, done_in, rows_in
from beambox.structures import Detections
from oracles.tiny_detector import street, tiny_weights

OPTIONS = {"device": "cpu", "precision": "float32"}


def found(count: int) -> Detections:
    boxes = torch.arange(count * 7, dtype=torch.float32).reshape(count, 7)
    return Detections(boxes, torch.full((count,), 0.5), torch.zeros(count, dtype=torch.int64), ("Car",))


def sweeps(folder: Path, count: int, every: int = 1) -> list[Sweep]:
    """Write so many files of one street, of whose points ``every`` n-th is kept."""
    folder.mkdir(exist_ok=True)
    points = street()[::every]
    for k in range(count):
        points.tofile(folder / f"{k:06d}.bin")
    return find_sweeps([folder])


def test_a_journal_keeps_whole_sweeps_alone_wherever_it_was_cut(tmp_path: Path) -> None:
    with Journal(tmp_path / "a.jsonl") as journal:
        for k in range(4):
            journal.append(f"s{k}", found(k))
    whole = (tmp_path / "a.jsonl").read_bytes()
    for cut in [*range(0, len(whole), 7), len(whole)]:
        path = tmp_path / "cut.jsonl"
        path.write_bytes(whole[:cut])
        with Journal(path) as journal:
            done = len(journal.done)
            for k in range(done, 4):
                journal.append(f"s{k}", found(k))
        assert path.read_bytes() == whole
    assert [row["sweep"] for row in rows_in(path)] == ["s1", "s2", "s2", "s3", "s3", "s3"]
    assert done_in(tmp_path) == {"s0", "s1", "s2", "s3"}


def test_one_process_writes_a_journal_and_other_files_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("fcntl")
    monkeypatch.setattr("beambox.infer.journal.PATIENCE", 0.2)
    with Journal(tmp_path / "a.jsonl"), pytest.raises(BeamboxError, match="another process writes"):
        Journal(tmp_path / "a.jsonl")
    (tmp_path / "b.jsonl").write_text('{"frame": 1}\n')
    with pytest.raises(BeamboxError, match="is no journal of detections"):
        Journal(tmp_path / "b.jsonl")
    assert (tmp_path / "b.jsonl").read_text() == '{"frame": 1}\n'


def test_a_full_disk_leaves_the_journal_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Journal(tmp_path / "a.jsonl") as journal:
        journal.append("s0", found(2))
        before, real = (tmp_path / "a.jsonl").read_bytes(), os.write

        def full(handle: int, content: memoryview) -> int:
            if len(content) > 40:
                return real(handle, content[:40])
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(OSError, match="No space left"):
            journal.append("s1", found(1))
        monkeypatch.undo()
        assert (tmp_path / "a.jsonl").read_bytes() == before


def test_shards_and_workers_give_what_one_process_gives(tmp_path: Path) -> None:
    weights, given = tiny_weights(tmp_path), sweeps(tmp_path / "in", 7)
    run_job(given, Job(str(weights), OPTIONS, tmp_path / "one"))
    for number in range(3):
        run_job(
            given, Job(str(weights), OPTIONS, tmp_path / "many", shard=(number, 3)), workers=2 if number == 1 else 1
        )
    rows = [
        sorted(json.dumps(row) for path in (tmp_path / name).glob("*.jsonl") for row in rows_in(path))
        for name in ("one", "many")
    ]
    assert rows[0] == rows[1] and len(rows[0]) > 11
    assert done_in(tmp_path / "many") == {sweep.name for sweep in given}
    with pytest.raises(BeamboxError, match="holds sweeps already: go on with --skip-existing"):
        run_job(given, Job(str(weights), OPTIONS, tmp_path / "one"))
    again = run_job(given, Job(str(weights), OPTIONS, tmp_path / "one"), skip_existing=True)
    assert (again.sweeps, again.failed) == (0, 0)


def test_formats_of_one_file_a_sweep_skip_what_is_there(tmp_path: Path) -> None:
    weights, given = tiny_weights(tmp_path), sweeps(tmp_path / "in", 4)
    job = Job(str(weights), OPTIONS, tmp_path / "out", kinds=("json", "csv"))
    assert run_job(given, job).sweeps == 4
    (tmp_path / "out" / "000002.csv").unlink()
    assert run_job(given, job, skip_existing=True).sweeps == 1


def test_parquet_has_one_row_a_box(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    weights, given = tiny_weights(tmp_path), sweeps(tmp_path / "in", 3)
    tally = run_job(given, Job(str(weights), OPTIONS, tmp_path / "out", kinds=("parquet",)))
    table = parquet.read_table(tmp_path / "out" / "part-00001-of-00001.parquet")
    assert table.num_rows == tally.boxes > 0
    assert table.column_names == ["sweep", "name", "score", "x", "y", "z", "l", "w", "h", "yaw"]


def test_an_unreadable_sweep_is_counted_and_tried_again(tmp_path: Path) -> None:
    weights, given = tiny_weights(tmp_path), sweeps(tmp_path / "in", 3)
    (tmp_path / "in" / "000001.bin").write_bytes(b"abc")
    job = Job(str(weights), OPTIONS, tmp_path / "out")
    tally = run_job(given, job)
    assert (tally.sweeps, tally.failed) == (2, 1) and "000001.bin" in tally.faults[0]
    street()[:50].tofile(tmp_path / "in" / "000001.bin")
    assert run_job(given, job, skip_existing=True).sweeps == 1


def test_words_of_the_command_line() -> None:
    assert parse_shard("3/10") == (2, 10)
    for wrong in ("0/10", "11/10", "3", "a/b", "1/0"):
        with pytest.raises(BeamboxError, match=r"--shard takes i/n"):
            parse_shard(wrong)
    assert choose_kinds("jsonl,parquet") == ["jsonl", "parquet"]
    with pytest.raises(BeamboxError, match="hold many sweeps in one file"):
        choose_kinds("jsonl,json")


def run_and_kill(tmp_path: Path, weights: Path, count: int, kills: int) -> None:
    """Start the command, kill -9 it and its group again and again at any moment, and let it end at last."""
    words = [
        sys.executable,
        "-m",
        "beambox",
        "detect",
        str(tmp_path / "in"),
        "--model",
        str(weights),
        "--format",
        "jsonl",
    ]
    words += ["--out", str(tmp_path / "out"), "--workers", "2", "--skip-existing", "--precision", "float32"]
    rng = np.random.default_rng(0)
    for kill in range(kills + 1):
        process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True)
        if kill == kills:
            _, output = process.communicate(timeout=600)
            assert process.returncode == 0, output
            break
        before = len(done_in(tmp_path / "out"))
        while process.poll() is None and len(done_in(tmp_path / "out")) < min(
            count - 1, before + 1 + count // (3 * kills)
        ):
            time.sleep(float(rng.uniform(0, 0.05)))
        if kill % 2:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()  # its workers are left to see that they are orphans
        process.wait()


def check_once(tmp_path: Path, count: int) -> None:
    lines = [line for path in (tmp_path / "out").glob("*.jsonl") for line in path.read_text().splitlines()]
    rows = [json.loads(line) for line in lines]
    done = Counter(row["done"] for row in rows if "done" in row)
    assert len(done) == count and set(done.values()) == {1}
    boxes = Counter(row["sweep"] for row in rows if "sweep" in row)
    assert boxes and all(boxes[row["done"]] == row["boxes"] for row in rows if "done" in row)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_kill_9_and_go_on(tmp_path: Path) -> None:
    sweeps(tmp_path / "in", 60)
    run_and_kill(tmp_path, tiny_weights(tmp_path), 60, kills=1)
    check_once(tmp_path, 60)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_kill_9_and_go_on_over_10000_sweeps(tmp_path: Path) -> None:
    sweeps(tmp_path / "in", 10_000, every=20)  # 845 points, 3 ms
    run_and_kill(tmp_path, tiny_weights(tmp_path), 10_000, kills=4)
    check_once(tmp_path, 10_000)
