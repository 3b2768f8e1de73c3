"""What a cell shows to people: its scene once, and while somebody watches, what each moment looks like.

The control loop only hands over references (`look`): copied poses, the observation, the numbers of the tick. Working
them into frames, and sending them, is done on the link's thread (`Drawing`). Nothing here decides anything.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Final, Protocol, cast

from app import protocol
from app.cell.moment import Moment, Session
from app.governance.model import Status
from app.governance.signals import FAR_M, Signals
from app.protocol import Path, Scene, Sitting, pack_poses

if TYPE_CHECKING:
    from app.cell.governing import Governing
    from app.cell.loop import Outbox
    from app.cell.substrate import Substrate
    from app.governance.model import Observation

GAUGES: Final = (
    "separation_m", "protective_separation_m", "zone_margin_m", "tcp_speed_mps", "tcp_speed_limit_mps",
    "base_speed_mps", "base_speed_limit_mps", "grip_force_n", "grip_force_limit_n", "contact_force_n",
    "contact_force_limit_n", "progress", "rate", "base_radius_m", "tcp_x_m", "tcp_y_m",
)  # fmt: skip
"""The gauges of a frame, in order; limits bear the name of what they limit.

The last three say what separation is measured from: the hull, a disc around the base, and the tool, seen from the base.
"""

_ROW: Final = struct.Struct(f"<{len(GAUGES)}f")

UNKNOWN: Final = math.nan


class Socket(Protocol):
    """Where frames are sent."""

    async def send(self, message: str | bytes) -> None:
        """Send one frame."""
        ...


def describe(substrate: Substrate) -> Scene:
    """Return a substrate's scene as it goes up."""
    scene = dict(substrate.scene())
    bodies = cast("list[str]", scene.pop("bodies", []))
    return Scene(scene=scene, bodies=bodies, gauges=list(GAUGES))


def look(substrate: Substrate, seen: Observation, session: Governing | None, at_s: float) -> Moment:
    """Take hold of what there is to be seen; costs the control loop microseconds."""
    if session is None:
        return Moment(at_s, seen.tick, substrate.poses(), seen, None, None, ())
    run = session.run
    numbers = Session(run.watching.measured, run.plan.bounds, run.plan.base_radius_m, run.report.progress, run.rate)
    return Moment(at_s, seen.tick, substrate.poses(), seen, numbers, run.id, substrate.way())


def sitting(session: Governing | None) -> Sitting | None:
    """Return what a session is at; None where there is none."""
    if session is None:
        return None
    run = session.run
    return Sitting(
        profile=run.grant.authorization.profile,
        phase=run.report.phase,
        doing=run.doing.value,
        violated=run.watcher.violated(run.watching),  # what speaks on once it is let go on
        paused_by=sorted(run.paused_by),
        waits_for=run.escalated_by if run.status is Status.ESCALATED else "",  # what was asked last is no question now
    )


class Drawing:
    """Shows a cell over one link: the scene whenever somebody begins to watch, then frames and ways as they come."""

    def __init__(self, outbox: Outbox) -> None:
        """Begin with nothing shown; what is left of an earlier link is old."""
        self._outbox = outbox
        self._described = 0
        self._way: tuple[str | None, tuple[tuple[float, float], ...]] = (None, ())
        self._shown = outbox.moment

    async def show(self, socket: Socket) -> None:
        """Send what there is to be seen, if somebody watches and it is another moment."""
        outbox = self._outbox
        moment = outbox.moment
        if moment is None or moment is self._shown or not outbox.watched:
            return
        self._shown = moment
        if (time := outbox.watched) != self._described and outbox.scene is not None:
            self._described, self._way = time, (None, ())
            await socket.send(protocol.encode(outbox.scene))
        if (moment.invocation, moment.way) != self._way:
            self._way = moment.invocation, moment.way
            await socket.send(protocol.encode(Path(invocation=moment.invocation, points=list(moment.way))))
        await socket.send(frame(moment))


def frame(moment: Moment) -> bytes:
    """Return a moment as a binary frame."""
    return pack_poses(moment.tick, moment.at_s, moment.poses(), _ROW.pack(*map(protocol.single, gauges(moment))))


def sensed(seen: Observation) -> dict[str, float]:
    """Return what sensors say of a robot whose session is over, by the names of the watcher's signals.

    What only the watcher measures (distances, ages, how long it has taken) is not there: nobody watches, and the last
    session's numbers would pass for this moment's.
    """
    return {
        "tcp_speed_mps": seen.tcp_speed_mps,
        "base_speed_mps": math.hypot(seen.base_velocity[0], seen.base_velocity[1]),
        "grip_force_n": seen.grip_force_n,
        "contact_force_n": seen.contact_force_n,
    }


def gauges(moment: Moment) -> tuple[float, ...]:
    """Return the gauges of a moment, as `GAUGES` lists them; NaN is not known.

    Without a session nobody measures how near people and zones are, and nothing is limited.
    """
    seen, session = moment.seen, moment.session
    tool_x_m, tool_y_m, _ = seen.tcp_m
    if session is None:
        known = sensed(seen) | {"tcp_x_m": tool_x_m, "tcp_y_m": tool_y_m}
        return tuple(known.get(name, UNKNOWN) for name in GAUGES)
    signals, bounds = Signals._make(session.measured), session.bounds
    return (
        _near(signals.separation_m),
        signals.protective_separation_m if signals.protective_separation_m > 0.0 else UNKNOWN,
        _near(signals.zone_margin_m),
        signals.tcp_speed_mps,
        bounds.tcp_speed_mps,
        signals.base_speed_mps,
        bounds.base_speed_mps,
        seen.grip_force_n,
        bounds.grip_force_n,
        signals.contact_force_n,
        bounds.contact_force_n,
        session.progress,
        session.rate,
        session.base_radius_m,
        tool_x_m,
        tool_y_m,
    )


def _near(distance_m: float) -> float:
    return distance_m if distance_m < FAR_M else UNKNOWN
