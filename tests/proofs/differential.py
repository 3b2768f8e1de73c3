"""The encoding held against the real code: for one proposal after the other, both must come to the same."""

from __future__ import annotations

from fractions import Fraction
from random import Random
from typing import TYPE_CHECKING, NamedTuple

import z3

from app.governance.fitting import MISFIT
from app.governance.guard import check
from app.governance.model import PolicyOutcome
from app.governance.vocabulary import referring
from app.proofs.formulas import both, named, no, rational, some, term
from app.proofs.pair import Pair
from app.proofs.space import FLAGS, STRANGER, Space
from app.proofs.values import OVERFLOW
from app.proofs.witness import decided
from tests.proofs.random_rules import base, compiled, drawn, proposed, vocabulary

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from app.proofs.encoding import Slot
    from app.proofs.formulas import Formula


TRUE, FALSE = z3.BoolVal(True), z3.BoolVal(False)


def compare(seed: int, sets: int, proposals: int) -> tuple[int, int]:
    """Compare so many rule sets with so many proposals each; return how many were compared, and how many exactly."""
    random = Random(seed)
    compared = exactly = 0
    for _ in range(sets):
        capability, profile, rules = drawn(random)
        policy = compiled(capability, profile, rules)
        pair = Pair(
            Space(policy, policy.capabilities[capability]), policy.gates[capability, profile], rules, vocabulary()
        )
        if pair.uncovered:
            continue
        bench = Bench(pair)
        for _ in range(proposals):
            exactly += bench.compare(policy, proposed(random, capability, profile))
            compared += 1
    return compared, exactly


class Bench:
    """One rule set, encoded once.

    No search: the proposal is put in, every fact then says what its own name stands for, rounding is Python's own, and
    what comes out has to be what the real code said. That every fact holds in the end means that reality is among the
    solutions the prover goes by.
    """

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self.outcomes = {
            PolicyOutcome.DENY: pair.denied, PolicyOutcome.ESCALATE: pair.escalated, PolicyOutcome.MODIFY: pair.modified,
            PolicyOutcome.ALLOW: pair.allowed,
        }  # fmt: skip
        self.left = pair.first.effective()
        self.edge = some(pair.space.ground.edges)
        rounding = pair.space.theory.rounding()
        everything = (*pair.everything(), term(pair.space.said["agent.name"]))
        self.facts = [Fact.of(fact, rounding) for fact in everything]

    def compare(self, policy, case) -> bool:
        """Compare one case; return whether no answer was left open (near an edge either is)."""
        seen = decided(policy, case)
        assert seen is not None, case
        verdict = check(policy, seen.proposal, seen.context)
        world = World(pins(self.pair.space, case, seen.proposal.params))
        for either_way in self.pair.space.ground.open:
            world.put(either_way, z3.BoolVal(False))
        world.settle(self.facts)
        if world.true(self.edge):
            return False
        assert world.true(self._said(verdict)), (
            case,
            verdict,
            [(r.id, r.then.value, r.when, r.settings) for r in self.pair.rules],
        )
        return True

    def _said(self, verdict) -> Formula:
        """Say in formulas what the real code decided: this outcome and no other, what failed, effective parameters."""
        pair = self.pair
        failed = {reason.rule for reason in verdict.reasons if reason.code == "rule_error"}
        unsettled = any(reason.code == "unsettled" for reason in verdict.reasons)
        parts = [said if outcome is verdict.outcome else no(said) for outcome, said in self.outcomes.items()]
        if "guard" in failed:
            return both(*parts, pair.lost)
        if not unsettled:
            parts += [
                pair.first.errors[rule.id] if rule.id in failed else no(pair.first.errors[rule.id])
                for rule in pair.rules
            ]
            parts.append(no(pair.unsettled))
            parts.append(pair.unfit if any(reason.code == MISFIT for reason in verdict.reasons) else no(pair.unfit))
        else:
            parts.append(pair.unsettled)
        if verdict.outcome is not PolicyOutcome.DENY:
            parts += [_is(slot, verdict.effective.get(name)) for name, slot in self.left.items()]
        return both(*parts)


class Fact(NamedTuple):
    """A fact, taken apart once: under `premise` (None: always) it says what `name` (None: nothing) stands for.

    `near` is the number that the name is rounded to, where it is rounded.
    """

    whole: z3.BoolRef
    premise: z3.BoolRef | None = None
    name: z3.ExprRef | None = None
    meaning: z3.ExprRef | None = None
    near: z3.ExprRef | None = None

    @classmethod
    def of(cls, whole: z3.BoolRef, rounding: Mapping[int, z3.ExprRef]) -> Fact:
        """Take a fact apart."""
        premise, said = whole.children() if z3.is_implies(whole) else (None, whole)
        if not z3.is_eq(said) or not z3.is_const(said.arg(0)):
            return cls(whole)
        name, meaning = said.children()
        return cls(whole, premise, name, meaning, rounding.get(name.get_id()))


