"""The open questions to humans: how one is asked, kept, recorded, and what ends the session it is about.

A question is pending from the moment it is recorded until a version of it that is closed is recorded. Who may answer,
and what silence means, is the desk's subject (`app.runtime.desk`).
"""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from app.audit.errors import RecordUnavailable
from app.clock import monotonic_s, rfc3339
from app.governance.authority import waiting
from app.governance.model import Reason
from app.protocol import Human
from app.runtime.departures import Departures
from app.runtime.drafts import reason
from app.runtime.errors import Conflict, Forbidden
from app.runtime.escalation import (
    APPROVAL,
    NEVER_S,
    PENDING,
    POLICY_CHANGED,
    PROFILE_CHANGED,
    ROLLBACK,
    SESSION_QUESTION,
    WITHDRAWN,
    Escalation,
    bound_digest,
    stated,
)
from app.runtime.grants import Grants
from app.runtime.overtaken import check_waiting

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Generator, Mapping, Sequence

    from app.audit.event import EventDraft, RowWrite
    from app.governance.model import ApprovalNeed
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Register

RULE: Final = "runtime/session"
PAUSED: Final = "paused"
ASK: Final = "ask whoever paused it, or end it"
MOST_OF_AGENT: Final = 100  # proposals of one agent that wait for people
MOST_ASKED: Final = 400  # and of all: every console holds them all, and every deadline is looked at


