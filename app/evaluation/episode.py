"""One execution in the workcell: ungoverned, or under as much governance as a method has.

Both run the same skill from the same start; what differs is who stands between it and the actuators. An execution under
governance goes the whole way: a signed permit, the cell's runner with its journal, clamp, watcher and recovery.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Final

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.cell.journal import Entry, Journal
from app.cell.run import Doing
from app.cell.runner import Runner
from app.cell.substrate import SubstrateError
from app.evaluation.floor import RETREATS
from app.evaluation.methods import Recovering, Watching
from app.evaluation.model import AGENT
from app.governance.conditions import unmet
from app.governance.coverage import covered_recoveries
from app.governance.model import (
    Authorization,
    Bounds,
    CellFacts,
    Context,
    CoveredRecovery,
    EventKind,
    Mode,
    Outcome,
    Proposal,
    RecoveryPlan,
    RecoveryRule,
    SkillState,
    Status,
    Strategy,
    WatchPlan,
)
from app.governance.permit import mint, verify
from app.governance.policy import recovery_plan, watch_plan, watch_plan_for
from app.governance.signals import SIGNAL_NAMES
from app.governance.watcher import without
from app.sim.skills import Run

if TYPE_CHECKING:
    from app.cell.substrate import Skill
    from app.evaluation.methods import Method
    from app.evaluation.truth import Truth
    from app.governance.model import Params, WorldFacts
    from app.governance.permit import Grant, SignedAuthorization
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

LIMIT_TICKS: Final = 3000  # most trials take 5 to 16 s; the longest carry at 0.2 m/s takes 25
RECOVERY_TICKS: Final = 9000
"""And what recovering may add: five new attempts, as sim-relaxed allows them, take 75 s before policy ends it."""
ANSWER_TICKS: Final = 200  # the supervisor is there within two seconds
AGENT_RETRIES: Final = 1
INTERNAL_SIGNALS: Final = frozenset({"contact_force_n", "grip_force_n", "slip_m", "grip_lost", "elapsed_s"})
"""What a skill's embedded checks can see: its own gripper, its own contact force, its own time."""
UNSEEN: Final[Mapping[Watching, frozenset[str]]] = {
    Watching.GOVERNED: frozenset(),
    Watching.INTERNAL: frozenset(SIGNAL_NAMES) - INTERNAL_SIGNALS,
    Watching.NOTHING: frozenset(SIGNAL_NAMES),
}
"""What a method's watcher is blind to, the rules included that a watcher has without being asked."""

_KEY: Final = Ed25519PrivateKey.generate()
_UNBOUNDED: Final = Bounds(1e3, 1e3, 1e4, 1e5, 1e2)
_WALL_S: Final = 1.0e9


