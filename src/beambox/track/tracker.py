"""Detections joined over time: predict, match, correct, give birth, let die.

One Kalman filter for each object (:mod:`beambox.track.kalman`); matching is Hungarian on the negative log likelihood of
each detection under each track, class by class, first with the detections sure enough to start a track, then with the
others, which only continue one (as ByteTrack does, Zhang et al., ECCV 2022). The score of a track is the running mean
of its detections' over ``memory`` seconds, a sweep without one counting 0. (Scores are not multiplied up as independent
evidence: what a detector takes for a car in one sweep it takes for a car in the next.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beambox.checks import BeamboxError, import_library
from beambox.structures import Detections
from beambox.track.kalman import BoxFilter
from beambox.track.options import TrackerOptions
from beambox.track.poses import as_pose, carry_boxes, carry_vectors
from beambox.track.tracks import Tracks

__all__ = ["Tracker"]

Floats = NDArray[np.float64]
FORBIDDEN = 1e6
"""Cost of a pair beyond the gate."""


@dataclass
class _Track:
    """One object."""

    id: int
    name: str
    filter: BoxFilter
    score: float
    """Running mean of its detections' scores."""
    seen_score: float
    """Of its last detection."""
    born: float
    seen: float
    confirmed: bool = False


class Tracker:
    """Gives the detections of successive sweeps identities and velocities.

    Needs filterpy and scipy (the extra ``track``). One tracker follows one sensor; sweeps come in order of time.
    """

    def __init__(self, options: TrackerOptions | None = None, *, rate: float = 10.0) -> None:
        """Start without objects.

        Args:
            options: what is assumed of sensor and objects.
            rate: sweeps per second, for sweeps that come without a time.

        Raises:
            BeamboxError: if ``rate`` is not positive, or filterpy or scipy is not installed.
        """
        if not (math.isfinite(rate) and rate > 0):
            raise BeamboxError(f"`rate` must be a positive number of sweeps per second, got {rate}")
        import_library("filterpy.kalman", "track", "tracking")
        self._assign = import_library("scipy.optimize", "track", "tracking").linear_sum_assignment
        self.options = options or TrackerOptions()
        self.rate = rate
        self._next = 1
        self.reset()

    def reset(self) -> None:
        """Forget all objects, as at the start of another drive; identities go on counting."""
        self._tracks: list[_Track] = []
        self._time: float | None = None
        self._fading = 1.0

    def update(
        self, detections: Detections, time: float | None = None, pose: Tensor | Floats | Sequence | None = None
    ) -> Tracks:
        """Take in the detections of the next sweep.

        Args:
            detections: in the LiDAR frame of the sweep.
            time: of the sweep in seconds; 1 / rate after the last one where not given.
            pose: ``(4, 4)`` or ``(3, 4)`` from the LiDAR frame to a fixed one; all sweeps or none have one. Without
                poses, velocities are relative to the sensor, and turning fast costs tracks.

        Returns:
            The confirmed objects, in the LiDAR frame of the sweep, in order of their identity.

        Raises:
            BeamboxError: if the time goes back, a pose is no rigid motion, or a box is not finite.
        """
        now = self._advance(time)
        to_world = as_pose(pose)
        boxes = detections.boxes.detach().cpu().double().numpy()
        scores = detections.scores.detach().cpu().double().numpy()
        if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
            raise BeamboxError("detections for tracking must be finite; leave out boxes with NaN or infinite values")
        boxes, names = carry_boxes(boxes, to_world), np.array(detections.names, dtype=object)
        strong = scores >= self.options.birth_score
        weak = (scores >= self.options.score_threshold) & ~strong
        free = list(self._tracks)
        for kind in (strong, weak):
            free = self._match(free, boxes, scores, names, np.flatnonzero(kind), now)
        self._end(now)
        return self._report(detections, to_world, now)

    def _advance(self, time: float | None) -> float:
        """Predict all objects to the time of the next sweep."""
        last = self._time
        now = float(time) if time is not None else 0.0 if last is None else last + 1 / self.rate
        if not math.isfinite(now) or (last is not None and now < last):
            raise BeamboxError(
                f"sweeps must come in order of time, got {now:g} s after {last if last is not None else 0:g} s; "
                "call reset() where another drive begins"
            )
        elapsed = 0.0 if last is None else now - last
        self._fading = fading = math.exp(-elapsed / self.options.memory)
        for track in self._tracks:
            track.filter.predict(elapsed)
            track.score *= fading
        self._time = now
        return now

    def _match(
        self, free: list[_Track], boxes: Floats, scores: Floats, names: NDArray, rows: NDArray[np.intp], now: float
    ) -> list[_Track]:
        """Match some detections; return the tracks that are still without one. New tracks start from what is left."""
        left: list[_Track] = []
        for name in dict.fromkeys([*(track.name for track in free), *names[rows]]):
            tracks = [track for track in free if track.name == name]
            places = [row for row in rows if names[row] == name]
            pairs = self._pairs(tracks, boxes[places])
            for i, j in pairs.items():
                self._correct(tracks[i], boxes[places[j]], float(scores[places[j]]), now)
            left += [track for i, track in enumerate(tracks) if i not in pairs]
            taken = set(pairs.values())
            for j, row in enumerate(places):
                if j not in taken and scores[row] >= self.options.birth_score:
                    self._begin(name, boxes[row], float(scores[row]), now)
        return left

    def _pairs(self, tracks: list[_Track], boxes: Floats) -> dict[int, int]:
        """Return which track (its position) goes with which detection."""
        if not tracks or not len(boxes):
            return {}
        cost = np.full((len(tracks), len(boxes)), FORBIDDEN)
        for i, track in enumerate(tracks):
            offset = boxes[:, :2] - track.filter.box[:2]  # (D, 2)
            covariance = track.filter.covariance
            squared = np.einsum("di,ij,dj->d", offset, np.linalg.inv(covariance), offset)
            likely = squared + math.log(np.linalg.det(covariance))  # twice the negative log likelihood, less 2 log 2 pi
            cost[i] = np.where(squared <= self.options.gate, likely, FORBIDDEN)
        rows, columns = self._assign(cost)
        return {int(i): int(j) for i, j in zip(rows, columns) if cost[i, j] < FORBIDDEN}

    def _correct(self, track: _Track, box: Floats, score: float, now: float) -> None:
        track.filter.update(box, score)
        track.score += (1 - self._fading) * score
        track.seen, track.seen_score = now, score
        track.confirmed |= track.score >= self.options.confirm_score

    def _begin(self, name: str, box: Floats, score: float, now: float) -> None:
        speed = self.options.speeds.get(name, self.options.speed)
        track = _Track(self._next, name, BoxFilter(box, self.options, speed), score, score, now, now)
        track.confirmed = score >= self.options.confirm_score
        self._next += 1
        self._tracks.append(track)

    def _end(self, now: float) -> None:
        self._tracks = [t for t in self._tracks if t.score >= self.options.death_score or t.seen == now]

    def _report(self, detections: Detections, to_world: Floats, now: float) -> Tracks:
        shown = [t for t in self._tracks if t.confirmed and now - t.seen <= self.options.coast + 1e-9]
        shown.sort(key=lambda track: track.id)
        back = np.linalg.inv(to_world).astype(np.float64)
        boxes = carry_boxes(np.array([t.filter.box for t in shown]).reshape(-1, 7), back)
        velocities = carry_vectors(np.array([t.filter.velocity for t in shown]).reshape(-1, 3), back)
        classes = tuple(dict.fromkeys([*detections.classes, *(t.name for t in shown)]))
        found = Detections(
            torch.from_numpy(boxes).float(),
            torch.tensor([t.seen_score for t in shown], dtype=torch.float32),
            torch.tensor([classes.index(t.name) for t in shown], dtype=torch.int64),
            classes,
        )
        return Tracks(
            replace(found, frame_id=detections.frame_id),
            torch.tensor([t.id for t in shown], dtype=torch.int64),
            torch.from_numpy(velocities).float(),
            torch.tensor([now - t.born for t in shown], dtype=torch.float32),
            torch.tensor([now - t.seen for t in shown], dtype=torch.float32),
            now,
        )
