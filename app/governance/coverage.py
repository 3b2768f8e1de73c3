"""Which recoveries an authorization covers: each decided by itself, and as constrained as it came out.

A cell may recover while the server is away, but only by what was admitted and checked beforehand (design, section 7).
What policy's table asks for and nothing covers needs a new authorization, which means a human.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from app.governance.decision import decide
from app.governance.model import AdmissionOutcome, AgentFacts, CoveredRecovery, Mode, PolicyOutcome, Strategy
from app.governance.plans import recovery_plan
from app.governance.policy_model import GOVERNANCE
from app.governance.recovery import RETRACE
from app.governance.vocabulary import properties

if TYPE_CHECKING:
    from app.governance.model import Context, Json, Params, Proposal, RecoveryPlan
    from app.governance.policy import PolicySet


def covered_recoveries(policy: PolicySet, proposal: Proposal, context: Context) -> tuple[CoveredRecovery, ...]:
    """Decide about every recovery that policy may ask for in a session, and return those it may have.

    Args:
        policy: The policy in force.
        proposal: What is about to be launched, with its effective parameters.
        context: Γ_t of the launch.

    Raises:
        KeyError: Capability or profile is unknown.
    """
    plan = recovery_plan(policy, proposal.capability, context.profile)
    free = replace(context, cell=replace(context.cell, busy=None))  # it is this very invocation that has the cell
    found = (_cover(policy, proposal, free, *wanted) for wanted in _wanted(policy, plan, proposal))
    return tuple(recovery for recovery in found if recovery is not None)


def _wanted(policy: PolicySet, plan: RecoveryPlan, proposal: Proposal) -> list[tuple[Strategy, str, Mode]]:
    """List what policy's table may ask for, each once, in the order of the table."""
    wanted: dict[tuple[Strategy, str, Mode], None] = {}
    for row in plan.rules:
        for strategy in row.do:
            match strategy:
                case Strategy.RETRY:
                    wanted[strategy, proposal.capability, proposal.mode] = None
                case Strategy.SAFER_MODE if plan.careful_admitted:
                    wanted[strategy, proposal.capability, Mode.CAREFUL] = None
                case Strategy.RECOVERY_CAPABILITY if row.capability is not None:
                    wanted[strategy, row.capability, Mode.NORMAL] = None
                case _:
                    pass
    if plan.rollback_capability is not None:  # an operator may ask for it even where no row does
        wanted[Strategy.ROLLBACK, plan.rollback_capability, Mode.NORMAL] = None
        if (back := policy.capabilities.get(RETRACE)) is not None and back.recovery:  # a rollback may end elsewhere
            wanted[Strategy.ROLLBACK, RETRACE, Mode.NORMAL] = None
    return list(wanted)


def recoveries(policy: PolicySet, proposal: Proposal, context: Context) -> tuple[Proposal, ...]:
    """Return what else than itself policy may ask for in a session, each as governance proposes it (`acting_for`).

    Args and errors as of `covered_recoveries`.
    """
    plan = recovery_plan(policy, proposal.capability, context.profile)
    named = {name: mode for _, name, mode in _wanted(policy, plan, proposal) if name != proposal.capability}
    found = ((name, mode, _params(policy, name, proposal, context)) for name, mode in named.items())
    return tuple(
        replace(proposal, capability=name, params=params, mode=mode, preconditions=(), version=None)
        for name, mode, params in found
        if params is not None
    )


def acting_for(agent: AgentFacts) -> AgentFacts:
    """Return governance as it acts for an agent: it may start recoveries, and may else no more than that agent."""
    return AgentFacts(name=GOVERNANCE, permissions=agent.permissions | {GOVERNANCE})


def _params(policy: PolicySet, capability: str, proposal: Proposal, context: Context) -> Params | None:
    """Return what a recovery is proposed with; None where it cannot run on its defaults."""
    params = policy.validate_params(capability, _named(policy, capability, proposal, context))
    return None if isinstance(params, tuple) else params


def _named(policy: PolicySet, capability: str, proposal: Proposal, context: Context) -> dict[str, Json]:
    """Return what a recovery has to be told: the object that this session handles, where it handles one."""
    if "object_id" not in properties(policy.capabilities[capability]):
        return {}
    facts = context.cell.facts
    name = proposal.params.get("object_id") or (None if facts is None else facts.holding)
    return {} if name is None else {"object_id": name}


def _cover(
    policy: PolicySet, proposal: Proposal, context: Context, strategy: Strategy, capability: str, mode: Mode
) -> CoveredRecovery | None:
    again = capability == proposal.capability
    params = proposal.params if again else _params(policy, capability, proposal, context)
    if params is None:  # so it cannot be had without being asked
        return None
    asked = replace(proposal, capability=capability, params=params, mode=mode, preconditions=())
    decision = decide(policy, asked, context if again else replace(context, agent=acting_for(context.agent)))
    # A new attempt at what a human approved needs no second approval; any other recovery must need none at all.
    verdict, admission = decision.verdict, decision.admission.outcome
    if verdict is None or verdict.outcome is PolicyOutcome.DENY:
        return None
    asks = admission is AdmissionOutcome.ESCALATE or verdict.outcome is PolicyOutcome.ESCALATE
    if admission in (AdmissionOutcome.REJECT, AdmissionOutcome.DEFER) or (asks and not again):
        return None
    return CoveredRecovery(strategy=strategy, capability=capability, params=dict(verdict.effective), mode=mode)
