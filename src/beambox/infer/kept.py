"""Detections kept in one file while they are made, frame by frame, so that nothing is detected twice.

The file holds JSON lines: the first says what made the detections, each further one is a frame. Whatever the layout of
the data, boxes stand in the sensor's frame, with all their digits: scoring the file gives what scoring at once gave. A
line that a killed process left unfinished is dropped.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.data.source import FrameSource
from beambox.file_names import check_file_name
from beambox.infer.evaluate import Detect
from beambox.io import parse_json
from beambox.structures import Detections, Frame

__all__ = ["KeptDetections", "digest"]

FORMAT = "beambox-detections-1"


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        summed = hashlib.sha256()
        while block := file.read(1 << 20):
            summed.update(block)
    return summed.hexdigest()


class KeptDetections:
    """A file of detections, appended to frame by frame."""

    def __init__(self, path: Path, made_by: Mapping[str, Any], classes: Sequence[str]) -> None:
        """Open the file, or begin it.

        Args:
            path: of the file.
            made_by: all that the detections depend on: weights, precision, region, thresholds; plain values.
            classes: of the detector.

        Raises:
            BeamboxError: if the file holds something else, or detections made otherwise.
        """
        self.path, self.classes = path, tuple(classes)
        header = {"format": FORMAT, **made_by, "classes": list(classes)}
        self.frames: dict[str, Detections] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
        whole = [line for line in lines if line.endswith(b"\n")]
        if whole:
            self._check(self._parse(whole[0], 1), header)
            for number, line in enumerate(whole[1:], 2):
                self._take(self._parse(line, number), number)
        elif lines:
            raise BeamboxError(f"{path} is not a file of kept detections; give another name")
        self._file = path.open("ab")
        os.truncate(path, sum(map(len, whole)))
        if not whole:
            self._append({**header, "beambox": __version__})

    def _parse(self, line: bytes, number: int) -> dict[str, Any]:
        try:
            content = parse_json(line.decode("utf-8"), f"{self.path}, line {number}")
        except UnicodeDecodeError:
            content = None
        if not isinstance(content, dict):
            raise BeamboxError(f"{self.path}, line {number}: expected a JSON object; these are no kept detections")
        return content

    def _check(self, stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
        if stored.get("format") != FORMAT:
            raise BeamboxError(f"{self.path} is not a file of kept detections (no {FORMAT}); give another name")
        differing = [key for key, value in wanted.items() if stored.get(key) != value]
        if differing:
            key = differing[0]
            raise BeamboxError(
                f"{self.path} holds detections made otherwise: {key} was {stored.get(key)}, is {wanted[key]}; "
                "give another name, or remove it"
            )

    def _take(self, entry: Mapping[str, Any], number: int) -> None:
        try:
            boxes = torch.tensor(entry["boxes"], dtype=torch.float32).reshape(-1, 7)
            scores = torch.tensor(entry["scores"], dtype=torch.float32)
            class_ids = torch.tensor(entry["class_ids"], dtype=torch.int64)
            name = check_file_name(entry["frame"], str(self.path))
            finite = bool(torch.isfinite(boxes).all() and torch.isfinite(scores).all())
            self.frames[name] = Detections(boxes, scores, class_ids, self.classes, name)
        except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise BeamboxError(
                f"{self.path}, line {number}: expected frame, boxes, scores, class_ids: {error}"
            ) from None
        if not finite:
            raise BeamboxError(f"{self.path}, line {number}: expected finite boxes and scores")

    def _append(self, content: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(content).encode() + b"\n")
        self._file.flush()

    def detect(
        self, detect: Detect, source: FrameSource, *, batch: int = 1, score_threshold: float = 0.0
    ) -> Iterator[tuple[Frame, Detections]]:
        """Yield each frame with its detections, in order; only frames that the file lacks are detected, then kept.

        Arguments as for :func:`beambox.infer.evaluate.detect_frames`.
        """
        for start in range(0, len(source), batch):
            frames = [source[i] for i in range(start, min(start + batch, len(source)))]
            new = [frame for frame in frames if frame.id not in self.frames]
            for frame, found in zip(new, detect(new) if new else []):
                self._keep(frame, found[found.scores >= score_threshold])
            for frame in frames:
                yield frame, self.frames[frame.id]

    def _keep(self, frame: Frame, found: Detections) -> None:
        values = {"boxes": found.boxes.float(), "scores": found.scores.float(), "class_ids": found.class_ids}
        self._append({"frame": frame.id, **{key: value.tolist() for key, value in values.items()}})
        self.frames[frame.id] = found

    def close(self) -> None:
        """Close the file."""
        self._file.close()
