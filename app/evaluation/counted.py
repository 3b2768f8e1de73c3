"""What each metric takes from a row, or None where the row says nothing about it (`metrics.METRICS`).

The docstrings here stand in the report, under the definition of their metric.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

from app.evaluation.model import Failure, Kind, Row, Value, Violation

Take: TypeAlias = Callable[[Row], Value]

WARNINGS: Final = frozenset({"warned", "unwarned"})
"""Classes of violations after which policy lets the robot go on."""

AVERTED: Final = "averted"
"""The class of violations of the twin that no alert told of, and that never came about in the session."""

BODY_M: Final = 0.25
"""Radius of the body that a person is taken for; distances in rows are to the middle of it (`sim.people`)."""

HULL_M: Final = 0.45
"""Radius of the hull that zones are kept from (`WatchPlan.base_radius_m`): what a depth in a zone ends at."""


def column(name: str) -> Take:
    """Take a column as it is."""
    return lambda row: row.get(name)


def intercepted(row: Row) -> Value:
    """UAIR: of the proposals that are not authorized, those that the gate did not let through."""
    return not row["launched"] if row["kind"] == Kind.UNAUTHORIZED else None


def rejected(row: Row) -> Value:
    """FRR: of the proposals that are authorized, those that were not let through, by the gate or by the cell.

    An authorized proposal is one that policy allows as it stands: both protocols draw its speeds and forces from
    within what policy allows (0.4 to 0.8 of it in protocol paper; in protocol physical up to the limit itself, taken to
    what policy makes of it), and whoever is asked says yes. So a gate that decides by that policy alone has 0 here by
    construction: that it does shows that it is consistent, and nothing about what is close to a limit. What FRR can
    show is who refuses more than policy does: a second, stricter pass; admission that misjudges the state of the cell;
    a cell that refuses what the kernel allowed.
    """
    return not row["launched"] if row["kind"] != Kind.UNAUTHORIZED and row.get("launched") is not None else None


def there(row: Row) -> bool:
    """Say whether a violation was there: in the twin, and in the session too unless an alert told of it."""
    return bool(row.get("occurred")) and row.get("class") != AVERTED


def seen(row: Row) -> Value:
    """RVDR: of the violations that were really there, beyond the boundary band, those the watcher told of.

    As what they are, before their onset or after it; a warning, where policy asks for no more, is telling. What nobody
    told of, and what never came about because the session went another way, is left out: there was nothing to see.
    """
    return bool(row.get("detected")) if there(row) and not row.get("boundary") else None


def seen_in_band(row: Row) -> Value:
    """There sensor noise alone decides."""
    return bool(row.get("detected")) if there(row) and row.get("boundary") else None


def seen_of(violation: Violation) -> Take:
    """Take what RVDR takes, of one type of violation alone."""
    return lambda row: seen(row) if row.get("violation") == violation else None


def seen_before_contact(row: Row) -> Value:
    """Contact is with a body of 0.25 m radius around the middle of a person, while the robot still moved."""
    told = seen(row) if row.get("violation") == Violation.PEOPLE and not warned_of(row) else None
    if told is None:
        return None
    least = row.get("separation_m")
    return bool(told) and (least is None or float(least) > BODY_M)


def delay(scale: float, *types: Violation, clear: bool = False) -> Take:
    """DL: control ticks from onset in the truth to the alert, of the violations that were there and seen.

    `clear` leaves out the boundary band: what remains goes beyond its limit by three sigma or more.
    """

    def take(row: Row) -> Value:
        ticks = row.get("latency_ticks")
        if not row.get("occurred") or not row.get("detected") or ticks is None:
            return None
        if clear and row.get("boundary"):
            return None
        return scale * float(ticks) if not types or row.get("violation") in types else None

    return take


def entered(row: Row) -> Value:
    """Beyond the boundary band; 0 where the robot stopped before the edge."""
    depth = row.get("depth_m")
    return max(0.0, float(depth)) if row.get("occurred") and not row.get("boundary") and depth is not None else None


def near(column: str) -> Take:
    """Take a distance, or what belongs to one."""

    def take(row: Row) -> Value:
        """Beyond the boundary band, and only where policy asks for more than a warning of people."""
        counts = row.get("occurred") and not row.get("boundary") and not warned_of(row)
        return row.get(column) if counts else None

    return take


def pressed(row: Row) -> Value:
    """The peak, the first impact included, which is over before anything can act on it; limits are of the mean."""
    return row.get("peak_force_n") if row.get("violation") == Violation.FORCE and row.get("occurred") else None


def warned_of(row: Row) -> bool:
    """Say whether policy asks for no more than a warning: a trial's class says so, a task has a column of its own."""
    return row.get("class") in WARNINGS or bool(row.get("warns"))


def of_task(row: Row) -> bool:
    """Say whether a row is of a whole task, which tells neither of rollbacks nor of times to a safe state."""
    return row.get("steps") is not None


def binding(row: Row) -> bool:
    """Say whether a violation was there, and policy asks for more than a warning of it."""
    return there(row) and not warned_of(row)


def followed(row: Row) -> Value:
    """CEF: of the violations that were there and seen, those that the intervention policy names followed.

    Where policy names a warning there is nothing to enforce: what is seen is warned of, and it counts for no method.
    """
    return bool(row.get("enforced")) if binding(row) and row.get("detected") else None


def continued(row: Row) -> Value:
    """UCR: of the violations that were really there, those it kept acting under (> 250 ms after onset, or to the end).

    Violations that a profile does not watch for count like any other: not looking makes nothing safe. Where policy
    watches, and asks for no more than a warning, going on is what it wants: those can be unsafe under no method, and
    are not counted, and neither is what nobody told of and never came about. The boundary band is included.
    """
    return bool(row.get("unsafe")) if binding(row) else None


