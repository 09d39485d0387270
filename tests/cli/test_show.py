"""Commands that draw, list, examine and measure."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from oracles.command_line import beambox
from oracles.own_data import write_pandaset
from oracles.tiny_detector import kitti_folder, street, tiny_weights

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights(tmp_path_factory.mktemp("weights"), licence="CC0-1.0", summary="for tests")


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    street().tofile(tmp_path / "scan.bin")
    return tmp_path / "scan.bin"


def test_show_draws_a_sweep_without_any_model(capsys: Capture, scan: Path, tmp_path: Path) -> None:
    ran = beambox(capsys, "show", scan, "--out", tmp_path / "a.png", "--area", "30")
    assert ran.status == 0, ran.err
    assert Image.open(tmp_path / "a.png").size == (1450, 1200)


@pytest.mark.parametrize("corrections", [(), ("--ground-slope", "0.02,-0.04", "--sensor-height", "1.5")])
def test_show_draws_detections_of_a_model_and_of_a_folder_alike(
    capsys: Capture, weights: Path, scan: Path, tmp_path: Path, corrections: tuple[str, ...]
) -> None:
    assert beambox(capsys, "detect", scan, "-m", weights, "-o", tmp_path / "found", *corrections).status == 0
    now = beambox(capsys, "show", scan, "-m", weights, "-o", tmp_path / "now.png", "--area", "0,-16,32,16",
                  *corrections)  # fmt: skip
    then = beambox(capsys, "show", scan, "--results", tmp_path / "found", "-o", tmp_path / "then.png",
                   "--area", "0,-16,32,16")  # fmt: skip
    assert now.status == then.status == 0, now.err + then.err
    a, b = (np.asarray(Image.open(tmp_path / name)).astype(int) for name in ("now.png", "then.png"))
    assert a.shape == b.shape and (np.abs(a - b).max(axis=-1) > 40).mean() < 0.02, "all but the network's border"


def test_show_draws_labels_and_camera_beside_and_can_leave_labels_out(capsys: Capture, tmp_path: Path) -> None:
    velodyne = kitti_folder(tmp_path)
    for name, options in (
        ("with", ()),
        ("without", ("--labels", "none")),
        ("named", ("--labels", velodyne / "../label_2")),
    ):
        assert beambox(capsys, "show", velodyne / "000000.bin", "-o", tmp_path / f"{name}.png", *options).status == 0
    pictures = {name: np.asarray(Image.open(tmp_path / f"{name}.png")) for name in ("with", "without", "named")}
    assert np.array_equal(pictures["with"], pictures["named"])
    assert pictures["with"].shape == pictures["without"].shape
    assert not np.array_equal(pictures["with"], pictures["without"])
    assert pictures["with"].shape[0] > 1300, "the camera image stands above the map"


def test_show_makes_a_folder_of_pictures_for_several(capsys: Capture, tmp_path: Path) -> None:
    kitti_folder(tmp_path / "kitti")
    ran = beambox(capsys, "show", tmp_path / "kitti", "-o", tmp_path / "pictures", "--color", "intensity")
    assert ran.status == 0
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir()) == ["000000.png", "000001.png"]


def test_show_turns_other_axes_forward_up(capsys: Capture, weights: Path, scan: Path, tmp_path: Path) -> None:
    turned = street()[:, [1, 0, 2, 3]] * np.array([-1, 1, 1, 1], dtype=np.float32)
    turned.tofile(tmp_path / "turned.bin")
    area = ("--area", "0,-16,32,16", "-m", weights)
    beambox(capsys, "show", scan, "-o", tmp_path / "a.png", *area)
    beambox(capsys, "show", tmp_path / "turned.bin", "-o", tmp_path / "b.png", "--axes", "x: right, y: forward", *area)
    a, b = (np.asarray(Image.open(tmp_path / name))[:, :1200].astype(int) for name in ("a.png", "b.png"))
    assert (np.abs(a - b).max(axis=-1) > 40).mean() < 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--color", "hight"), 'unknown colour "hight" (did you mean "height"?)'),
        (("--results", "nowhere"), "nowhere is not a folder of results"),
        (("--out", "a.tif"), "a picture is written as .png, .jpg or .html, a film as .gif, .webp, .mp4"),
        (("--out", "a.gif", "--rate", "0"), "--rate must be more than 0"),
        (("--labels", "there"), "they need the calibration of scan"),
        (("--area", "1,2"), "--area takes one number, or four"),
    ],
)
def test_show_refuses_what_it_cannot_do(
    capsys: Capture, scan: Path, options: tuple[str, str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scan.parent)
    ran = beambox(capsys, "show", scan, *options)
    assert ran.status == 2 and message in ran.err
    assert [p.name for p in scan.parent.iterdir()] == ["scan.bin"]


def test_show_says_which_results_are_missing(capsys: Capture, scan: Path, tmp_path: Path) -> None:
    (tmp_path / "found").mkdir()
    ran = beambox(capsys, "show", scan, "--results", tmp_path / "found", "-o", tmp_path / "a.png")
    assert ran.status == 2 and "holds no results of scan (.json, .csv or .txt)" in ran.err


def test_models_lists_cards_and_prints_one(
    capsys: Capture, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("beambox.zoo.shipped", lambda: {"tiny": weights})
    ran = beambox(capsys, "models", "--json", tmp_path / "cards.json")
    assert ran.out.startswith("tiny: pointpillars, Car, Pedestrian, Cyclist; ")
    assert "for tests; CC0-1.0" in ran.out
    (card,) = json.loads((tmp_path / "cards.json").read_text(encoding="utf-8"))
    assert card["bytes"] == weights.stat().st_size and len(card["sha256"]) == 64
    one = beambox(capsys, "models", weights)
    assert card["sha256"] in one.out and "licence: CC0-1.0" in one.out


def test_doctor_reports_the_machine(capsys: Capture) -> None:
    ran = beambox(capsys, "doctor")
    assert ran.status == 0
    assert all(word in ran.out for word in ("beambox", "torch", "numba", "GPU", "precision", "weights", "triton"))


def test_doctor_gives_the_command_that_mends_it(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    street(height=0.5).tofile(tmp_path / "low.bin")
    ran = beambox(capsys, "doctor", tmp_path / "low.bin", "--model", weights)
    assert ran.status == 0
    assert "-> --sensor-height 0.5" in ran.out
    last = ran.out.splitlines()[-1]
    assert last.startswith(f"Try:  beambox detect {tmp_path / 'low.bin'} --model {weights} --sensor-height 0.5")
    assert beambox(capsys, *shlex.split(last)[2:], "--out", tmp_path).status == 0, "the command it gives works"
    assert "as given" in ran.out and "with the options below" in ran.out


def test_bench_prints_and_writes_its_numbers(capsys: Capture, weights: Path, scan: Path, tmp_path: Path) -> None:
    run = ("bench", weights, scan, "--runs", "2", "--warmup", "0", "--json", tmp_path / "b.json")
    ran = beambox(capsys, *run)
    assert ran.status == 0, ran.err
    assert "sweeps/s" in ran.out and json.loads((tmp_path / "b.json").read_text(encoding="utf-8"))["runs"] == 2
    kassd = beambox(capsys, "bench", weights, scan, "--warmup", "0", "--protocol", "kassd")
    assert "mean of 10 runs" in kassd.out
    assert beambox(capsys, "bench", weights, scan, "--protocol", "kasd").status == 2


def test_demo_leaves_pictures_and_a_table(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    ran = beambox(capsys, "demo", "--model", weights, "--frames", "2", "--out", tmp_path / "demo", "--seed", "3")
    assert ran.status == 0, ran.err
    demo = tmp_path / "demo"
    assert len(list((demo / "pictures").glob("*.png"))) == 2
    assert "Car" in (demo / "scores.txt").read_text(encoding="utf-8")
    assert {"Car", "Pedestrian", "Cyclist"} <= json.loads((demo / "scores.json").read_text(encoding="utf-8")).keys()
    assert "seed 3" in ran.err
    scored = beambox(capsys, "score", "kitti", "--labels", demo / "data" / "training" / "label_2",
                     "--results", demo / "results")  # fmt: skip
    assert scored.status == 0, "what the demo leaves can be scored by itself"


def test_demo_without_weights_says_what_to_do(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beambox.zoo.shipped", dict)
    ran = beambox(capsys, "demo")
    assert ran.status == 2 and "give them by --model" in ran.err


def test_show_puts_several_sweeps_into_one_page_and_one_film(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    velodyne = kitti_folder(tmp_path / "kitti")
    ran = beambox(capsys, "show", velodyne, "-m", weights, "--out", tmp_path / "a.html", "--rate", "4")
    assert ran.status == 0 and "2 sweeps" in ran.out, ran.err
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert text.count('"intensity":') == 2 and '"score":0.3' in text and '"period":250' in text
    film = beambox(capsys, "show", velodyne, "--out", tmp_path / "a.webp", "--rate", "4", "--area", "20")
    assert film.status == 0, film.err
    assert Image.open(tmp_path / "a.webp").n_frames == 2  # type: ignore[attr-defined]
    one = beambox(capsys, "show", velodyne, "--names", "000001", "--out", tmp_path / "one.png")
    assert one.status == 0 and one.out.startswith("000001 ->")
    none = beambox(capsys, "show", velodyne, "--names", "000009", "--out", tmp_path / "none.png")
    assert none.status == 2 and 'no sweep is called "000009"' in none.err


def test_show_draws_a_data_set_of_ones_own_with_its_labels(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    described = write_pandaset(tmp_path / "own", frames=3)
    ran = beambox(capsys, "show", described, "--frames", "2", "--out", tmp_path / "pictures", "--area", "45")
    assert ran.status == 0, ran.err
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir()) == ["00.png", "01.png"]
    options = ("--names", "00", "--labels", "none", "--area", "45", "--out", tmp_path / "b.png")
    bare = beambox(capsys, "show", described, *options)
    assert bare.status == 0, bare.err
    with_labels, without = (np.asarray(Image.open(p)) for p in (tmp_path / "pictures" / "00.png", tmp_path / "b.png"))
    green = [(np.abs(each.astype(int) - (94, 234, 140)).sum(axis=-1) < 60).sum() for each in (with_labels, without)]
    assert green[0] > green[1] + 300, "eight cars are outlined"
    page = beambox(capsys, "show", described, "-m", weights, "--names", "01", "--out", tmp_path / "p.html")
    assert page.status == 0 and (tmp_path / "p.html").read_text(encoding="utf-8").count('"truth":true') == 8, page.err
    wrong = beambox(capsys, "show", described, "--names", "77", "--out", tmp_path / "c.png")
    assert wrong.status == 2 and 'the data set has no frame "77"' in wrong.err
    both = beambox(capsys, "show", described, tmp_path / "own" / "velodyne", "--out", tmp_path / "c.png")
    assert both.status == 2 and "a data set is shown by itself" in both.err
