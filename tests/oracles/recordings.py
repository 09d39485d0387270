"""Recordings of point clouds for tests, written by rosbags."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FIELDS = ("x", "y", "z", "intensity")


def record(
    path: Path,
    clouds: list[np.ndarray],
    topics: tuple[str, ...] = ("/lidar/top",),
    *,
    period: float = 0.1,
    late: int = 7,
) -> Path:
    """Write (N, 4) float32 clouds as PointCloud2, frame id "lidar"; recorded ``late`` ns after their header's stamp.

    Returns the file: a .mcap or .db3 inside the folder ``path``, or ``path`` itself with the ending .bag.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    first = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    types, plugin = store.types, StoragePlugin.SQLITE3 if path.suffix == ".db3" else StoragePlugin.MCAP
    folder = path.with_suffix("")
    writer = Writer1(path) if first else Writer2(folder, version=9, storage_plugin=plugin)
    write = store.serialize_ros1 if first else store.serialize_cdr
    with writer:
        for topic in topics:
            connection = writer.add_connection(topic, "sensor_msgs/msg/PointCloud2", typestore=store)
            for k, cloud in enumerate(clouds):
                stamp = 1_700_000_000_000_000_000 + round(k * period * 1e9)
                time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 1_000_000_000))
                header = {"stamp": time, "frame_id": "lidar", **({"seq": k} if first else {})}
                point = types["sensor_msgs/msg/PointField"]
                data = np.ascontiguousarray(cloud, dtype="<f4")
                message = types["sensor_msgs/msg/PointCloud2"](
                    header=types["std_msgs/msg/Header"](**header),
                    height=1,
                    width=len(data),
                    fields=[point(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(FIELDS)],
                    is_bigendian=False,
                    point_step=16,
                    row_step=16 * len(data),
                    data=data.view(np.uint8).reshape(-1),
                    is_dense=True,
                )
                writer.write(connection, stamp + late, write(message, "sensor_msgs/msg/PointCloud2"))
    return path if first else next(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))
