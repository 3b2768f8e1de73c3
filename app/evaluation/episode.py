"""One execution in the workcell: ungoverned, or under as much governance as a method has.

Both run the same skill from the same start; what differs is who stands between it and the actuators. An execution under
governance goes the whole way: a signed permit, the cell's runner with its journal, clamp, watcher and recovery.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from app.cell.journal import Entry
from app.cell.run import Doing
from app.cell.runner import Runner
from app.cell.substrate import SubstrateError
from app.evaluation.capabilities import truly_unmet
from app.evaluation.floor import RETREATS
from app.evaluation.permits import UNSEEN, WALL_S, adopt, authorize, grant_of, recovery_of, signed, watch_of
from app.governance.conditions import unmet
from app.governance.model import (
    CoveredRecovery,
    EventKind,
    Outcome,
    Proposal,
    RecoveryPlan,
    SkillState,
    Status,
    WatchPlan,
)
from app.governance.plans import recovery_plan, watch_plan, watch_plan_for
from app.sim.skills import Run

if TYPE_CHECKING:
    from app.cell.substrate import Skill
    from app.evaluation.journals import Journals
    from app.evaluation.methods import Method
    from app.evaluation.truth import Truth
    from app.governance.model import Params, WorldFacts
    from app.governance.permit import Grant
    from app.governance.policy import PolicySet
    from app.sim import truth as sim_truth
    from app.sim.workcell import Workcell

LIMIT_TICKS: Final = 3000  # most trials take 5 to 16 s; the longest carry at 0.2 m/s takes 25
RECOVERY_TICKS: Final = 9000
"""And what recovering may add: five new attempts, as sim-relaxed allows them, take 75 s before policy ends it."""
REST_TICKS: Final = 300  # what does not stand 3 s after the end of its session is not coming to rest
ANSWER_TICKS: Final = 200  # the supervisor is there within two seconds
AGENT_RETRIES: Final = 1


@dataclass(slots=True)
class Execution:
    """What happened in an execution. Ticks count from the launch, at 100 a second.

    `over` is whether it had ended when the evaluation let go of it. `answers` are the words of humans who were asked
    midway, `waited_ticks` how long they were waited for, all in all. `claimed` is whether the skill said that it had
    succeeded, `achieved` whether the world says so too; `going` holds for every tick under governance whether the skill
    was let go on. `unkept` are the ticks in which something was found not to be as promised, and truly was not.
    """

    truth: Truth
    claimed: bool = False
    achieved: bool = False
    failures: list[tuple[int, str]] = field(default_factory=list[tuple[int, str]])
    attempts: int = 1
    ticks: int = 0
    outcome: Outcome | None = None
    refused: str = ""
    entries: tuple[Entry, ...] = ()
    escalated: bool = False
    over: bool = True
    answers: list[str] = field(default_factory=list[str])
    waited_ticks: int = 0
    going: bytearray = field(default_factory=bytearray)
    unkept: set[int] = field(default_factory=set[int])

    def of(self, kind: EventKind) -> list[Entry]:
        """Return the entries of one kind."""
        return [entry for entry in self.entries if entry.kind == kind]


Achieved = Callable[["Workcell"], bool]


def ungoverned(
    cell: Workcell,
    capability: str,
    params: Params,
    truth: Truth,
    achieved: Achieved,
    *,
    retries: int = AGENT_RETRIES,
    limit: int = LIMIT_TICKS,
    enough: Callable[[Truth], bool] = lambda _: False,
) -> Execution:
    """Run a skill with nobody between it and the actuators; the agent tries again where the skill fails.

    This is the method `direct`, and the twin that tells whether a fault took. `enough` ends it early, for those who
    only ask that.
    """
    done = Execution(truth)
    grant = grant_of(cell, capability, params)
    before = 0
    for _ in range(1 + retries):
        cell.unbind()
        try:
            skill = cell.bind(grant, capability, params)
        except SubstrateError as error:
            done.failures.append((truth.tick, error.failure))
            break
        done.attempts = before + skill.starts
        seen = cell.observe()
        while truth.tick < limit and skill.report().state is SkillState.RUNNING and not enough(truth):
            seen = cell.step(skill.act(seen, 1.0))
            claimed = skill.report().state is SkillState.SUCCEEDED
            falsely = claimed and not achieved(cell)
            done.attempts = before + skill.starts
            truth.see(cell.glance(), attempts=done.attempts, claims_falsely=falsely, executing=True, attempting=True)
        before += skill.starts
        report = skill.report()
        done.claimed, done.over = report.state is SkillState.SUCCEEDED, report.state is not SkillState.RUNNING
        if report.state is not SkillState.FAILED:
            break
        done.failures.append((truth.tick, report.failure))
    done.ticks, done.achieved = truth.tick, achieved(cell)
    cell.unbind()
    return done


@dataclass(frozen=True, slots=True, kw_only=True)
class Supervised:
    """The supervisor of a trial: what is answered to an escalation and how long that takes, and what is asked unasked.

    `after_ticks` is None for one who never answers. After `answers` escalations of one session the word is to end it,
    whatever it was before. `order` is an operator's word (`rollback`, `stop`, …) said at `order_tick`, whatever
    happens then.
    """

    after_ticks: int | None = ANSWER_TICKS
    op: str = "resolve_terminate"
    answers: int = 3
    order: str = ""
    order_tick: int = 0


def governed(  # noqa: PLR0913  # an execution has that many sides
    cell: Workcell,
    method: Method,
    policy: PolicySet,
    proposal: Proposal,
    profile: str,
    truth: Truth,
    achieved: Achieved,
    journals: Journals,
    *,
    supervised: Supervised = Supervised(),  # frozen
    plan_change: Callable[[WatchPlan], WatchPlan] = lambda plan: plan,
    during: Callable[[Runner], None] = lambda runner: None,
    limit: int = LIMIT_TICKS + RECOVERY_TICKS,
) -> Execution:
    """Run a skill under a method's watcher and recovery.

    Args:
        cell: where.
        method: how much governance there is.
        policy: Π.
        proposal: what was let through, with its effective parameters.
        profile: the environment.
        truth: looks on.
        achieved: whether the world is as the capability promises.
        journals: where the cell's journal goes.
        supervised: who answers an escalation.
        plan_change: changes every watch plan (to take a detector out, or to move the sensitivity).
        during: called after every tick, with the runner.
        limit: ticks after which a session that is not over is let go.
    """
    journal = journals.open()
    entries: list[Entry] = []

    def plan_of(grant: Grant, recovery: CoveredRecovery | None = None) -> tuple[WatchPlan, RecoveryPlan]:
        permit = grant.authorization
        then = recovery_of(method, recovery_plan(policy, permit.capability, permit.profile))
        plan = (
            watch_plan_for(policy, permit)
            if recovery is None
            else watch_plan(policy, recovery.capability, permit.profile, recovery.params, recovery.mode)
        )
        truth.plan = plan  # a recovery is held to what policy allows it, not to what the task was allowed
        return plan_change(watch_of(method, plan)), then

    promised = policy.capabilities[proposal.capability].postconditions

    def verified(postconditions: tuple[str, ...], params: Params, facts: WorldFacts) -> tuple[str, ...]:
        if "postcondition" in UNSEEN[method.watch] and postconditions == promised:
            return ()  # who does not look at what was promised takes the skill's word for it
        return tuple(found.condition for found in unmet(postconditions, params, facts, policy.site))

    runner = Runner(cell, plan_of=plan_of, verify=verified, journal=journal, wall=lambda: WALL_S, emit=entries.append)
    adopt(runner, policy)
    done, unkept = Execution(truth), partial(_unkept, cell=cell, began=cell.truth(), achieved=achieved)
    refused = runner.launch(signed(authorize(cell, method, policy, proposal, profile)))
    if refused is None:
        _watch_over(runner, cell, done, supervised, achieved, _noting(done, unkept, during), limit)
    else:
        done.refused = refused
    done.entries, done.ticks = tuple(entries), truth.tick
    done.over = runner.session is None
    if refused is None and done.over:
        watch_rest(runner, cell, truth)
    done.achieved = achieved(cell)
    ends = [str(entry.body["outcome"]) for entry in done.of(EventKind.OUTCOME)]
    done.outcome = Outcome(ends[-1]) if ends else None
    if not done.over:  # out of time: let go, so that the next trial may begin
        runner.estop("evaluation")
        cell.reset()
    cell.unbind()
    journal.close()
    return done


def _watch_over(  # an execution has that many sides
    runner: Runner,
    cell: Workcell,
    done: Execution,
    supervised: Supervised,
    achieved: Achieved,
    during: Callable[[Runner], None],
    limit: int,
) -> None:
    truth, waiting, answered, skill, ended = done.truth, 0, 0, None, 0
    capability = runner.session.run.grant.authorization.capability if runner.session is not None else ""
    while (session := runner.session) is not None and truth.tick < limit:
        runner.tick()
        during(runner)
        bound = session.run.skill
        if bound is not skill:
            ended, skill = ended + _starts(skill, capability), bound
        done.attempts = ended + _starts(skill, capability)
        claims = (
            session.over is not None
            and session.over.outcome in (Outcome.SUCCEEDED, Outcome.RECOVERED)
            and not achieved(cell)
        )
        going = session.over is None and session.run.moves()
        done.going.append(going)
        truth.see(
            cell.glance(),
            attempts=done.attempts,
            claims_falsely=claims,
            executing=going,
            attempting=going and session.run.doing is Doing.ATTEMPT,
            retreating=going and not done.escalated and isinstance(bound, Run) and bound.capability in RETREATS,
        )
        done.escalated = done.escalated or runner.status is Status.ESCALATED
        asking = runner.status is Status.ESCALATED
        waiting, done.waited_ticks = waiting + 1 if asking else 0, done.waited_ticks + asking
        if supervised.order and truth.tick == supervised.order_tick and session.over is None:
            runner.human(session.run.id, supervised.order, "supervisor")
        if waiting == supervised.after_ticks:
            waiting, answered = 0, answered + 1
            op = supervised.op if answered <= supervised.answers else "resolve_terminate"
            done.answers.append(op)
            runner.human(session.run.id, op, "supervisor")


def _noting(
    done: Execution, unkept: Callable[[Runner], bool], during: Callable[[Runner], None]
) -> Callable[[Runner], None]:
    """Return what is called after every tick, and notes the ticks in which a promise is truly not kept."""

    def note(runner: Runner) -> None:
        if unkept(runner):
            done.unkept.add(done.truth.tick + 1)  # the truth takes the tick after this
        during(runner)

    return note


def _unkept(runner: Runner, cell: Workcell, began: sim_truth.Truth, achieved: Achieved) -> bool:
    """Say whether the cell has found something not to be as promised, and the world says the same."""
    session = runner.session
    if session is None or not session.run.unmet:
        return False
    if session.run.doing is Doing.ATTEMPT:
        return not achieved(cell)
    params = session.run.grant.authorization.params
    return any(truly_unmet(name, params, began, cell.truth()) for name in session.run.unmet)


def watch_rest(runner: Runner, cell: Workcell, truth: Truth) -> None:
    """Look on until the robot truly stands: a session is over by what the sensors say, which may be a little before."""
    for _ in range(REST_TICKS):
        runner.tick()
        if truth.settle(cell.glance()):
            return


def _starts(skill: Skill | None, capability: str) -> int:
    """Return how often a skill has begun with the task itself: what begins anew in a recovery is no retry of it."""
    return skill.starts if isinstance(skill, Run) and skill.capability == capability else 0
