"""What a log says of how a policy is lived with: what it bounds, what it asks, what people answer, what never happens.

Read are decisions under one version of policy only, and answers to its questions: what another version did says nothing
certain about this one. A condition that held is told by asking the recorded decisions again, with every rule that
modifies made to speak up; what a rule changed, and what people answered, is taken from the record as it stands.
"""

from __future__ import annotations

from collections import deque
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from app.audit.errors import RecordDamaged
from app.audit.places import Places
from app.clock import parse_rfc3339
from app.governance import recorded
from app.governance.bundle import make_gate
from app.governance.model import EventKind
from app.governance.policy_code import limit_for
from app.governance.policy_model import Effect
from app.governance.vocabulary import properties

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from app.audit.event import Event
    from app.governance.policy import Gate, PolicySet
    from app.governance.policy_model import Rule

EXAMPLES: Final = 20
SOON_S: Final = 600.0  # a takeover within so long answers a refusal
TAKEOVER: Final = "takeover"
_READ: Final = frozenset({
    EventKind.PROPOSAL, EventKind.ADMISSION, EventKind.POLICY, EventKind.ESCALATION, EventKind.APPROVAL,
    EventKind.HUMAN,
})  # fmt: skip

Body = dict[str, Any]


@dataclass(slots=True)
class Tally:
    """How often something was, from when to when, and the newest events that show it."""

    count: int = 0
    first: str = ""
    last: str = ""
    events: deque[int] = field(default_factory=lambda: deque[int](maxlen=EXAMPLES))

    def note(self, seq: int, at: str) -> None:
        """Count one more."""
        self.count += 1
        self.first, self.last = self.first or at, at
        self.events.append(seq)

    def with_(self, other: Tally) -> Tally:
        """Return both counts together, with the newest events of either."""
        first = min((at for at in (self.first, other.first) if at), default="")
        found = Tally(self.count + other.count, first, max(self.last, other.last))
        found.events.extend(sorted({*self.events, *other.events}))
        return found


@dataclass(slots=True)
class Bound:
    """One bound on a parameter: how often an agent named a value where it holds, and the values beyond it."""

    limit: float
    above: bool
    named: Tally = field(default_factory=Tally)
    beyond: list[float] = field(default_factory=list[float])
    pairs: set[tuple[str, str]] = field(default_factory=set[tuple[str, str]])

    def note(self, value: float, pair: tuple[str, str], seq: int, at: str) -> None:
        """Take one value that was proposed."""
        self.named.note(seq, at)
        self.pairs.add(pair)
        if value > self.limit if self.above else value < self.limit:
            self.beyond.append(value)


class Question(NamedTuple):
    """The last word on one question before launch: the event, and the escalation as it stood then."""

    seq: int
    at: str
    document: Mapping[str, Any]


@dataclass(slots=True, kw_only=True)
class Habits:
    """What was found.

    Attributes:
        decisions: first decisions on proposals, under the version that is asked about.
        left_out: those under another version, or recorded without their context.
        applied: for each rule, the decisions it had a say in.
        told: for each rule, those it was a reason of.
        held: for each rule, how often its condition held.
        bounds: by rule or limit, parameter (empty for a limit), and whether it holds from above.
        questions: answered questions before launch, by their names.
        in_advance: launches that a standing grant answered for, by capability and profile.
        overridden: for each rule, the refusals after which a person took the controls of the same, idle cell.
    """

    decisions: Tally = field(default_factory=Tally)
    left_out: int = 0
    applied: dict[str, Tally] = field(default_factory=dict[str, Tally])
    told: dict[str, Tally] = field(default_factory=dict[str, Tally])
    held: dict[str, int] = field(default_factory=dict[str, int])
    bounds: dict[tuple[str, str, bool], Bound] = field(default_factory=dict[tuple[str, str, bool], Bound])
    questions: dict[str, Question] = field(default_factory=dict[str, Question])
    in_advance: dict[tuple[str, str], Tally] = field(default_factory=dict[tuple[str, str], Tally])
    overridden: dict[str, Tally] = field(default_factory=dict[str, Tally])


