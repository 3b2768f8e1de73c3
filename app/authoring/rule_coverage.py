"""Which rules and limits determine what comes of a policy's cases, and which never do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from app.governance import cases
from app.governance.decision import decide
from app.governance.model import PolicyOutcome
from app.governance.policy_code import limit_for
from app.governance.policy_model import Effect
from app.governance.vocabulary import properties

if TYPE_CHECKING:
    from app.governance.decision import Decision
    from app.governance.policy import PolicySet


@dataclass(frozen=True, slots=True, kw_only=True)
class RuleCoverage:
    """How many cases each rule determined, in the order of the policy, and each limit that holds something."""

    determined: Mapping[str, int]

    @property
    def never(self) -> list[str]:
        """Return what determined no case's outcome."""
        return [rule for rule, count in self.determined.items() if not count]

    @property
    def share(self) -> float:
        """Return the covered share; 1 where there is nothing to cover."""
        return 1.0 - len(self.never) / len(self.determined) if self.determined else 1.0


def rule_coverage(policy: PolicySet, case_files: Mapping[str, str]) -> RuleCoverage:
    """Decide every case, and count for each rule and limit the outcomes it determined.

    Raises:
        PolicyErrors: A file of cases has something wrong with it.
    """
    counts = dict.fromkeys((*policy.rules, *_limits(policy)), 0)
    for _, _, profile, case in cases.read(policy, case_files):
        asked = cases.asking(policy, profile, case)
        for rule in determining(policy, decide(policy, *asked)) if asked is not None else ():
            counts[rule] += 1
    return RuleCoverage(determined=counts)


def _limits(policy: PolicySet) -> Iterable[str]:
    """Return the limits that hold a parameter of something enabled, as rules are called."""
    found: dict[str, None] = {}
    for gate in policy.gates.values():
        for spec in properties(gate.capability).values():
            limit = limit_for(spec, gate.profile.limits)
            if limit is not None:
                found[f"{gate.profile.name}/{limit.name}"] = None
    return found


_WEAKER = {
    PolicyOutcome.DENY: frozenset({Effect.DENY}),
    PolicyOutcome.ESCALATE: frozenset({Effect.ESCALATE, Effect.MODIFY}),
    PolicyOutcome.MODIFY: frozenset({Effect.MODIFY}),
    PolicyOutcome.ALLOW: frozenset[Effect](),
}
"""Which rules determine an outcome: what a denial reports beside the rules that deny changed nothing about it. An
escalation carries what was modified."""


def determining(policy: PolicySet, decision: Decision) -> set[str]:
    """Return the rules and limits that made a verdict what it is."""
    verdict = decision.verdict
    if verdict is None:
        return set()
    determined = _WEAKER[verdict.outcome]
    found: set[str] = set()
    for reason in verdict.reasons:
        rule = policy.rules.get(reason.rule)
        if rule is not None and rule.then in determined:
            found.add(rule.id)
        elif rule is None and reason.code == "limit" and Effect.MODIFY in determined:
            found.add(reason.rule)
    return found
