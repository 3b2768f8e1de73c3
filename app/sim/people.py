"""People: figures that walk scripted or recorded ways.

They have no physical collision; the distance to them is what counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, hypot, sin
from typing import TYPE_CHECKING

from app.sim.occasions import Trigger, mapping, number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.governance.model import Json, Point
    from app.sim.occasions import Occasions
    from app.sim.plant import Plant

PERSON_RADIUS_M = 0.25
_STRIDE_M, _SWING_RAD = 0.75, 0.45


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """One person's way: points in the world frame, walking speed, when it begins, how long to stay at which point.

    `stay_s` maps the index of a point to a pause there. Before the start the person is away; after the last point
    they leave, unless `leaves` is false.
    """

    points: tuple[Point, ...]
    speed_mps: float = 1.2
    start: Trigger = field(default_factory=lambda: Trigger(time_s=0.0))
    stay_s: tuple[tuple[int, float], ...] = ()
    leaves: bool = True

    def __post_init__(self) -> None:
        """Refuse a way that goes nowhere or at no speed."""
        if not self.points or self.speed_mps <= 0:
            raise ValueError("a walk needs at least one point and a speed above 0")

    @classmethod
    def read(cls, data: Json) -> Walk:
        """Read a walk from plain data: points, speed_mps, start, stay_s, leaves.

        Raises:
            ValueError: an unknown key, a value that is none, or a way that goes nowhere.
        """
        fields = dict(mapping(data, "walk"))
        unknown = set(fields) - {"points", "speed_mps", "start", "stay_s", "leaves"}
        if unknown:
            raise ValueError(f"walk key `{min(map(str, unknown))}`: valid are points, speed_mps, start, stay_s, leaves")
        points = fields.get("points")
        if not isinstance(points, list):
            raise ValueError("a walk needs `points`: a list of [x_m, y_m]")
        leaves = fields.get("leaves", True)
        if not isinstance(leaves, bool):
            raise ValueError(f"a walk's `leaves` is `{leaves}`: valid is true or false")
        return cls(
            points=tuple(_point(point) for point in points),
            speed_mps=number(fields.get("speed_mps", 1.2), "a walk's `speed_mps`"),
            start=Trigger.read(fields.get("start", 0.0)),
            stay_s=tuple(
                _stay(at, stay, len(points)) for at, stay in mapping(fields.get("stay_s", {}), "stay_s").items()
            ),
            leaves=leaves,
        )

    def at(self, since_s: float) -> tuple[float, float, float, float] | None:
        """Return x, y, heading and the metres walked `since_s` after the start, or None once they have left."""
        stays, walked, heading = dict(self.stay_s), 0.0, 0.0
        since_s -= stays.get(0, 0.0)
        if since_s <= 0:
            return (*self.points[0], 0.0, 0.0)
        for k, (a, b) in enumerate(zip(self.points, self.points[1:], strict=False), start=1):
            length, heading = hypot(b[0] - a[0], b[1] - a[1]), atan2(b[1] - a[1], b[0] - a[0])
            needed = length / self.speed_mps
            if since_s < needed:
                share = since_s / needed
                return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), heading, walked + share * length
            since_s, walked = since_s - needed, walked + length
            if since_s < stays.get(k, 0.0):
                return (*b, heading, walked)
            since_s -= stays.get(k, 0.0)
        return None if self.leaves else (*self.points[-1], heading, walked)


def _point(data: Json) -> Point:
    if not isinstance(data, list) or len(data) != 2:
        raise ValueError(f"a walk's point is `{data}`: valid is [x_m, y_m]")
    return number(data[0], "a walk's `x_m`"), number(data[1], "a walk's `y_m`")


def _stay(at: object, stay: Json, points: int) -> tuple[int, float]:
    index = str(at)
    if not index.isdecimal() or int(index) >= points:
        raise ValueError(f"a walk stays at the point `{at}`: valid is 0 to {points - 1}, as it has {points} points")
    return int(index), number(stay, f"a walk's stay at point {index}", 0.0)


class People:
    """All walks of a run and where everyone is now."""

    def __init__(self, walks: Sequence[Walk]) -> None:
        """Start with everyone away."""
        self.walks = tuple(walks)
        self.present: dict[int, Point] = {}
        self._moved: set[int] = set(range(len(self.walks)))

    def move(self, time_s: float, occasions: Occasions, plant: Plant) -> None:
        """Put every figure where its walk has it now."""
        for index, walk in enumerate(self.walks):
            due = occasions.due(walk.start)
            at = walk.at(time_s - due) if due is not None and time_s >= due else None
            if at is None:
                if self.present.pop(index, None) is not None or index in self._moved:
                    plant.place_person(index, 0.0, 0.0, 0.0, 0.0, present=False)
                    self._moved.discard(index)
                continue
            x, y, heading, walked = at
            if self.present.get(index) != (x, y):
                plant.place_person(
                    index, x, y, heading, _SWING_RAD * sin(6.28318 * walked / (2 * _STRIDE_M)), present=True
                )
            self.present[index] = (x, y)
            self._moved.add(index)
