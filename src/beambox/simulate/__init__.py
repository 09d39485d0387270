"""A LiDAR simulator: scenes of shapes, ray casting with numba, KITTI-layout data sets with labels."""

from beambox.callable_package import make_callable
from beambox.simulate.frames import SimulatedSource, simulate_frame
from beambox.simulate.sensors import SENSORS, Sensor, load_sensor
from beambox.simulate.writer import write_dataset

__all__ = ["SENSORS", "Sensor", "SimulatedSource", "load_sensor", "simulate_frame", "write_dataset"]

make_callable(__name__)  # beambox.simulate(...) is beambox.verbs.simulate
