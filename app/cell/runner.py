"""The tick loop of one cell: one governed session at a time, 100 times a second (design, section 4, steps 6 and 7).

One `tick` is a plain function call and everything in it happens in this order:

1. the rate ramps: towards 1 where the session may move, else down to 0 as declared (category 2: held, power kept);
2. the skill says what it wants, or, at rate 0, is not even asked: then the command repeats the last one without speed;
3. the clamp holds the command to the session's bounds, and the substrate applies it;
4. the watcher judges what the sensors say, and the declared responses say what follows;
5. what was waiting for standstill is done (a recovery is bound, the session ends), or completion is verified.

A failure goes the same way whatever found it (a watch rule, the skill, a postcondition): hold, ask `recover`, write the
decision to the journal *and to the disk*, and only then bind what it names. Orders from outside (`launch`, `human`,
`estop`, `reset`, `hold`, `welcomed`) are plain calls too, made between ticks by whoever owns the thread. Those that
restrain act first and record afterwards; all others record first.

If the journal cannot be written, nothing moves: the session is brought to a stop, `fault` says why, and what could not
be recorded is kept and recorded as soon as it can be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, TypeAlias, assert_never

from app.cell import telling
from app.cell.journal import USED, Entry, Journal, JournalUnavailable
from app.cell.run import Bind, Doing, End, Run, not_restored
from app.cell.substrate import SubstrateError
from app.governance.clamp import clamp, hold
from app.governance.detectors import Signals
from app.governance.intervention import NOTHING, Decision, Responses, recovering, released
from app.governance.model import (
    EMPTY,
    Alert,
    CoveredRecovery,
    EventKind,
    Intervention,
    Mode,
    Outcome,
    Signal,
    SkillReport,
    SkillState,
    Status,
    Strategy,
)
from app.governance.permit import PermitError, SignedAuthorization, verify
from app.governance.recovery import RecoveryDecision, recover, roll_back
from app.governance.session import Event, accepts, final_status, step
from app.governance.watcher import compile_watch

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    from app.cell.substrate import Substrate
    from app.governance.model import Command, Json, Observation, Params, RecoveryPlan, WatchPlan, WorldFacts
    from app.governance.permit import Grant

Verify: TypeAlias = "Callable[[tuple[str, ...], Params, WorldFacts], tuple[str, ...]]"

SETTLE_TICKS: Final = 50
VERIFY_EVERY: Final = 5
QUIET_TICKS: Final = 50
UNSAID_EVERY: Final = 100


class PlanOf(Protocol):
    """Compiles, from the policy the cell holds, what a grant is watched by; for a recovery it covers, what that one is."""

    def __call__(self, grant: Grant, recovery: CoveredRecovery | None = None) -> tuple[WatchPlan, RecoveryPlan]:
        """Return the plans. Raises `ValueError` where policy does not know what the grant names."""
        ...


class View(NamedTuple):
    """The runner as displays and the server see it. `fault` says why nothing moves, empty when all is well."""

    tick: int
    time_s: float
    invocation: str | None
    status: Status | None
    latched: bool
    holding: str
    fault: str
    signals: Signals


class Runner:
    """Runs sessions on one substrate. Not thread-safe: one thread owns it, ticks and orders alike."""

    def __init__(
        self,
        substrate: Substrate,
        *,
        plan_of: PlanOf,
        verify: Verify,
        journal: Journal,
        wall: Callable[[], float],
        emit: Callable[[Entry], None] = lambda _: None,
        on_telemetry: Callable[[str, bytes], None] = lambda _, __: None,
    ) -> None:
        """Take a substrate into custody. What an earlier run of the cell left open is reported as the fault it is.

        Args:
            substrate: What moves.
            plan_of: Compiles a grant's watch and recovery plan.
            verify: Names the postconditions that do not hold: (postconditions, params, facts) → unmet.
            journal: Where everything is written before it counts.
            wall: Wall time, seconds since the epoch.
            emit: Told every entry of the journal, after it was written.
            on_telemetry: Told (invocation, packed rows) every `protocol.ROWS_PER_BATCH` ticks.
        """
        self.substrate = substrate
        self.journal = journal
        self.observation: Observation = substrate.observe()
        self.fault = ""
        self.holding = ""
        self._plan_of, self._verify, self._wall = plan_of, verify, wall
        self._emit, self._on_telemetry = emit, on_telemetry
        self._key: Ed25519PublicKey | None = None
        self._policy_digest = ""
        self._run: Run | None = None
        self._tick = 0
        self._signals = Signals()
        self._unsaid: list[tuple[telling.Saying, Params]] = []
        self._unpowered = False
        self.latched = bool(journal.marks.get("latched"))
        if self.latched:
            substrate.stop(0)
        left = journal.marks.get("open")
        if isinstance(left, str):
            self._say_safely(telling.outcome(left, Outcome.FAULT, "cell_restarted", self._tick), marks={"open": None})

    # -- what it is doing ----------------------------------------------------------------------------------------------

    @property
    def period_s(self) -> float:
        """Return the control period."""
        return self.substrate.period_s

    @property
    def invocation(self) -> str | None:
        """Return the invocation under way, if there is one."""
        return None if self._run is None else self._run.id

    @property
    def status(self) -> Status | None:
        """Return the status of the session under way."""
        return None if self._run is None else self._run.status

    def view(self) -> View:
        """Return what displays and the server want to know."""
        return View(
            self._tick,
            self.observation.time_s,
            self.invocation,
            self.status,
            self.latched,
            self.holding,
            self.fault,
            self._signals,
        )

    def standing(self) -> bool:
        """Say whether nothing moves and nothing is about to."""
        run = self._run
        return run is None or (run.rate == 0.0 and not run.moves() and run.next is None)

    # -- orders --------------------------------------------------------------------------------------------------------

    def adopt(self, *, policy_digest: str, key: Ed25519PublicKey) -> None:
        """Believe authorizations under this policy, signed with this key."""
        self._policy_digest, self._key = policy_digest, key

    def launch(self, signed: SignedAuthorization) -> str | None:
        """Verify a signed authorization and begin its session; return None, or the code of the refusal.

        A refusal is recorded; it uses the permit up only if the permit was good, so that it can never launch later.
        """
        try:
            grant = self._admit(signed)
        except PermitError as error:
            return self._refuse(error.invocation, error.code, error.detail)
        permit = grant.authorization
        if (why := self._not_now()) is not None:
            return self._refuse(permit.invocation, *why)
        used: dict[str, Json] = {USED + permit.id: permit.expires_at_s, "open": permit.invocation}
        try:
            self._say(telling.launch(permit, self._tick), marks=used)
            self.journal.sync()
        except JournalUnavailable as error:
            self.fault = str(error)
            return self._refuse(permit.invocation, "journal_unavailable", str(error))
        return self._begin(grant)

    def human(self, invocation: str, op: str, actor: str) -> str | None:
        """Do an operator's word on the session; return None, or the code of why it could not be done."""
        run = self._run
        if run is None or run.id != invocation:
            return "no_such_session"
        if isinstance(run.next, End):
            return "ending"
        try:
            deed = _OPS.get(op)
            refused = "unknown_op" if deed is None else deed(self, run)
        except JournalUnavailable as error:
            self.fault = refused = str(error)
            self._end_when_still(run, End(Outcome.FAULT, "journal_unavailable", 1))
        self._say_safely(telling.human(run.id, op, actor, refused, self._tick))
        return refused

    def estop(self, actor: str) -> None:
        """Stop by category 0, now, and stay stopped until reset. Needs nothing and waits for nothing."""
        self.substrate.stop(0)
        self.latched = self._unpowered = True
        self._say_safely(telling.cell("estop", actor, self._tick), marks={"latched": True})
        if (run := self._run) is not None:
            self._finish(run, End(Outcome.STOPPED, "estop"))

    def reset(self, actor: str) -> None:
        """Leave a latched stop. Moves nothing."""
        if not self.latched:
            return
        self._say_safely(telling.cell("reset", actor, self._tick), marks={"latched": None})
        self.latched = False

    def hold(self, reason: str) -> None:
        """Hold (category 2) and launch nothing until welcomed; a session that moved waits for a human from now on.

        A recovery under way is finished first: it is recorded, covered, and safer done than left half done.
        `shutdown` ends the session instead.
        """
        self.holding = reason
        run = self._run
        if run is None or isinstance(run.next, End):
            return
        if reason == "shutdown":
            self._end_when_still(run, End(Outcome.STOPPED, "shutdown", 1))
        elif run.status is Status.RECOVERING:
            run.hold_after_recovery = True
        else:
            self._escalate(run, reason)

    def welcomed(self) -> None:
        """The server is back. Nothing moves by that: what was held waits for a human."""
        self.holding = ""

    # -- launching -----------------------------------------------------------------------------------------------------

    def _admit(self, signed: SignedAuthorization) -> Grant:
        if self._key is None:
            raise PermitError("wrong_policy", "this cell has no policy and no key yet")
        return verify(
            signed,
            key=self._key,
            cell=self.substrate.id,
            policy_digest=self._policy_digest,
            now_s=self._wall(),
            used=self.journal.used_permits(),
        )

    def _not_now(self) -> tuple[str, str] | None:
        if self.latched:
            return "estop_latched", "an emergency stop is latched; valid: reset it first"
        if self.holding:
            return "holding", f"the cell holds (`{self.holding}`); valid: wait until the link is back"
        if self._run is not None:
            return "busy", f"the cell runs `{self._run.id}`"
        return None

    def _refuse(self, invocation: str | None, code: str, detail: str) -> str:
        self._say_safely(telling.launch_refused(invocation, code, detail, self._tick))
        return code

    def _begin(self, grant: Grant) -> str | None:
        permit = grant.authorization
        substrate = self.substrate
        try:
            plan, recovery = self._plan_of(grant)
            watcher = compile_watch(plan, substrate.period_s)
            if self._unpowered:
                substrate.reset()
                self._unpowered = False
            began = substrate.facts()
            skill = substrate.bind(grant, permit.capability, permit.params, careful=permit.mode is Mode.CAREFUL)
        except (SubstrateError, ValueError) as error:
            code = error.failure if isinstance(error, SubstrateError) else "no_plan"
            substrate.unbind()
            self._say_safely(
                telling.outcome(permit.invocation, Outcome.FAULT, code, self._tick, detail=str(error)),
                marks={"open": None},
            )
            return code
        self._run = Run(
            grant=grant,
            plan=plan,
            recovery=recovery,
            skill=skill,
            watcher=watcher,
            responses=Responses(watcher.rules, substrate.period_s),
            watching=watcher.begin(),
            previous=substrate.hold(),
            began=began,
            first_tick=self._tick,
        )
        self._say_safely(telling.status(permit.invocation, Status.RUNNING, None, "launched", self._tick))
        return None

    # -- the tick ------------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Do one control period."""
        self._tick += 1
        if self._unsaid and self._tick % UNSAID_EVERY == 0:
            self._say_unsaid()
        run = self._run
        if run is None:
            self.observation = self.substrate.step(self.substrate.hold())
            return
        try:
            self._govern(run)
        except JournalUnavailable as error:
            self.fault = str(error)
            self._end_when_still(run, End(Outcome.FAULT, "journal_unavailable", 1))

    def _govern(self, run: Run) -> None:
        rate = run.ramp(self.substrate.period_s)
        command, report = self._ask(run, rate)
        command, _ = clamp(command, run.previous, run.plan.bounds, self.observation.jacobian, self.substrate.period_s)
        self.observation = seen = self.substrate.step(command)
        run.previous = command
        run.watching, alerts = run.watcher.watch(
            run.watching, seen, report, command, run.rate, run.used.retries, len(run.unmet)
        )
        self._signals = signals = run.watching.signals
        run.rows += telling.row(seen, signals, report.progress, run.rate)
        run.row_count += 1
        if run.row_count >= telling.ROWS_PER_BATCH:
            self._send_rows(run)
        if alerts or run.responding is not NOTHING or run.speaking:
            self._answer(run, alerts)
        if run.next is not None:
            if run.still(seen):
                self._go_on(run, run.next)
        elif report.state is not SkillState.RUNNING and run.moves():
            self._conclude(run, report)

    def _ask(self, run: Run, rate: float) -> tuple[Command, SkillReport]:
        """Return the skill's command, or one that holds; a skill that breaks has failed."""
        if rate == 0.0:
            return hold(run.previous), run.skill.report()
        try:
            command, report = run.skill.act(self.observation, rate), run.skill.report()
        except SubstrateError as error:
            return hold(run.previous), SkillReport("failed", 0.0, SkillState.FAILED, error.failure)
        except Exception as error:  # noqa: BLE001  # whatever a skill does wrong must not take the watcher along
            self._say_safely(telling.cell("skill_error", "cell", self._tick, repr(error)))
            return hold(run.previous), SkillReport("failed", 0.0, SkillState.FAILED, "skill_error")
        phases = run.grant.authorization.confirm_before
        if phases and report.phase in phases and report.phase not in run.confirmed and not run.recovering:
            self._escalate(run, f"confirm:{report.phase}")
            run.rate = 0.0
            return hold(run.previous), report
        return command, report

    def _answer(self, run: Run, alerts: tuple[Alert, ...]) -> None:
        """Report what is new among the alerts and do what the declared responses ask for."""
        for alert in alerts:
            if alert.rule not in run.speaking:
                stale = run.watcher.measure.stale_sensors(self.observation)
                self._say(telling.alert(run.id, alert, stale, self._tick))
            run.speaking[alert.rule] = self._tick
        for rule in [rule for rule, last in run.speaking.items() if self._tick - last >= QUIET_TICKS]:
            del run.speaking[rule]
            self._say(telling.quiet(run.id, rule, self._tick))
        run.responding, decision = run.responses.intervene(run.responding, alerts, self._tick)
        if isinstance(run.next, End) or run.status is Status.ESCALATED:
            return
        if decision.ends_attempt and run.next is None:
            self._end_attempt(run, decision)
        elif decision.holding is not None:
            self._hold_for(run, decision.holding)
        elif decision.intervention is Intervention.CONTINUE and "watch" in run.paused_by:
            run.paused_by.discard("watch")
            self._resume(run, "clear")

    def _end_attempt(self, run: Run, decision: Decision) -> None:
        alert = decision.alert
        if alert is None:
            raise AssertionError("a decision to end the attempt names its alert")
        if decision.holding is not None or "operator" in run.paused_by:
            run.failed = alert  # first things first: whoever is in the way has to leave before anything recovers
            if decision.holding is not None:
                self._hold_for(run, decision.holding)
            return
        run.paused_by.discard("watch")
        self._say(telling.intervention(run.id, decision.intervention, alert, self._tick))
        if decision.intervention is Intervention.ROLLBACK:
            self._roll_back(run, alert.failure or alert.rule)
        elif alert.failure:
            self._fail(run, alert.failure, alert)
        else:
            self._end_when_still(run, End(Outcome.STOPPED, alert.rule, 1))

    def _hold_for(self, run: Run, decision: Decision) -> None:
        alert = decision.alert
        if alert is None:
            raise AssertionError("a decision to hold names its alert")
        if decision.intervention is Intervention.ESCALATE:
            self._say(telling.intervention(run.id, decision.intervention, alert, self._tick))
            self._escalate(run, alert.rule)
        elif "watch" not in run.paused_by:
            self._say(telling.intervention(run.id, decision.intervention, alert, self._tick))
            run.paused_by.add("watch")
            self._pause(run, alert.rule)

    # -- completion and failure ----------------------------------------------------------------------------------------

    def _conclude(self, run: Run, report: SkillReport) -> None:
        """Verify what a skill claims, or take its failure up."""
        if report.state is SkillState.FAILED:
            self._fail(run, report.failure or "skill_failed", None)
            return
        run.settling_ticks += 1
        if run.settling_ticks % VERIFY_EVERY:
            return
        unmet = self._unmet(run)
        if not unmet:
            self._verified(run)
        elif run.settling_ticks > SETTLE_TICKS + QUIET_TICKS:
            self._fail(run, "postcondition_failed", None)  # policy only warns about it; it is no success for that
        elif run.settling_ticks >= SETTLE_TICKS:
            run.unmet = unmet  # the watcher takes it from here

    def _unmet(self, run: Run) -> tuple[str, ...]:
        facts = self.substrate.facts()
        unmet = self._verify(run.plan.postconditions, run.plan.params, facts)
        if run.doing is Doing.ROLLBACK:
            unmet += not_restored(run.began, facts, run.grant.authorization.params)
        return unmet

    def _verified(self, run: Run) -> None:
        self._say(telling.completion(run.id, run.doing, run.plan, self._tick))
        match run.doing:
            case Doing.ATTEMPT:
                outcome = Outcome.RECOVERED if run.recoveries else Outcome.SUCCEEDED
                self._end_when_still(run, End(outcome, "verified"))
            case Doing.ROLLBACK:
                self._end_when_still(run, End(Outcome.ROLLED_BACK, "verified"))
            case Doing.RECOVERY:
                self._follow(run, self._choose(run, "recovery_incomplete", after=run.deciding), None)
            case never:
                assert_never(never)

    def _fail(self, run: Run, failure: str, alert: Alert | None) -> None:
        run.failed = None
        self._follow(run, self._choose(run, failure), alert)

    def _choose(self, run: Run, failure: str, after: RecoveryDecision | None = None) -> RecoveryDecision:
        return recover(
            failure,
            run.recovery,
            run.used,
            risk=None,
            can_ask=True,
            covered=run.grant.authorization.recoveries,
            after=after,
        )

    def _roll_back(self, run: Run, failure: str) -> str | None:
        decision = roll_back(failure, run.recovery, run.used, run.grant.authorization.recoveries)
        if decision is None:
            self._escalate(run, "rollback_unavailable")
            return "rollback_unavailable"
        self._follow(run, decision, None)
        return None

    def _follow(self, run: Run, decision: RecoveryDecision, alert: Alert | None) -> None:
        """Record a recovery decision on the disk, then prepare what it says."""
        run.used = decision.used
        run.deciding = decision
        run.brake(self.observation)
        self._say(telling.recovery(run.id, decision, run.unmet, self._tick))
        permit = run.grant.authorization
        match decision.strategy:
            case Strategy.TERMINATE:
                self._end_when_still(run, End(Outcome.TERMINATED, decision.failure))
                return
            case Strategy.ASK_HUMAN:
                run.failed = alert or Alert(Signal.VIOLATION, decision.failure, 1.0, 0.0, decision.failure)
                self._escalate(run, decision.failure)
                return
            case Strategy.RETRY | Strategy.SAFER_MODE:
                careful = decision.strategy is Strategy.SAFER_MODE or permit.mode is Mode.CAREFUL
                params = permit.params if decision.covered is None else decision.covered.params
                then = Bind(Doing.ATTEMPT, permit.capability, params, careful)
            case Strategy.RECOVERY_CAPABILITY | Strategy.ROLLBACK:
                doing = Doing.ROLLBACK if decision.strategy is Strategy.ROLLBACK else Doing.RECOVERY
                cover = decision.covered
                if cover is None:
                    raise AssertionError("a recovery that moves is covered")
                then = Bind(doing, cover.capability, cover.params, cover.mode is Mode.CAREFUL)
            case never:
                assert_never(never)
        self.journal.sync()
        run.recoveries += 1
        run.next = then
        self._become(run, Event.RECOVER, decision.strategy.value)

    # -- at standstill -------------------------------------------------------------------------------------------------

    def _go_on(self, run: Run, then: Bind | End) -> None:
        match then:
            case End():
                self._finish(run, then)
            case Bind():
                self._bind(run, then)
            case never:
                assert_never(never)

    def _bind(self, run: Run, then: Bind) -> None:
        run.next = None
        if run.hold_after_recovery and then.doing is Doing.ATTEMPT:
            run.hold_after_recovery = False
            run.next = None
            run.failed = Alert(Signal.VIOLATION, "link", 1.0, 0.0, "link_lost")
            self._escalate(run, "link")
            return
        cover = None if run.deciding is None else run.deciding.covered
        run.doing = then.doing
        try:
            plan, _ = self._plan_of(run.grant, None if then.doing is Doing.ATTEMPT else cover)
            run.skill = self.substrate.bind(run.grant, then.capability, then.params, careful=then.careful)
            run.watch_with(plan, self.substrate.period_s)
        except SubstrateError as error:
            self._fail(run, error.failure, None)
            return
        except ValueError as error:
            self._say(telling.cell("no_plan", "cell", self._tick, str(error)))
            self._end_when_still(run, End(Outcome.FAULT, "no_plan", 1))
            return
        run.previous = self.substrate.hold()
        run.responding = recovering(tuple(run.speaking), self._tick, self.substrate.period_s)
        run.settling_ticks, run.unmet, run.failed = 0, (), None
        if then.doing is Doing.ATTEMPT:
            self._become(run, Event.RECOVERED, "new_attempt")

    def _finish(self, run: Run, end: End) -> None:
        """Lock the actuators, then say how it ended."""
        if end.category is not None:
            self.substrate.stop(end.category)
            self._unpowered = True
        self.substrate.unbind()
        self._run = None
        self._send_rows(run)
        status = final_status(end.outcome)
        event = Event.COMPLETE if status is Status.COMPLETED else Event.FAIL
        if not accepts(run.status, event):  # a rollback or recovery that ends the session ends it from RECOVERING
            event = Event.FAIL
        before, run.status = run.status, step(run.status, event)
        self._say_safely(telling.status(run.id, run.status, before, end.code, self._tick))
        self._say_safely(
            telling.outcome(
                run.id,
                end.outcome,
                end.code,
                self._tick,
                ticks=self._tick - run.first_tick,
                recoveries=run.recoveries,
                retries=run.used.retries,
            ),
            marks={"open": None},
        )

    # -- moving between statuses ---------------------------------------------------------------------------------------

    def _become(self, run: Run, event: Event, reason: str) -> None:
        before, run.status = run.status, step(run.status, event)
        if run.status is not before:
            self._say_safely(telling.status(run.id, run.status, before, reason, self._tick))

    def _pause(self, run: Run, reason: str) -> None:
        run.brake(self.observation)
        self._become(run, Event.PAUSE, reason)

    def _escalate(self, run: Run, reason: str) -> None:
        run.brake(self.observation)
        run.escalated_by = reason
        self._become(run, Event.ESCALATE, reason)
        self._say_safely(telling.escalation(run.id, reason, run.failed, self._tick))

    def _resume(self, run: Run, reason: str) -> None:
        """Go on once nothing holds any more; what failed in the meantime is recovered first."""
        if run.paused_by or run.status is not Status.PAUSED:
            return
        self._become(run, Event.RESUME_RECOVERY if run.recovering else Event.RESUME, reason)

    def _end_when_still(self, run: Run, end: End) -> None:
        if not isinstance(run.next, End):
            run.brake(self.observation)
        run.next = end

    # -- what operators may say ----------------------------------------------------------------------------------------

    def _op_pause(self, run: Run) -> str | None:
        run.paused_by.add("operator")
        self._pause(run, "operator")
        return None

    def _op_resume(self, run: Run) -> str | None:
        if run.status is Status.ESCALATED:
            return self._op_continue(run)
        if run.status is not Status.PAUSED:
            return "not_paused"
        run.paused_by.clear()
        run.responding = released(run.responding)
        self._resume(run, "operator")
        return None

    def _op_continue(self, run: Run) -> str | None:
        """A human lets an escalated session go on: where it was held, or with a new attempt where one had failed."""
        if run.status is not Status.ESCALATED:
            return "not_escalated"
        if self.holding:
            return "holding"
        run.paused_by.clear()
        run.responding = released(run.responding)
        if run.escalated_by.startswith("confirm:"):
            run.confirmed.add(run.escalated_by.removeprefix("confirm:"))
        failed, run.failed, run.escalated_by = run.failed, None, ""
        if failed is None:
            self._become(run, Event.CONTINUE_RECOVERY if run.recovering else Event.CONTINUE, "operator")
            return None
        permit = run.grant.authorization
        self._say(telling.asked_again(run.id, failed, self._tick))
        self.journal.sync()
        run.recoveries += 1
        run.deciding = None
        run.next = Bind(Doing.ATTEMPT, permit.capability, permit.params, permit.mode is Mode.CAREFUL)
        self._become(run, Event.RECOVER, "operator")
        return None

    def _op_confirm(self, run: Run) -> str | None:
        return self._op_continue(run) if run.escalated_by.startswith("confirm:") else "nothing_to_confirm"

    def _op_stop(self, run: Run) -> str | None:
        self._end_when_still(run, End(Outcome.STOPPED, "operator", 1))
        return None

    def _op_cancel(self, run: Run) -> str | None:
        self._end_when_still(run, End(Outcome.CANCELLED, "cancelled"))
        return None

    def _op_terminate(self, run: Run) -> str | None:
        self._end_when_still(run, End(Outcome.TERMINATED, "operator"))
        return None

    def _op_rollback(self, run: Run) -> str | None:
        if self.holding:
            return "holding"
        run.paused_by.clear()
        return self._roll_back(run, "operator")

    # -- recording -----------------------------------------------------------------------------------------------------

    def _say(self, saying: telling.Saying, marks: Params = EMPTY) -> None:
        """Write one entry. Raises `JournalUnavailable`."""
        entry = self.journal.append(at_s=self._wall(), marks=marks, **saying._asdict())
        self._emit(entry)

    def _say_safely(self, saying: telling.Saying, marks: Params = EMPTY) -> None:
        """Write one entry, or keep it until that is possible: for what restrains, and for what has happened anyway."""
        try:
            self._say(saying, marks)
        except JournalUnavailable as error:
            self.fault = str(error)
            self._unsaid.append((saying, marks))
            if (run := self._run) is not None and not isinstance(run.next, End):
                self._end_when_still(run, End(Outcome.FAULT, "journal_unavailable", 1))

    def _say_unsaid(self) -> None:
        """Record what could not be recorded when it happened."""
        try:
            while self._unsaid:
                self._say(*self._unsaid[0])
                self._unsaid.pop(0)
            self.journal.sync()
            self.fault = ""
        except JournalUnavailable as error:
            self.fault = str(error)

    def _send_rows(self, run: Run) -> None:
        if run.rows:
            self._on_telemetry(run.id, bytes(run.rows))
            run.rows.clear()
            run.row_count = 0


_OPS: Final[dict[str, Callable[[Runner, Run], str | None]]] = {
    "pause": Runner._op_pause,
    "resume": Runner._op_resume,
    "stop": Runner._op_stop,
    "rollback": Runner._op_rollback,
    "cancel": Runner._op_cancel,
    "confirm": Runner._op_confirm,
    "resolve_continue": Runner._op_continue,
    "resolve_terminate": Runner._op_terminate,
}


def run_session(
    runner: Runner, signed: SignedAuthorization, max_ticks: int = 60_000
) -> tuple[Outcome | None, tuple[Entry, ...]]:
    """Launch and tick until the session has ended; for tests and evaluation, no server needed.

    Returns:
        The outcome (None if it was refused, or not over after `max_ticks`), and the entries of the session in order.
    """
    first = runner.journal.last_seq
    if runner.launch(signed) is None:
        for _ in range(max_ticks):
            runner.tick()
            if runner.invocation is None:
                break
    told = runner.journal.unacknowledged(first)
    ends = [entry.body["outcome"] for entry in told if entry.kind == EventKind.OUTCOME]
    return (Outcome(str(ends[-1])) if ends else None), told
