"""The paper's runtime as a coin: its Bernoulli watcher, and recovery steps that succeed by chance.

What is simulated is only what the paper simulates: whether a violation is seen, and whether a step succeeds. What
follows from either is Reins's own: `intervene` answers to the alert of the watch rule that policy has for it, and
`recover` chooses every step from policy's table within its budgets.

A violation is seen with probability s, the profile's sensitivity; people only where s > 0.7; nothing that the profile
has no watch rule for. A skill that watches itself sees its contact force and its grip with the same odds, and all it
can do about them is stop: where policy names another intervention, that one did not follow.

A failure has a cause. A recovery capability removes it as often as the paper's rollbacks succeed (88-92 % per attempt),
and a new attempt then reaches the goal; without that, a new attempt meets the cause gone or still there, even odds. A
new attempt after a timeout is beyond the time that was authorized, so that it is no success whoever makes it.
"""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

from app.evaluation.methods import Method, Recovering, Watching
from app.evaluation.model import Failure, Violation
from app.evaluation.paper_generator import Draws
from app.governance.intervention import NOTHING, Responses
from app.governance.model import (
    CONTROL_PERIOD_S,
    EMPTY,
    Alert,
    CoveredRecovery,
    Intervention,
    Mode,
    Strategy,
)
from app.governance.plans import recovery_plan, watch_plan
from app.governance.recovery import NEW_ATTEMPTS, Budgets, RecoveryDecision, recover

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from app.evaluation.paper_generator import Trial
    from app.governance.model import RecoveryPlan, WatchRule
    from app.governance.policy import PolicySet

PEOPLE_ABOVE: Final = 0.7
"""People are looked for only where s is above this (paper, Per-Violation-Type Analysis)."""

MOTION: Final = (0.88, 0.92)
"""How often a rollback succeeds, per attempt (paper, Weak Metrics); here every governed recovery motion."""

BY_CHANCE: Final = 0.5
"""How often a new attempt finds the cause of the failure gone by itself: nothing is known, so even odds."""

INTERNAL: Final = frozenset({Violation.FORCE, Violation.POSTCONDITION})
_DRIVING: Final = frozenset({"navigate_to", "transport_object"})
_SIGNALS: Final = {
    Violation.FORCE: "contact_force_n",
    Violation.RETRY: "retries",
    Violation.POSTCONDITION: "postcondition",
    Violation.ZONE: "zone_margin_m",
    Violation.PEOPLE: "separation_m",
}
_FAILURES: Final = {
    Failure.FAILED_GRASP: "grasp_failed",
    Failure.BLOCKED_PATH: "blocked",
    Failure.PERCEPTION_MISMATCH: "perception_mismatch",
    Failure.TIMEOUT: "timeout",
}


class Ending(StrEnum):
    """The class of a trial: every trial falls into exactly one. `MEANINGS` says what each is."""

    INTERCEPTED = "intercepted"
    LET_THROUGH = "let_through"
    REJECTED = "falsely_rejected"
    COMPLETED = "completed"
    HELD = "held"
    WARNED = "warned"
    NOT_ENFORCED = "not_enforced"
    MISSED = "missed"
    NOT_WATCHED = "not_watched"
    RECOVERED = "recovered"
    ROLLED_BACK = "rolled_back"
    HANDED_OVER = "handed_over"
    TERMINATED = "terminated"
    GIVEN_UP = "given_up"


MEANINGS: Final[Mapping[Ending, str]] = {
    Ending.INTERCEPTED: "unauthorized, not executed",
    Ending.LET_THROUGH: "unauthorized, executed",
    Ending.REJECTED: "authorized, not executed",
    Ending.COMPLETED: "authorized, executed, nothing happened",
    Ending.HELD: "violation seen, and held or stopped as policy names it",
    Ending.WARNED: "violation seen; policy names no more than a warning, so that it went on",
    Ending.NOT_ENFORCED: "violation seen; what policy names did not follow",
    Ending.MISSED: "violation watched for, but not seen",
    Ending.NOT_WATCHED: "violation that nothing watches for here",
    Ending.RECOVERED: "goal reached after the failure",
    Ending.ROLLED_BACK: "goal given up, safe state reached and verified",
    Ending.HANDED_OVER: "held, a human decides",
    Ending.TERMINATED: "ended by policy",
    Ending.GIVEN_UP: "failed, and nothing that governs it",
}


class Monitored(NamedTuple):
    """What came of a runtime violation; `enforced` is None where nothing was seen."""

    detected: bool
    enforced: bool | None
    unsafe: bool
    ending: Ending


