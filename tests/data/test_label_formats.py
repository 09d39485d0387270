"""Labels of annotation tools: round trips, small files written by hand from the formats' documentation, faults."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.cli.main import main
from beambox.data.custom import CustomSource
from beambox.data.labels.catalog import FORMATS, parse_labels, read_labels, write_labels
from beambox.data.labels.convert import convert_labels, heading_note
from beambox.data.labels.frames import LabeledFrame
from beambox.geometry.boxes import corners_3d

BOXES = np.array(
    [
        [10.123456789, -2.5, -0.75, 4.25, 1.75, 1.5, 0.3],
        [1e-3, 20.0, 0.5, 0.8, 0.6, 1.7, -3.0],
        [-7, 8, 1, 12, 2.5, 3.2, 2.9],
    ]
)
NAMES = ("Car", "Pedestrian", "Construction Vehicle")


def frames() -> dict[str, LabeledFrame]:
    return {
        "000000": LabeledFrame(NAMES, BOXES, ("7", "9", "12")),
        "000001": LabeledFrame(NAMES[:1], BOXES[:1] + 0.25, ("7",)),
    }


@pytest.mark.parametrize("kind", FORMATS)
def test_round_trips_are_exact(kind: str, tmp_path: Path) -> None:
    """Numbers come back to the last bit where the format has radians and this house's axes, else to 1e-14."""
    given = frames()
    write_labels(given, kind, tmp_path / "out")
    found, notes = read_labels(tmp_path / "out", kind)
    assert not notes and list(found) == list(given)
    computed = kind in ("labelcloud", "labelcloud_vertices", "scale", "pandaset_columns", "mmdet3d")
    for name, frame in given.items():
        assert found[name].names == frame.names
        np.testing.assert_allclose(found[name].boxes, frame.boxes, rtol=0, atol=1e-14 if computed else 0)
    if kind in ("sustechpoints", "datumaro", "segments", "scale", "openlabel", "pandaset_columns", "table"):
        assert found["000000"].ids == ("7", "9", "12")


@pytest.mark.parametrize("kind", [kind for kind, form in FORMATS.items() if form.write_frame])
def test_a_frame_without_boxes_stays_one(kind: str, tmp_path: Path) -> None:
    write_labels({"a/000001": LabeledFrame((), np.zeros((0, 7)))}, kind, tmp_path)
    found, _ = read_labels(tmp_path, kind)
    assert list(found) == ["a/000001"] and len(found["a/000001"]) == 0


