"""A trained network that takes what a user has and returns boxes: ``detector = load(name); detector("scan.bin")``."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.formats.kept import close_kept
from beambox.data.read_points import points_from_array
from beambox.detectors.contract import AnyModel, DetectorConfig, model_of, module_of
from beambox.detectors.weights import load_weights, read_weights
from beambox.geometry import VoxelGrid
from beambox.geometry.axes import Axes
from beambox.infer.bn_folding import fold_batch_norms
from beambox.infer.forking import survive_fork
from beambox.infer.ground import EmptyGround
from beambox.infer.inputs import Sweep, read_sweep
from beambox.infer.memory import keep_memory
from beambox.infer.precision import choose_device, choose_precision
from beambox.infer.sensor_alignment import SensorAlignment
from beambox.infer.sensor_profile import SensorProfile
from beambox.infer.streaming import Input, each_input, groups, names_one_sweep
from beambox.structures import Batch, Detections, Frame, expect_columns
from beambox.zoo import find_weights

__all__ = ["Detector", "Input", "View", "load", "region"]

log = logging.getLogger("beambox")

View = Literal["auto", "camera", "full"]
VIEWS = ("auto", "camera", "full")

STRIDE = 8
"""Regions are rounded to this many cells, the coarsest step of the networks' backbones."""


