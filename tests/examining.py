"""A candidate examined right here, without the solver: for tests of what follows from an examination."""

from __future__ import annotations

import asyncio

from app.governance import bundle, cases
from app.governance.comparison import compare
from app.governance.errors import PolicyError, PolicyErrors
from app.runtime.examining import Candidate, Examined


async def examine_here(candidate: Candidate, against: Candidate | None) -> Examined:
    """Load it, run its cases, and compare part by part, on a thread. Raises `PolicyErrors`."""
    return await asyncio.to_thread(_examined, candidate, against)


def _examined(candidate: Candidate, against: Candidate | None) -> Examined:
    policy = bundle.load_files(candidate.files)
    results = cases.run(policy, candidate.cases)
    failed = [
        PolicyError(file=one.file, line=one.line, key=one.name, message="; ".join(one.differences))
        for one in results
        if not one.passed
    ]
    if failed:
        raise PolicyErrors(failed)
    found = None if against is None else compare(bundle.load_files(against.files), policy)
    proved = "that its cases hold" if candidate.prove else ""
    return Examined(policy=policy, cases=len(results), proved=proved, comparison=found)