def read_habits(data_dir: Path, policy: PolicySet, *, since: float | None = None) -> Habits:
    """Read a log, beside a running server or without one.

    Args:
        data_dir: the directory of a server.
        policy: the version that is asked about.
        since: wall time in seconds from which on; None is the beginning.

    Raises:
        RecordDamaged: there is no log, it cannot be read, or an event is not what a server writes.
    """
    from app.audit.reader import MAX_LIMIT, Reader  # the database, which every other command does without

    database = Places(data_dir).database
    listening = _Listening(policy)
    with closing(Reader(database)) as reader:
        after = 0
        while page := reader.events(since=since, after=after, limit=MAX_LIMIT):
            for event in page:
                if event.kind in _READ:
                    try:
                        listening.hear(event)
                    except (KeyError, TypeError, ValueError) as error:
                        raise RecordDamaged(database, f"event `{event.seq}` cannot be read: {error!r}") from error
            after = page[-1].seq
    return listening.habits


class _Refusal(NamedTuple):
    seq: int
    at: str
    rules: tuple[str, ...]


class _Listening:
    """Goes through events in order."""

    def __init__(self, policy: PolicySet) -> None:
        self.habits = Habits(applied={name: Tally() for name in policy.rules})
        self._policy = policy
        self._probe = _Probe(policy)
        self._given: dict[str, frozenset[str]] = {}  # by invocation, until it is decided: what its agent named
        self._judged: tuple[Event, Body, frozenset[str]] | None = None  # an admission; its verdict comes right behind
        self._refused: dict[str, _Refusal] = {}  # by cell: the last one
        self._taken: Event | None = None

    def hear(self, event: Event) -> None:
        body = cast("Body", event.payload())
        match event.kind:
            case EventKind.PROPOSAL:
                self._given[str(event.invocation)] = frozenset(body["params"])
            case EventKind.ADMISSION:
                self._admission(event, body)
            case EventKind.POLICY:
                self._verdict(event, body)
            case EventKind.HUMAN:
                if body.get("op") == TAKEOVER:
                    self._taken = event
            case _:
                self._answer(event, body)

    # -- answers -----------------------------------------------------------------------------------------------------

    def _answer(self, event: Event, body: Body) -> None:
        asked = body.get("escalation")
        if not asked or asked["kind"] != "approval" or asked["policy_version"] != self._policy.digest:
            return
        if asked["status"] in ("approved", "denied", "expired"):
            self.habits.questions[asked["id"]] = Question(event.seq, event.at, asked)

    # -- decisions ---------------------------------------------------------------------------------------------------

    def _admission(self, event: Event, body: Body) -> None:
        kept = body.get(recorded.KEY)
        given = self._given.pop(str(event.invocation), None)
        if body.get(TAKEOVER):  # somebody took a session over; its agent was not refused
            self._taken = None
        elif kept is not None and kept["proposal"]["capability"] == TAKEOVER and self._taken is not None:
            self._idle_takeover(event, str(body["cell"]))
        elif given is not None:  # the first decision: what is decided again is no other proposal
            if kept is None or kept["policy_version"] != self._policy.digest:
                self.habits.left_out += 1
            else:
                self.habits.decisions.note(event.seq, event.at)
                self._judged = (event, body, given)

    def _idle_takeover(self, event: Event, cell: str) -> None:
        """Take down that a person took an idle cell: its word stands right before its admission."""
        taken, self._taken = self._taken, None
        refused = self._refused.pop(cell, None)
        if taken is None or taken.invocation != event.invocation or refused is None:
            return
        if parse_rfc3339(event.at) - parse_rfc3339(refused.at) <= SOON_S:
            for rule in refused.rules:
                self.habits.overridden.setdefault(rule, Tally()).note(refused.seq, refused.at)

    def _verdict(self, event: Event, body: Body) -> None:
        judged, self._judged = self._judged, None
        if judged is None or judged[0].seq != event.seq - 1 or judged[0].invocation != event.invocation:
            return
        admission = judged[1]
        kept, profile = cast("Body", admission[recorded.KEY]), str(admission["profile"])
        proposal = kept["proposal"]
        pair = (str(proposal["capability"]), profile)
        told = {reason["rule"] for reason in body["reasons"]} & self._policy.rules.keys()
        for rule in told:
            self.habits.told.setdefault(rule, Tally()).note(event.seq, event.at)
        if "grant" in admission:
            self.habits.in_advance.setdefault(pair, Tally()).note(event.seq, event.at)
        denying = tuple(sorted(rule for rule in told if self._policy.rules[rule].then is Effect.DENY))
        if kept["decided"] == "denied" and denying and admission["cell"]:
            self._refused[str(admission["cell"])] = _Refusal(event.seq, event.at, denying)
        rules = self._probe.holding(kept, profile)
        for rule in self._probe.applying(pair):
            self.habits.applied[rule.id].note(event.seq, event.at)
            self.habits.held[rule.id] = self.habits.held.get(rule.id, 0) + (rule.id in rules)
        if body["outcome"] != "deny":
            params, given = cast("Body", proposal["params"]), judged[2]
            named = {name: float(params[name]) for name in given & params.keys() if _is_number(params[name])}
            self._bounds(event, pair, named, rules)

    def _bounds(self, event: Event, pair: tuple[str, str], named: Mapping[str, float], rules: frozenset[str]) -> None:
        """Hold what an agent named against every bound that held."""
        gate = self._policy.gates[pair]
        for name, value in named.items():
            limit = limit_for(properties(gate.capability)[name], gate.profile.limits)
            if limit is not None:
                self._bound((f"{pair[1]}/{limit.name}", "", True), limit.maximum).note(value, pair, event.seq, event.at)
        for rule in self._probe.applying(pair):
            for setting in rule.settings if rule.id in rules else ():
                value = named.get(setting.param)
                for bound, above in ((setting.maximum, True), (setting.minimum, False)):
                    if bound is not None and value is not None:
                        self._bound((rule.id, setting.param, above), bound).note(value, pair, event.seq, event.at)

    def _bound(self, key: tuple[str, str, bool], limit: float) -> Bound:
        return self.habits.bounds.setdefault(key, Bound(limit, key[2]))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


