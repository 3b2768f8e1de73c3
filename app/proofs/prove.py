"""Proves a policy: every enabled (capability, profile) by itself, profiles against one another, stated properties."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from app.governance.bundle import PROPERTIES
from app.governance.stated import Stated, read
from app.proofs.asking import Asking, Budget
from app.proofs.deciding import fates
from app.proofs.declared import misplaced
from app.proofs.findings import Finding, Kind, Lines, Weight
from app.proofs.obligations import Court, contradictions, coverage, errors, idempotence
from app.proofs.pair import Pair
from app.proofs.promises import applies, order_holds, property_holds
from app.proofs.space import Space
from app.proofs.witness import written

if TYPE_CHECKING:
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Rule
    from app.governance.vocabulary import Vocabulary
    from app.proofs.deciding import Fate

EFFORT: Final = 20_000_000  # steps of the solver; about ten seconds
ALL_S: Final = 120.0
_ORDER_OF_STATES: Final = ("alive", "unconfirmed", "undecided", "shadowed", "dead")


@dataclass(slots=True, kw_only=True)
class Report:
    """What was proved, and what was not.

    Attributes:
        findings: Everything that is not proved, in order of file and line; notes among it.
        pairs: How many pairs were looked at.
        rules: How many rules.
        stated: How many properties are stated.
        properties: How many (property, pair) were looked at.
        ordered: How many (capability, stricter, wider) were compared.
        asked: How many questions the solver was asked.
        idle: The properties that are about nothing that can be proposed, and so hold whatever policy does.
    """

    findings: list[Finding] = field(default_factory=list[Finding])
    pairs: int = 0
    rules: int = 0
    stated: int = 0
    properties: int = 0
    ordered: int = 0
    asked: int = 0
    idle: list[str] = field(default_factory=list[str])

    @property
    def faults(self) -> list[Finding]:
        """Return what keeps the policy from being sound: all but notes."""
        return [finding for finding in self.findings if not finding.sound]

    def summary(self) -> str:
        """Say what a report without faults amounts to."""
        parts = [
            "no contradiction, no gap, no dead or shadowed rule, no error, and what is constrained re-checks to allow",
            f"{self.ordered} comparisons of profiles" if self.ordered else "no order of profiles declared",
            f"{self.stated} properties, {self.properties} times" if self.stated else "no properties stated",
        ]
        if self.idle:
            parts.append(f"about nothing that can be proposed: {', '.join(f'`{name}`' for name in self.idle)}")
        return f"proved of {self.pairs} pairs: " + "; ".join(parts)


Progress = Callable[[int, int, str], None]


def prove(
    policy: PolicySet,
    properties: str | None,
    *,
    now: Callable[[], float],
    effort: int = EFFORT,
    all_s: float = ALL_S,
    progress: Progress = lambda _done, _of, _what: None,
) -> Report:
    """Prove a policy.

    Args:
        policy: The policy, loaded.
        properties: Text of `properties.yaml`; None where there is none.
        now: Tells the time, in seconds.
        effort: How many steps the solver may take about one question.
        all_s: How long everything may take.
        progress: Called with what was done, of how much, and what comes now.

    Raises:
        PolicyErrors: `properties.yaml` is at fault.
    """
    stated = read(policy, properties)
    budget = Budget(now, effort, now() + all_s)
    return Prover(policy, stated, policy.vocabulary(), budget).run(progress)


class Prover:
    """Goes through a policy, capability by capability."""

    def __init__(self, policy: PolicySet, stated: Stated, vocabulary: Vocabulary, budget: Budget) -> None:
        """Take what is to be proved."""
        self.policy, self.stated, self.vocabulary, self.budget = policy, stated, vocabulary, budget
        self.lines = Lines({**policy.files})
        self.report = Report(rules=len(policy.rules), stated=len(stated.properties))
        self.fates: dict[str, list[Fate]] = {rule: [] for rule in policy.rules}
        self.courts: dict[str, Court] = {}
        self.applied: set[str] = set()  # promises that are about something

    def run(self, progress: Progress) -> Report:
        """Prove everything."""
        self.report.findings += self._declared_order()
        names = sorted(self.policy.capabilities)
        done = 0
        for name in names:
            space = Space(self.policy, self.policy.capabilities[name])
            self.courts = {}
            for profile in self.policy.profiles:
                if (name, profile) in self.policy.gates:
                    progress(done, len(self.policy.gates), f"{name} in {profile}")
                    self.report.findings += self._pair(space, name, profile)
                    done += 1
            self.report.findings += self._order(space, name)
        self.report.findings += self._fates()
        self.report.findings += self._idle_promises()
        self.report.findings.sort(key=lambda found: (found.file, found.line, found.kind, found.capability))
        progress(done, done, "")
        return self.report

    def _applying(self, name: str, profile: str) -> list[Rule]:
        return [
            rule
            for rule in self.policy.rules.values()
            if (rule.applies_to is None or name in rule.applies_to)
            and (rule.profiles is None or profile in rule.profiles)
        ]

    def _pair(self, space: Space, name: str, profile: str) -> Iterator[Finding]:
        pair = Pair(space, self.policy.gates[name, profile], self._applying(name, profile), self.vocabulary)
        court = Court(self.policy, pair, Asking(self.budget, pair.everything), self.lines)
        self.courts[profile] = court
        self.report.pairs += 1
        for obligation in (contradictions, coverage, errors, idempotence):
            yield from obligation(court)
        for fate in fates(court):
            self.fates[fate.rule].append(fate)
        for promised in self.stated.properties:
            if (name, profile) in promised.pairs:
                self.report.properties += 1
                yield from property_holds(court, promised)
                if promised.shape.id not in self.applied and applies(court, promised):
                    self.applied.add(promised.shape.id)
        self.report.asked += court.asking.asked

    # Profiles against one another ------------------------------------------------------------------------------------

    def _declared_order(self) -> Iterator[Finding]:
        for strict, wide in zip(self.stated.order, self.stated.order[1:], strict=False):
            for found in misplaced(self.policy.profiles[strict], self.policy.profiles[wide]):
                file, line = self.lines.of(f"profiles/{strict}.yaml", found.path)
                yield Finding(
                    kind=Kind.ORDER,
                    weight=Weight.REFUTED,
                    message=f"{found.message}, and {strict} is declared the stricter",
                    file=file,
                    line=line,
                    profile=strict,
                    rule=found.limit,
                )

    def _order(self, space: Space, name: str) -> Iterator[Finding]:
        for strict, wide in zip(self.stated.order, self.stated.order[1:], strict=False):
            if strict not in self.courts:
                continue
            self.report.ordered += 1
            court = self.courts[strict]
            if wide not in self.courts:
                message = f"`{name}` is enabled in {strict}, the stricter, and forbidden in {wide}"
                yield court.finding(Kind.ORDER, Weight.REFUTED, message)
                continue
            pairs = (court.pair, self.courts[wide].pair)
            asking = Asking(self.budget, lambda pairs=pairs: [fact for pair in pairs for fact in pair.everything()])
            yield from order_holds(court, pairs[1], asking)
            self.report.asked += asking.asked

    # Rules over all pairs --------------------------------------------------------------------------------------------

    def _fates(self) -> Iterator[Finding]:
        """A rule is dead, or shadowed, if it is so wherever it applies; elsewhere that is worth a note."""
        for rule, found in self.fates.items():
            states = {fate.state for fate in found}
            best = next((state for state in _ORDER_OF_STATES if state in states), "dead")
            file, line = self.lines.rule(rule)
            if best == "alive":
                yield from self._notes(rule, found, file, line)
                continue
            weight = _WEIGHTS.get(best, Weight.REFUTED)
            kind = Kind.SHADOWED if best == "shadowed" else Kind.DEAD
            shown = next((fate for fate in found if fate.state == best and fate.case is not None), None)
            text, body = ("", {}) if shown is None or shown.case is None else written(
                self.policy, shown.case, f"{kind.value}: {rule}"
            )  # fmt: skip
            yield Finding(
                kind=kind, weight=weight, message=(_SAID[best] if found else _NOWHERE).format(rule=rule),
                file=file, line=line, rule=rule, example=text, body=body,
            )  # fmt: skip

    def _idle_promises(self) -> Iterator[Finding]:
        """What nothing can be proposed about is kept, whatever policy does: worth a word, and no fault."""
        for promised in self.stated.properties:
            name = promised.shape.id
            if promised.pairs and name not in self.applied:
                self.report.idle.append(name)
                message = f"`{name}` promises something about nothing: no proposal meets its `when`"
                yield Finding(
                    kind=Kind.PROPERTY, weight=Weight.NOTE, message=message,
                    file=PROPERTIES, line=promised.line, rule=name,
                )  # fmt: skip

    def _notes(self, rule: str, found: list[Fate], file: str, line: int) -> Iterator[Finding]:
        idle = [f"`{fate.capability}` in {fate.profile}" for fate in found if fate.state in ("dead", "shadowed")]
        owner = self.policy.rules[rule]
        if idle and (owner.applies_to is not None or owner.profiles is not None):
            shown = ", ".join(idle[:4]) + (f" and {len(idle) - 4} more" if len(idle) > 4 else "")
            message = f"`{rule}` never determines an outcome about {shown}; elsewhere it does"
            yield Finding(kind=Kind.DEAD, weight=Weight.NOTE, message=message, file=file, line=line, rule=rule)


_SAID: Final[Mapping[str, str]] = {
    "dead": "a dead rule: `{rule}` never holds, whatever is proposed",
    "shadowed": "a shadowed rule: `{rule}` holds, but never determines an outcome: others always decide",
    "undecided": "whether `{rule}` ever determines an outcome is not decided",
    "unconfirmed": "the real code does not confirm that `{rule}` determines an outcome; report it",
}
_WEIGHTS: Final[Mapping[str, Weight]] = {"undecided": Weight.UNDECIDED, "unconfirmed": Weight.BUG}
_NOWHERE: Final = "a dead rule: `{rule}` applies to no enabled capability and profile, or sets nothing there"

__all__ = ["ALL_S", "EFFORT", "Report", "prove"]