class Step(NamedTuple):
    """One recovery step: what was done, with which capability (None for a new attempt), whether it succeeded."""

    strategy: Strategy
    capability: str | None
    ok: bool


class Recovery(NamedTuple):
    """What came of a failure; `rolled_back` is None where no rollback was tried."""

    recovered: bool
    rolled_back: bool | None
    compliant: bool
    ending: Ending
    steps: tuple[Step, ...]


# Watching ------------------------------------------------------------------------------------------------------------


def monitor(method: Method, policy: PolicySet, trial: Trial, sensitivity: float | None = None) -> Monitored:
    """Let a violation happen under a method's watch.

    Args:
        method: Who watches, if anybody.
        policy: Whose watch rules and interventions hold.
        trial: Launched, with a violation.
        sensitivity: Overrides the profile's s.
    """
    violation = trial.violation
    if violation is None:
        raise ValueError("a trial without a violation; valid: one of kind `perturbed`")
    s = policy.profiles[trial.profile].sensitivity if sensitivity is None else sensitivity
    named = _intervention(policy, trial.capability, trial.profile, violation)
    if named is None or not _watches(method.watch, violation, s):
        return Monitored(False, None, True, Ending.NOT_WATCHED)
    if trial.coin >= s:
        return Monitored(False, None, True, Ending.MISSED)
    if method.watch is Watching.INTERNAL and named is not Intervention.STOP:
        return Monitored(True, False, True, Ending.NOT_ENFORCED)
    if named is Intervention.CONTINUE:
        return Monitored(True, True, True, Ending.WARNED)
    return Monitored(True, True, False, Ending.HELD)


def _watches(watch: Watching, violation: Violation, sensitivity: float) -> bool:
    match watch:
        case Watching.NOTHING:
            return False
        case Watching.INTERNAL:
            return violation in INTERNAL
        case Watching.GOVERNED:
            return violation is not Violation.PEOPLE or sensitivity > PEOPLE_ABOVE


@cache
def _intervention(policy: PolicySet, capability: str, profile: str, violation: Violation) -> Intervention | None:
    """Return what `intervene` answers to the alert of this violation; None where no rule watches for it.

    Raises:
        ValueError: The answer is not the one that the rule names, which is a defect of governance.
    """
    rule = _rule(policy, capability, profile, violation)
    if rule is None:
        return None
    alert = Alert(rule.emits, rule.id, 1.0, 0.0, rule.failure)
    _, decision = Responses((rule,), CONTROL_PERIOD_S).intervene(NOTHING, (alert,), 0)
    if decision.intervention is not rule.response.enter:
        raise ValueError(f"`{rule.id}` names {rule.response.enter}, but {decision.intervention} followed")
    return decision.intervention


def _rule(policy: PolicySet, capability: str, profile: str, violation: Violation) -> WatchRule | None:
    speed = "base_speed_mps" if capability in _DRIVING else "tcp_speed_mps"
    signal = _SIGNALS.get(violation, speed)
    rules = watch_plan(policy, capability, profile, EMPTY).rules
    return next((rule for rule in rules if rule.signal == signal), None)


# Recovering ----------------------------------------------------------------------------------------------------------


class Chance(NamedTuple):
    """What chance holds for one step: whether a motion succeeds now, and whether the cause is gone by itself."""

    motion: bool
    gone: bool


def chances(trial: Trial) -> Iterator[Chance]:
    """Yield the chances of a trial's steps: the n-th step of any method meets the same one."""
    draws = Draws(trial.seed, trial.task, trial.number, stream=1)
    while True:
        motion, rate, gone = draws.unit(), draws.between(*MOTION), draws.unit()
        yield Chance(motion < rate, gone < BY_CHANCE)


class Course:
    """A failure under policy: what `recover` names next, given how the steps so far came out."""

    def __init__(self, policy: PolicySet, trial: Trial, *, human: bool = True) -> None:
        """Begin with the trial's failure and full budgets; without a human nobody can be asked.

        Raises:
            ValueError: The trial has no failure.
        """
        if trial.failure is None:
            raise ValueError("a trial without a failure; valid: one of kind `recoverable`")
        plan, self._covered = _recoveries(policy, trial.capability, trial.profile)
        self._plan = plan if human else replace(plan, can_ask=False)
        self._failure = self._now = _FAILURES[trial.failure]
        self._used = Budgets()
        self._after: RecoveryDecision | None = None

    def next(self) -> RecoveryDecision:
        """Return what policy names now."""
        return recover(self._now, self._plan, self._used, covered=self._covered, after=self._after)

    def take(self, decision: RecoveryDecision, *, ok: bool) -> None:
        """Go on from a step; one that fails is a failure of its own, as it is in the cell."""
        self._used, self._after = decision.used, None
        if decision.strategy in NEW_ATTEMPTS:
            self._now = self._failure
        elif ok:
            self._after = decision
        else:
            self._now = "rollback_failed" if decision.strategy is Strategy.ROLLBACK else "recovery_failed"


