"""H: does a human have to approve before launch, how many, by when; and what may humans do to what runs?

| the profile's modes | asks |
|---|---|
| approval-required | at the risks it lists, for capabilities marked `approval-required`, and on every escalation |
| approval-on-escalation | for capabilities marked `approval-required`, and on every escalation |
| neither | never; nobody could answer, so that an escalation becomes a denial (`decision`) |

| mode | what it leaves to humans, and what is refused without it |
|---|---|
| interrupt-enabled | pausing, resuming and rolling back a session; a stop of any kind needs no mode |
| takeover-enabled | taking the controls |
| review-only | a verdict on finished sessions; nobody is asked before |
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.model import (
    AdmissionOutcome,
    ApprovalNeed,
    AuthorityMode,
    GrantScope,
    PolicyOutcome,
    Reason,
    Risk,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.model import Admission, Context, Grant, Outcome, Proposal, Verdict
    from app.governance.policy import Gate, PolicySet
    from app.governance.policy_model import Approval, Denial

MARKED: Final = "approval-required"
REQUIRED: Final = "approval_required"
REFUSALS: Final[Mapping[AuthorityMode, tuple[str, str, str]]] = {
    AuthorityMode.APPROVAL_REQUIRED: (
        "approval_not_enabled",
        "nobody approves anything before it is launched in `{profile}`",
        "propose it where a human can approve",
    ),
    AuthorityMode.APPROVAL_ON_ESCALATION: (
        "approval_not_enabled",
        "nobody is asked about escalations in `{profile}`",
        "propose it where a human can approve",
    ),
    AuthorityMode.INTERRUPT_ENABLED: (
        "interrupt_not_enabled",
        "sessions are not interrupted in `{profile}`",
        "stop it: that is always possible",
    ),
    AuthorityMode.TAKEOVER_ENABLED: (
        "takeover_not_enabled",
        "nobody takes the controls in `{profile}`",
        "put the cell under a profile with takeover, or stop it",
    ),
    AuthorityMode.REVIEW_ONLY: (
        "review_not_enabled",
        "finished sessions are not reviewed in `{profile}`",
        "a profile with the mode `review-only`",
    ),
}
"""What is answered where a profile lacks a mode: code, message, remedy."""


def allows(policy: PolicySet, profile: str, mode: AuthorityMode) -> bool:
    """Say whether a profile's authority has a mode; one that policy does not know has none."""
    found = policy.profiles.get(profile)
    return found is not None and mode in found.authority


def refusal(policy: PolicySet, profile: str, mode: AuthorityMode) -> Reason | None:
    """Return why what needs a mode is refused under a profile, or None where it is allowed.

    For a session that is the profile it was authorized under, for a cell without one the profile it is under now.
    """
    if allows(policy, profile, mode):
        return None
    code, message, remedy = REFUSALS[mode]
    return Reason(f"{profile}/authority", code, message.format(profile=profile), remedy)


# -- before launch ----------------------------------------------------------------------------------------------------


def need(
    policy: PolicySet, proposal: Proposal, admission: Admission, verdict: Verdict, context: Context
) -> ApprovalNeed | None:
    """Return what authority asks for before this proposal may be launched, or None where it asks for nothing.

    Args:
        policy: The active policy.
        proposal: What was proposed.
        admission: What `admit` said; an escalation asks.
        verdict: What `check` said; an escalation asks, by as many people as the strictest of its rules wants.
        context: Γ_t.
    """
    gate = policy.gates.get((proposal.capability, context.profile))
    approval = None if gate is None or not answers(gate) else gate.profile.approval
    if gate is None or approval is None:
        return None
    reasons = (*_escalated(admission, verdict), *_required(gate, approval))
    if not reasons:
        return None
    return ApprovalNeed(
        approvers=_approvers(policy, gate, approval, verdict),
        within_s=approval.within_s,
        on_timeout=approval.on_timeout,
        reasons=reasons,
    )


def answers(gate: Gate) -> bool:
    """Say whether anybody can be asked before this capability is launched in this profile; never about a recovery."""
    return gate.profile.approval is not None and gate.profile.asks and not gate.capability.recovery


def _escalated(admission: Admission, verdict: Verdict) -> tuple[Reason, ...]:
    by_admission = admission.reasons if admission.outcome is AdmissionOutcome.ESCALATE else ()
    by_guard = verdict.reasons if verdict.outcome is PolicyOutcome.ESCALATE else ()
    return (*by_admission, *by_guard)


def _required(gate: Gate, approval: Approval) -> tuple[Reason, ...]:
    capability, profile = gate.capability, gate.profile
    rule = f"{profile.name}/authority"
    if AuthorityMode.APPROVAL_REQUIRED in profile.authority and capability.risk in approval.risks:
        message = f"{capability.risk.value} risk needs approval in {profile.name}"
    elif capability.env_profile[profile.name] == MARKED:
        message = f"`{capability.name}` needs approval in {profile.name}"
    else:
        return ()
    return (Reason(rule, REQUIRED, message, "wait for a human's answer"),)


def _approvers(policy: PolicySet, gate: Gate, approval: Approval, verdict: Verdict) -> int:
    by_risk = approval.approvers.get(gate.capability.risk, approval.default_approvers)
    escalated = verdict.reasons if verdict.outcome is PolicyOutcome.ESCALATE else ()
    wanted = (policy.rules[reason.rule].approvers for reason in escalated if reason.rule in policy.rules)
    return max(by_risk, *wanted, 1)


