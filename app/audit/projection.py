"""The table `invocations`, made again from the log, to see that it says nothing else.

The table is state: nobody signs it, and what is listed is read from it. What the log states of an invocation is folded
event by event:

| event | states |
|---|---|
| proposal | who proposes what, and when: capability, agent, requested and (until policy) effective parameters |
| human, `takeover` of an idle cell | the same of a driving, but for its parameters and the time |
| admission, policy | cell, profile, policy version, status, effective parameters, what both said (not a mere check \
of what was approved); nothing once it was authorized |
| approval | the effective parameters, which an approver may have edited, and what policy says of the edit |
| authorization, the first | that it runs, with exactly those parameters |
| cell, the server's `not_sent` with an authorization | the policy version that it is bound by as before |
| status, escalation | what the session does |
| outcome | how it ended, and why nothing came of it, where it never ran; nothing comes after it |
| any with a question, or that withdraws one | which question the document shows, and what became of it |

Not stated, so not compared: what a document says of its takeover and its failure, and when it last changed. What policy
said of an edit, and when something was proposed, earlier releases did not state.
"""

from __future__ import annotations

from time import sleep
from typing import TYPE_CHECKING, Any, Final, cast

import orjson

from app.audit.cells import NUMBER
from app.governance.control import TAKEOVER
from app.governance.model import TERMINAL, AdmissionOutcome, EventKind, Outcome, Status
from app.governance.recorded import KEY as CIRCUMSTANCES
from app.governance.session import final_status

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from app.audit.event import Event
    from app.audit.reader import Reader, Row

Body = dict[str, Any]
PAGE: Final = 50
COLUMNS: Final = ("created_seq", "status", "capability", "agent", "cell", "profile", "created_at")
FIELDS: Final = (
    "id", "status", "capability", "agent", "cell", "profile", "policy_version", "requested", "effective", "outcome",
    "admission", "policy", "escalation", "created_at",
)  # fmt: skip
ADMISSION: Final = ("outcome", "reasons", "retry_after_s")  # of an event's body: what the document says of it
POLICY: Final = ("outcome", "reasons", "changes")
NOT_SENT: Final = "not_sent"  # what was recorded was not sent after all: the server's word, and no cell's
QUESTION: Final = ("id", "status", "code")  # an earlier release left the document with an older deadline


def rebuild(events: Iterable[Event]) -> dict[str, Any]:
    """Return what the log states of one invocation, by the names of `COLUMNS` and `FIELDS`.

    Args:
        events: those of the invocation that state something, in order.

    Raises:
        ValueError: an event that no server wrote in this way.
    """
    known: dict[str, Any] = {}
    for event in events:
        known.setdefault("id", event.invocation)
        if "created_seq" not in known or ("agent" not in known and _begins(event)):
            known["created_seq"] = event.seq  # a stop of the cell may be written down before what it met is
        states = _STATES.get(event.kind)
        if states is None:
            continue
        try:
            body: Body = event.payload()
            shown = _question(known, body)
            known |= states(known, event.actor, body)
            known |= shown
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"event `{event.seq}` cannot be followed: {error!r}") from error
    return {name: value for name, value in known.items() if name not in _BETWEEN and value is not _UNSTATED}


def _begins(event: Event) -> bool:
    """Say whether an event is the one that an invocation's row was written with first."""
    if event.kind == EventKind.HUMAN:
        return event.payload().get("op") == TAKEOVER
    return event.kind == EventKind.PROPOSAL


def differences(row: Row, known: Mapping[str, Any]) -> list[str]:
    """Return in which columns and fields a stored row is not what the log makes of it, in words."""
    try:
        document: Any = orjson.loads(row["document"])
    except (orjson.JSONDecodeError, TypeError):
        return ["its document is no JSON"]
    if not isinstance(document, dict):
        return ["its document is no object"]
    fields = cast("Body", document)
    stored = [(f"column `{name}`", row[name], name) for name in COLUMNS]
    stored += [(f"`{name}`", fields.get(name), name) for name in FIELDS]
    return [
        f"{where} is `{_shown(value)}`, the log makes it `{_shown(known[name])}`"
        for where, value, name in stored
        if name in known and not _same(name, value, known[name])
    ]