class World:
    """One assignment to every variable: the inputs given, the rest by what the facts say of it."""

    def __init__(self, given) -> None:
        self.model = z3.Model()
        self.known: set[int] = set()
        for variable, value in given:
            self.put(variable, value)

    def put(self, variable, value) -> None:
        self.model.update_value(variable, value)
        self.known.add(variable.get_id())

    def true(self, formula: Formula) -> bool:
        return formula is True or (formula is not False and self._value(formula, completed=True).eq(TRUE))

    def _value(self, formula: z3.ExprRef, *, completed: bool = False) -> z3.ExprRef:
        found = self.model.eval(formula, model_completion=completed)
        return found if found.eq(TRUE) or found.eq(FALSE) else z3.simplify(found)

    def settle(self, facts: Sequence[Fact]) -> None:
        """Let every fact define what it defines, until all hold."""
        waiting = list(facts)
        while waiting:
            left = [fact for fact in waiting if not self._holds(fact)]
            assert len(left) < len(waiting), left[:3]
            waiting = left

    def _holds(self, fact: Fact) -> bool:
        found = self._value(fact.whole)
        if found.eq(TRUE):
            return True
        assert not found.eq(FALSE), fact
        if fact.name is None or fact.name.get_id() in self.known:
            return False
        if fact.premise is not None and not self.true(fact.premise):
            return False
        value = self._value(fact.meaning)
        if not _is_value(value):
            return False
        self.put(fact.name, value)
        if fact.near is not None:
            exact = Fraction(value.numerator_as_long(), value.denominator_as_long())
            self.put(fact.near, rational(exact if abs(exact) >= OVERFLOW else float(exact)))
        return True


def _is_value(value) -> bool:
    return (
        z3.is_true(value)
        or z3.is_false(value)
        or z3.is_rational_value(value)
        or z3.is_int_value(value)
        or z3.is_string_value(value)
    )


def _is(slot: Slot, value) -> Formula:
    if value is None:
        return no(slot.present)
    if isinstance(value, bool):
        return both(slot.present, slot.value.truth if value else no(slot.value.truth))
    options = [
        both(guard, payload == (rational(value) if isinstance(value, float) else value)) if isinstance(payload, z3.ExprRef)
        else both(guard, payload == value)
        for guard, payload in slot.value.cases
    ]  # fmt: skip
    return both(slot.present, z3.Or(*(term(option) for option in options)))


def pins(space: Space, case, params) -> Iterator[tuple[z3.ExprRef, z3.ExprRef]]:
    """Yield every variable with the value that makes the proposal this one, in this context."""
    context, metadata = case["context"], case["metadata"]
    for name, slot in space.params.items():
        yield from _parameter(name, slot, params.get(name))
        given = space.given[name]
        if not isinstance(given, bool):
            yield given, z3.BoolVal(name in case["params"])
    for name, sort in (("confidence", z3.RealSort()), ("intent", z3.StringSort()), ("priority", z3.IntSort())):
        yield named(f"given metadata.{name}"), z3.BoolVal(name in metadata)
        yield z3.Const(f"metadata.{name}", sort), _constant(metadata.get(name, "" if name == "intent" else 0), sort)
    agent = STRANGER if "agent" in context else "planner"
    for options, chosen in (
        (space.modes, case["mode"]),
        (space.holding, context.get("holding")),
        (space.agents, agent),
    ):
        yield from ((option, z3.BoolVal(value == chosen)) for option, value in options.options)
    yield z3.String("agent.name"), z3.StringVal(context.get("agent", "nobody"))
    for name, held in space.held.items():
        yield held, z3.BoolVal(name in context.get("permissions", []))
    for name in FLAGS:
        yield named(f"world.{name}"), z3.BoolVal(context[name])
    yield named("operator_on_duty"), z3.BoolVal(context["operator_on_duty"])
    count, near = space.people
    yield count, z3.IntVal(context["people_count"])
    yield near, rational(context["people_nearest_m"])
    thing = params.get(referring(space.capability).get("object", ""))
    found = base().site.objects.get(thing)
    x, y = (0.0, 0.0) if found is None else context.get("at", {}).get(thing, (found.x_m, found.y_m))
    yield space.seen[0], rational(x)
    yield space.seen[1], rational(y)


def _parameter(name: str, slot: Slot, value) -> Iterator[tuple[z3.ExprRef, z3.ExprRef]]:
    for guard, payload in slot.value.cases:
        if isinstance(payload, z3.BoolRef):
            yield payload, z3.BoolVal(bool(value))
        elif isinstance(payload, z3.ExprRef):
            low = slot.value.cases[0][1].is_real()
            yield payload, rational(float(value or 0.0)) if low else z3.IntVal(value or 0)
        else:
            yield guard, z3.BoolVal(value == payload)


def _constant(value, sort) -> z3.ExprRef:
    if sort == z3.RealSort():
        return rational(float(value))
    return z3.StringVal(value) if sort == z3.StringSort() else z3.IntVal(value)
