"""One trial of protocol `paper` under one method, as a row."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.evaluation.methods import Method, Passed
from app.evaluation.model import Kind, Row
from app.evaluation.paper_generator import draw
from app.evaluation.paper_runtime import Ending, monitor, undergo
from app.evaluation.rows import COLUMNS
from app.evaluation.timing import time_gate

if TYPE_CHECKING:
    from app.evaluation.paper_generator import Trial
    from app.governance.policy import PolicySet


def row(
    method: Method, policy: PolicySet, seed: int, task: str, number: int, *, sensitivity: float | None = None
) -> Row:
    """Run one trial; the columns of `rows.COLUMNS`.

    All but `decision_us` follows from the arguments. Sizes, delays and durations do not exist in this protocol, and
    their columns stay empty.

    Args:
        method: What governs it.
        policy: Π.
        seed: Seed of the run.
        task: Task type, or `all`.
        number: Number of the trial.
        sensitivity: Overrides s of every profile.
    """
    trial = draw(policy, seed, task, number)
    passed, spent_us = time_gate(method, policy, trial.proposal, trial.context, approved=trial.approved)
    made = _blank(method, policy, trial, passed)
    made["decision_us"] = spent_us
    if not passed.launched:
        made["class"] = (Ending.INTERCEPTED if trial.kind is Kind.UNAUTHORIZED else Ending.REJECTED).value
    elif trial.violation is not None:
        _monitored(made, method, policy, trial, sensitivity)
    elif trial.failure is not None:
        _undergone(made, method, policy, trial)
    else:
        made["class"] = (Ending.LET_THROUGH if trial.kind is Kind.UNAUTHORIZED else Ending.COMPLETED).value
    return made


def _blank(method: Method, policy: PolicySet, trial: Trial, passed: Passed) -> Row:
    made: Row = dict.fromkeys(COLUMNS)
    made.update(
        method=method.name,
        task=trial.task,
        seed=trial.seed,
        trial=trial.number,
        kind=trial.kind.value,
        breach=None if trial.breach is None else trial.breach.value,
        violation=None if trial.violation is None else trial.violation.value,
        failure=None if trial.failure is None else trial.failure.value,
        capability=trial.capability,
        profile=trial.profile,
        launched=passed.launched,
        blocked_by=passed.by or None,
        rollback_capable=policy.capabilities[trial.capability].rollback is not None,
    )
    return made


def _monitored(made: Row, method: Method, policy: PolicySet, trial: Trial, sensitivity: float | None) -> None:
    found = monitor(method, policy, trial, sensitivity)
    made.update(occurred=True, boundary=False, detected=found.detected, enforced=found.enforced, unsafe=found.unsafe)
    made["class"] = found.ending.value


def _undergone(made: Row, method: Method, policy: PolicySet, trial: Trial) -> None:
    found = undergo(method, policy, trial)
    made.update(
        recovered=found.recovered,
        handed_over=found.ending is Ending.HANDED_OVER,
        rolled_back=found.rolled_back,
        compliant=found.compliant,
    )
    made["class"] = found.ending.value
