"""Has policies examined by a process of their own, one at a time, and takes what it compiled in small steps."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, cast

import orjson

from app.governance.changes import Comparison
from app.governance.errors import PolicyError, PolicyErrors, Undecided
from app.governance.parcel import unpacked
from app.runtime.errors import ExaminationFailed
from app.runtime.examining import Examined

if TYPE_CHECKING:
    from app.governance.policy import PolicySet
    from app.runtime.examining import Candidate

NICENESS: Final = 15
PATIENCE_S: Final = 1800.0  # it has the lowest priority, and may wait long for its turn
STOPPING: Final = "the server is stopping; valid is to ask again once it is back"
COMMAND: Final = (sys.executable, "-m", "app.assay")


class Assayer:
    """Examines candidates (`runtime.examining.Examine`)."""

    def __init__(self, *, patience_s: float = PATIENCE_S) -> None:
        """Take how long one examination may last."""
        self._patience_s = patience_s
        self._child: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._one = asyncio.Lock()  # a second one would take what the first leaves to requests

    async def __call__(self, candidate: Candidate, against: Candidate | None) -> Examined:
        """Examine a candidate. Errors as the port says."""
        request = {"candidate": asdict(candidate), "against": None if against is None else asdict(against)}
        async with self._one:
            told = await asyncio.to_thread(self._run, orjson.dumps(request))
        answer, rest = await asyncio.to_thread(_split, told)
        _refuse(answer)
        policy = await _unpacked(rest, answer["parcels"])
        found = answer["comparison"]
        return Examined(
            policy=policy,
            cases=answer["cases"],
            proved=answer["proved"],
            comparison=None if found is None else Comparison.read(found),
        )

    def close(self) -> None:
        """End the examination that runs, if one does: it fails, as does whatever is asked for after this."""
        self._closed = True
        if self._child is not None:
            self._child.kill()

    def _run(self, request: bytes) -> bytes:
        if self._closed:
            raise ExaminationFailed(STOPPING)
        pipe = subprocess.PIPE
        try:
            with subprocess.Popen(COMMAND, stdin=pipe, stdout=pipe, stderr=pipe) as child:  # noqa: S603  # our own words
                os.setpriority(os.PRIO_PROCESS, child.pid, NICENESS)  # from here: it takes its time to load the solver
                self._child = child
                if self._closed:
                    child.kill()
                try:
                    told, said = child.communicate(request, timeout=self._patience_s)
                finally:
                    self._child = None
                    child.kill()  # nothing, where it has ended
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ExaminationFailed(str(error)) from error
        if self._closed:
            raise ExaminationFailed(STOPPING)
        if child.returncode != 0:
            last = said.decode(errors="replace").strip().splitlines()[-1:] or ["it said nothing"]
            raise ExaminationFailed(f"it ended with `{child.returncode}`: {last[0]}")
        return told


def _split(told: bytes) -> tuple[dict[str, Any], memoryview]:
    head, _, _ = told.partition(b"\n")
    return cast("dict[str, Any]", orjson.loads(head)), memoryview(told)[len(head) + 1 :]


def _refuse(answer: dict[str, Any]) -> None:
    """Raise what is wrong with what was examined, if anything is."""
    if answer["problems"]:
        problems = [PolicyError(**problem) for problem in answer["problems"]]
        raise (Undecided if answer["undecided"] else PolicyErrors)(problems)


async def _unpacked(rest: memoryview, sizes: list[int]) -> PolicySet:
    """Take the parcels one by one, and let others do something after each."""
    ends = [0]
    for size in sizes:
        ends.append(ends[-1] + size)
    taken = (bytes(rest[start:end]) for start, end in pairwise(ends))
    policy: PolicySet | None = None
    for step in unpacked(taken):
        policy = step
        await asyncio.sleep(0)
    if policy is None:
        raise ExaminationFailed("it compiled nothing")
    return policy