class _Probe:
    """Tells of a recorded decision whose conditions held: rules that modify are made to ask, so that each speaks up."""

    def __init__(self, policy: PolicySet) -> None:
        self._policy = policy
        self._vocabulary = policy.vocabulary()
        self._agents = recorded.Agents(policy)
        self._gates: dict[tuple[str, str], Gate] = {}
        self._applying: dict[tuple[str, str], tuple[Rule, ...]] = {}

    def applying(self, pair: tuple[str, str]) -> tuple[Rule, ...]:
        """Return the rules that have a say in a pair."""
        if pair not in self._applying:
            self._applying[pair] = tuple(
                rule
                for rule in self._policy.rules.values()
                if (rule.applies_to is None or pair[0] in rule.applies_to)
                and (rule.profiles is None or pair[1] in rule.profiles)
            )
        return self._applying[pair]

    def holding(self, kept: Body, profile: str) -> frozenset[str]:
        """Return the rules whose conditions held; one that failed did not."""
        proposal, context = recorded.read(kept, profile, self._policy, self._agents)
        verdict = self._gate((proposal.capability, profile)).check(proposal, context)
        return frozenset(
            one.rule
            for one in verdict.reasons
            if one.rule in self._policy.rules and one.code == self._policy.rules[one.rule].code
        )

    def _gate(self, pair: tuple[str, str]) -> Gate:
        if pair not in self._gates:
            was = self._policy.gates[pair]
            rules = _speaking(self.applying(pair))
            self._gates[pair] = make_gate(was.capability, was.profile, rules, was.site, self._vocabulary)
        return self._gates[pair]


def _speaking(rules: Iterable[Rule]) -> list[Rule]:
    return [
        rule if rule.then is not Effect.MODIFY else replace(rule, then=Effect.ESCALATE, settings=()) for rule in rules
    ]


__all__ = ["Bound", "Habits", "Question", "Tally", "read_habits"]