def projection_problems(reader: Reader, *, limit: int, pause_s: float = 0.0) -> list[str]:
    """Compare every row of `invocations` with the log; return the first ones that differ, or are missing, in words.

    A page of rows and their events are read at one moment, so a writer may go on meanwhile.

    Args:
        reader: the log's.
        limit: how many to name at most.
        pause_s: how long to step aside after every page, so that a server whose process this runs in goes on.

    Raises:
        RecordDamaged: the database cannot be read.
    """
    found = [f"`{name}`: the log knows it, the table `invocations` does not" for name in reader.without_row(limit)]
    for row, events in _rows(reader, pause_s):
        if len(found) >= limit:
            break
        try:
            wrong = differences(row, rebuild(events)) if events else ["the log knows nothing of it"]
        except ValueError as error:
            wrong = [str(error)]
        if wrong:
            found.append(f"`{row['id']}`: {'; '.join(wrong)}")
    return found[:limit]


def _rows(reader: Reader, pause_s: float) -> Iterator[tuple[Row, list[Event]]]:
    after = ""
    while page := reader.told(kinds=_STATES, after=after, limit=PAGE):
        yield from page
        after = page[-1][0]["id"]
        sleep(pause_s)


def _same(name: str, value: object, known: object) -> bool:
    if name == "escalation" and isinstance(value, dict) and isinstance(known, dict):
        stored, stated = cast("Body", value), cast("Body", known)
        return all(stored.get(part) == stated.get(part) for part in QUESTION)
    return value == known


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else orjson.dumps(value, default=repr).decode()
    return text if len(text) <= 80 else f"{text[:77]}…"


# What each kind of event states ---------------------------------------------------------------------------------------

_AUTHORIZED: Final = "_authorized"
_APPROVED: Final = "_approved"
_BETWEEN: Final = frozenset({_AUTHORIZED, _APPROVED})  # what only the next events are read by
_UNSTATED: Final = object()
_SAID_NO: Final = frozenset({Outcome.DENIED, Outcome.EXPIRED})
RECHECK: Final = "recheck"


def _proposal(known: Body, actor: str, body: Body) -> Body:
    said = {"capability": body["capability"], "agent": actor, "requested": body["filled"], "effective": body["filled"]}
    told = {} if "created_at" not in body else {"created_at": body["created_at"]}
    return {**said, **told, "outcome": None, "escalation": None}


def _human(known: Body, actor: str, body: Body) -> Body:
    alone = body.get("op") == TAKEOVER and "agent" not in known
    return {"capability": TAKEOVER, "agent": actor, "outcome": None, "escalation": None} if alone else {}


def _admission(known: Body, actor: str, body: Body) -> Body:
    if _AUTHORIZED in known:
        return {}
    status = Status(body["status"])
    outcome = status.value if status in TERMINAL else None  # refused, it has no other outcome than that
    said = {"cell": body["cell"], "profile": body["profile"], "status": status.value, "outcome": outcome}
    if not _only_checked(known, status, body):
        said["admission"] = _parts(ADMISSION, body)
        if said["admission"] is not _UNSTATED:
            said["policy"] = None  # until its own event, which follows if there was something to check
    decided = body.get(CIRCUMSTANCES)  # what was not admitted was not checked: no policy event names the version then
    return said if decided is None else {**said, "policy_version": decided["policy_version"]}


def _policy(known: Body, actor: str, body: Body) -> Body:
    if _AUTHORIZED in known:
        return {}
    said = {"effective": body["effective"], "policy_version": body["policy_version"]}
    shown = {} if _only_checked(known, known.get("status"), body) else {"policy": _parts(POLICY, body)}
    return {**said, **shown}


def _only_checked(known: Body, status: object, body: Body) -> bool:
    """Say whether a decision is only that the approved form conforms; what is shown is the verdict on the request."""
    return bool(body.get(RECHECK)) and _APPROVED in known and status not in TERMINAL


def _approval(known: Body, actor: str, body: Body) -> Body:
    if _AUTHORIZED in known:
        return {}
    question: Body = body["escalation"]
    said: Body = {"effective": question["effective"]}
    if question.get("status") == "approved":
        said[_APPROVED] = True
    if question.get("edits"):
        said["policy"] = body.get("policy", _UNSTATED)
    return said


