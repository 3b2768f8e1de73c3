"""What came of a task run: every proposal that was made on the way, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.model import Outcome

if TYPE_CHECKING:
    from app.evaluation.episode import Execution
    from app.evaluation.methods import Passed
    from app.governance.model import Context, Proposal, WatchPlan

_DONE: Final = (Outcome.SUCCEEDED, Outcome.RECOVERED)


class Asked(NamedTuple):
    """A proposal that was made on the way: of which step, in which context, what the gate said, what came of it."""

    place: int
    proposal: Proposal
    context: Context
    passed: Passed
    decision_us: float
    plan: WatchPlan
    execution: Execution | None

    @property
    def refused_by(self) -> str:
        """Return what kept it from being executed: a part of the gate, or the cell; empty where nothing did."""
        if self.execution is None:
            return self.passed.by
        return "cell" if self.execution.refused else ""

    @property
    def done(self) -> bool:
        """Return whether the step was reported done, by the skill or by the session's outcome."""
        if self.execution is None or self.execution.refused:
            return False
        return self.execution.outcome in _DONE if self.execution.entries else self.execution.claimed


@dataclass(slots=True)
class TaskEnd:
    """What came of a task run: every proposal, the ticks that it took, and whether the world is as the task asks."""

    asked: list[Asked] = field(default_factory=list[Asked])
    ticks: int = 0
    achieved: bool = False

    @property
    def executions(self) -> list[Execution]:
        """Return what was executed, in order."""
        return [one.execution for one in self.asked if one.execution is not None]

    def steps_done(self) -> int:
        """Return how many steps were reported done."""
        return sum(one.done for one in self.asked)
