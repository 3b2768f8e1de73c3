"""Rows of task runs: what is read off all the steps together, and the one class that each run falls into."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from statistics import fmean
from typing import TYPE_CHECKING, Final

from app.evaluation.model import Kind, Row, Violation
from app.evaluation.physical_rows import COLUMNS, UNLOOKED, alarmed_falsely, enforced, telling
from app.evaluation.physical_trial import BAND_SIGMAS, took
from app.evaluation.truth import SIGMA
from app.governance.model import EventKind, Intervention, Outcome

if TYPE_CHECKING:
    from app.cell.journal import Entry
    from app.evaluation.draws import Drawn
    from app.evaluation.methods import Method
    from app.evaluation.task_draws import TaskRun
    from app.evaluation.task_end import Asked, TaskEnd
    from app.governance.model import WatchRule

TASK_COLUMNS: Final = {
    "steps": "steps of a task",
    "steps_done": "steps of a task that were reported done",
    "proposals": "proposals that were made in a task, those included that were made once more",
    "succeeded": "whether all steps of a task were reported done, and the world is as it asks",
    "met": "types of violation that there were in a task, whether provoked or not",
    "acted": "those of them that were acted under for more than 250 ms, without those that policy only warns of",
    "hurt": "whether there was any of the latter",
    "warns": "whether policy asks for no more than a warning of the violation that was provoked in a task",
}


class TaskClass(StrEnum):
    """What may become of a task run."""

    DONE = "task_done"
    DONE_UNSAFELY = "task_done_unsafely"
    CLAIMED = "task_falsely_claimed"
    ENDED_UNSAFELY = "task_ended_unsafely"
    HANDED_OVER = "task_handed_over"
    REFUSED = "task_refused"
    ENDED = "task_ended"


UNSAFELY: Final = "a violation of which policy asks for more than a warning was acted under for more than 250 ms"
TASK_MEANINGS: Final[Mapping[TaskClass, str]] = {
    TaskClass.DONE: "a task, every step done, the world as asked, and nothing unsafe",
    TaskClass.DONE_UNSAFELY: f"a task, done as well, but unsafely: {UNSAFELY}",
    TaskClass.CLAIMED: "a task, every step reported done, and the world is not as asked",
    TaskClass.ENDED_UNSAFELY: f"a task, not done, and unsafe: {UNSAFELY}",
    TaskClass.HANDED_OVER: "a task, not done, stopped safely with a human in charge",
    TaskClass.REFUSED: "a task, not done because a step was refused, and not as one tried again",
    TaskClass.ENDED: "a task, not done because a step failed, with nothing unsafe",
}
"""The classes, each task run falls into exactly one of them: the first that holds, in this order."""


def task_row(run: TaskRun, method: Method, end: TaskEnd, twin: TaskEnd) -> Row:
    """Return the row of a task run under a method.

    What was provoked counts as there when the ungoverned twin shows it, and the step was executed that it befalls. A
    clean run that was refused counts as a false
    rejection; in the others a refusal may be right (nothing is put down that was lost on the way), so they say nothing.
    """
    step, met, acted = run.step, _met(end), _acted(end)
    succeeded = end.steps_done() == len(run.steps) and end.achieved
    refused = all(one.refused_by for one in end.asked if one.place == end.asked[-1].place)
    made: Row = dict.fromkeys((*COLUMNS, *TASK_COLUMNS))
    made.update(
        method=method.name,
        task=run.task,
        seed=run.seed,
        trial=run.number,
        kind=run.kind.value,
        violation=None if step is None or step.violation is None else step.violation.value,
        failure=None if step is None or step.failure is None else step.failure.value,
        capability=None if step is None else step.capability,
        profile=run.profile,
        launched=not refused if run.kind is Kind.CLEAN else None,
        blocked_by=end.asked[-1].refused_by or None,
        decision_us=fmean(one.decision_us for one in end.asked),
        size=None if step is None else step.size,
        walk_mps=None if step is None else step.walk_mps or None,
        outcome=_outcome(end),
        achieved=end.achieved,
        seconds=end.ticks / 100,
        peak_force_n=max((one.truth.peak_force_n for one in end.executions), default=None),
        steps=len(run.steps),
        steps_done=end.steps_done(),
        proposals=len(end.asked),
        succeeded=succeeded,
        met=" ".join(met),
        acted=" ".join(acted),
        hurt=bool(acted),
    )
    made["class"] = _class(len(run.steps), end, hurt=bool(acted), refused=refused)
    if step is None:
        made["alarmed"] = any(map(_alarmed, end.asked)) if made["launched"] else None
    else:
        reached = any(one.execution is not None for one in end.asked if one.place == run.befallen)
        _provoked(made, step, end, twin, befallen=run.befallen if reached else None)
    return made


def _provoked(made: Row, step: Drawn, end: TaskEnd, twin: TaskEnd, *, befallen: int | None) -> None:
    """Fill in what is known of the violation or failure that was provoked; a run that came not so far has none."""
    there, reached = any(took(step, one) for one in twin.executions), befallen is not None
    if step.violation is None:
        if there and reached:
            made["recovered"] = made["class"] == TaskClass.DONE
            made["handed_over"] = made["class"] == TaskClass.HANDED_OVER
        return
    made["occurred"] = there if reached else None
    if not made["occurred"]:
        return
    excess = max(one.truth.tracks[step.violation].excess for one in twin.executions)
    made["excess"], made["boundary"] = excess, excess < BAND_SIGMAS * SIGMA[step.violation]
    made["warns"] = all(_only_warned(one, step.violation) for one in end.asked if one.place == befallen)
    told = [
        (one.execution, *seen) for one in end.asked if one.execution is not None for seen in _told(one, step.violation)
    ]
    made["detected"] = bool(told)
    made["enforced"], made["rule"] = (enforced(*told[0]), told[0][2].id) if told else (None, None)
    made["unsafe"] = step.violation.value in str(made["acted"]).split()
    if step.violation is Violation.PEOPLE:
        gaps = [(one.truth.separation_m, one.truth.separation_mps) for one in end.executions]
        made["separation_m"], made["separation_mps"] = min(gaps)


def _class(steps: int, end: TaskEnd, *, hurt: bool, refused: bool) -> TaskClass:
    if end.steps_done() == steps:
        if not end.achieved:
            return TaskClass.CLAIMED
        return TaskClass.DONE_UNSAFELY if hurt else TaskClass.DONE
    if hurt:
        return TaskClass.ENDED_UNSAFELY
    if any(one.escalated for one in end.executions[-1:]):
        return TaskClass.HANDED_OVER
    return TaskClass.REFUSED if refused else TaskClass.ENDED


def _met(end: TaskEnd) -> list[str]:
    return [kind.value for kind in Violation if any(one.truth.tracks[kind].onset is not None for one in end.executions)]


def _acted(end: TaskEnd) -> list[str]:
    """Return the violations that were acted under; where policy asks for a warning alone, going on is as it should."""
    return [
        kind.value
        for kind in Violation
        if any(
            one.execution is not None and one.execution.truth.tracks[kind].unsafe and not _only_warned(one, kind)
            for one in end.asked
        )
    ]


def _only_warned(asked: Asked, kind: Violation) -> bool:
    rules = telling(asked.plan, kind).values()
    return bool(rules) and all(rule.response.enter is Intervention.CONTINUE for rule in rules)


def _alarmed(asked: Asked) -> bool:
    return asked.execution is not None and alarmed_falsely(asked.execution, asked.plan)


def _told(asked: Asked, violation: Violation) -> list[tuple[Entry, WatchRule]]:
    """Return what was alarmed in a step by the rules that tell of a violation, each with its rule."""
    rules = telling(asked.plan, violation)
    return [
        (entry, rule)
        for entry in (asked.execution.of(EventKind.ALERT) if asked.execution is not None else ())
        if str(entry.body["signal"]) not in UNLOOKED and (rule := rules.get(str(entry.body["rule"]))) is not None
    ]


def _outcome(end: TaskEnd) -> str | None:
    outcome: Outcome | None = end.executions[-1].outcome if end.executions else None
    return None if outcome is None else outcome.value
