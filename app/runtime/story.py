"""A batch of a cell's reports on its way into the record: drafts in order, and what follows for invocations.

Nothing is changed here; a story holds the newest versions until the record has taken all of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from app.audit.event import EventDraft
from app.governance.authority import denial
from app.governance.continuing import CHANGED
from app.governance.model import TERMINAL, EventKind, Outcome, Status
from app.governance.session import final_status, refused_launch
from app.runtime.drafts import DENIAL, SERVER, outcome_event, reason
from app.runtime.escalation import APPROVED, DENIED, EXPIRED, PENDING, ROLLBACK, WITHDRAWN, bound_digest
from app.runtime.failures import described, failure, of_refusal
from app.runtime.hands import LAPSED, driven, followed
from app.runtime.questions import PAUSED, RULE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.governance.policy import PolicySet
    from app.protocol import UpEvent
    from app.runtime.desk import Desk
    from app.runtime.escalation import Escalation
    from app.runtime.invocation import Invocation

ITSELF: Final = "cell"  # how a cell names itself as an actor
CONFIRM: Final = "confirm:"  # how a cell says which phase waits
LINK: Final = "link"  # how a cell says that it holds because its link had lapsed
LOST: Final = frozenset({LINK, "link_lost", "link_returned"})  # and how the server says that it was lost
UNAVAILABLE: Final = "rollback_unavailable"  # how a cell says that it cannot undo its session
ONWARD: Final = "let it go on from where it is held, or end it"  # what a human may say of a held session
ANEW: Final = "let it go on with a new attempt, or end it"  # and of one that had failed
CONFIRM_RULE: Final = "authority/confirm_before"
NOTHING: Final[Mapping[str, Any]] = {}
ANSWERED: Final = frozenset({APPROVED, DENIED, EXPIRED})
DONE: Final = frozenset({Outcome.SUCCEEDED, Outcome.RECOVERED})


class Story:
    """Reports in order, and the versions they make of the live invocations they are about."""

    def __init__(self, desk: Desk, versions: dict[str, Invocation], strange: frozenset[str] = frozenset()) -> None:
        """Begin with versions whose locks are held; `strange` are invocations that the cell never had."""
        self._desk = desk
        self._strange = strange
        self._before = dict(versions)
        self._versions = versions
        self.drafts: list[EventDraft] = []
        self.questions: dict[str, Escalation] = {}

    def changed(self) -> list[Invocation]:
        """Return the new versions."""
        return [version for name, version in self._versions.items() if version is not self._before[name]]

    def before(self, name: str) -> Invocation:
        """Return the version that a batch found."""
        return self._before[name]

    def tell(self, cell: str, event: UpEvent, at: str) -> None:
        """Take one report."""
        name = event.invocation
        if name in self._strange:  # a trace holds nobody's word but that of the cell which had it
            self.drafts.append(_stray(cell, event))
            return
        version = None if name is None else self._versions.get(name)
        live = (
            version is not None and not version.final
        )  # a late word cannot raise the dead; it is recorded all the same
        added = self._follow(version, event, at) if version is not None and live else NOTHING
        body = {**_said(cell, event), **added}
        kind = event.kind
        if kind == EventKind.OUTCOME and not live:  # an invocation has one outcome, and this one came after it
            kind, body = EventKind.CELL, {**body, "late": EventKind.OUTCOME}
        self.drafts.append(EventDraft(kind=kind, actor=cell, invocation=name, body=body))
        if version is not None and live and event.kind == EventKind.LAUNCH and self._versions[version.id].final:
            refusal = reason(RULE, of_refusal(str(event.body["refused"])), str(event.body.get("detail", "")))
            self.drafts.append(outcome_event(self._versions[version.id], SERVER, refusal))

    def _follow(self, version: Invocation, event: UpEvent, at: str) -> Mapping[str, Any]:
        """Change the invocation as the report says; returns what the record adds to the report."""
        if event.kind == EventKind.LAUNCH and "refused" in event.body:
            permit = event.body.get("permit")
            if permit is not None and permit != version.terms.authorization:  # another has been sent since
                return NOTHING
        version = self._in_whose_hands(self._undone(version, event, at), event, at)
        match event.kind:
            case EventKind.LAUNCH if "refused" not in event.body:
                self._versions[version.id] = version.evolve(at, terms=replace(version.terms, confirmed=True))
            case EventKind.LAUNCH if not version.terms.confirmed:  # nothing moved, and nothing will on this permit
                code = str(event.body["refused"])
                return self._end(version, refused_launch(code), at, of_refusal(code))
            case EventKind.STATUS:
                return self._status(version, Status(str(event.body["status"])), event, at)
            case EventKind.ESCALATION:
                return self._status(version, Status.ESCALATED, event, at)
            case EventKind.OUTCOME:
                codes = (str(event.body.get("failure") or ""), str(event.body.get("code") or ""))
                return self._end(version, Outcome(str(event.body["outcome"])), at, *codes)
            case _:
                pass
        return NOTHING

    def _undone(self, version: Invocation, event: UpEvent, at: str) -> Invocation:
        """Leave the end of a session to its agent as well, where the cell has no way to undo it as a human ordered."""
        if version.terms.undone_by is None or not _undoes_nothing(version, event):
            return version
        self._versions[version.id] = version.evolve(at, terms=replace(version.terms, undone_by=None))
        return self._versions[version.id]

    def _in_whose_hands(self, version: Invocation, event: UpEvent, at: str) -> Invocation:
        """Follow a takeover: what the cell says decides whose hands its session is in.

        A session that escalates before the cell has heard of a takeover was let go by somebody else.
        """
        if version.terms.taking and event.kind == EventKind.ESCALATION:
            return version
        terms = driven(version.terms, event)
        if terms is not version.terms:
            version = self._versions[version.id] = version.evolve(at, terms=terms)
        after = followed(version.takeover, event)
        if after is None and version.takeover is not None and terms.displaced:  # somebody had driven it before
            after = {**version.takeover, "state": LAPSED}
        if after is not version.takeover:
            version = self._versions[version.id] = version.evolve(at, takeover=after)
        return version

    def _status(self, version: Invocation, status: Status, event: UpEvent, at: str) -> Mapping[str, Any]:
        if status in TERMINAL:  # the outcome follows, and says more
            return NOTHING
        question = self._open(version.id)
        if status is Status.ESCALATED:
            return self._escalated(version, question, event, at)
        terms = version.terms
        if (
            status is Status.RUNNING and version.status is not Status.RUNNING
        ):  # it goes on after all, so its end is the agent's as well
            terms = replace(terms, undone_by=None)
        if question is not None:
            return self._withdraw(version, question, at, status=status, terms=terms)
        if status is not version.status:
            self._versions[version.id] = version.evolve(at, status=status, terms=terms)
        return NOTHING

    def _escalated(
        self, version: Invocation, question: Escalation | None, event: UpEvent, at: str
    ) -> Mapping[str, Any]:
        """Ask a human, or say better why one was asked.

        A cell says that a session is escalated, and then why. Who has answered by then is not asked again.
        """
        self._desk.departures.holds(version.id)
        asked_before = version.terms.asked_tick == event.tick and event.kind == EventKind.ESCALATION
        if question is None and (asked_before or self._answered_meanwhile(version, event)):
            if version.status is not Status.ESCALATED:
                self._versions[version.id] = version.evolve(at, status=Status.ESCALATED)
            return NOTHING
        phase, reasons = _asked(event)
        paused = event.body.get("paused") is True
        code = event.body.get("reason")
        if code == CHANGED and (told := self._desk.departures.standing(version.id)):
            failed = reasons if event.body.get("failure") else ()  # without one, they are no more than the code
            reasons = [*told, *failed]
        if question is None:
            asked = self._desk.session_question(version, reasons, phase, paused=paused)
        elif code == LINK and not _of_the_link(question):  # it waits as before, on the terms it was asked on
            asked = question.evolve(at, reasons=_with_link(question))
        elif phase != question.phase:  # its terms are those of what it waits for
            asked = replace(self._desk.session_question(version, reasons, phase, paused=paused), id=question.id)
        else:
            asked = self._said_better(version, question, event, reasons, at)
        self.questions[asked.id] = asked
        if version.status is not Status.ESCALATED or version.escalation != asked.reference():
            terms = replace(version.terms, asked_tick=event.tick)
            self._versions[version.id] = version.evolve(
                at, status=Status.ESCALATED, escalation=asked.reference(), terms=terms
            )
        return {"escalation": asked.public()}

    def _said_better(
        self, version: Invocation, question: Escalation, event: UpEvent, reasons: list[dict[str, str]], at: str
    ) -> Escalation:
        """Return a question with what its cell says of why it is asked.

        Where that is something else than what was asked, and not only said in more words in the same moment, an answer
        to what was asked is none to this: going on may be a new attempt now.
        """
        told = self._desk.and_paused(version, reasons, told=event.body.get("paused") is True)
        same = [why["code"] for why in told] == [why["code"] for why in question.reasons]
        if version.terms.asked_tick == event.tick or same:
            return question.evolve(at, reasons=told)
        bound = bound_digest(version, question.effective, told, question.phase, carried=question.carried)
        return question.evolve(at, reasons=told, digest=bound, acknowledged=())

    def _answered_meanwhile(self, version: Invocation, event: UpEvent) -> bool:
        """Say whether a cell holds for its link, of which somebody knew whose answer is on its way to it.

        The server asks by itself about a session whose link is lost, so the cell may say so only after the answer, and
        before that what else it did meanwhile. Should the session wait all the same, it is asked about again in time
        (`not_gone_on`).
        """
        if (version.escalation or NOTHING).get("status") not in ANSWERED or event.body.get("reason") != LINK:
            return False
        cell = self._desk.fleet.cell(version.cell or "")
        return version.status is Status.ESCALATED or cell.goes_on(version.id) or cell.ending(version.id) is not None

    def _end(self, version: Invocation, outcome: Outcome, at: str, *codes: str) -> Mapping[str, Any]:
        question = self._open(version.id)
        status, why = final_status(outcome), None if outcome in DONE else failure(*codes)
        if why is not None:
            why["reasons"][:0] = denied(self._desk.kernel.policy, version)
        if question is not None:
            return self._withdraw(version, question, at, status=status, outcome=outcome, failure=why)
        self._versions[version.id] = version.evolve(at, status=status, outcome=outcome, failure=why)
        return NOTHING

    def _withdraw(
        self,
        version: Invocation,
        question: Escalation,
        at: str,
        **changes: Any,  # noqa: ANN401  # fields of an invocation
    ) -> Mapping[str, Any]:
        closed = question.evolve(at, status=WITHDRAWN)
        self.questions[closed.id] = closed
        self._versions[version.id] = version.evolve(at, escalation=closed.reference(), **changes)
        return {"withdrawn": closed.id}

    def _open(self, name: str) -> Escalation | None:
        known = [question for question in self.questions.values() if question.invocation == name]
        if known:
            return known[-1] if known[-1].status == PENDING else None
        return self._desk.pending_for(name)


def denied(policy: PolicySet, version: Invocation) -> list[dict[str, str]]:
    """Return why a human did not let a held session go on, in the words of the code they chose.

    One that runs again goes on by somebody else's word, and ends for other reasons.
    """
    asked = version.escalation or NOTHING
    ends = asked.get("status") == DENIED and version.status is not Status.RUNNING
    code = asked.get("code") if ends else None
    why = None if code is None else denial(policy, code)
    if why is None or why == policy.authority.denials[0]:
        return []
    return [reason(DENIAL, why.code, why.says, why.remedy)]


def _said(cell: str, event: UpEvent) -> dict[str, Any]:
    """Return a report as the record holds it."""
    body = {**event.body, "cell_seq": event.seq, "cell_at_s": event.at_s, "tick": event.tick}
    return body if event.actor in (cell, ITSELF) else {**body, "actor": event.actor}


def _stray(cell: str, event: UpEvent) -> EventDraft:
    """Return what a cell says of an invocation that it never had: kept, and in no invocation's trace.

    It is not refused: a cell that outlived a record restored from a copy would report it for ever, and move no more.
    """
    body = {**_said(cell, event), "stray": event.kind, "session": event.invocation}  # `of` is a report's own word
    return EventDraft(kind=EventKind.CELL, actor=cell, body=body)


def _undoes_nothing(version: Invocation, event: UpEvent) -> bool:
    """Say whether a cell has no way to undo a session, and is not mending an undoing that failed."""
    said = event.kind == EventKind.HUMAN and event.body.get("op") == ROLLBACK
    return said and event.body.get("refused") == UNAVAILABLE and version.status is not Status.RECOVERING


def _of_the_link(question: Escalation) -> bool:
    """Say whether a question is about nothing but a link that was lost, by the server's word or the cell's."""
    return question.phase is None and {why["code"] for why in question.reasons} <= LOST | {PAUSED}


def _with_link(question: Escalation) -> Sequence[Mapping[str, str]]:
    """Return why a session waits, and that the cell's link lapsed meanwhile, said once."""
    waits = "the session waits" if question.phase is None else f"`{question.phase}` waits to be confirmed"
    lapsed = reason(RULE, LINK, f"the cell's link lapsed meanwhile; {waits} as before")
    return question.reasons if lapsed in question.reasons else [*question.reasons, lapsed]


def _asked(event: UpEvent) -> tuple[str | None, list[dict[str, str]]]:
    """Return the phase that waits for a confirmation, if one does, and why a cell asks.

    Its `reason` is a code, `failure` what had gone wrong before.
    """
    code = str(event.body.get("reason") or "escalated")
    if code.startswith(CONFIRM):
        phase = code.removeprefix(CONFIRM)
        message = f"policy has a human confirm `{phase}` before it begins; the session is held"
        return phase, [reason(CONFIRM_RULE, code, message)]
    failed = event.body.get("failure")
    if not failed:
        return None, [reason(RULE, code, f"the session is held (`{code}`) and waits for a human", ONWARD)]
    held = "" if failed == code else f" (`{code}`)"
    message = f"{described(str(failed))}; the session is held{held} and waits for a human"
    return None, [reason(RULE, code, message, ANEW)]