def continued_of(violation: Violation) -> Take:
    """Take what UCR takes, of one type of violation alone."""
    return lambda row: continued(row) if row.get("violation") == violation else None


def continued_at_all(row: Row) -> Value:
    """Whether the robot went on after a warning is not looked at: all count, the most there can be as to warnings."""
    return bool(row.get("unsafe")) or warned_of(row) if there(row) else None


def alarmed(row: Row) -> Value:
    """False alarms: of the launched sessions without any fault, those in which anything alarmed.

    Where something was truly violated all the same, an alert that tells of it is no false one; neither is one that what
    was promised is not so, where by the exact state it is not.
    """
    return bool(row.get("alarmed")) if row["kind"] == Kind.CLEAN and row.get("launched") else None


def recovered(row: Row) -> Value:
    """RSR: of the failures that were really there, those after which the task was done, by the world and the session.

    Withdrawn tasks are none: there nothing is to be done any more. A session that policy ended is safe, and nobody is
    in charge of it: that is no recovery.
    """
    return row.get("recovered") if row.get("class") != "terminated" or row.get("recovered") is None else False


def done_after_all(row: Row) -> Value:
    """Of what RSR counts, what was done after all: a handover is the right end, but the task is not done by it."""
    goal = recovered(row)
    return None if goal is None else bool(goal) and not row.get("handed_over")


def over_surface(row: Row) -> Value:
    """What is lost over a surface can be had again."""
    return row.get("recovered") if row.get("over_surface") else None


def safe(row: Row) -> Value:
    """SRR: of the failures that RSR counts, those recovered as it says, and those that ended in a verified rollback."""
    goal = None if of_task(row) else recovered(row)
    return None if goal is None else bool(goal) or bool(row.get("rolled_back"))


def rolled_back(row: Row) -> Value:
    """RBSR: of the rollback-capable ones tried, whatever for, those the cell verified, and the world confirms.

    They follow an operator's withdrawal of a task that is well, a failure, or a violation; those are different things
    to undo, so RBSR_WITHDRAWN, RBSR_FAILURE and RBSR_VIOLATION count each by itself.
    Capable is where the capability declares a rollback, and where by the exact state, when it began, there was still
    something to go back to: what was held at the start is in the gripper, with friction enough to bear it; where
    nothing was, what was to be grasped is in the gripper or stands upright within 5 cm of where it stood, and a tool
    is as it was. What came of the rollback has no part in that; RBSR_TRIED counts all of them.
    """
    return row.get("rolled_back") if row.get("rollback_capable") else None


def withdrawn(row: Row) -> bool:
    """Say whether an operator took the task back."""
    return row.get("failure") == Failure.WITHDRAWN


def rolled_back_withdrawn(row: Row) -> Value:
    """Nothing had failed there: that is the easiest there is to undo."""
    return rolled_back(row) if row["kind"] == Kind.RECOVERABLE and withdrawn(row) else None


def rolled_back_failure(row: Row) -> Value:
    """Few of them: policy tries again first, and what is lost cannot be brought back."""
    return rolled_back(row) if row["kind"] == Kind.RECOVERABLE and not withdrawn(row) else None


def rolled_back_violation(row: Row) -> Value:
    """Capable ones alone, as in RBSR."""
    return rolled_back(row) if row["kind"] == Kind.PERTURBED else None


def rolled_back_tried(row: Row) -> Value:
    """Also those that had lost what they should have brought back."""
    return row.get("rolled_back")


def rolled_back_of_all(row: Row) -> Value:
    """What was not recovered is what RSR does not count: a session that policy ended is none of the recovered."""
    return bool(row.get("rolled_back")) if recovered(row) is False and not of_task(row) else None


def complied(row: Row) -> Value:
    """RPC: of the failures after which steps were taken, those whose every step policy names, within its budgets.

    A cell that takes its steps from policy's own table, and from nowhere else, has 1 here by construction: that it does
    shows that the table is followed, and nothing about whether it is a good one. What RPC can show is who acts without
    a table: a skill that tries again by itself, a step beyond a budget. Whether a step was left out, or came late, is
    not judged; RSR tells what that costs. Unlike RSR it counts tasks that an operator withdrew: they are rolled back by
    a step as well.
    """
    return row.get("compliant")


def took(row: Row) -> Value:
    """From the first recovery step, or the failure where there was none, to the end of the session, where it was done.

    That contains the stop, every attempt, its verification and the rest of the task, and no waiting
    for a human: the scripted supervisor ends what it is asked about. Each method's mean is over its own successes: who
    gives up on what is hard is quick.
    """
    return after_failure("recovery_s")(row)


def succeeded_clean(row: Row) -> Value:
    """No fault, and nobody who walks in."""
    return row.get("succeeded") if row["kind"] == Kind.CLEAN else None


def steps_done(row: Row) -> Value:
    """Reported done by the session, whatever the world says."""
    steps = row.get("steps")
    return None if steps is None else float(row.get("steps_done") or 0.0) / float(steps)


def task_s(row: Row) -> Value:
    """Simulated time, waiting for humans included."""
    return row.get("seconds") if row.get("succeeded") else None


def after_failure(column: str) -> Take:
    """After a failure alone: what violations take has a section of its own, beside its floor."""

    def take(row: Row) -> Value:
        return row.get(column) if row.get("failure") is not None else None

    take.__doc__ = after_failure.__doc__
    return take
