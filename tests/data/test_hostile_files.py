"""Every reader, given files that were changed on purpose: a value or one line of error, in seconds and bounded memory.

Mutants of small good files: bytes and numbers changed, cut, repeated, put in; keys of JSON and YAML taken away or given
other values. A small share runs always, the large run under the marker ``slow``.
"""

from __future__ import annotations

import json
import random
import resource
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.custom import CustomSource
from beambox.data.database import ObjectDatabase
from beambox.data.folder import parse_boxes
from beambox.data.kitti_calibration import read_calibration
from beambox.data.kitti_text import read_labels
from beambox.data.once import OnceSource
from beambox.data.read_points import read_frame
from beambox.detectors.catalog import build
from beambox.detectors.weights import load_weights, save_weights
from beambox.geometry import Calibration
from beambox.infer.results import read_result, write_results
from beambox.io import read_text
from beambox.metrics.once import evaluate_annotations
from beambox.simulate.sensors import load_sensor
from beambox.structures import Detections, Frame
from beambox.train.checkpoint import Checkpoint, load_checkpoint

SECONDS, MEGABYTES = 5.0, 1000
FEW, MANY = 25, 2000
CALIBRATION = Calibration(
    torch.tensor([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    torch.eye(3),
    torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]),
)
CALIB_TEXT = (
    "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
)
CLOUD = (np.random.default_rng(5).random((40, 4)) * [60, 20, 3, 1] - [0, 10, 2, 0]).astype(np.float32)
OPTIONS = {
    "grid": {"minimum": [0.0, -6.4, -3.0], "maximum": [12.8, 6.4, 1.0], "cell": [0.4, 0.4, 4.0]},
    "pillar_channels": 4, "depths": [1, 1], "strides": [2, 2], "widths": [8, 8], "up_strides": [1, 2],
    "up_widths": [8, 8],
}  # fmt: skip


def write_cloud(path: Path) -> None:
    kind = path.suffix
    if kind == ".bin":
        CLOUD.tofile(path)
    elif kind == ".npy":
        np.save(path, CLOUD)
    elif kind == ".npz":
        np.savez_compressed(path, points=CLOUD[:, :3], intensity=CLOUD[:, 3])
    elif kind == ".pcd":
        module = pytest.importorskip("pypcd4")
        encoding = ("ascii", "binary", "binary_compressed")[int(path.stem)]
        module.PointCloud.from_xyzi_points(CLOUD).save(path, encoding=module.Encoding(encoding))
    elif kind == ".ply":
        module = pytest.importorskip("plyfile")
        records = np.zeros(len(CLOUD), [(name, "f4") for name in ("x", "y", "z", "intensity")])
        for k, name in enumerate(records.dtype.names or ()):
            records[name] = CLOUD[:, k]
        element = module.PlyElement.describe(records, "vertex")
        module.PlyData([element], text=path.stem == "0").write(str(path))
    else:
        module = pytest.importorskip("laspy")
        number = (0, 6, 7)[int(path.stem)]
        header = module.LasHeader(point_format=number, version="1.4" if number > 5 else "1.2")
        las = module.LasData(header)
        las.x, las.y, las.z = CLOUD[:, :3].T
        las.write(str(path))


def write_bag(path: Path) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    fields = [
        types["sensor_msgs/msg/PointField"](name=name, offset=4 * k, datatype=7, count=1)
        for k, name in enumerate(("x", "y", "z", "intensity"))
    ]
    time_ = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    message = types["sensor_msgs/msg/PointCloud2"](
        header=types["std_msgs/msg/Header"](seq=0, stamp=time_, frame_id="l"), height=1, width=40, fields=fields,
        is_bigendian=False, point_step=16, row_step=640, data=np.frombuffer(CLOUD.tobytes(), "u1"), is_dense=True,
    )  # fmt: skip
    with Writer(path) as writer:
        connection = writer.add_connection("/p", "sensor_msgs/msg/PointCloud2", typestore=store)
        writer.write(connection, 5, store.serialize_ros1(message, "sensor_msgs/msg/PointCloud2"))


