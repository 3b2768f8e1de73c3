"""What has to hold of a cell in every tick, whatever is said to it and whatever breaks."""

from __future__ import annotations

from math import dist, hypot
from typing import TYPE_CHECKING, Final

from app.cell.run import Doing, End
from app.governance.control import GOING_ON
from app.governance.model import EventKind, Status
from app.governance.session import TABLE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.cell.handover import Session
    from app.cell.journal import Entry
    from app.cell.runner import Runner
    from app.governance.model import Bounds
    from app.ordeal.instruments import Disk, Witness
    from app.sim.faults import Fault

HELD_TICKS: Final = 250  # what is held stands by then: two seconds of braking at most, and what swings out after it
END_TICKS: Final = 350
STILL_MPS, DRIFT_M, DRIFT_RAD, DRIFT_FINGERS_M = 0.03, 0.02, 0.06, 0.006
ROUNDING: Final = 1.001
UNTOLD_TICKS: Final = 800  # no shipped rule holds for more than 5 s before it asks, or takes more than 1 s to clear
LET_GO_TICKS, FALLS_TICKS, FALLS_M = 20, 50, 0.03  # a glass that only topples comes down by less
LOOSENS: Final = frozenset({"slippery", "payload_shift", "missing", "misplaced"})


class BrokenInvariant(Exception):  # a finding, not an error of the program
    """Something did not hold."""

    def __init__(self, invariant: str, detail: str) -> None:
        """Keep both."""
        self.invariant, self.detail = invariant, detail
        super().__init__(f"{invariant}: {detail}")