# -- in advance -------------------------------------------------------------------------------------------------------


def grantable(policy: PolicySet, capability: str, profile: str) -> Reason | None:
    """Return why no standing grant is given for a capability under a profile, or None where it may be.

    A grant spares a human the same answer again, and nothing else: only where the profile's own requirement asks, only
    where one person's answer is enough, and never at critical risk.
    """
    gate, terms = policy.gates.get((capability, profile)), policy.authority.grants
    rule = f"{profile}/authority"
    if terms is None:
        return Reason(rule, "grants_not_enabled", "policy knows no standing grants", "approve each proposal")
    if gate is None or gate.profile.approval is None or not answers(gate) or not _required(gate, gate.profile.approval):
        message = f"`{capability}` needs no approval in {profile} that a grant could stand for"
        return Reason(rule, "nothing_to_grant", message, "a capability that needs approval here")
    risk = gate.capability.risk
    if risk is Risk.CRITICAL or risk not in terms.risks:
        return Reason(rule, "risk_not_granted", f"{risk.value} risk is never granted", "approve each proposal")
    if gate.profile.approval.approvers.get(risk, gate.profile.approval.default_approvers) > 1:
        message = f"`{capability}` takes more than one person's approval in {profile}"
        return Reason(rule, "quorum_not_granted", message, "approve each proposal")
    return None


def granted(policy: PolicySet, proposal: Proposal, wanted: ApprovalNeed, context: Context) -> Grant | None:
    """Return the standing grant that answers what authority asks for, or None where a human has to.

    What a rule or admission escalates is never answered by a grant: somebody wrote that rule to have a human look at
    this very proposal. Nor is what takes more than one person.
    """
    if wanted.approvers != 1 or any(reason.code != REQUIRED for reason in wanted.reasons):
        return None
    if grantable(policy, proposal.capability, context.profile) is not None:
        return None
    return next((grant for grant in context.grants if covers(policy, grant, proposal, context)), None)


def covers(policy: PolicySet, grant: Grant, proposal: Proposal, context: Context) -> bool:
    """Say whether a grant is for this proposal, here and now: every bound it has must hold."""
    bound = (grant.capability, grant.agent, grant.cell, grant.profile, grant.policy_digest)
    if bound != (proposal.capability, context.agent.name, context.cell.id, context.profile, policy.digest):
        return False
    if not grant.issued_at_s <= context.time_s < grant.expires_at_s:
        return False
    match grant.scope:
        case GrantScope.OBJECT:
            return handled(policy, proposal, context) == grant.object
        case GrantScope.TASK:
            return proposal.metadata.get("task") == grant.task
        case _:  # time alone
            return True


def handled(policy: PolicySet, proposal: Proposal, context: Context) -> str | None:
    """Return the object a proposal handles: the one it names, else the one in the gripper."""
    gate = policy.gates.get((proposal.capability, context.profile))
    for param, kind, _ in () if gate is None else gate.known:
        if kind == "object":
            return str(proposal.params[param]) if param in proposal.params else None
    return None if context.cell.facts is None else context.cell.facts.holding


# -- in mid-execution, and afterwards ---------------------------------------------------------------------------------


class Wait(NamedTuple):
    """How long a session waits for a human, and what a denial and silence lead to: `terminate` or `rollback`."""

    within_s: float
    on_deny: str
    on_timeout: str


def waiting(policy: PolicySet, capability: str, profile: str, phase: str | None) -> Wait:
    """Return how a session of a capability waits for a human: before a phase that policy names, else for any cause."""
    authority = policy.authority
    for entry in authority.confirm_before:
        if (entry.capability, entry.profile) == (capability, profile) and phase in entry.phases:
            within_s = authority.within_s if entry.within_s is None else entry.within_s
            return Wait(within_s, entry.on_deny, entry.on_timeout)
    return Wait(authority.within_s, "terminate", authority.on_timeout)


def denial(policy: PolicySet, code: str | None) -> Denial | None:
    """Return what a denial's code means, the declared default where there is none; None for a code policy lacks."""
    denials = policy.authority.denials
    return denials[0] if code is None else next((known for known in denials if known.code == code), None)


def reviewed(policy: PolicySet, capability: str, profile: str, outcome: Outcome) -> tuple[Reason, ...]:
    """Return why a session that ended so waits for a human's verdict; empty where policy does not ask for one."""
    found, package = policy.profiles.get(profile), policy.capabilities.get(capability)
    if (
        found is None
        or package is None
        or found.review is None
        or not allows(policy, profile, AuthorityMode.REVIEW_ONLY)
    ):
        return ()
    rule, reasons = f"{profile}/authority", list[Reason]()
    if package.risk in found.review.risks:
        message = f"what is of {package.risk.value} risk is reviewed in {profile}"
        reasons.append(Reason(rule, "reviewed_for_risk", message, "look at the trace, and give a verdict"))
    if outcome in found.review.outcomes:
        message = f"what ended as `{outcome.value}` is reviewed in {profile}"
        reasons.append(Reason(rule, "reviewed_for_outcome", message, "look at the trace, and give a verdict"))
    return tuple(reasons)
