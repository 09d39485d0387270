"""A Kalman filter on boxes that move with constant velocity (filterpy).

The state is x, y, z, yaw, l, w, h, vx, vy, vz; a detection measures the first seven. It follows AB3DMOT (Weng et al.,
IROS 2020), with process noise that depends on the time between sweeps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from beambox.checks import import_library
from beambox.geometry.angles import wrap
from beambox.track.options import TrackerOptions

__all__ = ["BoxFilter"]

Floats = NDArray[np.float64]
YAW, STATE, MEASURED = 3, 10, 7
ORDER = [0, 1, 2, 6, 3, 4, 5]
"""Columns of a box in the order of the state: x, y, z, yaw, l, w, h."""


class BoxFilter:
    """Place, heading, size and velocity of one object."""

    def __init__(self, box: Floats, options: TrackerOptions, speed: float) -> None:
        """Start from a detection.

        Args:
            box: ``(7,)`` x, y, z, l, w, h, yaw; metres, radians.
            options: of the tracker.
            speed: standard deviation of the velocity along each axis, metres per second.
        """
        self.options = options
        self._kalman = import_library("filterpy.kalman", "track", "tracking").KalmanFilter(dim_x=STATE, dim_z=MEASURED)
        self._kalman.H = np.eye(MEASURED, STATE)
        noise = [options.position_noise] * 3 + [options.heading_noise] + [options.size_noise] * 3
        self._kalman.R = np.diag(np.square(noise))
        self._kalman.x = np.concatenate((box[ORDER], np.zeros(3)))[:, None]
        self._kalman.P = np.diag(np.square([*noise, speed, speed, min(speed, 1.0)]))
        self._votes = 0.0

    @property
    def box(self) -> Floats:
        """``(7,)`` x, y, z, l, w, h, yaw."""
        x, y, z, yaw, length, width, height = self._kalman.x[:MEASURED, 0]
        return np.array([x, y, z, length, width, height, wrap(yaw)])

    @property
    def velocity(self) -> Floats:
        """``(3,)`` metres per second."""
        return self._kalman.x[MEASURED:, 0].copy()

    @property
    def covariance(self) -> Floats:
        """``(2, 2)`` of where a detection is expected, in BEV: of the state and of the detection together."""
        return self._kalman.P[:2, :2] + self._kalman.R[:2, :2]

    def predict(self, seconds: float) -> None:
        """Move on in time."""
        if seconds <= 0:
            return
        transition = np.eye(STATE)
        transition[[0, 1, 2], [7, 8, 9]] = seconds
        noise = np.zeros((STATE, STATE))
        power = self.options.acceleration**2
        for axis in range(3):  # white noise acceleration, constant within a step
            variance = power if axis < 2 else power / 16  # roads are flatter than they are straight
            noise[axis, axis] = variance * seconds**4 / 4
            noise[axis, axis + 7] = noise[axis + 7, axis] = variance * seconds**3 / 2
            noise[axis + 7, axis + 7] = variance * seconds**2
        noise[YAW, YAW] = self.options.turn**2 * seconds
        noise[[4, 5, 6], [4, 5, 6]] = 0.1**2 * seconds  # sizes seen better as the object comes nearer
        self._kalman.predict(F=transition, Q=noise)

    def update(self, box: Floats, score: float) -> None:
        """Take in a detection.

        Detectors confuse front and rear: a heading that differs by more than 90 degrees is turned round, and once the
        scores of such detections outweigh the others the object is.
        """
        measured = box[ORDER]
        difference = wrap(float(measured[0 + YAW] - self._kalman.x[YAW, 0]))
        turned = abs(difference) > math.pi / 2
        self._votes += -score if turned else score
        if turned:
            difference = wrap(difference + math.pi)
        measured[YAW] = self._kalman.x[YAW, 0] + difference
        self._kalman.update(measured[:, None])
        self._kalman.x[4:7, 0] = np.maximum(self._kalman.x[4:7, 0], 0.01)
        if self._votes < 0:
            self._kalman.x[YAW, 0] += math.pi
            self._votes = -self._votes
        self._kalman.x[YAW, 0] = wrap(self._kalman.x[YAW, 0])
