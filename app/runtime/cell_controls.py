"""What people may do to cells: stop one and latch it, leave the stop in two steps, put it under another profile.

The stop is sent before it is recorded, and whatever comes of the record; what leaves it is recorded first, and moves
nothing.
"""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any, Final

from app.audit.cells import NOT_CONFIRMED
from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.clock import monotonic_s, rfc3339
from app.governance.model import EventKind
from app.protocol import Estop, SetProfile
from app.runtime.cells import Arming
from app.runtime.drafts import SERVER, cell_word
from app.runtime.errors import Conflict, NotFound
from app.runtime.overtaken import check_waiting
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from app.runtime.cells import Cell, Moment
    from app.runtime.desk import Desk
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Register

CONFIRM_S: Final = 10.0  # between the two steps of a reset


class CellControls:
    """The words of people about cells, carried to them and into the record."""

    register: Register
    kernel: Kernel
    fleet: Fleet
    desk: Desk

    @uncut
    async def estop(self, cell_id: str, principal: Principal) -> dict[str, Any]:
        """Stop a cell at once and latch it; anyone may. The answer's `recorded` says whether the record took it.

        Raises:
            NotFound: no such cell.
        """
        cell = self.fleet.cell(cell_id)
        word = cell_word("estop", cell, principal)
        cell.latched = True
        cell.stops += 1
        cell.control = cell.arming = None
        self.fleet.restrain(cell, Estop(actor=principal.name))
        self.desk.grants.drop(cell.id, "estop", principal.name)
        try:
            await self.fleet.roster.keep(cell, [word], estop=True)
        except RecordUnavailable:
            cell.latch_unkept = True
            await self.register.say(word)
            return {**self.fleet.document(cell), "recorded": False}
        cell.latch_unkept = False
        await self.desk.grants.record_ends()
        return {**self.fleet.document(cell), "recorded": True}

    @uncut
    async def reset(self, cell_id: str, principal: Principal, code: str | None = None) -> dict[str, Any]:
        """Leave a latched stop; recorded first, moves nothing.

        The answer waits, shortly, for the cell to say so itself; its `latched` is what a launch would meet. Where the
        cell does not say so, the record says that behind the reset (`not_confirmed`), and the cell counts as latched
        until it says that it has no stop (`confirmed`), or hears another reset. A stop that the cell has set by itself
        since its newest state, as it was when this was said, or armed, stays.

        Args:
            cell_id: which cell.
            principal: who resets it.
            code: what `arm_reset` returned; None where it is done in one step.

        Raises:
            NotFound: no such cell.
            Conflict: `not_latched`, `cell_offline`; `not_armed`, the code is not the one that was given to this person
                since the last stop, or its time is over: whoever had armed the reset has to arm it anew; `given_up`,
                they wait for the answer no more.
            RecordUnavailable: nothing was recorded, it stays latched.
        """
        cell = self._resettable(cell_id)
        check_waiting(principal)
        seen, decided = _seen(cell, principal, code), cell.moment
        self.desk.grants.drop(cell.id, "estop", principal.name)  # none outlives a stop that the cell latched by itself
        cell.resetting += 1
        try:
            await self._reset(cell, principal, seen, decided)
        finally:
            cell.resetting -= 1
        return self.fleet.document(cell)

    async def _reset(self, cell: Cell, principal: Principal, seen: int, decided: Moment) -> None:
        before, unkept = cell.stops, cell.latch_unkept
        cell.latch_unkept = False  # or the latch could follow the word that leaves it into the record
        try:
            await self.fleet.roster.keep(cell, [cell_word("reset", cell, principal)], estop=False)
        except RecordUnavailable:
            cell.latch_unkept = unkept or cell.latch_unkept
            raise
        async with cell.unlatching:
            cell.unheard = cell.journal if cell.stops == before else None
            if cell.stops == before:  # none has come while this was recorded, or waited for another reset
                cell.latched = cell.latch_unkept = False
                if await self.fleet.unlatch(cell, principal.name, seen=seen, decided=decided):
                    cell.unheard = None
                    await self._refused(cell)
                elif cell.unheard is not None:  # nor has it reported one
                    body = {"what": NOT_CONFIRMED, "op": "reset", "cell": cell.id, "journal": cell.unheard}
                    await self.register.say(EventDraft(kind=EventKind.CELL, actor=SERVER, body=body))

    async def _refused(self, cell: Cell) -> None:
        """Keep a stop that its cell, which heard the reset, has not left: its next run may not know of it."""
        if cell.state is not None and cell.state.latched:
            cell.latched = cell.latch_unkept = True
            await self.fleet.roster.keep_late()

    def arm_reset(self, cell_id: str, principal: Principal) -> dict[str, Any]:
        """Prepare to leave a latched stop: returns the code to confirm it with. Changes nothing else, moves nothing.

        Raises:
            NotFound: no such cell.
            Conflict: `not_latched`, `cell_offline`.
        """
        cell = self._resettable(cell_id)
        until_s = monotonic_s() + CONFIRM_S
        code = secrets.token_hex(4)
        cell.arming = Arming(code=code, by=principal.name, stops=cell.stops, seen=cell.seen, until_s=until_s)
        expires_at = rfc3339(self.register.now_s() + CONFIRM_S)
        return {**self.fleet.document(cell), "arming": {"code": code, "expires_at": expires_at}}

    def _resettable(self, cell_id: str) -> Cell:
        cell = self.fleet.cell(cell_id)
        if not self.fleet.latched(cell):
            raise Conflict("not_latched", f"the cell `{cell.id}` is not latched")
        if not self.fleet.attached(cell):
            raise Conflict("cell_offline", f"the cell `{cell.id}` is away: it cannot be reset")
        return cell

    @uncut
    async def set_profile(
        self, cell_id: str, profile: str, principal: Principal, before: str | None = None
    ) -> dict[str, Any]:
        """Put a cell under another environment profile; where `before` is said, only from under that one.

        What runs keeps the one it was authorized under; what waits for approval is decided again, and asked anew.

        Raises:
            NotFound: no such cell, no such profile.
            Conflict: `profile_changed`, it is under another one than `before`; `given_up`, they wait for the answer no
                more.
            RecordUnavailable: nothing was recorded, the profile stays.
        """
        cell = self.fleet.cell(cell_id)
        if profile not in (profiles := self.kernel.profiles()):
            raise NotFound("profile", profile, sorted(profiles))
        async with cell.profiling:
            if before not in {None, cell.profile}:
                message = f"`{cell.id}` is under `{cell.profile}`, not `{before}` any more; valid: compare with that"
                raise Conflict("profile_changed", message)
            check_waiting(principal)
            await self._put_under(cell, profile, principal)
        await self.desk.decide_again()  # what was asked was shown under the former profile
        return self.fleet.document(cell)

    async def _put_under(self, cell: Cell, profile: str, principal: Principal) -> None:
        before = cell.profile
        draft = EventDraft(
            kind=EventKind.PROFILE_CHANGED,
            actor=principal.name,
            body={"cell": cell.id, "before": before, "profile": profile},
        )
        await self.fleet.roster.keep(cell, [draft], profile=profile)
        cell.profile = profile
        if profile != before:
            self.desk.grants.drop(cell.id, "profile_changed", principal.name)
            await self.desk.grants.record_ends()
        if self.fleet.attached(cell):
            self.fleet.order(cell, SetProfile(profile=profile), decided=cell.moment)


def _seen(cell: Cell, principal: Principal, code: str | None) -> int:
    """Return the tick of the state that a reset is said of; whatever was armed is over.

    Raises:
        Conflict: `not_armed`.
    """
    confirmed = code is not None and _confirms(cell, principal, code)
    armed, cell.arming = cell.arming, None
    if armed is not None and confirmed:
        return armed.seen
    if code is not None:
        disarmed = "" if armed is None else f", and the one that `{armed.by}` armed is off"
        raise Conflict("not_armed", f"`{code[:64]}` confirms no reset of `{cell.id}`{disarmed}; valid: arm it anew")
    return cell.seen


def _confirms(cell: Cell, principal: Principal, code: str) -> bool:
    armed = cell.arming
    return (
        armed is not None
        and cell.armed_by == principal.name
        and secrets.compare_digest(armed.code.encode(), code.encode())
    )
