"""One physical trial under every method that is compared: the twin first, then as few executions as tell them apart.

Methods that launch the same parameters under the same watcher and recovery behave alike, bit by bit, so they share an
execution: whoever watches nothing shares the ungoverned twin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from app.cell.run import Doing
from app.evaluation.capabilities import judge_of, restored_of, undoable_of
from app.evaluation.circumstances import AS_REPORTED, USUAL, Circumstances, other_way
from app.evaluation.draws import Drawn, draw, of_type
from app.evaluation.episode import LIMIT_TICKS, RECOVERY_TICKS, Execution, Supervised, governed, ungoverned
from app.evaluation.journals import Journals
from app.evaluation.methods import Passed, Recovering, Watching
from app.evaluation.model import Breach, Failure, Kind, Violation
from app.evaluation.permits import context_of
from app.evaluation.stage import Stage
from app.evaluation.timing import time_gates
from app.evaluation.truth import SIGMA, Truth
from app.governance.guard import check
from app.governance.model import AgentFacts, Context, Intervention, Proposal
from app.governance.plans import watch_plan
from app.sim.faults import Scenario
from app.sim.sensors import AS_MEASURED, Quality

if TYPE_CHECKING:
    from app.cell.runner import Runner
    from app.evaluation.capabilities import Judge
    from app.evaluation.methods import Method
    from app.governance.model import Params, WatchPlan
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

MOST_TURNS: Final = 6
"""So often a trial is drawn again when its fault does not take; then it is kept as one that did not occur."""

LONGEST_TICKS: Final = 1600
"""16 s: a fault shows by then, or it has not taken; what comes later follows from a failed first attempt."""

BAND_SIGMAS: Final = 3.0

Change = Callable[["WatchPlan"], "WatchPlan"]


class Ran(NamedTuple):
    """A trial under one method: what the gate said, how long that took, and what was executed (None: nothing).

    `undoable` says whether there was anything to go back to when a rollback began (None: none did), `restored` whether
    the world is at the end as it was at the beginning.
    """

    passed: Passed
    decision_us: float
    execution: Execution | None
    restored: bool | None
    undoable: bool | None = None


@dataclass(slots=True)
class Bench:
    """What a process needs to run trials: policy, prepared worlds, a place for journals."""

    policy: PolicySet
    stage: Stage
    under: Circumstances = AS_REPORTED
    journals: Journals = field(default_factory=Journals)

    @classmethod
    def of(cls, policy: PolicySet, quality: Quality = AS_MEASURED) -> Bench:
        """Set a bench up for a policy, with sensors of a quality."""
        return cls(policy, Stage(policy.site, quality))

    @classmethod
    def in_circumstances(cls, policy: PolicySet, under: Circumstances) -> Bench:
        """Set a bench up for a policy, in the circumstances that a campaign asks for."""
        return cls(policy, Stage(policy.site, under.quality), under)


@dataclass(slots=True)
class Trial:
    """A trial that took: what was drawn, how often it had to be, its twin, and the proposal that all methods get.

    A twin that is not `whole` was ended once it had shown whether the fault took, and by enough to be beyond the
    boundary band; it tells nothing else, and no method shares it. A clean trial needs none then.
    """

    drawn: Drawn
    turns: int
    proposal: Proposal
    context: Context
    plan: WatchPlan
    twin: Execution | None
    whole: bool = True

    @property
    def occurred(self) -> bool:
        """Return whether the violation, or the failure, was really there in the ungoverned twin."""
        return self.twin is not None and took(self.drawn, self.twin)

    @property
    def boundary(self) -> bool:
        """Return whether the violation stayed within three sigma of the limit."""
        violation = self.drawn.violation
        if violation is None or self.twin is None or not SIGMA[violation]:
            return False
        return self.twin.truth.tracks[violation].excess < BAND_SIGMAS * SIGMA[violation]


def took(drawn: Drawn, twin: Execution) -> bool:
    """Say whether a fault took: whether the ungoverned twin shows what was to be provoked, and soon enough."""
    if drawn.violation is not None:
        onset = twin.truth.tracks[drawn.violation].onset
        return onset is not None and onset <= LONGEST_TICKS
    match drawn.failure:
        case None:
            return False
        case Failure.FAILED_GRASP:
            return bool(twin.failures) or twin.truth.tracks[Violation.POSTCONDITION].onset is not None
        case Failure.TIMEOUT | Failure.WITHDRAWN:
            return twin.ticks > drawn.size * 100
        case _:
            return bool(twin.failures)


def prepare(
    bench: Bench,
    seed: int,
    number: int,
    *,
    wanted: Kind | Violation | Failure | None = None,
    whole: bool = True,
) -> Trial:
    """Draw a trial until its fault takes, and run its ungoverned twin, whole or as far as that needs."""
    return taken(bench, lambda turn: _drawn(bench, seed, number, wanted, turn), whole=whole)


def taken(bench: Bench, draw_turn: Callable[[int], Drawn], *, whole: bool = True) -> Trial:
    """Draw with a function of the turn until the fault takes, and run the ungoverned twin."""
    turn = 0
    while True:
        trial = twinned(bench, draw_turn(turn), turn, whole=whole)
        faultless = trial.drawn.violation is None and trial.drawn.failure is None
        turn += 1
        if faultless or trial.occurred or turn == MOST_TURNS:
            return trial


def _drawn(bench: Bench, seed: int, number: int, wanted: Kind | Violation | Failure | None, turn: int) -> Drawn:
    policy, size = bench.policy, bench.under.fault_size
    if isinstance(wanted, Violation | Failure):
        drawn = of_type(policy, seed, number, wanted, turn=turn, size=size)
    else:
        drawn = draw(policy, seed, number, kind=wanted, turn=turn, size=size)
    if bench.under.walks == USUAL or drawn.violation is not Violation.PEOPLE:
        return drawn
    walk, pace = other_way(policy, drawn, np.random.default_rng((seed, number, turn, 31)))
    return replace(drawn, scenario=Scenario(people=(walk,)), size=pace, walk_mps=pace)


def ready(bench: Bench, drawn: Drawn, turn: int = 0) -> tuple[Trial, Workcell]:
    """Return a drawn trial without its twin, and the workcell as it stands there when the trial begins."""
    policy = bench.policy
    cell = bench.stage.set(drawn.start, drawn.world, drawn.scenario)
    params = policy.validate_params(drawn.capability, drawn.params)
    if isinstance(params, tuple):
        raise TypeError(f"trial {drawn.seed}/{drawn.number} draws parameters that nobody could propose: {params}")
    context = context_of(cell, policy, drawn.profile)
    if drawn.breach is Breach.PERMISSION:
        context = Context(
            time_s=context.time_s,
            profile=context.profile,
            agent=AgentFacts(name="visitor", permissions=frozenset()),
            cell=context.cell,
            operator_on_duty=True,
        )
    proposal = Proposal(capability=drawn.capability, params=params)
    if drawn.kind is not Kind.UNAUTHORIZED:  # execution begins from an allowed request (paper, Experiment 2)
        verdict = check(policy, proposal, context)
        proposal = Proposal(capability=drawn.capability, params=verdict.effective)
    plan = watch_plan(policy, drawn.capability, drawn.profile, proposal.params)
    return Trial(drawn, turn, proposal, context, plan, None), cell


def twinned(bench: Bench, drawn: Drawn, turn: int = 0, *, whole: bool = True) -> Trial:
    """Return a drawn trial with its ungoverned twin; what is not authorized has none."""
    trial, cell = ready(bench, drawn, turn)
    trial.whole = whole
    needless = drawn.kind is Kind.CLEAN and not whole
    if drawn.kind is not Kind.UNAUTHORIZED and not needless:
        truth, judge = looking(bench.policy, drawn, trial.plan), judge_of(drawn)
        params = trial.proposal.params
        if whole:
            trial.twin = ungoverned(cell, drawn.capability, params, truth, judge)
        else:
            shown = _shown(drawn)
            trial.twin = ungoverned(cell, drawn.capability, params, truth, judge, retries=0, enough=shown)
    return trial


def _shown(drawn: Drawn) -> Callable[[Truth], bool]:
    """Return what says that a twin has shown what it is for."""
    violation = drawn.violation
    if violation is not None:
        band = BAND_SIGMAS * SIGMA[violation]
        return lambda truth: (
            truth.tick > LONGEST_TICKS
            or (truth.tracks[violation].onset is not None and truth.tracks[violation].excess >= band)
        )
    match drawn.failure:
        case Failure.FAILED_GRASP:
            return lambda truth: truth.tracks[Violation.POSTCONDITION].onset is not None
        case Failure.TIMEOUT | Failure.WITHDRAWN:
            return lambda truth: truth.tick > drawn.size * 100
        case _:
            return lambda _: False


def looking(policy: PolicySet, drawn: Drawn, plan: WatchPlan) -> Truth:
    """Return what looks at the truth of an execution of this trial."""
    budget = policy.profiles[drawn.profile].retry_budget
    return Truth(plan=plan, people_m=_kept_m(plan), budget=budget)


def _kept_m(plan: WatchPlan) -> float | None:
    """Return the fixed distance to people that policy asks for; None where it is the protective separation, or nothing.

    A rule that only warns asks for its distance where no other does: beside one that holds the robot it is early.
    """
    rows = [rule for rule in plan.rules if rule.signal == "separation_m"]
    holding = [rule for rule in rows if rule.response.enter is not Intervention.CONTINUE]
    asked = [rule.threshold for rule in holding or rows]
    fixed = [threshold for threshold in asked if threshold is not None]
    return max(fixed) if fixed and len(fixed) == len(asked) else None


def run(
    bench: Bench,
    trial: Trial,
    methods: Sequence[Method],
    *,
    change: Change | None = None,
    limit: int = LIMIT_TICKS + RECOVERY_TICKS,
) -> Mapping[str, Ran]:
    """Run a trial under every method; returns what came of it by the method's name.

    Args:
        bench: where.
        trial: what.
        methods: who.
        change: changes every watch plan, to take a detector out or move the sensitivity.
        limit: ticks after which a session under governance that is not over is let go.
    """
    shared: dict[object, tuple[Execution, bool | None, bool | None]] = {}
    found: dict[str, Ran] = {}
    gates = time_gates(
        methods,
        bench.policy,
        trial.proposal,
        trial.context,
        approved=trial.drawn.breach is not Breach.APPROVAL,
        seed=(trial.drawn.seed, trial.drawn.number),
    )
    for method in methods:
        passed, spent_us = gates[method.name]
        execution = restored = undoable = None
        if passed.launched and trial.drawn.kind is not Kind.UNAUTHORIZED:
            key = (*alike(method), tuple(sorted(passed.effective.items())))
            if key not in shared:
                shared[key] = _execute(bench, trial, method, passed.effective, change, limit)
            execution, restored, undoable = shared[key]
        found[method.name] = Ran(passed, spent_us, execution, restored, undoable)
    return found


def shares_twin(method: Method) -> bool:
    """Say whether a method's executions are the ungoverned twin itself."""
    return alike(method) == ("twin",)


