"""H: does a human have to approve before launch, how many, by when?

| the profile's modes | asks |
|---|---|
| approval-required | at the risks it lists, for capabilities marked `approval-required`, and on every escalation |
| approval-on-escalation | for capabilities marked `approval-required`, and on every escalation |
| neither | never; nobody could answer, so that an escalation becomes a denial (`decision`) |
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from app.governance.model import AdmissionOutcome, ApprovalNeed, AuthorityMode, PolicyOutcome, Reason

if TYPE_CHECKING:
    from app.governance.model import Admission, Context, Proposal, Verdict
    from app.governance.policy import Gate, PolicySet
    from app.governance.policy_model import Approval

MARKED: Final = "approval-required"


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
