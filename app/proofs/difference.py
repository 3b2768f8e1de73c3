"""What really changes between two policies: proved of every decision, compared of everything else.

1. Parts (`standing`): every part that is another, and which way it goes by itself. Rules go no way by themselves.
2. Decisions (`joint`): for every (capability, profile) that both enable, whether any proposal in any context comes out
   otherwise; each way in which one does is shown by the smallest case, confirmed by both real policies.
3. Ground: whether a point is forbidden that was not, or the other way round.

What is not decided, or not confirmed, is a loosening that says so: nothing is called a tightening that is not one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final, cast

import z3

from app.governance.changes import LOOSENS, TIGHTENS, Comparison, Transition, summed
from app.governance.places import inside
from app.proofs.asking import UNDECIDED, Asking, Budget, Undecided
from app.proofs.formulas import both, no, some, term
from app.proofs.ground import Coordinates, Ground
from app.proofs.joint import Joint, told
from app.proofs.pair import Pair
from app.proofs.space import FARTHEST_M, Space
from app.proofs.standing import forbidden, standing
from app.proofs.witness import decided, read, written

if TYPE_CHECKING:
    from app.governance.changes import Direction
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Rule
    from app.proofs.joint import Question, Told
    from app.proofs.witness import Case, Seen

EFFORT: Final = 20_000_000
ALL_S: Final = 120.0
Progress = Callable[[int, int, str], None]


def difference(
    old: PolicySet,
    new: PolicySet,
    *,
    now: Callable[[], float],
    effort: int = EFFORT,
    all_s: float = ALL_S,
    progress: Progress = lambda _done, _of, _what: None,
) -> Comparison:
    """Compare two policies.

    Args:
        old: The one in force.
        new: The one that may come into force.
        now: Tells the time, in seconds.
        effort: How many steps the solver may take about one question.
        all_s: How long everything may take; what is left then is undecided, and a loosening.
        progress: Called with what was done, of how much, and what comes now.
    """
    comparing = _Comparing(old, new, Budget(now, effort, now() + all_s))
    return summed(standing(old, new), tuple(comparing.run(progress)), proved=True)


class _Comparing:
    """Goes through what both policies enable, capability by capability."""

    def __init__(self, old: PolicySet, new: PolicySet, budget: Budget) -> None:
        self.old, self.new, self.budget = old, new, budget
        self.policies = (old, new)
        self.vocabularies = [found.vocabulary() for found in self.policies]

    def run(self, progress: Progress) -> Iterator[Transition]:
        """Yield everything that comes out otherwise."""
        yield from self._ground()
        pairs = [pair for pair in self.new.gates if pair in self.old.gates and self._may_differ(*pair)]
        fresh = [pair for pair in self.new.gates if pair not in self.old.gates]
        spaces: dict[str, tuple[Space, Space]] = {}
        for done, (name, profile) in enumerate(pairs):
            progress(done, len(pairs), f"{name} in {profile}")
            if name not in spaces:
                one = Space(self.old, self.old.capabilities[name])
                spaces = {name: (one, Space(self.new, self.new.capabilities[name], beside=one))}
            yield from self._pair(spaces[name], name, profile)
        progress(len(pairs), len(pairs), "")
        for name, profile in fresh:
            yield from self._enabled(name, profile)

    def _may_differ(self, name: str, profile: str) -> bool:
        """Say whether anything that is decided by is another, words aside."""
        one, other = (_decided_by(policy, name, profile) for policy in self.policies)
        return one != other

    # What decides ----------------------------------------------------------------------------------------------------

    def _pair(self, spaces: tuple[Space, Space], name: str, profile: str) -> Iterator[Transition]:
        one = Pair(spaces[0], self.old.gates[name, profile], _applying(self.old, name, profile), self.vocabularies[0])
        other = Pair(
            spaces[1], self.new.gates[name, profile], _applying(self.new, name, profile), self.vocabularies[1], one
        )
        joint = Joint(self.policies, (one, other), self.budget)
        questions = list(joint.questions())
        anything = joint.ask(some(question.where for question in questions))
        if anything is None:
            return
        for question in questions:
            answer = UNDECIDED if isinstance(anything, Undecided) else joint.ask(question.where)
            if answer is None:
                continue
            case = joint.confirmed(answer, question) if isinstance(answer, z3.ModelRef) else None
            if case is not None:
                yield self._shown(name, profile, question, case)
            elif not question.left_out:  # another default by which nothing real comes out otherwise is a part
                yield self._open(joint, question, answer)
            if isinstance(anything, Undecided):
                return  # one word on a pair is enough

    def _shown(self, name: str, profile: str, question: Question, case: Case) -> Transition:
        seen = [cast("Seen", decided(policy, case)) for policy in self.policies]
        found = [cast("Told", told(policy, one)) for policy, one in zip(self.policies, seen, strict=True)]
        rules = [sorted({reason.rule for reason in one.reasons}) for one in seen]
        sides = [_said(one, by) for one, by in zip(found, rules, strict=True)]
        message = f"`{name}` in {profile}: {question.change}: {sides[0]} before, now {sides[1]}"
        text, body = written(self.new, case, f"{question.change}: `{name}` in {profile}")
        outcomes = (_outcome(one, by) for one, by in zip(found, rules, strict=True))
        return Transition(name, profile, question.change, question.direction, True, message, text, body, *outcomes)

    def _open(self, joint: Joint, question: Question, answer: object) -> Transition:
        gate = joint.old.gate
        if isinstance(answer, Undecided):
            why = "the solver found no answer"
        elif joint.uncovered:
            why = "; ".join(
                sorted({f"`{rule}` reads {what}, which proofs do not cover" for rule, what in joint.uncovered.items()})
            )
        elif joint.approximate:
            why = "only rounding could show it"
        else:
            why = "the real code does not confirm what the solver says; report it"
        message = f"`{gate.capability.name}` in {gate.profile.name}: {question.change}: not decided ({why})"
        return Transition(gate.capability.name, gate.profile.name, question.change, LOOSENS, False, message, "", {})

    # What is newly enabled -------------------------------------------------------------------------------------------

    def _enabled(self, name: str, profile: str) -> Iterator[Transition]:
        """Show something that goes through where nothing did."""
        space = Space(self.new, self.new.capabilities[name])
        pair = Pair(space, self.new.gates[name, profile], _applying(self.new, name, profile), self.vocabularies[1])
        asking = Asking(self.budget, pair.everything)
        answer = asking.ask(no(pair.denied), space.ready(), *space.plain())
        if not isinstance(answer, z3.ModelRef):
            return  # that it is enabled is a part of its own, and a loosening
        case = read(space, profile, answer)
        seen = decided(self.new, case)
        found = None if seen is None else told(self.new, seen)
        if found is not None:
            change = f"not enabled -> {found.what}"
            text, body = written(self.new, case, f"{change}: `{name}` in {profile}")
            message = f"`{name}` in {profile}: {change}"
            yield Transition(name, profile, change, LOOSENS, True, message, text, body)

    # Ground ----------------------------------------------------------------------------------------------------------

    def _ground(self) -> Iterator[Transition]:
        """Yield whether a point is forbidden that was not, or the other way round."""
        zones = [forbidden(policy) for policy in self.policies]
        if [zone.polygon for zone in zones[0]] == [zone.polygon for zone in zones[1]]:
            return
        grounds = [Ground({}, policy.site) for policy in self.policies]
        grounds[1].answers = grounds[0].answers
        x, y = z3.Real("x"), z3.Real("y")
        here = Coordinates(((True, x, y),))
        was, becomes = (ground.forbids(here) for ground in grounds)
        far = [term(bound) for value in (x, y) for bound in (value <= FARTHEST_M, value >= -FARTHEST_M)]
        asking = Asking(self.budget, lambda: far)
        edges = [no(edge) for ground in grounds for edge in ground.edges]
        for change, direction, where in (
            ("forbidden ground -> free", LOOSENS, both(was, no(becomes))),
            ("free ground -> forbidden", TIGHTENS, both(becomes, no(was))),
        ):
            found = asking.ask(where, *edges)
            if found is None:
                found = asking.ask(where)
            if found is not None:
                yield self._point(change, direction, found, x, y)

    def _point(self, change: str, direction: Direction, found: object, *axes: z3.ArithRef) -> Transition:
        if isinstance(found, z3.ModelRef):
            values = [found.eval(axis, model_completion=True) for axis in axes]
            x, y = (float(value.as_fraction()) if isinstance(value, z3.RatNumRef) else 0.0 for value in values)
            held = [any(inside((x, y), zone.polygon) for zone in forbidden(policy)) for policy in self.policies]
            if held == [direction is LOOSENS, direction is TIGHTENS]:
                message = f"{change}: for instance at ({x:g}, {y:g})"
                return Transition("", "", change, direction, True, message, "", {})
        message = f"{change}: not decided; if at all, within a micrometre of an edge"
        return Transition("", "", change, LOOSENS, False, message, "", {})


def _applying(policy: PolicySet, name: str, profile: str) -> list[Rule]:
    return [
        rule
        for rule in policy.rules.values()
        if (rule.applies_to is None or name in rule.applies_to) and (rule.profiles is None or profile in rule.profiles)
    ]


def _decided_by(policy: PolicySet, name: str, profile: str) -> tuple[Any, ...]:
    """Return everything that a decision about a pair follows from, but for words and the order of rules."""
    package, environment = policy.capabilities[name], policy.profiles[profile]
    rules = [
        repr((rule.when, rule.then, sorted(map(repr, rule.settings)), rule.approvers))
        for rule in _applying(policy, name, profile)
    ]
    return (
        sorted(set(rules)),
        package.inputs, package.permissions, package.risk, package.recovery, package.env_profile[profile],
        environment.admits, environment.sensitivity, environment.shared_floor, environment.authority,
        environment.approval,
        {key: limit.maximum for key, limit in environment.limits.items()},
        policy.site, policy.agents, policy.permissions,
    )  # fmt: skip


def _outcome(found: Told, rules: list[str]) -> dict[str, Any]:
    values = {} if found.what == "deny" else dict(found.effective)
    return {"what": found.what, "approvers": found.approvers, "values": values, "rules": rules}


def _said(found: Told, rules: list[str]) -> str:
    """Say in a few words what became of a case, and by which rules."""
    words = {"deny": "denied", "approve": f"asks {found.approvers}", "allow": "launched"}[found.what]
    params = (
        ""
        if found.what == "deny"
        else f" with {{{', '.join(f'{key}: {value}' for key, value in found.effective.items())}}}"
    )
    return f"{words}{params}" + (f" by {', '.join(rules)}" if rules else "")


__all__ = ["ALL_S", "EFFORT", "difference"]
