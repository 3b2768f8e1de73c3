"""The port through which candidates are examined: by another process, so that no request waits while it is done.

Whoever examines does what `reins policy check` and `test` do: it loads, type-checks, runs the cases, and proves. What
has a fault does not come back at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.changes import Comparison
    from app.governance.policy import PolicySet


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """What is to be examined.

    Attributes:
        files: The policy's files, path → text.
        cases: Its case files.
        promises: Text of its `properties.yaml`; None where it promises nothing.
        prove: Whether to run the cases and to prove it, or only to load it.
    """

    files: Mapping[str, str]
    cases: Mapping[str, str]
    promises: str | None
    prove: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Examined:
    """A candidate without a fault.

    Attributes:
        policy: Compiled, ready to decide.
        cases: How many cases it passed.
        proved: What was proved of it, in a sentence; empty where nothing was.
        comparison: What it would change of what it was compared with; None where it was not.
    """

    policy: PolicySet
    cases: int
    proved: str
    comparison: Comparison | None


class Examine(Protocol):
    """Examines candidates."""

    async def __call__(self, candidate: Candidate, against: Candidate | None) -> Examined:
        """Examine a candidate, and compare it with another policy.

        Raises:
            PolicyErrors: Everything that is wrong with it, each with its file and line.
            Undecided: Nothing is, as far as it is known; it names what is not decided.
            ExaminationFailed: It could not be examined.
        """
        ...
