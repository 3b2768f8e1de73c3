"""What a cell says about a session: the bodies of its events, and the rows of its telemetry.

One function per kind of event, so that the whole vocabulary of a trace can be read here. Bodies are JSON objects; a
number that is not finite becomes null, because JSON has none and a guard's broken reading must not break its record.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from app.governance.model import EventKind, Signal, Strategy
from app.protocol import HAND, HAND_PART, ROW, ROWS_PER_BATCH, SENSED_PART, single

if TYPE_CHECKING:
    from app.governance.model import (
        Alert,
        Authorization,
        Intervention,
        Json,
        Observation,
        Outcome,
        Status,
        WatchPlan,
        Wish,
        WorldFacts,
    )
    from app.governance.recovery import RecoveryDecision

CELL: Final = "cell"
BATCH_BYTES: Final = ROW.size * ROWS_PER_BATCH
NO_HAND: Final = HAND_PART.pack(*(0.0 for _ in HAND))


class Saying(NamedTuple):
    """One entry before it has a number and a time."""

    kind: str
    invocation: str | None
    actor: str
    body: dict[str, Json]


def launch(permit: Authorization) -> Saying:
    """The permit is used up and its capability is about to be bound."""
    body: dict[str, Json] = {
        "permit": permit.id,
        "capability": permit.capability,
        "profile": permit.profile,
        "policy_digest": permit.policy_digest,
        "params": dict(permit.params),
        "mode": permit.mode.value,
        "recoveries": [f"{one.strategy}:{one.capability}" for one in permit.recoveries],
    }
    return Saying(EventKind.LAUNCH, permit.invocation, CELL, body)


def launch_refused(invocation: str | None, code: str, detail: str, permit: str | None = None) -> Saying:
    """An authorization, the `permit` where that is known, was not good enough; nothing moved."""
    which: dict[str, Json] = {} if permit is None else {"permit": permit}
    return Saying(EventKind.LAUNCH, invocation, CELL, {**which, "refused": code, "detail": detail})


def status(invocation: str, now: Status, before: Status | None, reason: str) -> Saying:
    """The session has another status."""
    body: dict[str, Json] = {"status": now.value, "before": None if before is None else before.value, "reason": reason}
    return Saying(EventKind.STATUS, invocation, CELL, body)


def alert(invocation: str, said: Alert, stale: tuple[str, ...]) -> Saying:
    """A watch rule has begun to be violated."""
    body = _alert(said)
    if stale:
        body["stale"] = list(stale)
    return Saying(EventKind.ALERT, invocation, CELL, body)


def quiet(invocation: str, rule: str) -> Saying:
    """A watch rule has not been violated for a while."""
    return Saying(EventKind.ALERT, invocation, CELL, {"signal": Signal.NORMAL.value, "rule": rule})


def completion(invocation: str, doing: str, plan: WatchPlan) -> Saying:
    """What was bound is done, and its postconditions were verified."""
    body: dict[str, Json] = {
        "signal": Signal.COMPLETION.value,
        "rule": "watch/completion",
        "of": doing,
        "capability": plan.capability,
        "verified": list(plan.postconditions),
    }
    return Saying(EventKind.ALERT, invocation, CELL, body)


def intervention(invocation: str, what: Intervention, because: Alert) -> Saying:
    """The watcher's word has a consequence."""
    body: dict[str, Json] = {"intervention": what.value, **_alert(because)}
    return Saying(EventKind.INTERVENTION, invocation, CELL, body)


def escalation(invocation: str, reason: str, failed: str, *, paused: bool) -> Saying:
    """The session waits for a human, and somebody has `paused` it already."""
    body: dict[str, Json] = {"reason": reason, "failure": failed or None}
    if paused:
        body["paused"] = True
    return Saying(EventKind.ESCALATION, invocation, CELL, body)


def recovery(invocation: str, decision: RecoveryDecision, unmet: tuple[str, ...]) -> Saying:
    """What is tried about a failure, decided before it moves."""
    cover = decision.covered
    body: dict[str, Json] = {
        "failure": decision.failure,
        "strategy": decision.strategy.value,
        "reason": decision.reason,
        "capability": None if cover is None else cover.capability,
        "params": {} if cover is None else dict(cover.params),
        "retries": decision.used.retries,
        "unmet": list(unmet),
    }
    return Saying(EventKind.RECOVERY, invocation, CELL, body)


def asked_again(invocation: str, failed: str) -> Saying:
    """A human let a session that had failed try again."""
    body: dict[str, Json] = {
        "failure": failed,
        "strategy": Strategy.RETRY.value,
        "reason": "operator",
    }
    return Saying(EventKind.RECOVERY, invocation, CELL, body)


