"""Exported files: onnxruntime computes what PyTorch computes, nothing half-written stays, refusals are one line."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

from beambox.checks import BeamboxError, MissingFileError
from beambox.detectors.catalog import CATALOG, config_from_dict
from beambox.detectors.weights import save_weights
from beambox.export import onnx_file
from beambox.export.onnx_check import (
    Differences,
    box_differences,
    compare,
    opened,
    read_about,
    synthetic_sweep,
    verify,
)
from beambox.export.onnx_file import Written, export_onnx
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS
from oracles.command_line import beambox
from oracles.paths import ROOT
from oracles.small_detectors import HCNET, KASSD_CONFIG, POINTPILLARS, SECOND, SMALL, build_small, car_frame
from oracles.tiny_detector import street, tiny_model

ELSEWHERE = VoxelGrid((-10.24, -5.12, -3), (10.24, 5.12, 1), (0.32, 0.32, 4))
SPARSE = ("second", "kassd")
CASES: dict[str, tuple[str, Any, VoxelGrid | None, int]] = {
    "pointpillars": ("pointpillars", POINTPILLARS, None, 18),
    "hcnet": ("hcnet", HCNET, None, 20),
    "padded pillars elsewhere": ("pointpillars", replace(POINTPILLARS, empty_slots=True, max_points=4), ELSEWHERE, 23),
    "second": ("second", replace(SECOND, anchors=KITTI_ANCHORS[:2]), None, 18),
    "kassd": ("kassd", replace(KASSD_CONFIG, anchors=KITTI_ANCHORS), None, 19),
}


def shaken(model: Any, seed: int = 0) -> Any:
    """Give a detector weights of which every one shows in its boxes and scores."""
    generator = torch.Generator().manual_seed(seed)
    for layer in model.modules():
        if isinstance(layer, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            for values in (layer.weight.data, layer.running_var):
                values.copy_(0.5 + torch.rand(values.shape, generator=generator))
            for values in (layer.bias.data, layer.running_mean):
                values.copy_(0.2 * torch.randn(values.shape, generator=generator))
    for layer in (model.head.cls, model.head.box, model.head.direction):
        layer.weight.data.copy_(0.1 * torch.randn(layer.weight.shape, generator=generator))
        layer.bias.data.zero_()
    if getattr(model, "kam", None) is not None:
        last = model.kam.maps[-1]
        last.weight.data.copy_(0.3 * torch.randn(last.weight.shape, generator=generator))
        last.bias.data.zero_()
    return model.eval()


class Exported:
    """A small detector and the file made from it."""

    def __init__(self, folder: Path, case: str) -> None:
        self.name, self.config, self.grid, self.opset = CASES[case]
        self.model = shaken(build_small(self.name, self.config))
        self.path = folder / "small.onnx"
        card = {"name": "small"}
        self.written = export_onnx(self.model, self.path, grid=self.grid, opset=self.opset, card=card)


@pytest.fixture(scope="module")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Exported]:
    """Tracing takes seconds: each case is exported once."""
    return cache(lambda case: Exported(tmp_path_factory.mktemp("onnx"), case))


@pytest.fixture(params=CASES)
def exported(request: pytest.FixtureRequest, made_once: Callable[[str], Exported]) -> Exported:
    return made_once(request.param)


@pytest.fixture
def pillars(made_once: Callable[[str], Exported]) -> Exported:
    return made_once("pointpillars")


@pytest.fixture
def no_tracing(pillars: Exported, monkeypatch: pytest.MonkeyPatch) -> Exported:
    """Let exporting take the graph that was traced before, which takes no time."""

    def again(*_: object) -> Any:
        proto = onnx.load(pillars.path)
        del proto.metadata_props[:]
        return proto

    monkeypatch.setattr(onnx_file, "traced", again)
    return pillars


# --- what the file computes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 40, 6000])
def test_onnxruntime_computes_what_pytorch_computes(exported: Exported, count: int) -> None:
    grid = exported.grid or exported.config.grid
    generator = torch.Generator().manual_seed(count)
    low, high = torch.tensor([*grid.minimum, 0]), torch.tensor([*grid.maximum, 1])
    points = low + 0.999 * (high - low) * torch.rand(count, 4, generator=generator)
    found = compare(exported.path.read_bytes(), Looking(exported), points, f"{count} points")
    assert found.agree and found.half_turns <= 2, found
    assert found.voxels > 0 and found.points <= count


class Looking:
    """The network of an exported file, which looks where the file looks."""

    def __init__(self, exported: Exported) -> None:
        self.exported = exported
        self.config = exported.config

    def __call__(self, batch: Any, grid: VoxelGrid | None = None) -> Any:
        assert grid == (self.exported.grid or self.exported.config.grid), "the metadata tell the region"
        return self.exported.model(batch, grid)


def test_many_points_in_one_cell(exported: Exported) -> None:
    points = torch.tensor([[5.0, 1.0, -1.0, 0.3]]) + 0.01 * torch.rand(200, 4)
    found = verify(exported.path, exported.model, points)
    assert found.agree and found.voxels == 1 and found.points == min(200, exported.config.max_points), found


def test_a_sweep_with_cars(exported: Exported) -> None:
    assert verify(exported.path, exported.model, car_frame(3, [6.0, 1.0, -1.0, 4.0, 1.7, 1.5, 0.4]).points).agree


def test_weights_of_another_network_do_not_agree(exported: Exported) -> None:
    other = shaken(build_small(exported.name, exported.config, seed=1), seed=1)
    found = verify(exported.path, other, synthetic_sweep(exported.config.grid))
    assert not found.agree and found.scores > 0.01 and found.boxes > 0.01


def test_writing_compared_the_built_in_sweep(exported: Exported) -> None:
    (found,) = exported.written.checks
    assert found.agree and found.sweep == "built-in sweep" and 2000 >= found.points > found.voxels > 500


# --- what the file holds ----------------------------------------------------------------------------------------------


def test_one_file_with_everything_inside(exported: Exported) -> None:
    assert [file.name for file in exported.path.parent.iterdir()] == ["small.onnx"]
    content = exported.path.read_bytes()
    assert len(content) == exported.written.size
    assert str(ROOT).encode() not in content, "no paths of the machine it was made on"
    onnx.checker.check_model(onnx.load(exported.path), full_check=True)
    assert onnx.load(exported.path).opset_import[0].version == exported.opset


def test_inputs_and_outputs_are_named_and_of_any_length(exported: Exported) -> None:
    anchors = len(exported.model.anchors.boxes(exported.grid or exported.config.grid))
    rows = min(anchors, exported.config.kam_options.test_boxes) if exported.name == "kassd" else anchors
    classes = len(exported.config.classes)
    assert exported.written.inputs == {"points": "(N, 4) float32", "voxel": "(N) int64", "index": "(V, 3) int64"}
    assert exported.written.outputs == {
        "boxes": f"({rows}, 7) float32",
        "scores": f"({rows}, {classes}) float32",
    }


def test_rows_are_never_scattered_whole(exported: Exported) -> None:
    """With onnxruntime's threads, rows that ScatterND brings to one place are lost now and then."""
    kinds = {node.op_type for node in onnx.load(exported.path).graph.node}
    assert "ScatterElements" in kinds and not kinds & {"ScatterND", "Unique"}
    assert ("NonZero" in kinds) == (exported.name in SPARSE), "sizes of dense networks are known before values"


