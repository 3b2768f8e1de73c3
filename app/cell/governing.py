"""One governed session, from the first tick after its launch to its outcome.

A failure goes the same way whatever found it (a watch rule, the skill, a postcondition): hold, ask `recover`, write the
decision to the journal, come to rest, have it on the disk, and only then bind what it names. What restrains acts first
and records afterwards; everything else records first. Nothing waits for a disk while anything moves: meanwhile nobody
would tick, and the last command would stay in force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

from app.cell import telling
from app.cell.journal import JournalUnavailable
from app.cell.restored import not_restored, seen_since
from app.cell.run import LINK, Bind, Doing, End, Run, Unprepared
from app.cell.substrate import SubstrateError
from app.governance.clamp import clamp, hold
from app.governance.intervention import CONTACT, NOTHING, Decision, recovering
from app.governance.model import Alert, Intervention, Mode, Outcome, SkillReport, SkillState, Status, Strategy
from app.governance.recovery import RecoveryDecision, lead_back, recover, roll_back
from app.governance.session import Event, final_status, step

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.cell.recorder import Recorder
    from app.cell.substrate import Skill, Substrate
    from app.governance.intervention import Engaged
    from app.governance.model import (
        Command,
        CoveredRecovery,
        Observation,
        Params,
        RecoveryPlan,
        WatchPlan,
        WorldFacts,
    )
    from app.governance.permit import Grant

Verify: TypeAlias = "Callable[[tuple[str, ...], Params, WorldFacts], tuple[str, ...]]"

SETTLE_TICKS: Final = 50
VERIFY_EVERY: Final = 5
QUIET_TICKS: Final = 50
AWAY: Final = frozenset({"base_pose", "object_pose"})
"""What a rollback may leave open that driving back can set right: from elsewhere an object may be out of sight."""
OVERSPEED: Final = "overspeed"
UNDONE_BADLY: Final = "rollback_failed"
UNBELIEVED: Final = frozenset({"implausible", "sensor_age_ms"})
"""Signals of what the sensors are worth: nothing follows readings that are held against them."""
HELD: Final = {Status.PAUSED: Event.RESUME_RECOVERY, Status.ESCALATED: Event.CONTINUE_RECOVERY}
"""How a rollback that is held goes on."""
OPERATOR: Final = "operator"
EXPIRED: Final = "expired"
"""Why a session ends, or is undone: an operator said so, or nobody answered in time."""
STOP: Final = End(Outcome.STOPPED, OPERATOR, 1)
RUNNING: Final = SkillState.RUNNING
FAILED: Final = SkillState.FAILED


class NotHeldError(Exception):
    """An arm that is held moves all the same: what stops by its drives alone does not stop it."""

    def __init__(self) -> None:
        """Say so."""
        super().__init__("the arm moved while it was held")


class PlanOf(Protocol):
    """Compiles what a grant is watched by, from the policy the cell holds; for a recovery it covers, what that is."""

    def __call__(self, grant: Grant, recovery: CoveredRecovery | None = None) -> tuple[WatchPlan, RecoveryPlan]:
        """Return the plans. Raises `ValueError` where policy does not know what the grant names."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Ports:
    """What a session works with: the substrate, the policy's answers, the record, and where telemetry goes."""

    substrate: Substrate
    plan_of: PlanOf
    verify: Verify
    recorder: Recorder
    on_telemetry: Callable[[str, bytes], None]


