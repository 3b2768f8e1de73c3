"""What an earlier run of the server left open, as the log has it.

Rows are state that nobody signs, and from them follows what is launched, who still has to be asked, and what decides.
So whatever the log states of an open invocation, of its question, of the policy in force and of a cell's profile is
taken from the log. A row that says otherwise changes nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from app.audit.documents import documents
from app.audit.projection import FIELDS, differences, rebuild, unsent
from app.governance.model import CoveredRecovery, EventKind, Mode, Outcome, Status, Strategy
from app.runtime.escalation import PENDING, Escalation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.audit.event import Event
    from app.audit.reader import Row
    from app.audit.store import AuditStore
    from app.runtime.invocation import Invocation, Terms

PAGE: Final = 500


async def events_of(
    store: AuditStore, *, invocation: str | None = None, kind: str | None = None, after: int = 0
) -> list[Event]:
    """Return everything that the log says of an invocation, or with one kind of event, behind a place, in order."""
    found: list[Event] = []
    while page := await store.events(invocation=invocation, kind=kind, after=after, limit=PAGE):
        found += page
        after = page[-1].seq
    return found


def invocation_of(row: Row, stored: Invocation, events: Sequence[Event]) -> tuple[Invocation | None, str]:
    """Return an invocation as the log has it, and in words what its row, which was read as `stored`, says otherwise.

    None, where the log knows nothing of it, or nothing that can be followed: then nothing may come of the row.
    """
    try:
        known: dict[str, Any] = rebuild(events)
    except ValueError as error:
        return None, str(error)
    if not known:
        return None, "the log knows nothing of it"
    wrong = differences(row, known)
    terms = _terms_of(stored.terms, events)
    if terms != stored.terms:
        wrong.append("its terms are not those that were proposed")
    told = {name: known[name] for name in FIELDS if name in known}
    told["status"] = Status(told["status"])
    told["outcome"] = None if told["outcome"] is None else Outcome(told["outcome"])
    terms = replace(terms, recoveries=_covered(stored.capability, events))
    return replace(stored, **told, terms=terms), "; ".join(wrong)


def questions_of(events: Sequence[Event]) -> list[Escalation]:
    """Return the questions about an invocation that the log says are open."""
    found: list[Escalation] = []
    for document in documents(events, "escalation"):
        if document["status"] == PENDING:
            document.pop("approved", None)
            found.append(Escalation(**document))
    return found


async def last_phase(store: AuditStore, invocation: str) -> str | None:
    """Return the phase that the question about a session which was asked last waits for; read back no further."""
    before: int | None = None
    while page := await store.events(invocation=invocation, before=before, newest=True, limit=PAGE):
        if (found := last_question(page[::-1])) is not None:
            return found.get("phase")
        before = page[-1].seq
    return None


def last_question(events: Sequence[Event]) -> dict[str, Any] | None:
    """Return the question about an invocation that was asked last, as the log has it; None where none was."""
    return next(reversed(documents(events, "escalation")), None)


def needed_first(events: Sequence[Event], question: Escalation) -> int:
    """Return how many people a question wanted when it was asked first, under the policy and profile it is of now."""
    needed, under = question.needed, ("", "")
    for event in events:
        body: dict[str, Any] = event.payload()
        asked: dict[str, Any] = body.get("escalation", {})
        if event.kind != EventKind.ESCALATION or asked.get("id") != question.id:
            continue
        before, under = under, (asked.get("policy_version", ""), asked.get("profile", ""))
        if before != under:
            needed = int(asked["needed"])
    return needed


def _terms_of(stored: Terms, events: Sequence[Event]) -> Terms:
    """Return the terms with what was proposed as the log has it; the rest of them is the server's own."""
    proposed: dict[str, Any] | None = next((one.payload() for one in events if one.kind == EventKind.PROPOSAL), None)
    if proposed is None:  # a human drives, and proposed nothing
        return stored
    preference = proposed["recovery_preference"]
    return replace(
        stored,
        mode=Mode(proposed["mode"]),
        preconditions=tuple(proposed["preconditions"]),
        recovery_preference=None if preference is None else Strategy(preference),
        metadata=proposed["metadata"],
        version=proposed.get("capability_version"),
    )


def _covered(capability: str, events: Sequence[Event]) -> tuple[CoveredRecovery, ...] | None:
    """Return what the newest authorization of a session itself covers that was sent; None where there was none."""
    sent: dict[str, dict[str, Any]] = {}
    for event in events:
        body: dict[str, Any] = event.payload()
        if event.kind == EventKind.AUTHORIZATION:
            permit = body["authorization"]
            if permit["capability"] == capability:  # one for a human's hands covers nothing of it
                sent[permit["id"]] = permit
        elif event.kind == EventKind.CELL and unsent(body):
            sent.pop(body.get("authorization", ""), None)
    own = next(reversed(sent.values()), None)
    if own is None:
        return None
    return tuple(
        CoveredRecovery(
            strategy=Strategy(one["strategy"]),
            capability=one["capability"],
            params=one["params"],
            mode=Mode(one["mode"]),
        )
        for one in own["recoveries"]
    )
