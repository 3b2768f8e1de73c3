"""What a session would be held to if a proposal were launched as decided: `expect.session` of a case.

Numbers are rounded to nine digits, so that `1.05 × 0.25` can be written down. What a rule leaves at its default is not
said: method `threshold`, a response that stays.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from app.governance.authority import allows, grantable, reviewed, waiting
from app.governance.model import AuthorityMode, Outcome, Strategy
from app.governance.plans import confirm_before, recovery_plan, watch_plan
from app.governance.policy_model import FAILURES
from app.governance.recovery import DEFAULT_BUDGET

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.decision import Decision
    from app.governance.model import Context, Proposal, RecoveryPlan, RecoveryRule, WatchPlan, WatchRule
    from app.governance.policy import PolicySet

DIGITS: Final = 9


def terms(policy: PolicySet, proposal: Proposal, context: Context, decision: Decision) -> dict[str, Any]:
    """Return what a session of this proposal would be held to, as decided; nothing where the pair does not exist."""
    capability, profile = proposal.capability, context.profile
    if capability not in policy.capabilities:
        return {}
    params = proposal.params if decision.verdict is None else decision.verdict.effective
    watch = watch_plan(policy, capability, profile, params, proposal.mode)
    recovery = recovery_plan(policy, capability, profile)
    return (
        {"params": dict(params)}
        | _watched(watch)
        | _recovered(recovery)
        | _asked(policy, capability, profile, decision)
    )


def _watched(plan: WatchPlan) -> dict[str, Any]:
    return {
        "sensitivity": plan.sensitivity,
        "bounds": {name: _short(bound) for name, bound in plan.bounds._asdict().items()},
        "watch": watch_terms(plan),
        "separation": None if plan.separation is None else asdict(plan.separation),
        "stale_after_ms": dict(plan.stale_after_ms),
        "timeout_s": plan.timeout_s,
        "postconditions": list(plan.postconditions),
        "base_deceleration_mps2": plan.base_deceleration_mps2,
        "base_radius_m": plan.base_radius_m,
        "keep_every_tick": plan.keep_every_tick,
    }


def watch_terms(plan: WatchPlan) -> dict[str, dict[str, Any]]:
    """Return what a session is watched for, by rule: signal, threshold, and what is done about it."""
    return {rule.id: _watch(rule) for rule in plan.rules}


def _short(value: float) -> float:
    return round(value, DIGITS)


def _watch(rule: WatchRule) -> dict[str, Any]:
    response = rule.response
    threshold = "computed" if rule.threshold is None else _short(rule.threshold)
    said: Mapping[str, Any] = {
        "method": "" if rule.method == "threshold" else rule.method,
        "failure": rule.failure,
        "clear_after_ms": response.clear_after_ms,
        "clear_beyond": _short(response.clear_beyond),
        "then": "" if response.then == "stay" else response.then,
        "persist_ms": response.persist_ms,
        "else": None if response.persist_ms is None else response.otherwise.value.lower(),
    }
    return {
        "signal": rule.signal,
        "above" if rule.above else "below": threshold,
        "for_ms": rule.for_ms,
        "emits": rule.emits.value,
        "enter": response.enter.value.lower(),
        **{key: value for key, value in said.items() if value},
    }


def _recovered(plan: RecoveryPlan) -> dict[str, Any]:
    return {
        "risk": plan.risk.value,
        "recovery": recovery_terms(plan),
        "retry_budget": plan.retry_budget,
        "rollback": plan.rollback,
        "rollback_capability": plan.rollback_capability,
        "careful": plan.careful_admitted,
    }


def recovery_terms(plan: RecoveryPlan) -> dict[str, list[str]]:
    """Return what follows each failure: the steps of the row that holds, in order."""
    return {failure: _steps(failure, plan) for failure in sorted(FAILURES)}


def _steps(failure: str, plan: RecoveryPlan) -> list[str]:
    """Return the steps of the row that holds, in order: a recovery by its capability, with its budget if not 1."""
    row = next((row for row in plan.rules if row.on in (failure, "any") and plan.risk in row.risks), None)
    return [] if row is None else [_step(strategy, row) for strategy in row.do]


def _step(strategy: Strategy, row: RecoveryRule) -> str:
    name = strategy.value.lower()
    if strategy is Strategy.RECOVERY_CAPABILITY:
        name = str(row.capability)
    budget = row.budget.get(strategy, DEFAULT_BUDGET)
    return name if budget == DEFAULT_BUDGET else f"{name} {budget}"


def _asked(policy: PolicySet, capability: str, profile: str, decision: Decision) -> dict[str, Any]:
    phases = confirm_before(policy, capability, profile)
    why_not, grants = grantable(policy, capability, profile), policy.authority.grants
    return {
        "asked_because": [] if decision.need is None else [reason.message for reason in decision.need.reasons],
        "answer_within_s": None if decision.need is None else decision.need.within_s,
        "confirm_before": {phase: waiting(policy, capability, profile, phase)._asdict() for phase in phases},
        "wait": waiting(policy, capability, profile, None)._asdict(),
        "grant": (None if grants is None else grants.up_to_s) if why_not is None else why_not.code,
        "denial": policy.authority.denials[0].code,
        "modes": sorted(mode.value for mode in AuthorityMode if allows(policy, profile, mode)),
        "review": [outcome.value for outcome in Outcome if reviewed(policy, capability, profile, outcome)],
    }
