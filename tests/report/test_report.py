"""The report: what it counts, checked by hand and against the official metrics, and its page, clicked through."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.source import FrameList
from beambox.metrics.kitti import KittiFrame
from beambox.report import numbers
from beambox.report.build import write_page
from beambox.report.failures import draw_failures, worst
from beambox.report.matching import match_frames
from beambox.report.measure import PointCounts, TimedDetect, measure
from beambox.report.page import report_html
from beambox.report.tables import latex, numbers_csv, write_numbers
from beambox.structures import Detections, Frame, Labels
from oracles.browser import needs_browser, run_in_browser
from oracles.command_line import beambox
from oracles.tiny_detector import kitti_folder, tiny_weights

CLASSES = ("Car", "Pedestrian")
SIZES = {"Car": (4.0, 1.8, 1.5), "Pedestrian": (0.8, 0.6, 1.7)}


def box(name: str, x: float, y: float) -> list[float]:
    return [x, y, -0.9, *SIZES[name], 0.0]


def frame_of(
    truth: list[tuple[str, float, float]], found: list[tuple[str, float, float, float]], name: str = "f"
) -> KittiFrame:
    """Return a frame of labelled (class, x, y) and detected (class, x, y, score) boxes."""
    labels = Labels(torch.tensor([box(*each) for each in truth]).reshape(-1, 7), tuple(each[0] for each in truth))
    boxes = torch.tensor([box(*each[:3]) for each in found]).reshape(-1, 7)
    kinds = torch.tensor([CLASSES.index(each[0]) for each in found], dtype=torch.int64)
    return KittiFrame(labels, Detections(boxes, torch.tensor([each[3] for each in found]), kinds, CLASSES, name))


BY_HAND = [
    frame_of(
        [("Car", 10, 0), ("Car", 30, 5), ("Pedestrian", 8, -4)],
        [
            ("Car", 10.1, 0, 0.95),
            ("Car", 10, 0.1, 0.85),
            ("Car", 31.5, 5, 0.75),
            ("Car", 15, 9, 0.65),
            ("Car", 8, -4, 0.55),
        ],
        "one",
    ),
    frame_of([("Car", 50, 0), ("Pedestrian", 12, 3)], [("Car", 50, 0, 0.35), ("Pedestrian", 12, 3, 0.97)], "two"),
]


def test_every_detection_and_object_is_what_it_looks_like() -> None:
    matches = match_frames(BY_HAND, {"Car": 0.7, "Pedestrian": 0.5}, [np.array([90, 3, 40]), np.array([0, 25])])
    kinds = dict(zip(zip(matches.found.frame.tolist(), matches.found.row.tolist()), matches.found.kind.tolist()))
    assert [kinds[0, k] for k in range(5)] == ["right", "duplicate", "misplaced", "background", "wrong class"]
    assert [kinds[1, k] for k in range(2)] == ["right", "right"]
    assert matches.found.about[4] == "Pedestrian"
    scores = matches.truth.score
    assert scores[[0, 3, 4]] == pytest.approx([0.95, 0.35, 0.97]) and np.isnan(scores[[1, 2]]).all()
    assert matches.truth.points.tolist() == [90, 3, 40, 0, 25]
    assert matches.truth.distance == pytest.approx([10, math.hypot(30, 5), math.hypot(8, 4), 50, math.hypot(12, 3)])


def test_groups_working_point_calibration_and_confusion_by_hand() -> None:
    matches = match_frames(BY_HAND, {"Car": 0.7, "Pedestrian": 0.5}, [np.array([90, 3, 40]), np.array([0, 25])])
    groups = {(group.by, group.name): group for group in numbers.groups(matches, "Car")}
    # right at 0.95, wrong at 0.85 0.75 0.65 0.55, right at 0.35: precision 1 at recall 1/3, 2/6 at recall 2/3
    assert groups["all", "all objects"].ap == pytest.approx(100 * (1 / 3 + 1 / 3 * 2 / 6))
    assert groups["distance", "0-20 m"].ap == pytest.approx(100) and groups["distance", "0-20 m"].objects == 1
    assert groups["distance", "40 m and farther"].ap == pytest.approx(100), "no wrong detection is that far"
    assert groups["distance", "20-40 m"].ap == 0
    assert groups["points", "20-99"].objects == 1 and groups["points", "0-4"].objects == 2
    assert groups["points", "0-4"].ap == pytest.approx(100 * (1 / 2 * 1 / 5)), "wrong detections count in every group"
    assert not any(by == "occlusion" for by, _ in groups), "nothing is known of it"
    point = numbers.working_point(matches, "Car")
    assert (point.score, point.precision, point.recall) == pytest.approx((0.95, 100, 100 / 3))
    scores = numbers.calibration(matches, "Car")
    assert sum(each.right + each.wrong for each in scores.bins) == 6
    assert scores.error == pytest.approx(100 * (0.05 + 0.85 + 0.75 + 0.65 + 0.55 + 0.65) / 6, abs=1e-4)
    table = numbers.confusion(matches)
    assert table.counts[0] == (1, 0, 2) and table.counts[1] == (0, 1, 1), "the working point of cars is 0.95"


def random_frames(seed: int, number: int = 12) -> list[KittiFrame]:
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(number):
        truth = [(CLASSES[int(rng.integers(2))], 6.0 * i + 8, float(rng.uniform(-9, 9))) for i in range(8)]
        found = [
            (name, x + float(rng.normal(0, 0.25)), y + float(rng.normal(0, 0.1)), float(rng.uniform(0.2, 1)))
            for name, x, y in truth
            if rng.random() < 0.8
        ]
        found += [("Car", float(rng.uniform(0, 60)), float(rng.uniform(-30, -15)), float(rng.uniform(0, 0.7)))]
        frames.append(frame_of(truth, found, f"{k:06d}"))
    return frames


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_ap_of_all_objects_is_that_of_the_official_metric(seed: int) -> None:
    one = measure("m", random_frames(seed), CLASSES)
    for name in CLASSES:
        ap = numbers.groups(one.matches, name)[0].ap
        assert ap == pytest.approx(one.scored[name].box3d[0].all_points, abs=1e-9)  # type: ignore[index]


def test_nothing_found_and_nothing_labeled_make_a_report() -> None:
    empty = measure("nothing", [frame_of([("Car", 10, 0)], []), frame_of([], [])], CLASSES)
    point = numbers.working_point(empty.matches, "Car")
    assert math.isnan(point.score) and numbers.groups(empty.matches, "Car")[0].ap == 0
    assert json.loads(json.dumps(empty.to_json(), allow_nan=False))["classes"]["Car"]["working_point"]["f1"] is None
    assert "nothing" in report_html([empty])


def test_numbers_are_written_as_csv_latex_and_json(tmp_path: Path) -> None:
    one, other = measure("a_b", random_frames(0), CLASSES), measure("other", random_frames(1), CLASSES)
    rows = list(csv.DictReader(io.StringIO(numbers_csv([one, other]))))
    ap = one.scored["Car"].box3d[0].r40  # type: ignore[index]
    found = [row for row in rows if (row["evaluation"], row["class"], row["metric"]) == ("a_b", "Car", "AP 3d R40")]
    assert float(found[0]["value"]) == pytest.approx(ap, rel=1e-5) and found[0]["unit"] == "percent"
    assert {row["evaluation"] for row in rows} == {"a_b", "other"}
    text = latex([one, other])
    assert rf"Car & 3d R40 & a\_b & {ap:.2f} \\" in text and text.count(r"\begin{tabular}") == 1
    write_numbers(tmp_path / "n.json", [one, other])
    content = json.loads((tmp_path / "n.json").read_text(encoding="utf-8"))
    assert content["evaluations"][0]["ap"]["Car"]["3d"]["R40"] == [round(ap, 4)]
    with pytest.raises(BeamboxError, match="numbers are written as"):
        write_numbers(tmp_path / "n.xlsx", [one])


def test_the_worst_come_first_and_one_frame_does_not_fill_the_page() -> None:
    crowd = [("Car", 12.0 + 5 * k, -12.0, 0.99 - 0.01 * k) for k in range(6)]
    frames = [frame_of([("Car", 10, 0)], [("Car", 10, 0, 0.995), *crowd]), frame_of([], [("Car", 20, 3, 0.4)])]
    one = measure("m", frames, ("Car",))
    made_up = [failure for failure in worst(one.matches, "Car") if failure.kind == "background"]
    assert [(failure.frame, failure.row) for failure in made_up] == [(0, 1), (0, 2), (1, 0)]
    source = FrameList([Frame(torch.rand(500, 4) * 40, "a"), Frame(torch.rand(10, 4), "b")])
    drawn = list(draw_failures(one, source, made_up))
    assert [picture.frame_id for picture in drawn] == ["a", "a", "b"]
    assert all(picture.bev[:2] == b"\xff\xd8" and picture.camera is None for picture in drawn)


def test_no_name_can_break_the_page(tmp_path: Path) -> None:
    one = measure("evil <b>{{CONTENT}}&$x", random_frames(3), ("Pedestrian",), about={"card": {"<i>": "</script>"}})
    source = FrameList([Frame(torch.rand(300, 4) * 40, f"<{k}>") for k in range(12)])
    write_page(tmp_path / "r.html", [one], source, most=2)
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert text.count("<script") == text.count("</script>") == 1
    assert "evil &lt;b&gt;{{CONTENT}}&amp;$x" in text and "<i>" not in text and "default-src 'none'" in text
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=[\"']?https?:", text)


def test_points_and_times_are_taken_as_frames_pass_by() -> None:
    points = torch.cat((torch.rand(70, 3) * 0.5 + torch.tensor([10.0, 0, -1]), torch.zeros(70, 1)), dim=1)
    frame = Frame(points, "a", labels=BY_HAND[0].labels)
    counts = PointCounts()
    assert list(counts.watch([(frame, BY_HAND[0].detections)])) == [(frame, BY_HAND[0].detections)]
    assert counts.counts[0].tolist() == [70, 0, 0]
    timed = TimedDetect(lambda frames: [Detections.empty(CLASSES) for _ in frames])
    assert timed.summary() == {}
    for _ in range(5):
        timed([frame])
    assert timed.summary()["calls"] == 2 and timed.summary()["median"] >= 0


def test_the_command_writes_page_numbers_and_pages_of_frames(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    kitti_folder(tmp_path / "kitti")
    (tmp_path / "kitti" / "ImageSets").mkdir(exist_ok=True)
    (tmp_path / "kitti" / "ImageSets" / "val.txt").write_text("000000\n000001\n")
    weights = tiny_weights(tmp_path)
    command = (
        "report",
        weights,
        "--data",
        tmp_path / "kitti",
        "--out",
        tmp_path / "r.html",
        "--numbers",
        tmp_path / "n.csv",
    )
    ran = beambox(capsys, *command, "--pages", "--worst", "2", "--classes", "Car")
    assert ran.status == 0, ran.err
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "latency, ms per frame" in text and "sha256" in text
    linked = set(re.findall(r'<a href="(r_frames/[^"]+)">', text))
    assert linked and all((tmp_path / link).is_file() for link in linked)
    assert "AP 3d R40" in (tmp_path / "n.csv").read_text(encoding="utf-8")
    found = beambox(capsys, "detect", tmp_path / "kitti", "-m", weights, "-o", tmp_path / "results")
    assert found.status == 0
    again = beambox(capsys, "report", tmp_path / "results", "--against", weights, "--data", tmp_path / "kitti",
                    "--out", tmp_path / "both.html", "--classes", "Car", "--worst", "0")  # fmt: skip
    assert again.status == 0, again.err
    assert "first - second" in (tmp_path / "both.html").read_text(encoding="utf-8")
    for wrong, message in (
        (("--out", "r.pdf"), "its name ends in .html"),
        (("--numbers", "n.xls"), "numbers are written"),
    ):
        refused = beambox(capsys, "report", weights, "--data", tmp_path / "kitti", *wrong)
        assert refused.status == 2 and message in refused.err
    scored = beambox(capsys, "evaluate", weights, "--data", tmp_path / "kitti", "--classes", "Car",
                     "--report", tmp_path / "e.html")  # fmt: skip
    assert scored.status == 0, scored.err
    tables = [
        re.findall(r"<table>.*?</table>", (tmp_path / n).read_text(encoding="utf-8"))[0] for n in ("e.html", "r.html")
    ]
    assert tables[0] == tables[1], "both ways give one table of AP"
    (tmp_path / "results" / "000001.json").unlink()
    missing = beambox(
        capsys, "report", tmp_path / "results", "--data", tmp_path / "kitti", "--out", tmp_path / "x.html"
    )
    assert missing.status == 2 and "1 of 2 frames have no results" in missing.err and not (tmp_path / "x.html").exists()


@needs_browser
def test_a_browser_shows_classes_in_turn_and_enlarges_pictures(tmp_path: Path) -> None:
    one = measure("a", random_frames(4), CLASSES)
    source = FrameList([Frame(torch.rand(300, 4) * 40, f"{k:06d}") for k in range(12)])
    write_page(tmp_path / "r.html", [one, measure("b", random_frames(5), CLASSES)], source, most=2)
    result = run_in_browser(
        (tmp_path / "r.html").read_text(encoding="utf-8"),
        """
        const sections = [...document.querySelectorAll("section[data-class]")];
        const shown = () => sections.filter((one) => !one.hidden).map((one) => one.dataset.class);
        const out = { first: shown() };
        document.querySelectorAll("button[data-class]")[1].click();
        out.second = shown();
        await Promise.all([...document.querySelectorAll(".charts img")].map((one) => one.decode()));
        out.charts = [...document.querySelectorAll(".charts img")].every((one) => one.naturalWidth > 100);
        document.querySelector("section:not([hidden]) figure img").click();
        out.large = document.getElementById("large").open;
        document.getElementById("large").click();
        out.closed = !document.getElementById("large").open;
        return out;
        """,
        tmp_path,
    )
    assert result["first"] == ["Car"] and result["second"] == ["Pedestrian"]
    assert result["charts"] and result["large"] and result["closed"]