def test_metadata_hold_the_configuration(exported: Exported) -> None:
    about = read_about(opened(exported.path.read_bytes()))
    assert VoxelGrid(**{key: tuple(value) for key, value in about["grid"].items()}) == (
        exported.grid or exported.config.grid
    )
    assert config_from_dict(CATALOG[about["detector"]].config, about["config"]) == exported.config
    assert (
        about["detector"] == exported.name
        and about["classes"] == list(exported.config.classes)
        and about["card"] == {"name": "small"}
    )
    assert about["cells"] == list((exported.grid or exported.config.grid).size)
    assert about["post"] == asdict(exported.config.post)
    assert about["max_points"] == exported.config.max_points and about["max_voxels"] in (40000, 60000)


def test_the_model_is_not_changed(no_tracing: Exported, tmp_path: Path) -> None:
    model = build_small("pointpillars").train()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(BeamboxError, match="differ"):  # the graph is that of other weights
        export_onnx(model, tmp_path / "m.onnx")
    assert model.training and all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


# --- measuring --------------------------------------------------------------------------------------------------------


def test_another_half_turn_is_excused_only_where_rounding_decides() -> None:
    boxes = torch.tensor([[10.0, 0, 0, 4, 2, 1, 0.3]]).repeat(3, 1)
    turned = boxes.clone()
    turned[:, 6] = 0.3 - torch.pi
    direction = torch.tensor([[1.0, -1.0], [0.5, 0.5 + 1e-6], [1.0, -1.0]])
    border = torch.tensor([0.78539 + 1e-6])
    boxes[2, 6], turned[2, 6] = border, border - torch.pi
    apart, excused = box_differences(turned, boxes, direction)
    assert excused.tolist() == [False, True, True]
    assert apart[0, 6] > 3 and apart[1:, 6].max() < 1e-5