def _authorization(known: Body, actor: str, body: Body) -> Body:
    permit = body["authorization"]
    if _AUTHORIZED in known:  # it changes hands, or comes back by a decision of its own; what it is and does stays
        back = permit["capability"] == known["capability"] != TAKEOVER
        return {"policy_version": permit["policy_digest"]} if back else {}
    return {
        _AUTHORIZED: True,
        "status": Status.RUNNING.value,
        "effective": permit["params"],
        "policy_version": permit["policy_digest"],
    }


def unsent(body: Mapping[str, Any]) -> bool:
    """Say whether a word about a cell says that what was recorded before was never sent; no report of a cell's does."""
    return body.get("what") == NOT_SENT and NUMBER not in body


def _cell(known: Body, actor: str, body: Body) -> Body:
    # Earlier releases left it at the version of what was not sent.
    return {"policy_version": body["policy_version"]} if unsent(body) and "policy_version" in body else {}


def _status(known: Body, actor: str, body: Body) -> Body:
    status = Status(body["status"])
    # A terminal status is followed by the outcome, which says more.
    return {} if status in TERMINAL or _over(known) else {"status": status.value}


def _escalation(known: Body, actor: str, body: Body) -> Body:
    question = body.get("escalation")
    if _over(known):  # a late word of the cell's
        return {}
    if question is None:  # the cell's, who holds all the same, where somebody has answered it already
        return {"status": Status.ESCALATED.value} if NUMBER in body else {}
    asked = question["kind"] == "session" and question["status"] == "pending"
    return {"status": Status.ESCALATED.value} if asked else {}


def _outcome(known: Body, actor: str, body: Body) -> Body:
    if _over(known):
        return {}
    outcome = Outcome(body["outcome"])
    told = None if NUMBER in body else body.get("status")  # by the server alone: no cell says what its outcome makes
    said = {"outcome": outcome.value, "status": Status(told or final_status(outcome)).value}
    return said if _AUTHORIZED in known else {**said, **_unlaunched(known, outcome, body)}


def _unlaunched(known: Body, outcome: Outcome, body: Body) -> Body:
    """Return what the end of something that never ran adds: a person's or the time's no to what policy said."""
    reasons, policy = body.get("reasons", []), known.get("policy")
    if outcome in _SAID_NO and isinstance(policy, dict):
        said = cast("Body", policy)
        return {"policy": {**said, "reasons": [*said["reasons"], *reasons]}}
    if outcome is Outcome.REJECTED:  # the policy in force takes no such parameters any more
        return {"admission": {"outcome": AdmissionOutcome.REJECT.value, "reasons": reasons}}
    return {}


def _launch(known: Body, actor: str, body: Body) -> Body:
    return {}


def _question(known: Body, body: Body) -> Body:
    """Return what an event says of the question that the document shows."""
    shown: Body = known.get("escalation") or {}
    match body:
        case {"escalation": {"id": str(name), "status": str(status), **rest}}:
            denial = cast("Body | None", rest.get("denial"))
            code = {} if denial is None else {"code": denial["code"]}
            asked: Body = {"id": name, "status": status, "expires_at": rest.get("expires_at"), **code}
        case {"withdrawn": str(name)} if name == shown.get("id"):
            asked = {**shown, "status": "withdrawn"}
        case _:
            return {}
    return {"escalation": asked} if name == shown.get("id") or not _over(known) else {}


def _parts(names: Iterable[str], body: Body) -> object:
    """Return what an event says as the document says it; an event of another make states nothing of it."""
    return {name: body[name] for name in names if name in body} or _UNSTATED


def _over(known: Body) -> bool:
    return known.get("status") in TERMINAL


_STATES: Final[Mapping[str, Callable[[Body, str, Body], Body]]] = {
    EventKind.PROPOSAL: _proposal,
    EventKind.HUMAN: _human,
    EventKind.ADMISSION: _admission,
    EventKind.POLICY: _policy,
    EventKind.APPROVAL: _approval,
    EventKind.AUTHORIZATION: _authorization,
    EventKind.CELL: _cell,
    EventKind.STATUS: _status,
    EventKind.ESCALATION: _escalation,
    EventKind.OUTCOME: _outcome,
    EventKind.LAUNCH: _launch,
}
