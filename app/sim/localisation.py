"""Where the robot believes it stands.

Dead reckoning aligned with absolute fixes by an α-β filter, fixes compared at the time they were taken.
"""

from __future__ import annotations

from collections import deque
from math import atan2, cos, sin
from typing import TYPE_CHECKING

from app.governance.model import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from app.governance.model import Fix, Vec3

_ALPHA, _BETA = 0.10, 0.004
_HISTORY_TICKS = 40
_FIX_PERIOD_S = 0.05


class Localiser:
    """Offset between odometry and world, and how fast it drifts."""

    def __init__(self, start: Vec3) -> None:
        """Start without offset: the robot was parked where it knows."""
        self._offset: Vec3 = (0.0, 0.0, 0.0)
        self._rate: Vec3 = (0.0, 0.0, 0.0)
        self._odometry: deque[tuple[float, Vec3]] = deque([(0.0, start)], maxlen=_HISTORY_TICKS)
        self.pose = start  # the estimated pose of the base: x_m, y_m, yaw_rad

    def update(self, time_s: float, odometry: Vec3, fix: Fix | None) -> None:
        """Take this tick's odometry and the fix that arrived in it, if any."""
        (ox, oy, oyaw), (rx, ry, ryaw), dt = self._offset, self._rate, CONTROL_PERIOD_S
        self._offset = ox, oy, oyaw = ox + rx * dt, oy + ry * dt, oyaw + ryaw * dt
        self._odometry.append((time_s, odometry))
        if fix is not None:
            self._correct(time_s, fix)
            ox, oy, oyaw = self._offset
        x, y, yaw = odometry
        self.pose = (x + ox, y + oy, wrapped(yaw + oyaw))

    def _correct(self, time_s: float, fix: Fix) -> None:
        then, late = self._at(fix.stamp_s), time_s - fix.stamp_s
        seen = (fix.x_m, fix.y_m, fix.yaw_rad)
        ex, ey, eyaw = (s - t - (o - r * late) for s, t, o, r in zip(seen, then, self._offset, self._rate, strict=True))
        error = (ex, ey, wrapped(eyaw))
        self._offset = _moved(self._offset, error, _ALPHA)
        self._rate = _moved(self._rate, error, _BETA / _FIX_PERIOD_S)

    def _at(self, time_s: float) -> Vec3:
        for stamp, pose in reversed(self._odometry):
            if stamp <= time_s + 1e-6:
                return pose
        return self._odometry[0][1]


def _moved(at: Vec3, error: Vec3, gain: float) -> Vec3:
    return at[0] + gain * error[0], at[1] + gain * error[1], at[2] + gain * error[2]


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