def test_lengths_count_relative_above_a_meter() -> None:
    wanted = torch.tensor([[70.0, 0.1, 0, 4, 2, 1, 3.1415]])
    actual = wanted + torch.tensor([0.007, 0.007, 0, 0, 0, 0, 2e-4])  # the angle crosses the border of its interval
    apart, _ = box_differences(actual, wanted, torch.tensor([[1.0, 0.0]]))
    torch.testing.assert_close(apart[0, [0, 1, 6]], torch.tensor([1e-4, 7e-3, 2e-4]), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("scores", "boxes"), [(float("nan"), 0.0), (0.0, float("nan")), (2e-4, 0.0), (0.0, 2e-4)])
def test_nan_and_large_differences_do_not_agree(scores: float, boxes: float) -> None:
    assert not Differences("s", 1, 1, scores, boxes, 0).agree
    assert Differences("s", 1, 1, 9e-5, 9e-5, 5).agree


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(SMALL.keys() - {"pointpillars", "hcnet", "second", "kassd"}))
def test_detectors_with_two_stages_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(
        BeamboxError,
        match=f"^{name} cannot be exported: its second stage .*pointpillars, hcnet, second and kassd can be$",
    ):
        export_onnx(build_small(name), tmp_path / "x.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("file", "opset", "message"),
    [("x.pt", 18, "must end in .onnx, got"), ("x.onnx", 17, "must lie in 18 .. 23, got 17"), ("x.onnx", 99, "got 99")],
)
def test_wrong_names_and_versions_are_refused(tmp_path: Path, file: str, opset: int, message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        export_onnx(build_small("pointpillars"), tmp_path / file, opset=opset)


def test_a_sweep_outside_the_region_is_refused(pillars: Exported) -> None:
    with pytest.raises(BeamboxError, match="none of its 5 points lies in the region"):
        verify(pillars.path, pillars.model, torch.full((5, 4), 1000.0))


def test_files_that_are_none_of_ours_are_refused(pillars: Exported, tmp_path: Path) -> None:
    points = synthetic_sweep(POINTPILLARS.grid)
    with pytest.raises(MissingFileError, match="beambox export"):
        verify(tmp_path / "absent.onnx", pillars.model, points)
    (tmp_path / "broken.onnx").write_bytes(b"no graph")
    with pytest.raises(BeamboxError, match="cannot open the file"):
        verify(tmp_path / "broken.onnx", pillars.model, points)
    proto = onnx.load(pillars.path)
    del proto.metadata_props[:]
    onnx.save(proto, tmp_path / "bare.onnx")
    with pytest.raises(BeamboxError, match='"beambox" in its metadata'):
        verify(tmp_path / "bare.onnx", pillars.model, points)


def test_another_number_of_anchors_is_told(pillars: Exported) -> None:
    two_classes = build_small("pointpillars", replace(POINTPILLARS, anchors=KITTI_ANCHORS[:2])).eval()
    with pytest.raises(BeamboxError, match="it is of another network"):
        verify(pillars.path, two_classes, synthetic_sweep(POINTPILLARS.grid))


# --- nothing half-written ---------------------------------------------------------------------------------------------


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(("stop", "error"), [(interrupted, KeyboardInterrupt), (full, BeamboxError)])
def test_an_interrupted_write_leaves_nothing(
    no_tracing: Exported,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stop: Callable[..., None],
    error: type[BaseException],
) -> None:
    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(error):
        export_onnx(no_tracing.model, tmp_path / "m.onnx")
    assert not list(tmp_path.iterdir())


def test_a_file_that_differs_is_not_written_and_the_old_one_stays(no_tracing: Exported, tmp_path: Path) -> None:
    (tmp_path / "m.onnx").write_text("old")
    with pytest.raises(BeamboxError, match=r"differ on built-in sweep: .*allowed are 1e-04; nothing was written"):
        export_onnx(shaken(build_small("pointpillars", seed=1), seed=1), tmp_path / "m.onnx")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]