CAR = [10.0, 2.0, -0.5, 4.0, 1.8, 1.5, math.pi / 2]
XYZ, SIZE = {"x": 10.0, "y": 2.0, "z": -0.5}, {"x": 4.0, "y": 1.8, "z": 1.5}
ZERO = {"x": 0.0, "y": 0.0}
HALF = math.sqrt(0.5)
# kind -> a file written by hand from the format's documentation: one car that looks along +y
DOCUMENTED: dict[str, object] = {
    "openpcdet": f"10 2 -0.5 4.0 1.8 1.5 {math.pi / 2!r} Car\n",
    "mmdet3d": f"10 2 -1.25 4.0 1.8 1.5 {math.pi / 2!r} Car\n",
    "sustechpoints": [
        {
            "obj_id": "3",
            "obj_type": "Car",
            "psr": {"position": XYZ, "rotation": {**ZERO, "z": math.pi / 2}, "scale": SIZE},
        }
    ],
    "labelcloud": {
        "folder": "pointclouds",
        "filename": "a.pcd",
        "path": "pointclouds/a.pcd",
        "objects": [
            {
                "name": "Car",
                "centroid": XYZ,
                "dimensions": {"length": 4.0, "width": 1.8, "height": 1.5},
                "rotations": {**ZERO, "z": 90},
            }
        ],
    },
    # docs/conventions.md: 0 left back bottom, 1 left front bottom, 2 right front, 3 right back; length along 0 to 3
    "labelcloud_vertices": {
        "objects": [
            {
                "name": "Car",
                "vertices": [
                    *([10.9, 0.0, -1.25], [9.1, 0.0, -1.25], [9.1, 4.0, -1.25], [10.9, 4.0, -1.25]),
                    *([10.9, 0.0, 0.25], [9.1, 0.0, 0.25], [9.1, 4.0, 0.25], [10.9, 4.0, 0.25]),
                ],
            }
        ]
    },
    "supervisely": {
        "description": "",
        "key": "e9f0a3ae21be41d08eec166d454562be",
        "tags": [],
        "objects": [{"key": "6663ca1d20c74bc3bdd3c1a2b2a1c2ab", "classTitle": "Car", "tags": []}],
        "figures": [
            {
                "key": "cb8e067dadfc426aa8575a0c5e62de33",
                "objectKey": "6663ca1d20c74bc3bdd3c1a2b2a1c2ab",
                "geometryType": "cuboid_3d",
                "geometry": {"position": XYZ, "rotation": {**ZERO, "z": math.pi / 2}, "dimensions": SIZE},
            }
        ],
    },
    "datumaro": {
        "info": {},
        "categories": {"label": {"labels": [{"name": "Bus", "parent": ""}, {"name": "Car", "parent": ""}]}},
        "items": [
            {
                "id": "a",
                "annotations": [
                    {"id": 0, "type": "label", "label_id": 0},
                    {
                        "id": 1,
                        "type": "cuboid_3d",
                        "attributes": {"occluded": False},
                        "label_id": 1,
                        "position": [10.0, 2.0, -0.5],
                        "rotation": [0, 0, math.pi / 2],
                        "scale": [4.0, 1.8, 1.5],
                    },
                ],
            }
        ],
    },
    "segments": {
        "dataset": {
            "task_attributes": {"format_version": "0.1", "categories": [{"name": "Car", "id": 1}]},
            "samples": [
                {
                    "name": "a",
                    "labels": {
                        "ground-truth": {
                            "attributes": {
                                "annotations": [
                                    {
                                        "id": 1,
                                        "category_id": 1,
                                        "type": "cuboid",
                                        "position": XYZ,
                                        "dimensions": SIZE,
                                        "yaw": 0.0,
                                        "rotation": {"qx": 0.0, "qy": 0.0, "qz": HALF, "qw": HALF},
                                    }
                                ]
                            }
                        }
                    },
                }
            ],
        }
    },
    "scale": [
        {
            "cuboids": [
                {
                    "uuid": "4DBCC561",
                    "label": "Car",
                    "position": XYZ,
                    "dimensions": {"x": 1.8, "y": 4.0, "z": 1.5},  # 0 yaw is along (0, 1, 0)
                    "yaw": 0.0,
                    "stationary": False,
                }
            ]
        }
    ],
    "openlabel": {
        "openlabel": {
            "metadata": {"schema_version": "1.0.0"},
            "objects": {"1": {"name": "car1", "type": "Car"}},
            "frames": {
                "0": {
                    "objects": {
                        "1": {
                            "object_data": {
                                "cuboid": [{"name": "shape", "val": [10, 2, -0.5, 0, 0, HALF, HALF, 4.0, 1.8, 1.5]}]
                            }
                        }
                    }
                }
            },
        }
    },
    "pandaset_columns": ",uuid,label,yaw,stationary,camera_used,position.x,position.y,position.z,dimensions.x,"
    "dimensions.y,dimensions.z,attributes.object_motion\n0,ab12,Car,0.0,False,-1,10,2,-0.5,1.8,4.0,1.5,Moving\n",
    "table": "Class;CX;CY;CZ;Length;Width;Height;Yaw_Deg\nCar;10,0;2;-0,5;4,0;1,8;1,5;90\n",
}


@pytest.mark.parametrize("kind", DOCUMENTED)
def test_files_written_from_the_documentation_are_read(kind: str) -> None:
    content = DOCUMENTED[kind]
    found, notes = parse_labels(content if isinstance(content, str) else json.dumps(content), kind, "file", "a")
    assert not notes and len(found) == 1
    (frame,) = found.values()
    assert frame.names == ("Car",)
    np.testing.assert_allclose(frame.boxes, [CAR], atol=1e-12)


def test_vertices_are_the_corners_of_the_box() -> None:
    """The same eight points as :func:`corners_3d`, whatever their order."""
    write = FORMATS["labelcloud_vertices"].write_frame
    assert write is not None
    for k, one in enumerate(write(frames()["000000"], "a")["objects"]):
        ours = corners_3d(torch.from_numpy(BOXES[k : k + 1]))[0].numpy()
        theirs = np.array(one["vertices"])
        np.testing.assert_allclose(theirs[np.lexsort(theirs.T.round(6))], ours[np.lexsort(ours.T.round(6))], atol=1e-9)


def test_degrees_are_told_from_radians() -> None:
    text = "".join(f"{k} 2 3 4 2 1.5 {angle} Car\n" for k, angle in enumerate((90, 180, 270)))
    with pytest.raises(BeamboxError, match="angles should be radians, but reach 270"):
        parse_labels(text, "openpcdet", "file", "a")
    found, notes = parse_labels(text, "openpcdet", "file", "a", degrees=True)
    assert not notes and found["a"].boxes[:, 6] == pytest.approx([math.pi / 2, math.pi, -math.pi / 2])
    small = "".join(f"{k} 2 3 4 2 1.5 {angle} Car\n" for k, angle in enumerate((1.5, 3.1, 0.2)))
    assert "are they radians?" in parse_labels(small, "openpcdet", "file", "a", degrees=True)[1][0]


