"""What the server knows of one cell: its link, its newest state, who has it, and what it is owed."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import orjson
from pydantic import TypeAdapter, ValidationError

from app.audit.event import RowWrite
from app.clock import monotonic_s
from app.governance.control import GOING_ON
from app.governance.model import WorldFacts
from app.governance.permit import CLOCK_TOLERANCE_S
from app.protocol import AGED_MS, first_problem
from app.runtime.budget import Budget, drawings, records

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from app.governance.control import Control
    from app.governance.model import Proposal
    from app.governance.policy import PolicySet
    from app.protocol import Hello, Human, Message, State

FRESH_S: Final = 1.0  # a state older than this says nothing
LAUNCH_WITHIN_S: Final = 10.0  # a permit not bound by then is worth nothing
BEHIND_S: Final = CLOCK_TOLERANCE_S + AGED_MS / 1000  # a permit is from the future, however old the word of that is
UNTIMELY: Final = "whatever is authorized here counts for nothing there. Set one of the clocks"
ENDING: Final = frozenset(
    {"stop", "cancel", "resolve_terminate", "end_takeover"}
)  # after these a session only comes to rest
PAUSE: Final = "pause"
SOMEBODY: Final = ""  # an operator whose name is not known any more
MOST_JOURNALS: Final = 100  # of one cell: how far the log has come in each is written down anew with every report
KEPT: Final = frozenset({"profile", "estop", "journals"})  # settings of a cell, by what precedes its name
_WORLD: Final = TypeAdapter(WorldFacts)
_JOURNALS: Final = TypeAdapter(dict[str, int])
_WORLD_NAMES: Final = frozenset(WorldFacts.__dataclass_fields__)


class Line(Protocol):
    """A cell's link, as those see it who speak to the cell; `app.runtime.link.Attachment` is one."""

    cell: Cell
    hello: Hello | None
    closed: bool

    @property
    def welcomed(self) -> bool:
        """Say whether the cell has said `Hello` and was answered, and the link still stands."""
        ...

    @property
    def settled(self) -> bool:
        """Say whether every report that has come is in the log."""
        ...

    def silent_s(self) -> float:
        """Return for how long nothing has been heard."""
        ...

    def post(self, message: Message, *, urgent: bool = False) -> None:
        """Send a message without waiting; an urgent one overtakes what waits."""
        ...

    def jog(self, command: Message) -> None:
        """Send a jog command once nothing else waits, in the place of an older one that waits still."""
        ...

    def beat(self) -> None:
        """Keep the lease alive."""
        ...

    def shut(self, code: int, reason: str) -> None:
        """Close the link and say why."""
        ...


class Moment(NamedTuple):
    """How a cell stood when somebody decided to let something move: their word counts for that, and for nothing newer.

    Recording takes time, and a restraint does not wait for it: whoever pauses what somebody else is resuming right now
    has the last word. And a cell that was away meanwhile may hold for what nobody knew of.
    """

    restraints: int
    link: Line | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reunion:
    """A cell's `Hello`, and the session it was believed to have just then."""

    hello: Hello
    believed: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Arming:
    """A reset that was asked for and has to be confirmed: by whom, with which code, and after which stop.

    `seen` is the tick of the newest state by then.
    """

    code: str
    by: str
    stops: int
    seen: int
    until_s: float


class Hands(NamedTuple):
    """How a session is driven by hand: under which policy that was decided, and what, with its effective limits.

    `compared` is the policy that was in force when it was last asked whether that may go on.
    """

    policy: PolicySet
    proposal: Proposal
    compared: PolicySet


