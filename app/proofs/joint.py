"""One (capability, profile) under two policies at once: where the two decide otherwise about the same proposal.

Both verdicts are formulas over the same proposal and context. Compared is what both admit; what only one of them would
(a name, an agent, a value of a parameter that the other does not know) is a difference of parts (`standing`). A rule
that both have is encoded once under one name, so that what is left of the question is what really differs.

| change | goes |
|---|---|
| deny → approve, deny → allow, approve → allow | loosens |
| the other way round | tightens |
| what is launched is nearer to what was asked for, or further from it | looser, tighter |
| it is held to the other side of it, or to another name | loosens: nobody can say |
| fewer people approve, or more | loosens, tightens |
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import z3

from app.governance.admission import ACCEPT
from app.governance.authority import need
from app.governance.changes import LOOSENS, TIGHTENS
from app.governance.model import Status
from app.governance.vocabulary import always_there, properties
from app.proofs.asking import Asking, Undecided
from app.proofs.formulas import Formula, both, either, every, no, same, some
from app.proofs.promises import at_least, people, statuses
from app.proofs.space import Options
from app.proofs.values import Items, lift
from app.proofs.witness import confirm_by, decided, read, shrink_by

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from app.governance.changes import Direction
    from app.governance.policy import PolicySet
    from app.proofs.asking import Budget
    from app.proofs.encoding import Slot
    from app.proofs.pair import Pair
    from app.proofs.space import Space
    from app.proofs.witness import Case, Seen

DENY, APPROVE, ALLOW = "deny", "approve", "allow"
_STATUS: Final[Mapping[str, str]] = {DENY: "denied", APPROVE: "awaiting_approval", ALLOW: "allowed"}
_WIDENS: Final = (DENY, APPROVE, ALLOW)


class Told(NamedTuple):
    """What really becomes of a case under one policy, whatever keeps it waiting at the moment."""

    what: str
    effective: Mapping[str, Any]
    approvers: int


@dataclass(frozen=True, slots=True)
class Question:
    """One way in which decisions may differ: where that is, and whether two real decisions show it."""

    change: str
    direction: Direction
    where: Formula
    shown: Callable[[Told, Told, Mapping[str, Any]], bool]
    left_out: str = ""  # a parameter that has to be left to its default


class Joint:
    """Two pairs, and the questions about them."""

    def __init__(self, policies: tuple[PolicySet, PolicySet], pairs: tuple[Pair, Pair], budget: Budget) -> None:
        """Take the pair under the old policy, and under the new one beside it."""
        self.policies, (self.old, self.new) = policies, pairs
        self._link = [*_same_proposal(self.old.space, self.new.space), self._modes()]
        self._found = tuple(statuses(pair) for pair in pairs)
        self.asking = Asking(budget, lambda: [fact for pair in pairs for fact in pair.everything()])

    @property
    def uncovered(self) -> dict[str, str]:
        """Return the rules of either that proofs cannot reason about, and why."""
        return {**self.old.uncovered, **self.new.uncovered}

    @property
    def approximate(self) -> bool:
        """Say whether a solution may be none for the real code."""
        return self.old.space.approximate or self.new.space.approximate

    def _modes(self) -> Formula:
        admitted = self.old.gate.profile.admits & self.new.gate.profile.admits
        return self.old.space.modes.where([mode.value for mode in admitted])

    def _what(self, before: str, after: str) -> Formula:
        old, new = self._found
        return both(old[_STATUS[before]], new[_STATUS[after]])

    # The questions ---------------------------------------------------------------------------------------------------

    def questions(self) -> Iterator[Question]:
        """Yield every way in which the two may differ."""
        for before, after in product(_WIDENS, _WIDENS):
            if before != after:
                wider = _WIDENS.index(after) > _WIDENS.index(before)
                yield Question(
                    f"{before} -> {after}",
                    LOOSENS if wider else TIGHTENS,
                    self._what(before, after),
                    lambda old, new, _params, before=before, after=after: (old.what, new.what) == (before, after),
                )
        for name in sorted(self.old.space.params.keys() & self.new.space.params.keys()):
            yield from self._values(name)
        yield from self._quorum()
        yield from self._defaults()

    def _launched(self) -> Formula:
        """Return where something would be launched under both, at once or when people approve."""
        return every(no(found["denied"]) for found in self._found)

    def _values(self, name: str) -> Iterator[Question]:
        asked = self.old.space.params[name]
        old, new = self.old.second.params[name], self.new.second.params[name]
        if name not in self.old.numbers or name not in self.new.numbers:
            yield from self._names(name, asked, old, new)
            return
        less, more = self._order(new, old), self._order(old, new)
        (old_low, old_high), (new_low, new_high) = (self._side(asked, found) for found in (old, new))
        from_above, from_below = both(no(old_high), no(new_high)), both(no(old_low), no(new_low))
        goes = both(self._launched(), asked.present)
        yield Question(
            f"looser {name}", LOOSENS, both(goes, either(both(from_above, more), both(from_below, less))),
            lambda a, b, params: _nearer(a, b, name, params),
        )  # fmt: skip
        yield Question(
            f"tighter {name}", TIGHTENS, both(goes, either(both(from_above, less), both(from_below, more))),
            lambda a, b, params: _nearer(b, a, name, params),
        )  # fmt: skip
        yield Question(
            f"another {name}", LOOSENS, both(goes, either(both(old_low, new_high), both(old_high, new_low))),
            lambda a, b, _params: _goes(a, b) and a.effective.get(name) != b.effective.get(name),
        )  # fmt: skip

    def _order(self, one: Slot, other: Slot) -> Formula:
        """Return where one number is less than the other."""
        theory = self.old.space.theory
        return some(
            both(here, there, theory.compare("less", low, high))
            for (here, low), (there, high) in product(one.value.cases, other.value.cases)
        )

    def _side(self, asked: Slot, found: Slot) -> tuple[Formula, Formula]:
        """Return where a number was lowered, and where it was raised."""
        return self._order(found, asked), self._order(asked, found)

    def _names(self, name: str, asked: Slot, old: Slot, new: Slot) -> Iterator[Question]:
        if name not in self.old.first.named and name not in self.new.first.named:
            return
        differs = both(self._launched(), no(_alike(old, new)))
        kept, keeps = _alike(asked, old), _alike(asked, new)

        def shown(a: Told, b: Told, params: Mapping[str, Any], left: bool, leaves: bool) -> bool:
            mine, theirs = a.effective.get(name), b.effective.get(name)
            wanted = params.get(name)
            return _goes(a, b) and mine != theirs and ((mine == wanted), (theirs == wanted)) == (left, leaves)

        for change, direction, left, leaves in (
            (f"looser {name}", LOOSENS, False, True),
            (f"tighter {name}", TIGHTENS, True, False),
            (f"another {name}", LOOSENS, False, False),
        ):
            where = both(differs, kept if left else no(kept), keeps if leaves else no(keeps))
            yield Question(
                change, direction, where,
                lambda a, b, params, left=left, leaves=leaves: shown(a, b, params, left, leaves),
            )  # fmt: skip

    def _quorum(self) -> Iterator[Question]:
        counts = sorted({rule.approvers for pair in (self.old, self.new) for rule in pair.rules}
                        | {people(pair.gate) for pair in (self.old, self.new)})  # fmt: skip
        waits = self._what(APPROVE, APPROVE)
        for change, direction, one, other in (
            ("fewer approvers", LOOSENS, self.old, self.new),
            ("more approvers", TIGHTENS, self.new, self.old),
        ):
            where = some(both(at_least(one, count), no(at_least(other, count))) for count in counts if count > 1)
            yield Question(
                change, direction, both(waits, where),
                lambda a, b, _params, fewer=direction is LOOSENS: (
                    (a.what, b.what) == (APPROVE, APPROVE)
                    and (a.approvers > b.approvers if fewer else a.approvers < b.approvers)
                ),
            )  # fmt: skip

    def _defaults(self) -> Iterator[Question]:
        """A parameter that is left out may come to another value: what is launched is then another."""
        old, new = (properties(pair.gate.capability) for pair in (self.old, self.new))
        for name in sorted(old.keys() & new.keys()):
            defaults = [spec[name].get("default") for spec in (old, new)]
            if defaults[0] != defaults[1]:
                where = some(both(_is(self.old.space.params[name], value), self._untouched(name)) for value in defaults)
                yield Question(
                    f"another default of {name}", LOOSENS, both(self._launched(), where),
                    lambda a, b, _params: a.what != b.what or (_goes(a, b) and dict(a.effective) != dict(b.effective)),
                    left_out=name,
                )  # fmt: skip

    def _untouched(self, name: str) -> Formula:
        return every(no(pair.first.changed.get(name, False)) for pair in (self.old, self.new))

    # Answers ---------------------------------------------------------------------------------------------------------

    def ask(self, where: Formula) -> z3.ModelRef | Undecided | None:
        """Ask where this holds; of the solutions, prefer one in an idle, ready cell that neither rounds nor is open."""
        found = self.asking.ask(where, *self._link)
        if not isinstance(found, z3.ModelRef):
            return found
        ready = [pair.space.ready() for pair in (self.old, self.new)]
        plain = [part for pair in (self.old, self.new) for part in pair.space.plain()] if self.approximate else []
        for further in ([*ready, *plain], ready, plain):
            better = self.asking.ask(where, *self._link, *further) if further else None
            if isinstance(better, z3.ModelRef):
                return better
        return found

    def confirmed(self, model: z3.ModelRef, question: Question) -> Case | None:
        """Return the smallest case for which the real code under both policies shows what the model says."""
        case = read(self.old.space, self.old.gate.profile.name, model)
        known = self.new.space.params.keys()
        case["params"] = {name: value for name, value in case["params"].items() if name in known}
        case["params"].pop(question.left_out, None)

        def shown(candidate: Case) -> bool:
            seen = [decided(policy, candidate) for policy in self.policies]
            if seen[0] is None or seen[1] is None or question.left_out in candidate["params"]:
                return False
            old, new = (told(policy, cast("Seen", one)) for policy, one in zip(self.policies, seen, strict=True))
            return old is not None and new is not None and question.shown(old, new, seen[0].proposal.params)

        case = confirm_by(shown, case)
        return None if case is None else shrink_by(shown, case)


def told(policy: PolicySet, seen: Seen) -> Told | None:
    """Return what becomes of a case but for what keeps it waiting; None where it is rejected."""
    verdict = seen.decision.verdict
    if verdict is None:
        return None
    if seen.decision.status == Status.DENIED:
        return Told(DENY, seen.proposal.params, 0)
    wanted = seen.decision.need
    if seen.decision.status == Status.DEFERRED:
        wanted = need(policy, seen.proposal, ACCEPT, verdict, seen.context)
    return Told(ALLOW if wanted is None else APPROVE, verdict.effective, 0 if wanted is None else wanted.approvers)


def _goes(old: Told, new: Told) -> bool:
    return DENY not in (old.what, new.what)


def _nearer(one: Told, other: Told, name: str, params: Mapping[str, Any]) -> bool:
    """Say whether the other leaves a number nearer to what was asked for, on the same side of it."""
    if not _goes(one, other) or name not in params:
        return False
    far, near, asked = one.effective[name], other.effective[name], params[name]
    return far < near <= asked or asked <= near < far


def _alike(one: Slot, other: Slot) -> Formula:
    """Return where two parameters with names, or truth values, are the same: both left out, or both this."""
    if one is other:
        return True
    cases = product(one.value.cases, other.value.cases)
    equal = some(both(here, there, _equal(mine, theirs)) for (here, mine), (there, theirs) in cases)
    return either(both(no(one.present), no(other.present)), both(one.present, other.present, equal))


def _equal(one: object, other: object) -> Formula:
    if isinstance(one, z3.ExprRef) or isinstance(other, z3.ExprRef):
        mine, theirs = (lift(cast("Items", found)) for found in (one, other))
        return cast("Formula", mine == theirs)
    return one == other


# The same proposal ---------------------------------------------------------------------------------------------------


def _same_proposal(old: Space, new: Space) -> Iterator[Formula]:
    """Yield what makes one proposal and context of both spaces', as far as both know what is in it."""
    yield from _common(old.agents, new.agents)
    yield from _common(old.holding, new.holding)
    for name in sorted({*old.params, *new.params}):
        if name not in old.params or name not in new.params:
            yield _left_out(old if name in old.params else new, name)
            continue
        one, other = old.params[name], new.params[name]
        yield same(one.present, other.present)
        if one.value is not other.value:
            yield either(no(one.present), _equal_values(one, other))


