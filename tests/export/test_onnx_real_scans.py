"""Exported files on real scans: every row of the outputs, and box by box what the detector finds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

from beambox.data.read_points import read_frame
from beambox.detectors.second import second
from beambox.detectors.weights import load_weights
from beambox.export.onnx_check import gathered, read_about
from beambox.export.onnx_file import export_onnx
from beambox.infer.predictor import Detector
from beambox.ops.nms import nms
from beambox.structures import Detections
from beambox.zoo import find_weights
from oracles.paths import data_dir
from oracles.same_boxes import expect_same_boxes


def network(name: str) -> Any:
    if name != "second":
        return load_weights(find_weights(name), "cpu")
    torch.manual_seed(0)  # no weights are shipped
    model = second()
    torch.nn.init.normal_(model.head.cls.weight, std=0.05)
    torch.nn.init.normal_(model.head.box.weight, std=0.05)
    return model.eval()


def found_by_the_file(path: Path, points: torch.Tensor) -> Detections:
    session = onnxruntime.InferenceSession(path)
    about = read_about(session)
    voxels = gathered(about, points)
    inputs = {"points": voxels.points, "voxel": voxels.voxel, "index": voxels.index[:, 1:].contiguous()}
    boxes, scores = map(
        torch.from_numpy, session.run(["boxes", "scores"], {key: value.numpy() for key, value in inputs.items()})
    )
    score, label = scores.max(dim=1)
    post = about["post"]
    rows = torch.nonzero(score >= post["score_threshold"])[:, 0]
    rows = rows[nms(boxes[rows], score[rows], post["nms_iou"], post["nms_pre"], post["nms_post"])]
    return Detections(boxes[rows], score[rows], label[rows], about["classes"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kassd-kitti", "second", "pointpillars-kitti", "hcnet-kitti"])
def test_real_scans_give_the_same_boxes(name: str, tmp_path: Path) -> None:
    scans = sorted(data_dir("kitti", "training", "velodyne").glob("*.bin"))[::70][:3]
    assert len(scans) == 3
    sweeps = {scan.name: read_frame(scan).points for scan in scans}
    model = network(name)
    written = export_onnx(model, tmp_path / "m.onnx", sweeps=sweeps)
    assert [check.sweep for check in written.checks[1:]] == list(sweeps) and all(
        check.agree for check in written.checks
    )
    if name == "second":
        return  # untrained, it finds noise
    detector = Detector(model, device="cpu", precision="float32", view="full")
    for points in sweeps.values():
        expect_same_boxes(found_by_the_file(tmp_path / "m.onnx", points), detector(points), 1e-4, least=3)