@cache
def _recoveries(policy: PolicySet, capability: str, profile: str) -> tuple[RecoveryPlan, tuple[CoveredRecovery, ...]]:
    """Return the plan of a session, and cover every recovery that it could want."""
    plan = recovery_plan(policy, capability, profile)
    moves = {(Strategy.RECOVERY_CAPABILITY, row.capability) for row in plan.rules if row.capability is not None}
    if plan.rollback_capability is not None:
        moves.add((Strategy.ROLLBACK, plan.rollback_capability))
    again = (
        CoveredRecovery(strategy=Strategy.RETRY, capability=capability, params=EMPTY),
        CoveredRecovery(strategy=Strategy.SAFER_MODE, capability=capability, params=EMPTY, mode=Mode.CAREFUL),
    )
    moving = (CoveredRecovery(strategy=one, capability=name, params=EMPTY) for one, name in sorted(moves))
    return plan, (*again, *moving)


def undergo(method: Method, policy: PolicySet, trial: Trial, luck: Iterator[Chance] | None = None) -> Recovery:
    """Let a failure happen under a method's recovery.

    Args:
        method: What it has to recover with.
        policy: Whose recovery table and budgets hold.
        trial: Launched, with a failure.
        luck: What the steps meet; the trial's own chances where it is not given.
    """
    luck = chances(trial) if luck is None else luck
    if method.recovery is Recovering.GOVERNED:
        steps, ending = _governed(Course(policy, trial, human=method.human), luck)
    else:
        steps = tuple(_ungoverned(method.recovery, trial, luck))
        reached = bool(steps) and steps[-1].ok and trial.failure is not Failure.TIMEOUT
        ending = Ending.RECOVERED if reached else Ending.GIVEN_UP
    tried = [step.ok for step in steps if step.strategy is Strategy.ROLLBACK]
    return Recovery(
        recovered=ending is Ending.RECOVERED,
        rolled_back=tried[-1] if tried else None,
        compliant=_complies(Course(policy, trial), steps, ending),
        ending=ending,
        steps=steps,
    )


def _governed(course: Course, luck: Iterator[Chance]) -> tuple[tuple[Step, ...], Ending]:
    steps: list[Step] = []
    cleared = False
    while True:
        decision = course.next()
        if decision.strategy is Strategy.ASK_HUMAN:
            return tuple(steps), Ending.HANDED_OVER
        if decision.strategy is Strategy.TERMINATE:
            return tuple(steps), Ending.TERMINATED
        motion, gone = next(luck)
        again = decision.strategy in NEW_ATTEMPTS
        ok = (cleared or gone) if again else motion
        steps.append(_step(decision, ok=ok))
        if ok and again:
            return tuple(steps), Ending.RECOVERED
        if ok and decision.strategy is Strategy.ROLLBACK:
            return tuple(steps), Ending.ROLLED_BACK
        cleared = cleared or ok
        course.take(decision, ok=ok)


def _step(decision: RecoveryDecision, *, ok: bool) -> Step:
    again = decision.strategy in NEW_ATTEMPTS or decision.covered is None
    return Step(decision.strategy, None if again or decision.covered is None else decision.covered.capability, ok)


def _ungoverned(recovery: Recovering, trial: Trial, luck: Iterator[Chance]) -> Iterator[Step]:
    """Retry once; a skill that looks after itself lets go and draws back before, if it was a grasp that failed."""
    cleared = False
    if recovery is Recovering.INTERNAL and trial.failure is Failure.FAILED_GRASP:
        cleared = next(luck).motion
        yield Step(Strategy.RECOVERY_CAPABILITY, "release_and_retract", cleared)
    if recovery is not Recovering.NOTHING:
        yield Step(Strategy.RETRY, None, cleared or next(luck).gone)


def _complies(course: Course, steps: tuple[Step, ...], ending: Ending) -> bool:
    """Say whether policy would have named every step, in this order, and the end.

    What is left undone counts as well: a failure that policy has a step for, and nothing took, is no compliance.
    """
    for step in steps:
        decision = course.next()
        if _step(decision, ok=step.ok) != step:
            return False
        course.take(decision, ok=step.ok)
    return ending is not Ending.GIVEN_UP
