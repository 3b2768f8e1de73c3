"""The whole decision about a proposal: admission, guard and authority combined by one table.

```
reject > deny > defer > escalate > modify > allow
```

| admission | guard | authority asks | status |
|---|---|---|---|
| reject | not evaluated | – | rejected |
| any other | deny | – | denied |
| any other | escalate, or admission escalates or would | nobody to ask | denied (`no_authority`) |
| defer | any other | – | deferred |
| accept, escalate | any other | yes, and no standing grant answers | awaiting_approval |
| accept | allow, modify | no, or a standing grant answers | allowed |

What nobody can be asked about is denied, and its verdict still says what policy said: `escalate`. A defer hides neither
kind of denial: it asks to propose again, and that has to have a chance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

from app.governance.admission import admit, supervised
from app.governance.authority import answers, granted, need
from app.governance.guard import check
from app.governance.model import AdmissionOutcome, PolicyOutcome, Reason, Status, Verdict

if TYPE_CHECKING:
    from app.governance.model import Admission, ApprovalNeed, Context, Grant, Proposal
    from app.governance.policy import PolicySet

Decided: TypeAlias = Status | Literal["allowed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What was decided about a proposal; `verdict` is None where admission rejected, `need` where nobody is asked.

    `grant` is the standing grant by which nobody has to be.
    """

    status: Decided
    admission: Admission
    verdict: Verdict | None
    need: ApprovalNeed | None
    grant: Grant | None = None


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
    gate = policy.gates[proposal.capability, context.profile]  # without one, the verdict denies
    if (verdict.outcome is PolicyOutcome.ESCALATE or supervised(gate, context)) and not answers(gate):
        refusal = _unanswerable(verdict, context)
        return Decision(status=Status.DENIED, admission=admission, verdict=refusal, need=None)
    if admission.outcome is AdmissionOutcome.DEFER:
        return Decision(status=Status.DEFERRED, admission=admission, verdict=verdict, need=None)
    wanted = need(policy, proposal, admission, verdict, context)
    grant = None if wanted is None else granted(policy, proposal, wanted, context)
    if wanted is not None and grant is None:
        return Decision(status=Status.AWAITING_APPROVAL, admission=admission, verdict=verdict, need=wanted)
    return Decision(status="allowed", admission=admission, verdict=verdict, need=None, grant=grant)


def _unanswerable(verdict: Verdict, context: Context) -> Verdict:
    """A human would have to decide, and the profile has nobody who could: it stays an escalation, and is denied."""
    message = f"a human would have to decide, and {context.profile} asks nobody before execution"
    reason = Reason(f"{context.profile}/authority", "no_authority", message, "propose it where a human can approve")
    return replace(verdict, outcome=PolicyOutcome.ESCALATE, reasons=(*verdict.reasons, reason))
