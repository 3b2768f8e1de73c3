"""Taking over, and driving: one lease for each cell's controls, and the authorizations that go with it.

A human drives under an authorization of their own, decided, recorded and signed as any (`takeover`), for the session
that runs or for one that is nothing else. Jog commands are not recorded one by one: the right to give them is, before
the first one moves anything, and the cell records what they come to. What restrains (a lapse, an end) is sent first.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING, Any, Final

from app.audit.event import EventDraft
from app.clock import monotonic_s
from app.governance.authority import refusal
from app.governance.control import TAKEOVER, Claim, Control, Taking, Where, command, take
from app.governance.model import SESSION, AuthorityMode, EventKind, Proposal, Reason, Role, Status, Wish
from app.governance.plans import watch_plan
from app.protocol import Jog
from app.runtime.cells import Hands
from app.runtime.drafts import SERVER
from app.runtime.errors import Conflict, InvalidParams
from app.runtime.handback import Handbacks
from app.runtime.hands import OPEN, taken
from app.runtime.invocation import Invocation, Terms, reasons_document
from app.runtime.overtaken import check_pause
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.runtime.cells import Cell, Moment
    from app.runtime.invocation import Principal
    from app.runtime.kernel import Judgement

LOOK_S: Final = 0.1


class Takeovers(Handbacks):
    """Who drives what by hand."""

    # -- taking ------------------------------------------------------------------------------------------------------

    @uncut
    async def take_over(self, invocation_id: str, principal: Principal, after: int | None = None) -> dict[str, Any]:
        """Take the controls of a session; returns the lease.

        Args:
            invocation_id: whose session.
            principal: who takes them.
            after: the last `seq` of the record that they had seen; None if they do not say.

        Raises:
            NotFound: there is none that this principal may see.
            Conflict: `wrong_status`, `takeover_not_enabled`, `control_held` (naming the holder), `ending`,
                `cell_offline`, `takeover_refused` with policy's reasons; `overtaken`, it would end a pause that they
                had not seen.
            Forbidden: `role_forbidden`, they may do so no more once it is their turn.
            RecordUnavailable: nothing was recorded, and nobody has taken anything.
        """
        present = await self._session(invocation_id, principal)
        cell = self.fleet.cell(present.cell or "")
        self._allow_takeover(present.profile)
        self._reachable(cell, present.id)
        lapsed = cell.control is None or cell.control.lapsed(monotonic_s())
        if present.capability == TAKEOVER and lapsed and (present.takeover or {}).get("state") in OPEN:
            raise Conflict("ending", "whoever drove it has let go, and with that it ends; valid: the idle cell, then")
        before, how = self._take(cell, principal, present.id)
        decided = cell.moment
        now = self.register.now()
        cell.control_at = cell.control_at if how is Taking.RENEWED else now
        document, mine, control = cell.control_document() or {}, cell.takings, cell.control
        try:
            if how is Taking.GRANTED:
                await self._change_hands(cell, present.id, principal, decided, document, after)
            else:
                if how is Taking.PREEMPTED:
                    self._still(cell)
                    cell.unrecorded = control
                await self._pass_on(cell, present, principal, document, how)
        except BaseException:
            whole = how is Taking.GRANTED and cell.takings == mine  # with it goes what was renewed of it
            whole |= cell.unrecorded is control and cell.is_passing()
            if cell.control is not None and (whole or cell.control.lease == document.get("lease")):
                cell.control = before
            raise
        finally:
            if cell.unrecorded is control:
                cell.unrecorded = None
        return _theirs(cell, document)

    @uncut
    async def take_cell(self, cell_id: str, principal: Principal, after: int | None = None) -> dict[str, Any]:
        """Take the controls of a cell that is idle, or driven by hand already; returns the lease.

        Of two who want it, the second waits until the first is in the record, and then meets who has it.
        `after` counts there, as in `take_over`.

        Raises:
            NotFound: no such cell.
            Forbidden: as `take_over`.
            Conflict: as `take_over`, and `cell_busy` where a session runs: that is taken over by its own name.
            RecordUnavailable: nothing was recorded, and nobody has taken anything.
        """
        cell = self.fleet.cell(cell_id)
        async with cell.taking:
            await self.fleet.settle(cell)
            busy = self.fleet.busy(cell)
            if busy is None:
                return await self._take_idle(cell, principal)
        known = self.register.newest(busy)
        if known is None or known.capability != TAKEOVER:
            raise Conflict("cell_busy", f"the cell `{cell.id}` runs `{busy}`; valid: take that over")
        return await self.take_over(busy, principal, after)

    async def _take_idle(self, cell: Cell, principal: Principal) -> dict[str, Any]:
        self._allow_takeover(self.fleet.profile(cell))
        self.desk.ask_again(principal)
        self._reachable(cell, "")
        self._same_site(cell)
        params = self._alone(cell, self.fleet.profile(cell))
        judgement = self.kernel.judge(Proposal(capability=TAKEOVER, params=params), None, cell)
        _held_to(judgement)
        name = self.kernel.identities.make("inv")
        before, _ = self._take(cell, principal, name)
        cell.control_at = self.register.now()
        document = cell.control_document() or {}
        invocation = self._driving(name, cell, principal, params, judgement)
        try:
            async with self.kernel.launch(invocation, judgement) as launch:
                word = self._word("takeover", invocation, principal, document, Taking.GRANTED)
                drafts = [word, *judgement.events(invocation), *launch.events]
                await self.register.append(drafts, launch.rows, [launch.invocation])
        except BaseException:
            cell.control = before
            raise
        return _theirs(cell, document)

    def _same_site(self, cell: Cell) -> None:
        """Refuse controls that the cell has said it would not give: it works by another site than policy's."""
        state = cell.state if cell.fresh else None
        if state is not None and state.elsewhere and state.policy_digest == self.kernel.policy.digest:
            remedy = "stop it, or put a policy of the robot's site in force"
            raise _not_let(Reason("authority/takeover", "another_site", state.elsewhere, remedy))

    def _allow_takeover(self, profile: str) -> None:
        refused = refusal(self.kernel.policy, profile, AuthorityMode.TAKEOVER_ENABLED)
        if refused is not None:
            raise Conflict.of(refused)

    def _take(self, cell: Cell, principal: Principal, invocation: str) -> tuple[Control | None, Taking]:
        """Take the lease at once, before anything is awaited: of two who want it, one has it then."""
        now_s = monotonic_s()
        if cell.control is not None and cell.control.lapsed(now_s):
            self.fleet.loosen(cell, SERVER)
        before = cell.control
        where = Where.LOCAL if principal.station == cell.id else Where.REMOTE
        claim = Claim(
            lease=self.kernel.identities.make("lease"),
            holder=principal.name,
            where=where,
            invocation=invocation,
            at_s=now_s,
        )
        how, control = take(before, claim)
        if how is Taking.REFUSED:
            held = f"`{control.holder}` has the controls of `{cell.id}` ({control.where})"
            raise Conflict("control_held", f"{held}; valid: when they hand back, or from the cell's own station")
        cell.control = control
        cell.takings += how is Taking.GRANTED
        return before, how

    async def _pass_on(
        self, cell: Cell, present: Invocation, principal: Principal, document: Mapping[str, Any], how: Taking
    ) -> None:
        """Record that a lease took the place of another, and from where it is held now.

        Raises:
            Conflict: `takeover_refused`, it was let go of before that; `given_up`, they wait for the answer no more.
            Forbidden: `role_forbidden`, they may do so no more once it is their turn.
        """
        entry = self.register.entry(present.id)
        word = self._word("takeover", present, principal, document, how)
        held = {"where": document["where"], "since": document["since"]}
        passing = cell.is_passing()  # then even a renewal waits for what it renews
        if entry is None or (how is Taking.RENEWED and not passing and not _moved(entry.newest, held)):
            self.desk.ask_again(principal)
            await self.register.append([word])
            return
        async with entry.lock:  # whoever had it before may be about to have it recorded
            renewed = how is Taking.PREEMPTED and cell.is_passing()  # by the same person, who has to have taken them
            if cell.control is None or (cell.control.lease != document["lease"] and not renewed):
                raise _lost(cell)
            self.desk.ask_again(principal)
            newest = entry.newest
            takeover = {**(newest.takeover or {}), **held}
            versions = [newest.evolve(self.register.now(), takeover=takeover)] if _moved(newest, held) else []
            await self.register.append([word], versions=versions)

    async def _change_hands(
        self,
        cell: Cell,
        invocation: str,
        principal: Principal,
        decided: Moment,
        document: Mapping[str, Any],
        after: int | None,
    ) -> None:
        entry, mine = self.register.entry(invocation), cell.takings
        if entry is None:
            raise Conflict("wrong_status", f"`{invocation}` has ended")
        async with entry.lock:
            if after is not None:
                await check_pause(self.register, cell, invocation, after)
            present = entry.newest
            if present.status not in SESSION:
                raise Conflict("wrong_status", f"`takeover` is not possible while the invocation is `{present.status}`")
            if cell.control is None or cell.control.invocation != invocation or cell.takings != mine:
                raise _lost(cell)
            self._allow_takeover(present.profile)  # again: another policy may be in force by now
            self.desk.ask_again(principal)
            self._same_site(cell)
            params = self._as_in(cell, present)
            proposal = Proposal(capability=TAKEOVER, params=params)
            judgement = self.kernel.judge(proposal, None, cell, within=present)
            _held_to(judgement)
            limits = judgement.effective(params)
            driving = replace(present, capability=TAKEOVER, effective=limits)
            cell.hands = Hands(judgement.policy, Proposal(capability=TAKEOVER, params=limits), judgement.policy)
            async with self.kernel.launch(driving, judgement, anew=decided) as launch:
                now, permit = self.register.now(), launch.invocation.terms.authorization
                terms = replace(present.terms, taking=True, authorization=permit)
                version = present.evolve(now, takeover=taken(Where(document["where"]), now), terms=terms)
                word = self._word("takeover", present, principal, document, Taking.GRANTED)
                drafts = [word, *judgement.taking_events(driving), *launch.events]
                await self.register.append(drafts, launch.rows, [version])

    def _as_in(self, cell: Cell, present: Invocation) -> dict[str, Any]:
        """Return the limits of a session: whoever takes it over is held to them as it was.

        Of a capability that policy has dropped meanwhile nothing says them: those of driving an idle cell count then.
        """
        policy, effective = self.kernel.policy, dict(present.effective or {})
        if present.capability not in policy.capabilities:
            return self._alone(cell, present.profile)
        bounds = watch_plan(policy, present.capability, present.profile, effective, present.terms.mode).bounds
        return self._limits(
            tcp_speed_mps=bounds.tcp_speed_mps,
            base_speed_mps=bounds.base_speed_mps,
            grip_force_n=bounds.grip_force_n,
        )

    def _alone(self, cell: Cell, profile: str) -> dict[str, Any]:
        """Return the limits of driving an idle cell: the profile's; what is held already stays as firmly held."""
        facts = self.fleet.facts(cell).facts
        if facts is None or facts.gripper_empty:
            return self._limits()
        limit = self.kernel.policy.profiles[profile].limits["grip_force_n"]
        return self._limits(grip_force_n=limit.maximum)

    def _limits(self, **limits: float) -> dict[str, Any]:
        """Return limits as policy takes them of whoever drives; whoever takes the controls said none of these."""
        try:
            return self.kernel.fill_in(TAKEOVER, limits)
        except InvalidParams as error:
            told = f"`{TAKEOVER}` does not take the limits that are to be held here: {error}"
            why = Reason("authority/takeover", "params_invalid", told, "stop it, or put a policy in force that does")
            raise _not_let(why) from error

    def _driving(
        self, name: str, cell: Cell, principal: Principal, params: Mapping[str, Any], judgement: Judgement
    ) -> Invocation:
        now = self.register.now()
        where = Where.REMOTE if cell.control is None else cell.control.where
        return Invocation(
            id=name,
            status=Status.RUNNING,
            capability=TAKEOVER,
            agent=principal.name,
            cell=cell.id,
            requested=params,
            effective=judgement.effective(params),
            escalation=None,
            outcome=None,
            created_at=now,
            updated_at=now,
            terms=Terms(),
            takeover=taken(where, now),
            **judgement.parts(),
        )

    # -- driving -----------------------------------------------------------------------------------------------------

    def jog(
        self, principal: Principal, cell_id: str, lease: str, number: int, wish: Wish, late_s: float = 0.0
    ) -> str | None:
        """Pass a hold-to-run command on to the cell; return None, or the code of why it is not. Never waits.

        `not_holder`, `lease_lapsed`, `returning`, `out_of_order`, `too_late` (`control.command`; letting go never is),
        `not_finite`, `cell_offline`; why the cell does not do it is in its document's `control`, and what `jogged`
        returns.
        """
        if principal.role is not Role.OPERATOR or not self.fleet.knows(cell_id):
            return "not_holder"
        cell = self.fleet.cell(cell_id)
        if cell.control is None or cell.is_passing():
            return "not_holder"
        if not all(map(isfinite, (*wish.base, *wish.tool))):
            return "not_finite"
        self.kernel.heard(principal)
        cell.control, why = command(
            cell.control,
            lease=lease,
            holder=principal.name,
            number=number,
            now_s=monotonic_s(),
            late_s=late_s if wish != Wish() else 0.0,  # letting go is never too late
        )
        if why is not None:
            return why
        message = Jog.model_construct(
            invocation=cell.control.invocation,
            lease=lease,
            actor=principal.name,
            n=number,
            base=wish.base,
            tool=wish.tool,
            grip=wish.grip,
        )
        return None if self.fleet.jog(cell, message) else "cell_offline"

    def jogged(self, cell_id: str) -> str | None:
        """Return why the cell does not do what the newest command it has taken asks for, as far as it has said so."""
        cell = self.fleet.cell(cell_id)
        jog = cell.state.jog if cell.fresh and cell.state is not None else None
        return None if jog is None else jog.refused

    def _still(self, cell: Cell) -> None:
        control = cell.control
        if control is not None:
            here, resting = control.invocation, (0.0, 0.0, 0.0)
            # By no lease: it is the new holder who has to let go, and nobody does so for them.
            self.fleet.jog(cell, Jog(invocation=here, lease="", actor=SERVER, n=0, base=resting, tool=resting))

    async def watch_leases(self) -> None:
        """Take the controls out of hands that are silent, or that policy does not let drive any more, for ever."""
        async with asyncio.TaskGroup() as saying:
            while True:
                await asyncio.sleep(LOOK_S)
                if drafts := self.loosen_hands():  # whoever loses them next does not wait for the record of these
                    saying.create_task(self._say_loosened(drafts), name="loosened")

    @uncut
    async def _say_loosened(self, drafts: list[EventDraft]) -> None:
        await self.register.say(*drafts)

    def loosen_hands(self) -> list[EventDraft]:
        """Take the controls, at once, out of every hand that may have them no longer; return what to record of it."""
        now_s, said = monotonic_s(), list[EventDraft]()
        for cell in self.fleet.cells():
            control = cell.control
            if control is None:
                continue
            why = {"op": "control_lapsed"} if control.lapsed(now_s) else self._not_allowed(cell, control)
            if why is not None:
                self.fleet.loosen(cell, SERVER)
                body = {**why, "cell": cell.id, "holder": control.holder, "lease": control.lease}
                said.append(EventDraft(kind=EventKind.HUMAN, actor=SERVER, invocation=control.invocation, body=body))
        return said

    def _not_allowed(self, cell: Cell, control: Control) -> dict[str, Any] | None:
        """Return why the policy in force lets nobody drive what is driven; what is not recorded yet is asked there."""
        driven = self.register.newest(control.invocation)
        if driven is None or (driven.takeover or {}).get("state") not in OPEN:
            return None
        refused = refusal(self.kernel.policy, driven.profile, AuthorityMode.TAKEOVER_ENABLED)
        reasons = self._bound_otherwise(cell, driven) if refused is None else (refused,)
        return {"op": "control_withdrawn", "reasons": reasons_document(reasons)} if reasons else None

    def _bound_otherwise(self, cell: Cell, driven: Invocation) -> tuple[Reason, ...]:
        """Return what policy has by now against how a session is driven; that of an idle cell is a session itself."""
        hands, policy = cell.hands, self.kernel.policy
        if hands is None or hands.compared is policy or driven.capability == TAKEOVER:
            return ()
        cell.hands = hands._replace(compared=policy)
        context = self.kernel.context(TAKEOVER, driven.agent, driven)
        covered = ()  # while a human drives nothing recovers by itself
        return self.kernel.departure(hands.policy, hands.proposal, context, covered).reasons


def _theirs(cell: Cell, document: dict[str, Any]) -> dict[str, Any]:
    """Return a lease that holds still: while it was recorded a stop, a lost link or silence may have ended it."""
    if cell.control is None or cell.control.lease != document["lease"]:
        raise _lost(cell)
    return document


def _lost(cell: Cell) -> Conflict:
    """Return why somebody has not what they took: by the time it was recorded another taking has it, or nobody."""
    if cell.control is None:
        return Conflict("takeover_refused", f"the controls of `{cell.id}` were let go of meanwhile")
    return Conflict("takeover_refused", f"`{cell.control.holder}` has taken the controls of `{cell.id}` since")


def _held_to(judgement: Judgement) -> None:
    if judgement.status is not Status.RUNNING:
        raise _not_let(*judgement.reasons())


def _not_let(*reasons: Reason) -> Conflict:
    message = "policy does not let anybody drive now"
    return Conflict("takeover_refused", message, reasons=reasons_document(reasons))


def _moved(session: Invocation, held: Mapping[str, Any]) -> bool:
    """Say whether a session that a human has says of them that they are somewhere else than where it is held from."""
    known = session.takeover or {}
    return known.get("state") in OPEN and known.get("where") != held["where"]
