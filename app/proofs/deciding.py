"""Dead and shadowed rules: does a rule ever determine an outcome?

A rule is *dead* where its condition never holds, and *shadowed* where it holds, but others always decide: something at
least as strict, or stricter, at the same time. A rule that says exactly what one of another owner says is neither (a
profile may restate what the organization demands); said twice in one file, the later one is shadowed.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import z3

from app.governance.expression_tree import BOOL, STRING
from app.governance.model import PolicyOutcome
from app.governance.policy_model import Effect
from app.proofs.asking import Undecided
from app.proofs.formulas import Formula, both, either, no, some

if TYPE_CHECKING:
    from collections.abc import Iterator

    from app.governance.policy_model import Rule
    from app.proofs.obligations import Court
    from app.proofs.pair import Pair
    from app.proofs.witness import Case, Seen


@dataclass(frozen=True, slots=True)
class Fate:
    """What becomes of a rule in one pair: `alive`, `shadowed`, `dead`, `undecided`, `unconfirmed` by the real code."""

    rule: str
    capability: str
    profile: str
    state: str
    case: Case | None = None


def fates(court: Court) -> Iterator[Fate]:
    """Yield what becomes of every rule here."""
    deciding = Deciding(court)
    for rule in court.pair.rules:
        yield deciding.fate(rule)


class Deciding:
    """Says whether a rule determines outcomes: whether some proposal would come out otherwise without it."""

    def __init__(self, court: Court) -> None:
        """Chain up which other rules deny or escalate, so that each question stays short."""
        self.court, self.pair = court, court.pair
        self._place = {rule.id: index for index, rule in enumerate(self.pair.rules)}
        self._twins = self._same()
        self._chains: dict[tuple[Effect, int], _Chain] = {}

    def _same(self) -> dict[str, list[str]]:
        """Return for each rule the others that say exactly the same here."""
        name = self.pair.gate.capability.name
        groups: dict[object, list[str]] = {}
        for rule in self.pair.rules:
            typed = None if rule.when is None else self.pair.vocabulary.typed(rule.when, name, BOOL)
            settings = tuple(
                (s.param, s.minimum, s.maximum, s.to and repr(self.pair.vocabulary.typed(s.to, name, STRING)))
                for s in self.pair.settings(rule)
            )
            groups.setdefault((rule.then, rule.approvers, repr(typed), settings), []).append(rule.id)
        return {one: [other for other in group if other != one] for group in groups.values() for one in group}

    def _weak(self, rule: Rule) -> frozenset[str]:
        """Return the twins that take nothing from a rule: those of another owner, and later ones of its own."""
        owner = rule.id.partition("/")[0]
        return frozenset(
            twin
            for twin in self._twins[rule.id]
            if twin.partition("/")[0] != owner or self._place[twin] > self._place[rule.id]
        )

    def fate(self, rule: Rule) -> Fate:
        """Ask what becomes of a rule."""
        court, pair = self.court, self.pair
        here = (rule.id, pair.gate.capability.name, pair.gate.profile.name)
        if rule.id in pair.uncovered:
            return Fate(*here, "undecided")
        again = both(pair.second.fires[rule.id], pair.unsettled)  # it may hold of nothing but what others make of it
        found = court.solve(either(self._decisive(rule, self._weak(rule)), again))
        if isinstance(found, z3.ModelRef):
            case = court.confirmed(found, lambda seen: _determines(rule, seen), small=False)
            missed = "undecided" if pair.space.approximate else "unconfirmed"
            return Fate(*here, missed if case is None else "alive", case)
        if isinstance(found, Undecided):
            return Fate(*here, "undecided")
        fired = court.solve(pair.first.fires[rule.id], no(pair.lost))
        if not isinstance(fired, z3.ModelRef):
            return Fate(*here, "undecided" if isinstance(fired, Undecided) else "dead")
        return Fate(*here, "shadowed", court.confirmed(fired, lambda _: True))

    def _decisive(self, rule: Rule, weak: frozenset[str]) -> Formula:
        pair, run = self.pair, self.pair.first
        fires = run.fires[rule.id]
        match rule.then:
            case Effect.DENY:
                others = self._others(rule, weak, Effect.DENY, 0)
                return both(fires, no(others), no(run.failed), no(run.conflict), no(pair.lost))
            case Effect.ESCALATE:
                asks = max(rule.approvers, 1)
                return both(fires, no(self._others(rule, weak, Effect.ESCALATE, asks)), no(run.denied))
            case _:
                held = some(self._holds(rule, param, weak) for param in {s.param for s in pair.settings(rule)})
                free = both(no(run.refused), no(run.failed), no(pair.lost))
                return both(fires, free, either(both(no(run.conflict), held), self._apart(rule)))

    def _apart(self, rule: Rule) -> Formula:
        """Return where a rule is one of those that leave nothing."""
        run, parts = self.pair.first, list[Formula]()
        for setting in self.pair.settings(rule):
            if setting.to is not None:
                parts.append(run.clashes[setting.param])
            elif (held := run.held[setting.param]) and setting.maximum is not None:
                parts.append(setting.maximum < held.minimum or held.above(setting.maximum))
            if setting.minimum is not None:
                parts.append(run.held[setting.param].below(setting.minimum))
        return some(parts)

    def _others(self, rule: Rule, weak: frozenset[str], effect: Effect, asks: int) -> Formula:
        """Return where another rule has the effect, and asks for as many people."""
        if (effect, asks) not in self._chains:
            rules = [r.id for r in self.pair.rules if r.then is effect and max(r.approvers, 1) >= asks]
            self._chains[effect, asks] = _Chain(self.pair, rules)
        return self._chains[effect, asks].without({rule.id, *weak})

    def _holds(self, rule: Rule, param: str, weak: frozenset[str]) -> Formula:
        """Return where nothing holds a parameter as much as this rule does."""
        run = self.pair.first
        parts: list[Formula] = []
        for setting in rule.settings:
            if setting.param != param:
                continue
            if setting.to is not None:
                parts.append(self._names(rule, param, weak))
                continue
            held = run.held[param]
            for bound, side in ((setting.maximum, held.uppers), (setting.minimum, held.lowers)):
                if bound is None:
                    continue
                ties = some(b.fires for b in side if b.value == bound and b.rule != rule.id and b.rule not in weak)
                if side is held.uppers:
                    past, stricter = run.compare("greater", held.slot.value, bound), held.below(bound)
                    tied = ties if held.ceiling > bound else True
                else:
                    past, stricter = run.compare("less", held.slot.value, bound), held.above(bound)
                    tied = ties if held.minimum < bound else True
                parts.append(both(past, no(stricter), no(tied)))
        return some(parts)

    def _names(self, rule: Rule, param: str, weak: frozenset[str]) -> Formula:
        run = self.pair.first
        slot = run.params[param]
        is_it = {payload: both(slot.present, guard) for guard, payload in slot.value.cases}
        (own,) = (named for named in run.named[param] if named.rule == rule.id)
        others = [n for n in run.named[param] if n.rule != rule.id and n.rule not in weak]
        parts: list[Formula] = []
        for guard, name in own.names:
            same = some(other for named in others for other, wanted in named.names if wanted == name)
            parts.append(both(guard, no(is_it.get(name, False)), no(same)))
        return some(parts)


class _Chain:
    """Rules in a row: where any but a few of them fires, in a formula that does not grow with the row."""

    def __init__(self, pair: Pair, rules: list[str]) -> None:
        self._place = {rule: index for index, rule in enumerate(rules)}
        self._fires = [pair.first.fires[rule] for rule in rules]
        self._before: list[Formula] = [False]
        self._after: list[Formula] = [False]
        for fires in self._fires:
            self._before.append(pair.name("before", either(self._before[-1], fires)))
        for fires in reversed(self._fires):
            self._after.append(pair.name("after", either(self._after[-1], fires)))
        self._after.reverse()

    def without(self, rules: set[str]) -> Formula:
        """Return where a rule fires that is none of these."""
        left_out = sorted(self._place[rule] for rule in rules)
        inner = [self._fires[low + 1 : high] for low, high in pairwise(left_out)]
        return some((self._before[left_out[0]], self._after[left_out[-1] + 1], *(some(part) for part in inner)))


def _determines(rule: Rule, seen: Seen) -> bool:
    """Say whether the real verdict names a rule among those that determine it."""
    verdict = seen.decision.verdict
    if verdict is None:
        return False
    if rule.then is Effect.MODIFY and "empty_intersection" in {reason.code for reason in verdict.reasons}:
        return True  # the reason names one of the two rules only
    if rule.id not in {reason.rule for reason in verdict.reasons}:
        return False
    match rule.then:
        case Effect.DENY:
            return verdict.outcome is PolicyOutcome.DENY
        case Effect.ESCALATE:
            return verdict.outcome in (PolicyOutcome.ESCALATE, PolicyOutcome.DENY)  # what is unsettled is denied
        case _:
            return bool(verdict.changes) or verdict.outcome is PolicyOutcome.DENY
