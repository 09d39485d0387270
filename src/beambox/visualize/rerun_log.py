"""Sweeps in the rerun viewer: points, boxes, camera, time line; live or as an .rrd file (extra ``rerun``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.checks import BeamboxError, import_library
from beambox.io import replacing
from beambox.structures import Detections, Frame, Labels
from beambox.visualize.colors import TRUTH, class_color, gradient
from beambox.visualize.image import box_edges, open_image

__all__ = ["RerunLog", "import_rerun"]


def import_rerun() -> Any:
    """Return the module ``rerun``.

    Raises:
        BeamboxError: saying how to install it.
    """
    return import_library("rerun", "rerun", "the viewer")


class RerunLog:
    """Sends sweeps to rerun, one after the other.

    Below ``world`` (the LiDAR's frame): ``points``, ``detections``, ``truth``; beside it ``camera`` with the boxes
    projected into the picture, and ``scores``, the network's map of class scores, where it is given.
    """

    def __init__(self, out: Path | None = None, *, color_by: Literal["height", "intensity"] = "height") -> None:
        """Begin.

        Args:
            out: .rrd file to write; None opens rerun's viewer and sends to it, as sweeps come.
            color_by: what the points' colours say.

        Raises:
            BeamboxError: if rerun-sdk is not installed or the name does not end in .rrd.
        """
        if out is not None and out.suffix.lower() != ".rrd":
            raise BeamboxError(f"a recording of rerun is written as .rrd, got the name {out}")
        self._rr = import_rerun()
        self._out = out
        self._color_by = color_by
        self._count = 0
        self._stream = self._rr.RecordingStream("beambox")
        if out is None:
            self._stream.spawn()
        else:
            self._memory = self._stream.memory_recording()
        self._log("world", self._rr.ViewCoordinates.FLU, static=True)  # x forward, y left, z up

    def _log(self, place: str, *what: Any, static: bool = False) -> None:
        self._stream.log(place, *what, static=static)

    def add(
        self,
        frame: Frame,
        detections: Detections | None = None,
        labels: Labels | None = None,
        *,
        tracks: NDArray[np.int64] | None = None,
        scores: NDArray[np.floating] | None = None,
        seconds: float | None = None,
    ) -> None:
        """Send a sweep.

        Args:
            frame: points, and the camera picture where there is one.
            detections: with class, score and track.
            labels: the truth, in green.
            tracks: ``(N,)`` track of each detection.
            scores: ``(Y, X)`` map of scores in [0, 1], x forward up, to show as a picture.
            seconds: time of the sweep; the sweeps are also numbered.
        """
        rr = self._rr
        self._stream.set_time("sweep", sequence=self._count)
        if seconds is not None:
            self._stream.set_time("time", duration=seconds)
        self._count += 1
        points = frame.points[:, :4].numpy()
        points = points[np.isfinite(points).all(axis=1)]
        value = points[:, 2] if self._color_by == "height" else points[:, 3]
        low, high = np.quantile(value, (0.02, 0.98)) if len(value) else (0.0, 1.0)
        colors = gradient((value - low) / max(float(high - low), 1e-3))
        self._log("world/points", rr.Points3D(points[:, :3], colors=colors, radii=0.03))
        self._log("frame", rr.TextLog(frame.id or "sweep"))
        found_words = [] if detections is None else _words(detections, tracks)
        for place, part, words in (("detections", detections, found_words), ("truth", labels, None)):
            if part is None:
                continue
            boxes = part.boxes.detach().cpu().numpy()
            tint = [TRUTH if place == "truth" else class_color(name) for name in part.names]
            half = np.stack(
                (np.zeros(len(boxes)), np.zeros(len(boxes)), np.sin(boxes[:, 6] / 2), np.cos(boxes[:, 6] / 2)), 1
            )
            shown = rr.Boxes3D(
                centers=boxes[:, :3],
                sizes=boxes[:, 3:6],
                quaternions=half,
                colors=tint,
                labels=list(part.names) if words is None else words,
                show_labels=place == "detections" or detections is None,
            )
            self._log(f"world/{place}", shown)
        self._camera(frame, detections, labels)
        if scores is not None:
            self._log("scores", rr.Image(gradient(scores)))

    def _camera(self, frame: Frame, detections: Detections | None, labels: Labels | None) -> None:
        if frame.calibration is None or frame.image_path is None:
            return
        rr = self._rr
        self._log("camera", rr.Image(np.asarray(open_image(frame.image_path))).compress(jpeg_quality=85))
        for place, part in (("truth", labels), ("detections", detections)):
            if part is None:
                continue
            strips, tint = [], []
            for box, name in zip(part.boxes.detach().cpu(), part.names):
                edges = box_edges(torch.as_tensor(box), frame.calibration)
                strips += [np.array(edge) for edge in edges]
                tint += [TRUTH if place == "truth" else class_color(name)] * len(edges)
            self._log(f"camera/{place}", rr.LineStrips2D(strips, colors=tint, radii=0.8))

    def close(self) -> int:
        """Write the file, where there is one, whole or not at all; return the number of sweeps."""
        self._stream.flush()
        if self._out is not None:
            content = self._memory.drain_as_bytes()
            with replacing(self._out) as stream:
                stream.write(content)
        return self._count


def _words(detections: Detections, tracks: NDArray[np.int64] | None) -> list[str]:
    words = [f"{name} {score:.2f}" for name, score in zip(detections.names, detections.scores.tolist())]
    return words if tracks is None else [f"{word} #{track}" for word, track in zip(words, tracks)]
