"""nuScenes' tables, made by hand: two key frames and a sweep between them, a vehicle that drives and turns."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.nuscenes import NuScenesSource
from beambox.data.open_dataset import open_dataset

HALF = math.sqrt(0.5)
EGO = {
    "e0": ([100.0, 50, 0], [1, 0, 0, 0]),
    "e1": ([101.0, 50, 0], [1, 0, 0, 0]),
    "e2": ([102.0, 50, 0], [HALF, 0, 0, HALF]),
}
TRUTH = np.array([112.0, 55.0, 1.0])  # a car in the global frame that looks along +x; a point on it


def write(root: Path, **tables: list[dict]) -> None:
    (root / "v1.0-mini").mkdir(parents=True)
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))


def sensor_point(ego: str) -> np.ndarray:
    """The global point as the sensor sees it, by hand: it sits 2 m above the ego's origin, x right, y forward."""
    (x, y, z), rotation = EGO[ego]
    ahead, left, up = TRUTH - [x, y, z + 2.0]
    if rotation[3]:  # turned left by 90 degrees
        ahead, left = left, -ahead
    return np.array([-left, ahead, up, 127.5, 3])


@pytest.fixture
def root(tmp_path: Path) -> Path:
    turned = [HALF, 0, 0, -HALF]  # the sensor's y is the vehicle's x
    write(
        tmp_path,
        scene=[{"token": "s", "name": "scene-0001"}],
        sample=[{"token": one, "scene_token": "s", "timestamp": time} for one, time in (("b", 500000), ("a", 0))],
        sensor=[{"token": "L", "channel": "LIDAR_TOP"}, {"token": "C", "channel": "CAM_FRONT"}],
        calibrated_sensor=[
            {"token": "cl", "sensor_token": "L", "translation": [0, 0, 2.0], "rotation": turned},
            {"token": "cc", "sensor_token": "C", "translation": [0, 0, 1.0], "rotation": [1, 0, 0, 0]},
        ],
        ego_pose=[{"token": key, "translation": t, "rotation": r} for key, (t, r) in EGO.items()],
        sample_data=[
            {"token": f"d{k}", "sample_token": sample, "ego_pose_token": f"e{k}", "calibrated_sensor_token": "cl",
             "timestamp": 250000 * k, "filename": f"{folder}/LIDAR_TOP/{k}.pcd.bin",
             "is_key_frame": folder == "samples", "prev": f"d{k - 1}" if k else ""}
            for k, (sample, folder) in enumerate([("a", "samples"), ("b", "sweeps"), ("b", "samples")])
        ] + [{"token": "img", "sample_token": "a", "ego_pose_token": "e0", "calibrated_sensor_token": "cc",
              "timestamp": 0, "filename": "samples/CAM_FRONT/0.jpg", "is_key_frame": True, "prev": ""}],
        category=[{"token": "c", "name": "vehicle.car"}],
        instance=[{"token": "i", "category_token": "c"}],
        sample_annotation=[
            {"sample_token": sample, "instance_token": "i", "translation": TRUTH.tolist(), "size": [1.9, 4.5, 1.6],
             "rotation": [1, 0, 0, 0]}
            for sample in "ab"
        ],
    )  # fmt: skip
    for k, folder in enumerate(["samples", "sweeps", "samples"]):
        path = tmp_path / folder / "LIDAR_TOP" / f"{k}.pcd.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        points = np.stack([sensor_point(f"e{k}"), [0.2, 0.3, -1, 10, 0]])
        points.astype("<f4").tofile(path)
    return tmp_path


def test_points_and_boxes_agree_in_the_turned_frame(root: Path) -> None:
    source = open_dataset(root, "all")
    assert isinstance(source, NuScenesSource) and list(source.ids) == ["a", "b"]
    first, second = source[0], source[1]
    assert first.points[0].tolist() == pytest.approx([12, 5, -1, 0.5])  # ahead, left, up; intensity / 255
    assert first.labels is not None and first.labels.names == ("vehicle.car",)
    assert first.labels.boxes[0].tolist() == pytest.approx([12, 5, -1, 4.5, 1.9, 1.6, 0], abs=1e-5)
    assert second.labels is not None
    assert second.labels.boxes[0].tolist() == pytest.approx([5, -10, -1, 4.5, 1.9, 1.6, -math.pi / 2], abs=1e-5)
    assert second.points[0, :3].tolist() == pytest.approx([5, -10, -1], abs=1e-5)


def test_earlier_sweeps_fall_onto_the_key_frame(root: Path) -> None:
    """A still point seen from three places is one point; returns of the own roof go; the fifth column is the age."""
    points = NuScenesSource(root, sweeps=10)[1].points
    assert points.shape == (3, 5)
    np.testing.assert_allclose(points[:, :3], np.tile([5, -10, -1], (3, 1)), atol=1e-5)
    assert points[:, 4].tolist() == pytest.approx([0, 0.25, 0.5])


def test_splits_and_faults(root: Path) -> None:
    assert len(NuScenesSource(root, "scene-0001")) == 2
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "train.txt").write_text("scene-0001\n")
    assert len(NuScenesSource(root, "train")) == 2
    with pytest.raises(BeamboxError, match='has no split "val": give all, the name of a scene'):
        NuScenesSource(root, "val")
    (root / "ImageSets" / "val.txt").write_text("scene-0002\n")
    with pytest.raises(BeamboxError, match=r'no scene "scene-0002" \(did you mean "scene-0001"\?\)'):
        NuScenesSource(root, "val")
    (root / "samples" / "LIDAR_TOP" / "0.pcd.bin").unlink()
    with pytest.raises(MissingFileError):
        NuScenesSource(root)[0]
    (root / "v1.0-mini" / "ego_pose.json").write_text("[]")
    with pytest.raises(BeamboxError, match="lacks an entry or refers to none: 'e0'"):
        NuScenesSource(root)


def test_a_table_that_leads_out_of_the_folder_is_refused(root: Path) -> None:
    path = root / "v1.0-mini" / "sample_data.json"
    path.write_text(path.read_text().replace("samples/LIDAR_TOP/0.pcd.bin", "../outside.bin"))
    with pytest.raises(BeamboxError, match="leads out of"):
        NuScenesSource(root)[0]