class Questions:
    """The questions of one server that are open."""

    def __init__(self, register: Register, fleet: Fleet, kernel: Kernel) -> None:
        """Take where changes are recorded, where orders go, and who decides."""
        self.register = register
        self.fleet = fleet
        self.kernel = kernel
        self.grants = Grants(register, fleet, kernel)
        self.on_held: Callable[[Escalation], None] = lambda _: None
        self.kept_back: Callable[[Invocation], Sequence[Mapping[str, str]]] = lambda _: ()
        self.departures = Departures()
        self._pending: dict[str, Escalation] = {}
        self._until_s: dict[str, tuple[float, float]] = {}  # the deadline, and when that is on the clock nobody sets
        self._asking: Counter[str] = Counter()  # by agent, what is being recorded
        self._asked = asyncio.Event()

    # -- asking ------------------------------------------------------------------------------------------------------

    def question(self, invocation: Invocation, need: ApprovalNeed, risk: str) -> Escalation:
        """Return the question whether an invocation may launch; `hold` it once it is recorded."""
        now_s = self.register.now_s()
        return self._build(
            invocation,
            kind=APPROVAL,
            risk=risk,
            reasons=[reason._asdict() for reason in need.reasons],
            needed=need.approvers,
            expires_at=rfc3339(now_s + need.within_s),
            on_timeout=need.on_timeout,
        )

    def session_question(
        self,
        invocation: Invocation,
        reasons: Sequence[Mapping[str, str]],
        phase: str | None = None,
        *,
        paused: bool = False,
    ) -> Escalation:
        """Return the question whether a held session may go on, or begin a phase; `hold` it once it is recorded.

        `paused` is what its cell says of a pause, as `and_paused` takes it.
        """
        wait = waiting(self.kernel.policy, invocation.capability, invocation.profile, phase)
        return self._build(
            invocation,
            kind=SESSION_QUESTION,
            phase=phase,
            risk=self.kernel.risk(invocation.capability),
            reasons=self.and_paused(invocation, reasons, told=paused),
            needed=1,
            expires_at=rfc3339(self.register.now_s() + wait.within_s),
            on_deny=wait.on_deny,
            on_timeout=wait.on_timeout,
        )

    def and_paused(
        self, invocation: Invocation, reasons: Sequence[Mapping[str, str]], *, told: bool = False
    ) -> Sequence[Mapping[str, str]]:
        """Return why a session is held, and by whose pause as well: whoever lets it go on lifts that.

        Args:
            invocation: whose session.
            reasons: why it is held otherwise.
            told: whether its cell said that somebody had paused it, which is all that is known of that after a start.
        """
        by = None if invocation.cell is None else self.fleet.cell(invocation.cell).paused_by(invocation.id)
        if by is None and not told:
            return reasons
        who = f"`{by}`" if by else "an operator"
        return [*reasons, reason(RULE, PAUSED, f"it was paused by {who}; whoever lets it go on lifts that pause", ASK)]

    def _build(self, invocation: Invocation, **fields: Any) -> Escalation:  # noqa: ANN401  # fields of an escalation
        effective = invocation.requested if invocation.effective is None else invocation.effective
        now = self.register.now()
        bound = self._bound(invocation, effective, fields)
        return Escalation(
            id=self.kernel.identities.make("esc"),
            invocation=invocation.id,
            capability=invocation.capability,
            agent=invocation.agent,
            cell=invocation.cell,
            profile=invocation.profile,
            requested=invocation.requested,
            constrained=effective,
            effective=effective,
            digest=bound,
            names_task=invocation.task is not None,
            goal=stated(invocation.goal),
            task=stated(invocation.task),
            carried=self.kernel.carried(invocation, effective) if fields["kind"] == APPROVAL else None,
            policy_version=invocation.policy_version,
            status=PENDING,
            approvals=(),
            created_at=now,
            updated_at=now,
            **fields,
        )

    def _bound(self, invocation: Invocation, effective: Mapping[str, Any], fields: Mapping[str, Any]) -> str:
        if fields["kind"] == APPROVAL:
            return self.bound(invocation, effective, fields["reasons"])
        # Its cell says in the same moment, in more words, why it is held: no answer to the first is outdated by that.
        return bound_digest(invocation, effective, (), fields.get("phase"))

    def bound(self, invocation: Invocation, effective: Mapping[str, Any], why: Sequence[Mapping[str, str]]) -> str:
        """Return the digest that approvals of a launch for these reasons are bound to, as the world is now."""
        return bound_digest(invocation, effective, why, carried=self.kernel.carried(invocation, effective))

    def ask_again(self, principal: Principal) -> None:
        """Refuse a word on which something moves, and which had to wait, of somebody who may say it no more by now.

        Raises:
            Conflict: `given_up`, nor do they wait for its answer.
            Forbidden: `role_forbidden`.
        """
        check_waiting(principal)
        if not self.grants.may_give(principal.name):
            raise Forbidden.withdrawn(principal.name)

    def hold(self, *versions: Escalation) -> None:
        """Take newest versions that are recorded: a pending one waits for its answer, others are done."""
        for version in versions:
            if version.status == PENDING:
                self._pending[version.id] = version
                self._time(version)
                self._asked.set()
            else:
                self._pending.pop(version.id, None)
                self._until_s.pop(version.id, None)
            self.on_held(version)

    def _time(self, question: Escalation) -> None:
        """Note how long an open question may wait from now on, unless that is known."""
        deadline_s, known = question.deadline_s, self._until_s.get(question.id)
        if deadline_s is not None and (known is None or known[0] != deadline_s):
            self._until_s[question.id] = deadline_s, monotonic_s() + deadline_s - self.register.now_s()

    def due(self, question: Escalation) -> bool:
        """Say whether silence answers an open question by now; a clock that is put back makes that no later."""
        deadline_s, until_s = self._until_s.get(question.id, (NEVER_S, NEVER_S))
        return self.register.now_s() >= deadline_s or monotonic_s() >= until_s

    def pending(self) -> list[Escalation]:
        """Return the questions that are open."""
        return list(self._pending.values())

    def approvals(self, question: Escalation) -> tuple[Mapping[str, Any], ...]:
        """Return the approvals of a question that count: those of people who may answer questions still."""
        return tuple(said for said in question.approvals if self.grants.may_give(said["by"]))

    def no_room(self, agent: str) -> Reason | None:
        """Return why an agent may ask people nothing more for now; None where it may.

        Questions wait for minutes and are cheap to ask: without an end to them, one agent could bury what the others
        ask, and what people are to see of it.
        """
        asked = [question.agent for question in self._pending.values() if question.kind == APPROVAL]
        asked += self._asking.elements()
        own = asked.count(agent)
        if own < MOST_OF_AGENT and len(asked) < MOST_ASKED:
            return None
        who = f"`{own}` proposals of `{agent}`" if own >= MOST_OF_AGENT else f"`{len(asked)}` proposals"
        return Reason(
            "authority/approvals",
            "too_many_waiting",
            f"{who} wait for people already",
            "wait for answers, or cancel some",
        )

    @contextmanager
    def asking(self, agent: str) -> Generator[None]:
        """Have a question of an agent count among those that wait while it is being recorded."""
        self._asking[agent] += 1
        try:
            yield
        finally:
            self._asking[agent] -= 1

    def pending_for(self, invocation: str) -> Escalation | None:
        """Return the question that is open about an invocation."""
        for escalation in self._pending.values():
            if escalation.invocation == invocation:
                return escalation
        return None

    def outdated(self, question: Escalation) -> str | None:
        """Return why a question about a launch is not the one to ask now; None where it is."""
        if question.policy_version != self.kernel.policy.digest:
            return POLICY_CHANGED
        cell = self.fleet.cell(question.cell) if question.cell else None
        return None if question.profile == self.fleet.profile(cell) else PROFILE_CHANGED

    def withdrawal(self, invocation: str) -> Escalation | None:
        """Return the open question about an invocation as withdrawn, if there is one; `hold` it once recorded."""
        present = self.pending_for(invocation)
        return None if present is None else present.evolve(self.register.now(), status=WITHDRAWN)

    # -- closing ----------------------------------------------------------------------------------------------------

    async def commit(
        self,
        drafts: Sequence[EventDraft],
        escalation: Escalation,
        invocation: Invocation,
        rows: Sequence[RowWrite] = (),
    ) -> None:
        """Record the new version of a question together with its invocation's. Raises `RecordUnavailable`."""
        await self.register.append(drafts, [*rows, escalation.row()], [invocation])
        self.hold(escalation)

    async def end_session(
        self,
        invocation: Invocation,
        ending: str,
        actor: str,
        recording: Coroutine[Any, Any, None],
        *,
        expired: bool = False,
    ) -> None:
        """Have a held session come to rest, or undone where policy says so of a denial, or of silence (`expired`).

        Coming to rest is sent first, as any restraint. Undoing moves, so it is recorded first; where it cannot be
        recorded, or the log is damaged, or the cell is away or ending the session already, it comes to rest instead.

        Raises:
            RecordUnavailable: it is not recorded; the session comes to rest all the same.
        """
        cell = self.fleet.cell(invocation.cell or "")
        rest = Human(invocation=invocation.id, op="resolve_terminate", actor=actor, expired=expired)
        gone = not self.fleet.attached(cell) or self.register.store.damage is not None
        still = gone or cell.driven(invocation.id) or cell.ending(invocation.id)
        if ending != ROLLBACK or still:  # nothing is undone under somebody's hand
            self.fleet.restrain(cell, rest)
            await recording
            return
        decided = cell.moment
        try:
            await recording
            undo = Human(invocation=invocation.id, op="rollback", actor=actor, expired=expired)
            self.fleet.order(cell, undo, decided=decided)
        except RecordUnavailable:
            self.fleet.restrain(cell, rest)
            raise
        except Conflict:  # the cell left while this was recorded
            self.fleet.restrain(cell, rest)
