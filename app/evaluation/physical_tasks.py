"""Task runs: an agent takes the steps of a task one after the other, in one world that goes on from step to step.

The world is set once. Every step is proposed anew, with the context that the cell has then, goes through the gate of
the method and is executed as a single trial is (`episode`): a permit, a watcher and recovery of its own.

The agent is the same under every method. It asks within policy, as single trials do; waits a moment between steps; and
goes on when a step is reported done. A step that was refused, or ended otherwise, is proposed once more; then the task
ends. It ends at once where a human has taken the matter in hand. The ungoverned skill has no retry of its own here: it
is the agent that tries again.

Methods that run alike and say the same to every proposal share a run, because decisions are pure: those of another
method are asked for, with the proposals and contexts that were recorded.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot
from typing import TYPE_CHECKING, Final

from app.evaluation.capabilities import judge_of
from app.evaluation.draws import Drawn
from app.evaluation.episode import LIMIT_TICKS, RECOVERY_TICKS, Execution, governed, ungoverned
from app.evaluation.extensions import find_method, find_task
from app.evaluation.methods import METHODS, Passed
from app.evaluation.permits import context_of
from app.evaluation.physical_trial import Bench, alike, looking, shares_twin, took
from app.evaluation.task_draws import DRIVING, TaskRun, draw_task
from app.evaluation.task_end import Asked, TaskEnd
from app.evaluation.task_rows import task_row
from app.evaluation.timing import Timed, time_gate
from app.governance.guard import check
from app.governance.model import Context, Proposal, WatchPlan
from app.governance.plans import watch_plan

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from app.evaluation.jobs import Job
    from app.evaluation.methods import Method
    from app.evaluation.model import Row, Task
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

DIRECT: Final = METHODS["direct"]
"""Who runs the ungoverned twin."""

PAUSE_TICKS: Final = 20
"""What the agent takes to see that a step is done."""

AGAIN_TICKS: Final = 100
"""And before it proposes a step once more."""

DRIVE_TICKS: Final = 9000  # the way from bench to bench at 0.15 m/s takes 40 s, and more with people on it
MOST_TURNS: Final = 3
"""So often a run is drawn again when what goes wrong does not take; then it is kept as one in which it did not."""

PLACED_M: Final = 0.10
LASTING: Final = ("place_object", "operate_tool", "inspect_area")
"""What is still to hold when the task is over, whatever came after it; of the others only what came last."""


def run_task(bench: Bench, run: TaskRun, method: Method) -> TaskEnd:
    """Run a task under a method, from its beginning."""
    cell = bench.stage.set(run.steps[0].start, run.steps[0].world, run.scenario)
    end = TaskEnd()
    for place, step in enumerate(run.steps):
        if not _taken(bench, cell, method, place, step, end):
            break
    _wait(cell, end, PAUSE_TICKS)
    end.achieved = all(_holds(step, cell) for step in _goals(run.steps))
    return end


def run_twin(bench: Bench, task: Task, seed: int, number: int) -> tuple[TaskRun, int, TaskEnd]:
    """Draw a task run until what goes wrong takes; returns it, how often it was drawn again, and its twin."""
    turn = 0
    while True:
        run = draw_task(bench.policy, task, seed, number, turn, bench.under.fault_size)
        twin = run_task(bench, run, DIRECT)
        if run.step is None or turn == MOST_TURNS or any(took(run.step, one) for one in twin.executions):
            return run, turn, twin
        turn += 1


def run_under(bench: Bench, run: TaskRun, twin: TaskEnd, methods: Sequence[Method]) -> Mapping[str, TaskEnd]:
    """Run a task under every method; returns what came of each by the method's name."""
    ends: dict[object, list[TaskEnd]] = {alike(DIRECT): [twin]}
    found: dict[str, TaskEnd] = {}
    for method in methods:
        alike_ends = ends.setdefault(alike(method), [])
        again = next((one for end in alike_ends if (one := _said(bench, method, end)) is not None), None)
        if again is None:
            again = run_task(bench, run, method)
            alike_ends.append(again)
        found[method.name] = again
    return found


