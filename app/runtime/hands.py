"""In whose hands a session is, as its document says under `takeover`; what the cell reports moves it on.

| state | means | the cell says | becomes |
|---|---|---|---|
| held | a human has the controls, or is about to | refuses the launch of that | gone; lapsed, if driven before |
| held | | is back, and never had that launch | the same |
| held, returning | | escalates | lapsed |
| held, returning | | the session's outcome | ended |
| returning | the human gives the session back | binds it anew, or begins the rollback | returned |
| returning | | refuses | held, with the code of why |
| lapsed | nobody has the controls; someone is asked | binds it anew, or begins the rollback | returned |
| held, returning, lapsed | | never says how it ended: the server ends it | ended |

The agent reads it: codes, numbers and names, never a person's words. `facts` is the state it faces after the takeover.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, cast

from pydantic import BaseModel, ConfigDict, ValidationError

from app.governance.control import TAKEOVER
from app.governance.model import EventKind, Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.control import Where
    from app.protocol import UpEvent
    from app.runtime.invocation import Invocation, Terms

HELD, RETURNING, LAPSED, RETURNED, ENDED = "held", "returning", "lapsed", "returned", "ended"
ANEW: Final = "handed_back"
HANDED_BACK: Final = frozenset({ANEW, "ROLLBACK"})  # why a session's status changes when it is given back
OPEN: Final = frozenset({HELD, RETURNING})


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class _Seen(_Strict):
    """Where an object is, as far as sensors say."""

    visible: bool = False
    reachable: bool = False
    x_m: float | None = None
    y_m: float | None = None


class _Faced(_Strict):
    """What `facing` returns."""

    base: list[float | None] | None = None
    holding: str | None = None
    gripper_empty: bool = False
    arm_retracted: bool = False
    tools: dict[str, str] | None = None
    objects: dict[str, _Seen] | None = None


def driven(terms: Terms, event: UpEvent) -> Terms:
    """Return the terms after a report: the cell has heard of a takeover, a human drives, or the session is its own."""
    body = event.body
    match event.kind:
        case EventKind.LAUNCH if "refused" in body:
            return replace(terms, taking=False) if terms.taking else terms
        case EventKind.LAUNCH if body.get("capability") == TAKEOVER:
            return replace(terms, taking=False, displaced=True)
        case EventKind.LAUNCH if terms.taking and body.get("permit") == terms.authorization:
            return replace(terms, taking=False)  # what was launched before the takeover may be told of behind it
        case EventKind.STATUS if body.get("reason") == ANEW and body.get("status") == Status.RUNNING:
            return replace(terms, displaced=False)
        case _:
            return terms


def never_taken(present: Invocation, at: str) -> Invocation:
    """Return a session after the launch of a human's driving was lost: in the hands that it was in before."""
    terms, takeover = replace(present.terms, taking=False), present.takeover or {}
    left = {**takeover, "state": LAPSED} if terms.displaced else None
    return present.evolve(at, takeover=left, terms=terms)


def taken(where: Where, at: str) -> dict[str, Any]:
    """Return what a document says once a human has the controls."""
    return {"state": HELD, "where": where, "since": at}


def given_back(takeover: Mapping[str, Any], then: str, facts: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what a document says while a human gives the session back."""
    kept = {key: value for key, value in takeover.items() if key != "refused"}
    return {**kept, "state": RETURNING, "then": then, "facts": None if facts is None else facing(facts)}


def led(takeover: Mapping[str, Any] | None) -> bool:
    """Say whether a human has driven a session which may be its own again: what undoes it goes all their way back."""
    return takeover is not None and takeover["state"] != HELD


def over(takeover: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return what a document says once the session has ended: nobody has its controls any more."""
    if takeover is None or takeover["state"] not in (*OPEN, LAPSED):
        return takeover
    return {**takeover, "state": ENDED}


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
            return {**takeover, "state": ENDED, "facts": _faced(body.get("facts")) or takeover.get("facts")}
        case EventKind.LAUNCH | EventKind.HUMAN if body.get("refused") and state in OPEN:
            return _refused(takeover, event)
        case EventKind.ESCALATION if state in OPEN:
            return {**takeover, "state": LAPSED}
        case EventKind.STATUS if body.get("reason") in HANDED_BACK and state in (RETURNING, LAPSED):
            begun = body.get("status") == Status.RUNNING or body.get("reason") == "ROLLBACK"
            return {**takeover, "state": RETURNED} if begun else takeover
        case _:
            return takeover


def _faced(said: object) -> object:
    """Return what a cell says that the agent faces; None where that is not what `facing` makes of facts."""
    try:
        _Faced.model_validate(said)
    except ValidationError:
        return None
    return said


def _refused(takeover: Mapping[str, Any], event: UpEvent) -> Mapping[str, Any] | None:
    """Return what becomes of a refusal: of the driving itself, of the way back, or of something else."""
    if takeover["state"] == RETURNING and (event.kind == EventKind.LAUNCH or event.body.get("op") == "rollback"):
        return {**takeover, "state": HELD, "refused": event.body["refused"]}
    return None if event.kind == EventKind.LAUNCH else takeover
