"""Versions of policy: brought, checked, compared, put in force, and what is in force when a server comes back.

What is in force changes in one step, and only behind its record: `Kernel.enforce` swaps one reference with nothing
awaited, so every decision is made under exactly one version, and says which. What loosens takes two engineers, what
tightens one; what cannot be told to tighten counts as a loosening.

At a start:

| in force when the server ended | the directory it starts with | in force now |
|---|---|---|
| nothing, or what a directory held | any | the directory's |
| what an engineer put in force | the same | that |
| what an engineer put in force | another | that; the directory's becomes a candidate |
| what an engineer put in force | another, and the start is told to take it | the directory's |
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

import orjson

from app.audit.event import EventDraft, RowWrite
from app.audit.versions import Told, told_of, version_wrong
from app.governance import bundle
from app.governance.errors import PolicyError, PolicyErrors
from app.governance.evolution import outgrown
from app.governance.model import EventKind
from app.runtime.drafts import SERVER
from app.runtime.errors import Conflict, ExaminationFailed, Forbidden, NotFound
from app.runtime.examining import Candidate
from app.runtime.overtaken import check_waiting
from app.runtime.proving import Proving
from app.runtime.recollection import events_of
from app.runtime.uncut import uncut
from app.runtime.version import (
    ACTIVE,
    AWAITING,
    CANDIDATE,
    DIRECTORY,
    FORMER,
    REQUEST,
    SETTING,
    InForce,
    Version,
    files_row,
    read_version,
)
from app.runtime.vouching import Vouching, vouching, words_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.changes import Comparison
    from app.governance.policy import PolicySet
    from app.runtime.examining import Examine, Examined
    from app.runtime.invocation import Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Register
    from app.runtime.succession import Succession

KEPT_COMPILED: Final = 4  # beside those that are needed: a candidate is compiled once for its checks and its activation
CASES: Final = f"{bundle.TESTS_FOLDER}/"


def candidate_of(files: Mapping[str, str]) -> Candidate:
    """Return what was brought as what is to be examined: what lies in `tests/`, and the promises, decide nothing."""
    return Candidate(
        files={name: text for name, text in files.items() if not name.startswith(CASES) and name != bundle.PROPERTIES},
        cases={name: text for name, text in files.items() if name.startswith(CASES)},
        promises=files.get(bundle.PROPERTIES),
    )


def _demand_versions(active: PolicySet, candidate: PolicySet) -> None:
    """Refuse a candidate with a capability whose version does not say what changed. Raises `PolicyErrors`."""
    if problems := outgrown(active, candidate):
        raise PolicyErrors(problems)


class Versions:
    """Every version that one server knows, and which of them decides."""

    def __init__(
        self, register: Register, kernel: Kernel, succession: Succession, examine: Examine, promises: str | None
    ) -> None:
        """Take where changes are recorded, who decides, what follows, and who examines candidates.

        `promises` is the `properties.yaml` of the directory this server starts with.
        """
        self._register = register
        self._kernel = kernel
        self._succession = succession
        self._examine = examine
        self._promises = promises
        self._changing = asyncio.Lock()  # one change of what is in force at a time
        self.proving = Proving(register, kernel, examine, self.load, self._changing)
        self._compiled: OrderedDict[str, PolicySet] = OrderedDict()
        self._compared: OrderedDict[tuple[str, str], Comparison] = OrderedDict()
        self.may_vouch: Callable[[str], bool] = lambda _: True  # whether somebody of that name is an engineer now
        self.in_force = InForce(kernel.policy.digest, DIRECTORY, "")
        self.reason = ""  # why that, in words, since the start

    # -- reading -----------------------------------------------------------------------------------------------------

    async def list(self, *, limit: int = 50, cursor: str | None = None) -> tuple[list[dict[str, Any]], str | None]:
        """Return versions, the newest first, and the cursor behind them. Raises `ValueError` on a bad one."""
        page = await self._register.store.page("policies", limit=limit, cursor=cursor)
        return self._register.stored.those_of("policies", page.items, _shown), page.next

    async def load(self, digest: str) -> Version:
        """Return a version, as the log has it.

        Raises:
            NotFound: there is none, or none that the log knows.
            RowUnreadable: it is damaged.
        """
        row = await self._register.store.row("policies", id=digest)
        told = told_of(await words_of(self._register.store)).get(digest)
        if row is None or told is None:
            raise NotFound("policy", digest)
        return self._register.stored.read("policies", row, read_version).as_told(told)

    async def compiled(self, digest: str) -> PolicySet:
        """Return a version ready to decide, from its files if need be.

        Raises:
            NotFound: its files are not here.
            RowUnreadable: they are damaged.
            PolicyErrors: they are no policy any more, or not those of the digest.
            ExaminationFailed: they could not be compiled.
        """
        known = self._kernel.policy if self._kernel.policy.digest == digest else self._compiled.get(digest)
        if known is not None:
            return known
        row = await self._register.store.row("policy_files", digest=digest)
        if row is None:
            raise NotFound("policy", digest)
        files = self._register.stored.read("policy_files", row, _files)
        kept = Candidate(files=files, cases={}, promises=None, prove=False)
        policy = (await self._examine(kept, None)).policy
        if policy.digest != digest:
            message = f"what is kept as `{digest}` has the digest `{policy.digest}`"
            raise PolicyErrors([PolicyError(file="policy_files", line=0, key="", message=message)])
        self._remember(policy)
        return policy

    def _remember(self, policy: PolicySet) -> None:
        self._compiled[policy.digest] = policy
        self._compiled.move_to_end(policy.digest)
        while len(self._compiled) > KEPT_COMPILED:
            self._compiled.popitem(last=False)

    async def difference(self, digest: str) -> Comparison:
        """Return what a version would change of what is in force. Errors as `compiled`."""
        version, active = await self.load(digest), self._kernel.policy
        known = self._compared.get((active.digest, digest))
        if known is not None:
            return known
        policy = await self.compiled(digest)
        return (await self._examined(version, policy, active, prove=False))[1]

    async def _examined(
        self, version: Version, policy: PolicySet, active: PolicySet, *, prove: bool
    ) -> tuple[Examined, Comparison]:
        """Have a version compared with what is in force, and proved if need be."""
        candidate = Candidate(files=policy.files, cases={}, promises=version.promises, prove=prove)
        found = await self._examine(candidate, await self._basis(active))
        return found, self._note(active, found)

    async def _basis(self, active: PolicySet) -> Candidate:
        """Return what is in force as what a candidate is compared with."""
        promises = (await self.load(active.digest)).promises
        return Candidate(files=active.files, cases={}, promises=promises, prove=False)

    def _note(self, active: PolicySet, found: Examined) -> Comparison:
        if found.comparison is None:
            raise ExaminationFailed("it was not compared with what is in force")
        self._compared[active.digest, found.policy.digest] = found.comparison
        while len(self._compared) > KEPT_COMPILED:
            self._compared.popitem(last=False)
        return found.comparison

    # -- bringing ----------------------------------------------------------------------------------------------------

    @uncut
    async def propose(self, files: Mapping[str, str], principal: Principal, why: str) -> tuple[dict[str, Any], bool]:
        """Examine a candidate, keep it by its digest, and return it and whether it is new; nothing comes into force.

        Raises:
            PolicyErrors: what is wrong with it; then it is not kept, and nobody can put it in force.
            ExaminationFailed: likewise, because nobody knows.
            RecordUnavailable: it is not kept.
        """
        candidate, active = candidate_of(files), self._kernel.policy
        found = await self._examine(candidate, await self._basis(active))
        self._remember(found.policy)
        async with self._changing:  # of two who bring the same, one brought it
            brought = await self._bring(candidate, found, active, principal, why)
        if brought is not None:
            return brought.public(), True
        known = await self.proving.proved(
            found.policy.digest, candidate.promises, found.proved, actor=principal.name, cases=found.cases
        )
        return known.public(), False

    async def _bring(
        self, candidate: Candidate, found: Examined, active: PolicySet, principal: Principal, why: str
    ) -> Version | None:
        """Keep a version that was examined against what was in force; None where the log knows it already."""
        policy = found.policy
        if policy.digest in told_of(await words_of(self._register.store)):
            return None
        _demand_versions(active, policy)
        comparison = self._note(active, found)  # of a known one, with the promises that are kept with it, another time
        now = self._register.now()
        version = Version(
            digest=policy.digest,
            status=CANDIDATE,
            source=REQUEST,
            by=principal.name,
            why=why,
            against=active.digest,
            rules=len(policy.rules),
            cases=found.cases,
            proved=found.proved,
            promises=candidate.promises,
            created_at=now,
            updated_at=now,
        )
        said = version.event(
            "proposed",
            principal.name,
            against=active.digest,
            comparison=comparison.brief(),
            proved=found.proved,
            promises=candidate.promises,
        )
        await self._register.append([said], [version.row(), files_row(policy.digest, policy.files, now)])
        return version

    # -- putting in force --------------------------------------------------------------------------------------------

    @uncut
    async def activate(
        self, digest: str, principal: Principal, why: str, before: str | None = None
    ) -> tuple[dict[str, Any], bool]:
        """Put a version in force, or note that one engineer wants it; return it and whether it is in force.

        Where `before` is said, only in the place of that one.

        Raises:
            NotFound: there is no such version; one with faults is never kept.
            Conflict: `policy_active`, it is in force; `policy_changed`, another one than `before` is;
                `second_engineer_needed`, it takes another person than those who want it already; `given_up`, they wait
                for the answer no more.
            Forbidden: `role_forbidden`, they are no engineer any more.
            PolicyErrors: a capability changed, and its version does not say so.
            PolicyErrors: it was never proved, because a start brought it, and does not pass its proofs.
            ExaminationFailed: it could not be examined.
            RecordUnavailable: nothing was recorded and nothing has changed.
        """
        async with self._changing:
            version = await self.load(digest)
            active = self._kernel.policy
            if digest == active.digest:
                raise Conflict("policy_active", f"`{digest}` is in force already")
            if before not in {None, active.digest}:
                message = f"`{active.digest}` is in force, not `{before}` any more; valid: compare with that"
                raise Conflict("policy_changed", message)
            candidate = await self.compiled(digest)
            if not version.activations:  # what was in force before may come back
                _demand_versions(active, candidate)
            version, found = await self._sound(version, candidate, active, principal.name)
            check_waiting(principal)
            if not self.may_vouch(principal.name):  # by now: others' changes come first, and proofs take minutes
                raise Forbidden.withdrawn(principal.name)
            words = await vouching(self._register.store, digest) if found.loosens else Vouching()
            others = {name for name in words.others(principal.name) if self.may_vouch(name)}
            if found.loosens and not others:
                return await self._wait_for_second(version, words, found, principal, why), False
            version = await self._enter(version, candidate, found, principal, why, others)
        return version.public(), True

    async def _sound(
        self, version: Version, candidate: PolicySet, active: PolicySet, by: str
    ) -> tuple[Version, Comparison]:
        """Return a version that is proved, and what it would change; both may have been found out before."""
        known = self._compared.get((active.digest, version.digest))
        if version.proved and known is not None:
            return version, known
        found, comparison = await self._examined(version, candidate, active, prove=not version.proved)
        if version.proved:
            return version, comparison
        return await self.proving.keep(
            version.evolve(self._register.now(), proved=found.proved, doubt=""), by
        ), comparison

    async def _wait_for_second(
        self, version: Version, words: Vouching, found: Comparison, principal: Principal, why: str
    ) -> dict[str, Any]:
        if principal.name in words.asked:
            message = f"`{principal.name}` wants it in force already, and it loosens: it takes another engineer"
            raise Conflict("second_engineer_needed", message)
        now = self._register.now()
        word = {"by": principal.name, "at": now, "why": why, "against": self._kernel.policy.digest}
        waiting = version.evolve(now, status=AWAITING, awaiting=word)
        said = waiting.event("awaiting_second", principal.name, awaiting=word, comparison=found.brief())
        await self._register.append([said], [waiting.row()])
        return waiting.public()

    async def _enter(
        self,
        version: Version,
        candidate: PolicySet,
        found: Comparison,
        principal: Principal,
        why: str,
        others: set[str],
    ) -> Version:
        former = self._kernel.policy
        present = await self.load(former.digest)
        by = sorted({principal.name, *others})
        activation = {"by": by, "why": why, "former": former.digest, "direction": found.direction}
        now = self._register.now()
        entered = version.entered(now, activation)
        left = present.evolve(now, status=FORMER)
        body = {
            "policy_version": candidate.digest,
            "source": REQUEST,
            **activation,
            "proposed_by": version.by,
            "awaiting": version.awaiting,
            "comparison": found.brief(),
        }
        said = EventDraft(kind=EventKind.POLICY_ACTIVATED, actor=principal.name, body=body)
        entering = InForce(candidate.digest, REQUEST, why)
        await self._succession.prepare(self.compiled)
        await self._register.append([said], [left.row(), entered.row(), entering.row(now)])
        self.in_force, self.reason = entering, f"an engineer put it in force: {why}"
        self._kernel.enforce(candidate)
        done = self._succession.at_once()
        self._remember(former)
        await self._succession.afterwards(done)
        return entered

    # -- at a start --------------------------------------------------------------------------------------------------

    async def recall(self, *, take_directory: bool = False) -> tuple[list[EventDraft], list[RowWrite]]:
        """Put in force what was, or what the directory of this start holds; return what to record of it.

        Args:
            take_directory: the directory's version comes into force even if an engineer had put another one there.

        Raises:
            PolicyErrors: what was in force is no policy any more, for instance after a newer release.
            NotFound: its files are lost.
            ExaminationFailed: it could not be compiled.
        """
        directory, now = self._kernel.policy, self._register.now()
        before = await self._before()
        drafts: list[EventDraft] = []
        rows: list[RowWrite] = []
        told = await self._told()
        offered, known = await self._known(directory, told.get(directory.digest), now)
        brought: dict[str, Any] = {}
        chosen = before is not None and before.source == REQUEST
        if before is not None and chosen and before.digest != directory.digest and not take_directory:
            why = f"an engineer put it in force: {before.why}"
            self._kernel.enforce(await self.compiled(before.digest))
            self.in_force = before
            if not known:
                drafts.append(offered.event("offered", SERVER, against=before.digest, promises=offered.promises))
                rows += [offered.row(), files_row(directory.digest, directory.files, now)]
        else:
            why = _why_directory(before, directory)
            rows += await self._entered_by_start(offered, before, why, now)
            said = told.get(directory.digest)
            if said is None or not said.promised or said.promises != self._promises:
                brought["promises"] = self._promises
            same = before is not None and before.digest == directory.digest
            self.in_force = before if before and same else InForce(directory.digest, DIRECTORY, why)
        self.reason = why
        body = {
            "policy_version": self.in_force.digest,
            "source": self.in_force.source,
            "why": why,
            "directory": directory.digest,
            "former": None if before is None else before.digest,
            **brought,
        }
        drafts.append(EventDraft(kind=EventKind.POLICY_ACTIVATED, actor=SERVER, body=body))
        return drafts, [*rows, self.in_force.row(now)]

    async def _before(self) -> InForce | None:
        """Return what was in force when the server ended: what the log says was activated last."""
        store = self._register.store
        rows = await store.rows("settings", {"name": SETTING})
        (kept,) = self._register.stored.those_of("settings", rows, _in_force) or (None,)
        said = await events_of(store, kind=EventKind.POLICY_ACTIVATED)
        body: dict[str, Any] = dict(said[-1].payload()) if said else {}
        told = InForce(body["policy_version"], body["source"], body["why"]) if said else None
        if (kept and kept[:2]) == (told and told[:2]):
            return kept
        self._register.unfounded[SETTING] = "its row is not the policy that was activated last"
        return told

    async def _told(self) -> dict[str, Told]:
        """Return what the log says of every version, and note which rows say something else."""
        told = told_of(await words_of(self._register.store))
        for row in await self._register.store.rows("policies"):
            if (wrong := version_wrong(row, told)) is not None:
                self._register.unfounded[row["id"]] = wrong
        return told

    async def _known(self, policy: PolicySet, told: Told | None, now: str) -> tuple[Version, bool]:
        """Return the version of the directory this server starts with, and whether it was known before."""
        row = await self._register.store.row("policies", id=policy.digest)
        if row is not None and told is not None:
            for version in self._register.stored.those_of("policies", [row], read_version):
                return version.as_told(told), True
        made = Version(
            digest=policy.digest,
            status=CANDIDATE,
            source=DIRECTORY,
            by=SERVER,
            why="the directory this server was started with",
            against=None,
            rules=len(policy.rules),
            cases=0,
            promises=self._promises,
            created_at=now,
            updated_at=now,
        )
        return made, False

    async def _entered_by_start(self, version: Version, before: InForce | None, why: str, now: str) -> list[RowWrite]:
        if before is not None and before.digest == version.digest and version.status == ACTIVE:
            if version.promises == self._promises:
                return []
            return [version.evolve(now, promises=self._promises, proved="", doubt="").row()]
        if version.promises != self._promises:  # what was proved was proved with the others
            version = version.evolve(version.updated_at, promises=self._promises, proved="", doubt="")
        activation = {"by": [SERVER], "why": why, "former": None if before is None else before.digest}
        entered = version.entered(now, {**activation, "direction": None})
        rows = [entered.row(), files_row(version.digest, self._kernel.policy.files, now)]
        if before is not None and before.digest != version.digest:
            former = await self._register.store.rows("policies", {"id": before.digest})
            versions = self._register.stored.those_of("policies", former, read_version)
            rows += [version.evolve(now, status=FORMER).row() for version in versions]
        return rows


def _shown(document: bytes) -> dict[str, Any]:
    return read_version(document).public()


def _in_force(value: bytes) -> InForce:
    return InForce(**orjson.loads(value))


def _files(content: bytes) -> dict[str, str]:
    return dict(orjson.loads(content))


def _why_directory(before: InForce | None, directory: PolicySet) -> str:
    if before is None:
        return "the first start: the directory's"
    if before.digest != directory.digest:
        return "the directory holds another version than when the server ended"
    return "it was in force when the server ended, and the directory holds the same"
