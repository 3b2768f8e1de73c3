"""The table `invocations`, made again from the log, to see that it says nothing else.

The table is state: nobody signs it, and what is listed is read from it. What the log states of an invocation is folded
event by event:

| event | states |
|---|---|
| proposal | who proposes what: capability, agent, requested and (until policy) effective parameters |
| human, `takeover` of an idle cell | the same of a driving, but for its parameters |
| admission, policy | cell, profile, policy version, status, effective parameters; nothing once it was authorized |
| approval | the effective parameters, which an approver may have edited |
| authorization, the first | that it runs, with exactly those parameters |
| status, escalation | what the session does |
| outcome | how it ended; nothing comes after it |

Not stated, so not compared: what a document says of its question, its takeover and its failure, and times.
"""

from __future__ import annotations

from time import sleep
from typing import TYPE_CHECKING, Any, Final, cast

import orjson

from app.governance.control import TAKEOVER
from app.governance.model import TERMINAL, EventKind, Outcome, Status
from app.governance.recorded import KEY as CIRCUMSTANCES
from app.governance.session import final_status

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from app.audit.event import Event
    from app.audit.reader import Reader, Row

Body = dict[str, Any]
PAGE: Final = 50
COLUMNS: Final = ("created_seq", "status", "capability", "agent", "cell", "profile")
FIELDS: Final = (
    "id", "status", "capability", "agent", "cell", "profile", "policy_version", "requested", "effective", "outcome",
)  # fmt: skip


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
        known.setdefault("created_seq", event.seq)
        states = _STATES.get(event.kind)
        if states is None:
            continue
        try:
            known |= states(known, event.actor, event.payload())
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"event `{event.seq}` cannot be followed: {error!r}") from error
    known.pop(_AUTHORIZED, None)
    return known


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
        if name in known and value != known[name]
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


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else orjson.dumps(value, default=repr).decode()
    return text if len(text) <= 80 else f"{text[:77]}…"


# What each kind of event states ---------------------------------------------------------------------------------------

_AUTHORIZED: Final = "_authorized"


def _proposal(known: Body, actor: str, body: Body) -> Body:
    said = {"capability": body["capability"], "agent": actor, "requested": body["filled"], "effective": body["filled"]}
    return {**said, "outcome": None}


def _human(known: Body, actor: str, body: Body) -> Body:
    alone = body.get("op") == TAKEOVER and "agent" not in known
    return {"capability": TAKEOVER, "agent": actor, "outcome": None} if alone else {}


def _admission(known: Body, actor: str, body: Body) -> Body:
    if _AUTHORIZED in known:
        return {}
    status = Status(body["status"])
    outcome = status.value if status in TERMINAL else None  # refused, it has no other outcome than that
    said = {"cell": body["cell"], "profile": body["profile"], "status": status.value, "outcome": outcome}
    decided = body.get(CIRCUMSTANCES)  # what was not admitted was not checked: no policy event names the version then
    return said if decided is None else {**said, "policy_version": decided["policy_version"]}


def _policy(known: Body, actor: str, body: Body) -> Body:
    if _AUTHORIZED in known:
        return {}
    return {"effective": body["effective"], "policy_version": body["policy_version"]}


def _approval(known: Body, actor: str, body: Body) -> Body:
    return {} if _AUTHORIZED in known else {"effective": body["escalation"]["effective"]}


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


def _status(known: Body, actor: str, body: Body) -> Body:
    status = Status(body["status"])
    # A terminal status is followed by the outcome, which says more.
    return {} if status in TERMINAL or _over(known) else {"status": status.value}


def _escalation(known: Body, actor: str, body: Body) -> Body:
    question = body.get("escalation")
    if question is None or _over(known):  # a late word of the cell's
        return {}
    asked = question["kind"] == "session" and question["status"] == "pending"
    return {"status": Status.ESCALATED.value} if asked else {}


def _outcome(known: Body, actor: str, body: Body) -> Body:
    if _over(known):
        return {}
    outcome = Outcome(body["outcome"])
    return {"outcome": outcome.value, "status": Status(body.get("status") or final_status(outcome)).value}


def _over(known: Body) -> bool:
    return known.get("status") in TERMINAL


_STATES: Final[Mapping[str, Callable[[Body, str, Body], Body]]] = {
    EventKind.PROPOSAL: _proposal,
    EventKind.HUMAN: _human,
    EventKind.ADMISSION: _admission,
    EventKind.POLICY: _policy,
    EventKind.APPROVAL: _approval,
    EventKind.AUTHORIZATION: _authorization,
    EventKind.STATUS: _status,
    EventKind.ESCALATION: _escalation,
    EventKind.OUTCOME: _outcome,
}
