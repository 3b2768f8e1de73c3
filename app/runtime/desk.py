"""The desk: questions to humans, from asking to the answer, the deadline or the withdrawal.

Every change is made under the lock of the invocation it is about, and is durable before anybody learns of it. What is
approved is exactly what was shown: an answer names the digest of the effective proposal. An edit is decided again; it
voids earlier approvals, and where policy constrains the edit further, the constrained proposal is a new question. With
the last approval the proposal is decided once more, because the world went on while people thought.

Answering a session's question: *approve* lets it go on (recorded first, and only to a cell that is there), *deny* ends
it (sent first).
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Final

from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.clock import rfc3339
from app.governance.model import EventKind, Outcome, Status
from app.protocol import Human
from app.runtime.errors import Conflict, Forbidden, NotFound
from app.runtime.escalation import (
    APPROVAL,
    APPROVED,
    DENIED,
    EXPIRED,
    PENDING,
    SESSION_QUESTION,
    WITHDRAWN,
    Escalation,
    bound_digest,
    read_escalation,
)
from app.runtime.invocation import Principal
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.audit.event import RowWrite
    from app.governance.model import ApprovalNeed
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Invocation
    from app.runtime.kernel import Judgement, Kernel
    from app.runtime.register import Register

POLL_S: Final = 0.5  # the wall clock may step; a deadline is met within this all the same
SERVER: Final = "server"


class Desk:
    """Pending questions of one server, and their answers."""

    def __init__(self, register: Register, fleet: Fleet, kernel: Kernel) -> None:
        """Take where changes are recorded, where orders go, and who decides."""
        self.register = register
        self.fleet = fleet
        self.kernel = kernel
        self._pending: dict[str, Escalation] = {}
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
        )

    def session_question(self, invocation: Invocation, reasons: Sequence[Mapping[str, str]]) -> Escalation:
        """Return the question whether a held session may go on; `hold` it once it is recorded."""
        risk = self.kernel.risk(invocation.capability)
        until = rfc3339(self.register.now_s() + self.kernel.policy.authority.within_s)
        return self._build(invocation, kind=SESSION_QUESTION, risk=risk, reasons=reasons, needed=1, expires_at=until)

    def _build(self, invocation: Invocation, **fields: Any) -> Escalation:  # noqa: ANN401  # fields of an escalation
        effective = invocation.requested if invocation.effective is None else invocation.effective
        now = self.register.now()
        return Escalation(
            id=self.kernel.identities.make("esc"),
            invocation=invocation.id,
            capability=invocation.capability,
            agent=invocation.agent,
            requested=invocation.requested,
            constrained=effective,
            effective=effective,
            digest=bound_digest(invocation, effective),
            status=PENDING,
            approvals=(),
            created_at=now,
            updated_at=now,
            **fields,
        )

    def hold(self, *versions: Escalation) -> None:
        """Take newest versions that are recorded: a pending one waits for its answer, others are done."""
        for version in versions:
            if version.status == PENDING:
                self._pending[version.id] = version
                self._asked.set()
            else:
                self._pending.pop(version.id, None)

    def pending_for(self, invocation: str) -> Escalation | None:
        """Return the question that is open about an invocation."""
        for escalation in self._pending.values():
            if escalation.invocation == invocation:
                return escalation
        return None

    def withdrawal(self, invocation: str) -> Escalation | None:
        """Return the open question about an invocation as withdrawn, if there is one; `hold` it once recorded."""
        present = self.pending_for(invocation)
        return None if present is None else present.evolve(self.register.now(), status=WITHDRAWN)

    # -- reading -----------------------------------------------------------------------------------------------------

    async def list(
        self, *, status: str | None = None, limit: int = 50, cursor: str | None = None
    ) -> tuple[list[dict[str, Any]], str | None]:
        """Return questions, newest first, and the cursor behind them. Raises `ValueError` on a bad limit or cursor."""
        page = await self.register.store.page("escalations", {"status": status}, limit=limit, cursor=cursor)
        return [read_escalation(row["document"]).public() for row in page.items], page.next

    async def get(self, escalation_id: str) -> dict[str, Any]:
        """Return one question.

        Raises:
            NotFound: there is none.
        """
        return (await self._load(escalation_id)).public()

    async def _load(self, escalation_id: str) -> Escalation:
        present = self._pending.get(escalation_id)
        if present is not None:
            return present
        row = await self.register.store.row("escalations", id=escalation_id)
        if row is None:
            raise NotFound("escalation", escalation_id)
        return read_escalation(row["document"])

    # -- answering ---------------------------------------------------------------------------------------------------

    @uncut
    async def resolve(
        self,
        escalation_id: str,
        principal: Principal,
        decision: str,
        digest: str,
        *,
        params: Mapping[str, Any] | None = None,
        comment: str | None = None,
    ) -> dict[str, Any]:
        """Take one person's answer, `approve` or `deny`, and return the question as it stands then.

        Raises:
            NotFound: no such question.
            Conflict: `already_resolved`, `escalation_expired`, `digest_mismatch`, `already_approved`, `edit_refused`
                (with policy's reasons), `cell_offline`.
            Forbidden: `own_proposal`, nobody approves what they proposed.
            InvalidParams: edited parameters that do not fit the schema.
            RecordUnavailable: nothing was recorded; a denial of a session has been sent to the cell all the same.
        """
        known = self._pending.get(escalation_id)
        entry = None if known is None else self.register.entry(known.invocation)
        if entry is None:
            raise _gone(await self._load(escalation_id))
        async with entry.lock:
            present = self._pending.get(escalation_id)
            if present is None:
                raise _gone(await self._load(escalation_id))
            await self._check_answer(present, principal, digest, entry.newest)
            answer = _Answer(self, entry.newest, present, principal, comment)
            match present.kind, decision:
                case "session", "approve":
                    final = await answer.go_on()
                case "session", _:
                    final = await answer.terminate()
                case _, "approve":
                    final = await answer.approve(params)
                case _:
                    final = await answer.deny()
        return final.public()

    async def _check_answer(
        self, present: Escalation, principal: Principal, digest: str, invocation: Invocation
    ) -> None:
        deadline_s = present.deadline_s
        if deadline_s is not None and self.register.now_s() >= deadline_s:
            with contextlib.suppress(RecordUnavailable):  # it stays pending, and is tried again; the answer is the same
                await self._expire(present, invocation)
            raise Conflict("escalation_expired", f"the escalation `{present.id}` expired at `{present.expires_at}`")
        if digest != present.digest:
            raise Conflict("digest_mismatch", f"`{digest}` is not what is asked now: valid is `{present.digest}`")
        if principal.name == present.agent:
            raise Forbidden("own_proposal", "nobody answers for what they proposed themselves")

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

    # -- silence -----------------------------------------------------------------------------------------------------

    async def expire_due(self) -> None:
        """Close every question whose time is over, as nobody's answer.

        Raises:
            RecordUnavailable: the rest stays pending; answers to it are refused as expired all the same.
        """
        for known in list(self._pending.values()):
            entry = self.register.entry(known.invocation)
            if entry is None or not self._due(known):
                continue
            async with entry.lock:
                present = self._pending.get(known.id)
                if present is not None and self._due(present):
                    await self._expire(present, entry.newest)

    def _due(self, escalation: Escalation) -> bool:
        deadline_s = escalation.deadline_s
        return deadline_s is not None and self.register.now_s() >= deadline_s

    async def _expire(self, present: Escalation, invocation: Invocation) -> None:
        if present.kind == SESSION_QUESTION:
            await self._expire_session(present, invocation)
        else:
            await self._expire_approval(present, invocation)

    async def _expire_session(self, present: Escalation, invocation: Invocation) -> None:
        """End a held session that nobody spoke for: sent first, as any restraint."""
        op = Human(invocation=invocation.id, op="resolve_terminate", actor=SERVER)
        self.fleet.restrain(self.fleet.cell(invocation.cell or ""), op)
        now = self.register.now()
        closed = present.evolve(now, status=EXPIRED)
        await self.commit([_escalation_event(closed)], closed, invocation.evolve(now, escalation=closed.reference()))

    async def _expire_approval(self, present: Escalation, invocation: Invocation) -> None:
        now = self.register.now()
        closed = present.evolve(now, status=EXPIRED)
        reason = _reason("approval_expired", "nobody answered in time", "propose again when somebody is on duty")
        ended = invocation.evolve(
            now,
            status=Status.DENIED,
            outcome=Outcome.EXPIRED,
            escalation=closed.reference(),
            policy=with_reason(invocation.policy, reason),
        )
        await self.commit([_escalation_event(closed), outcome_event(ended, SERVER, reason)], closed, ended)

    async def watch_deadlines(self) -> None:
        """Close questions when their time is over, for ever."""
        while True:
            self._asked.clear()
            deadlines = [deadline for item in self._pending.values() if (deadline := item.deadline_s) is not None]
            wait_s = max(0.0, min(POLL_S, min(deadlines) - self.register.now_s())) if deadlines else None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._asked.wait()
            try:
                await self.expire_due()
            except RecordUnavailable:  # the store's health says so; the question stays closed to answers meanwhile
                await asyncio.sleep(POLL_S)

    # -- remembering -------------------------------------------------------------------------------------------------

    async def recall(self) -> None:
        """Read back the questions that were open when the server ended."""
        cursor: str | None = None
        while True:
            page = await self.register.store.page("escalations", {"status": PENDING}, limit=500, cursor=cursor)
            self.hold(*(read_escalation(row["document"]) for row in page.items))
            cursor = page.next
            if cursor is None:
                return


class _Answer:
    """One person's answer to one question, under the invocation's lock."""

    def __init__(
        self, desk: Desk, invocation: Invocation, escalation: Escalation, principal: Principal, comment: str | None
    ) -> None:
        self._desk = desk
        self._register = desk.register
        self._fleet = desk.fleet
        self._kernel = desk.kernel
        self._invocation = invocation
        self._escalation = escalation
        self._principal = principal
        self._comment = comment

    # -- before launch -----------------------------------------------------------------------------------------------

    async def deny(self) -> Escalation:
        """End the invocation: one denial is enough."""
        now = self._register.now()
        closed = self._escalation.evolve(now, status=DENIED)
        reason = _reason("denied_by_human", "a human denied this", "propose something else")
        ended = self._invocation.evolve(
            now,
            status=Status.DENIED,
            outcome=Outcome.DENIED,
            escalation=closed.reference(),
            policy=with_reason(self._invocation.policy, reason),
        )
        await self._desk.commit(
            [self._event("deny", closed), outcome_event(ended, self._principal.name, reason)], closed, ended
        )
        return closed

    async def approve(self, params: Mapping[str, Any] | None) -> Escalation:
        """Count this approval, of the question as shown or as edited, and launch with the last one needed."""
        present = self._escalation
        full = {**present.effective, **(params or {})}
        if full != present.effective:
            return await self._approve_edit(full)
        if any(approval["by"] == self._principal.name for approval in present.approvals):
            raise Conflict("already_approved", f"`{self._principal.name}` approved this: it takes another person")
        return await self._count(present, None)

    async def _approve_edit(self, full: Mapping[str, Any]) -> Escalation:
        filled = self._kernel.fill_in(self._invocation.capability, full)
        judgement = self._judge(filled)
        if judgement.refused:
            reasons = [reason._asdict() for reason in judgement.reasons()]
            raise Conflict("edit_refused", "policy refuses the edited proposal", reasons=reasons)
        effective = judgement.effective(filled)
        edited = self._escalation.evolve(
            self._register.now(), effective=effective, digest=bound_digest(self._invocation, effective), approvals=()
        )
        if effective == filled:
            return await self._count(edited, judgement)
        # Policy constrained the edit further: nobody has seen that, so nobody has approved it.
        await self._commit_pending(edited, "edit")
        return edited

    async def _count(self, present: Escalation, judgement: Judgement | None) -> Escalation:
        approval = {"by": self._principal.name, "at": self._register.now(), "digest": present.digest}
        counted = present.evolve(self._register.now(), approvals=(*present.approvals, approval))
        if len(counted.approvals) < counted.needed:
            await self._commit_pending(counted, "approve")
            return counted
        return await self._conclude(counted, judgement or self._judge(counted.effective))

    async def _conclude(self, counted: Escalation, judgement: Judgement) -> Escalation:
        """Launch, if the proposal still conforms in the world as it is now; otherwise say what changed."""
        need = judgement.need
        if need is not None and need.approvers > len(counted.approvals):
            stricter = counted.evolve(self._register.now(), needed=need.approvers)
            await self._commit_pending(stricter, "approve")
            return stricter
        now = self._register.now()
        closed = counted.evolve(now, status=APPROVED)
        invocation = self._invocation.evolve(now, escalation=closed.reference(), **judgement.parts())
        approved = self._event("approve", closed)
        if not judgement.conforms(counted.effective):
            ended = judgement.refuse(invocation)
            await self._desk.commit(
                [approved, *judgement.events(ended), outcome_event(ended, SERVER, *judgement.ending_reasons())],
                closed,
                ended,
            )
            return closed
        approvers = tuple(str(approval["by"]) for approval in closed.approvals)
        launching = invocation.evolve(now, effective=dict(counted.effective))
        async with self._kernel.launch(launching, judgement, approvers) as launch:
            await self._desk.commit(
                [approved, *judgement.events(launch.invocation), *launch.events], closed, launch.invocation, launch.rows
            )
        return closed

    async def _commit_pending(self, escalation: Escalation, decision: str) -> None:
        invocation = self._invocation.evolve(
            self._register.now(), effective=dict(escalation.effective), escalation=escalation.reference()
        )
        await self._desk.commit([self._event(decision, escalation)], escalation, invocation)

    def _judge(self, params: Mapping[str, Any]) -> Judgement:
        invocation = self._invocation
        cell = self._fleet.cell(invocation.cell) if invocation.cell else None
        return self._kernel.judge(invocation.proposal(params), invocation.agent, cell)

    # -- in mid-execution --------------------------------------------------------------------------------------------

    async def go_on(self) -> Escalation:
        """Let the session go on: recorded first, and not at all while the cell is away."""
        cell = self._fleet.cell(self._invocation.cell or "")
        if not self._fleet.attached(cell):
            raise Conflict("cell_offline", f"the cell `{cell.id}` is away: it cannot be told to go on")
        closed = await self._commit_session("approve", APPROVED)
        self._fleet.order(cell, self._human("resolve_continue"))
        return closed

    async def terminate(self) -> Escalation:
        """End the session: sent first."""
        cell = self._fleet.cell(self._invocation.cell or "")
        self._fleet.restrain(cell, self._human("resolve_terminate"))
        return await self._commit_session("deny", DENIED)

    async def _commit_session(self, decision: str, status: str) -> Escalation:
        now = self._register.now()
        approval = {"by": self._principal.name, "at": now, "digest": self._escalation.digest}
        approvals = (approval,) if status == APPROVED else ()
        closed = self._escalation.evolve(now, status=status, approvals=approvals)
        invocation = self._invocation.evolve(now, escalation=closed.reference())
        await self._desk.commit([self._event(decision, closed)], closed, invocation)
        return closed

    def _human(self, op: str) -> Human:
        return Human.model_validate({"invocation": self._invocation.id, "op": op, "actor": self._principal.name})

    def _event(self, decision: str, escalation: Escalation) -> EventDraft:
        return EventDraft(
            kind=EventKind.APPROVAL,
            actor=self._principal.name,
            invocation=self._invocation.id,
            body={"decision": decision, "escalation": escalation.public(), "comment": self._comment},
        )


def _escalation_event(escalation: Escalation) -> EventDraft:
    return EventDraft(
        kind=EventKind.ESCALATION,
        actor=SERVER,
        invocation=escalation.invocation,
        body={"escalation": escalation.public()},
    )


def outcome_event(invocation: Invocation, actor: str, *reasons: Mapping[str, str]) -> EventDraft:
    """Return the event that says how an invocation ended."""
    return EventDraft(
        kind=EventKind.OUTCOME,
        actor=actor,
        invocation=invocation.id,
        body={"status": invocation.status, "outcome": invocation.outcome, "reasons": list(reasons)},
    )


def with_reason(policy: Mapping[str, Any] | None, reason: Mapping[str, str]) -> Mapping[str, Any] | None:
    """Return what policy said with one more reason: the agent learns why by code, never in a person's words."""
    return None if policy is None else {**policy, "reasons": [*policy["reasons"], reason]}


def _reason(code: str, message: str, remedy: str) -> dict[str, str]:
    return {"rule": "authority/approval", "code": code, "message": message, "remedy": remedy}


def _gone(escalation: Escalation) -> Conflict:
    if escalation.status == EXPIRED:
        return Conflict("escalation_expired", f"the escalation `{escalation.id}` expired at `{escalation.expires_at}`")
    return Conflict("already_resolved", f"the escalation `{escalation.id}` is `{escalation.status}` already")
