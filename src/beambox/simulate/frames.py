"""One simulated frame from (seed, index), and a source of as many as wanted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.kitti import DEFAULT_IMAGE_SIZE
from beambox.geometry.calibration import Calibration
from beambox.simulate.annotate import annotate
from beambox.simulate.layouts import check_layout, pick_layout, scene
from beambox.simulate.object_mix import KITTI_MIX, ObjectMix
from beambox.simulate.raycast import cast, pack
from beambox.simulate.returns import measure
from beambox.simulate.sensors import Sensor, load_sensor
from beambox.structures.frame import Frame

__all__ = ["CAMERA", "SimulatedSource", "simulate_frame"]

VIEWS = ("camera", "full")
_VIEW_LEFT, _VIEW_RIGHT, _VIEW_LOW = 42.5, 42.5, -19.0  # degrees; a little more than the camera sees

# A camera like KITTI's: 1242 x 375 pixels, 0.27 m before and 0.08 m below the LiDAR (its published calibration).
CAMERA = Calibration(
    p2=torch.tensor(
        [[721.5377, 0.0, 609.5593, 44.85728], [0.0, 721.5377, 172.854, 0.2163791], [0.0, 0.0, 1.0, 0.002745884]]
    ),
    r0=torch.tensor(
        [
            [0.9999239, 0.00983776, -0.007445048],
            [-0.009869795, 0.9999421, -0.004278459],
            [0.007402527, 0.004351614, 0.9999631],
        ]
    ),
    velo_to_cam=torch.tensor(
        [
            [0.007533745, -0.9999714, -0.000616602, -0.004069766],
            [0.01480249, 0.0007280733, -0.9998902, -0.07631618],
            [0.9998621, 0.00752379, 0.01480755, -0.2717806],
        ]
    ),
)


def simulate_frame(
    seed: int,
    index: int,
    *,
    sensor: str | Path | Sensor = "hdl64",
    view: str = "camera",
    layout: str = "random",
    layout_split: str | None = "train",
    object_mix: ObjectMix = KITTI_MIX,
) -> Frame:
    """Simulate one sweep; the same arguments give the same frame.

    Args:
        seed: of the data set.
        index: of the frame in it.
        sensor: preset, YAML file or :class:`Sensor`.
        view: ``camera`` casts and keeps only what the camera sees; ``full`` the whole turn.
        layout: ``random``, ``kitti:PATH`` (folder or archive of label_2 and calib) or ``mixed:PATH`` (in turn).
        layout_split: which ImageSets list of the layouts to draw from, where there is one; None draws from all.
        object_mix: which objects random streets hold, and how labels call them.

    Returns:
        Frame with points, labels (with attributes), calibration and image size.

    Raises:
        BeamboxError: an unknown sensor, view or layout.
        MissingFileError: a sensor file or layout that is not there.
    """
    sensor = load_sensor(sensor)
    if view not in VIEWS:
        raise BeamboxError(f"`view` must be camera or full, got {view!r}{did_you_mean(view, VIEWS)}")
    kind, path = check_layout(layout)
    rng = np.random.default_rng([seed, index])
    full = view == "full"
    real = pick_layout(path, layout_split, rng) if kind == "kitti" or (kind == "mixed" and index % 2) else None
    calibration = real.calibration if real else CAMERA
    stage = scene(rng, sensor.height, full, real, object_mix)
    points, unoccluded_hits, hits = _sweep(stage, sensor, full, rng)
    frame = Frame(
        points=torch.from_numpy(points),
        id=f"{index:06d}",
        labels=object_mix.rename(annotate(stage.placed, unoccluded_hits, hits, calibration, DEFAULT_IMAGE_SIZE, full)),
        calibration=calibration,
        image_size=DEFAULT_IMAGE_SIZE,
        notes=(f"layout {real.id if real else 'random'}",),
    )
    return frame if full else frame.camera_view()


def _sweep(stage, sensor: Sensor, full: bool, rng: np.random.Generator):
    """Cast the sensor's beams over a stage: points, and each object's beams alone and among the others."""
    elevation = np.radians(sensor.elevations)
    offsets = np.array(sensor.offsets or (0.0,) * len(elevation))
    if not full:
        kept = elevation > math.radians(_VIEW_LOW)
        elevation, offsets = elevation[kept], offsets[kept]
    step = 2 * math.pi / sensor.columns
    # A turn begins straight ahead and runs to the left, as in KITTI's files.
    azimuths = rng.uniform(0, step) + step * np.arange(sensor.columns)
    azimuths = (azimuths + math.pi) % (2 * math.pi) - math.pi
    if not full:
        azimuths = azimuths[(azimuths < math.radians(_VIEW_LEFT)) & (azimuths > -math.radians(_VIEW_RIGHT))]
    phases = rng.uniform(0, step, len(elevation))
    beams = np.stack((elevation, offsets), axis=1)  # (B, 2)
    table = stage.palette.table()
    packed = pack(stage.placed, (float(offsets.min()), float(offsets.max())))
    seed = int(rng.integers(2**62))
    hits = cast(packed, stage.packed_ground, table, seed, azimuths, phases, beams, sensor.max_range, step)
    angle = azimuths[None, :] + phases[:, None]  # (B, C)
    flat = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], angle.shape)
    directions = np.stack((flat * np.cos(angle), flat * np.sin(angle), up), axis=2).reshape(-1, 3)  # (B * C, 3)
    points = measure(hits, np.repeat(offsets, len(azimuths)), directions, table, sensor, rng)
    return points, hits.unoccluded_hits, hits.hits


@dataclass(frozen=True)
class SimulatedSource:
    """Frames simulated when asked for: a ``FrameSource`` without files."""

    frames: int
    """How many frames there are."""
    seed: int = 0
    """Of the data set."""
    sensor: str | Path | Sensor = "hdl64"
    """Preset, YAML file or sensor."""
    view: str = "camera"
    """camera or full."""
    layout: str = "random"
    """random, kitti:PATH or mixed:PATH."""
    layout_split: str | None = "train"
    """List of the layouts to draw from."""
    first: int = 0
    """Index of the first frame; a training run may move it on every pass to see new frames."""

    @property
    def ids(self) -> list[str]:
        """Name of each frame."""
        return [f"{self.first + i:06d}" for i in range(self.frames)]

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, index: int) -> Frame:
        if not -self.frames <= index < self.frames:
            raise IndexError(f"frame {index} of {self.frames}")
        return simulate_frame(
            self.seed,
            self.first + index % self.frames,
            sensor=self.sensor,
            view=self.view,
            layout=self.layout,
            layout_split=self.layout_split,
        )
