"""Paths and how they are travelled: geometry with one parameter, timed by ruckig along that parameter.

One degree of freedom along the path keeps the robot on it whatever the rate does: `Travel.advance` moves time by
`rate` control periods, so a rate of 0 stands still on the path and power stays on. Limits per axis would let a
diagonal exceed the speed; along the path they cannot.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from math import hypot
from operator import sub
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import ruckig

from app.governance.model import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

ARM_ACCELERATION, ARM_JERK = 1.2, 10.0
BASE_ACCELERATION, BASE_JERK = 0.8, 4.0
APART_M, BACK = 0.05, -0.5  # a turn of more than 120 degrees leads back
MARGIN = 0.95  # skills drive below the limit: the truth overshoots a command by up to some percent


class Limits(NamedTuple):
    """Speed, acceleration and jerk along a path, metres and seconds."""

    speed_mps: float
    acceleration_mps2: float
    jerk_mps3: float


class Path:
    """Way points joined by straight lines in their own space, with metres along the way as parameter."""

    def __init__(self, points: Sequence[Sequence[float] | Floats], metres: Sequence[float]) -> None:
        """Take n points and the n - 1 lengths between them."""
        kept = [0] + [k + 1 for k, length in enumerate(metres) if length > 1e-9]
        spans = [float(metres[k - 1]) for k in kept[1:]]
        self._at = [0.0, *itertools.accumulate(spans)]
        self.length_m = self._at[-1]
        # Plain numbers: one point of few coordinates per tick is cheaper so than as an array.
        self._points: list[list[float]] = np.array([points[k] for k in kept], dtype=np.float64).tolist()
        self._steps = [list(map(sub, b, a)) for a, b in itertools.pairwise(self._points)]

    def sample(self, metres: float) -> tuple[list[float], list[float]]:
        """Return the point at `metres` along the way and the direction there (per metre)."""
        if not self._steps:
            return self._points[0], [0.0] * len(self._points[0])
        k = min(max(bisect_right(self._at, metres) - 1, 0), len(self._steps) - 1)
        span = self._at[k + 1] - self._at[k]
        share = min(max((metres - self._at[k]) / span, 0.0), 1.0)
        step = self._steps[k]
        return [p + share * s for p, s in zip(self._points[k], step, strict=True)], [s / span for s in step]


def reversals(points: Sequence[Floats]) -> list[int]:
    """Return where a way turns back on itself, as indices; what is nearer than `APART_M` may be noise and is no turn.

    Args:
        points: the way, of which the first two coordinates count (metres).
    """
    anchors, turns = [0], list[int]()
    for k, point in enumerate(points):
        if hypot(*(point - points[anchors[-1]])[:2]) < APART_M:
            continue
        anchors.append(k)
        if len(anchors) < 3:
            continue
        a, b, c = anchors[-3:]
        before, after = (points[b] - points[a])[:2], (points[c] - points[b])[:2]
        if float(before @ after) < BACK * hypot(*before) * hypot(*after):
            turns.append(max(range(b, c), key=lambda k, a=a: hypot(*(points[k] - points[a])[:2])))
            anchors[-2:] = [turns[-1], c]
    return turns


class Travel:
    """One rest-to-rest journey along a path."""

    def __init__(self, path: Path, limits: Limits) -> None:
        """Time the journey with ruckig."""
        self.path = path
        self.metres = 0.0  # along the path, so far
        self._time_s = 0.0
        self._trajectory = ruckig.Trajectory(1)
        self.duration_s = 0.0
        if path.length_m > 1e-9:
            wish = ruckig.InputParameter(1)
            wish.current_position, wish.target_position = [0.0], [path.length_m]
            wish.max_velocity, wish.max_acceleration, wish.max_jerk = (
                [limits.speed_mps],
                [limits.acceleration_mps2],
                [limits.jerk_mps3],
            )
            result = ruckig.Ruckig(1).calculate(wish, self._trajectory)
            if result not in (ruckig.Result.Working, ruckig.Result.Finished):
                raise ValueError(f"no timing for {path.length_m:.3f} m within {limits}: {result}")
            self.duration_s = float(self._trajectory.duration)

    @property
    def done(self) -> bool:
        """Whether the end is reached."""
        return self._time_s >= self.duration_s

    @property
    def progress(self) -> float:
        """Share of the journey's time that has passed."""
        return 1.0 if self.duration_s == 0.0 else min(self._time_s / self.duration_s, 1.0)

    def advance(self, rate: float) -> tuple[list[float], list[float]]:
        """Move on by `rate` control periods and return point and velocity there."""
        self._time_s = min(self._time_s + rate * CONTROL_PERIOD_S, self.duration_s)
        if self.duration_s == 0.0:
            return self.path.sample(0.0)
        position, velocity, _ = self._trajectory.at_time(self._time_s)
        self.metres = position[0]
        point, direction = self.path.sample(self.metres)
        speed = velocity[0] * rate
        return point, [slope * speed for slope in direction]