@dataclass(slots=True)
class Execution:
    """What happened in an execution. Ticks count from the launch, at 100 a second.

    `over` is whether it had ended when the evaluation let go of it. `answers` are the words of humans who were asked
    midway, `waited_ticks` how long they were waited for, all in all. `claimed` is whether the skill said that it had
    succeeded, `achieved` whether the world says so too; `going` holds for every tick under governance whether the skill
    was let go on.
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
    grant = _grant(cell, capability, params)
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


class Journals:
    """A folder for journals that nobody will read again."""

    def __init__(self) -> None:
        """Make the folder; it goes with this object."""
        self._folder = Path(mkdtemp(prefix="reins-evaluation-"))
        self._remove = weakref.finalize(self, rmtree, self._folder)
        self._count = 0

    def open(self) -> Journal:
        """Return a fresh journal."""
        self._count += 1
        return Journal(self._folder / f"{self._count}.journal", boot="evaluation")

    def close(self) -> None:
        """Remove the folder."""
        self._remove()


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
        then = _recovery(method, recovery_plan(policy, permit.capability, permit.profile))
        plan = (
            watch_plan_for(policy, permit)
            if recovery is None
            else watch_plan(policy, recovery.capability, permit.profile, recovery.params, recovery.mode)
        )
        truth.plan = plan  # a recovery is held to what policy allows it, not to what the task was allowed
        return plan_change(_watch(method, plan)), then

    promised = policy.capabilities[proposal.capability].postconditions

    def verified(postconditions: tuple[str, ...], params: Params, facts: WorldFacts) -> tuple[str, ...]:
        if "postcondition" in UNSEEN[method.watch] and postconditions == promised:
            return ()  # who does not look at what was promised takes the skill's word for it
        return tuple(found.condition for found in unmet(postconditions, params, facts, policy.site))

    runner = Runner(cell, plan_of=plan_of, verify=verified, journal=journal, wall=lambda: _WALL_S, emit=entries.append)
    runner.adopt(policy_digest=policy.digest, key=_KEY.public_key())
    done = Execution(truth)
    refused = runner.launch(mint(authorize(cell, method, policy, proposal, profile), _KEY))
    if refused is None:
        _watch_over(runner, cell, done, supervised, achieved, during, limit)
    else:
        done.refused = refused
    done.entries, done.ticks, done.achieved = tuple(entries), truth.tick, achieved(cell)
    ends = [str(entry.body["outcome"]) for entry in done.of(EventKind.OUTCOME)]
    done.outcome = Outcome(ends[-1]) if ends else None
    done.over = runner.session is None
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


def adopt(runner: Runner, policy: PolicySet) -> None:
    """Let a cell believe authorizations under another policy from now on, as it does when one is activated."""
    runner.adopt(policy_digest=policy.digest, key=_KEY.public_key())


def signed(permit: Authorization) -> SignedAuthorization:
    """Sign an authorization as the kernel of these executions does."""
    return mint(permit, _KEY)


def _starts(skill: Skill | None, capability: str) -> int:
    """Return how often a skill has begun with the task itself: what begins anew in a recovery is no retry of it."""
    return skill.starts if isinstance(skill, Run) and skill.capability == capability else 0


def authorize(cell: Workcell, method: Method, policy: PolicySet, proposal: Proposal, profile: str) -> Authorization:
    """Make the permit that the kernel would make for this proposal, with the recoveries that the method has."""
    return Authorization(
        id="permit",
        invocation="trial",
        cell=cell.id,
        capability=proposal.capability,
        version=policy.capabilities[proposal.capability].version,
        params=proposal.params,
        mode=proposal.mode,
        profile=profile,
        policy_digest=policy.digest,
        issued_at_s=_WALL_S,
        expires_at_s=_WALL_S + 60.0,
        recoveries=_covered(method, policy, proposal, context_of(cell, policy, profile)),
        approvals=("supervisor",),
    )


def context_of(cell: Workcell, policy: PolicySet, profile: str) -> Context:
    """Return Γ_t as the server would see this cell."""
    facts = CellFacts(id=cell.id, online=True, facts=cell.facts())
    return Context(time_s=_WALL_S, profile=profile, agent=policy.agent(AGENT), cell=facts, operator_on_duty=True)


def _covered(method: Method, policy: PolicySet, proposal: Proposal, context: Context) -> tuple[CoveredRecovery, ...]:
    match method.recovery:
        case Recovering.GOVERNED:
            return covered_recoveries(policy, proposal, context)
        case Recovering.INTERNAL:
            return (
                CoveredRecovery(strategy=Strategy.RETRY, capability=proposal.capability, params=proposal.params),
                CoveredRecovery(strategy=Strategy.RECOVERY_CAPABILITY, capability="release_and_retract", params={}),
            )
        case _:
            return ()


_INTERNAL_ROWS: Final = (
    RecoveryRule(
        on="grasp_failed", do=(Strategy.RECOVERY_CAPABILITY, Strategy.RETRY), capability="release_and_retract"
    ),
    RecoveryRule(on="object_lost", do=(Strategy.RECOVERY_CAPABILITY, Strategy.RETRY), capability="release_and_retract"),
    RecoveryRule(on="any", do=(Strategy.RETRY, Strategy.TERMINATE)),
)


def _recovery(method: Method, plan: RecoveryPlan) -> RecoveryPlan:
    match method.recovery:
        case Recovering.GOVERNED:
            return replace(plan, can_ask=plan.can_ask and method.human)
        case Recovering.INTERNAL:
            return replace(plan, rules=_INTERNAL_ROWS, retry_budget=1, rollback="optional", rollback_capability=None)
        case _:
            end = RecoveryRule(on="any", do=(Strategy.TERMINATE,))
            return replace(plan, rules=(end,), retry_budget=0, rollback="optional", rollback_capability=None)


def _watch(method: Method, plan: WatchPlan) -> WatchPlan:
    if not method.guard:  # bounds are what policy allows: a method that does not ask it has none
        plan = replace(plan, bounds=_UNBOUNDED) if method.watch is Watching.NOTHING else plan
    return without(plan, *sorted(UNSEEN[method.watch]))


def _grant(cell: Workcell, capability: str, params: Params) -> Grant:
    """Return a grant for the ungoverned: the substrate moves on nothing else."""
    permit = Authorization(
        id="permit",
        invocation="trial",
        cell=cell.id,
        capability=capability,
        version="1.0.0",
        params=params,
        mode=Mode.NORMAL,
        profile="ungoverned",
        policy_digest="none",
        issued_at_s=_WALL_S,
        expires_at_s=_WALL_S + 60.0,
    )
    return verify(
        mint(permit, _KEY),
        key=_KEY.public_key(),
        cell=cell.id,
        policy_digest="none",
        now_s=_WALL_S + 1.0,
        used=frozenset(),
    )
