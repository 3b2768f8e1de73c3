"""What proofs say of versions of policy that a start brought, and of what is in force.

A version that is brought by request is proved before it is kept. What the directory of a start holds decides at once,
whoever started the server answers for it; it is proved behind the start, in the process that examines candidates. The
verdict stays with the version and its promises, and is recorded:

| verdict | means |
|---|---|
| `unknown` | nobody has tried yet |
| `proved` | no fault; never asked again |
| `refuted` | something does not hold, and the record says what; it goes on deciding, and `/healthz` says so |
| `undecided` | nothing is known to be wrong, and not everything is known to be right |

Why what is refuted goes on deciding: each of its decisions fails closed by itself, and without any policy nothing could
be recovered or handed back. What was proved of a version before holds at the next start as well; what was not is tried
again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.errors import PolicyErrors, Undecided
from app.runtime.drafts import SERVER
from app.runtime.examining import Candidate
from app.runtime.version import REFUTED, UNDECIDED

if TYPE_CHECKING:
    from asyncio import Lock
    from collections.abc import Awaitable, Callable

    from app.governance.errors import PolicyError
    from app.runtime.examining import Examine
    from app.runtime.kernel import Kernel
    from app.runtime.register import Register
    from app.runtime.version import Version

TOLD: Final = 20  # faults in the record; `reins policy check` says all of them
LONGEST: Final = 2000  # of one fault's words, with the case that shows it
BROKEN: Final = "it does not pass its proofs: `reins policy check` says where, and so does its event in the record"


class Found(NamedTuple):
    """A version with its verdict, and what is wrong with it."""

    version: Version
    problems: tuple[PolicyError, ...] = ()


class Proving:
    """Records what proofs say of versions, and knows whether what is in force was refuted."""

    def __init__(
        self,
        register: Register,
        kernel: Kernel,
        examine: Examine,
        load: Callable[[str], Awaitable[Version]],
        changing: Lock,
    ) -> None:
        """Take where verdicts are recorded, what is in force, who examines and loads, and what guards versions."""
        self._register = register
        self._kernel = kernel
        self._examine = examine
        self._load = load
        self._changing = changing
        self._refuted: set[str] = set()  # digests

    def trouble(self) -> str | None:
        """Return what is wrong with what is in force; None where nothing is known to be."""
        return BROKEN if self._kernel.policy.digest in self._refuted else None

    async def recall(self) -> None:
        """Read back what was known of what is in force when the server ended."""
        version = await self._load(self._kernel.policy.digest)
        if version.verdict == REFUTED:
            self._refuted.add(version.digest)

    async def in_force(self) -> Found:
        """Have what is in force proved, if it is not, and record the verdict.

        Raises:
            ExaminationFailed: it could not be examined; nothing is known, and nothing recorded.
            RecordUnavailable: the verdict could not be recorded; `trouble` knows it.
        """
        policy = self._kernel.policy
        version = await self._load(policy.digest)
        if version.proved:
            return Found(version)
        candidate = Candidate(files=policy.files, cases={}, promises=version.promises)
        try:
            found = await self._examine(candidate, None)
        except PolicyErrors as faults:
            verdict = UNDECIDED if isinstance(faults, Undecided) else REFUTED
            return Found(await self._doubted(version, verdict, faults.problems), faults.problems)
        return Found(await self.proved(version.digest, version.promises, found.proved, actor=SERVER))

    async def proved(
        self, digest: str, promises: str | None, proved: str, *, actor: str, cases: int | None = None
    ) -> Version:
        """Record what was proved of a known version, unless that is known, or it has other promises by now.

        Args:
            digest: of the version.
            promises: what was proved with it.
            proved: what was proved, in a sentence.
            actor: who wanted to know.
            cases: how many cases it passed; None where they were not run.
        """
        async with self._changing:
            version = await self._load(digest)
            if version.proved or version.promises != promises:
                return version
            more = {} if cases is None else {"cases": cases}
            return await self.keep(version.evolve(self._register.now(), proved=proved, doubt="", **more), actor)

    async def keep(self, version: Version, actor: str) -> Version:
        """Record that a version is proved, while nobody else changes any. Raises `RecordUnavailable`."""
        said = version.event("proved", actor, proved=version.proved, promises=version.promises)
        await self._register.append([said], [version.row()])
        self._refuted.discard(version.digest)
        return version

    async def _doubted(self, tried: Version, verdict: str, problems: tuple[PolicyError, ...]) -> Version:
        if verdict == REFUTED:
            self._refuted.add(tried.digest)
        async with self._changing:
            version = await self._load(tried.digest)
            if version.proved or version.promises != tried.promises:
                return version
            version = version.evolve(self._register.now(), doubt=verdict)
            told = [str(problem)[:LONGEST] for problem in problems[:TOLD]]
            said = version.event(verdict, SERVER, problems=told, of=len(problems), promises=version.promises)
            await self._register.append([said], [version.row()])
            return version