def write_database(path: Path) -> None:
    ObjectDatabase(
        boxes=np.tile(np.array([[5, 0, -1, 4, 2, 1.5, 0]], "f4"), (3, 1)),
        points=CLOUD[:12],
        offsets=np.array([0, 4, 8, 12]),
        labels=np.array([0, 1, 0]),
        classes=("Car", "Cyclist"),
        frames=("a", "b", "c"),
    ).save(path)


def write_detections(path: Path) -> None:
    boxes = torch.tensor([[5.0, 0, -1, 4, 2, 1.5, 0]] * 2)
    found = Detections(boxes, torch.tensor([0.9, 0.5]), torch.tensor([0, 1]), ("Car", "Van"), "a")
    frame = Frame(torch.zeros(0, 4), "a", calibration=CALIBRATION, image_size=(1242, 375))
    kind = {".json": "json", ".csv": "csv", ".txt": "kitti"}[path.suffix]
    written = write_results(path.parent / "out", frame, found, [kind], "m", path.stem)[0]
    path.write_bytes(written.read_bytes())


def read_detections(path: Path) -> None:
    frame = Frame(torch.zeros(0, 4), "a", calibration=CALIBRATION)
    found = read_result(path, frame)
    assert bool(found.boxes.isfinite().all()) and bool(found.scores.isfinite().all())
    assert bool((found.boxes[:, 3:6] >= 0).all())


def write_once(path: Path) -> None:
    folder = path.parent / "once" / "data" / "000000"
    folder.mkdir(parents=True, exist_ok=True)
    boxes = [[5, 0, -1, 4, 2, 1.5, 0]] * 2
    content = {"calib": {}, "frames": [
        {"frame_id": "1", "pose": [0] * 7, "annos": {"names": ["Car", "Bus"], "boxes_3d": boxes}}, {"frame_id": "2"},
    ]}  # fmt: skip
    path.write_text(json.dumps(content), encoding="utf-8")


def read_once(path: Path) -> None:
    (path.parent / "once" / "data" / "000000" / "000000.json").write_bytes(path.read_bytes())
    OnceSource(path.parent / "once", "all", labeled=False)


def write_annotations(path: Path) -> None:
    truth = {"frame_id": "1", "names": ["Car"], "boxes_3d": [[5, 0, -1, 4, 2, 1.5, 0]]}
    content = {"ground_truth": [truth], "predictions": [{**truth, "scores": [0.5]}]}
    path.write_text(json.dumps(content), encoding="utf-8")


def write_description(path: Path) -> None:
    (path.parent / "sweeps").mkdir(exist_ok=True)
    CLOUD.tofile(path.parent / "sweeps" / "1.bin")
    text = (
        "points: sweeps/{frame}.bin\nlabels: boxes.csv\naxes: 'x: right, y: forward'\nsensor_height: 1.8\n"
        "ground_slope: {forward: 0.01}\nclasses: {Car: [Car, Van]}\nignore: ['*']\nrange: [0, -40, 70, 40]\n"
    )
    (path.parent / "boxes.csv").write_text("frame,name,x,y,z,l,w,h,yaw\n1,Car,1,2,3,4,5,6,0\n", encoding="utf-8")
    path.write_text(text, encoding="utf-8")


def write_table(path: Path) -> None:
    write_description(path.with_suffix(".yaml"))
    path.write_bytes((path.parent / "boxes.csv").read_bytes())


def read_table(path: Path) -> None:
    (path.parent / "boxes.csv").write_bytes(path.read_bytes())
    write = path.parent / "table.yaml"
    write.write_text("points: sweeps/{frame}.bin\nlabels: boxes.csv\nclasses: [Car]\nignore: ['*']\n", encoding="utf-8")
    CustomSource(write).labels(0)


def write_weights(path: Path) -> None:
    save_weights(path, build("pointpillars", OPTIONS), {"data": "x"})


def write_checkpoint(path: Path) -> None:
    tensors = {"model.weight": torch.zeros(4), "optim.weight.step": torch.zeros(())}
    Checkpoint(tensors, 3, {"name": "r"}, {"name": "pointpillars"}, {"best": 1.0}).save(path)


