"""What an execution is permitted and governed by: a signed authorization, a method's share of watching and recovery.

Whoever has less governance than policy gives has the same plans with parts taken out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.evaluation.methods import Recovering, Watching
from app.evaluation.model import AGENT
from app.governance.coverage import covered_recoveries
from app.governance.model import (
    Authorization,
    Bounds,
    CellFacts,
    Context,
    CoveredRecovery,
    Mode,
    Proposal,
    RecoveryPlan,
    RecoveryRule,
    Strategy,
    WatchPlan,
)
from app.governance.permit import mint, verify
from app.governance.signals import SIGNAL_NAMES
from app.governance.watcher import without

if TYPE_CHECKING:
    from app.cell.runner import Runner
    from app.evaluation.methods import Method
    from app.governance.model import Params
    from app.governance.permit import Grant, SignedAuthorization
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

INTERNAL_SIGNALS: Final = frozenset({"contact_force_n", "grip_force_n", "slip_m", "grip_lost", "elapsed_s"})
"""What a skill's embedded checks can see: its own gripper, its own contact force, its own time."""
UNSEEN: Final[Mapping[Watching, frozenset[str]]] = {
    Watching.GOVERNED: frozenset(),
    Watching.INTERNAL: frozenset(SIGNAL_NAMES) - INTERNAL_SIGNALS,
    Watching.NOTHING: frozenset(SIGNAL_NAMES),
}
"""What a method's watcher is blind to, the rules included that a watcher has without being asked."""

_KEY: Final = Ed25519PrivateKey.generate()
_UNBOUNDED: Final = Bounds(1e3, 1e3, 1e4, 1e5, 1e2)
WALL_S: Final = 1.0e9


def adopt(runner: Runner, policy: PolicySet) -> None:
    """Let a cell believe authorizations under another policy from now on, as it does when one is activated."""
    runner.adopt(policy_digest=policy.digest, key=_KEY.public_key())


def signed(permit: Authorization) -> SignedAuthorization:
    """Sign an authorization as the kernel of these executions does."""
    return mint(permit, _KEY)


def authorize(cell: Workcell, method: Method, policy: PolicySet, proposal: Proposal, profile: str) -> Authorization:
    """Make the permit that the kernel would make for this proposal, with the recoveries that the method has."""
    return Authorization(
        id="permit",
        invocation="trial",
        cell=cell.id,
        capability=proposal.capability,
        version=policy.capabilities[proposal.capability].version,
        params=proposal.params,
        mode=proposal.mode,
        profile=profile,
        policy_digest=policy.digest,
        issued_at_s=WALL_S,
        expires_at_s=WALL_S + 60.0,
        recoveries=_covered(method, policy, proposal, context_of(cell, policy, profile)),
        approvals=("supervisor",),
    )


def context_of(cell: Workcell, policy: PolicySet, profile: str) -> Context:
    """Return Γ_t as the server would see this cell."""
    facts = CellFacts(id=cell.id, online=True, facts=cell.facts())
    return Context(time_s=WALL_S, profile=profile, agent=policy.agent(AGENT), cell=facts, operator_on_duty=True)


def _covered(method: Method, policy: PolicySet, proposal: Proposal, context: Context) -> tuple[CoveredRecovery, ...]:
    match method.recovery:
        case Recovering.GOVERNED:
            return covered_recoveries(policy, proposal, context)
        case Recovering.INTERNAL:
            return (
                CoveredRecovery(strategy=Strategy.RETRY, capability=proposal.capability, params=proposal.params),
                CoveredRecovery(strategy=Strategy.RECOVERY_CAPABILITY, capability="release_and_retract", params={}),
            )
        case _:
            return ()


_INTERNAL_ROWS: Final = (
    RecoveryRule(
        on="grasp_failed", do=(Strategy.RECOVERY_CAPABILITY, Strategy.RETRY), capability="release_and_retract"
    ),
    RecoveryRule(on="object_lost", do=(Strategy.RECOVERY_CAPABILITY, Strategy.RETRY), capability="release_and_retract"),
    RecoveryRule(on="any", do=(Strategy.RETRY, Strategy.TERMINATE)),
)


def recovery_of(method: Method, plan: RecoveryPlan) -> RecoveryPlan:
    """Return what of a recovery plan a method has."""
    match method.recovery:
        case Recovering.GOVERNED:
            return replace(plan, can_ask=plan.can_ask and method.human)
        case Recovering.INTERNAL:
            return replace(plan, rules=_INTERNAL_ROWS, retry_budget=1, rollback="optional", rollback_capability=None)
        case _:
            end = RecoveryRule(on="any", do=(Strategy.TERMINATE,))
            return replace(plan, rules=(end,), retry_budget=0, rollback="optional", rollback_capability=None)


def watch_of(method: Method, plan: WatchPlan) -> WatchPlan:
    """Return what of a watch plan a method has."""
    if not method.guard:  # bounds are what policy allows: a method that does not ask it has none
        plan = replace(plan, bounds=_UNBOUNDED) if method.watch is Watching.NOTHING else plan
    return without(plan, *sorted(UNSEEN[method.watch]))


def grant_of(cell: Workcell, capability: str, params: Params) -> Grant:
    """Return a grant for the ungoverned: the substrate moves on nothing else."""
    permit = Authorization(
        id="permit",
        invocation="trial",
        cell=cell.id,
        capability=capability,
        version="1.0.0",
        params=params,
        mode=Mode.NORMAL,
        profile="ungoverned",
        policy_digest="none",
        issued_at_s=WALL_S,
        expires_at_s=WALL_S + 60.0,
    )
    return verify(
        mint(permit, _KEY),
        key=_KEY.public_key(),
        cell=cell.id,
        policy_digest="none",
        now_s=WALL_S + 1.0,
        used=frozenset(),
    )