class Detector:
    """A network for inference with what it needs: reading, alignment, precision, boxes in the given frame."""

    def __init__(
        self,
        model: AnyModel,
        *,
        card: Mapping[str, Any] | None = None,
        device: str | torch.device | None = None,
        precision: str = "auto",
        grid: VoxelGrid | None = None,
        view: View = "auto",
        alignment: SensorAlignment | None = None,
        intensity_scale: float | None = None,
        fields: str | Sequence[str] | None = None,
        batch_size: int = 1,
    ) -> None:
        """Prepare a model: batch norms folded, channels last, on its device.

        Args:
            model: a detector of the catalogue; it is copied, and neither it nor its mode is changed.
            card: what is known of its weights.
            device: "cpu", "cuda", ...; None takes the GPU where there is one.
            precision: "auto", "float32", "bfloat16" or "float16".
            grid: region to look at, with cells of the model's size; the model's own where None.
            view: "camera" keeps the points that the camera sees (KITTI's labels exist only there), "full" keeps all;
                "auto" is "camera" for a sweep with a calibration where the network looks ahead only.
            alignment: of another sensor's points.
            intensity_scale: factor that brings the intensity to [0, 1]; found from the numbers where None.
            fields: names of the columns of files that do not name them.
            batch_size: sweeps that go through the network together when a list is given.
        """
        if view not in VIEWS:
            raise BeamboxError(f'unknown view "{view}"{did_you_mean(view, VIEWS)}')
        self.device = choose_device(device)
        self.dtype = choose_precision(precision, self.device)
        self.card = dict(card or {})
        self.config: DetectorConfig = model.config
        self.grid: VoxelGrid = grid or self.config.grid
        self.view: View = view
        self.alignment = alignment or SensorAlignment()
        self.intensity_scale = intensity_scale
        self.fields = fields
        self.batch_size = batch_size
        survive_fork()
        folded = fold_batch_norms(module_of(model)).to(self.device)
        self.model: AnyModel = model_of(channels_last(folded))
        self.ground = EmptyGround()
        if self.device.type == "cpu":
            keep_memory()

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of what it finds."""
        return self.config.classes

    @overload
    def __call__(  # pyright: ignore[reportOverlappingOverload]  # an array can be iterated over, but is one sweep
        self, given: np.ndarray | Tensor | Frame
    ) -> Detections: ...
    @overload
    def __call__(self, given: str | Path) -> Detections | Any: ...  # a list for a folder, a pattern or a recording
    @overload
    def __call__(self, given: Iterable[Input]) -> list[Detections]: ...
    def __call__(self, given: Input | Iterable[Input]) -> Detections | list[Detections]:
        """Detect.

        Args:
            given: a path; an ``(N, 4 or more)`` array or tensor of x, y, z in metres (x forward, y left, z up) and
                intensity in [0, 1]; a :class:`Frame`; or several sweeps: a list or generator of these, a folder, a
                pattern such as ``"drive/*.pcd"``, a recording of ROS.

        Returns:
            The detections, best first, on the CPU, in the frame of the points as given; a list for several sweeps.

        Raises:
            BeamboxError: if something cannot be read or is no point cloud.
        """
        if names_one_sweep(given):
            return self.detect([self.read(given)])[0]  # pyright: ignore[reportArgumentType]
        return list(self.stream(given))

    def stream(self, given: Input | Iterable[Input]) -> Iterator[Detections]:
        """Detect and yield as it goes: one sweep (or ``batch_size`` of them) is in memory at a time.

        Args:
            given: as for a call; each sweep of a folder, pattern, recording, list or generator in turn. A recording
                is opened once.

        Yields:
            The detections of each sweep, in order.

        Raises:
            BeamboxError: when a sweep cannot be read.
        """
        try:
            for frames in groups(each_input(given), self.read, self.batch_size):
                yield from self.detect(frames)
        finally:
            close_kept()

    def read(self, given: Input | Sweep) -> Frame:
        """Turn any input into a frame; nothing is corrected yet."""
        scale = self.intensity_scale
        if isinstance(given, str | Path | Sweep):
            frame = read_sweep(given, fields=self.fields, intensity_scale=scale)
        elif isinstance(given, np.ndarray | Tensor):
            points, notes = points_from_array(given, scale)
            frame = Frame(points, notes=notes)
        elif isinstance(given, Frame):  # pyright: ignore[reportUnnecessaryIsInstance]  # callers may not be typed
            if scale is None:
                return given
            brighter = given.points.clone()
            brighter[:, 3] *= scale
            return given.with_points(brighter)
        else:
            raise BeamboxError(f"a sweep is a path, an (N, 4) array or tensor, or a Frame; got {type(given).__name__}")
        for note in frame.notes:
            log.info("%s: %s", frame.id or "array", note)
        return frame

    def prepare(self, frame: Frame) -> Frame:
        """Crop to the view and correct."""
        return self.alignment.apply(self.crop(frame))

    def sees(self, prepared: Frame) -> bool:
        """Tell whether any point lies where the network looks; warns where points are there, but none does."""
        if bool(self.grid.index(prepared.points)[1].any()):
            return True
        if len(prepared):
            log.warning(
                "%s: none of its %d points lies in the region the network looks at; beambox doctor says why",
                prepared.id or "sweep",
                len(prepared),
            )
        return False

    def crop(self, frame: Frame) -> Frame:
        """Drop the points outside the camera's view where only that is looked at."""
        return frame.camera_view() if self.sees_camera_only(frame) else frame

    def sees_camera_only(self, frame: Frame) -> bool:
        """Whether points outside the camera's view are dropped."""
        if self.view == "auto":
            return frame.calibration is not None and frame.image_size is not None and self.grid.minimum[0] >= 0
        return self.view == "camera"

    @torch.inference_mode()
    def detect(self, frames: Sequence[Frame]) -> list[Detections]:
        """Detect in frames that pass through the network together; where there is no point, there is nothing."""
        survive_fork()
        for frame in frames:
            expect_columns(frame, self.config.num_point_features)
        prepared = [self.prepare(frame) for frame in frames]
        seen = [k for k, frame in enumerate(prepared) if self.sees(frame)]
        found = [Detections.empty(self.classes, frame.id) for frame in frames]
        if seen:
            batch = Batch.of([prepared[k] for k in seen]).to(self.device)
            for k, one in zip(seen, self.finish(self.predict(batch), [frames[k] for k in seen])):
                found[k] = one
        return found

    @torch.inference_mode()
    def predict(self, batch: Batch) -> Any:
        """Run the network on a prepared batch that lies on its device."""
        survive_fork()
        lower = self.dtype != torch.float32
        with torch.autocast(self.device.type, dtype=self.dtype if lower else torch.bfloat16, enabled=lower):
            self.ground.learn(module_of(self.model), self.grid)
            return self.model(batch, self.grid)

    @torch.inference_mode()
    def finish(self, predictions: Any, frames: Sequence[Frame]) -> list[Detections]:
        """Decode, and carry the boxes into the frame of the points as given."""
        decoded = self.model.decode(predictions)
        return [
            self.alignment.to_sensor(replace(found.to("cpu"), frame_id=frame.id))
            for found, frame in zip(decoded, frames)
        ]


def channels_last(model: nn.Module) -> nn.Module:
    """Lay out the weights of convolutions so that their maps keep the channels of a cell together."""
    for layer in model.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)
    return model


