"""Stage 3, first half: may this proposal enter the pipeline at all? a_t = Admit(q_t, Π_t, Γ_t).

| found | outcome | code |
|---|---|---|
| no policy, unknown profile | reject | `no_policy`, `unknown_profile` |
| capability unknown, or not enabled here | reject | `unknown_capability`, `not_in_profile` |
| recovery capability, proposed by an agent | reject | `recovery_only` |
| another version of the capability asked for than is in force | reject | `capability_version` |
| agent not permitted | reject | `permission_missing` |
| agent permitted under supervision | escalate | `permission_supervised` |
| mode not admitted | reject | `mode_not_admitted` |
| a name the site does not know | reject | `unknown_object`, `unknown_target`, … |
| metadata that is not what it should be | reject | `invalid_metadata` |
| cell latched | reject | `estop_latched` |
| cell offline or holding, without a journal, busy | defer | `cell_offline`, `journal_unavailable`, `cell_busy` |
| a precondition is not met | defer | `precondition_unmet` |

Reject > defer > escalate > accept. All reasons of the strongest outcome are reported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from app.governance.conditions import TESTS, unmet
from app.governance.model import Admission, AdmissionOutcome, Reason
from app.governance.policy_code import metadata_fault
from app.governance.policy_model import GOVERNANCE
from app.governance.semver import meets, parse

if TYPE_CHECKING:
    from collections.abc import Iterator

    from app.governance.model import Capability, CellFacts, Context, Proposal
    from app.governance.policy import Gate, PolicySet

ACCEPT: Final = Admission(outcome=AdmissionOutcome.ACCEPT)
RETRY_OFFLINE_S: Final = 2.0
RETRY_BUSY_S: Final = 2.0
RETRY_UNMET_S: Final = 1.0
RULE: Final = "admission"


def admit(policy: PolicySet | None, proposal: Proposal, context: Context) -> Admission:
    """Decide whether a proposal may enter the pipeline.

    Args:
        policy: The active policy; None rejects.
        proposal: Parameters are validated and complete.
        context: Γ_t.
    """
    gate = None if policy is None else policy.gates.get((proposal.capability, context.profile))
    if policy is None or gate is None:
        return _reject(_no_gate(policy, proposal, context))
    if proposal.version is not None and not meets(gate.capability.version, proposal.version):
        return _reject(_other_version(gate.capability, proposal.version))  # its parameters are another version's
    cell = context.cell
    if (
        gate.permissions <= context.agent.permissions
        and proposal.mode in gate.profile.admits
        and cell.online
        and not cell.latched
        and not cell.holding_link
        and cell.recording
        and cell.busy is None
        and not proposal.preconditions
        and (not proposal.metadata or metadata_fault(proposal.metadata) is None)
        and _ready(gate, proposal, cell)
    ):
        return ACCEPT
    return _explain(policy, gate, proposal, context)


def _ready(gate: Gate, proposal: Proposal, cell: CellFacts) -> bool:
    """Say whether every name is known and every precondition met: the short way, without reasons."""
    params, facts = proposal.params, cell.facts
    for param, _, names in gate.known:
        if param in params and params[param] not in names:
            return False
    if facts is None or gate.actions is not None:
        return not _unknown_names(gate, proposal) and not unmet(gate.capability.preconditions, params, facts, gate.site)
    site = gate.site
    for test in gate.tests:  # noqa: SIM110  # a loop costs half of what `all` over a generator does
        if test(params, facts, site) is not None:
            return False
    return True


def _reject(*reasons: Reason) -> Admission:
    return Admission(outcome=AdmissionOutcome.REJECT, reasons=reasons)


def _no_gate(policy: PolicySet | None, proposal: Proposal, context: Context) -> Reason:
    name, profile = proposal.capability, context.profile
    if policy is None:
        return Reason(RULE, "no_policy", "no policy is active, so nothing is admitted", "activate a policy")
    if profile not in policy.profiles:
        known = ", ".join(sorted(policy.profiles))
        return Reason(RULE, "unknown_profile", f"there is no profile `{profile}`", f"one of: {known}")
    if name not in policy.capabilities:
        offered = sorted(known for known, capability in policy.capabilities.items() if not capability.recovery)
        return Reason(
            RULE, "unknown_capability", f"there is no capability `{name[:64]}`", f"one of: {', '.join(offered)}"
        )
    return Reason(RULE, "not_in_profile", f"`{name}` is not enabled in {profile}", "propose another capability")


def _other_version(capability: Capability, asked: str) -> Reason:
    """Name the version in force, and what changed on the way to it, as far as the manifest says."""
    name, present, least = capability.name, parse(capability.version), parse(asked)
    came = sorted((parse(version), said) for version, said in capability.changes.items() if parse(version) > least)
    told = "".join(f"; {version}: {said}" for version, said in came)
    message = f"`{name}` is in force as {present}, and `{asked}` was asked for{told}"
    return Reason(RULE, "capability_version", message, f"propose what {present} takes, or leave the version out")


def _explain(policy: PolicySet, gate: Gate, proposal: Proposal, context: Context) -> Admission:
    rejections = (
        *_not_permitted(policy, gate, context),
        *_wrong_mode(gate, proposal),
        *_unknown_names(gate, proposal),
        *_bad_metadata(proposal),
        *_latched(context.cell),
    )
    if rejections:
        return _reject(*rejections)
    for delay_s, found in (
        (RETRY_OFFLINE_S, _away(context.cell)),
        (RETRY_BUSY_S, _busy(context.cell)),
        (RETRY_UNMET_S, _not_yet(gate, proposal, context.cell)),
    ):
        if reasons := tuple(found):  # what is shadowed by a stronger one is not even looked for
            return Admission(outcome=AdmissionOutcome.DEFER, reasons=reasons, retry_after_s=delay_s)
    asked = tuple(_supervised(policy, gate, context))
    return Admission(outcome=AdmissionOutcome.ESCALATE, reasons=asked) if asked else ACCEPT


def supervised(gate: Gate, context: Context) -> bool:
    """Say whether the agent lacks a permission; of what admission does not reject, it holds that under supervision."""
    return not gate.permissions <= context.agent.permissions


def _missing(gate: Gate, context: Context) -> frozenset[str]:
    return gate.permissions - context.agent.permissions


def _under_supervision(policy: PolicySet, context: Context) -> frozenset[str]:
    agent = policy.agents.get(context.agent.name)
    return frozenset() if agent is None else agent.supervised


def _not_permitted(policy: PolicySet, gate: Gate, context: Context) -> Iterator[Reason]:
    missing = _missing(gate, context)
    if GOVERNANCE in missing:
        message = f"`{gate.capability.name}` is a recovery that governance alone starts"
        yield Reason(RULE, "recovery_only", message, "propose what should be achieved; recovery is not proposed")
        return
    for permission in sorted(missing - _under_supervision(policy, context)):
        message = f"`{context.agent.name}` does not hold the permission `{permission}`"
        yield Reason(RULE, "permission_missing", message, f"leave it to an agent that holds `{permission}`")


def _supervised(policy: PolicySet, gate: Gate, context: Context) -> Iterator[Reason]:
    for permission in sorted(_missing(gate, context)):
        message = f"`{context.agent.name}` holds the permission `{permission}` under supervision only"
        yield Reason(RULE, "permission_supervised", message, "a human decides")


def _wrong_mode(gate: Gate, proposal: Proposal) -> Iterator[Reason]:
    if proposal.mode not in gate.profile.admits:
        admitted = ", ".join(sorted(gate.profile.admits))
        message = f"mode `{proposal.mode}` is not admitted in {gate.profile.name}"
        yield Reason(RULE, "mode_not_admitted", message, f"one of: {admitted}")


def _unknown_names(gate: Gate, proposal: Proposal) -> list[Reason]:
    params = proposal.params
    found = [
        _unknown(kind, params[param], names)
        for param, kind, names in gate.known
        if param in params and params[param] not in names
    ]
    if gate.actions is not None and not found:
        tool_param, action_param = gate.actions
        actions = gate.site.tools[cast("str", params[tool_param])].actions
        if params[action_param] not in actions:
            found.append(_unknown("action", params[action_param], frozenset(actions)))
    return found


def _unknown(kind: str, value: object, names: frozenset[str]) -> Reason:
    return Reason(
        RULE, f"unknown_{kind}", f"there is no {kind} `{str(value)[:64]}`", f"one of: {', '.join(sorted(names))}"
    )


def _bad_metadata(proposal: Proposal) -> Iterator[Reason]:
    name = metadata_fault(proposal.metadata)
    if name is not None:
        remedy = "confidence is a number in 0…1, intent a text, priority an integer"
        yield Reason(RULE, "invalid_metadata", f"metadata `{name}` is not what it should be", remedy)
    for condition in proposal.preconditions:
        if condition not in TESTS:
            known = ", ".join(sorted(TESTS))
            yield Reason(RULE, "unknown_precondition", f"there is no condition `{condition[:64]}`", f"one of: {known}")


def _latched(cell: CellFacts) -> Iterator[Reason]:
    if cell.latched:
        yield Reason(RULE, "estop_latched", f"`{cell.id}` is stopped and latched", "an operator resets it")


def _away(cell: CellFacts) -> Iterator[Reason]:
    if not cell.id:  # nothing to name: none was ever heard of
        yield Reason(RULE, "cell_offline", "no cell has attached yet", "propose again once a cell is connected")
    elif not cell.online:
        yield Reason(RULE, "cell_offline", f"`{cell.id}` is not connected", "propose again later")
    elif cell.holding_link:
        yield Reason(RULE, "cell_offline", f"`{cell.id}` holds because its link lapsed", "propose again later")
    elif not cell.recording:
        message = f"`{cell.id}` cannot write its journal, and moves nothing without"
        yield Reason(RULE, "journal_unavailable", message, "propose again once an operator has made room for it")


def _busy(cell: CellFacts) -> Iterator[Reason]:
    if cell.busy is not None:
        yield Reason(RULE, "cell_busy", f"`{cell.id}` is running `{cell.busy}`", "propose again when it has ended")


def _not_yet(gate: Gate, proposal: Proposal, cell: CellFacts) -> Iterator[Reason]:
    names = gate.capability.preconditions
    if proposal.preconditions:
        names = tuple(dict.fromkeys((*names, *proposal.preconditions)))
    for missing in unmet(names, proposal.params, cell.facts, gate.site):
        yield Reason(f"{RULE}/{missing.condition}", "precondition_unmet", missing.message, missing.remedy)