class Governing:
    """Governs one run. `over` holds how it ended once it has."""

    __slots__ = ("_ports", "_recorder", "_substrate", "_tell", "_tell_anyway", "hand", "over", "run", "seen")

    def __init__(self, ports: Ports, run: Run, seen: Observation) -> None:
        """Take a bound run over."""
        self._ports, self._substrate = ports, ports.substrate
        self._recorder = ports.recorder
        self._tell, self._tell_anyway = ports.recorder.say, ports.recorder.say_anyway
        self.run = run
        self.seen = seen
        self.over: End | None = None
        self.hand = telling.NO_HAND  # what a human at the controls asks for in this tick, as its row holds it

    # -- the tick ------------------------------------------------------------------------------------------------------

    def tick(self) -> Observation:
        """Do one control period and return what the sensors saw."""
        run, substrate = self.run, self._substrate
        period_s = substrate.period_s
        rate = run.ramp(period_s)
        if not run.moves():
            self._require_held()
        if rate == 0.0:  # not asked to move
            report, command = self._last_report(), run.held()
        else:
            command, report = self._asked(rate)
        if run.given is not None:
            command = run.yielding(command, self.seen)
        command, _ = clamp(command, run.previous, run.bounds, self.seen.jacobian, period_s)
        self.seen = seen = substrate.step(command)
        run.sent(command, seen)
        run.report, rate = report, run.rate
        watching, alerts = run.watcher.watch(
            run.watching, seen, report, command, rate, run.used.retries, len(run.unmet)
        )
        run.watching, series = watching, run.series
        _, progress, state, _ = report
        row = telling.row(seen, watching.measured, progress, rate, run.plan.base_radius_m) + self.hand
        series.add(row, alerted=bool(alerts))
        if len(series.ready) >= telling.BATCH_BYTES:
            self._send_rows()
        answering = alerts or run.speaking or run.responding is not NOTHING
        if answering or run.next is not None or state is not RUNNING or self._recorder.fault:
            try:
                self._consider(alerts, report)
            except JournalUnavailable:
                self._end_unrecorded()
        return seen

    def _asked(self, rate: float) -> tuple[Command, SkillReport]:
        """Return what the skill wants, and what it says."""
        run = self.run
        try:
            command, report = run.skill.act(self.seen, rate), run.skill.report()
        except Exception as error:  # whatever a skill does wrong must not take the watcher along
            return hold(run.previous), self._failed(error)
        if run.given is not None or run.apart is not None:
            command = run.led_back(command, self._substrate.period_s)
        if run.confirms and run.waits_for_confirmation(report.phase):
            command = self._wait_before(report.phase)
        return command, report

    def _require_held(self) -> None:
        """See that an arm which is to stand slows down, and stays where it stands.

        Raises:
            NotHeldError: it moves away, and its readings can be believed.
        """
        if self.run.strays(self.seen) and not self._doubted():
            raise NotHeldError

    def _wait_before(self, phase: str) -> Command:
        """Hold before a phase that a human has to confirm; a session that comes to rest asks once it is let go on."""
        run = self.run
        run.rate = 0.0
        if run.moves():
            self.escalate(f"confirm:{phase}")
        return hold(run.previous)

    def _end_unrecorded(self) -> None:
        """Come to rest and end, although a rule has more to say in every tick than can be written down."""
        self.end(End(Outcome.FAULT, "journal_unavailable", 1))
        if self.run.next is not None:
            self._go_on(self.run.next)

    def _last_report(self) -> SkillReport:
        """Return what a skill says that is not asked to move; one that breaks then fails once it is."""
        try:
            return self.run.skill.report()
        except Exception:  # it is told when the skill is asked again: nothing comes of it while everything stands
            return self.run.report

    def _failed(self, error: Exception) -> SkillReport:
        """Return what a skill that broke would have had to say."""
        if isinstance(error, SubstrateError):
            return SkillReport("failed", 0.0, FAILED, error.failure)
        self._tell_anyway(telling.cell("skill_error", telling.CELL, repr(error)))
        return SkillReport("failed", 0.0, FAILED, "skill_error")

    def _consider(self, alerts: tuple[Alert, ...], report: SkillReport) -> None:
        """Do what follows from the tick: nothing does while the skill runs, no rule speaks and nothing waits."""
        run = self.run
        if alerts or run.speaking or run.responding is not NOTHING:
            self._answer(alerts)
            if not run.moves():
                self._yield_to(alerts)
        if self._recorder.fault and not isinstance(run.next, End):
            self.end(End(Outcome.FAULT, "journal_unavailable", 1))
        if run.next is not None:
            self._go_on(run.next)
        elif report.state is not RUNNING and run.moves():
            self._conclude(report)

    def _yield_to(self, alerts: tuple[Alert, ...]) -> None:
        """Have an arm that stands give way to what it presses on, where its readings say so and can be believed."""
        run = self.run
        if self._doubted():
            run.giving_ticks = 0
        elif any(run.watcher.signal_of(alert.rule) in CONTACT for alert in alerts):
            run.give_way()

    def _doubted(self) -> bool:
        """Say whether readings are held against their sensors."""
        run = self.run
        if run.watching.signals.implausible > 0.0:  # before its rule speaks, which may wait for a second tick
            return True
        held_against = (*run.speaking, *(one.rule for one in run.responding.engaged))
        return any(run.watcher.signal_of(rule) in UNBELIEVED for rule in held_against)

    # -- what the watcher says -----------------------------------------------------------------------------------------

    def _answer(self, alerts: tuple[Alert, ...]) -> None:
        """Do what the declared responses ask for."""
        run = self.run
        self._report(alerts)
        run.responding, decision = run.responses.intervene(run.responding, alerts, self._ports.recorder.tick)
        if isinstance(run.next, End) or run.status is Status.ESCALATED:
            return
        alert = decision.alert
        if alert is None or decision.intervention is Intervention.CONTINUE:
            self._clear()
        elif decision.intervention is Intervention.STOP and not alert.failure:
            self._tell(telling.intervention(run.id, decision.intervention, alert))
            self.end(End(Outcome.STOPPED, alert.rule, 1))
        else:
            self._respond(decision, alert)

    def _respond(self, decision: Decision, alert: Alert) -> None:
        """Hold as long as that is asked for, else end the attempt and recover."""
        if decision.holding is not None:
            self._hold_for(decision.holding)  # whoever is in the way has to leave before anything recovers
        elif self.run.next is not None and not (decision.gave_up and "watch" in self.run.paused_by):
            self._clear()  # what held the recovery is gone; what the recovery is for may speak on
        elif "operator" not in self.run.paused_by:
            self._end_attempt(decision.intervention, alert)

    def _report(self, alerts: tuple[Alert, ...]) -> None:
        """Say which rules began to be violated, and which have been quiet for a while."""
        run, tick = self.run, self._ports.recorder.tick
        for alert in alerts:
            if run.watcher.signal_of(alert.rule) == "grip_force_n":
                run.ease_grip(alert.value, tick)
            if alert.rule not in run.speaking:
                self._tell(telling.alert(run.id, alert, run.watcher.stale_sensors(self.seen)))
            run.speaking[alert.rule] = tick
        for rule in [rule for rule, last in run.speaking.items() if tick - last >= QUIET_TICKS]:
            del run.speaking[rule]
            self._tell(telling.quiet(run.id, rule))

    def _clear(self) -> None:
        if "watch" in self.run.paused_by:
            self.run.paused_by.discard("watch")
            self._resume("clear")

    def _hold_for(self, decision: Decision) -> None:
        run, alert = self.run, decision.alert
        if alert is None:
            raise AssertionError("a decision to hold names its alert")
        if decision.intervention is Intervention.ESCALATE:
            self._tell_anyway(telling.intervention(run.id, decision.intervention, alert))
            self._ask_human(alert.rule)
        elif "watch" not in run.paused_by:
            run.paused_by.add("watch")
            run.brake(self.seen)
            self._tell_anyway(telling.intervention(run.id, decision.intervention, alert))
            self._become(Event.PAUSE, alert.rule)

    def _end_attempt(self, intervention: Intervention, alert: Alert) -> None:
        run = self.run
        run.paused_by.discard("watch")
        self._tell_anyway(telling.intervention(run.id, intervention, alert))
        if intervention is Intervention.ROLLBACK:
            if (unavailable := self._roll_back(alert.failure or alert.rule)) is not None:
                self._ask_human(unavailable)
        else:
            self._follow(self._choose(alert.failure))

    # -- completion and failure ----------------------------------------------------------------------------------------

    def _conclude(self, report: SkillReport) -> None:
        """Verify what a skill claims, or take its failure up."""
        run = self.run
        if report.state is FAILED:
            self._follow(self._choose(report.failure or "skill_failed"))
            return
        run.settling_ticks += 1
        if run.settling_ticks % VERIFY_EVERY:
            return
        unmet = self._unmet()
        if not unmet:
            self._verified()
        elif run.doing is Doing.ROLLBACK and AWAY.issuperset(unmet) and self._lead_back(unmet):
            pass  # settles again, and is verified, once it is back
        elif run.settling_ticks > SETTLE_TICKS + QUIET_TICKS:
            self._follow(self._choose("postcondition_failed"))  # policy only warns of it; that makes it no success
        elif run.settling_ticks >= SETTLE_TICKS:
            run.unmet = unmet  # the watcher takes it from here

    def _unmet(self) -> tuple[str, ...]:
        run, facts = self.run, self._substrate.facts()
        params = run.plan.params
        if run.began.holding is not None:  # what was carried in is what has to be found, not just any object
            params = {"object_id": run.began.holding, **params}
        unmet = self._ports.verify(run.plan.postconditions, params, seen_since(facts, run.began.stamp_s))
        if run.doing is Doing.ROLLBACK:
            unmet += not_restored(run.began, facts, run.grant.authorization.params)
        return unmet

    def _verified(self) -> None:
        run = self.run
        self._tell(telling.completion(run.id, run.doing.value, run.plan))
        if run.doing is Doing.ATTEMPT:
            self.end(End(Outcome.RECOVERED if run.recoveries else Outcome.SUCCEEDED, "verified"))
        elif run.doing is Doing.ROLLBACK:
            self.end(End(Outcome.ROLLED_BACK, "verified"))
        else:
            self._follow(self._choose(self._recovered(), after=run.deciding))

    def _choose(self, failure: str, after: RecoveryDecision | None = None) -> RecoveryDecision:
        run = self.run
        covered = run.grant.authorization.recoveries
        if run.doing is Doing.ROLLBACK:
            failure = UNDONE_BADLY
        elif run.doing is Doing.RECOVERY and failure == "postcondition_failed":
            failure = "recovery_failed"
        # Undoing that fails is a failure of its own: nothing may make a new attempt of it, or of what recovers from it.
        failed_in = failure == UNDONE_BADLY or (run.doing is Doing.RECOVERY and after is None)
        found = recover(failure, run.recovery, run.used, covered=covered, after=after, recovering=failed_in)
        if found.strategy is Strategy.ASK_HUMAN and isinstance(run.skill, Unprepared) and failure == run.asked:
            return found._replace(strategy=Strategy.TERMINATE, reason="unprepared")  # they would be asked without end
        return found

    def _roll_back(self, failure: str) -> str | None:
        run = self.run
        decision = roll_back(failure, run.recovery, run.used, run.grant.authorization.recoveries)
        if decision is None:
            return "rollback_unavailable"
        self._follow(decision)
        run.failed = ""  # this answers it, and what holds the session from here on holds the rollback
        return None

    def _lead_back(self, unmet: tuple[str, ...]) -> bool:
        """Bring the base back, with nothing else left to undo, to where the session began; say whether it can be."""
        run = self.run
        if "base_pose" not in unmet:
            return False
        decision = lead_back(self._recovered(), run.recovery, run.used, run.grant.authorization.recoveries)
        if decision is not None:
            run.unmet = unmet  # for the record; it is not for the watcher to judge before it is done
            self._follow(decision)
            run.unmet = ()
        return decision is not None

    def _recovered(self) -> str:
        return self._decided() or "recovery_incomplete"

    def _decided(self) -> str:
        """Return the failure that what is tried was decided for; empty where nothing had failed."""
        return "" if self.run.deciding is None else self.run.deciding.failure

    def _follow(self, decision: RecoveryDecision) -> None:
        """Hold, record the decision, and prepare what it says for when everything stands still."""
        run = self.run
        run.used, run.deciding = decision.used, decision
        run.brake(self.seen)
        self._tell(telling.recovery(run.id, decision, run.unmet))
        if decision.strategy is Strategy.TERMINATE:
            self.end(End(Outcome.TERMINATED, decision.failure))
        elif decision.strategy is Strategy.ASK_HUMAN:
            run.failed = decision.failure
            self.escalate(decision.failure)
        else:
            self._prepare(_bound(decision), decision.strategy.value)

    def _prepare(self, then: Bind, reason: str) -> None:
        self.run.recoveries += 1
        self.run.next, self.run.answered = then, frozenset(self.run.speaking)
        self.run.decided_tick = self._ports.recorder.tick
        self._become(Event.RECOVER, reason)

    # -- at standstill -------------------------------------------------------------------------------------------------

    def _go_on(self, then: Bind | End) -> None:
        """Do what was waiting for standstill; a recovery also waits for whatever else holds the session.

        And for whoever is too near, even where policy says to end the attempt for that rather than to hold.
        """
        run = self.run
        if not run.still(self.seen):
            return
        if isinstance(then, End):
            self.finish(then)
        elif run.status is Status.RECOVERING and not run.responses.keeps_off(run.speaking):
            run.next = None
            if run.hold_after_recovery and then.doing is Doing.ATTEMPT:
                reason, run.hold_after_recovery = run.hold_after_recovery, ""
                run.failed = "link_lost" if reason == LINK else self._recovered()
                self.escalate(reason)
            else:
                self._recorder.sync()
                self._bind(then)

    def _bind(self, then: Bind) -> None:
        run, substrate = self.run, self._substrate
        try:
            plan, _ = self._ports.plan_of(run.grant, then.cover)
            run.skill = self._prepared(then)
            run.watch_with(plan, substrate.period_s)
        except ValueError as error:
            self._tell(telling.cell("no_plan", telling.CELL, str(error)))
            self.end(End(Outcome.FAULT, "no_plan", 1))
            return
        run.bound(then.doing, substrate.hold())
        run.responding = recovering(run.spared, self._ports.recorder.tick, substrate.period_s, self._kept())
        run.settling_ticks, run.unmet, run.failed = 0, (), ""
        run.asked = run.asked if isinstance(run.skill, Unprepared) else ""
        run.begin_anew()
        if then.doing is Doing.ATTEMPT:
            self._become(Event.RECOVERED, "new_attempt")

    def _kept(self) -> tuple[Engaged, ...]:
        """Return the responses that go on whatever is bound: what is borne, and contacts that nothing has answered."""
        responses, responding = self.run.responses, self.run.responding
        return responses.borne(responding) + responses.met(responding, self._decided(), self.run.decided_tick)

    def _prepared(self, then: Bind) -> Skill:
        """Bind what comes next; what cannot begin fails as what it was to be, and so decides what may follow."""
        run, what = self.run, then.cover or self.run.grant.authorization
        try:
            return self._substrate.bind(run.grant, what.capability, what.params, careful=then.careful)
        except SubstrateError as error:
            self._tell_anyway(telling.cell("unprepared", telling.CELL, str(error)))
            return Unprepared(error.failure, self._substrate.hold())

    def end(self, end: End) -> None:
        """Come to rest, then end; an end that is under way already is replaced by a stricter one alone."""
        run = self.run
        if not isinstance(run.next, End):
            run.brake(self.seen)
            run.next = end
        elif run.next.yields_to(end):  # it brakes already, and is to come to rest no later
            run.next = end

    def finish(self, end: End) -> None:
        """Lock the actuators, then say how it ended."""
        run = self.run
        if end.category is not None:
            self._substrate.stop(end.category)
        self._substrate.unbind()
        self.over = end
        run.series.close()
        self._send_rows()
        completed = final_status(end.outcome) is Status.COMPLETED
        self._become(Event.COMPLETE if completed else Event.FAIL, end.code)
        self._tell_anyway(
            telling.outcome(
                run.id,
                end.outcome,
                end.code,
                ticks=self._ports.recorder.tick - run.first_tick,
                recoveries=run.recoveries,
                retries=run.used.retries,
                failure=(run.failed or (run.deciding.failure if run.deciding else "")) or None,
                **({"facts": telling.facing(self._substrate.facts())} if end.outcome is Outcome.TAKEN_OVER else {}),
            ),
            marks={"open": None},
        )

    # -- moving between statuses ---------------------------------------------------------------------------------------

    def _become(self, event: Event, reason: str) -> None:
        run = self.run
        before, run.status = run.status, step(run.status, event)
        if run.status is not before:
            self._tell_anyway(telling.status(run.id, run.status, before, reason))

    def _ask_human(self, reason: str) -> None:
        """Escalate; where authority leaves nobody to ask, waiting would be for ever: come to rest and end."""
        if self.run.recovery.can_ask:
            self.escalate(reason)
        else:
            self.end(End(Outcome.TERMINATED, reason, 1))

    def escalate(self, reason: str) -> None:
        """Hold and wait for a human."""
        run = self.run
        run.brake(self.seen)
        run.escalated(reason)
        self._become(Event.ESCALATE, reason)
        self._tell_anyway(telling.escalation(run.id, reason, run.failed, paused="operator" in run.paused_by))

    def _resume(self, reason: str) -> None:
        run = self.run
        if not run.paused_by and run.status is Status.PAUSED:
            self._become(Event.RESUME_RECOVERY if run.recovering else Event.RESUME, reason)

    def _send_rows(self) -> None:
        run = self.run
        if run.series.ready:
            self._ports.on_telemetry(run.id, bytes(run.series.ready))
            run.series.ready.clear()

    # -- what operators may say ----------------------------------------------------------------------------------------

    def pause(self) -> str | None:
        """Hold until an operator resumes."""
        self.run.paused_by.add("operator")
        self.run.brake(self.seen)
        self._become(Event.PAUSE, "operator")
        return None

    def resume(self) -> str | None:
        """Let a paused session go on; what is still violated pauses it again at once.

        One that asks has to be answered: whoever resumes may not know what it asks.
        """
        run = self.run
        if run.status is not Status.PAUSED:
            return "not_paused"
        run.paused_by.clear()
        run.let_go()
        self._resume("operator")
        return None

    def go_on(self) -> str | None:
        """Let an escalated session go on: where it was held, or with a new attempt where one had failed."""
        run = self.run
        if run.status is not Status.ESCALATED:
            return "not_escalated"
        permit, failed = run.grant.authorization, run.failed
        if failed:
            self._tell(telling.asked_again(run.id, failed))
        run.deciding, run.failed, run.asked = None, "", failed
        run.confirm()
        run.paused_by.clear()
        run.hold_after_recovery = ""
        run.let_go()
        if failed:
            self._prepare(Bind(Doing.ATTEMPT, permit.mode is Mode.CAREFUL), "operator")
        else:
            self._become(Event.CONTINUE_RECOVERY if run.recovering else Event.CONTINUE, "operator")
        return None

    def go_on_after_recovery(self) -> str | None:
        """Let a session go on once its recovery has ended: whoever was asked after the link was lost has answered."""
        run = self.run
        run.hold_after_recovery = ""
        self._tell_anyway(telling.status(run.id, run.status, run.status, "operator"))
        return None

    def confirm(self) -> str | None:
        """Let the phase begin that waits for a confirmation."""
        return self.go_on() if self.run.unconfirmed else "nothing_to_confirm"

    def stop(self) -> str | None:
        """Stop by category 1 and end."""
        self.end(STOP)
        return None

    def cancel(self) -> str | None:
        """Come to rest and end: the work is not wanted any more."""
        self.end(End(Outcome.CANCELLED, "cancelled"))
        return None

    def terminate(self, code: str = OPERATOR) -> str | None:
        """Come to rest and end: a human decided so, or nobody did in time."""
        self.end(End(Outcome.TERMINATED, code))
        return None

    def roll_back(self, code: str = OPERATOR) -> str | None:
        """Undo what the session did, by the rollback its authorization covers; one under way is only carried on."""
        run = self.run
        if run.undoing:
            return self._carry_on()
        if run.used.rolled_back and run.status is Status.RECOVERING:
            return "rollback_unavailable"  # what became of that is being mended, and waits for no answer
        run.paused_by.clear()
        run.release()
        unavailable = self._roll_back(code)
        if unavailable is not None:
            self.escalate(unavailable)  # whoever asked for it is there to decide
        return unavailable

    def _carry_on(self) -> str | None:
        """Let a rollback go on that is held; nothing becomes of the word where it moves already."""
        run = self.run
        if run.status not in HELD:
            return None
        run.paused_by.clear()
        run.let_go()
        self._become(HELD[run.status], "operator")
        return None


def _bound(decision: RecoveryDecision) -> Bind:
    cover = decision.covered
    if cover is None:
        raise AssertionError("a recovery that moves is covered")
    careful = cover.mode is Mode.CAREFUL
    match decision.strategy:
        case Strategy.SAFER_MODE:
            return Bind(Doing.ATTEMPT, True, cover)
        case Strategy.RETRY:
            return Bind(Doing.ATTEMPT, careful, cover)
        case Strategy.ROLLBACK:
            # Whatever moves faster than it is told would do so on the way back as well.
            return Bind(Doing.ROLLBACK, careful or decision.failure == OVERSPEED, cover)
        case _:
            return Bind(Doing.RECOVERY, careful, cover)