def region(model_grid: VoxelGrid, wanted: float | Sequence[float] | VoxelGrid) -> VoxelGrid:
    """Choose another region for a network: same cells, same heights, whole steps of its backbone.

    Args:
        model_grid: what it was trained on.
        wanted: a number r (from -r to r ahead and to the sides: 360 degrees), or x_min, y_min, x_max, y_max in metres,
            or a grid.

    Raises:
        BeamboxError: if the region is empty or not four numbers, or a grid's cells differ from the model's.
    """
    if isinstance(wanted, VoxelGrid):
        if any(abs(a - b) > 1e-9 for a, b in zip(wanted.cell, model_grid.cell)):
            raise BeamboxError(f"the region needs cells of {model_grid.cell} m as in training, got {wanted.cell}")
        return wanted
    numbers = [-wanted, -wanted, wanted, wanted] if isinstance(wanted, int | float) else list(wanted)
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
        raise BeamboxError(f"a range is one number, or x_min, y_min, x_max, y_max in metres, got {wanted}")
    low: list[float] = []
    high: list[float] = []
    for axis in (0, 1):
        step, start = model_grid.cell[axis] * STRIDE, model_grid.minimum[axis]
        first = math.floor((numbers[axis] - start) / step + 1e-6)
        last = math.ceil((numbers[axis + 2] - start) / step - 1e-6)
        low.append(start + first * step)
        high.append(start + last * step)
    return VoxelGrid(
        (low[0], low[1], model_grid.minimum[2]), (high[0], high[1], model_grid.maximum[2]), model_grid.cell
    )


def covers(trained: VoxelGrid, wanted: VoxelGrid) -> bool:
    """Whether one region lies within another, in BEV."""
    return all(trained.minimum[k] <= wanted.minimum[k] and wanted.maximum[k] <= trained.maximum[k] for k in (0, 1))


def load(
    name: str | Path,
    *,
    device: str | torch.device | None = None,
    precision: str = "auto",
    range: float | Sequence[float] | VoxelGrid | None = None,
    view: View = "auto",
    sensor_height: float | None = None,
    axes: str | Axes | None = None,
    ground_slope: tuple[float, float] = (0.0, 0.0),
    intensity_scale: float | None = None,
    fields: str | Sequence[str] | None = None,
    batch_size: int = 1,
) -> Detector:
    """Load a detector.

    Args:
        name: a shipped name (`beambox models` lists them), a .safetensors file, or the folder of a training run.
        device: "cpu", "cuda", ...; None takes the GPU where there is one.
        precision: "auto" (bfloat16 where the machine computes it natively), "float32", "bfloat16" or "float16".
        range: look elsewhere than in training, with the same cells: a number r for -r to r on both axes (360 degrees),
            or x_min, y_min, x_max, y_max in metres, or a :class:`VoxelGrid`.
        view: "camera", "full" or "auto"; see :class:`Detector`.
        sensor_height: metres of this sensor above the ground (0 where the points' origin lies on it), where that
            differs from the training sensor's.
        axes: where x and y lead, such as ``"x: right, y: forward"``, where that is not forward and left.
        ground_slope: metres that the ground rises a metre forward and a metre to the left, where it does not lie level.
        intensity_scale: factor that brings the intensity to [0, 1], such as 0.01 for percent; None finds it from the
            numbers, as :mod:`beambox.data.read_points` says.
        fields: names of the columns of files that do not name them, such as "x,y,z,intensity,ring".
        batch_size: sweeps that go through the network together when a list is given.

    Raises:
        BeamboxError: if there are no such weights, the file is broken, or an option cannot be used.
    """
    survive_fork()
    path = find_weights(name)
    chosen = choose_device(device)
    model = load_weights(path, "cpu")
    card = read_weights(path).card
    trained = SensorProfile.of(card, model.config.grid).sensor_height
    alignment = SensorAlignment(
        axes=Axes.parse(axes) if isinstance(axes, str) else axes or Axes(),
        z_offset=0.0 if sensor_height is None else sensor_height - trained,
        slope=ground_slope,
    )
    grid: VoxelGrid = model.config.grid if range is None else region(model.config.grid, range)
    if model.config.absolute_xy and not covers(model.config.grid, grid):
        log.warning(
            "%s learnt where things are as seen from the sensor (its absolute_xy is on) and looks beyond the region it "
            "was trained on: expect less of it there",
            name,
        )
    return Detector(
        model,
        card=card,
        device=chosen,
        precision=precision,
        grid=grid,
        view=view,
        alignment=alignment,
        intensity_scale=intensity_scale,
        fields=fields,
        batch_size=batch_size,
    )
