"""The cell's runner: one governed session at a time, 100 times a second (design, section 4, steps 6 and 7).

One `tick` is a plain function call. Within a session (`governing`) everything in it happens in this order:

1. the rate ramps: towards 1 where the session may move, else down to 0 as declared (category 2: held, power kept);
2. the skill says what it wants, or, at rate 0, is not even asked: then the command repeats the last one without speed;
3. the clamp holds the command to the session's bounds, and the substrate applies it;
4. the watcher judges what the sensors say, and the declared responses say what follows;
5. what was waiting for standstill is done (a recovery is bound, the session ends), or completion is verified.

Orders from outside (`launch`, `human`, `estop`, `reset`, `hold`, `welcomed`) are plain calls too, made between ticks by
whoever owns the thread. If the journal cannot be written, nothing moves: the session is brought to a stop, `fault` says
why, and what could not be recorded is kept and recorded as soon as it can be. Whoever ticks does not wait for a slow
disk either, once a thread of its own writes (`write_behind`).
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from app.cell import telling
from app.cell.governing import EXPIRED, STOP, NotHeldError, PlanOf, Ports, Verify
from app.cell.handover import Session
from app.cell.journal import USED, Entry, Journal, JournalUnavailable
from app.cell.recorder import Recorder
from app.cell.run import LINK, Doing, End, Run, Unprepared
from app.cell.series import Series
from app.cell.substrate import SubstrateError
from app.governance.continuing import CHANGED
from app.governance.control import GOING_ON, TAKEOVER
from app.governance.detectors import DOUBT_S, FIX_JUMP_M
from app.governance.estimation import BaseEstimate, follow_base
from app.governance.intervention import Responses
from app.governance.model import EventKind, Mode, Outcome, Status
from app.governance.permit import PermitError, SignedAuthorization, verify
from app.governance.policy_model import FAILURES
from app.governance.signals import Signals
from app.governance.watcher import compile_watch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    from app.cell.latch import Latch
    from app.cell.substrate import Skill, Substrate
    from app.governance.model import Json, Observation, Wish
    from app.governance.permit import Grant

Deed: TypeAlias = "Callable[[Session], str | None]"

CATCH_UP_TICKS: Final = 100
LOST: Final = "a stop was latched, and the journal could not take what came before it"
_NOTHING: Final[Mapping[str, tuple[str, str]]] = {}
_NO_WORDS: Final[Mapping[str, str]] = {}


class View(NamedTuple):
    """The runner as displays and the server see it.

    `fault` says why nothing moves, empty when all is well, and `unsaid` what has ended (outcome, code, by invocation)
    and could not be recorded for that reason; `broken` says what failed of the guard itself, until a reset; `signals`
    are those of the last session, where none runs.
    """

    tick: int
    time_s: float
    invocation: str | None
    status: Status | None
    latched: bool
    holding: str
    fault: str
    unsaid: Mapping[str, tuple[str, str]]
    broken: str
    signals: Signals
    jogged: tuple[int, str] | None


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
        latch: Latch | None = None,
    ) -> None:
        """Take a substrate into custody. What an earlier run of the cell left open is reported as the fault it is.

        Args:
            substrate: What moves.
            plan_of: Compiles a grant's watch and recovery plan.
            verify: Names the postconditions that do not hold: (postconditions, params, facts) → unmet.
            journal: Where everything is written before it counts.
            wall: Wall time, seconds since the epoch.
            emit: Told every entry of the journal, after it was written.
            on_telemetry: Told (invocation, packed rows) whenever `protocol.ROWS_PER_BATCH` of those to keep are there.
            latch: Where a latched stop is kept that the journal does not take; without it, nowhere.
        """
        self.substrate = substrate
        self.journal = journal
        self.observation: Observation = substrate.observe()
        self.holding = ""
        self._wall = wall
        self._record = Recorder(journal, wall, emit)
        self._ports = Ports(
            substrate=substrate, plan_of=plan_of, verify=verify, recorder=self._record, on_telemetry=on_telemetry
        )
        self._key: Ed25519PublicKey | None = None
        self._policy_digest = ""
        self._former: frozenset[str] = frozenset()
        self._elsewhere = _NO_WORDS
        self._session: Session | None = None
        self._signals = Signals()
        self._base = BaseEstimate()
        self._doubted = False  # something leapt, and no session has waited it out
        self._unpowered = False
        self._latch_beside = latch
        self.latched = left_latched(journal, latch)
        self.broken = str(journal.marks.get("broken") or "")  # until a reset, whoever starts the cell meanwhile
        if self.latched and not journal.marks.get("latched"):
            self.broken = LOST
            self._record.say_anyway(telling.cell("estop", telling.CELL), marks={"latched": True, "broken": LOST})
        self._broke_tick = 1 if self.broken else 0  # no state of this run has said so yet
        if self.latched:
            self._cut_power()
        close_left_open(journal, self._record)

    # -- what it is doing ----------------------------------------------------------------------------------------------

    @property
    def period_s(self) -> float:
        """Return the control period."""
        return self.substrate.period_s

    @property
    def fault(self) -> str:
        """Return why nothing may move, or nothing."""
        return self._record.fault

    @fault.setter
    def fault(self, why: str) -> None:
        self._record.fault = why

    @property
    def session(self) -> Session | None:
        """Return the session under way, for evaluation to look at."""
        return self._session

    @property
    def invocation(self) -> str | None:
        """Return the invocation under way, if there is one."""
        return None if self._session is None else self._session.run.id

    @property
    def status(self) -> Status | None:
        """Return the status of the session under way."""
        return None if self._session is None else self._session.run.status

    def view(self) -> View:
        """Return what displays and the server want to know."""
        session = self._session
        return View(
            self._record.tick,
            self.observation.time_s,
            self.invocation,
            self.status,
            self.latched,
            self.holding,
            self.fault,
            self._unsaid_ends() if self.fault else _NOTHING,
            self.broken,
            self._signals if session is None else session.run.watching.signals,
            None if session is None else session.jogged(),
        )

    def _unsaid_ends(self) -> dict[str, tuple[str, str]]:
        ends = self._record.unsaid_ends()
        ends.pop(self.invocation or "", None)  # a change of hands was refused; the session itself is not over yet
        return ends

    def standing(self) -> bool:
        """Say whether nothing moves and nothing is about to."""
        session = self._session
        return session is None or (session.run.rate == 0.0 and not session.run.moves() and session.run.next is None)

    # -- orders --------------------------------------------------------------------------------------------------------

    def adopt(
        self,
        *,
        policy_digest: str,
        key: Ed25519PublicKey,
        former: frozenset[str] = frozenset(),
        elsewhere: Mapping[str, str] = _NO_WORDS,
    ) -> None:
        """Believe authorizations under this policy, or one of those still held, signed with this key.

        Args:
            policy_digest: The newest policy.
            key: What authorizations are signed with.
            former: The others that are still held.
            elsewhere: Of these, those of another site than the substrate's, and what to say of it: nothing is launched
                under them.
        """
        self._policy_digest, self._former, self._key, self._elsewhere = policy_digest, former, key, elsewhere

    def launch(self, signed: SignedAuthorization, *, anew: bool = False) -> str | None:
        """Verify a signed authorization and begin its session; return None, or the code of the refusal.

        One for the session that runs already changes whose hands it is in: to a human's (`takeover`), or back to its
        own capability. One that was meant for that (`anew`) begins no session once that one is over. Every refusal is
        recorded, and says under which invocation where the signature was good; an authorization that was refused is
        used up.
        """
        try:
            grant = self._admit(signed)
        except PermitError as error:
            used = {} if error.permit is None else {USED + error.permit: error.expires_at_s}
            return self._refuse(error.invocation, error.code, error.detail, error.permit, used)
        permit = grant.authorization
        used: dict[str, Json] = {USED + permit.id: permit.expires_at_s}
        if (why := self._not_now(grant, anew=anew)) is not None:
            return self._refuse(permit.invocation, *why, permit.id, used)
        launched: dict[str, Json] = {**used, "open": permit.invocation}
        session = self._session
        try:
            if session is None:
                self._record.require_room()
                self._record.say_first(telling.launch(permit), marks=launched)
            else:  # it may move: it waits for the disk once it stands, before anything is bound
                self._record.say(telling.launch(permit), marks=launched)
        except JournalUnavailable as error:
            return self._refuse(permit.invocation, "journal_unavailable", str(error), permit.id, used)
        return self._begin(grant) if session is None else self._change_hands(session, grant)

    def jog(self, invocation: str, lease: str, number: int, wish: Wish, actor: str) -> str | None:
        """Take a command of the human at the controls; return None, or the code of why it is not done."""
        session = self._session
        if session is None or session.run.id != invocation:
            return "no_such_session"
        if self.holding:
            return "holding"
        return session.jog(lease, number, wish, actor)

    def human(self, invocation: str, op: str, actor: str, *, expired: bool = False) -> str | None:
        """Do an operator's word on the session, or what follows where nobody said one in time (`expired`).

        Returns:
            None, or the code of why it could not be done.
        """
        session = self._session
        if session is None or session.run.id != invocation:
            return "no_such_session"
        refused = self._obey(session, op, _SILENCE if expired else _OPS)
        self._record.say_anyway(telling.human(invocation, op, actor, refused, expired=expired))
        return refused

    def estop(self, actor: str) -> None:
        """Stop by category 0, now, and stay stopped until reset. Needs nothing and waits for nothing."""
        self._latch(actor, End(Outcome.STOPPED, "estop"))

    def _latch(self, actor: str, end: End) -> None:
        self._cut_power()
        self._say_latched(actor)
        if self._session is not None:
            self._session.finish(end)
            self._take_leave(self._session)
        # Last, since nothing that restrains waits for a disk. The server may not have heard of it: without this, losing
        # power in the seconds until the system writes by itself would take the latch back.
        try:
            self._record.sync()
        except JournalUnavailable:  # `fault` says so
            self._keep_beside()

    def _say_latched(self, actor: str) -> None:
        self.latched = True
        marks: dict[str, Json] = {"latched": True, **({"broken": self.broken} if self.broken else {})}
        self._record.say_anyway(telling.cell("estop", actor), marks=marks)

    def _keep_beside(self) -> None:
        if self._latch_beside is not None:
            with suppress(JournalUnavailable):  # then nothing on that disk can be written, and no cell starts on it
                self._latch_beside.keep()

    def break_off(self, error: Exception) -> None:
        """Stop by category 0, and stay latched in whatever runs next: what drives the ticks broke, and nobody will."""
        session, self._session = self._session, None
        self.broken = f"its control loop broke, and power was cut: {error!r}"
        try:
            self._cut_power()
        finally:  # whatever else is broken
            self._keep_beside()
            self._say_latched(telling.CELL)
            self._record.say_anyway(telling.cell("broken", telling.CELL, repr(error)))
            if session is not None:
                ended = telling.outcome(session.run.id, Outcome.FAULT, "loop_broken")
                self._record.say_anyway(ended, marks={"open": None})
            with suppress(JournalUnavailable):  # it is kept beside the journal
                self._record.sync()

    def reset(self, actor: str, seen: int | None = None) -> str | None:
        """Leave a latched stop; return None, or why not. Moves nothing.

        Whoever says so knows of what the cell has done up to the tick `seen`; None, of everything.
        """
        if not self.latched:
            return "not_latched"
        if self.holding:  # it may have been under way for as long: whoever said it was told that nobody heard it
            self._record.say_anyway(telling.cell("reset_refused", actor, "the server was lost when it came"))
            return "holding"
        if seen is not None and seen < self._broke_tick:
            self._record.say_anyway(telling.cell("reset_refused", actor, "the watch broke after what was seen"))
            return "broken_since"
        try:
            self._record.say_first(telling.cell("reset", actor), marks={"latched": None, "broken": None})
            if self._latch_beside is not None:
                self._latch_beside.leave()
        except JournalUnavailable:
            return "journal_unavailable"
        self.latched, self.broken = False, ""
        return None

    def hold(self, reason: str) -> None:
        """Hold (category 2) and launch nothing until welcomed; a session that moved waits for a human from now on.

        A recovery under way is finished first: it is recorded, covered, and safer done than left half done.
        `shutdown` ends the session instead.
        """
        self.holding = reason
        session = self._session
        if session is None or isinstance(session.run.next, End):
            return
        if reason == "shutdown":
            session.end(End(Outcome.STOPPED, "shutdown", 1))
        elif session.run.status is Status.RECOVERING:
            session.run.hold_after_recovery = session.run.hold_after_recovery or reason
        else:
            session.escalate(reason)

    def welcomed(self) -> None:
        """The server is back. Nothing moves by that: what was held waits for a human."""
        self.holding = ""

    def acknowledged(self, seq: int) -> None:
        """The server's log holds everything up to `seq`; the next word will do as well where anything moves."""
        if self.standing():  # a file that is made smaller is waited for
            self._record.acknowledged(seq)

    # -- the record ----------------------------------------------------------------------------------------------------

    def write_behind(self) -> None:
        """Have a thread of its own write the journal from here on: whoever ticks does not wait for the disk."""
        self._record.write_behind()

    def when_written(self, then: Callable[[], None]) -> None:
        """Do something once everything said so far is written, or at once where that cannot be (`recorder`)."""
        self._record.when_written(then)

    def settle(self) -> None:
        """Return once everything that can be written is; for whoever leaves."""
        self._record.settle()

    # -- the tick ------------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Do one control period."""
        record = self._record
        record.tick += 1
        record.check_on_time()
        session = self._session
        if record.tick % CATCH_UP_TICKS == 1:  # a drive that has nothing to say would not notice that its disk is gone
            record.catch_up()
        if session is None:
            self.observation = self.substrate.step(self.substrate.hold())
            self._base = follow_base(self._base, self.observation)  # who is launched next is watched from where it is
            self._doubted = self._doubted or self._base.miss_m > FIX_JUMP_M
            return
        try:
            self.observation = session.tick()
        except NotHeldError as error:
            self._break("not_held", f"{error}, and power was cut", str(error))
            return
        except Exception as error:  # a guard that breaks guards nothing: power off, and say so
            self._break("guard_broken", f"its watch broke, and power was cut: {error!r}", repr(error))
            return
        if session.over is not None:
            self._take_leave(session)

    def _break(self, code: str, why: str, detail: str) -> None:
        """Cut power, until somebody who knows of it resets it: what has to stop the robot does not."""
        self.broken, self._broke_tick = why, self._record.tick
        self._latch(telling.CELL, End(Outcome.FAULT, code))
        self._record.say_anyway(telling.cell("broken", telling.CELL, detail))

    def _take_leave(self, session: Session) -> None:
        watching = session.run.watching
        self._signals, self._base = watching.signals, watching.senses.base
        self._doubted = watching.senses.doubted_until_s > self.observation.time_s
        self._unpowered = self._unpowered or session.over is None or session.over.category is not None
        self._session = None

    def _cut_power(self) -> None:
        self.substrate.stop(0)
        self._unpowered = True

    # -- inside --------------------------------------------------------------------------------------------------------

    def _obey(self, session: Session, op: str, deeds: Mapping[str, Deed]) -> str | None:
        ending = session.run.next
        if isinstance(ending, End) and not (op == "stop" and ending.yields_to(STOP)):
            return "ending"
        if self.holding and op in GOING_ON:
            return "holding"
        deed = deeds.get(op)
        if deed is None:
            return "unknown_op"
        try:
            return deed(session)
        except JournalUnavailable:
            session.end(End(Outcome.FAULT, "journal_unavailable", 1))
            return "journal_unavailable"

    def _admit(self, signed: SignedAuthorization) -> Grant:
        if self._key is None:
            raise PermitError("wrong_policy", "this cell has no policy and no key yet")
        return verify(
            signed,
            key=self._key,
            cell=self.substrate.id,
            policy_digest=self._policy_digest,
            now_s=self._wall(),
            used=self._record.used_permits(),
            forgotten_s=self.journal.forgotten_s,
            begun_s=self.journal.begun_s,
            former=self._former,
        )

    def _not_now(self, grant: Grant, *, anew: bool) -> tuple[str, str] | None:
        if self.latched:
            return "estop_latched", "an emergency stop is latched; valid: reset it first"
        if self.holding:
            return "holding", f"the cell holds (`{self.holding}`); valid: wait until the link is back"
        if (why := self._elsewhere.get(grant.authorization.policy_digest)) is not None:
            return "another_site", why
        session = self._session
        if session is None:
            return ("no_such_session", "the session that was to change hands is over") if anew else None
        if session.run.id != grant.authorization.invocation:
            return "busy", f"the cell runs `{session.run.id}`"
        return session.why_not(grant)

    def _change_hands(self, session: Session, grant: Grant) -> str | None:
        permit = grant.authorization
        if permit.capability != TAKEOVER:
            session.hand_back(grant)
            return None
        code = session.take_over(grant)
        return None if code is None else self._refuse(permit.invocation, code, "nothing changed hands", permit.id, {})

    def _refuse(
        self, invocation: str | None, code: str, detail: str, permit: str | None, used: Mapping[str, Json]
    ) -> str:
        """Say that an authorization was refused. With that it is used up: said again, it begins nothing."""
        self._record.say_anyway(telling.launch_refused(invocation, code, detail, permit), marks=used)
        return code

    def _begin(self, grant: Grant) -> str | None:
        permit, substrate = grant.authorization, self.substrate
        try:
            self._record.sync()
        except JournalUnavailable as error:  # the server may have heard already that it was launched: so it ends
            return self._not_begun(permit.invocation, "journal_unavailable", str(error))
        try:
            plan, recovery = self._ports.plan_of(grant)
            watcher = compile_watch(plan, substrate.period_s)
            if self._unpowered:
                substrate.reset()
                self._unpowered = False
            skill = self._prepared(grant)
            began = substrate.facts()  # as they are for this session: what a switch remembers may have been another's
        except (SubstrateError, ValueError) as error:
            substrate.unbind()
            code = error.failure if isinstance(error, SubstrateError) else "no_plan"
            return self._not_begun(permit.invocation, code, str(error))
        run = Run(
            grant=grant,
            plan=plan,
            recovery=recovery,
            skill=skill,
            watcher=watcher,
            responses=Responses(watcher.rules, substrate.period_s),
            watching=watcher.begin(base=self._base, doubted_until_s=self._doubted_until_s()),
            previous=substrate.hold(),
            series=Series(substrate.period_s, keep_every_tick=plan.keep_every_tick),
            began=began,
            first_tick=self._record.tick,
            doing=Doing.TAKEOVER if permit.capability == TAKEOVER else Doing.ATTEMPT,
        )
        self._session = Session(self._ports, run, self.observation)
        self._record.say_anyway(telling.status(permit.invocation, Status.RUNNING, None, "launched"))
        return None

    def _not_begun(self, invocation: str, code: str, detail: str) -> str:
        """Say that a session which was launched is over before anything was bound; return why."""
        ended = telling.outcome(invocation, Outcome.FAULT, code, detail=detail)
        self._record.say_anyway(ended, marks={"open": None})
        return code

    def _doubted_until_s(self) -> float:
        """Return until when a session that begins now holds against its sensors what leapt before, with nobody there.

        For as long as if it had leapt just now: what is left of that time might be over before the session asks.
        """
        return self.observation.time_s + DOUBT_S if self._doubted else 0.0

    def _prepared(self, grant: Grant) -> Skill:
        """Bind the granted capability; what fails by a name that policy recovers from has failed like any attempt.

        Raises:
            SubstrateError: the substrate will not have the grant; no recovery would change that.
        """
        permit = grant.authorization
        try:
            return self.substrate.bind(grant, permit.capability, permit.params, careful=permit.mode is Mode.CAREFUL)
        except SubstrateError as error:
            if error.failure not in FAILURES:
                raise
            self._record.say_anyway(telling.cell("unprepared", telling.CELL, str(error)))
            return Unprepared(error.failure, self.substrate.hold())


