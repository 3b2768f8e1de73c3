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

from typing import TYPE_CHECKING, Final

from app.governance.model import AdmissionOutcome, ApprovalNeed, AuthorityMode, PolicyOutcome, Reason

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.model import Admission, Context, Proposal, Verdict
    from app.governance.policy import Gate, PolicySet
    from app.governance.policy_model import Approval

MARKED: Final = "approval-required"
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
    return (Reason(rule, "approval_required", message, "wait for a human's answer"),)


def _approvers(policy: PolicySet, gate: Gate, approval: Approval, verdict: Verdict) -> int:
    by_risk = approval.approvers.get(gate.capability.risk, approval.default_approvers)
    escalated = verdict.reasons if verdict.outcome is PolicyOutcome.ESCALATE else ()
    wanted = (policy.rules[reason.rule].approvers for reason in escalated if reason.rule in policy.rules)
    return max(by_risk, *wanted, 1)
