"""Questions to the solver, each with so much effort: a solution, none, or no answer, and nothing else.

Effort is counted in the solver's own steps, not in seconds, so that what is decided on one machine is on any other;
only all questions together have a deadline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import z3

from app.proofs.formulas import term

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from app.proofs.formulas import Formula

LEAST_S: Final = 0.001
# While there is much longer than a question's effort takes, none has a timeout. The solver would start a timer for each
# of thousands, a tenth of the time that proofs take, and one that goes off late would spoil an answer.
HURRY_MS_PER_STEP: Final = 0.003  # a step takes about half a microsecond; a slow machine six times that
NO_TIMEOUT: Final = 2**32 - 1  # to Z3


class Undecided:
    """The solver gave no answer for this effort, or in the time there was."""


UNDECIDED: Final = Undecided()


@dataclass(slots=True)
class Budget:
    """How much effort a question may take, and until when all of them; `now` tells the time in seconds."""

    now: Callable[[], float]
    effort: int
    until_s: float

    def left_ms(self) -> int:
        """Return how long there is for the next question; 0 where the time is up."""
        left_s = self.until_s - self.now()
        return round(left_s * 1000) if left_s > LEAST_S else 0


class Asking:
    """One solver, the facts it goes by, and the questions put to it."""

    def __init__(self, budget: Budget, facts: Callable[[], Sequence[z3.BoolRef]]) -> None:
        """Take the facts when they are needed: encoding a question may add to them, never take from them."""
        self._budget, self._facts = budget, facts
        self._solver = z3.SimpleSolver()
        self._solver.set(rlimit=budget.effort)
        self._timeout_ms = NO_TIMEOUT
        self._hurry_ms = HURRY_MS_PER_STEP * budget.effort
        self._known: dict[int, z3.BoolRef] = {}  # by identity, which is good only as long as the terms live
        self.asked = 0

    def ask(self, *parts: Formula) -> z3.ModelRef | Undecided | None:
        """Return a model in which all parts hold, None where there is none, or `UNDECIDED`."""
        if any(part is False for part in parts):
            return None
        left_ms = self._budget.left_ms()
        if not left_ms:
            return UNDECIDED
        for fact in self._facts():
            if id(fact) not in self._known:
                self._known[id(fact)] = fact
                # As `add` does, which would first look what kind of thing it is given.
                z3.Z3_solver_assert(self._solver.ctx.ref(), self._solver.solver, fact.as_ast())
        self._limit(left_ms if left_ms < self._hurry_ms else NO_TIMEOUT)
        self.asked += 1
        answer = self._solver.check(*(term(part) for part in parts if part is not True))
        if answer == z3.sat:
            return self._solver.model()
        return None if answer == z3.unsat else UNDECIDED

    def _limit(self, timeout_ms: int) -> None:
        if timeout_ms != self._timeout_ms:
            self._solver.set(timeout=timeout_ms)
            self._timeout_ms = timeout_ms


__all__ = ["UNDECIDED", "Asking", "Budget", "Undecided"]
