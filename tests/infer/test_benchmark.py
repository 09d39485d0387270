"""Times of every stage, that add up and say what they were measured on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.infer import peaks
from beambox.infer.benchmark import STAGES, Report, measure, summary, untrained
from beambox.infer.predictor import load
from oracles.command_line import beambox
from oracles.tiny_detector import street, tiny_weights


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    folder = tmp_path_factory.mktemp("bench")
    for k in range(2):
        street(k).tofile(folder / f"{k}.bin")
    detector = load(tiny_weights(folder), device="cpu", precision="float32")
    return measure(detector, sorted(folder.glob("*.bin")), runs=4, warmup=1, batch=2, name="tiny")


def test_every_stage_of_every_run_takes_time(report: Report) -> None:
    assert list(report.milliseconds) == list(STAGES)
    assert all(len(times) == 4 and min(times) > 0 for times in report.milliseconds.values())


def test_the_total_is_the_sum_of_the_stages_and_the_throughput_counts_sweeps(report: Report) -> None:
    total = report.of(STAGES)
    assert total == [sum(report.milliseconds[stage][run] for stage in STAGES) for run in range(4)]
    assert report.throughput == pytest.approx(2 * 1000 / (sum(total) / 4))


def test_json_says_what_was_measured_on_what(report: Report) -> None:
    content = json.loads(json.dumps(report.to_json()))
    assert set(content["stages"]) == set(STAGES)
    assert set(content["total"]) == {"mean", "median", "p90", "p99", "min"}
    output = {key: content[key] for key in ("model", "precision", "batch", "points", "warmup", "runs", "unit")}
    expected = {
        "model": "tiny",
        "precision": "float32",
        "batch": 2,
        "points": 16900,
        "warmup": 1,
        "runs": 4,
        "unit": "ms",
    }
    assert output == expected
    assert content["torch"] == torch.__version__ and content["device"] and content["peak_memory_mb"] > 10


def test_stages_share_the_whole_and_stand_beside_the_machines_best(report: Report) -> None:
    content = report.to_json()
    assert sum(stage["share"] for stage in content["stages"].values()) == pytest.approx(1.0, abs=1e-3)
    assert set(content["machine"]) == {"convolution_gflops", "product_gflops", "copy_gbs"}
    assert all(value > 0.1 for value in content["machine"].values())
    assert "this machine at best: convolution" in report.table() and "%" in report.table()


def test_peaks_are_work_by_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peaks, "shortest", lambda run, device: 0.5)
    found = peaks.machine_peaks(torch.device("cpu"), torch.float32)
    assert found == {"convolution_gflops": 9.7, "product_gflops": 4.3, "copy_gbs": 0.3}


def test_tables_name_every_part(report: Report) -> None:
    assert all(stage in report.table() for stage in (*STAGES, "total", "sweeps/s"))
    parts = report.kassd_table()
    assert "mean of 4 runs" in parts and "45.9" in parts


def test_summary_of_known_times() -> None:
    assert summary([float(k) for k in range(1, 101)]) == {
        "mean": 50.5, "median": 50.5, "p90": 90.1, "p99": 99.01, "min": 1.0,
    }  # fmt: skip


def test_hooks_are_gone_after_the_measurement(tmp_path: Path) -> None:
    street().tofile(tmp_path / "a.bin")
    detector = load(tiny_weights(tmp_path), device="cpu")
    measure(detector, [tmp_path / "a.bin"], runs=1, warmup=0)
    assert not any(part._forward_pre_hooks for part in detector.model.children())


def test_nothing_to_measure_is_refused(tmp_path: Path) -> None:
    detector = load(tiny_weights(tmp_path), device="cpu")
    with pytest.raises(BeamboxError, match="needs sweeps and at least 1 run"):
        measure(detector, [])


def test_a_detector_is_timed_as_configured_without_trained_weights(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = tmp_path / "small.yaml"
    grid = {"minimum": [0, -16, -3], "maximum": [32, 16, 1], "cell": [0.2, 0.2, 0.1]}
    options = {"grid": grid, "encoder_widths": [4, 4, 8, 8], "encoder_out": 8, "width": 8, "kam_width": 8}
    recipe.write_text(json.dumps({"name": "small", "detector": {"name": "kassd", "options": options}}))
    first, again = untrained(recipe, device="cpu"), untrained(recipe, device="cpu")
    assert (first.model.config.width, first.model.config.kam) == (8, True)
    assert all(torch.equal(a, b) for a, b in zip(first.model.parameters(), again.model.parameters()))
    words = ("--config", "--protocol", "kassd", "--device", "cpu", "--warmup", 0)
    output = beambox(capsys, "bench", recipe, *words).out
    assert "untrained weights" in output and "42.9" in output
    for name, message in (("kasd", r'did you mean "kassd"'), (tmp_path / "no.yaml", "there is no recipe")):
        with pytest.raises(BeamboxError, match=message):
            untrained(name)
    recipe.write_text("[1, 2]")
    with pytest.raises(BeamboxError, match="names no detector"):
        untrained(recipe)