def alike(method: Method) -> tuple[object, ...]:
    """Return what tells the executions of methods apart, once they have launched the same parameters."""
    if method.watch is Watching.NOTHING and method.recovery is Recovering.RETRY:
        return ("twin",)
    return (method.watch, method.recovery, method.human, method.guard or method.watch is not Watching.NOTHING)


def _execute(
    bench: Bench, trial: Trial, method: Method, effective: Params, change: Change | None, limit: int
) -> tuple[Execution, bool | None, bool | None]:
    drawn, twin = trial.drawn, trial.twin
    if twin is not None and trial.whole and alike(method) == ("twin",) and effective == trial.proposal.params:
        return twin, None, None
    cell = bench.stage.set(drawn.start, drawn.world, drawn.scenario)
    began = cell.truth()
    restored, undoable = restored_of(drawn, began), Once(cell, undoable_of(drawn, began))
    truth = looking(bench.policy, drawn, trial.plan)
    if alike(method) == ("twin",):
        return ungoverned(cell, drawn.capability, effective, truth, judge_of(drawn)), None, None
    withdrawn = drawn.failure is Failure.WITHDRAWN
    supervised = Supervised(order="rollback", order_tick=round(drawn.size * 100)) if withdrawn else Supervised()
    execution = governed(
        cell,
        method,
        bench.policy,
        Proposal(capability=drawn.capability, params=effective),
        drawn.profile,
        truth,
        judge_of(drawn),
        bench.journals,
        supervised=supervised,
        plan_change=change or _as_is,
        during=undoable.see,
        limit=limit,
    )
    return execution, _at_rest(cell, restored), undoable.found


@dataclass(slots=True)
class Once:
    """Judges a workcell in the tick in which a rollback is bound for the first time, before it has moved anything."""

    cell: Workcell
    judge: Judge
    found: bool | None = None

    def see(self, runner: Runner) -> None:
        """Take one tick."""
        session = runner.session
        if self.found is None and session is not None and session.run.doing is Doing.ROLLBACK:
            self.found = self.judge(self.cell)


def _at_rest(cell: Workcell, restored: Judge) -> bool:
    for _ in range(20):
        cell.step(cell.hold())
    return restored(cell)


def _as_is(plan: WatchPlan) -> WatchPlan:
    return plan