def test_boxes_that_lean_and_boxes_longer_across_are_mentioned() -> None:
    leaning = json.loads(json.dumps(DOCUMENTED["sustechpoints"]))
    leaning[0]["psr"]["rotation"]["x"] = 0.2
    assert "lean by up to 11.5 degrees" in parse_labels(json.dumps(leaning), "sustechpoints", "file", "a")[1][0]
    swapped = LabeledFrame(("Car",) * 4, np.tile([10, 2, 0, 1.8, 4.2, 1.5, 0.0], (4, 1)))
    assert "4 of 4 boxes longer than 2.5 m are longer across" in (heading_note({"a": swapped}) or "")
    assert heading_note(frames()) is None


@pytest.mark.parametrize(
    ("kind", "content", "fault"),
    [
        ("openpcdet", "1 2 3 4 5 6 7\n", "line 1: expected x y z dx dy dz yaw name, got 7 columns"),
        ("openpcdet", "1 2 3 4 five 6 0 Car\n", "line 1: expected numbers x y z l w h yaw"),
        ("openpcdet", "1 2 nan 4 5 6 0 Car\n", "expected finite metres"),
        ("sustechpoints", [{"obj_type": "Car"}], "expected an object under the key `psr`"),
        ("sustechpoints", {"a": 1}, "expected a list of objects"),
        ("labelcloud", {"objects": [{"name": "Car", "vertices": [[1, 2]]}]}, "expected eight vertices"),
        ("supervisely", {"objects": [], "figures": [{"objectKey": "x"}]}, "its object 'x' is not among"),
        ("datumaro", {"categories": {}, "items": []}, "under the key `label`"),
        ("scale", [{"cuboids": [{"dimensions": {"x": 1}}]}], r"expected x, y, z; y, z not there"),
        ("openlabel", {"openlabel": {"frames": {"0": {"objects": {"1": {"object_data": {"cuboid": [{"val": [1]}]}}}}}}},
         "expected 9 or 10 numbers, got 1"),
        ("table", "name,x,y,z,l,w,h\n", "there is no column `yaw`"),
        ("table", "name,x,y,z,l,w,h,yaw\nCar,1,2\n", "line 2: expected 8 columns as in the header, got 3"),
        ("table", DOCUMENTED["pandaset_columns"], "read it as pandaset_columns"),
    ],
)  # fmt: skip
def test_faults_name_the_place(kind: str, content: object, fault: str) -> None:
    with pytest.raises(BeamboxError, match=fault):
        parse_labels(content if isinstance(content, str) else json.dumps(content), kind, "file", "a")


def test_names_that_lead_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BeamboxError, match="a name must be"):
        write_labels({"../x": LabeledFrame((), np.zeros((0, 7)))}, "openpcdet", tmp_path / "out")
    assert not list(tmp_path.glob("*.txt"))


@pytest.mark.parametrize("kind", ["openpcdet", "labelcloud", "sustechpoints", "pandaset_columns", "datumaro", "table"])
def test_own_data_take_every_format(kind: str, tmp_path: Path) -> None:
    (tmp_path / "points").mkdir()
    for name in frames():
        np.zeros((5, 4), np.float32).tofile(tmp_path / "points" / f"{name}.bin")
    form = FORMATS[kind]
    write_labels(frames(), kind, tmp_path / "labels" if form.write_frame else tmp_path / f"all{form.ending}")
    labels = f"labels/{{frame}}{form.ending}" if form.write_frame else f"all{form.ending}"
    (tmp_path / "data.yaml").write_text(
        f'points: points/{{frame}}.bin\nlabels: {labels}\nformat: {kind}\nclasses: [Car]\nignore: ["*"]\n'
    )
    source = CustomSource(tmp_path / "data.yaml")
    found = source.labels(0)
    assert found is not None and found.names == ("Car",)
    torch.testing.assert_close(found.boxes, torch.from_numpy(BOXES[:1]).float())


def test_convert_command_and_detections_into_a_tool(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_labels(frames(), "labelcloud", tmp_path / "in")
    words = [
        "data",
        "convert",
        str(tmp_path / "in"),
        "--from",
        "labelcloud",
        "--to",
        "kitti",
        "--out",
        str(tmp_path / "out"),
    ]
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert not stopped.value.code and "4 boxes of 2 frames" in capsys.readouterr().out
    back, _ = convert_labels(tmp_path / "out", "kitti", tmp_path / "back", "openpcdet")
    np.testing.assert_allclose(back["000000"].boxes, BOXES, atol=0.011)  # KITTI's text has two decimals
    detections = {
        "frame": "s",
        "classes": ["Car"],
        "detections": [{"name": "Car", "score": 0.9} | dict(zip("xyzlwh", CAR)) | {"yaw": 0.1}],
    }
    (tmp_path / "s.json").write_text(json.dumps(detections))
    found, _ = convert_labels(tmp_path / "s.json", "json", tmp_path / "scene", "sustechpoints")
    assert found["s"].boxes[0, :6].tolist() == CAR[:6] and (tmp_path / "scene" / "s.json").exists()
    with pytest.raises(BeamboxError, match=r'unknown label format "labelcoud" \(did you mean "labelcloud"\?\)'):
        convert_labels(tmp_path, "labelcoud", tmp_path, "kitti")
