"""Handing back what a human drove: the session goes on, is undone, or ends.

A session goes on after a takeover only under a new authorization: its proposal is decided again on the facts of now.
What policy or the cell refuses leaves the controls where they are.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from app.audit.event import EventDraft
from app.audit.projection import NOT_SENT
from app.clock import monotonic_s
from app.governance.control import TAKEOVER, Control, Phase, Taking, keep, returning
from app.governance.model import SESSION, EventKind
from app.protocol import Human
from app.runtime.cells import FRESH_S
from app.runtime.drafts import SERVER
from app.runtime.errors import Conflict, NotFound
from app.runtime.hands import HELD, RETURNING, given_back
from app.runtime.invocation import Invocation, may_see
from app.runtime.overtaken import check_newest
from app.runtime.readmission import RULE, going_on, readmitted, tell_first, told_by
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.runtime.cells import Cell, Moment
    from app.runtime.desk import Desk
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Entry, Register

FACTS_S: Final = FRESH_S  # by then the state that is there says nothing either
RETURN_S: Final = 3.0  # for a robot to come to rest and its plan to be bound anew


class Handbacks:
    """How a session comes out of a human's hands."""

    register: Register
    kernel: Kernel
    fleet: Fleet
    desk: Desk

    @uncut
    async def release(
        self,
        invocation_id: str,
        principal: Principal,
        then: str,
        lease: str | None = None,
        after: int | None = None,
        digest: str | None = None,
    ) -> dict[str, Any]:
        """Hand a session back, to go on (`resume`), to be undone (`rollback`), or done with (`end`).

        Waits, shortly, for the cell to say that it has the session again.

        Args:
            invocation_id: whose session.
            principal: who hands it back.
            then: what becomes of it.
            lease: by which they have the controls; None if they do not say. What ends it counts by whichever lease.
            after: the last `seq` of the record that they had seen; None if they do not say. What ends it counts anyway.
            digest: of the refusal that told them what policy asks, which they approve by going on; None if of none.

        Raises:
            NotFound: there is none that this principal may see.
            Conflict: `wrong_status`, `not_taken_over`, `control_held`, `nothing_to_resume`, `ending`, `cell_offline`;
                `overtaken`, they have them by another lease by now, or others have said a word since; `facts_stale`,
                `paused`, and `resume_refused` with the reasons: the holder keeps the controls.
            Forbidden: `role_forbidden`, they may say so no more once the cell was waited for; likewise.
            RecordUnavailable: nothing was recorded, and the holder keeps the controls.
        """
        present = await self._session(invocation_id, principal)
        cell = self.fleet.cell(present.cell or "")
        control = _held_by(cell, present.id, principal, ends=then == "end")
        self._reachable(cell, present.id)
        if then == "resume" and present.capability == TAKEOVER:
            raise Conflict("nothing_to_resume", "nothing ran before; valid: `rollback`, `end`")
        if then == "end":
            return await self._end(cell, present, principal)
        self.register.check_undamaged()
        decided = cell.moment
        _by_lease(cell, lease)
        cell.control = keep(control, monotonic_s())  # some say nothing else
        newer = await self._newer(cell)
        if after is not None:
            await check_newest(self.register, cell, present.id, principal, after)
        if not newer and then == "resume":  # a rollback is the cell's own to judge
            raise Conflict(
                "facts_stale",
                f"the cell `{cell.id}` has not said for {FACTS_S:g} s where the robot is, so nothing can be decided on "
                "that; valid: again when it does, or `end`",
            )
        if then == "resume" and cell.paused(present.id):  # handing back is no word against it
            raise Conflict(
                "paused", f"an operator paused `{present.id}`; valid: resume it and hand back, or `rollback`, `end`"
            )
        control = _held_by(cell, present.id, principal)  # again: much may have come meanwhile
        _by_lease(cell, lease)
        cell.control = returning(keep(control, monotonic_s()))
        try:
            if then == "resume":
                await self._resume(cell, control, principal, decided, digest)
            else:
                await self._roll_back(cell, control, principal, decided)
        except BaseException:
            _keep(cell, control)
            raise
        return await self._returned(present.id, then)

    async def _newer(self, cell: Cell) -> bool:
        """Wait for the cell's next state, since a plan begins with where the robot is now; say whether there is one."""
        try:
            async with asyncio.timeout(FACTS_S):
                await cell.stated.wait()
        except TimeoutError:
            return False
        return True

    async def _end(self, cell: Cell, present: Invocation, principal: Principal) -> dict[str, Any]:
        document = cell.control_document() or {}
        if cell.control is not None and cell.control.phase is Phase.HELD:
            cell.control = returning(cell.control)
        self.fleet.restrain(cell, Human(invocation=present.id, op="end_takeover", actor=principal.name))
        await self.register.say(self._word("release", present, principal, document, then="end"))
        return await self._returned(present.id, "end")

    async def _resume(
        self, cell: Cell, control: Control, principal: Principal, decided: Moment, said: str | None
    ) -> None:
        invocation = control.invocation
        entry = self.register.entry(invocation)
        if entry is None:
            raise Conflict("wrong_status", f"`{invocation}` has ended")
        async with entry.lock:
            told = await told_by(self.desk, invocation)
            present = _still_held(entry, cell, control)
            found = await readmitted(self.desk, cell, present, principal)
            _still_held(entry, cell, control)  # again: that was waited for
            document = cell.control_document() or {}
            approves = await tell_first(self.desk, present, found, control.lease, told, said)
            self.desk.ask_again(principal)  # last: all of it was waited for
            word = self._word("release", present, principal, document, then="resume", **approves)
            remedy = "hand back again, roll it back, or end it"
            async with going_on(self.desk, cell, found, decided, "resume", remedy) as launch:
                terms = replace(launch.invocation.terms, undone_by=None)  # it goes on: its agent may end it as well
                version = self._given_back(cell, launch.invocation, "resume", terms=terms)
                await self.register.append([word, *launch.events], launch.rows, [version])

    async def _roll_back(self, cell: Cell, control: Control, principal: Principal, decided: Moment) -> None:
        invocation = control.invocation
        entry = self.register.entry(invocation)
        if entry is None:
            raise Conflict("wrong_status", f"`{invocation}` has ended")
        async with entry.lock:
            present, document = _still_held(entry, cell, control), cell.control_document() or {}
            self.desk.ask_again(principal)
            word = self._word("release", present, principal, document, then="rollback")
            terms = replace(present.terms, undone_by=principal.name)
            await self.register.append([word], versions=[self._given_back(cell, present, "rollback", terms=terms)])
        try:
            undo = Human(invocation=invocation, op="rollback", actor=principal.name)
            self.fleet.order(cell, undo, decided=decided)
        except Conflict as error:  # the cell left while this was recorded
            await take_back(self.register, "rollback", invocation, error.code)
            raise

    def _given_back(self, cell: Cell, present: Invocation, then: str, **changes: Any) -> Invocation:  # noqa: ANN401
        read = cell.state is not None and self.fleet.facts(cell).facts is not None  # else they may be anything
        facts = cell.state.facts if read and cell.state is not None else None
        takeover = given_back(present.takeover or {}, then, facts)
        return present.evolve(self.register.now(), takeover=takeover, **changes)

    async def _returned(self, invocation: str, then: str) -> dict[str, Any]:
        """Wait until the cell has said what became of the way back; a refusal is the caller's."""
        known = await self.register.load(invocation)
        with suppress(TimeoutError):
            async with asyncio.timeout(RETURN_S):
                while not known.final and (known.takeover or {}).get("state") in (RETURNING, HELD):
                    code = (known.takeover or {}).get("refused")
                    if code and then != "end":
                        raise Conflict(
                            "resume_refused",
                            f"the cell cannot: `{code}`; the controls stay where they are",
                            reasons=[{"rule": RULE, "code": str(code), "message": f"`{code}`", "remedy": ""}],
                        )
                    known = await self.register.wait(invocation, RETURN_S, known.updated_at)
        return known.public()

    def _word(
        self,
        op: str,
        present: Invocation,
        principal: Principal,
        lease: Mapping[str, Any],
        how: Taking | None = None,
        **more: str,
    ) -> EventDraft:
        body = {"op": op, "role": principal.role, "cell": present.cell, "status": present.status, **more}
        for name in ("lease", "where"):
            body[name] = lease.get(name)
        if how is not None:
            body["how"] = how
        return EventDraft(kind=EventKind.HUMAN, actor=principal.name, invocation=present.id, body=body)

    async def _session(self, invocation_id: str, principal: Principal) -> Invocation:
        present = self.register.newest(invocation_id) or await self.register.load(invocation_id)
        if not may_see(principal, present.agent):
            raise NotFound("invocation", invocation_id)
        if present.status not in SESSION:
            raise Conflict("wrong_status", f"nobody drives an invocation by hand while it is `{present.status}`")
        return present

    def _reachable(self, cell: Cell, invocation: str) -> None:
        if self.fleet.latched(cell):
            raise Conflict("estop_latched", f"the cell `{cell.id}` is stopped and latched; valid: reset it first")
        if word := cell.ending(invocation):
            raise Conflict("ending", f"the session is coming to its end after `{word}`")
        if not self.fleet.attached(cell):
            raise Conflict("cell_offline", f"the cell `{cell.id}` is away: nobody can drive it")


