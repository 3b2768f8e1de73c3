"""`recover`: what is tried after a failure (paper, Stage 6: r_t = Recover(e, w, Π, Γ)).

The profile's table is read from the top: the first row for this failure and risk holds (`any` matches every failure),
and its steps are tried in order. A step is taken when

1. its budget is left: the row's own (1 where it names none), and the session's retry budget for every new attempt;
2. the plant and the profile have it: a rollback needs a capability to roll back with, careful mode must be admitted;
3. the authorization covers it. A step that policy asks for but no authorization covers is not skipped in favour of a
   lesser one: a human is asked.

Budgets are counted over the whole session. A recovery that fails comes back here with the same budgets, so nesting
ends: every decision that moves something uses up a part of a finite sum, and what is left is a human or the end. A
rollback that a human takes the controls from is not used up: it has not failed.

A rollback that ends elsewhere than the session began (a retreat, or a release after the base was moved) is led back
along the recorded path, once, if that is covered. What a human has driven is undone along that path to begin with
(`retracing`): a release would let go of what is held wherever the hand has taken it.

Where the end is reached and the profile requires rollback, the rollback comes first; if it cannot be had, a human
decides. Where nobody can be asked, asking is the end.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.model import Strategy

if TYPE_CHECKING:
    from app.governance.model import CoveredRecovery, RecoveryPlan, RecoveryRule

NEW_ATTEMPTS: Final = frozenset({Strategy.RETRY, Strategy.SAFER_MODE})
DEFAULT_BUDGET: Final = 1
RETRACE: Final = "retrace"
"""The recovery capability that goes back along the recorded path of the session."""


class Budgets(NamedTuple):
    """What a session has used up: steps by (row, strategy), new attempts, whether it rolled back, was led back."""

    steps: tuple[tuple[int, Strategy], ...] = ()
    retries: int = 0
    rolled_back: bool = False
    led_back: bool = False

    def taking(self, row: int, strategy: Strategy) -> Budgets:
        """Return the budgets after one more step."""
        return Budgets(
            (*self.steps, (row, strategy)),
            self.retries + (strategy in NEW_ATTEMPTS),
            self.rolled_back or strategy is Strategy.ROLLBACK,
            self.led_back,
        )

    def giving_up(self) -> Budgets:
        """Return the budgets where a rollback is given up before it ended: what it was to undo may still be undone."""
        steps = tuple(step for step in self.steps if step[1] is not Strategy.ROLLBACK)
        return Budgets(steps, self.retries)


class RecoveryDecision(NamedTuple):
    """What to do about a failure, why, and the budgets it leaves.

    `reason` is a code: `table`, `rollback_required`, `not_covered`, `no_row`, `row_exhausted`, `nobody_to_ask`,
    `asked`, `elsewhere`. `row` is −1 where no row was found; `step` is the place in the row, for what follows when this
    step has succeeded.
    """

    strategy: Strategy
    failure: str
    reason: str
    used: Budgets
    covered: CoveredRecovery | None = None
    row: int = -1
    step: int = -1


def recover(
    failure: str,
    plan: RecoveryPlan,
    used: Budgets,
    *,
    covered: tuple[CoveredRecovery, ...],
    after: RecoveryDecision | None = None,
    recovering: bool = False,
) -> RecoveryDecision:
    """Choose the recovery for a failure.

    Args:
        failure: Name of the failure, as skills and watch rules use them.
        plan: The profile's table and budgets, the session's risk, and whether anybody can be asked.
        used: What the session has used up so far.
        covered: The recoveries the authorization covers.
        after: A recovery capability that has just succeeded; its row is read on from there.
        recovering: Whether it was a recovery that failed. Then no new attempt is made: it would stand on what that
            recovery was to restore.
    """
    chooser = _Chooser(failure, plan, used, covered, recovering)
    if after is not None:
        return chooser.read(after.row, after.step + 1)
    for number, row in enumerate(plan.rules):
        if row.on in (failure, "any") and plan.risk in row.risks:
            return chooser.read(number, 0)
    return chooser.ask("no_row")


def roll_back(
    failure: str, plan: RecoveryPlan, used: Budgets, covered: tuple[CoveredRecovery, ...]
) -> RecoveryDecision | None:
    """Return the rollback that was asked for outright (by an operator or a watch rule), or None if it cannot be had."""
    cover = _Chooser(failure, plan, used, covered).cover(Strategy.ROLLBACK, None)
    if plan.rollback_capability is None or cover is None or used.rolled_back:
        return None
    return RecoveryDecision(Strategy.ROLLBACK, failure, "asked", used.taking(-1, Strategy.ROLLBACK), cover)


def retracing(plan: RecoveryPlan, covered: tuple[CoveredRecovery, ...]) -> RecoveryPlan:
    """Return the plan of a session that a human has driven: it is undone along the recorded path if that is covered."""
    return plan if _retrace(covered) is None else replace(plan, rollback_capability=RETRACE)


def lead_back(
    failure: str, plan: RecoveryPlan, used: Budgets, covered: tuple[CoveredRecovery, ...]
) -> RecoveryDecision | None:
    """Return the way back to where the session began, for a rollback that ended elsewhere; None if it cannot be had.

    One that retraced already is where that leads, and is not sent the same way again.
    """
    if used.led_back or plan.rollback_capability == RETRACE:
        return None
    cover = _retrace(covered)
    if cover is None:
        return None
    return RecoveryDecision(Strategy.ROLLBACK, failure, "elsewhere", used._replace(led_back=True), cover)


def _retrace(covered: tuple[CoveredRecovery, ...]) -> CoveredRecovery | None:
    for known in covered:
        if known.strategy is Strategy.ROLLBACK and known.capability == RETRACE:
            return known
    return None


class _Chooser(NamedTuple):
    failure: str
    plan: RecoveryPlan
    used: Budgets
    covered: tuple[CoveredRecovery, ...]
    recovering: bool = False

    def read(self, number: int, first: int) -> RecoveryDecision:
        """Return the first step of a row, from `first` on, that may be taken."""
        row = self.plan.rules[number]
        for step in range(first, len(row.do)):
            strategy = row.do[step]
            if strategy is Strategy.ASK_HUMAN:
                return self.ask("table", number, step)
            if strategy is Strategy.TERMINATE:
                return self.end("table", number, step)
            if not self._possible(strategy, number, row):
                continue
            cover = self.cover(strategy, row)
            if cover is None:
                return self.ask("not_covered", number, step)
            used = self.used.taking(number, strategy)
            return RecoveryDecision(strategy, self.failure, "table", used, cover, number, step)
        return self.ask("row_exhausted", number, len(row.do))

    def ask(self, reason: str, row: int = -1, step: int = -1) -> RecoveryDecision:
        if self.plan.can_ask:
            return RecoveryDecision(Strategy.ASK_HUMAN, self.failure, reason, self.used, None, row, step)
        return self.end("nobody_to_ask", row, step)

    def end(self, reason: str, row: int, step: int) -> RecoveryDecision:
        """Return the end of the session, behind the rollback that the profile may require."""
        needed = self.plan.rollback in ("required", "always") and self.plan.rollback_capability is not None
        if needed and not self.used.rolled_back:
            cover = self.cover(Strategy.ROLLBACK, None)
            if cover is not None:
                used = self.used.taking(row, Strategy.ROLLBACK)
                return RecoveryDecision(Strategy.ROLLBACK, self.failure, "rollback_required", used, cover, row, step)
            if self.plan.can_ask:
                return RecoveryDecision(Strategy.ASK_HUMAN, self.failure, "not_covered", self.used, None, row, step)
        return RecoveryDecision(Strategy.TERMINATE, self.failure, reason, self.used, None, row, step)

    def _possible(self, strategy: Strategy, number: int, row: RecoveryRule) -> bool:
        if self.used.steps.count((number, strategy)) >= row.budget.get(strategy, DEFAULT_BUDGET):
            return False
        if strategy in NEW_ATTEMPTS and (self.recovering or self.used.retries >= self.plan.retry_budget):
            return False
        if strategy is Strategy.SAFER_MODE:
            return self.plan.careful_admitted
        if strategy is Strategy.ROLLBACK:
            return self.plan.rollback_capability is not None and not self.used.rolled_back
        return True

    def cover(self, strategy: Strategy, row: RecoveryRule | None) -> CoveredRecovery | None:
        wanted = {
            Strategy.ROLLBACK: self.plan.rollback_capability,
            Strategy.RECOVERY_CAPABILITY: None if row is None else row.capability,
        }.get(strategy)
        for known in self.covered:
            if known.strategy is strategy and (strategy in NEW_ATTEMPTS or known.capability == wanted):
                return known
        return None
