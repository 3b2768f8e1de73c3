"""The six methods, five ablations, and the gate they share: governance with parts of it left out (paper, Setup).

| method | admission | guard | modifies | human | second pass | watch | recovery |
|---|---|---|---|---|---|---|---|
| direct | – | – | – | – | – | – | the skill's own retry |
| static-rule | manifest | – | – | – | – | – | the skill's own retry |
| capability-internal | manifest | – | – | – | – | what a skill can see | one retry, release |
| autort-style | full | yes | – | asks | – | – | the skill's own retry |
| roboguard-style | full | yes | yes | asks | speed and force × 0.875 | – | the skill's own retry |
| reins | full | yes | yes | asks | – | every rule of policy | policy's table |

A *manifest* check looks at the capability alone: registered, enabled in the profile, permitted to the agent, mode
admitted. It knows neither places nor objects nor people, which is what the paper calls a static rule ("static rules
miss context-dependent violations").

Nothing here re-implements governance. `pass_gate` calls `admit`, `check` and `need`, and leaves out what a method does
not have.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.admission import admit
from app.governance.authority import need
from app.governance.guard import check
from app.governance.model import Admission, AdmissionOutcome, PolicyOutcome, Verdict

if TYPE_CHECKING:
    from app.governance.model import Context, Json, Params, Proposal
    from app.governance.policy import PolicySet

SECOND_PASS: Final = 0.875
"""RoboGuard-style thresholds of the second pass: 12.5 % stricter, the middle of the paper's 10-15 %."""

_MANIFEST: Final = frozenset(
    {
        "no_policy",
        "unknown_profile",
        "unknown_capability",
        "not_in_profile",
        "recovery_only",
        "permission_missing",
        "mode_not_admitted",
    }
)
_TIGHTENED: Final = ("speed_mps", "force_n")


class Admitting(StrEnum):
    """How much of admission a method has."""

    NOTHING = "nothing"
    MANIFEST = "manifest"
    FULL = "full"


class Watching(StrEnum):
    """What watches an execution."""

    NOTHING = "nothing"
    INTERNAL = "internal"  # the signals a skill has anyway: its grip, its contact force, its own timeout
    GOVERNED = "governed"


class Recovering(StrEnum):
    """What is done about a failure."""

    NOTHING = "nothing"
    RETRY = "retry"  # the agent tries the same thing again
    INTERNAL = "internal"  # a skill releases and tries again
    GOVERNED = "governed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One row of the table above. `tier` is the paper's: 1 none, 2 before execution only, 3 at runtime as well."""

    name: str
    title: str
    tier: int
    admission: Admitting = Admitting.NOTHING
    guard: bool = False
    modifies: bool = False
    human: bool = False
    second_pass: float | None = None
    watch: Watching = Watching.NOTHING
    recovery: Recovering = Recovering.RETRY

    @property
    def runtime(self) -> tuple[Watching, Recovering, bool]:
        """Return what tells executions apart: methods equal in this behave alike once they have launched the same."""
        return self.watch, self.recovery, self.human


REINS: Final = Method(
    name="reins",
    title="Reins",
    tier=3,
    admission=Admitting.FULL,
    guard=True,
    modifies=True,
    human=True,
    watch=Watching.GOVERNED,
    recovery=Recovering.GOVERNED,
)

METHODS: Final[Mapping[str, Method]] = {
    method.name: method
    for method in (
        Method(name="direct", title="Direct execution", tier=1),
        Method(name="static-rule", title="Static rule", tier=2, admission=Admitting.MANIFEST),
        Method(
            name="capability-internal",
            title="Capability-internal",
            tier=2,
            admission=Admitting.MANIFEST,
            watch=Watching.INTERNAL,
            recovery=Recovering.INTERNAL,
        ),
        Method(name="autort-style", title="AutoRT-style", tier=2, admission=Admitting.FULL, guard=True, human=True),
        Method(
            name="roboguard-style",
            title="RoboGuard-style",
            tier=2,
            admission=Admitting.FULL,
            guard=True,
            modifies=True,
            human=True,
            second_pass=SECOND_PASS,
        ),
        REINS,
    )
}

ABLATIONS: Final[Mapping[str, Method]] = {
    method.name: method
    for method in (
        replace(REINS, name="-admission", title="− admission", admission=Admitting.NOTHING),
        replace(REINS, name="-policy", title="− policy guard", guard=False, modifies=False),
        replace(REINS, name="-watcher", title="− watcher", watch=Watching.NOTHING),
        replace(REINS, name="-recovery", title="− recovery", recovery=Recovering.NOTHING),
        replace(REINS, name="-human", title="− human override", human=False),
    )
}


class Passed(NamedTuple):
    """What came of a proposal at the gate: launched or not, by which part stopped, and with which parameters.

    `by` is `admission`, `guard`, `second_pass`, `authority`, or empty where it was launched; `codes` are the reasons'.
    """

    launched: bool
    by: str
    effective: Params
    codes: tuple[str, ...]
    modified: bool = False


def pass_gate(method: Method, policy: PolicySet, proposal: Proposal, context: Context, *, approved: bool) -> Passed:
    """Take a proposal through as much of Stage 3 as a method has.

    Args:
        method: Which parts there are.
        policy: Π.
        proposal: q_t, parameters validated and complete.
        context: Γ_t.
        approved: Whether a human who is asked says yes.
    """
    admission = _admitted(method, policy, proposal, context)
    if admission.outcome in (AdmissionOutcome.REJECT, AdmissionOutcome.DEFER):
        return Passed(False, "admission", proposal.params, tuple(reason.code for reason in admission.reasons))
    allowed = Verdict(outcome=PolicyOutcome.ALLOW, effective=proposal.params)
    verdict = check(policy, proposal, context) if method.guard else allowed
    codes = tuple(reason.code for reason in verdict.reasons)
    if verdict.outcome is PolicyOutcome.DENY or (verdict.changes and not method.modifies):
        return Passed(False, "guard", proposal.params, codes)
    if method.second_pass is not None and _too_much(policy, method.second_pass, proposal, verdict.effective, context):
        return Passed(False, "second_pass", verdict.effective, codes)
    wanted = need(policy, proposal, admission, verdict, context)
    asks = wanted is not None or PolicyOutcome.ESCALATE is verdict.outcome
    if method.human and asks and not (wanted is not None and approved):
        return Passed(False, "authority", verdict.effective, codes)
    return Passed(True, "", verdict.effective, codes, bool(verdict.changes))


def _admitted(method: Method, policy: PolicySet, proposal: Proposal, context: Context) -> Admission:
    accepted = Admission(outcome=AdmissionOutcome.ACCEPT)
    if method.admission is Admitting.NOTHING:
        return accepted
    admission = admit(policy, proposal, context)
    if method.admission is Admitting.FULL:
        return admission
    static = tuple(reason for reason in admission.reasons if reason.code in _MANIFEST)
    return Admission(outcome=AdmissionOutcome.REJECT, reasons=static) if static else accepted


def _too_much(policy: PolicySet, share: float, proposal: Proposal, effective: Params, context: Context) -> bool:
    """Say whether parameters exceed what a tightened policy would leave of the most that policy allows."""
    probe: dict[str, Json] = {**effective, **{name: 1e6 for name in _TIGHTENED if name in effective}}
    most = check(policy, replace(proposal, params=probe), context).effective
    return any(_number(effective[name]) > share * _number(most[name]) for name in _TIGHTENED if name in effective)


def _number(value: Json) -> float:
    return float(value) if isinstance(value, (int, float)) else 0.0