def _still_held(entry: Entry, cell: Cell, control: Control) -> Invocation:
    """Return a session as it is now that nobody else records anything of it.

    Raises:
        Conflict: `wrong_status`, it has ended meanwhile; `not_taken_over`, this lease was let go of meanwhile.
    """
    present = entry.newest
    if present.status not in SESSION:
        raise Conflict("wrong_status", f"`{present.id}` has ended")
    if cell.control is None or cell.control.lease != control.lease:
        raise Conflict("not_taken_over", f"the controls of `{present.id}` were let go of meanwhile")
    return present


def _held_by(cell: Cell, invocation: str, principal: Principal, *, ends: bool = False) -> Control:
    """Return the lease by which a person has the controls of a session.

    Raises:
        Conflict: `not_taken_over`, nobody has; `control_held`, somebody else has, or it is being handed back already,
            which is in the way of all but its end (`ends`).
    """
    control = cell.control
    if control is None or control.invocation != invocation:
        raise Conflict("not_taken_over", f"nobody has the controls of `{invocation}`")
    if control.holder != principal.name:
        raise Conflict("control_held", f"`{control.holder}` has the controls of `{cell.id}`; valid: they hand back")
    if control.phase is Phase.RETURNING and not ends:
        raise Conflict(
            "control_held", f"`{control.holder}` hands `{cell.id}` back; valid: `end`, or once that has failed"
        )
    return control