# --- without the packages ---------------------------------------------------------------------------------------------


def test_a_missing_package_is_told_with_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_file, "find_spec", lambda name: None)
    with pytest.raises(
        BeamboxError, match=r'needs the library onnx, which is not installed: python -m pip install "\.\[export\]"'
    ):
        export_onnx(build_small("pointpillars"), tmp_path / "m.onnx")


def test_without_onnxruntime_the_file_is_written_unless_a_sweep_is_given(
    no_tracing: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnx_file, "runtime_is_there", lambda: False)
    written: Written = export_onnx(no_tracing.model, tmp_path / "m.onnx")
    assert written.checks == () and written.path.is_file()
    with pytest.raises(
        BeamboxError,
        match=r'comparing needs the library onnxruntime, which is not installed: python -m pip install "\.\[export\]"',
    ):
        export_onnx(no_tracing.model, tmp_path / "n.onnx", sweeps={"s": torch.zeros(1, 4)})
    assert not (tmp_path / "n.onnx").exists()


# --- the command and the page -----------------------------------------------------------------------------------------


def test_the_command_and_the_example_of_its_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    model = tiny_model()
    save_weights("tiny.safetensors", model, {"name": "tiny"})
    street().tofile("scan.bin")
    ran = beambox(capsys, "export", "tiny.safetensors", "--out", "pointpillars.onnx", "--verify", "scan.bin")
    assert ran.status == 0, ran.err
    assert "points (N, 4) float32" in ran.out and "scan.bin, " in ran.out and "(allowed 1e-04)" in ran.out

    page = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    (example,) = page.split("```python\n")[1:]
    namespace: dict[str, Any] = {}
    exec(compile(example.split("```")[0], "docs/export.md", "exec"), namespace)
    from beambox.infer.predictor import Detector

    wanted = Detector(model, precision="float32", device="cpu")("scan.bin")
    assert len(namespace["keep"]) == len(wanted) > 5
    boxes, score = (namespace[name][namespace["keep"]] for name in ("boxes", "score"))
    torch.testing.assert_close(score, wanted.scores, atol=1e-4, rtol=0)
    same = torch.cdist(wanted.boxes, boxes).argmin(dim=1)  # scores that differ in the seventh digit may change places
    assert sorted(same.tolist()) == list(range(len(boxes)))
    assert ((score[same] - wanted.scores).abs() < 1e-5).all()
    torch.testing.assert_close(boxes[same], wanted.boxes, atol=1e-3, rtol=1e-4)
    assert capsys.readouterr().out.count("\n") == len(wanted)


def test_the_command_refuses_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_weights(tmp_path / "voxel_rcnn.safetensors", build_small("voxel_rcnn"))
    ran = beambox(capsys, "export", tmp_path / "voxel_rcnn.safetensors", "--out", tmp_path / "x.onnx")
    assert ran.status == 2 and ran.err.splitlines()[-1].startswith("beambox: voxel_rcnn cannot be exported")
    assert not (tmp_path / "x.onnx").exists()


def test_the_command_leaves_no_file_where_the_comparison_fails(
    no_tracing: Exported, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_weights(tmp_path / "other.safetensors", shaken(build_small("pointpillars", seed=1), seed=1))
    ran = beambox(capsys, "export", tmp_path / "other.safetensors", "--out", tmp_path / "new" / "x.onnx")
    assert ran.status == 2 and "nothing was written" in ran.err.splitlines()[-1]
    assert not (tmp_path / "new").exists()


def test_metadata_are_plain_json(pillars: Exported) -> None:
    values = {prop.key: prop.value for prop in onnx.load(pillars.path).metadata_props}
    assert json.loads(values["beambox"])["format"] == "beambox-onnx-1"
    plain = dict(line.split(" ", 1) for line in values["beambox-plain"].splitlines())
    assert plain["class"] == "Car" and plain["cells"] == "64 64 1" and plain["nms_iou"] == "0.01"