def write_plain(text: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(text, encoding="utf-8") and None


LABEL = "Car 0.25 1 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57\n"
SENSOR = "elevations: [1, 0, -1]\noffsets: [0, 0.1, 0.2]\nazimuth_step: 0.2\nheight: 1.7\nmax_range: 80\n"
READERS: dict[str, tuple[str, Callable[[Path], Any], Callable[[Path], Any]]] = {
    **{
        f"{stem}{kind}": (f"{stem}{kind}", write_cloud, read_frame)
        for kind, count in ((".bin", 1), (".npy", 1), (".npz", 1), (".pcd", 3), (".ply", 2), (".las", 3), (".laz", 3))
        for stem in range(count)
    },
    "recording": ("a.bag", write_bag, lambda path: read_frame(path / "p" / "5")),
    "object database": ("o.npz", write_database, ObjectDatabase.load),
    "result json": ("r.json", write_detections, read_detections),
    "result csv": ("r.csv", write_detections, read_detections),
    "result kitti": ("r.txt", write_detections, read_detections),
    "once": ("once.json", write_once, read_once),
    "annotations": ("ann.json", write_annotations, evaluate_annotations),
    "labels": ("l.txt", write_plain(LABEL * 2), lambda path: read_labels(path, CALIBRATION)),
    "boxes": ("b.txt", write_plain("Car 1 2 3 4 5 6 0.5\n" * 2), lambda path: parse_boxes(read_text(path), str(path))),
    "calibration": ("c.txt", write_plain(CALIB_TEXT), read_calibration),
    "description": ("d.yaml", write_description, lambda path: CustomSource(path)[0]),
    "table": ("t.csv", write_table, read_table),
    "sensor": ("s.yaml", write_plain(SENSOR), load_sensor),
    "weights": ("w.safetensors", write_weights, load_weights),
    "checkpoint": ("k.safetensors", write_checkpoint, load_checkpoint),
}  # fmt: skip
NUMBERS = (b"-1", b"0", b"1e400", b"nan", b"inf", b"1e9", b"4294967295", b"9" * 30, b"9" * 5000, b"null", b"[]", b"{}",
           b'""', b'"../../x"', b"true", b".inf", b"\x00", b"\xff", b"1e-320", b"[" * 2000)  # fmt: skip


def mutant(content: bytes, rng: random.Random) -> bytes:
    """Return the content changed in one to three places."""
    out = bytearray(content)
    for _ in range(rng.randint(1, 3)):
        if not out:
            return bytes(out)
        at = rng.randrange(len(out) if rng.random() < 0.5 else min(len(out), 400))
        match rng.randrange(7):
            case 0:
                out[at] = rng.randrange(256)
            case 1:
                del out[at:]
            case 2:
                del out[at : at + rng.randint(1, 20)]
            case 3:
                out[at:at] = rng.choice(NUMBERS)
            case 4:
                out[at : at + 4] = rng.choice((b"\xff" * 4, b"\x00" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80"))
            case 5:
                out[at : at + 8] = rng.choice((b"\xff" * 8, b"\x00" * 7 + b"\x10", b"\xff" * 7 + b"\x7f"))
            case _:  # a number, or a word, becomes another
                end = at
                while end < len(out) and chr(out[end]) not in " ,:]}\n\"'":
                    end += 1
                out[at:end] = rng.choice(NUMBERS)
    return bytes(out)


def run(tmp_path: Path, name: str, count: int, seed: int = 0) -> None:
    file, write, read = READERS[name]
    write(tmp_path / file)
    content = (tmp_path / file).read_bytes()
    read(tmp_path / file)  # the good file is read
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rng = random.Random(f"{name} {seed}")
    for number in range(count):
        changed = mutant(content, rng)
        (tmp_path / file).write_bytes(changed)
        start = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                read(tmp_path / file)
            except BeamboxError as error:
                text = str(error)
                assert len(text) < 2000, f"mutant {number}: a message of {len(text)} letters"
            except Exception as error:
                raise AssertionError(f"mutant {number} of {name}: {type(error).__name__}: {error}") from error
        assert time.process_time() - start < SECONDS, f"mutant {number} of {name}"
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown < MEGABYTES, f"{name} took {grown:.0f} MB"


@pytest.mark.parametrize("name", READERS)
def test_a_few_mutants(tmp_path: Path, name: str) -> None:
    run(tmp_path, name, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_mutants(tmp_path: Path, name: str) -> None:
    run(tmp_path, name, MANY, seed=1)
