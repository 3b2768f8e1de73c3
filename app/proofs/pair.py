"""The decision about one (capability, profile) as formulas: what `policy_code` compiles, compiled for Z3.

A `Pass` is one run over the rules, for the proposal's own parameters or for others; a `Pair` is the guard's whole
verdict, the second looks of `settling` and `fitting` included. Every rule's condition is a named variable, so that a
question about a thousand rules stays as long as the rules are, not as their square.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import z3

from app.governance.expression_tree import BOOL, STRING, references
from app.governance.fitting import coupled, filled
from app.governance.places import names
from app.governance.policy_code import limit_for
from app.governance.policy_model import Effect
from app.governance.settling import parameters_behind
from app.governance.vocabulary import properties
from app.proofs.encoding import Slot, encode
from app.proofs.formulas import Formula, both, either, no, same, some, term
from app.proofs.schema import Given, admitted
from app.proofs.values import MOST_CASES, NotCoveredError, Value, choice, lift, truth

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from app.governance.policy import Gate
    from app.governance.policy_model import Limit, Rule, Setting
    from app.governance.vocabulary import Vocabulary
    from app.proofs.encoding import Record, Scope
    from app.proofs.space import Space


@dataclass(frozen=True, slots=True)
class Bound:
    """A bound on one number, and where it holds; `rule` is the rule's id, or the limit's."""

    value: float
    rule: str
    fires: Formula


@dataclass(slots=True)
class Held:
    """Everything that may hold one number: from above in rising order, from below in falling order."""

    name: str
    slot: Slot
    minimum: float
    maximum: float
    limit: Limit | None
    uppers: list[Bound] = field(default_factory=list[Bound])
    lowers: list[Bound] = field(default_factory=list[Bound])
    tight: list[tuple[float, Formula]] = field(default_factory=list["tuple[float, Formula]"])  # some upper ≤ this fires
    steep: list[tuple[float, Formula]] = field(default_factory=list["tuple[float, Formula]"])  # some lower ≥ this fires

    @property
    def ceiling(self) -> float:
        """Return the highest that is ever left."""
        return self.maximum if self.limit is None else min(self.maximum, self.limit.maximum)

    def below(self, value: float) -> Formula:
        """Return where something lower than this holds it from above."""
        return self.ceiling < value or some([fires for bound, fires in self.tight if bound < value][-1:])

    def above(self, value: float) -> Formula:
        """Return where a rule higher than this holds it from below."""
        return some([fires for bound, fires in self.steep if bound > value][-1:])


@dataclass(frozen=True, slots=True)
class Named:
    """A rule that sets a name: where it does, and to which."""

    rule: str
    names: tuple[tuple[Formula, str], ...]


class Pass:
    """One run over the rules of a pair."""

    def __init__(self, pair: Pair, params: Record, before: Pass | None = None) -> None:
        """Encode every rule; what reads nothing that differs from the pass before is taken over from it."""
        self.pair, self.params = pair, params
        self._scope, self.broken = pair.space.scope(pair.gate.profile, params)
        self.fires: dict[str, Formula] = {}
        self.errors: dict[str, Formula] = {}
        self.held = {name: pair.holder(name, spec, params) for name, spec in pair.numbers.items()}
        self.named: dict[str, list[Named]] = {}
        for rule in pair.rules:
            self._rule(rule, before)
        for held in self.held.values():
            self._order(held)
        self.clashes = {name: self._clash(found) for name, found in self.named.items()}
        self.empty = {name: self._empty(held) for name, held in self.held.items()}
        self.changed = {name: self._moved(held) for name, held in self.held.items()}
        self.changed |= {name: self._renamed(name, found) for name, found in self.named.items()}
        self.failed: Formula = pair.name("failed", some(self.errors.values()))
        self.conflict: Formula = pair.name("conflict", some((*self.empty.values(), *self.clashes.values())))
        self.refused: Formula = pair.name("refused", self._by(Effect.DENY))
        self.denied: Formula = pair.name("denied", some((self.refused, self.failed, self.conflict, pair.lost)))
        self.asked: Formula = pair.name("asked", self._by(Effect.ESCALATE))
        self.lost: Formula = pair.lost

    def _by(self, effect: Effect) -> Formula:
        return some(self.fires[rule.id] for rule in self.pair.rules if rule.then is effect)

    # Rules -----------------------------------------------------------------------------------------------------------

    def _rule(self, rule: Rule, before: Pass | None) -> None:
        pair = self.pair
        if before is not None and rule.id in before.fires and not (pair.reads[rule.id] & pair.changing):
            self.fires[rule.id], self.errors[rule.id] = before.fires[rule.id], before.errors[rule.id]
        else:
            condition = truth(True) if rule.when is None else self.value(rule.when, BOOL, rule)
            self.fires[rule.id] = pair.name(f"fires {rule.id}", condition.holds)
            self.errors[rule.id] = condition.error
        if rule.then is Effect.MODIFY:
            for setting in pair.settings(rule):
                self._setting(rule, setting)

    def value(self, source: str, expect: object, rule: Rule | None = None) -> Value:
        """Return what a condition comes to; one that cannot be reasoned about may be anything, an error included."""
        typed = self.pair.vocabulary.typed(source, self.pair.gate.capability.name, expect)  # pyright: ignore[reportArgumentType]
        try:
            found = encode(typed, self._scope, self.pair.space.theory)
        except NotCoveredError as why:
            if rule is None:
                raise
            self.pair.uncovered[rule.id] = str(why)
            return truth(z3.FreshBool("open"), z3.FreshBool("open"))
        heads = {path.partition(".")[0] for path in references(typed)}
        lost = self.pair.name("lost", some(self.broken[head] for head in heads if head in self.broken))
        self.pair.lost = either(self.pair.lost, lost)
        return found

    def _setting(self, rule: Rule, setting: Setting) -> None:
        fires, name = self.fires[rule.id], setting.param
        if setting.to is not None:
            value = self.value(setting.to, STRING, rule)
            known = self.pair.nameable(name)
            found = [(both(fires, guard), chosen) for guard, chosen in _spelled(value, known)]
            fails = both(fires, either(value.error, no(some(guard for guard, _ in found))))
            self.errors[rule.id] = either(self.errors[rule.id], fails)
            self.named.setdefault(name, []).append(Named(rule.id, tuple(found)))
            return
        held = self.held[name]
        if setting.maximum is not None:
            held.uppers.append(Bound(setting.maximum, rule.id, fires))
        if setting.minimum is not None:
            held.lowers.append(Bound(setting.minimum, rule.id, fires))

    # Combining -------------------------------------------------------------------------------------------------------

    def _order(self, held: Held) -> None:
        held.uppers.sort(key=lambda bound: bound.value)
        held.lowers.sort(key=lambda bound: -bound.value)
        held.tight, held.steep = self._heap(held.name, held.uppers), self._heap(held.name, held.lowers)

    def _heap(self, name: str, bounds: Sequence[Bound]) -> list[tuple[float, Formula]]:
        """Return for each bound, strictest first, where it or a stricter one fires."""
        found: list[tuple[float, Formula]] = []
        so_far: Formula = False
        for index, bound in enumerate(bounds):
            so_far = either(so_far, bound.fires)
            if index + 1 == len(bounds) or bounds[index + 1].value != bound.value:
                so_far = self.pair.name(f"held {name}", so_far)
                found.append((bound.value, so_far))
        return found

    def _empty(self, held: Held) -> Formula:
        """Return where what must be at least so much must be less as well."""
        if not held.uppers and not held.lowers:
            return False
        lowest = held.below(held.minimum)
        return either(lowest, *(both(bound.fires, held.below(bound.value)) for bound in held.lowers))

    def _clash(self, found: Sequence[Named]) -> Formula:
        """Return where two rules set different names."""
        wanted = self.wanted(found)
        clashes: list[Formula] = []
        so_far: Formula = False
        for fires in wanted.values():
            clashes.append(both(so_far, fires))
            so_far = either(so_far, fires)
        return some(clashes)

    @staticmethod
    def wanted(found: Sequence[Named]) -> dict[str, Formula]:
        """Return where some rule sets which name."""
        wanted: dict[str, list[Formula]] = {}
        for named in found:
            for guard, name in named.names:
                wanted.setdefault(name, []).append(guard)
        return {name: some(guards) for name, guards in wanted.items()}

    def _moved(self, held: Held) -> Formula:
        parts: list[Formula] = []
        if held.limit is not None:
            parts.append(self.compare("greater", held.slot.value, held.limit.maximum))
        for value, fires in held.tight:
            parts.append(both(fires, self.compare("greater", held.slot.value, value)))
        for value, fires in held.steep:
            parts.append(both(fires, self.compare("less", held.slot.value, value)))
        return self.pair.name(f"changed {held.name}", some(parts))

    def _renamed(self, name: str, found: Sequence[Named]) -> Formula:
        slot = self.params[name]
        is_it = {payload: both(slot.present, guard) for guard, payload in slot.value.cases}
        parts = [both(fires, no(is_it.get(wanted, False))) for wanted, fires in self.wanted(found).items()]
        return self.pair.name(f"changed {name}", some(parts))

    def compare(self, overload: str, value: Value, bound: float) -> Formula:
        """Compare a number with a bound."""
        theory = self.pair.space.theory
        return some(both(guard, theory.compare(overload, payload, float(bound))) for guard, payload in value.cases)

    # What is left of the parameters ----------------------------------------------------------------------------------

    def effective(self) -> dict[str, Slot]:
        """Return the parameters as policy leaves them; meant where nothing denies."""
        left = dict(self.params)
        for name, held in self.held.items():
            if held.limit is not None or held.uppers or held.lowers:
                left[name] = Slot(held.slot.present, self._clamped(held))
        for name, found in self.named.items():
            slot, wanted = self.params[name], self.wanted(found)
            free = no(some(wanted.values()))
            cases = [*((fires, chosen) for chosen, fires in wanted.items())]
            kept = [(both(free, guard), payload) for guard, payload in slot.value.cases]
            left[name] = Slot(either(slot.present, some(wanted.values())), choice([*cases, *kept]))
        return left

    def _clamped(self, held: Held) -> Value:
        options: list[tuple[Formula, float]] = []
        free: Formula = True
        for value, fires in held.tight:
            if value < held.ceiling:
                options.append((both(free, fires, self.compare("greater", held.slot.value, value)), value))
                free = both(free, no(fires))
        over = self.compare("greater", held.slot.value, held.ceiling)
        options.append((both(free, over), held.ceiling))
        free = True
        for value, fires in held.steep:
            options.append((both(free, fires, self.compare("less", held.slot.value, value)), value))
            free = both(free, no(fires))
        named = [(self.pair.name(f"left {held.name}", guard), float(value)) for guard, value in options]
        kept = no(some(guard for guard, _ in named))
        cases = [*named, *((both(kept, guard), payload) for guard, payload in held.slot.value.cases)]
        if len(cases) <= MOST_CASES // 4:
            return choice(cases)
        left = z3.FreshReal(f"left {held.name}")
        self.pair.facts += [
            z3.Implies(term(guard), left == lift(payload)) for guard, payload in cases if guard is not False
        ]
        return Value(((True, left),))


def _spelled(value: Value, known: Iterable[str]) -> list[tuple[Formula, str]]:
    """Return which of the known names a text is; where it is none of them, nothing is returned."""
    found: list[tuple[Formula, str]] = []
    names_ = sorted(known)
    for guard, payload in value.cases:
        if isinstance(payload, z3.SeqRef):
            found += [(both(no(value.error), guard, cast("Formula", payload == name)), name) for name in names_]
        elif payload in names_:
            found.append((both(no(value.error), guard), cast("str", payload)))
    return found


class Pair:
    """The guard's verdict about one (capability, profile), as formulas.

    Attributes:
        first: The run over the proposal's own parameters.
        second: The run over what the first one left of them.
        unsettled: Where the second run would have changed or refused it once more.
        unfit: Where the input schema does not take what the first one left of them.
        facts: What the names in these formulas stand for.
        uncovered: Rules that proofs cannot reason about, and why.
        lost: Where looking up what the rules read fails, so that the guard as a whole denies.
    """

    def __init__(
        self,
        space: Space,
        gate: Gate,
        rules: Iterable[Rule],
        vocabulary: Vocabulary,
        beside: Pair | None = None,
    ) -> None:
        """Encode the rules that apply to the pair; what a pair beside it has a name for goes by that name here too."""
        self.space, self.gate, self.vocabulary = space, gate, vocabulary
        self.names: dict[int, tuple[Formula, Formula]] = {} if beside is None else dict(beside.names)
        declared = properties(gate.capability)
        self.rules = [rule for rule in rules if rule.then is not Effect.MODIFY or self.settings(rule)]
        self.numbers = {name: spec for name, spec in declared.items() if spec.get("type") in ("number", "integer")}
        self.facts: list[z3.BoolRef] = []
        self.uncovered: dict[str, str] = {}
        self.lost: Formula = False
        paths = {rule.id: self._paths(rule) for rule in self.rules}
        self.paths = frozenset[str]().union(*paths.values())
        self.reads = {rule: parameters_behind(read, gate.capability) for rule, read in paths.items()}
        limited = {name for name, spec in self.numbers.items() if limit_for(spec, gate.profile.limits) is not None}
        self.changing = limited | {setting.param for rule in self.rules for setting in self.settings(rule)}
        self.interferes = any(read & self.changing for read in self.reads.values())
        self.first = Pass(self, space.params)
        self.second = Pass(self, self.first.effective(), self.first)
        self.changes = self.name("changes", both(no(self.first.denied), some(self.first.changed.values())))
        restless = either(
            some(self.second.changed.values()),
            self.second.denied,
            both(self.second.asked, no(self.first.asked)),
        )
        self.restless = self.name("restless", both(self.changes, restless))
        self.unsettled = self.restless if self.interferes else False
        inputs = gate.capability.inputs
        self.unfit = self._unfit() if coupled(inputs) & self.changing or filled(inputs) else False

    def _unfit(self) -> Formula:
        """Return where what policy or a default made of it is no proposal of this capability.

        Of keywords not known here, it may be.
        """
        left = self.second.params
        given = Given(
            {name: slot.present for name, slot in left.items()},
            {name: slot.value for name, slot in left.items()},
            self.space.theory,
        )
        kept, known = admitted(self.gate.capability.inputs, given)
        refused = no(kept) if known else either(no(kept), z3.FreshBool("open"))
        made = no(self.first.denied) if filled(self.gate.capability.inputs) else self.changes
        return self.name("unfit", both(made, refused))

    def settings(self, rule: Rule) -> list[Setting]:
        """Return what a rule sets here."""
        return [setting for setting in rule.settings if setting.param in properties(self.gate.capability)]

    def _paths(self, rule: Rule) -> set[str]:
        """Return what a rule reads."""
        read: set[str] = set()
        sources = [(rule.when, BOOL), *((setting.to, STRING) for setting in self.settings(rule))]
        for source, expect in sources:
            if source is not None:
                read |= references(self.vocabulary.typed(source, self.gate.capability.name, expect)).keys()
        return read

    def holder(self, name: str, spec: Mapping[str, object], params: Record) -> Held:
        """Return what may hold a number, before the rules have been asked."""
        low, high = (
            cast("float", spec.get(key, default)) for key, default in (("minimum", -1e308), ("maximum", 1e308))
        )
        limit = limit_for(cast("Mapping[str, bool]", spec), self.gate.profile.limits)
        return Held(name, params[name], float(low), float(high), limit)

    def nameable(self, param: str) -> frozenset[str]:
        """Return what a named parameter may be set to."""
        spec = properties(self.gate.capability)[param]
        if "enum" in spec:
            return frozenset(cast("list[str]", spec["enum"]))
        return names(self.gate.site)[str(spec["x-ref"])]

    def name(self, name: str, formula: Formula) -> Formula:
        """Give a formula a name; questions then speak of the name."""
        if isinstance(formula, bool) or formula.num_args() == 0:
            return formula
        known = self.names.get(formula.get_id())
        if known is not None:
            return known[1]
        named = z3.FreshBool(name)
        self.facts.append(cast("z3.BoolRef", same(named, formula)))
        self.names[formula.get_id()] = (formula, named)  # an id is good only as long as its formula lives
        return named

    # The verdict -----------------------------------------------------------------------------------------------------

    @property
    def denied(self) -> Formula:
        """Return where the guard denies."""
        return either(self.first.denied, self.unsettled, self.unfit)

    @property
    def escalated(self) -> Formula:
        """Return where the guard escalates."""
        return both(no(self.denied), self.first.asked)

    @property
    def modified(self) -> Formula:
        """Return where the guard modifies."""
        return both(no(self.denied), no(self.first.asked), some(self.first.changed.values()))

    @property
    def allowed(self) -> Formula:
        """Return where the guard allows the proposal as it is."""
        return both(no(self.denied), no(self.first.asked), no(some(self.first.changed.values())))

    def scope(self, run: Pass) -> Scope:
        """Return what conditions see of a run's parameters."""
        return self.space.scope(self.gate.profile, run.params)[0]

    def everything(self) -> list[z3.BoolRef]:
        """Return every fact there is: about the terms, the proposal and its context, and the names given here."""
        said = [fact for path, fact in self.space.said.items() if path in self.paths]
        facts = [*self.space.theory.facts, *self.space.facts, *said, *self.facts]
        return [term(fact) for fact in facts if fact is not True]


__all__ = ["Bound", "Held", "Named", "Pair", "Pass"]