def _common(old: Options, new: Options) -> Iterator[Formula]:
    """Leave out what only one of them knows."""
    known = [{name for _, name in options.options} for options in (old, new)]
    yield from (no(option) for option, name in (*old.options, *new.options) if name not in known[0] & known[1])


def _equal_values(one: Slot, other: Slot) -> Formula:
    """Return where two values are one; of names, only those that both know."""
    if all(isinstance(payload, str) for slot in (one, other) for _, payload in slot.value.cases):
        cases = [{payload: guard for guard, payload in slot.value.cases} for slot in (one, other)]
        return some(both(guard, cases[1][name]) for name, guard in cases[0].items() if name in cases[1])
    payloads = [slot.value.cases[0][1] for slot in (one, other)]
    terms = [lift(payload) for payload in payloads]
    numbers = all(z3.is_arith(found) for found in terms)
    return _equal(*terms) if numbers or terms[0].sort().eq(terms[1].sort()) else False


def _left_out(space: Space, name: str) -> Formula:
    """Return where a parameter that one schema alone knows is not given: then it has its default, or is not there."""
    slot, spec = space.params[name], properties(space.capability)[name]
    if name not in always_there(space.capability):
        return no(slot.present)
    if "default" not in spec:
        return False  # one of them asks for what the other refuses
    return _is(slot, spec["default"])


def _is(slot: Slot, value: object) -> Formula:
    """Return where a parameter is given, and this."""
    if value is None:
        return False
    return both(slot.present, some(both(guard, _equal(payload, value)) for guard, payload in slot.value.cases))


__all__ = ["Joint", "Question", "Told", "told"]
