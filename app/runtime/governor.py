"""The governor: one invocation's way, from the proposal to its end, and what people may do to it meanwhile.

`propose` is the pipeline of design section 4: held to the schema, decided, recorded with its decision in one append,
and launched only behind that record. Nothing is awaited between the decision and the claim on the cell.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from app.audit.errors import RowExists
from app.audit.event import EventDraft, RowWrite
from app.governance.model import EventKind, Role, Status
from app.governance.permit import same_numbers
from app.governance.recorded import KEY as CIRCUMSTANCES
from app.runtime.cell_controls import CellControls
from app.runtime.controls import Controls
from app.runtime.drafts import escalation_event
from app.runtime.errors import Conflict, InvalidParams
from app.runtime.grant import GrantEnded
from app.runtime.identity import digest
from app.runtime.invocation import (
    Invocation,
    Principal,
    ProposalRequest,
    Terms,
    public_document,
    without_free_text,
)
from app.runtime.kernel import REFUSED_OUTCOME
from app.runtime.overtaken import check_waiting
from app.runtime.takeover import Takeovers
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from app.audit.event import Event
    from app.audit.store import AuditStore
    from app.runtime.desk import Desk
    from app.runtime.feed import Feed
    from app.runtime.fleet import Cell, Fleet
    from app.runtime.kernel import Judgement, Kernel
    from app.runtime.register import Register

TRACE_PAGE: Final = 1000
FORGOTTEN: Final = Terms()  # of what is final at once: its proposal is in the record


class Governor(Takeovers, Controls, CellControls):
    """Takes proposals and people's words through the pipeline. Performs effects, decides nothing."""

    def __init__(self, *, register: Register, kernel: Kernel, fleet: Fleet, desk: Desk, feed: Feed) -> None:
        """Take the parts; `app.runtime.assembly.assemble` is the usual way."""
        self.register = register
        self.kernel = kernel
        self.fleet = fleet
        self.desk = desk
        self.feed = feed
        self._in_flight: set[tuple[str, str]] = set()
        self._letting_go = False
        self.broken = ""  # what ended the work in the background: no deadline is met any more, and no cell is tended
        self.shadowed: Callable[[Judgement, Invocation], tuple[EventDraft, ...]] = lambda _, __: ()
        self.sealed: Callable[[str], Awaitable[None]] = _nothing_is_sealed

    @property
    def store(self) -> AuditStore:
        """Return the record."""
        return self.register.store

    # -- proposing ---------------------------------------------------------------------------------------------------

    async def propose(
        self, principal: Principal, request: ProposalRequest, idempotency_key: str | None = None
    ) -> tuple[dict[str, Any], bool]:
        """Decide on a proposal, record it, and launch it where that is the decision.

        Returns the invocation and whether it is new; with a key that was used for the same request before, it is the
        one of then.

        Raises:
            InvalidParams: parameters that do not fit the schema, or an unknown cell.
            Conflict: `in_flight` (the key's first request is not answered yet), `idempotency_mismatch`; `given_up`, it
                would launch or ask people, and its agent waits for the answer no more: nothing was recorded.
            RecordUnavailable: nothing was recorded and nothing moves.
        """
        if idempotency_key is None:
            return (await self._propose(principal, request, ())).public(), True
        place = (principal.name, idempotency_key)
        if place in self._in_flight:
            raise Conflict("in_flight", f"the first request with the key `{idempotency_key}` is not answered yet")
        self._in_flight.add(place)
        try:
            return await self._propose_once(principal, request, idempotency_key)
        finally:
            self._in_flight.discard(place)

    async def _propose_once(
        self, principal: Principal, request: ProposalRequest, key: str
    ) -> tuple[dict[str, Any], bool]:
        request_digest = digest(same_numbers(request.document()))
        known = await self.store.row("idempotency", agent=principal.name, key=key)
        if known is None:
            slot = {"agent": principal.name, "key": key, "request_digest": request_digest, "status": "done"}
            try:
                return (await self._propose(principal, request, (slot,))).public(), True
            except RowExists:  # the first one's client hung up while it was being recorded, and said it again
                known = await self.store.row("idempotency", agent=principal.name, key=key)
        if known is None or known["request_digest"] != request_digest:
            raise Conflict("idempotency_mismatch", f"the key `{key}` was used for another request")
        return await self.invocation(str(known["invocation"]), principal), False

    async def _propose(
        self, principal: Principal, request: ProposalRequest, slots: Sequence[Mapping[str, str]]
    ) -> Invocation:
        policy = self.kernel.policy
        params = self.kernel.fill_in(request.capability, request.params, request.version)
        cell = self._aim(request)
        await self.fleet.settle(cell)
        if self.kernel.policy is not policy:  # one version decides, from the schema on
            params = self.kernel.fill_in(request.capability, request.params, request.version)
        judgement = self.kernel.judge(request.proposal(params), principal.name, cell)
        invocation = self._decided(principal, request, params, cell, judgement)
        if judgement.need is not None and (full := self.desk.no_room(principal.name)) is not None:
            invocation = judgement.refuse(invocation, full)
        if not invocation.final:
            check_waiting(principal)
        proposal = EventDraft(
            kind=EventKind.PROPOSAL,
            actor=principal.name,
            invocation=invocation.id,
            body={**request.document(), "filled": params, "created_at": invocation.created_at},
        )
        drafts = [proposal, *judgement.events(invocation), *self.shadowed(judgement, invocation)]
        rows = [
            RowWrite(
                table="idempotency",
                values={**slot, "invocation": invocation.id, "created_at": invocation.created_at},
                once=True,
            )
            for slot in slots
        ]
        if (
            not invocation.final and judgement.need is None and cell is not None
        ):  # at once: nothing else may be decided on the cell's being free
            self.fleet.claim(cell, invocation.id)
        asks = not invocation.final and judgement.need is not None
        try:
            with self.desk.asking(principal.name) if asks else nullcontext():
                return await self._open(invocation, judgement, drafts, rows)
        except GrantEnded:  # between the decision and its record, of which there is none: without the grant, then
            return await self._propose(principal, request, slots)

    @uncut
    async def _open(
        self, invocation: Invocation, judgement: Judgement, drafts: Sequence[EventDraft], rows: Sequence[RowWrite]
    ) -> Invocation:
        """Ask for approval, or launch, or leave it at the decision."""
        if invocation.final:
            await self.register.append(drafts, rows, [invocation])  # its outcome is the decision, and stands in it
            return invocation
        need = judgement.need
        if need is not None:
            question = self.desk.question(invocation, need, self.kernel.risk(invocation.capability))
            asking = replace(invocation, escalation=question.reference())
            await self.desk.commit([*drafts, escalation_event(question)], question, asking, rows)
            return asking
        async with self.kernel.launch(invocation, judgement, judgement.by_grant) as launch:
            with self.desk.grants.use(invocation.grant) as used:
                await self.register.append([*drafts, *launch.events], [*rows, *launch.rows, *used], [launch.invocation])
        return launch.invocation

    def _aim(self, request: ProposalRequest) -> Cell | None:
        if request.cell is None:
            return self.fleet.choose()
        if not self.fleet.knows(request.cell):
            valid = ", ".join(f"`{cell.id}`" for cell in self.fleet.cells()) or "none has attached yet"
            message = f"names no cell there is: `{request.cell}`; valid: {valid}"
            raise InvalidParams([{"path": "cell", "message": message}])
        return self.fleet.cell(request.cell)

    def _decided(
        self,
        principal: Principal,
        request: ProposalRequest,
        params: Mapping[str, Any],
        cell: Cell | None,
        judgement: Judgement,
    ) -> Invocation:
        status = judgement.status
        now = self.register.now()
        return Invocation(
            id=self.kernel.identities.make("inv"),
            status=status,
            capability=request.capability,
            agent=principal.name,
            cell=None if cell is None else cell.id,
            requested=params,
            effective=judgement.effective(params),
            escalation=None,
            outcome=REFUSED_OUTCOME.get(status),
            grant=judgement.grant,
            created_at=now,
            updated_at=now,
            terms=FORGOTTEN if status in REFUSED_OUTCOME else _terms(request),
            **judgement.parts(),
        )

    async def check(self, principal: Principal, request: ProposalRequest) -> dict[str, Any]:
        """Return what would become of a proposal now, as an invocation without id; nothing is recorded.

        There is no question yet that could say why people are asked, so `asks` does.

        Raises:
            InvalidParams: parameters that do not fit the schema, or an unknown cell.
        """
        params = self.kernel.fill_in(request.capability, request.params, request.version)
        cell = self._aim(request)
        judgement = self.kernel.judge(request.proposal(params), principal.name, cell)
        document = self._decided(principal, request, params, cell, judgement).public()
        for absent in ("id", "created_at", "updated_at"):
            del document[absent]
        if document["status"] is Status.RUNNING:
            document["status"] = "allowed"
        if (asks := judgement.asking_document()) is not None:
            document["asks"] = asks
        return document

    # -- reading -----------------------------------------------------------------------------------------------------

    async def invocation(self, invocation_id: str, principal: Principal) -> dict[str, Any]:
        """Return an invocation.

        Raises:
            NotFound: there is none that this principal may see.
        """
        return (await self.visible(invocation_id, principal)).public()

    async def wait(
        self, invocation_id: str, principal: Principal, seconds: float, known_updated_at: str | None = None
    ) -> dict[str, Any]:
        """Return an invocation at its next change, or after the time; at once when it is final or newer than known.

        Once the server stops (`let_go`), that is at once too.

        Raises:
            NotFound: there is none that this principal may see.
        """
        await self.visible(invocation_id, principal)
        patience_s = 0.0 if self._letting_go else seconds
        return (await self.register.wait(invocation_id, patience_s, known_updated_at)).public()

    def let_go(self) -> None:
        """Answer whoever waits for a change with what there is, and nobody waits from now on: the server stops."""
        self._letting_go = True
        self.register.wake()

    async def list(
        self, principal: Principal, filters: Mapping[str, str | None], *, limit: int = 50, cursor: str | None = None
    ) -> tuple[list[dict[str, Any]], str | None]:
        """Return invocations, newest first, and the cursor behind them; an agent gets its own alone.

        Args:
            principal: who asks.
            filters: any of `status`, `capability`, `agent`, `cell`; None does not filter.
            limit: at most so many, 1 to 1000.
            cursor: the one returned before.

        Raises:
            ValueError: a bad limit or cursor.
            KeyError: a filter that is none.
        """
        wanted = {name: value for name, value in filters.items() if value is not None}
        if principal.role is Role.AGENT:
            if wanted.get("agent", principal.name) != principal.name:
                return [], None
            wanted["agent"] = principal.name
        page = await self.store.page("invocations", wanted, limit=limit, cursor=cursor)
        return self.register.stored.those_of("invocations", page.items, public_document), page.next

    async def trace(self, invocation_id: str, principal: Principal) -> list[dict[str, Any]]:
        """Return τ_t: every event under an invocation, in order, as this principal may see it.

        Raises:
            NotFound: there is none that this principal may see.
        """
        await self.visible(invocation_id, principal)
        trace: list[dict[str, Any]] = []
        after = 0
        while True:
            events = await self.store.events(invocation=invocation_id, after=after, limit=TRACE_PAGE)
            trace.extend(event_document(event, principal.role) for event in events)
            if len(events) < TRACE_PAGE:
                return trace
            after = events[-1].seq

    def ready(self) -> dict[str, str]:
        """Return what is in the way of any launch, by part (`store`, `policy`, `cell/…`, …); empty when nothing is."""
        broken = self.fleet.problems()
        if self.broken:
            broken["background"] = self.broken
        if not self.store.healthy:
            broken["store"] = self.store.reason or "the last write failed"
        if self.store.damage is not None:
            broken["record"] = self.store.damage
        if not self.kernel.policy.gates:
            broken["policy"] = "no capability is enabled in any profile"
        return broken

    def cells(self) -> list[dict[str, Any]]:
        """Return every cell as a document."""
        return [self.fleet.document(cell) for cell in self.fleet.cells()]


def _terms(request: ProposalRequest) -> Terms:
    return Terms(
        mode=request.mode,
        preconditions=request.preconditions,
        recovery_preference=request.recovery_preference,
        metadata=request.metadata,
        version=request.version,
    )


def event_document(event: Event, role: Role) -> dict[str, Any]:
    """Return an event as JSON; an agent gets what it said itself, and nothing of what an operator wrote in words."""
    body = event.payload()
    if role is Role.AGENT:  # what policy is asked about, grants and who is on duty, is no business of an agent's
        body.pop(CIRCUMSTANCES, None)
    return {
        "seq": event.seq,
        "at": event.at,
        "kind": event.kind,
        "invocation": event.invocation,
        "actor": event.actor,
        "body": without_free_text(body) if role is Role.AGENT and event.kind != EventKind.PROPOSAL else body,
    }


async def _nothing_is_sealed(_: str) -> None:
    """Wait for no telemetry: nobody keeps any."""
