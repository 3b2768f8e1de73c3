"""A candidate beside the live policy: it decides on every proposal too, and nothing follows from that but a record.

One candidate at a time. It is asked after the live decision is made, on the same proposal and context; a difference is
an event of its own, recorded with the decision, outside the invocation's trace: agents never see it. What fails in the
candidate is a difference as well, and reaches nobody else.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import orjson

from app.audit.errors import RowUnreadable
from app.audit.event import EventDraft, RowWrite
from app.governance.decision import decide
from app.governance.model import EventKind
from app.governance.policy_model import GOVERNANCE
from app.governance.recorded import Agents
from app.runtime.drafts import SERVER
from app.runtime.errors import NotFound
from app.runtime.invocation import reasons_document
from app.runtime.uncut import uncut
from app.runtime.version import UNREADABLE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.decision import Decision
    from app.governance.model import Context
    from app.governance.policy import PolicySet
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Judgement
    from app.runtime.register import Register
    from app.runtime.versions import Versions

SETTING: Final = "policy_shadow"
EXAMPLES: Final = 3
MOST_GROUPS: Final = 500  # the log holds every difference


@dataclass(slots=True, kw_only=True)
class Group:
    """Differences that have everything in common: how many, and the newest invocations among them."""

    count: int = 0
    examples: list[str] = field(default_factory=list[str])


@dataclass(slots=True, kw_only=True)
class Shadowing:
    """One candidate under shadow since a moment, and what differed since then; a restart of the server begins anew."""

    policy: PolicySet
    agents: Agents
    by: str
    why: str
    since: str
    decisions: int = 0
    differing: int = 0
    groups: dict[tuple[str, str, str, str], Group] = field(default_factory=dict[tuple[str, str, str, str], Group])
    live: str = ""  # which live version these two were found for
    other_inputs: frozenset[str] = frozenset()
    other_agents: frozenset[str] = frozenset()

    def note(self, place: tuple[str, str, str, str], invocation: str) -> None:
        """Count one difference."""
        self.differing += 1
        group = self.groups.get(place)
        if group is None:
            if len(self.groups) >= MOST_GROUPS:
                return
            group = self.groups[place] = Group()
        group.count += 1
        group.examples.insert(0, invocation)
        del group.examples[EXAMPLES:]

    def document(self) -> dict[str, Any]:
        """Return what was found as JSON, the largest group first."""
        groups = sorted(self.groups.items(), key=lambda item: (-item[1].count, item[0]))
        names = ("capability", "profile", "live", "candidate")
        return {
            "digest": self.policy.digest,
            "on": True,
            "by": self.by,
            "why": self.why,
            "since": self.since,
            "decisions": self.decisions,
            "differing": self.differing,
            "groups": [
                {**dict(zip(names, place, strict=True)), "count": group.count, "examples": list(group.examples)}
                for place, group in groups
            ],
        }


class Shadow:
    """Asks a candidate about what the live policy decides."""

    def __init__(self, register: Register, versions: Versions) -> None:
        """Take where differences are recorded, and where candidates are."""
        self._register, self._versions = register, versions
        self._now: Shadowing | None = None
        self._changing = asyncio.Lock()  # one beginning or ending at a time

    # -- beginning and ending ----------------------------------------------------------------------------------------

    @uncut
    async def set(self, digest: str, principal: Principal, why: str, *, on: bool) -> dict[str, Any]:
        """Begin with a candidate, in the place of another one, or end with it; return what was found.

        Begun once more it goes on: what it has found is not lost by somebody who did not know that it had begun.

        Raises:
            NotFound: there is no such version.
            RecordUnavailable: nothing has changed.
        """
        async with self._changing:
            version = await self._versions.load(digest)
            found, now = self.document(digest), self._register.now()
            if found["on"] is on:
                return found
            said = version.event("shadow_begun" if on else "shadow_ended", principal.name, reason=why)
            if not on:
                await self._register.append([said], [_setting(None, now)])
                self._now = None
                return {**found, "on": False}
            policy = await self._versions.compiled(digest)
            kept = {"digest": digest, "by": principal.name, "why": why}
            await self._register.append([said], [_setting(kept, now)])
            self._begin(policy, principal.name, why, now)
            return self.document(digest)

    def _begin(self, policy: PolicySet, by: str, why: str, now: str) -> None:
        self._now = Shadowing(policy=policy, agents=Agents(policy), by=by, why=why, since=now)

    async def recall(self) -> None:
        """Go on with the candidate that was under shadow when the server ended.

        Nothing follows from it: where nobody can read it any more it leaves the shadow, and keeps nobody from starting.

        Raises:
            RecordUnavailable: that it left the shadow is not recorded.
        """
        rows = await self._register.store.rows("settings", {"name": SETTING})
        for kept in self._register.stored.those_of("settings", rows, _kept):
            if kept is not None:
                digest, by, why = kept
                try:
                    policy = await self._versions.compiled(digest)
                except UNREADABLE as error:
                    await self._lost(digest, f"nobody can read it any more: {error}")
                else:
                    self._begin(policy, by, why, self._register.now())

    async def _lost(self, digest: str, why: str) -> None:
        with suppress(NotFound, RowUnreadable):  # then the log says nothing of it either
            version = await self._versions.load(digest)
            said = version.event("shadow_ended", SERVER, reason=why)
            await self._register.append([said], [_setting(None, self._register.now())])

    def document(self, digest: str) -> dict[str, Any]:
        """Return what was found of a candidate; one that is not under shadow has found nothing."""
        present = self._now
        if present is not None and present.policy.digest == digest:
            return present.document()
        empty: dict[str, Any] = {"by": None, "why": None, "since": None, "decisions": 0, "differing": 0, "groups": []}
        return {"digest": digest, "on": False, **empty}

    # -- asking ------------------------------------------------------------------------------------------------------

    def observe(self, judgement: Judgement, invocation: Invocation) -> tuple[EventDraft, ...]:
        """Ask the candidate about a live decision; return the event of a difference, to be recorded with it."""
        present = self._now
        if present is None or judgement.policy is present.policy:
            return ()
        present.decisions += 1
        try:
            decision = _ask(present, judgement)
        except Exception as error:  # whatever a candidate does, the live decision stands
            return (self._differs(present, judgement, invocation, f"error ({type(error).__name__})", None),)
        if decision is None:
            return (self._differs(present, judgement, invocation, "invalid", None),)
        if _same(judgement.decision, decision):
            return ()
        return (self._differs(present, judgement, invocation, _says(decision), decision),)

    def _differs(
        self, present: Shadowing, judgement: Judgement, invocation: Invocation, after: str, decision: Decision | None
    ) -> EventDraft:
        before = _says(judgement.decision)
        present.note((invocation.capability, judgement.profile, before, after), invocation.id)
        verdict = None if decision is None else decision.verdict
        reasons = () if decision is None else decision.admission.reasons
        body = {
            "policy_version": present.policy.digest,
            "live_version": judgement.policy.digest,
            "invocation": invocation.id,
            "live": before,
            "candidate": after,
            "effective": None if verdict is None else verdict.effective,
            "reasons": reasons_document((*reasons, *(() if verdict is None else verdict.reasons))),
        }
        return EventDraft(kind=EventKind.SHADOW, actor=SERVER, body=body)


def _ask(present: Shadowing, judgement: Judgement) -> Decision | None:
    """Return the candidate's decision; None where its schema does not take the parameters."""
    proposal, context, live = judgement.proposal, judgement.context, judgement.policy
    if present.live != live.digest:
        present.live = live.digest
        present.other_inputs = _other_inputs(live, present.policy)
        present.other_agents = _other_agents(live, present.policy)
    if proposal.capability in present.other_inputs:
        params = present.policy.validate_params(proposal.capability, proposal.params, proposal.version)
        if isinstance(params, tuple):
            return None
        proposal = replace(proposal, params=params)
    if context.grants or context.agent.name in present.other_agents:
        context = _as_known(present, context)
    return decide(present.policy, proposal, context)