@dataclass(slots=True, kw_only=True)
class Cell:
    """What the server knows of one cell. Times are monotonic seconds."""

    id: str
    profile: str
    latched: bool = False
    latch_unkept: bool = False  # the record could not take the latch: it is written as soon as that is possible
    itself: bool = False  # it has reported a stop, and no reset since
    unheard: str | None = None  # the journal that it had when a reset was said of which it has said nothing
    stops: int = 0  # emergency stops so far: a reset leaves those before it, none that comes while it is recorded
    journal: str = ""  # the one its reports are numbered in; "" before its first hello
    taken: dict[str, int] = field(default_factory=dict[str, int])  # by journal, the last report that the log holds
    arriving: asyncio.Lock = field(default_factory=asyncio.Lock)  # its links come and go one after the other
    recording: asyncio.Lock = field(default_factory=asyncio.Lock)  # one batch at a time, whichever link brought it
    records: Budget = field(default_factory=records)  # what it may have recorded, over whichever link
    shown: Budget = field(default_factory=drawings)  # what consoles may be told of its states
    takings: int = 0  # how often somebody was given the controls that nobody had
    taking: asyncio.Lock = field(default_factory=asyncio.Lock)  # one taker of an idle cell at a time
    claim: str | None = None
    attachment: Line | None = None
    state: State | None = None
    state_at_s: float = 0.0
    ahead_s: float = 0.0  # its clock of this one's, as its newest state said when it came
    world: WorldFacts | None = None
    trouble: str | None = None
    came: bool = False  # the record says that it has a link
    recalled: bool = False  # known from an earlier run of the server, and not seen in this one
    absent_since_s: float | None = None
    expected_until_s: float = 0.0  # its process is being started
    lapsed: bool = True  # it was away for longer than a lease before it attached, or nobody knows
    ended: str | None = None  # the last session that ended here, and when
    ended_at_s: float = 0.0
    stated: asyncio.Event = field(default_factory=asyncio.Event)
    owed: dict[tuple[str, str], Human] = field(
        default_factory=dict[tuple[str, str], "Human"]
    )  # restraints that it may not have heard
    told: tuple[Line, str] | None = None  # the session that it was told to stop, which nobody believes it to have
    awaited: dict[str, tuple[str, float]] = field(
        default_factory=dict[str, "tuple[str, float]"]
    )  # what its session is waited for to do, upon what, and since when
    onward: tuple[Line, str] | None = None  # the session to go on with, as it was told on that link and has not heard
    restraints: int = 0  # words that hold or end its session, so far
    restrained: dict[tuple[str, str], tuple[int, Human]] = field(
        default_factory=dict[tuple[str, str], "tuple[int, Human]"]
    )  # those to the present session, each with its number
    unreconciled: Reunion | None = None
    control: Control | None = None  # who drives it by hand
    control_at: str = ""  # since when, by the wall clock
    hands: Hands | None = None  # how, where it is a session that was taken over; as it was the last time
    unrecorded: Control | None = None  # as it is being taken from somebody: it moves nothing yet
    arming: Arming | None = None  # the first of the two steps out of a latched stop
    resetting: int = 0  # resets that are being recorded, or wait for another one
    profiling: asyncio.Lock = field(default_factory=asyncio.Lock)  # and is put under one profile at a time
    unlatching: asyncio.Lock = field(default_factory=asyncio.Lock)  # it is told one reset at a time
    reset: str = ""  # the one that it was told, and has not said to have heard: what it says until then is older

    @property
    def up_seq(self) -> int:
        """Return the last report of the cell's present journal that the log holds."""
        return self.taken.get(self.journal, 0)

    @property
    def behind(self) -> bool:
        """Say whether reports from before its `Hello` are not in the log yet, or not compared with what is believed."""
        return self.unreconciled is not None

    @property
    def missing(self) -> tuple[int, int] | None:
        """Return the first and last of the reports that the log lacks and the cell has not kept, where there are any.

        The log had them and was put back to an older copy of itself.
        """
        hello = None if self.attachment is None else self.attachment.hello
        if hello is None or hello.first_seq <= self.up_seq + 1:
            return None
        return self.up_seq + 1, hello.first_seq - 1

    @property
    def owing(self) -> bool:
        """Say whether nothing may begin here before reports are in; a session believed here is not kept from anybody.

        What the cell has not kept never comes, and what it reports behind that is not taken: then that holds for both.
        What it reports beyond what one cell may waits: of whatever began now people would hear as late.
        """
        waits = self.behind or self.records.owed_s() > 0
        return self.missing is not None or (waits and self.claim is None)

    @property
    def fresh(self) -> bool:
        """Say whether the cell's state may be relied on."""
        attachment = self.attachment
        return (
            attachment is not None
            and attachment.welcomed
            and self.state is not None
            and monotonic_s() - self.state_at_s <= FRESH_S
        )

    @property
    def untimely(self) -> str | None:
        """Return why it refuses whatever it is given, by its clock; None where that may agree with this one.

        What it says is older by the time it came. A session that runs goes on all the same.
        """
        if self.state is None or self.state.invocation is not None:
            return None
        if self.ahead_s >= LAUNCH_WITHIN_S:
            return f"its clock is {self.ahead_s:.0f} s ahead of the server's: {UNTIMELY}"
        if self.ahead_s <= -BEHIND_S:
            return f"its clock is {-self.ahead_s:.0f} s behind the server's: {UNTIMELY}"
        return None

    @property
    def outlived(self) -> bool:
        """Say whether the newest state is from before the last session's end: it came before, or names that session."""
        if self.state_at_s < self.ended_at_s:
            return True
        names = self.state is not None and self.state.invocation is not None and self.state.invocation == self.ended
        return names and monotonic_s() - self.ended_at_s <= FRESH_S  # a stray is told to stop after that

    @property
    def seen(self) -> int:
        """Return the tick of its newest state: whatever is said of it now is said of nothing that comes later."""
        return 0 if self.state is None else self.state.tick

    @property
    def moment(self) -> Moment:
        """Return how it stands now, for whoever decides on it."""
        return Moment(self.restraints, self.attachment)

    @property
    def armed_by(self) -> str | None:
        """Return who may take the second step out of a latched stop now."""
        armed = self.arming
        return None if armed is None or armed.stops != self.stops or monotonic_s() > armed.until_s else armed.by

    def note(self, restraint: Human, *, there: bool) -> None:
        """Note a restraint that is being said, to a cell that is there or is not."""
        key = restraint.op, restraint.invocation
        self.restraints += 1
        if restraint.invocation == self.claim:
            self.restrained[key] = self.restraints, restraint
        if not there or restraint.invocation == self.claim:
            self.owed[key] = restraint

    def heard(self, op: str, invocation: str, refused: object = None) -> None:
        """Note that the cell has a restraint: it is not said again, unless it ends a session that is not over yet.

        What is refused as the end of a takeover that never was ends nothing, unless somebody takes over just then.
        """
        if op in GOING_ON:
            self.onward = None
        if op not in ENDING or (refused == "not_taken_over" and not self.driven(invocation)):
            self.owed.pop((op, invocation), None)
        if op == PAUSE and refused:
            self.restrained.pop((op, invocation), None)

    def reported(self, what: object) -> None:
        """Note what it has reported of its stop."""
        if what == "estop":
            self.itself = True
        elif what == "reset":
            self.itself, self.unheard = False, None

    def forgetful(self, hello: Hello) -> bool:
        """Say whether a cell that is back cannot know of a stop any more that it may have had.

        Its journal is another one, or an older copy of the one it had: that ends before what the log holds of it, or
        where that ends, for a run may begin with a report, and knows of no stop where the log knows of no reset.
        """
        journal, last_seq = hello.journal, hello.last_seq
        lost = journal != self.journal or last_seq < self.up_seq or (last_seq == self.up_seq and not hello.latched)
        return self.unheard not in {None, journal} or (self.itself and lost)

    def lifted(self, since: int) -> None:
        """Note that the session goes on by the word of somebody who knew of the restraints up to that number."""
        for (op, invocation), (number, _) in tuple(self.restrained.items()):
            if number <= since:
                self.heard(op, invocation)
                if op == PAUSE:
                    del self.restrained[op, invocation]

    def goes_on(self, invocation: str) -> bool:
        """Say whether the word on which a session goes on is on its way, on the link that the cell has now."""
        return self.onward == (self.attachment, invocation)

    def driven(self, invocation: str) -> bool:
        """Say whether somebody drives a session by hand."""
        return self.control is not None and self.control.invocation == invocation

    def paused(self, invocation: str) -> bool:
        """Say whether an operator's pause of a session stands, on its way to the cell or heard by it.

        A state may be older than a pause that is in the record already.
        """
        return self.paused_by(invocation) is not None

    def paused_by(self, invocation: str) -> str | None:
        """Return whose pause of a session stands; `SOMEBODY` where the cell alone knows of it, None where none does."""
        key = PAUSE, invocation
        word = self.owed.get(key) or self.restrained.get(key, (0, None))[1]
        if word is not None:
            return word.actor
        session = None if self.state is None else self.state.session
        return SOMEBODY if session is not None and "operator" in session.paused_by else None

    def ending(self, invocation: str) -> str | None:
        """Return the word by which an invocation's session is coming to its end, if one was said."""
        return ended_by(op for op, name in self.owed if name == invocation)

    def recall(self, name: str, kept: bytes) -> None:
        """Take back one of the settings that were kept for this cell.

        Raises:
            ValueError, TypeError: it is no JSON, or not what is kept under that name.
        """
        match name, orjson.loads(kept):
            case "profile", str(profile):
                self.profile = profile
            case "estop", bool(latched):
                self.latched = latched
            case "journals", dict():
                self.taken = {**_JOURNALS.validate_json(kept), **self.taken}
            case _:
                message = f"no setting of a cell: `{name}`"
                raise TypeError(message)

    def awaited_s(self, what: str, upon: str) -> float:
        """Return for how long its session has been waited for to do something, on the clock that nobody sets."""
        now_s = monotonic_s()
        known, since_s = self.awaited.get(what, (None, now_s))
        if known != upon:
            since_s = now_s
            self.awaited[what] = upon, now_s
        return now_s - since_s

    @property
    def expected(self) -> bool:
        """Say whether the cell is on its way, and will say itself what became of its session."""
        return monotonic_s() < self.expected_until_s

    def is_passing(self) -> bool:
        """Say whether who drives it takes it from another, which is not recorded yet, by whichever of their leases."""
        control, taken = self.control, self.unrecorded
        if control is None or taken is None:
            return False
        return (control.holder, control.since_s) == (taken.holder, taken.since_s)

    def control_document(self) -> dict[str, Any] | None:
        """Return who drives the cell by hand as JSON, and why their last command was not done; None if nobody."""
        control = self.control
        if control is None:
            return None
        jog = None if self.state is None else self.state.jog
        return {
            "lease": control.lease,
            "cell": self.id,
            "holder": control.holder,
            "where": control.where,
            "since": self.control_at,
            "invocation": control.invocation,
            "phase": control.phase,
            "refused": None if jog is None else jog.refused,
        }

    def taken_with(self, journal: str, seq: int) -> dict[str, int]:
        """Return how far the log has come once it holds a report; of many journals those are left out that are older.

        One of those that comes back after all is met like one of which the log has lost what it held.
        """
        others = {name: last for name, last in self.taken.items() if name != journal}
        return dict([*others.items(), (journal, seq)][-MOST_JOURNALS:])

    def progress(self, taken: Mapping[str, int], at: str) -> list[RowWrite]:
        """Return the rows that say how far the log has come in the cell's journal, and in those it had before."""
        present = {"cell": self.id, "up_seq": taken.get(self.journal, 0), "journal": self.journal, "updated_at": at}
        rows = [RowWrite(table="cell_progress", values=present)]
        if former := {name: seq for name, seq in taken.items() if name != self.journal}:
            values = {"name": f"journals/{self.id}", "value": orjson.dumps(former), "updated_at": at}
            rows.append(RowWrite(table="settings", values=values))
        return rows

    def away_s(self) -> float | None:
        """Return for how long the cell has been away; None where nobody knows."""
        if self.recalled or self.absent_since_s is None:
            return None
        return monotonic_s() - self.absent_since_s


def ended_by(said: Iterable[str]) -> str | None:
    """Return the word by which a session ends, of those that were said to it: a stop outranks every other."""
    ending = [op for op in said if op in ENDING]
    return "stop" if "stop" in ending else next(iter(ending), None)


def read_world(facts: Mapping[str, Any]) -> WorldFacts:
    """Read a cell's facts, strictly.

    Raises:
        ValueError: a fact that is unknown, missing or of another type, or a number that is not finite.
    """
    if strange := facts.keys() - _WORLD_NAMES:
        raise ValueError(f"unknown fact `{sorted(strange)[0]}`")
    try:
        # Through JSON, which has no NaN and no infinity: they become null, and null is no number.
        return _WORLD.validate_json(orjson.dumps(facts))
    except ValidationError as error:
        raise ValueError(first_problem(error)) from error