def _hold_for_policy(session: Session) -> None:
    """Have a session wait for a human, to which another policy does not leave to go on; a recovery ends first."""
    if session.run.status is Status.RECOVERING:
        session.run.hold_after_recovery = CHANGED
    elif session.run.status is not Status.ESCALATED:
        session.escalate(CHANGED)


def _go_on(session: Session) -> str | None:
    """Let a held session go on, but not where a phase waits: that takes the word of somebody who was asked about it."""
    run = session.run
    if run.hold_after_recovery == LINK and run.status in {Status.RECOVERING, Status.PAUSED}:
        return session.go_on_after_recovery()
    return "needs_confirmation" if run.unconfirmed else session.go_on()


_OPS: Final[Mapping[str, Deed]] = {
    "escalate": _hold_for_policy,
    "pause": Session.pause,
    "resume": Session.resume,
    "stop": Session.stop,
    "rollback": Session.roll_back,
    "cancel": Session.cancel,
    "confirm": Session.confirm,
    "resolve_continue": _go_on,
    "resolve_terminate": Session.terminate,
    "let_go": Session.let_go,
    "end_takeover": Session.end_takeover,
}
_SILENCE: Final[Mapping[str, Deed]] = {
    "rollback": partial(Session.roll_back, code=EXPIRED),
    "resolve_terminate": partial(Session.terminate, code=EXPIRED),
}


def left_latched(journal: Journal, latch: Latch | None) -> bool:
    """Say whether an earlier run of the cell left its stop, in the journal or beside it."""
    return bool(journal.marks.get("latched")) or (latch is not None and latch.found)


def close_left_open(journal: Journal, record: Recorder) -> None:
    """Report the session that an earlier run of the cell left open as the fault it is.

    A cell does so before it first speaks to its server: the number of its last report then counts this one in, and
    nobody else has to say what became of the session.
    """
    left = journal.marks.get("open")
    if isinstance(left, str):
        record.say_anyway(telling.outcome(left, Outcome.FAULT, "cell_restarted"), marks={"open": None})


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
