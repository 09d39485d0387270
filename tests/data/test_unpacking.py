"""Compressed recordings are read as uncompressed ones are, and those that hold too much are refused."""

from __future__ import annotations

import bz2
from pathlib import Path

import numpy as np
import pytest

from beambox.checks import BeamboxError
from beambox.data.formats.unpacking import FREE, RATIO, unpack
from beambox.data.read_points import read_frame
from beambox.infer.inputs import find_sweeps

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from data.test_recording import message, points

KINDS = ("bag bz2", "bag lz4", "mcap zstd", "db3 message", "db3 file")


def record(folder: Path, kind: str, cloud: np.ndarray) -> Path:
    """Write one compressed sweep; returns the recording."""
    if kind.startswith("bag"):
        store, path = get_typestore(Stores.ROS1_NOETIC), folder / "drive.bag"
        writer, write = Writer1(path), store.serialize_ros1
        writer.set_compression(Writer1.CompressionFormat[kind[4:].upper()])
    else:
        store, path = get_typestore(Stores.ROS2_HUMBLE), folder / "drive"
        plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
        writer, write = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
        mode = {"mcap zstd": "STORAGE", "db3 message": "MESSAGE", "db3 file": "FILE"}[kind]
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/top", "sensor_msgs/msg/PointCloud2", typestore=store)
        made = message(store, cloud, kind.startswith("bag"))
        writer.write(connection, 5, write(made, "sensor_msgs/msg/PointCloud2"))
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_compressed_recordings_are_read(kind: str, tmp_path: Path) -> None:
    cloud = points(0)
    path = record(tmp_path, kind, cloud)
    found = find_sweeps([path])
    assert [sweep.name for sweep in found] == ["5"]
    assert np.array_equal(read_frame(found[0].path).points[:, 0].numpy(), cloud["x"].reshape(-1))


@pytest.mark.parametrize("kind", KINDS)
def test_what_unpacks_to_far_more_than_its_size_is_refused(kind: str, tmp_path: Path) -> None:
    # 66 MB of zeros, which pack to some kilobytes
    path = record(tmp_path, kind, np.zeros((1000, 3000), points(0).dtype))
    packed = sum(part.stat().st_size for part in ([path] if path.is_file() else path.iterdir()))
    if packed * RATIO + FREE > 66_000_000:
        pytest.skip("this compressor keeps zeros within the bound")
    with pytest.raises(BeamboxError, match="unpacks to more than"):
        read_frame(path / "top" / "5")


def test_frames_in_a_row_are_one_chunk() -> None:
    assert unpack(bz2.compress(b"one ") + bz2.compress(b"two"), bz2.BZ2Decompressor) == b"one two"
    with pytest.raises(BeamboxError, match="ends too early"):
        unpack(bz2.compress(b"one")[:-4], bz2.BZ2Decompressor)


def test_a_chunk_is_never_held_beyond_its_bound() -> None:
    asked: list[int] = []

    class Endless:
        eof, unused_data = False, b""

        def decompress(self, _data: bytes, most: int) -> bytes:
            asked.append(most)
            return bytes(most)

    with pytest.raises(BeamboxError, match="unpacks to more than"):
        unpack(b"xyz", Endless)
    assert asked == [3 * RATIO + FREE + 1]
