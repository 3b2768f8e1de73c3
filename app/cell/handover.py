"""A session that a human may take into their own hands, and give back.

The human drives under an authorization of their own, for the same invocation, and is watched as any skill: the same
clamp, the same rules but those about how a plan gets on. A violation stops the motion and says why; nothing recovers by
itself while a hand is on the controls, and nobody is asked but the one who drives.

What the session was doing is over with the takeover. It goes on only under a new authorization, which says that the
plan was admitted and checked again from where the robot is now, and is bound anew, at standstill. Where that cannot be
had the human keeps the controls. Whoever lets go without a word leaves a session that waits, escalated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from app.cell import telling
from app.cell.governing import OPERATOR, Governing
from app.cell.journal import JournalUnavailable
from app.cell.run import Bind, Doing, End
from app.cell.steering import NOTHING, Steering, asks
from app.cell.substrate import Steered, SubstrateError
from app.governance import intervention
from app.governance.control import TAKEOVER
from app.governance.intervention import leaving, recovering
from app.governance.model import Intervention, Mode, Outcome, Status
from app.governance.recovery import retracing, roll_back
from app.governance.session import Event

if TYPE_CHECKING:
    from app.cell.governing import Ports
    from app.cell.run import Run
    from app.governance.intervention import Decision
    from app.governance.model import Alert, Observation, SkillReport, WatchPlan, Wish
    from app.governance.permit import Grant

TAKEN_OVER: Final = "taken_over"
HANDED_BACK: Final = "handed_back"
COMING_TO_REST: Final = "coming_to_rest"


_govern: Final = Governing.tick


class Session(Governing):
    """Governs one run, in the skill's hands or in a human's."""

    __slots__ = ("_displaced", "_foreign", "_handing", "steering")

    def __init__(self, ports: Ports, run: Run, seen: Observation) -> None:
        """Take a bound run over."""
        super().__init__(ports, run, seen)
        self.steering: Steering | None = None
        self._handing: Grant | None = None
        self._displaced = False  # what it was authorized for was taken out of its hands, and is not bound again
        self._foreign = False  # what is bound is bound under another grant than the session's
        if run.doing is Doing.TAKEOVER:
            self._displaced = True
            self.steering = self._steering(run.grant, run.plan, alone=True)
            run.series.keep_every_tick()

    # -- changing hands ------------------------------------------------------------------------------------------------

    def why_not(self, grant: Grant) -> tuple[str, str] | None:
        """Say why an authorization cannot change whose hands this session is in: a code and what would be valid."""
        permit, run = grant.authorization, self.run
        if isinstance(run.next, End):
            return "ending", "the session is coming to its end"
        if permit.capability == TAKEOVER:
            taken = self.steering is not None
            return ("busy", "a human has the controls already; valid: a new lease") if taken else None
        if permit.capability != run.grant.authorization.capability:
            return "busy", f"the cell runs `{run.id}`"
        if not self._displaced or run.status is Status.RECOVERING:
            return "busy", f"`{run.id}` runs already; valid: once a human has taken over and let go"
        return None

    def take_over(self, grant: Grant) -> str | None:
        """Come to rest, then give the controls to a human; return None, or the code of why that cannot be."""
        run = self.run
        try:
            plan, _ = self._ports.plan_of(grant)
        except ValueError as error:
            self._tell_anyway(telling.cell("no_plan", telling.CELL, str(error)))
            return "no_plan"
        self.steering, self._handing, self._displaced = self._steering(grant, plan, alone=False), None, True
        if run.undoing:
            run.used = run.used.giving_up()
        run.recovery = retracing(run.recovery, run.grant.authorization.recoveries)
        run.brake(self.seen)
        run.next = Bind(Doing.TAKEOVER, careful=False)
        run.deciding, run.failed, run.escalated_by, run.hold_after_recovery = None, "", "", ""
        run.paused_by.clear()
        self._become(Event.TAKE_OVER, TAKEN_OVER)
        return None

    def hand_back(self, grant: Grant) -> None:
        """Come to rest, then bind the session's capability anew, under an authorization that was made for that."""
        if self.steering is not None:
            self.steering.rest()
        run = self.run
        self._handing = grant
        run.brake(self.seen)
        run.paused_by.clear()
        self._prepare(Bind(Doing.ATTEMPT, grant.authorization.mode is Mode.CAREFUL), HANDED_BACK)

    def let_go(self) -> str | None:
        """Do as if the human had left: a controlled stop, then the session waits for somebody else's word.

        A way back that is under way ends as well: whoever is let go of may have ordered it before.
        """
        if self.steering is None and self._handing is None:
            return "not_taken_over"
        self.escalate("control_lapsed")
        return None

    def end_takeover(self) -> str | None:
        """Come to rest and end: the human has done what was to be done, or undone it."""
        if not self._displaced:
            return "not_taken_over"
        self.end(End(Outcome.TAKEN_OVER, "operator"))
        return None

    # -- the hand on the controls --------------------------------------------------------------------------------------

    def jog(self, lease: str, number: int, wish: Wish, actor: str) -> str | None:
        """Take a command; return None, or why it is not done."""
        steering = self.steering
        if steering is None:
            return "not_taken_over"
        steering.come_by(lease)
        steering.hear(wish, number, actor, self._tick)
        if not asks(wish):
            steering.take(wish, self._tick)
        elif (why := self._in_the_way(steering)) is not None:
            steering.refuse(why, later=why == COMING_TO_REST)
        else:
            if steering.stopped_by:
                self._lead_out(steering)
            steering.take(wish, self._tick)
        self._note(steering)
        return steering.refused or None

    def tick(self) -> Observation:
        """Do one control period and return what the sensors saw."""
        steering = self.steering
        if steering is not None:
            wish = steering.wish(self._tick)
            if isinstance(self.run.skill, Steered):
                self.run.skill.steer(wish)
            self._note(steering)
            asked = steering.asked
            self.hand = telling.hand(asked, counts=asks(asked) and wish is asked)
        else:
            self.hand = telling.NO_HAND
        return _govern(self)  # not by super(), which looks the class up in every tick

    def jogged(self) -> tuple[int, str] | None:
        """Return the number of the newest command and why it is not done; None where no human has the controls."""
        steering = self.steering
        if steering is None:
            return None
        return steering.number, steering.stopped_by or self._undone(steering)

    @property
    def _tick(self) -> int:
        return self._ports.recorder.tick

    def _undone(self, steering: Steering) -> str:
        """Return why the newest command is not done, of the rules or of the robot itself; empty where it is."""
        skill = self.run.skill
        of_robot = skill.refused if isinstance(skill, Steered) and self.run.doing is Doing.TAKEOVER else ""
        return steering.refused or of_robot

    def _steering(self, grant: Grant, plan: WatchPlan, *, alone: bool) -> Steering:
        return Steering(grant=grant, plan=plan, alone=alone, period_s=self._substrate.period_s)

    def _in_the_way(self, steering: Steering) -> str | None:
        run = self.run
        if self._handing is not None or isinstance(run.next, End):
            return "returning"
        if run.doing is not Doing.TAKEOVER or run.next is not None:
            return COMING_TO_REST
        if "operator" in run.paused_by:
            return "paused"
        if steering.stopped_by and not (steering.leavable and steering.armed):
            return steering.stopped_by
        if steering.stopped_by and (rule := run.responses.barred(run.responding, self._tick)):
            return rule
        return None if steering.armed else "release_first"

    def _lead_out(self, steering: Steering) -> None:
        """Let a motion begin where one was stopped: what moving can mend may last a little longer, and hardly grow."""
        run = self.run
        speaking = {rule: kept for rule, kept in steering.blocked.items() if rule in run.speaking}
        steering.blocked, steering.stopped_by = speaking, ""
        borne = run.responses.borne(run.responding)
        run.responding = leaving(speaking, self._tick, steering.period_s, borne)
        run.paused_by.discard("watch")
        self._resume("operator")

    def _note(self, steering: Steering) -> None:
        """Record what is wanted where it is something new: before it moves anything, and not at every command."""
        wish = steering.wish(self._tick)
        undone = self._undone(steering)
        if steering.news(self._tick, undone):
            try:
                self._tell(telling.jog(self.run.id, steering.actor, steering.number, wish, undone))
            except JournalUnavailable:
                steering.rest()
                self.end(End(Outcome.FAULT, "journal_unavailable", 1))

    # -- what the watcher says -----------------------------------------------------------------------------------------

    def _report(self, alerts: tuple[Alert, ...]) -> None:
        super()._report(alerts)
        if self.steering is not None:
            for alert in alerts:
                self.steering.blocked.setdefault(alert.rule, (self.run.watcher.signal_of(alert.rule), alert.excess))

    def _respond(self, decision: Decision, alert: Alert) -> None:
        if self.steering is None:
            super()._respond(decision, alert)
        elif self.run.doing is Doing.TAKEOVER:
            self._stand_still(self.steering, decision, alert)

    def _stand_still(self, steering: Steering, decision: Decision, alert: Alert) -> None:
        run, holding = self.run, decision.holding
        stays = holding is not None and holding.intervention is Intervention.PAUSE  # it has to end by itself
        ends = decision.ends_attempt or decision.intervention is Intervention.ESCALATE
        if self._handing is not None and ends and holding is None and alert.rule not in run.speaking:
            return  # it is over: what is bound anew begins without it
        if self._handing is not None:
            self._keep_the_controls(steering, alert.rule, "the watcher stops it where it stands")
        if steering.stop(alert.rule, leavable=ends and not stays) or "watch" not in run.paused_by:
            run.paused_by.add("watch")
            run.brake(self.seen)
            self._tell_anyway(telling.intervention(run.id, decision.intervention, alert))
            self._become(Event.PAUSE, alert.rule)

    def _clear(self) -> None:
        if self.steering is not None:
            self.steering.stopped_by = ""
        super()._clear()

    def _conclude(self, report: SkillReport) -> None:
        if self.steering is None:
            super()._conclude(report)
        else:
            self.escalate(report.failure or "skill_failed")

    # -- at standstill -------------------------------------------------------------------------------------------------

    def _go_on(self, then: Bind | End) -> None:
        run = self.run
        if isinstance(then, Bind) and then.doing is Doing.TAKEOVER:
            if run.still(self.seen):
                run.next = None
                self._recorder.sync()
                self._bind(then)
            return
        super()._go_on(then)

    def _bind(self, then: Bind) -> None:
        steering = self.steering
        if self._foreign:
            self._substrate.unbind()
            self._foreign = False
        if then.doing is Doing.TAKEOVER and steering is not None:
            self._bind_takeover(steering)
        elif self._handing is not None and then.doing is Doing.ATTEMPT:
            self._bind_anew(self._handing, then)
        else:
            super()._bind(then)

    def _bind_takeover(self, steering: Steering) -> None:
        run, substrate, permit = self.run, self._substrate, steering.grant.authorization
        substrate.unbind()
        try:
            run.skill = substrate.bind(steering.grant, permit.capability, permit.params)
        except SubstrateError as error:
            self._tell_anyway(telling.launch_refused(run.id, error.failure, error.detail, permit.id))
            self.escalate(error.failure)
            return
        self._foreign = True
        run.watch_with(steering.plan, substrate.period_s)
        run.series.keep_every_tick()
        run.bound(Doing.TAKEOVER, substrate.hold())
        run.responding, run.settling_ticks, run.unmet = intervention.NOTHING, 0, ()

    def _bind_anew(self, grant: Grant, then: Bind) -> None:
        run, substrate, permit = self.run, self._substrate, grant.authorization
        substrate.unbind()  # what was bound before, where the hand had not come to drive
        try:
            plan, recovery = self._ports.plan_of(grant)
            run.skill = substrate.bind(grant, permit.capability, permit.params, careful=then.careful)
        except (SubstrateError, ValueError) as error:
            code = error.failure if isinstance(error, SubstrateError) else "no_plan"
            self._not_anew(code, str(error))
            return
        self.steering, self._handing, self._displaced = None, None, False
        run.grant, run.recovery = grant, retracing(recovery, permit.recoveries)  # the hand's way is behind it still
        run.watch_with(plan, substrate.period_s)
        run.bound(Doing.ATTEMPT, substrate.hold())
        borne = run.responses.borne(run.responding)
        run.responding = recovering(run.spared, self._tick, substrate.period_s, borne)
        run.settling_ticks, run.unmet, run.failed = 0, (), ""
        run.begin_anew()
        self._become(Event.RECOVERED, HANDED_BACK)

    def _not_anew(self, code: str, detail: str) -> None:
        """The plan cannot begin from here: whoever has the controls keeps them; where nobody has, a human is asked."""
        if self.steering is None:
            permit, self._handing = self._handed, None
            self._tell_anyway(telling.launch_refused(self.run.id, code, detail, permit))
            self.run.failed = TAKEN_OVER
            super().escalate(code)
        else:
            self._keep_the_controls(self.steering, code, detail)
            self._bind_takeover(self.steering)

    @property
    def _handed(self) -> str | None:
        """Return the authorization by which the session is being handed back."""
        return None if self._handing is None else self._handing.authorization.id

    def _keep_the_controls(self, steering: Steering, code: str, detail: str) -> None:
        steering.rest()
        permit, self._handing, self.run.next = self._handed, None, None
        self._tell_anyway(telling.launch_refused(self.run.id, code, detail, permit))
        self._become(Event.TAKE_OVER, code)

    def finish(self, end: End) -> None:
        """Lock the actuators, then say how it ended; that a human had driven it before is no failure of its own."""
        if end.outcome is not Outcome.TAKEN_OVER and self.run.failed == TAKEN_OVER:
            self.run.failed = ""
        super().finish(end)

    # -- restraints and other words ------------------------------------------------------------------------------------

    def escalate(self, reason: str) -> None:
        """Hold and wait for a human; where the session is nothing but a human's driving, end instead."""
        steering, run = self.steering, self.run
        if steering is None and self._handing is None:
            super().escalate(reason)
            return
        self._leave()
        if steering is not None and steering.alone:
            self.end(End(Outcome.TAKEN_OVER, reason, 1))
            return
        run.failed = TAKEN_OVER
        super().escalate(reason)

    def _leave(self) -> None:
        """Take the hand off the controls; what is bound is asked for nothing until something else is."""
        if isinstance(self.run.skill, Steered):
            self.run.skill.steer(NOTHING)
        if isinstance(self.run.next, Bind):
            self.run.next = None
        self.steering = self._handing = None

    def pause(self) -> str | None:
        """Hold until an operator resumes."""
        if self.steering is not None:
            self.steering.rest()
        return super().pause()

    def resume(self) -> str | None:
        """Let a paused session go on; where a human has the controls, let them drive again."""
        run = self.run
        if self.steering is None or run.status is not Status.PAUSED:
            return super().resume()
        run.paused_by.discard("operator")
        self._resume("operator")
        return None

    def go_on(self) -> str | None:
        """Let an escalated session go on, but not one that a human has driven: that takes a new authorization."""
        return "needs_authorization" if self._displaced else super().go_on()

    def roll_back(self, code: str = OPERATOR) -> str | None:
        """Undo what the session did, a human's driving included, by the rollback its authorization covers."""
        run = self.run
        if not self._displaced or run.undoing:
            return super().roll_back(code)
        decision = roll_back(code, run.recovery, run.used, run.grant.authorization.recoveries)
        if decision is None:
            return "rollback_unavailable"
        self._leave()  # nor is it handed back any more, where that was under way
        run.paused_by.clear()
        run.release()
        self._follow(decision)
        run.failed = ""
        return None
