"""The ROS 2 node of examples/: everything it takes from beambox is there; rclpy is stood in for."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import pytest

pytest.importorskip("filterpy")
NODE = Path(__file__).resolve().parents[2] / "examples" / "ros2" / "beambox_node.py"


def test_the_node_imports_and_names_what_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (
        "rclpy",
        "rclpy.node",
        "rclpy.qos",
        "sensor_msgs",
        "sensor_msgs.msg",
        "vision_msgs",
        "vision_msgs.msg",
    ):
        module = ModuleType(name)
        module.__getattr__ = lambda attribute: MagicMock  # type: ignore[method-assign]
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("beambox_node", NODE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert callable(module.BeamboxNode.on_cloud) and callable(module.cloud_columns)
