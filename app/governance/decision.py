"""The whole decision about a proposal: admission, guard and authority combined by one table.

```
reject > deny > defer > escalate > modify > allow
```

| admission | guard | authority asks | status |
|---|---|---|---|
| reject | not evaluated | – | rejected |
| any other | deny | – | denied |
| defer | any other | – | deferred |
| accept, escalate | escalate, or admission escalates | nobody to ask | denied (`no_authority`) |
| accept, escalate | any other | yes | awaiting_approval |
| accept | allow, modify | no | allowed |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from app.governance.admission import admit
from app.governance.authority import need
from app.governance.guard import check
from app.governance.model import AdmissionOutcome, PolicyOutcome, Reason, Status, Verdict

if TYPE_CHECKING:
    from app.governance.model import Admission, ApprovalNeed, Context, Proposal
    from app.governance.policy import PolicySet

Decided: TypeAlias = Status | Literal["allowed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What was decided about a proposal; `verdict` is None where admission rejected, `need` where nobody is asked."""

    status: Decided
    admission: Admission
    verdict: Verdict | None
    need: ApprovalNeed | None


def decide(policy: PolicySet | None, proposal: Proposal, context: Context) -> Decision:
    """Decide about a proposal. Pure: the same arguments give the same decision anywhere.

    Args:
        policy: The active policy; None rejects.
        proposal: Parameters are validated and complete (`PolicySet.validate_params`).
        context: Γ_t.
    """
    admission = admit(policy, proposal, context)
    if policy is None or admission.outcome is AdmissionOutcome.REJECT:
        return Decision(status=Status.REJECTED, admission=admission, verdict=None, need=None)
    verdict = check(policy, proposal, context)
    if verdict.outcome is PolicyOutcome.DENY:
        return Decision(status=Status.DENIED, admission=admission, verdict=verdict, need=None)
    if admission.outcome is AdmissionOutcome.DEFER:
        return Decision(status=Status.DEFERRED, admission=admission, verdict=verdict, need=None)
    wanted = need(policy, proposal, admission, verdict, context)
    if wanted is not None:
        return Decision(status=Status.AWAITING_APPROVAL, admission=admission, verdict=verdict, need=wanted)
    if admission.outcome is AdmissionOutcome.ESCALATE or verdict.outcome is PolicyOutcome.ESCALATE:
        refusal = _unanswerable(verdict, proposal, context)
        return Decision(status=Status.DENIED, admission=admission, verdict=refusal, need=None)
    return Decision(status="allowed", admission=admission, verdict=verdict, need=None)


def _unanswerable(verdict: Verdict, proposal: Proposal, context: Context) -> Verdict:
    """A human would have to decide, and the profile has nobody who could: the safe answer is no."""
    message = f"a human would have to decide, and {context.profile} asks nobody before execution"
    reason = Reason(f"{context.profile}/authority", "no_authority", message, "propose it where a human can approve")
    return Verdict(outcome=PolicyOutcome.DENY, effective=proposal.params, reasons=(*verdict.reasons, reason))