def run_tasks(bench: Bench, job: Job, names: Sequence[str]) -> Iterator[Row]:
    """Run the task runs of a job under some methods; a row for each of them and method.

    Raises:
        UnknownName: there is no such method or task.
    """
    methods, task = [find_method(name) for name in names], find_task(job.task)
    for number in range(job.first, job.first + job.count):
        run, turns, twin = run_twin(bench, task, job.seed, number)
        ends = run_under(bench, run, twin, methods)
        for method in methods:
            yield {**task_row(run, method, ends[method.name], twin), "turns": turns}


def _taken(bench: Bench, cell: Workcell, method: Method, place: int, step: Drawn, end: TaskEnd) -> bool:
    """Propose a step, and once more if it does not get done; says whether the agent may go on."""
    for pause in (PAUSE_TICKS, AGAIN_TICKS):
        _wait(cell, end, pause)
        asked = _ask(bench, cell, method, place, step)
        end.asked.append(asked)
        if asked.execution is not None:
            end.ticks += asked.execution.ticks
        if asked.done:
            return True
        if asked.execution is not None and asked.execution.escalated:
            return False
    return False


def _ask(bench: Bench, cell: Workcell, method: Method, place: int, step: Drawn) -> Asked:
    """Propose a step in the present context, and execute it where the gate lets it through."""
    policy = bench.policy
    params = policy.validate_params(step.capability, step.params)
    if isinstance(params, tuple):
        raise TypeError(f"run {step.seed}/{step.number} draws parameters that nobody could propose: {params}")
    context = context_of(cell, policy, step.profile)
    proposal = Proposal(capability=step.capability, params=params)
    # An agent that has read policy asks for no more than it allows (as in single trials).
    proposal = replace(proposal, params=check(policy, proposal, context).effective)
    passed, spent_us = _gate(method, policy, proposal, context)
    plan = watch_plan(policy, step.capability, step.profile, passed.effective)
    execution = _execute(bench, cell, method, step, passed, plan) if passed.launched else None
    return Asked(place, proposal, context, passed, spent_us, plan, execution)


def _gate(method: Method, policy: PolicySet, proposal: Proposal, context: Context) -> Timed:
    return time_gate(method, policy, proposal, context, approved=True)


def _execute(bench: Bench, cell: Workcell, method: Method, step: Drawn, passed: Passed, plan: WatchPlan) -> Execution:
    truth, judge = looking(bench.policy, step, plan), judge_of(step)
    limit = DRIVE_TICKS if step.capability in DRIVING else LIMIT_TICKS
    if shares_twin(method):
        return ungoverned(cell, step.capability, passed.effective, truth, judge, retries=0, limit=limit)
    proposal = Proposal(capability=step.capability, params=passed.effective)
    return governed(
        cell,
        method,
        bench.policy,
        proposal,
        step.profile,
        truth,
        judge,
        bench.journals,
        limit=limit + RECOVERY_TICKS,
    )


def _said(bench: Bench, method: Method, end: TaskEnd) -> TaskEnd | None:
    """Return a run as a method's own if the method says the same to all its proposals, None if it does not."""
    asked: list[Asked] = []
    for one in end.asked:
        passed, spent_us = _gate(method, bench.policy, one.proposal, one.context)
        if (passed.launched, passed.effective) != (one.passed.launched, one.passed.effective):
            return None
        asked.append(one._replace(passed=passed, decision_us=spent_us))
    return TaskEnd(asked, end.ticks, end.achieved)


def _wait(cell: Workcell, end: TaskEnd, ticks: int) -> None:
    for _ in range(ticks):
        cell.step(cell.hold())
    end.ticks += ticks


def _goals(steps: Sequence[Drawn]) -> list[Drawn]:
    return [step for place, step in enumerate(steps) if step.capability in LASTING or place == len(steps) - 1]


def _holds(step: Drawn, cell: Workcell) -> bool:
    """Say whether what a step was for is so in the world; what was to be put somewhere stands within 10 cm of it."""
    if not judge_of(step)(cell):
        return False
    match step:
        case Drawn(capability="place_object", params={"x_m": float(x), "y_m": float(y)}):
            at = cell.truth().objects[step.start.holding]
            return hypot(x - at[0], y - at[1]) < PLACED_M
        case _:
            return True