def _as_known(present: Shadowing, context: Context) -> Context:
    """Return the context as the candidate knows it: the agent's permissions, and grants as if given under it."""
    grants = tuple(replace(grant, policy_digest=present.policy.digest) for grant in context.grants)
    return replace(context, agent=present.agents(context.agent.name), grants=grants)


def _other_agents(live: PolicySet, candidate: PolicySet) -> frozenset[str]:
    """Return whom the two permit something else; whoever neither knows is permitted nothing by both."""
    names = live.agents.keys() | candidate.agents.keys()
    found = {name for name in names if live.agent(name) != candidate.agent(name)}
    return frozenset(found if live.permissions == candidate.permissions else {*found, GOVERNANCE})


def _other_inputs(live: PolicySet, candidate: PolicySet) -> frozenset[str]:
    return frozenset(
        name
        for name, found in candidate.capabilities.items()
        if name not in live.capabilities or live.capabilities[name].inputs != found.inputs
    )


def _same(live: Decision, other: Decision) -> bool:
    if live.status != other.status:
        return False
    asked, asks = live.need, other.need
    if asked is not asks and (asked is None or asks is None or asked.approvers != asks.approvers):
        return False
    one, two = live.verdict, other.verdict
    if one is None or two is None:
        return one is two
    return one.outcome is two.outcome and one.effective == two.effective


def _says(decision: Decision) -> str:
    said = "unchecked" if decision.verdict is None else decision.verdict.outcome
    return decision.status + " (" + said + ")"  # of enumerations that are texts; formatting them takes twice as long


def _kept(value: bytes) -> tuple[str, str, str] | None:
    kept: dict[str, str] | None = orjson.loads(value)
    return None if kept is None else (kept["digest"], kept["by"], kept["why"])


def _setting(kept: Mapping[str, str] | None, at: str) -> RowWrite:
    return RowWrite(table="settings", values={"name": SETTING, "value": orjson.dumps(kept), "updated_at": at})
