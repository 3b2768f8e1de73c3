"""What is proved of one (capability, profile) by itself.

No contradiction, no gap, no dead rule, no error, and what policy makes of a proposal it then leaves alone.

Each question asks for a proposal that shows the fault. None is the proof; one is held against the real `admit` and
`check`, and only what they confirm is a fault of the policy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast

import z3

from app.governance.authority import answers
from app.governance.model import Status
from app.governance.policy_model import Effect
from app.proofs.asking import Asking, Undecided
from app.proofs.findings import Finding, Kind, Lines, Weight
from app.proofs.formulas import Formula, both, either, no, some
from app.proofs.witness import confirm, decided, read, shrink, written

if TYPE_CHECKING:
    from app.governance.policy import PolicySet
    from app.proofs.pair import Pair
    from app.proofs.witness import Case, Seen, Shows

MOST_EXAMPLES: Final = 8
GUARD: Final = "guard"


def never(_seen: Seen) -> bool:
    """Confirm nothing: where there is no counterexample to confirm."""
    return False


@dataclass(slots=True)
class Court:
    """One pair, the solver that knows it, and the real policy that every counterexample is held against."""

    policy: PolicySet
    pair: Pair
    asking: Asking
    lines: Lines

    @property
    def where(self) -> str:
        """Name the pair."""
        return f"`{self.pair.gate.capability.name}` in {self.pair.gate.profile.name}"

    def finding(self, kind: Kind, weight: Weight, message: str, rule: str = "", case: Case | None = None) -> Finding:
        """Write a finding down, where the rule stands, or else the capability."""
        gate = self.pair.gate
        file, line = self.lines.rule(rule) if rule else self.lines.capability(gate.capability.name)
        text, body = ("", {}) if case is None else written(self.policy, case, f"{kind.value}: {rule or self.where}")
        return Finding(
            kind=kind, weight=weight, message=message, file=file, line=line, capability=gate.capability.name,
            profile=gate.profile.name, rule=rule, example=text, body=body,
        )  # fmt: skip

    def solve(self, *parts: Formula) -> z3.ModelRef | Undecided | None:
        """Ask about modes the profile admits; of the solutions, prefer one that neither rounds nor lies on an edge."""
        asked = (self.pair.space.modes.where([mode.value for mode in self.pair.gate.profile.admits]), *parts)
        found = self.asking.ask(*asked)
        if not isinstance(found, z3.ModelRef) or not self.pair.space.approximate:
            return found
        plain = self.asking.ask(*asked, *self.pair.space.plain())
        return plain if isinstance(plain, z3.ModelRef) else found

    def confirmed(self, model: z3.ModelRef, shows: Shows, *, small: bool = True) -> Case | None:
        """Return the case a model stands for, made small, if the real code shows the same."""
        case = confirm(self.policy, read(self.pair.space, self.pair.gate.profile.name, model), shows)
        return shrink(self.policy, case, shows) if case is not None and small else case

    def judged(
        self, kind: Kind, found: z3.ModelRef | Undecided | None, message: str, shows: Shows, rule: str = ""
    ) -> Iterator[Finding]:
        """Yield what an answer means: nothing where there is no model."""
        if found is None:
            return
        if isinstance(found, Undecided):
            yield self.finding(kind, Weight.UNDECIDED, f"{message}: not decided", rule)
            return
        case = self.confirmed(found, shows)
        if case is None:
            yield self.unconfirmed(kind, message, rule)
        else:
            yield self.finding(kind, Weight.REFUTED, message, rule, case)

    def unconfirmed(self, kind: Kind, message: str, rule: str = "") -> Finding:
        """Return what it means that the real code does not show what the solver says."""
        if self.pair.space.approximate or self.pair.uncovered:
            why = "; ".join(sorted(set(self.pair.uncovered.values()))) or "only rounding could show it"
            return self.finding(kind, Weight.UNDECIDED, f"{message}: not decided ({why})", rule)
        return self.finding(kind, Weight.BUG, f"{message}: the real code does not confirm this; report it", rule)


# Contradiction -------------------------------------------------------------------------------------------------------


def contradictions(court: Court) -> Iterator[Finding]:
    """Yield where modifications leave nothing, though no rule denies: each two rules that force apart, once."""
    pair, apart = court.pair, list[Formula]()
    run = pair.first
    for _ in range(MOST_EXAMPLES):
        found = court.solve(run.conflict, no(run.refused), no(run.failed), no(pair.lost), *apart)
        if found is None:
            return
        if isinstance(found, Undecided):
            yield from court.judged(Kind.CONTRADICTION, found, f"contradiction about {court.where}", never)
            return
        fighting = _fighting(court, found)
        case = court.confirmed(found, lambda seen: _leaves_nothing(court.policy, seen))
        rules = [rule for rule, _ in fighting]
        if case is None:
            yield court.unconfirmed(Kind.CONTRADICTION, f"contradiction about {court.where}", rules[0] if rules else "")
            return
        reason = next(r for r in cast("Seen", decided(court.policy, case)).reasons if r.code == "empty_intersection")
        message = f"contradiction about {court.where}: {reason.message}"
        yield court.finding(Kind.CONTRADICTION, Weight.REFUTED, message, reason.rule, case)
        if not fighting:
            return
        apart.append(no(both(*(fires for _, fires in fighting))))


def _leaves_nothing(policy: PolicySet, seen: Seen) -> bool:
    """Say whether modifications leave nothing though nothing else denies: no rule, and none that fails."""
    empty = False
    for reason in seen.reasons:
        rule = policy.rules.get(reason.rule)
        if reason.code == "rule_error" or reason.rule == GUARD or (rule is not None and rule.then is Effect.DENY):
            return False
        empty = empty or reason.code == "empty_intersection"
    return empty


def _fighting(court: Court, model: z3.ModelRef) -> list[tuple[str, Formula]]:
    """Return the rules that force apart in a model; a limit or the schema is none."""
    run = court.pair.first

    def on(formula: Formula) -> bool:
        return formula is True or (formula is not False and z3.is_true(model.eval(formula, model_completion=True)))

    for name, empty in run.empty.items():
        if on(empty):
            held = run.held[name]
            bounds = [next((b for b in side if on(b.fires)), None) for side in (held.lowers, held.uppers)]
            return [(bound.rule, bound.fires) for bound in bounds if bound is not None]
    for found in run.named.values():
        setting = [(named.rule, some(guard for guard, _ in named.names)) for named in found]
        return [(rule, fires) for rule, fires in setting if on(fires)][:2]
    return []


# Coverage ------------------------------------------------------------------------------------------------------------


def coverage(court: Court) -> Iterator[Finding]:
    """Yield proposals that nothing decides about, and pairs that nothing gets through."""
    pair = court.pair
    if pair.lost is not False:
        message = f"a gap: what rules read of {court.where} is not there to be looked up, so the guard itself fails"
        yield from court.judged(
            Kind.COVERAGE,
            court.solve(pair.lost),
            message,
            lambda seen: any(reason.rule == GUARD for reason in seen.reasons),
        )
    escalates = either(pair.first.asked, pair.space.supervised)
    through = court.solve(no(pair.denied), True if answers(pair.gate) else no(escalates))
    if through is None:
        why = "" if answers(pair.gate) else " (what a rule escalates is denied there: nobody is asked)"
        message = f"a gap: {court.where} is enabled, and no proposal ever gets through{why}"
        yield court.finding(Kind.COVERAGE, Weight.REFUTED, message)
        return
    # A way through is good news only if it is one for the real code as well.
    if isinstance(through, Undecided) or court.confirmed(through, _goes_through, small=False) is None:
        whether = f"whether anything gets through {court.where}"
        yield from court.judged(Kind.COVERAGE, through, whether, never)


def _goes_through(seen: Seen) -> bool:
    """Say whether nothing denies or rejects; what is deferred meets no precondition, or another time."""
    return seen.decision.verdict is not None and seen.status != Status.DENIED.value


# Errors --------------------------------------------------------------------------------------------------------------


def errors(court: Court) -> Iterator[Finding]:
    """Yield conditions that some well-typed proposal makes fail."""
    pair = court.pair
    for rule in pair.rules:
        if rule.id in pair.uncovered:
            message = f"`{rule.id}` reads {pair.uncovered[rule.id]}, which proofs do not cover"
            yield court.finding(Kind.ERROR, Weight.UNDECIDED, message, rule.id)
        elif pair.first.errors[rule.id] is not False:
            yield from court.judged(
                Kind.ERROR,
                court.solve(pair.first.errors[rule.id], no(pair.lost)),
                f"`{rule.id}` cannot be evaluated for some proposal for {court.where}, and then denies",
                lambda seen, rule=rule: (rule.id, "rule_error") in {(r.rule, r.code) for r in seen.reasons},
                rule.id,
            )


# Idempotence ---------------------------------------------------------------------------------------------------------


def idempotence(court: Court) -> Iterator[Finding]:
    """Yield proposals that policy changes into something it would not leave alone."""
    pair = court.pair
    if pair.restless is False:
        return
    found = court.solve(pair.restless)
    message = f"what policy makes of a proposal for {court.where} does not re-check to allow"
    rule = _unrest(court, found) if isinstance(found, z3.ModelRef) else ""
    if rule:
        message += f": then `{rule}` would have it otherwise"
    yield from court.judged(Kind.IDEMPOTENCE, found, message, _restless, rule)


def _restless(seen: Seen) -> bool:
    return any(reason.code == "unsettled" for reason in seen.reasons)


def _unrest(court: Court, model: z3.ModelRef) -> str:
    """Return the rule that would have it otherwise, as the real code names it."""
    case = confirm(court.policy, read(court.pair.space, court.pair.gate.profile.name, model), _restless)
    if case is None:
        return ""
    return next(
        reason.rule for reason in cast("Seen", decided(court.policy, case)).reasons if reason.code == "unsettled"
    )


__all__ = ["Court", "contradictions", "coverage", "errors", "idempotence", "never"]