def human(invocation: str, op: str, actor: str, refused: str | None, *, expired: bool = False) -> Saying:
    """An operator said something, or nobody did in time (`expired`), and whether it was done."""
    body: dict[str, Json] = {"op": op, "done": refused is None, "refused": refused}
    return Saying(EventKind.HUMAN, invocation, actor, {**body, "expired": True} if expired else body)


def jog(invocation: str, actor: str, number: int, wish: Wish, refused: str) -> Saying:
    """A human at the controls wants something else than before; what moved stands in the telemetry, tick by tick."""
    body: dict[str, Json] = {
        "op": "jog",
        "n": number,
        "base": list(wish.base),
        "tool": list(wish.tool),
        "grip": wish.grip,
        "done": not refused,
        "refused": refused or None,
    }
    return Saying(EventKind.HUMAN, invocation, actor, body)


def facing(facts: WorldFacts) -> dict[str, Json]:
    """Return the state that whoever gets the robot back now faces, as numbers and names."""
    return {
        "base": [_finite(value) for value in facts.base],
        "holding": facts.holding,
        "gripper_empty": facts.gripper_empty,
        "arm_retracted": facts.arm_retracted,
        "objects": {
            name: {
                "visible": seen.visible,
                "reachable": seen.reachable,
                "x_m": _finite(seen.x_m),
                "y_m": _finite(seen.y_m),
            }
            for name, seen in facts.objects.items()
        },
        "tools": dict(facts.tools),
    }


def cell(what: str, actor: str, detail: str = "") -> Saying:
    """Something about the cell itself."""
    return Saying(EventKind.CELL, None, actor, {"what": what, "detail": detail})


def outcome(invocation: str, label: Outcome, code: str, **facts: Json) -> Saying:
    """The session has ended."""
    return Saying(EventKind.OUTCOME, invocation, CELL, {"outcome": label.value, "code": code, **facts})


def _alert(said: Alert) -> dict[str, Json]:
    return {
        "signal": said.signal.value,
        "rule": said.rule,
        "value": _finite(said.value),
        "threshold": _finite(said.threshold),
        "failure": said.failure,
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def row(seen: Observation, measured: tuple[float, ...], progress: float, rate: float, base_radius_m: float) -> bytes:
    """Pack what was sensed in one control tick, as `protocol.SENSED` lists it; `measured` are the values of `Signals`.

    `base_radius_m` is the hull that separation was measured from.

    A reading that single precision cannot hold is kept as an infinite one: what judges it is the watcher, not this.
    """
    try:
        return _packed(seen, measured, progress, rate, base_radius_m)
    except OverflowError:
        held = seen._replace(
            tcp_m=_held(seen.tcp_m),
            joint_rad=_held(seen.joint_rad),
            tcp_speed_mps=single(seen.tcp_speed_mps),
            peak_force_n=single(seen.peak_force_n),
            grip_width_m=single(seen.grip_width_m),
            grip_force_n=single(seen.grip_force_n),
        )
        return _packed(held, _held(measured), single(progress), single(rate), base_radius_m)


def hand(asked: Wish, *, counts: bool) -> bytes:
    """Pack what a human at the controls asks for in one control tick, as `protocol.HAND` lists it.

    What single precision cannot hold is kept as infinite: anybody may ask for it, and nobody gets it.
    """
    grip = {None: 0.0, "open": 1.0, "close": -1.0}[asked.grip]
    return HAND_PART.pack(*map(single, (*asked.base, *asked.tool)), grip, float(counts))


def _held(readings: tuple[float, ...]) -> Any:  # noqa: ANN401  # as many as there were
    return tuple(map(single, readings))


def _packed(
    seen: Observation, measured: tuple[float, ...], progress: float, rate: float, base_radius_m: float
) -> bytes:
    tcp_x, tcp_y, tcp_z = seen.tcp_m
    q1, q2, q3, q4, q5, q6 = seen.joint_rad  # by name: a starred argument costs a third more
    (
        force, residual, _, base_speed, margin, separation, _, _, _, slip, _, _, _, _, _, _, _, protective, _, _,
        base_x, base_y, base_yaw, _,
    ) = measured  # fmt: skip
    return SENSED_PART.pack(
        seen.time_s,
        base_x,
        base_y,
        base_yaw,
        base_speed,
        tcp_x,
        tcp_y,
        tcp_z,
        seen.tcp_speed_mps,
        force,
        seen.peak_force_n,
        seen.grip_width_m,
        seen.grip_force_n,
        slip,
        residual,
        separation,
        protective,
        margin,
        progress,
        rate,
        q1,
        q2,
        q3,
        q4,
        q5,
        q6,
        base_radius_m,
    )
