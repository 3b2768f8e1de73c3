"""Where the robot believes it stands.

Dead reckoning aligned with absolute fixes by an α-β filter, fixes compared at the time they were taken.
"""

from __future__ import annotations

from collections import deque
from math import atan2, cos, sin
from typing import TYPE_CHECKING

import numpy as np

from app.governance.model import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from app.governance.model import Fix, Vec3

    Floats = NDArray[np.float64]

_ALPHA, _BETA = 0.10, 0.004
_HISTORY_TICKS = 40
_FIX_PERIOD_S = 0.05


class Localiser:
    """Offset between odometry and world, and how fast it drifts."""

    def __init__(self, start: Vec3) -> None:
        """Start without offset: the robot was parked where it knows."""
        self._offset = np.zeros(3)
        self._rate = np.zeros(3)
        self._odometry: deque[tuple[float, Floats]] = deque([(0.0, np.array(start))], maxlen=_HISTORY_TICKS)

    def update(self, time_s: float, odometry: Floats, fix: Fix | None) -> None:
        """Take this tick's odometry and the fix that arrived in it, if any."""
        self._offset += self._rate * CONTROL_PERIOD_S
        self._odometry.append((time_s, odometry.copy()))
        if fix is None:
            return
        then = self._at(fix.stamp_s)
        seen = np.array((fix.x_m, fix.y_m, fix.yaw_rad))
        error = seen - then - (self._offset - self._rate * (time_s - fix.stamp_s))
        error[2] = wrapped(error[2])
        self._offset += _ALPHA * error
        self._rate += _BETA / _FIX_PERIOD_S * error

    def _at(self, time_s: float) -> Floats:
        for stamp, pose in reversed(self._odometry):
            if stamp <= time_s + 1e-6:
                return pose
        return self._odometry[0][1]

    @property
    def pose(self) -> Vec3:
        """The estimated pose of the base: x_m, y_m, yaw_rad."""
        x, y, yaw = self._odometry[-1][1] + self._offset
        return float(x), float(y), wrapped(float(yaw))


def wrapped(angle_rad: float) -> float:
    """Return the angle within (-π, π]."""
    return atan2(sin(angle_rad), cos(angle_rad))


def to_base(pose: Vec3, x_m: float, y_m: float) -> tuple[float, float]:
    """Express a point of the world relative to the base at `pose`."""
    dx, dy, c, s = x_m - pose[0], y_m - pose[1], cos(pose[2]), sin(pose[2])
    return c * dx + s * dy, -s * dx + c * dy


def to_world(pose: Vec3, x_m: float, y_m: float) -> tuple[float, float]:
    """Express a point relative to the base at `pose` in the world."""
    c, s = cos(pose[2]), sin(pose[2])
    return pose[0] + c * x_m - s * y_m, pose[1] + s * x_m + c * y_m
