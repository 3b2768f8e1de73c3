"""What people may do to invocations.

What restrains (pause, stop, cancel) is sent before it is recorded; what loosens (resume, rollback) is recorded before
it is sent.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from app.governance.authority import refusal
from app.governance.model import SESSION, AuthorityMode, Outcome, Role, Status
from app.protocol import Human
from app.runtime.drafts import escalation_event, human_event, outcome_event
from app.runtime.errors import Conflict, NotFound
from app.runtime.handback import take_back
from app.runtime.invocation import may_see
from app.runtime.overtaken import check_newest
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.runtime.cells import Cell
    from app.runtime.desk import Desk
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Register

UNNAMED: Final = ""
LOOK_S: Final = 0.002  # between two looks at a question whose answer is being recorded

MOVING: Final = frozenset({Status.RUNNING, Status.RECOVERING})
# Which statuses an operator's word is legal in, and whether it restrains.
OPERATIONS: Final[Mapping[str, tuple[frozenset[Status], bool]]] = {
    "pause": (MOVING | {Status.PAUSED}, True),
    "stop": (SESSION, True),
    "resume": (frozenset({Status.PAUSED}), False),
    "rollback": (frozenset({Status.RUNNING, Status.PAUSED, Status.ESCALATED}), False),
}
# How what waits for approval ends by such a word.
WITHDRAWN: Final[Mapping[str, Outcome]] = {"cancel": Outcome.CANCELLED, "stop": Outcome.STOPPED}
ANYWHERE: Final = frozenset({"stop"})  # what no mode of authority is asked for (design, rule 6)


class Controls:
    """The words of people about invocations, carried to cells and into the record."""

    register: Register
    kernel: Kernel
    fleet: Fleet
    desk: Desk

    async def visible(self, invocation_id: str, principal: Principal) -> Invocation:
        """Return an invocation's newest version.

        Raises:
            NotFound: there is none that this principal may see.
        """
        found = await self.register.load(invocation_id)
        if not may_see(principal, found.agent):
            raise NotFound("invocation", invocation_id)
        return found

    async def pause(self, invocation_id: str, principal: Principal) -> dict[str, Any]:
        """Hold a session in place; sent first, and the answer's `recorded` says whether it is in.

        Errors as `stop`, and Conflict `interrupt_not_enabled`, or `ending`, `estop_latched` where it was stopped.
        """
        return await self._operate("pause", invocation_id, principal)

    async def resume(self, invocation_id: str, principal: Principal, after: int | None = None) -> dict[str, Any]:
        """Let a paused session go on; recorded first. Arguments and errors as of `rollback`."""
        return await self._operate("resume", invocation_id, principal, after)

    @uncut
    async def stop(self, invocation_id: str, principal: Principal) -> dict[str, Any]:
        """End an invocation: a session by a controlled stop, sent first; the answer's `recorded` says whether it is in.

        One that waits for approval is never launched.

        Raises:
            NotFound: there is none that this principal may see.
            Conflict: `wrong_status`, it is over.
            RecordUnavailable: nothing was recorded, and it goes on waiting; it cannot be launched unrecorded either.
        """
        ended = await self._withdrawn("stop", invocation_id, principal)
        return await self._operate("stop", invocation_id, principal) if ended is None else ended

    async def rollback(self, invocation_id: str, principal: Principal, after: int | None = None) -> dict[str, Any]:
        """Take a session back to where it began; recorded first. Said again, it carries on what is under way.

        Args:
            invocation_id: whose session.
            principal: who says so.
            after: the newest event that they had seen; None if they do not say.

        Errors as `cancel`, and Conflict `cell_offline`, `estop_latched`, `control_held`, `interrupt_not_enabled`, or
        `overtaken` by a word that was said after the event; Forbidden `role_forbidden`, they may say it no more.
        """
        return await self._operate("rollback", invocation_id, principal, after)

    @uncut
    async def cancel(self, invocation_id: str, principal: Principal) -> dict[str, Any]:
        """Withdraw an invocation: before launch it ends here, a session is told to stop.

        Raises:
            NotFound: there is none that this principal may see.
            Conflict: `wrong_status`, it is over; `ending`, it has been stopped already; `rollback_ordered`, an agent
                may not call off the rollback that a human ordered; `control_held`, nor end what a human drives.
            RecordUnavailable: nothing was recorded, and it goes on waiting. A session is told to stop all the same, and
                the answer's `recorded` says whether that is in.
        """
        await self.visible(invocation_id, principal)
        entry = self.register.entry(invocation_id)
        if entry is not None and entry.newest.status in SESSION:
            return await self._cancel(entry.newest, principal)
        if (ended := await self._withdrawn("cancel", invocation_id, principal)) is not None:
            return ended
        if entry is not None and entry.newest.status in SESSION:  # it was approved while this waited
            return await self._cancel(entry.newest, principal)
        raise _wrong_status("cancel", (await self.register.load(invocation_id)).status)

    async def _cancel(self, present: Invocation, principal: Principal) -> dict[str, Any]:
        cell = self.fleet.cell(present.cell or UNNAMED)
        if cell.ending(present.id) not in {None, "cancel"}:
            raise _ending("cancel", cell, present)
        if principal.role is Role.AGENT and present.terms.undone_by is not None:
            raise Conflict(
                "rollback_ordered",
                "an operator ordered that this be undone; valid: wait for its end, or ask an operator",
            )
        if principal.role is Role.AGENT and cell.driven(present.id):
            raise Conflict("control_held", "a human has the controls; valid: wait until they give it back or end it")
        return await self._restrain("cancel", present, principal)

    async def _withdrawn(self, op: str, invocation_id: str, principal: Principal) -> dict[str, Any] | None:
        """End what waits for approval, with its question; None where it does not, or was approved meanwhile."""
        entry = self.register.entry(invocation_id)
        if entry is None or entry.newest.status is not Status.AWAITING_APPROVAL:
            return None
        if not may_see(principal, entry.newest.agent):
            raise NotFound("invocation", invocation_id)
        async with entry.lock:
            present = entry.newest
            if present.status is not Status.AWAITING_APPROVAL:
                return None
            question = self.desk.withdrawal(present.id)
            if question is None:
                raise _wrong_status(op, present.status)
            ended = present.evolve(
                self.register.now(), status=Status.DENIED, outcome=WITHDRAWN[op], escalation=question.reference()
            )
            drafts = [human_event(op, ended, principal), escalation_event(question)]
            drafts.append(outcome_event(ended, principal.name))
            await self.desk.commit(drafts, question, ended)
            return ended.public()

    @uncut
    async def _operate(
        self, op: str, invocation_id: str, principal: Principal, after: int | None = None
    ) -> dict[str, Any]:
        legal, restrains = OPERATIONS[op]
        present = self.register.newest(invocation_id) or await self.visible(invocation_id, principal)
        if not may_see(principal, present.agent):
            raise NotFound("invocation", invocation_id)
        if op == "pause":
            present = await self._answered(present)
        if present.final or (present.status not in legal and not self._stands(op, present)):
            raise _wrong_status(op, present.status)
        self._allow(op, present)
        cell = self.fleet.cell(present.cell or UNNAMED)
        if op != "stop":
            self._goes_on(op, cell, present)
        if restrains:
            return await self._restrain(op, present, principal)
        if op == "resume" and (reasons := self.desk.kept_back(present)):
            raise Conflict("resume_refused", "the policy in force does not let it go on; valid: stop", reasons=reasons)
        if op == "rollback":
            _not_driven(cell)
        return await self._loosen(op, cell, present, principal, after)

    def _stands(self, op: str, present: Invocation) -> bool:
        """Say whether a word is legal for what was said before it.

        A session that asked, and has its answer, may be paused: it may move already, its cell's word of it is on its
        way. So may one that is asked about and moves: its recovery ends before it waits for the answer. One that is
        paused, by its cell's own word, may be resumed: where that cannot be recorded, the refusal says so. One that is
        undone because a human said so may be told once more: it is, or it is carried on.
        """
        state = self.fleet.cell(present.cell or UNNAMED).state
        said = None if state is None or state.invocation != present.id else state.status
        if op == "pause":
            moves = said in MOVING or self.desk.pending_for(present.id) is None
            return present.status is Status.ESCALATED and moves
        if op == "resume":
            return said == Status.PAUSED and present.status in MOVING
        return op == "rollback" and present.status is Status.RECOVERING and present.terms.undone_by is not None

    async def _answered(self, present: Invocation) -> Invocation:
        """Return a session that is asked about as it stands once an answer that is being recorded is in.

        A pause that was refused for it now would find the robot going on the moment after. It waits no longer than
        that: not for its turn behind reports that are being recorded, while the robot goes on.
        """
        entry = self.register.entry(present.id)
        if entry is None:
            return present

        def asked() -> bool:
            return entry.newest.status is Status.ESCALATED and not self._stands("pause", entry.newest)

        while asked() and await _taken(entry.lock):  # noqa: ASYNC110 (whoever has it, or the question, tells nobody)
            await asyncio.sleep(LOOK_S)
        return entry.newest

    async def _loosen(
        self, op: str, cell: Cell, present: Invocation, principal: Principal, after: int | None
    ) -> dict[str, Any]:
        """Record a word on which a session moves, then send it; nothing is kept for a cell that is away."""
        if not self.fleet.attached(cell):
            raise Conflict("cell_offline", f"the cell `{cell.id}` is away: it cannot be told to {op}")
        decided = cell.moment
        self.register.check_undamaged()
        if after is not None:
            await check_newest(self.register, cell, present.id, principal, after)
        undone_by = await self._record(op, cell, present, principal)
        try:
            self.fleet.order(cell, _message(op, present, principal), decided=decided)
        except Conflict as error:  # the cell left while this was recorded: nothing comes of it, and the record says so
            await take_back(self.register, op, present.id, error.code, undone_by=undone_by)
            raise
        return (await self.register.load(present.id)).public()

    async def _record(self, op: str, cell: Cell, present: Invocation, principal: Principal) -> str | None:
        """Record what loosens. Who wants a session undone stands with it: its end is not the agent's from now on.

        Returns who had ordered that before, if somebody had.
        """
        entry = self.register.entry(present.id)
        if entry is None:
            raise _wrong_status(op, (await self.register.load(present.id)).status)
        async with entry.lock:
            present = entry.newest
            if present.final:
                raise _wrong_status(op, present.status)
            self.desk.ask_again(principal)
            if op != "rollback":
                await self.register.append([human_event(op, present, principal)])
                return None
            _not_driven(cell)  # again: somebody may have taken over meanwhile, and nothing is undone under their hand
            before = present.terms.undone_by
            terms = replace(present.terms, undone_by=before or principal.name)
            version = present.evolve(self.register.now(), terms=terms)
            await self.register.append([human_event(op, present, principal)], versions=[version])
        return before

    def _allow(self, op: str, present: Invocation) -> None:
        """Hold a word to the authority of the profile that the session was launched under.

        Raises:
            Conflict: `interrupt_not_enabled`.
        """
        if op in ANYWHERE:
            return
        refused = refusal(self.kernel.policy, present.profile, AuthorityMode.INTERRUPT_ENABLED)
        if refused is not None:
            raise Conflict.of(refused)

    def _goes_on(self, op: str, cell: Cell, present: Invocation) -> None:
        """Refuse a word to a session that was stopped: it only comes to rest, and nothing would become of the word.

        Raises:
            Conflict: `ending`, `estop_latched`.
        """
        if self.fleet.latched(cell):
            raise Conflict(
                "estop_latched", f"`{op}` is not possible: an emergency stop ended the session, `{cell.id}` is latched"
            )
        if cell.ending(present.id):
            raise _ending(op, cell, present)

    async def _restrain(self, op: str, present: Invocation, principal: Principal) -> dict[str, Any]:
        """Send a restraint, then record it, later if need be: it was obeyed, and the answer says so either way."""
        self.fleet.restrain(self.fleet.cell(present.cell or UNNAMED), _message(op, present, principal))
        recorded = await self.register.say(human_event(op, present, principal))
        return {**(await self.register.load(present.id)).public(), "recorded": recorded}


async def _taken(lock: asyncio.Lock) -> bool:
    """Say whether somebody has a lock; between two of them nobody has, for a moment."""
    if not lock.locked():
        await asyncio.sleep(0)
    return lock.locked()


def _not_driven(cell: Cell) -> None:
    if cell.control is not None:
        raise Conflict("control_held", f"`{cell.control.holder}` has the controls; valid: they release it to roll back")


def _message(op: str, invocation: Invocation, principal: Principal) -> Human:
    return Human.model_validate({"invocation": invocation.id, "op": op, "actor": principal.name})


def _ending(op: str, cell: Cell, invocation: Invocation) -> Conflict:
    word = cell.ending(invocation.id)
    return Conflict("ending", f"`{op}` is not possible after `{word}`: the session is coming to its end")


def _wrong_status(op: str, status: Status) -> Conflict:
    return Conflict("wrong_status", f"`{op}` is not possible while the invocation is `{status}`")
