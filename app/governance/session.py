"""The session: six statuses, the events that lead from one to the next, and nothing else.

A session begins at launch, in RUNNING, and ends in COMPLETED or FAILED (paper, Stage 5). In between it is in one of
four ways alive:

* RUNNING: the authorized capability moves, or waits only for itself; so does a human's driving after `TAKE_OVER`,
  which is a capability with an authorization of its own.
* PAUSED: held in place with power kept (IEC 60204-1, category 2), by a watch rule or an operator; it may go on when
  the cause is gone.
* ESCALATED: held in the same way, but nothing short of a human's word lets it go on.
* RECOVERING: a recovery that the authorization covers moves (release and retract, a rollback, the way to a retry).

What may happen is the table below: a cell that is missing is a transition that must not exist, and raises. Restraint
is never missing: every living status has a cell for `PAUSE`, `ESCALATE`, `STOP` and `FAIL`, because refusing to
restrain for reasons of bookkeeping would be the one unforgivable bug. Going on is the opposite, each way of it
appears exactly once: `RESUME` and `RESUME_RECOVERY` leave PAUSED, `CONTINUE` and `CONTINUE_RECOVERY` leave ESCALATED.
`TAKE_OVER` goes on with nothing: it puts a human's hand in the place of what ran, whatever the session was doing. What
it was doing goes on only as a new attempt (`RECOVER`, `RECOVERED`), bound anew.
A terminal status absorbs every event, so a late word cannot raise the dead.

Which label a session ends with (`succeeded`, `recovered`, `stopped`, …) is the outcome's business; COMPLETED holds
`succeeded` and `recovered`, every other outcome is FAILED, a verified rollback included: the world is safe again, but
what was asked for was not done.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from app.governance.errors import GovernanceError
from app.governance.model import Outcome, Status


class Event(StrEnum):
    """What can happen to a session."""

    PAUSE = "pause"
    RESUME = "resume"
    RESUME_RECOVERY = "resume_recovery"
    ESCALATE = "escalate"
    CONTINUE = "continue"
    CONTINUE_RECOVERY = "continue_recovery"
    RECOVER = "recover"
    RECOVERED = "recovered"
    TAKE_OVER = "take_over"
    COMPLETE = "complete"
    STOP = "stop"
    FAIL = "fail"


class SessionError(GovernanceError):
    """An event that the session's status has no cell for.

    Attributes:
        status: The status it met.
        event: The event.
    """

    def __init__(self, status: Status, event: Event) -> None:
        """Keep the facts and list what would be valid."""
        self.status, self.event = status, event
        valid = ", ".join(f"`{known}`" for known in TABLE.get(status, {})) or "nothing: it is no status of a session"
        super().__init__(f"a session in `{status}` cannot take `{event}`; valid: {valid}")


_ALIVE: Final = {
    Event.STOP: Status.FAILED,
    Event.FAIL: Status.FAILED,
    Event.ESCALATE: Status.ESCALATED,
    Event.TAKE_OVER: Status.RUNNING,
}

TABLE: Final[dict[Status, dict[Event, Status]]] = {
    Status.RUNNING: {
        **_ALIVE,
        Event.PAUSE: Status.PAUSED,
        Event.RECOVER: Status.RECOVERING,
        Event.COMPLETE: Status.COMPLETED,
    },
    Status.PAUSED: {
        **_ALIVE,
        Event.PAUSE: Status.PAUSED,
        Event.RESUME: Status.RUNNING,
        Event.RESUME_RECOVERY: Status.RECOVERING,
        Event.RECOVER: Status.RECOVERING,
    },
    Status.ESCALATED: {
        **_ALIVE,
        Event.PAUSE: Status.ESCALATED,  # it is held already, and a human was asked
        Event.CONTINUE: Status.RUNNING,
        Event.CONTINUE_RECOVERY: Status.RECOVERING,
        Event.RECOVER: Status.RECOVERING,
    },
    Status.RECOVERING: {
        **_ALIVE,
        Event.PAUSE: Status.PAUSED,
        Event.RECOVER: Status.RECOVERING,  # a recovery failed, the next one begins
        Event.RECOVERED: Status.RUNNING,
    },
    Status.COMPLETED: dict.fromkeys(Event, Status.COMPLETED),
    Status.FAILED: dict.fromkeys(Event, Status.FAILED),
}
"""Status × event → status. Read a row as: what a session in this status can live through."""


def step(status: Status, event: Event) -> Status:
    """Return the status after an event.

    Raises:
        SessionError: the table has no such cell.
    """
    try:
        return TABLE[status][event]
    except KeyError:
        raise SessionError(status, event) from None


def accepts(status: Status, event: Event) -> bool:
    """Say whether the table has the cell."""
    return event in TABLE.get(status, {})


def refused_launch(code: str) -> Outcome:
    """Return how a session ended that its cell would not begin: where a stop came first, it was stopped."""
    return Outcome.STOPPED if code == "estop_latched" else Outcome.FAULT


def final_status(outcome: Outcome) -> Status:
    """Return the terminal status that an outcome of a session belongs to."""
    return Status.COMPLETED if outcome in (Outcome.SUCCEEDED, Outcome.RECOVERED) else Status.FAILED
