"""Where the robot believes it stands.

Dead reckoning, turned by what is known of its heading, plus an offset that absolute fixes teach. Three facts make it
exact enough to dock:

1. Wheels say how far and in which direction *relative to the robot*. Odometry adds that up along a heading of its own,
   which wanders off; a heading that is 0.05 rad wrong makes 3 cm/s of sideways error at 0.6 m/s, and that error changes
   with every start, stop and bend. So each step of the odometry is turned by the known heading error before it is added
   up, and what is left to be learnt changes slowly.
2. A fix is late. It is compared with the dead reckoning of the moment it was taken at, between two ticks if need be.
3. What is left goes to a Kalman filter of (offset, rate) per coordinate (constant velocity; Bar-Shalom, Li, Kirubarajan
   2001, §6.2). It expects the rate to change as the base moves and hardly while it rests, so its gains sink on arrival.
   A rate that appears at once, as from a broken odometry, shows as misses that agree in sign; they open the filter.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import atan2, cos, hypot, inf, sin, sqrt
from typing import TYPE_CHECKING, Final

from app.governance.model import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from app.governance.model import Fix, Vec3

HISTORY_TICKS: Final = 120
"""How many ticks of dead reckoning are kept; a fix older than that can be compared with nothing and is not used."""

_MISS_SHARE: Final = 0.25  # of each miss in their running mean
_MISS_SIGMAS: Final = 4.0  # so far from zero the running mean is once in 16,000 fixes that are as expected


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What one coordinate's filter expects; SI units, metres or radians.

    Attributes:
        fix_sigma: σ of a fix.
        first_sigma: σ of the offset at the start, where the robot knows where it was parked.
        first_rate_sigma: σ of the offset's rate at the start.
        offset_noise_ps: variance the offset gains per second by itself.
        rate_noise_ps: variance the rate gains per second, moving or not.
        rate_noise_pm: variance the rate gains per metre driven.
        new_rate_sigma: σ of a rate that appears at once.
    """

    fix_sigma: float
    first_sigma: float
    first_rate_sigma: float
    offset_noise_ps: float
    rate_noise_ps: float
    rate_noise_pm: float
    new_rate_sigma: float


ALONG: Final = Expectation(
    fix_sigma=0.02,
    first_sigma=0.01,
    first_rate_sigma=0.005,
    offset_noise_ps=1e-7,
    rate_noise_ps=1e-5,
    rate_noise_pm=1e-5,
    new_rate_sigma=0.1,
)
TURNED: Final = Expectation(
    fix_sigma=0.005,
    first_sigma=0.01,
    first_rate_sigma=0.002,
    offset_noise_ps=1e-8,
    rate_noise_ps=1e-7,
    rate_noise_pm=1e-5,
    new_rate_sigma=0.02,
)


class Drift:
    """How far dead reckoning is off in one coordinate, and how fast that grows: a Kalman filter."""

    def __init__(self, expected: Expectation) -> None:
        """Start without offset."""
        self.offset: float = 0.0
        self.rate: float = 0.0
        self._expected = expected
        self._offset_var: float = expected.first_sigma**2
        self._both_var: float = 0.0
        self._rate_var: float = expected.first_rate_sigma**2
        self._miss: float = 0.0  # running mean of misses, in σ

    def pass_by(self, seconds: float) -> None:
        """Let time pass."""
        self.offset += self.rate * seconds

    def correct(self, miss: float, seconds: float, metres: float) -> None:
        """Learn from a fix.

        Args:
            miss: how far the fix lay from where it was expected.
            seconds: since the last fix.
            metres: driven since then.
        """
        expected = self._expected
        self._offset_var += seconds * (2.0 * self._both_var + seconds * self._rate_var + expected.offset_noise_ps)
        self._both_var += seconds * self._rate_var
        self._rate_var += seconds * expected.rate_noise_ps + metres * expected.rate_noise_pm
        of_miss = self._offset_var + expected.fix_sigma**2
        self._miss += _MISS_SHARE * (miss / sqrt(of_miss) - self._miss)
        if abs(self._miss) > _MISS_SIGMAS * sqrt(_MISS_SHARE / (2.0 - _MISS_SHARE)):
            self._rate_var, self._miss = self._rate_var + expected.new_rate_sigma**2, 0.0
        of_offset, of_rate = self._offset_var / of_miss, self._both_var / of_miss
        self.offset += of_offset * miss
        self.rate += of_rate * miss
        self._rate_var -= of_rate * self._both_var
        self._offset_var, self._both_var = (1.0 - of_offset) * self._offset_var, (1.0 - of_offset) * self._both_var


class Localiser:
    """Dead reckoning with its heading put right, and how far it is off."""

    def __init__(self, start: Vec3) -> None:
        """Start without offset: the robot was parked where it knows."""
        self._x, self._y, self._yaw = Drift(ALONG), Drift(ALONG), Drift(TURNED)
        self._odometry: Vec3 = start
        self._reckoned: Vec3 = start
        self._history: deque[tuple[float, Vec3]] = deque([(0.0, start)], maxlen=HISTORY_TICKS)
        self._fixed_s: float = 0.0
        self._driven_m: float = 0.0
        self.pose: Vec3 = start  # the estimated pose of the base: x_m, y_m, yaw_rad

    def update(self, time_s: float, odometry: Vec3, fix: Fix | None) -> None:
        """Take this tick's odometry and the fix that arrived in it, if any."""
        for drift in (self._x, self._y, self._yaw):
            drift.pass_by(CONTROL_PERIOD_S)
        self._reckon(odometry)
        self._history.append((time_s, self._reckoned))
        if fix is not None and fix.stamp_s >= self._history[0][0]:
            self._correct(time_s, fix)
        x, y, yaw = self._reckoned
        self.pose = (x + self._x.offset, y + self._y.offset, wrapped(yaw + self._yaw.offset))

    def _reckon(self, odometry: Vec3) -> None:
        x, y, yaw = self._reckoned
        dx, dy = odometry[0] - self._odometry[0], odometry[1] - self._odometry[1]
        turn = wrapped(odometry[2] - self._odometry[2])
        c, s = cos(self._yaw.offset), sin(self._yaw.offset)
        self._reckoned = (x + c * dx - s * dy, y + s * dx + c * dy, yaw + turn)
        self._driven_m += hypot(dx, dy)
        self._odometry = odometry

    def _correct(self, time_s: float, fix: Fix) -> None:
        late_s, (x, y, yaw) = time_s - fix.stamp_s, self._at(fix.stamp_s)
        passed_s, self._fixed_s = time_s - self._fixed_s, time_s
        driven_m, self._driven_m = self._driven_m, 0.0
        for drift, off in ((self._x, fix.x_m - x), (self._y, fix.y_m - y), (self._yaw, fix.yaw_rad - yaw)):
            miss = off - (drift.offset - drift.rate * late_s)
            drift.correct(wrapped(miss) if drift is self._yaw else miss, passed_s, driven_m)

    def _at(self, time_s: float) -> Vec3:
        """Return the dead reckoning at a moment that it was kept for, between two ticks."""
        later_s, later = inf, self._reckoned
        for earlier_s, earlier in reversed(self._history):
            if earlier_s <= time_s:
                share = (time_s - earlier_s) / (later_s - earlier_s)
                x, y, yaw = (a + share * (b - a) for a, b in zip(earlier, later, strict=True))
                return x, y, yaw
            later_s, later = earlier_s, earlier
        return later


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
