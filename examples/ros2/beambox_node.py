"""A small ROS 2 node: PointCloud2 in, Detection3DArray out, with identities.

    ros2 run ... or simply:  python beambox_node.py --ros-args -p model:=pointpillars-kitti -r points:=/velodyne_points

Needs a sourced ROS 2 (rclpy, sensor_msgs, vision_msgs) and, in the same Python and from the checkout of beambox,
`python -m pip install ".[track]"`. Sweeps that arrive while one is worked on are dropped but for the newest (queue of
one).
"""

from __future__ import annotations

import math

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

import beambox
from beambox.data.formats.point_cloud2 import cloud_columns
from beambox.data.read_points import frame_from_columns
from beambox.track import Tracker


class BeamboxNode(Node):
    """Detects and tracks in every cloud that arrives."""

    def __init__(self) -> None:
        super().__init__("beambox")
        model = self.declare_parameter("model", "pointpillars-sim").value
        self.score_threshold = float(self.declare_parameter("score_threshold", 0.3).value)
        self.detector = beambox.load(model)
        self.tracker = Tracker()
        self.last = 0.0
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.publisher = self.create_publisher(Detection3DArray, "detections", 1)
        self.create_subscription(PointCloud2, "points", self.on_cloud, qos)

    def on_cloud(self, cloud: PointCloud2) -> None:
        """Publish the objects of one cloud under its own header."""
        frame = frame_from_columns(cloud_columns(cloud, "points"), "points")
        found = self.detector(frame)
        time = cloud.header.stamp.sec + cloud.header.stamp.nanosec / 1e9
        if time < self.last:
            self.tracker.reset()
        self.last = time
        tracks = self.tracker.update(found[found.scores >= self.score_threshold], time)
        self.publisher.publish(self.message(cloud, tracks))

    def message(self, cloud: PointCloud2, tracks) -> Detection3DArray:
        """Build the message."""
        out = Detection3DArray(header=cloud.header)
        rows = zip(
            tracks.detections.boxes.tolist(), tracks.names, tracks.ids.tolist(), tracks.detections.scores.tolist()
        )
        for (x, y, z, length, width, height, yaw), name, number, score in rows:
            one = Detection3D(header=cloud.header, id=str(number))
            center = one.bbox.center
            center.position.x, center.position.y, center.position.z = x, y, z
            center.orientation.z, center.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
            one.bbox.size.x, one.bbox.size.y, one.bbox.size.z = length, width, height
            result = ObjectHypothesisWithPose()
            result.hypothesis.class_id, result.hypothesis.score = name, score
            result.pose.pose = center
            one.results.append(result)
            out.detections.append(one)
        return out


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    rclpy.spin(BeamboxNode())


if __name__ == "__main__":
    main()
