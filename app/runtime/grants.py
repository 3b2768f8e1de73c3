"""Standing grants: giving, using, ending.

A grant is recorded before it answers for anything. Its end restrains: it holds from the moment it is said, and is
recorded then, later if need be. A cell's emergency stop ends every grant on it, whoever pressed it and wherever; so do
another profile of the cell and another policy. What somebody granted ends with their own authority.
`governance.authority` decides what a grant is for and answers to.
"""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from app.audit.documents import follow, is_founded, nothing_said
from app.audit.errors import RecordUnavailable
from app.clock import monotonic_s, parse_rfc3339, rfc3339
from app.governance.authority import grantable
from app.governance.model import EventKind, Grant, GrantScope, Reason
from app.runtime.drafts import SERVER, grant_event
from app.runtime.errors import Conflict, Forbidden, InvalidParams, NotFound
from app.runtime.grant import ACTIVE, LEAST_MINUTES, GrantEnded, Standing, read_standing
from app.runtime.overtaken import check_waiting
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence

    from app.audit.documents import Said
    from app.audit.event import RowWrite
    from app.runtime.cells import Cell
    from app.runtime.escalation import Escalation
    from app.runtime.fleet import Fleet
    from app.runtime.grant import GrantRequest
    from app.runtime.invocation import Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Register

POLL_S: Final = 0.25
PAGE: Final = 500
MILLISECOND_S: Final = 0.001  # events are stamped to that
RULE: Final = "authority/grants"
MOST_GRANTS: Final = 64  # more of them nobody keeps in view


