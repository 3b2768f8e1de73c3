"""In whose hands a session is, as its document says under `takeover`; what the cell reports moves it on.

| state | means | the cell says | becomes |
|---|---|---|---|
| held | a human has the controls, or is about to | refuses the launch of their driving | gone |
| held, returning | | escalates | lapsed |
| held, returning | | the session's outcome | ended |
| returning | the human gives the session back | binds it anew, or begins the rollback | returned |
| returning | | refuses | held, with the code of why |
| lapsed | nobody has the controls; someone is asked | binds it anew, or begins the rollback | returned |

The agent reads it: codes, numbers and names, never a person's words. `facts` is the state it faces after the takeover.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

from app.governance.model import EventKind, Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.control import Where
    from app.protocol import UpEvent

HELD, RETURNING, LAPSED, RETURNED, ENDED = "held", "returning", "lapsed", "returned", "ended"
HANDED_BACK: Final = frozenset({"handed_back", "ROLLBACK"})  # why a session's status changes when it is given back
OPEN: Final = frozenset({HELD, RETURNING})


def taken(where: Where, at: str) -> dict[str, Any]:
    """Return what a document says once a human has the controls."""
    return {"state": HELD, "where": where, "since": at}


def given_back(takeover: Mapping[str, Any], then: str, facts: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what a document says while a human gives the session back."""
    kept = {key: value for key, value in takeover.items() if key != "refused"}
    return {**kept, "state": RETURNING, "then": then, "facts": None if facts is None else facing(facts)}


def facing(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return of a cell's facts what a plan begins with: where the robot is, what it holds, what is where."""
    objects = cast("dict[str, dict[str, Any]]", facts.get("objects", {}))
    return {
        **{name: facts.get(name) for name in ("base", "holding", "gripper_empty", "arm_retracted", "tools")},
        "objects": {
            name: {key: seen.get(key) for key in ("visible", "reachable", "x_m", "y_m")}
            for name, seen in objects.items()
        },
    }


def followed(takeover: Mapping[str, Any] | None, event: UpEvent) -> Mapping[str, Any] | None:
    """Return what a document says after a report; the very same where the report is not about that."""
    if takeover is None:
        return None
    state, body = takeover["state"], event.body
    match event.kind:
        case EventKind.OUTCOME if state in OPEN or state == LAPSED:
            return {**takeover, "state": ENDED, "facts": body.get("facts") or takeover.get("facts")}
        case EventKind.LAUNCH | EventKind.HUMAN if body.get("refused") and state in OPEN:
            return _refused(takeover, event)
        case EventKind.ESCALATION if state in OPEN:
            return {**takeover, "state": LAPSED}
        case EventKind.STATUS if body.get("reason") in HANDED_BACK and state in (RETURNING, LAPSED):
            begun = body.get("status") == Status.RUNNING or body.get("reason") == "ROLLBACK"
            return {**takeover, "state": RETURNED} if begun else takeover
        case _:
            return takeover


def _refused(takeover: Mapping[str, Any], event: UpEvent) -> Mapping[str, Any] | None:
    """Return what becomes of a refusal: of the driving itself, of the way back, or of something else."""
    if takeover["state"] == RETURNING and (event.kind == EventKind.LAUNCH or event.body.get("op") == "rollback"):
        return {**takeover, "state": HELD, "refused": event.body["refused"]}
    return None if event.kind == EventKind.LAUNCH else takeover
