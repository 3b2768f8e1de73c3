"""What there is to be seen of a cell at one moment: handed from the control loop to the link by reference."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.governance.model import Bounds, Observation, PersonTrack


class Session(NamedTuple):
    """The numbers of a session at one moment: what watching measured, the limits, how far and how fast it is.

    `base_radius_m` is the hull that the watcher measures distances from.
    """

    measured: tuple[float, ...]
    bounds: Bounds
    base_radius_m: float
    progress: float
    rate: float


class Moment(NamedTuple):
    """Everything to be seen at one moment, by reference."""

    at_s: float
    tick: int
    poses: Callable[[], bytes]
    seen: Observation
    session: Session | None
    invocation: str | None
    way: tuple[tuple[float, float], ...]


class Sight(NamedTuple):
    """What there is to be seen of a session at one moment, by reference; times in seconds of the cell."""

    invocation: str
    time_s: float
    people: tuple[PersonTrack, ...]
    poses: Callable[[], bytes]