class Grants:
    """Standing grants of one server."""

    def __init__(self, register: Register, fleet: Fleet, kernel: Kernel) -> None:
        """Take where changes are recorded, whose cells they are for, and what decides by them."""
        self._register = register
        self._fleet = fleet
        self._kernel = kernel
        self._active: dict[str, Standing] = {}
        self._until_s: dict[str, float] = {}  # on the clock that nobody puts back
        self._dropped: dict[str, tuple[int, str, str]] = {}  # by cell: how often, and for what and by whom at last
        self._unrecorded: list[Standing] = []
        self._recording = asyncio.Lock()
        self.unfounded: frozenset[str] = frozenset()  # active by their rows, which is not what the log says
        self.on_changed: Callable[[Standing], None] = lambda _: None
        self.may_give: Callable[[str], bool] = lambda _: True  # whether somebody of that name may answer questions now
        kernel.standing = self.standing

    # -- reading -----------------------------------------------------------------------------------------------------

    def standing(self, cell: Cell | None) -> tuple[Grant, ...]:
        """Return the grants that may answer for a cell, the oldest first."""
        if cell is None:
            return ()
        here = (one.grant for one in self._active.values() if one.grant.cell == cell.id)
        return tuple(grant for grant in here if self.may_give(grant.issued_by))

    def active(self) -> list[Standing]:
        """Return every grant that has not ended, the newest first."""
        return list(reversed(self._active.values()))

    async def list(
        self, *, status: str | None = None, limit: int = 50, cursor: str | None = None
    ) -> tuple[list[dict[str, Any]], str | None]:
        """Return grants, newest first, and the cursor behind them. Raises `ValueError` on a bad limit or cursor."""
        page = await self._register.store.page("grants", {"status": status}, limit=limit, cursor=cursor)
        rows = [row for row in page.items if row["id"] not in self.unfounded]
        found = self._register.stored.those_of("grants", rows, read_standing)
        unsaid = {one.id: one for one in self._unrecorded}
        return [unsaid.get(one.id, one).public() for one in found], page.next

    def trouble(self) -> str | None:
        """Say which grants hold for nothing, because only their rows know them."""
        if not self.unfounded:
            return None
        named = ", ".join(f"`{name}`" for name in sorted(self.unfounded))
        return (
            f"{named}: not what the log says was given, so it holds for nothing; valid: look with `reins audit verify`"
        )

    # -- giving ------------------------------------------------------------------------------------------------------

    @uncut
    async def give(self, principal: Principal, request: GrantRequest) -> dict[str, Any]:
        """Grant something in advance; errors as `build`.

        Raises:
            Conflict: `given_up`, they wait for the answer no more.
            RecordUnavailable: nothing is granted.
        """
        check_waiting(principal)
        standing = self.build(principal, request)
        await self._register.append([grant_event("given", principal.name, standing)], [standing.row()])
        return self._hold(standing).public()

    def hold(self, *given: Standing) -> None:
        """Let grants that are recorded stand, but for those of cells whose grants were dropped meanwhile."""
        for standing in given:
            self._hold(standing)

    def _hold(self, standing: Standing) -> Standing:
        self._keep(standing)
        self.on_changed(standing)
        times, code, by = self._dropped.get(standing.grant.cell, (0, "", ""))
        return standing if standing.drops == times else self._end(standing, code, by)

    def _keep(self, standing: Standing) -> None:
        self._active[standing.id] = standing
        left_s = standing.grant.expires_at_s - self._register.now_s()
        self._until_s.setdefault(standing.id, monotonic_s() + left_s)

    def build(self, principal: Principal, request: GrantRequest, escalation: Escalation | None = None) -> Standing:
        """Return a grant that policy allows; `hold` it once it is recorded.

        Raises:
            InvalidParams: a scope that does not fit, or too short.
            Forbidden: `own_proposal`, nobody grants themselves anything.
            Conflict: `grant_refused`, with the reason: names there are not, too long, or what policy says;
                `profile_changed`, the cell is not under the profile that was named.
        """
        cell = self._check(request)
        if principal.name == request.agent:
            raise Forbidden("own_proposal", "nobody grants themselves anything")
        policy = self._kernel.policy
        if refused := grantable(policy, request.capability, cell.profile) or self._unfit(cell):
            raise refused_for(refused)
        most_s = policy.authority.grants.up_to_s if policy.authority.grants else 0.0
        if request.minutes < LEAST_MINUTES:
            raise _invalid("minutes", f"`{request.minutes:g}` is too short: valid are at least {LEAST_MINUTES:g}")
        if request.minutes * 60.0 > most_s:
            message = f"`minutes` `{request.minutes:g}` is longer than policy allows"
            raise refused_for(Reason(RULE, "too_long", message, f"at most {most_s / 60.0:g}"))
        now = self._register.now()
        issued_s = parse_rfc3339(now)
        grant = Grant(
            id=self._kernel.identities.make("gr"),
            capability=request.capability,
            agent=request.agent,
            cell=cell.id,
            profile=cell.profile,
            policy_digest=policy.digest,
            scope=request.scope,
            issued_by=principal.name,
            issued_at_s=issued_s,
            expires_at_s=parse_rfc3339(rfc3339(issued_s + request.minutes * 60.0)),
            object=request.object,
            task=request.task,
        )
        return Standing(
            grant=grant,
            status=ACTIVE,
            escalation=None if escalation is None else escalation.id,
            invocation=None if escalation is None else escalation.invocation,
            uses=0,
            used_at=None,
            ended=None,
            created_at=now,
            updated_at=now,
            drops=self._dropped.get(cell.id, (0,))[0],
        )

    def _check(self, request: GrantRequest) -> Cell:
        """Return the cell a request is for. Raises `InvalidParams` and `Conflict` as `build` does."""
        policy = self._kernel.policy
        _known("capability", request.capability, policy.capabilities)
        _known("agent", request.agent, policy.agents)
        _known("cell", request.cell, [cell.id for cell in self._fleet.cells()])
        cell = self._fleet.cell(request.cell)
        if request.profile not in (None, cell.profile):
            message = f"`{request.profile}` is not what `{cell.id}` is under: valid is `{cell.profile}`"
            raise Conflict("profile_changed", message)
        for name, value, scope in (
            ("object", request.object, GrantScope.OBJECT),
            ("task", request.task, GrantScope.TASK),
        ):
            if (value is not None) != (request.scope is scope):
                raise _invalid(name, f"goes with the scope `{scope}`, and that scope with it")
        if request.object is not None:
            _known("object", request.object, policy.site.objects)
        return cell

    def _unfit(self, cell: Cell) -> Reason | None:
        if self._fleet.latched(cell):
            return Reason(RULE, "estop_latched", f"`{cell.id}` is stopped", "reset it first")
        if len(self._active) >= MOST_GRANTS:
            return Reason(RULE, "too_many", f"`{MOST_GRANTS}` grants stand already", "revoke some")
        return None

    # -- using -------------------------------------------------------------------------------------------------------

    def stands(self, grant_id: str | None) -> bool:
        """Say whether a launch may go by a grant still; by none it may."""
        return grant_id is None or self._answering(grant_id) is not None

    def _answering(self, grant_id: str) -> Standing | None:
        """Return a grant that has not ended, nor is about to because its giver may give no more."""
        present = self._active.get(grant_id)
        return present if present is not None and self.may_give(present.grant.issued_by) else None

    @contextmanager
    def use(self, grant_id: str | None) -> Generator[list[RowWrite]]:
        """Count a launch under a grant, as long as what is to be recorded with it is recorded inside the context.

        Nothing may be awaited between the entrance and the append.

        Raises:
            GrantEnded: it has ended since the decision.
        """
        if grant_id is None:
            yield []
            return
        present = self._answering(grant_id)
        if present is None:
            raise GrantEnded
        now = self._register.now()
        used = present.evolve(now, uses=present.uses + 1, used_at=now)
        self.hold(used)
        try:
            yield [used.row()]
        except BaseException:
            self._not_used(used, present.used_at)
            raise

    def _not_used(self, used: Standing, before: str | None) -> None:
        """Take back a use of which there is no record; another one that came meanwhile stays counted."""
        present = self._active.get(used.id)
        if present is not None:
            at = before if present.used_at == used.used_at else present.used_at
            self.hold(present.evolve(self._register.now(), uses=present.uses - 1, used_at=at))

    # -- ending ------------------------------------------------------------------------------------------------------

    @uncut
    async def revoke(self, grant_id: str, principal: Principal) -> dict[str, Any]:
        """End a grant; it holds at once, and the answer's `recorded` says whether the record has it.

        Raises:
            NotFound: no such grant.
            Conflict: `grant_ended`, it has ended already.
        """
        present = self._active.get(grant_id)
        if present is None:
            row = await self._register.store.row("grants", id=grant_id)
            if row is None or grant_id in self.unfounded:
                raise NotFound("grant", grant_id)
            ended = self._register.stored.read("grants", row, read_standing).ended or {"code": "ended"}
            raise Conflict("grant_ended", f"the grant `{grant_id}` has ended already (`{ended['code']}`)")
        closed = self._end(present, "revoked", principal.name)
        return {**closed.public(), "recorded": await self.record_ends()}

    def drop(self, cell: str, code: str, by: str) -> None:
        """End every grant on a cell, at once, also those that are being recorded; `record_ends` records it."""
        self._dropped[cell] = (self._dropped.get(cell, (0,))[0] + 1, code, by)
        for standing in [one for one in self._active.values() if one.grant.cell == cell]:
            self._end(standing, code, by)

    def _end(self, standing: Standing, code: str, by: str) -> Standing:
        closed = standing.end(self._register.now(), code, by)
        del self._active[standing.id], self._until_s[standing.id]
        self._unrecorded.append(closed)
        self.on_changed(closed)
        return closed

    async def record_ends(self) -> bool:
        """Record the ends that are not yet; returns whether none is left."""
        async with self._recording:  # until it is in the record, memory says that they ended
            ends = tuple(self._unrecorded)
            if not ends:
                return True
            try:
                await self._register.append(
                    [grant_event("ended", (one.ended or {}).get("by", SERVER), one) for one in ends],
                    [one.row() for one in ends],
                )
            except RecordUnavailable:
                return False
            del self._unrecorded[: len(ends)]
        return True

    # -- keeping on --------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """End what is over: by time, a stop that a cell latched itself, another profile or policy, or its giver."""
        now_s = self._register.now_s()
        for standing in tuple(self._active.values()):
            if (code := self._over(standing.grant, now_s)) is not None:
                self._end(standing, code, SERVER)

    def _over(self, grant: Grant, now_s: float) -> str | None:
        if now_s >= grant.expires_at_s or monotonic_s() >= self._until_s[grant.id]:
            return "expired"
        if not self.may_give(grant.issued_by):
            return "giver_withdrawn"
        if grant.policy_digest != self._kernel.policy.digest:
            return "policy_changed"
        cell = self._fleet.cell(grant.cell) if self._fleet.knows(grant.cell) else None
        if cell is not None and self._fleet.latched(cell):
            return "estop"
        return None if self._fleet.profile(cell) == grant.profile else "profile_changed"  # forgotten: the default

    async def watch(self) -> None:
        """End what is over, for ever."""
        while True:
            self.look()
            await self.record_ends()
            await asyncio.sleep(POLL_S)

    async def recall(self) -> None:
        """Read back the grants that stood when the server ended, and end what is over since.

        Nobody signs a row, and a grant stands in for a person's word. So only what the log says was given stands; the
        rest is `unfounded`, and holds for nothing.
        """
        rows = await self._register.store.rows("grants", {"status": ACTIVE})
        given: Mapping[str, Said] = await self._given() if rows else {}
        self.unfounded = frozenset(row["id"] for row in rows if not is_founded(row, given))
        founded = [row for row in rows if row["id"] not in self.unfounded]
        standing = self._register.stored.those_of("grants", founded, read_standing)
        for one in sorted(standing, key=lambda one: one.id):
            self._keep(one)
            if await self._put_back(given[one.id].seq):
                self._end(one, "expired", SERVER)
        self.look()
        await self.record_ends()

    async def _put_back(self, seq: int) -> bool:
        """Say whether the clock was put back since an event: nobody knows then how much time has passed."""
        later_s = self._register.now_s() + MILLISECOND_S
        return bool(await self._register.store.events(after=seq - 1, since=later_s, limit=1))

    async def _given(self) -> Mapping[str, Said]:
        said, after = nothing_said(), 0
        while page := await self._register.store.events(kind=EventKind.GRANT, after=after, limit=PAGE):
            after = follow(page, said)
        return said["grants"]


def _known(field: str, name: str, names: Sequence[str] | Any) -> None:  # noqa: ANN401  # a mapping by name will do
    if name not in names:
        valid = ", ".join(f"`{one}`" for one in sorted(names))
        message = f"`{field}` names no {field} there is: `{name}`"
        raise refused_for(Reason(RULE, f"unknown_{field}", message, valid or "none is known yet"))


def refused_for(reason: Reason) -> Conflict:
    """Return the conflict by which nothing is granted in advance, with its reason."""
    return Conflict("grant_refused", f"{reason.message}; valid: {reason.remedy}", reasons=[reason._asdict()])


def _invalid(field: str, message: str) -> InvalidParams:
    return InvalidParams([{"path": field, "message": message}])
