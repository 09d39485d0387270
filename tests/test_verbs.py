"""The verbs of the public API: what a command does, called from Python."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from PIL import Image

import beambox
from beambox import BeamboxError
from beambox.infer.evaluate import evaluate_frames
from beambox.metrics.kitti import KittiFrame
from oracles.tiny_detector import street, tiny_weights
from oracles.tiny_training import recipe, tiny_kitti


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    assert beambox.simulate(str(folder), 4, seed=1, val_share=0.5, progress=False) == folder
    return folder


def test_a_simulated_data_set_is_opened_and_evaluated(data: Path, weights: Path, tmp_path: Path) -> None:
    source = beambox.open_dataset(str(data), "all")
    assert len(source) == 4 and isinstance(source[0], beambox.Frame) and source[0].labels is not None
    scores = beambox.evaluate(str(weights), str(data), split="all", results=tmp_path / "r", progress=False)
    assert "KITTI AP in percent, 4 frames" in str(scores) and len(list((tmp_path / "r").glob("*.txt"))) == 4
    detector = beambox.load(weights, device="cpu")
    again = beambox.evaluate(detector, source, progress=False)
    assert again.to_json() == beambox.evaluate(weights, data, split="all", device="cpu", progress=False).to_json()
    with pytest.raises(BeamboxError, match="give both by name or path"):
        beambox.evaluate(detector, source, keep=tmp_path / "kept")


def test_draw_takes_whatever_a_detector_takes(data: Path, tmp_path: Path, weights: Path) -> None:
    sweep = next((data / "training" / "velodyne").glob("*.bin"))
    found = beambox.load(weights, device="cpu")(sweep)
    bare, full = beambox.draw(street()), beambox.draw(sweep, found, out=tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").size == full.size and bare.tobytes() != full.tobytes()
    beambox.draw(str(sweep), found, out=str(tmp_path / "b.html"), title="{{DATA}}")
    assert "<canvas" in (tmp_path / "b.html").read_text()
    with pytest.raises(BeamboxError, match=r"as \.png or \.jpg"):
        beambox.draw(street(), out=tmp_path / "c.gif")
    with pytest.raises(BeamboxError, match="not there"):
        beambox.draw(tmp_path / "absent.bin")


def test_training_takes_text_and_paths(tmp_path: Path) -> None:
    root = tiny_kitti(tmp_path / "kitti")
    with pytest.raises(BeamboxError, match="there is no folder"):
        beambox.train(recipe(), str(tmp_path / "absent"))
    with pytest.raises(BeamboxError, match="`overrides` change a recipe that is read from a file"):
        beambox.train(recipe(), root, overrides=["seed=1"])
    with pytest.raises(BeamboxError):
        beambox.train(str(tmp_path / "absent.yaml"), str(root), str(tmp_path / "run"))
    written = tmp_path / "tiny.yaml"
    written.write_text(yaml.safe_dump(recipe(iterations=2).model_dump(mode="json", exclude_defaults=True)))
    outcome = beambox.train(str(written), str(root), str(tmp_path / "run"), overrides=["optim.iterations=1"])
    assert outcome.finished and (tmp_path / "run" / "final.safetensors").exists()


def test_export_refuses_before_it_works(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(BeamboxError, match=r"must end in \.onnx"):
        beambox.export(str(weights), str(tmp_path / "a.txt"))


CALLS = """
import inspect
import beambox
for name, module in (("train", "loop"), ("simulate", "writer"), ("export", "openpcdet")):
    before = getattr(beambox, name) if ASK_FIRST else None
    exec(f"import beambox.{name}.{module} as inner")
    assert inner.__name__ == f"beambox.{name}.{module}"
    verb = getattr(beambox, name)
    assert before in (None, verb) and "recipe" in str(inspect.signature(verb)) or "out" in str(inspect.signature(verb))
    try:
        verb()
    except TypeError as error:
        assert "missing" in str(error)
    else:
        raise AssertionError(name)
print("done")
"""


@pytest.mark.parametrize("ask_first", [True, False])
def test_a_verb_can_be_called_whatever_was_imported(ask_first: bool) -> None:
    """Importing beambox.train.loop binds the package's name in beambox, over any function of that name."""
    ran = subprocess.run(
        [sys.executable, "-c", CALLS.replace("ASK_FIRST", str(ask_first))], capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(Path(beambox.__file__).parents[1])},
    )  # fmt: skip
    assert ran.stdout == "done\n", ran.stderr


VERBS = ("draw", "evaluate", "export", "load", "open_dataset", "read_frame", "simulate", "train")


@pytest.mark.parametrize("name", VERBS)
def test_every_argument_is_typed_and_documented(name: str) -> None:
    from beambox import verbs

    function = getattr(verbs, name, None) or getattr(beambox, name)
    text = inspect.getdoc(function) or ""
    assert "Raises:" in text
    for parameter in inspect.signature(function).parameters.values():
        assert parameter.annotation is not inspect.Parameter.empty
        assert f"    {parameter.name}: " in text, f"{name}: {parameter.name} is not documented"


def test_results_print_as_tables_and_become_tables() -> None:
    pytest.importorskip("pandas")
    box = [[10.0, 2, -0.9, 4, 1.8, 1.5, 0.5]]
    frames = [KittiFrame(beambox.Labels(box, ["Car"]), beambox.Detections(box, [0.9], [0], ["Car"]))]
    for by_once in (False, True):
        scores = evaluate_frames(frames, ["Car"], by_once=by_once)
        table = scores.rounds[0].to_pandas()
        assert str(scores.rounds[0]) == scores.rounds[0].table() and str(scores) == scores.table()
        assert len(table) and "class" in table and (table["objects"] >= 0).all()
        assert scores.to_pandas()["precision"].tolist() == ["float32"] * len(table)


def test_results_give_every_number_as_a_record() -> None:
    box = [[10.0, 2, -0.9, 4, 1.8, 1.5, 0.5]]
    frames = [KittiFrame(beambox.Labels(box, ["Car"]), beambox.Detections(box, [0.9], [0], ["Car"]))]
    rows = evaluate_frames(frames, ["Car"]).to_rows()
    assert [(row["class"], row["metric"], row["all"], row["objects"]) for row in rows] == [
        ("Car", "3d", 100.0, 1), ("Car", "bev", 100.0, 1),
    ]  # fmt: skip
    once = evaluate_frames(frames, ["Car"], by_once=True).to_rows()
    assert {(row["band"], round(row["AP"])) for row in once if row["objects"]} == {("overall", 100), ("0-30m", 100)}
