"""Stage 3, second half: what may this proposal do? p_t = Check(q_t, Π_t, Γ_t) and q_t' = Constrain(q_t, Π_t, Γ_t).

The rules of the pair are compiled into one function (`policy_code`); this module is where a decision asks for it.
Without policy, or without a compiled pair, the answer is a denial: no rule is no permission.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from app.governance.model import PolicyOutcome, Reason, Verdict

if TYPE_CHECKING:
    from app.governance.model import Context, Proposal
    from app.governance.policy import PolicySet


def check(policy: PolicySet | None, proposal: Proposal, context: Context) -> Verdict:
    """Evaluate every rule that applies to the proposal; the most restrictive outcome wins.

    Deny > escalate > modify > allow. Modifications intersect; an empty intersection denies with `empty_intersection`.
    A rule that raises denies with `rule_error`. All determining rules are reported, the strongest first. What is denied
    keeps its requested parameters; what escalates carries the constrained ones.

    Args:
        policy: The active policy; None denies.
        proposal: Parameters are validated and complete.
        context: Γ_t.
    """
    gate = None if policy is None else policy.gates.get((proposal.capability, context.profile))
    if gate is None:
        message = f"no rules cover `{proposal.capability[:64]}` in {context.profile}"
        reason = Reason(
            "guard", "no_policy" if policy is None else "not_covered", message, "propose what policy covers"
        )
        return Verdict(outcome=PolicyOutcome.DENY, effective=proposal.params, reasons=(reason,))
    return gate.check(proposal, context)


def constrain(policy: PolicySet | None, proposal: Proposal, context: Context) -> Proposal:
    """Return the proposal in its policy-conforming form, which re-checks to allow wherever `check` would modify it."""
    return replace(proposal, params=check(policy, proposal, context).effective)