class Invariants:
    """What has to hold, whatever is said and whatever breaks."""

    def __init__(self, cell: Witness, disk: Disk, runner: Runner, faults: Sequence[Fault]) -> None:
        """Watch a cell, what it journals and the loop that drives it, knowing which faults it has."""
        self._cell, self._disk, self._runner = cell, disk, runner
        self._was: Session | None = None
        self._rate = 0.0
        self._bounds: Bounds | None = None  # of the tick before
        self._held = self._ending = self._recorded = 0
        self._paused: Session | None = None
        self._stood: tuple[tuple[float, ...], ...] | None = None
        self._status: dict[str, str] = {}
        self._ended: dict[str, str] = {}
        self._asked: set[str] = set()  # whose question has been put
        self._untold = 0
        self._open_until = self._falls_until = -1
        self._in_hand: tuple[str, float] | None = None  # and at what height
        self._let_go: tuple[str, float] | None = None
        self._keeps = LOOSENS.isdisjoint(fault.kind for fault in faults)
        sinks = any(fault.kind in ("fade", "payload_shift") for fault in faults)
        self._arm_rad = 0.5 if sinks else DRIFT_RAD  # of an arm that its drives do not hold the cell cuts power itself

    def after_word(self, session: Session, op: str, refused: str | None) -> None:
        """A pause lasts until somebody lets the session go on, and a stop is never refused."""
        ending = isinstance(session.run.next, End) or session.over is not None
        _hold(op != "stop" or ending, "a stop is never lost", f"{refused}")
        _hold(op != "pause" or not session.run.moves(), "a pause is never lost", f"{refused}")
        self._untold = self._untold if refused else 0  # somebody is there, and every wait begins anew
        if refused is None and op == "pause":
            self._paused = session
        elif refused is None and op in GOING_ON:
            self.may_move()

    def may_move(self) -> None:
        """Somebody let the session go on, or has taken the controls: it may move for a tick at least."""
        self._paused, self._held = None, 0

    def after_entry(self, entry: Entry) -> None:
        """Statuses follow the table, and every session ends once."""
        name, body = entry.invocation or "", entry.body
        if entry.kind == EventKind.STATUS:
            before, now = body["before"], str(body["status"])
            _hold(before == self._status.get(name), "statuses follow one another", f"{body}")
            legal = before is None or Status(now) in TABLE[Status(str(before))].values()
            _hold(legal, "statuses follow the table", f"{body}")
            self._status[name] = now
            self._asked.discard(name)
        elif entry.kind == EventKind.ESCALATION:
            self._asked.add(name)
        elif entry.kind == EventKind.OUTCOME:
            _hold(name not in self._ended, "a session ends once", f"{body}")
            _hold(bool(body["code"]), "every end says why", f"{body}")
            self._ended[name] = str(body["outcome"])

    def after_tick(self) -> None:
        """Look at what was commanded, what truly moved, and what is recorded."""
        session = self._runner.session
        self._commanded(session)
        self._latched(session)
        self._restrained(session)
        self._stands(session)
        self._keeps_hold(session)
        self._asks(session)
        self._is_recorded(session)
        self._was, self._rate, self._bounds = session, 0.0, None
        if session is not None:
            self._rate, self._bounds = session.run.rate, session.run.plan.bounds

    def at_the_end(self) -> None:
        """Whatever was launched has ended."""
        _hold(self._runner.session is None, "a stop ends a session", f"{self._status}")
        lost = self._status.keys() - self._ended.keys()
        _hold(not lost, "every session has an outcome", f"{sorted(lost)}")

    def _commanded(self, session: Session | None) -> None:
        cell, by = self._cell, self._was or session
        sent, before = cell.sent, cell.before
        if sent is None or before is None:
            return
        if by is None:
            _hold(not any((*sent.base_velocity, *sent.joint_speed_radps)), "nothing moves without a session", f"{sent}")
            return
        limits = [by.run.plan.bounds] if self._bounds is None else [self._bounds, by.run.plan.bounds]
        base_mps, grip_n = max(b.base_speed_mps for b in limits), max(b.grip_force_n for b in limits)
        _hold(hypot(*sent.base_velocity[:2]) <= ROUNDING * base_mps, "the base keeps its bound", f"{sent}")
        _hold(sent.grip_force_n <= ROUNDING * max(grip_n, before.grip_force_n), "the grip keeps its bound", f"{sent}")
        step = max(abs(a - b) for a, b in zip(sent.joint_rad, before.joint_rad, strict=True)) / cell.period_s
        bound = session is self._was and cell.powered
        _hold(not bound or step <= ROUNDING * limits[-1].joint_speed_radps, "joints keep their bound", f"{step} rad/s")

    def _latched(self, session: Session | None) -> None:
        latched = self._runner.latched
        _hold(not latched or (session is None and not self._cell.powered), "a latched cell has no power", "")

    def _restrained(self, session: Session | None) -> None:
        if session is None or session is not self._was:
            self._held = self._ending = 0
            self._paused = self._paused if session is self._paused else None
            return
        run = session.run
        self._held = 0 if run.moves() else self._held + 1
        self._ending = self._ending + 1 if isinstance(run.next, End) else 0
        _hold(self._held < 3 or run.rate <= self._rate, "what is held goes no faster", f"{self._rate} → {run.rate}")
        _hold(self._ending < END_TICKS, "an end comes", f"{run.next}")
        _hold(session is not self._paused or not run.moves(), "a pause lasts", f"{run.status}")
        holds = bool(self._runner.holding) and run.status is not Status.RECOVERING
        _hold(not holds or not run.moves(), "a cell without its server holds", f"{run.status}")

    def _stands(self, session: Session | None) -> None:
        rests = self._held >= HELD_TICKS or (session is None and self._was is None)
        if not rests or (session is not None and session.run.giving_ticks > 0):
            self._stood = None
            return
        physical, now = self._cell.plant.read(), self._cell.glance()
        stands = (now.base[:2], tuple(physical.joint_rad.tolist()), (physical.width_m,))
        if self._stood is None:
            self._stood = stands
            return
        _hold(self._held == 0 or now.base_speed_mps < STILL_MPS, "a held base stands", f"{now.base_speed_mps:.3f} m/s")
        for was, at, most, what in zip(
            self._stood, stands, (DRIFT_M, self._arm_rad, DRIFT_FINGERS_M), ("base", "arm", "hand"), strict=True
        ):
            off = dist(was, at) if what == "base" else max(abs(a - b) for a, b in zip(was, at, strict=True))
            _hold(self._held == 0 or off < most, f"a held {what} stays where it is", f"{off:.3f} off")

    def _keeps_hold(self, session: Session | None) -> None:
        """Look whether what was in the hand falls once it was let go of by anybody but a human at the controls."""
        if not self._keeps:
            return
        plant, tick = self._cell.plant, self._cell.observe().tick
        sent, held, by = self._cell.sent, plant.true_held(), self._was or session
        if sent is not None and sent.grip_force_n <= 0.0 and (by is None or by.run.doing is not Doing.TAKEOVER):
            self._open_until = tick + LET_GO_TICKS
        if held is not None:
            self._in_hand, self._let_go = (held, plant.true_object(held)[0][2]), None
        elif self._in_hand is not None:
            self._let_go = self._in_hand if tick < self._open_until else None
            self._in_hand, self._falls_until = None, tick + FALLS_TICKS
        if self._let_go is not None and tick < self._falls_until:
            name, height_m = self._let_go
            fell_m = height_m - plant.true_object(name)[0][2]
            _hold(fell_m < FALLS_M, "what is let go of does not fall", f"{name} by {fell_m:.3f} m")

    def _asks(self, session: Session | None) -> None:
        """Look whether somebody is told where a session waits: a human who holds it, or drives it, knows."""
        run = None if session is None else session.run
        known = run is None or run.moves() or run.status is Status.ESCALATED or "operator" in run.paused_by
        if known or session is None or session.steering is not None or self._runner.fault:
            self._untold = 0
            return
        self._untold += 1
        _hold(self._untold < UNTOLD_TICKS, "nothing waits without a word", f"{session.run.status}")

    def _is_recorded(self, session: Session | None) -> None:
        well = not self._disk.full and not self._runner.fault
        self._recorded = self._recorded + 1 if well else 0
        if self._recorded < 3:
            return
        marks, name = self._disk.marks, None if session is None else session.run.id
        _hold(marks.get("open") == name, "the journal knows what runs", f"{marks.get('open')}, not {name}")
        _hold(bool(marks.get("latched")) == self._runner.latched, "the journal knows of a latched stop", "")
        if session is not None:
            said = self._status.get(session.run.id)
            _hold(said == session.run.status, "the record knows the status", f"{said}, not {session.run.status}")
            asks = session.run.status is Status.ESCALATED
            _hold(not asks or session.run.id in self._asked, "who waits has asked", f"{session.run.escalated_by}")


def _hold(holds: bool, invariant: str, detail: str) -> None:
    if not holds:
        raise BrokenInvariant(invariant, detail)