def _by_lease(cell: Cell, lease: str | None) -> None:
    """Refuse a word that was said by another lease, before the controls were handed out anew. Raises `Conflict`."""
    if lease is not None and (cell.control is None or cell.control.lease != lease):
        message = f"the controls of `{cell.id}` were handed out anew since `{lease}`; valid: look, and say it anew"
        raise Conflict("overtaken", message)


def _keep(cell: Cell, control: Control) -> None:
    """Let a lease go on that was not handed back after all, if nobody else has the controls by now."""
    if cell.control is not None and cell.control.lease == control.lease:
        cell.control = replace(control, heard_s=monotonic_s())


async def take_back(register: Register, op: str, invocation: str, code: str, *, undone_by: str | None = None) -> None:
    """Record of a word that is in the record already that it was never sent; who said it was refused with this code.

    `undone_by` is who had ordered a rollback before, if it was one: theirs stands.
    """
    body = {"what": NOT_SENT, "op": op, "code": code}
    draft = EventDraft(kind=EventKind.CELL, actor=SERVER, invocation=invocation, body=body)
    entry = register.entry(invocation)
    if op != "rollback" or entry is None:
        await register.say(draft)
        return
    async with entry.lock:  # where nobody else undoes it, its end is the agent's as well
        present = entry.newest
        terms = replace(present.terms, undone_by=present.terms.undone_by and undone_by)
        version = present.evolve(register.now(), terms=terms)
        await register.append([draft], versions=[] if present.final else [version])
