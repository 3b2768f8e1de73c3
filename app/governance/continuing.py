"""May a session that runs go on, when another policy has come into force meanwhile?

Asked is only what the new policy says otherwise than the one the session was authorized under, both in the world as it
is now: a session in mid-grasp has its gripper closed, and no precondition of its launch need hold any more. What both
say is no news, and what the new one leaves freer touches only what starts later.

| the new policy | the session |
|---|---|
| does not admit it (capability, profile, permission, mode, names), or takes other parameters for it | departs |
| denies it, or holds its parameters tighter | departs |
| has something else under a name that says where it works, or in the way of it or of what recovers it | departs |
| watches it more strictly, recovers it less or otherwise, or has a further phase confirmed | departs |
| has people asked about what recovers it, denies that, or holds or watches it tighter | departs |
| wants a human's word that the old one did not want | departs, and one person's word lets it go on |

A session cannot be bound to other parameters while it runs: what departs in any way but the last may only end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import dist
from typing import TYPE_CHECKING, Final

from app.governance.admission import admit
from app.governance.authority import need
from app.governance.coverage import acting_for, recoveries
from app.governance.guard import check
from app.governance.model import Admission, AdmissionOutcome, PolicyOutcome, Reason, Strategy
from app.governance.places import beside, moved, places
from app.governance.plans import confirm_before, recovery_plan, watch_plan
from app.governance.policy_model import GOVERNANCE
from app.governance.recovery import DEFAULT_BUDGET

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from app.governance.model import (
        ApprovalNeed,
        Context,
        CoveredRecovery,
        Proposal,
        RecoveryPlan,
        Verdict,
        WatchPlan,
        WatchRule,
    )
    from app.governance.policy import PolicySet

RULE: Final = "policy/changed"
CHANGED: Final = "policy_changed"
END_IT: Final = "end it, and propose again"
ANY: Final = "any"
OTHER_VERSION: Final = "capability_version"
DRIVES_M: Final = 0.6  # as far as what recovers a session drives by itself, onto a stand that is near
REACH_M: Final = 1.2  # and as far as the base then reaches
ACCEPTED: Final = Admission(outcome=AdmissionOutcome.ACCEPT)


@dataclass(frozen=True, slots=True, kw_only=True)
class Departure:
    """Why a session does not conform to another policy, without reasons it does; `askable`: a human may let it."""

    reasons: tuple[Reason, ...] = ()
    askable: bool = False

    def __bool__(self) -> bool:
        """Say whether it departs."""
        return bool(self.reasons)


CONFORMS: Final = Departure()


def departure(
    old: PolicySet | None,
    new: PolicySet,
    proposal: Proposal,
    context: Context,
    covered: Sequence[CoveredRecovery] | None = None,
    *,
    led: bool = False,
) -> Departure:
    """Say how a running session departs from another policy. Pure.

    Args:
        old: what it was authorized under; None where that is not known any more: then everything is news.
        new: what is in force now.
        proposal: what runs, with its effective parameters.
        context: Γ_t now, the agent as the new policy knows it; whether the cell is busy does not matter.
        covered: the recoveries that its authorization covers, whatever the world was like then; None where they are
            not known: then what the old policy would have covered in the world as it is now.
        led: a human has driven it: what undoes it goes back as far as that led.
    """
    if misfits := _misfits(old, new, proposal):  # nothing could be asked about those
        return Departure(reasons=misfits)
    taken = _as_taken_by(new, proposal)
    admission, verdict = admit(new, taken, context), check(new, taken, context)
    if old is None:
        refused = admission.reasons if admission.outcome is AdmissionOutcome.REJECT else verdict.reasons
        return Departure(reasons=(*refused, GONE))
    if any(reason.code == OTHER_VERSION for reason in admission.reasons):  # its parameters are another version's
        return Departure(reasons=admission.reasons)
    then = _as_known_by(old, context)
    before, said = admit(old, proposal, then), check(old, proposal, then)
    refused = (
        *_rejected(admission, before),
        *_held(verdict, said, taken),
        *_moved(old, new, proposal, context),
        *_watched(old, new, proposal, context),
        *_recovered(old, new, _covered(old, proposal, then, covered), then, context, led=led),
    )
    refused = tuple(dict.fromkeys(refused))  # a watch rule may be of the session and of what recovers it
    if refused:
        return Departure(reasons=refused)
    wanted = _wanted(new, taken, admission, verdict, context)
    return _asks(wanted, _wanted(old, proposal, before, said, then))


def _as_known_by(policy: PolicySet, context: Context) -> Context:
    """Return Γ_t with the agent as another policy knows it: a permission that was taken away is news."""
    name = context.agent.name
    return replace(context, agent=policy.governance() if name == GOVERNANCE else policy.agent(name))


def _misfits(old: PolicySet | None, new: PolicySet, proposal: Proposal) -> tuple[Reason, ...]:
    """Return why what runs has other parameters than its capability takes by now; what both say is no news."""
    found, known = (
        None if policy is None else policy.validate_params(proposal.capability, proposal.params, proposal.version)
        for policy in (new, old)
    )
    if not isinstance(found, tuple) or found == known:
        return ()
    takes = f"`{proposal.capability}` takes other parameters now"
    return tuple(_news("params_invalid", f"{takes}: {problem.said}") for problem in found)


def _as_taken_by(policy: PolicySet, proposal: Proposal) -> Proposal:
    """Return what runs as a policy takes it: with the default of what its capability takes besides by now."""
    params = policy.validate_params(proposal.capability, proposal.params, proposal.version)
    return proposal if isinstance(params, tuple) else replace(proposal, params=params)


def _rejected(admission: Admission, before: Admission) -> tuple[Reason, ...]:
    """Return why the new policy does not admit what runs, but for what the old one would say as well."""
    if admission.outcome is not AdmissionOutcome.REJECT:
        return ()
    return tuple(reason for reason in admission.reasons if reason not in before.reasons)


def _held(verdict: Verdict, said: Verdict, taken: Proposal) -> tuple[Reason, ...]:
    """Return why the verdict refuses or binds what runs, as the new policy takes it, where the old one did not."""
    if verdict.outcome is PolicyOutcome.DENY:
        known = said.reasons if said.outcome is PolicyOutcome.DENY else ()
        # A rule that cannot be evaluated now, for want of fresh facts, says nothing about what it would have said.
        return tuple(reason for reason in verdict.reasons if reason.code == "rule_error" or reason not in known)
    if verdict.effective in (taken.params, {**taken.params, **said.effective}):
        return ()
    by = {change.rule for change in verdict.changes}
    return tuple(reason for reason in verdict.reasons if reason.rule in by) or verdict.reasons


def _moved(old: PolicySet, new: PolicySet, proposal: Proposal, context: Context) -> tuple[Reason, ...]:
    """Return which places that what runs names are others by now: it works where the old site has them.

    What drives also keeps clear of what the old site has in its way. What has no place any more admission says; where
    an object is, sensors do.
    """
    gate, found = old.gates.get((proposal.capability, context.profile)), list[Reason]()
    known = () if gate is None else gate.known
    for param, kind, _ in known:
        name = str(proposal.params.get(param))
        was, now = (places(policy.site).get(kind, {}).get(name) for policy in (old, new))
        if now is not None and now != was:
            found.append(_news("place_changed", f"the {kind} `{name}` is another place in the site now"))
    found += _ends_otherwise(old, new, proposal, None if gate is None else gate.actions)
    if any(kind == "target" for _, kind, _ in known):
        others = moved(old.site, new.site)
        found += [_news("place_changed", f"`{name}`, of which it keeps clear, is elsewhere now") for name, _ in others]
    return tuple(found)


def _ends_otherwise(
    old: PolicySet, new: PolicySet, proposal: Proposal, named: tuple[str, str] | None
) -> Iterator[Reason]:
    """Yield why what is done with a tool ends in another state by now; what the tool can do besides is no matter."""
    if named is None:
        return
    name, action = (str(proposal.params.get(param)) for param in named)
    tools = [policy.site.tools.get(name) for policy in (old, new)]
    was, now = (None if tool is None else tool.actions.get(action) for tool in tools)
    if now is not None and now != was:
        yield _news("place_changed", f"`{action}` of the tool `{name}` ends in another state in the site now")


def _wanted(
    policy: PolicySet, proposal: Proposal, admission: Admission, verdict: Verdict, context: Context
) -> ApprovalNeed | None:
    """Return what authority would ask; what admission defers is of no matter to what runs."""
    waits = admission.outcome in (AdmissionOutcome.DEFER, AdmissionOutcome.REJECT)
    return need(policy, proposal, ACCEPTED if waits else admission, verdict, context)


def _asks(wanted: ApprovalNeed | None, asked: ApprovalNeed | None) -> Departure:
    if wanted is None:
        return CONFORMS
    known = () if asked is None else asked.reasons
    fresh = tuple(reason for reason in wanted.reasons if reason not in known)
    more = asked is not None and wanted.approvers > asked.approvers
    if not fresh and not more:
        return CONFORMS
    return Departure(reasons=fresh or wanted.reasons, askable=wanted.approvers == 1)


def _covered(
    old: PolicySet, proposal: Proposal, then: Context, covered: Sequence[CoveredRecovery] | None
) -> list[Proposal]:
    """Return what else than itself a session may be recovered by without anybody being asked, as that would run.

    What is not to be had just now counts as well: a grasp that holds nothing yet has nothing to release.
    """
    if (proposal.capability, then.profile) not in old.gates:
        return []
    if covered is not None:
        named = (one for one in covered if one.capability != proposal.capability)
        return [
            replace(
                proposal, capability=one.capability, params=one.params, mode=one.mode, preconditions=(), version=None
            )
            for one in named
        ]
    by = replace(then, agent=acting_for(then.agent))
    wanted = ((asked, admit(old, asked, by), check(old, asked, by)) for asked in recoveries(old, proposal, then))
    return [replace(asked, params=said.effective) for asked, before, said in wanted if _unasked(before, said)]


def _recovered(
    old: PolicySet, new: PolicySet, covered: list[Proposal], then: Context, context: Context, *, led: bool
) -> tuple[Reason, ...]:
    """Return why the new policy would not have the session recovered by what its authorization covers."""
    by_old, by_new = (replace(known, agent=acting_for(known.agent)) for known in (then, context))
    found = [*_beside(old, new, context, led=led)] if covered else list[Reason]()
    for runs in covered:
        if misfits := _misfits(old, new, runs):
            found += misfits
            continue
        taken = _as_taken_by(new, runs)
        before, said = admit(old, runs, by_old), check(old, runs, by_old)
        admission, verdict = admit(new, taken, by_new), check(new, taken, by_new)
        news = (*_rejected(admission, before), *_held(verdict, said, taken))
        if not news and not _unasked(admission, verdict):
            known = () if _unasked(before, said) else (*before.reasons, *said.reasons)
            news = tuple(reason for reason in (*admission.reasons, *verdict.reasons) if reason not in known)
        found += news
        found += _watched_tighter(old, new, runs, context)
    return tuple(found)


def _beside(old: PolicySet, new: PolicySet, context: Context, *, led: bool) -> Iterator[Reason]:
    """Yield what is elsewhere by now where what recovers a session may drive by itself.

    All that is elsewhere, while nobody knows where the robot is, or how far back its way leads.
    """
    facts = context.cell.facts
    at = None if facts is None else facts.base[:2]
    stands = {(found.x_m, found.y_m, found.yaw_rad) for found in new.site.targets.values()}
    for name, found in old.site.targets.items():
        near = at is None or dist(at, (found.x_m, found.y_m)) <= DRIVES_M
        if near and (found.x_m, found.y_m, found.yaw_rad) not in stands:
            yield _news("place_changed", f"`{name}`, onto which what recovers it may drive, is elsewhere now")
    for name, place in moved(old.site, new.site):
        if led or at is None or beside(at, place, REACH_M):
            yield _news("place_changed", f"`{name}`, beside which what recovers it may drive, is elsewhere now")


def _unasked(admission: Admission, verdict: Verdict) -> bool:
    """Say whether nobody has to be asked about a recovery, so that an authorization may cover it."""
    barred = admission.outcome in (AdmissionOutcome.REJECT, AdmissionOutcome.ESCALATE)
    return not barred and verdict.outcome in (PolicyOutcome.ALLOW, PolicyOutcome.MODIFY)


# Watching ------------------------------------------------------------------------------------------------------------


def _watched(old: PolicySet, new: PolicySet, proposal: Proposal, context: Context) -> tuple[Reason, ...]:
    """Return why the plan that the session is watched by is not strict enough any more."""
    pair = (proposal.capability, context.profile)
    if pair not in old.gates:
        return (GONE,)
    if pair not in new.gates:
        return ()  # which admission says
    found = _watched_tighter(old, new, proposal, context)
    before, after = (recovery_plan(policy, *pair) for policy in (old, new))
    found += [_news("recovery_tighter", f"{what} is bound tighter now") for what in _recovers_less(before, after)]
    further = [phase for phase in confirm_before(new, *pair) if phase not in confirm_before(old, *pair)]
    found += [_news("confirmation_added", f"a human confirms `{phase}` now") for phase in further]
    return tuple(found)


def _watched_tighter(old: PolicySet, new: PolicySet, proposal: Proposal, context: Context) -> list[Reason]:
    pair = (proposal.capability, context.profile)
    if pair not in new.gates:
        return []  # which admission says
    if pair not in old.gates:
        return [GONE]
    bound = ((old, proposal), (new, _as_taken_by(new, proposal)))
    plans = [watch_plan(policy, *pair, runs.params, runs.mode) for policy, runs in bound]
    return [_news("watched_tighter", f"{what} tighter now") for what in _stricter(*plans)]


def _news(code: str, message: str) -> Reason:
    return Reason(RULE, code, message, END_IT)


def _recovers_less(old: RecoveryPlan, new: RecoveryPlan) -> list[str]:
    """Name what a plan may leave a session less to recover by: all that is another and not plainly more."""
    rolls_back = new.rollback == old.rollback or new.rollback == "optional"
    undone = old.rollback_capability in (None, new.rollback_capability)
    found = [] if new.retry_budget >= old.retry_budget and rolls_back and undone else ["recovery"]
    named = sorted({row.on for plan in (old, new) for row in plan.rules} - {ANY})
    found += [f"what follows `{name}`" for name in named if not _within(_steps(old, name), _steps(new, name))]
    return found if _within(_steps(old, ANY), _steps(new, ANY)) else [*found, "what follows any other failure"]


def _steps(plan: RecoveryPlan, failure: str) -> list[tuple[Strategy, str | None, int]]:
    """Return what a plan has tried after a failure, in order: with which capability, and how often at most."""
    for row in plan.rules:
        if row.on in (failure, ANY) and plan.risk in row.risks:
            by = {Strategy.RECOVERY_CAPABILITY: row.capability}
            had = (step for step in row.do if step is not Strategy.SAFER_MODE or plan.careful_admitted)
            return [(step, by.get(step), row.budget.get(step, DEFAULT_BUDGET)) for step in had]
    return []


def _within(steps: list[tuple[Strategy, str | None, int]], wider: list[tuple[Strategy, str | None, int]]) -> bool:
    """Say whether all steps are among others, in the same order, and each as often."""
    left = iter(wider)
    return all(
        any((what, by) == (step, name) and most >= times for what, by, most in left) for step, name, times in steps
    )


def not_comparable(error: Exception) -> Departure:
    """Return how something departs that cannot be compared: nobody knows what the new policy has against it."""
    why = f"it cannot be compared with the policy in force ({type(error).__name__}: {error}); see the server's log"
    return Departure(reasons=(_news("not_comparable", why),))


GONE: Final = _news("its_policy_is_gone", "the policy it was authorized under is not known here any more")


def _stricter(old: WatchPlan, new: WatchPlan) -> list[str]:
    """Name what a plan may hold tighter than another: all that is another and not plainly wider."""
    before, after = {rule.id: rule for rule in old.rules}, {rule.id: rule for rule in new.rules}
    found = [
        f"the watch rule `{name}` is"
        for name, rule in after.items()
        if name not in before or _sooner(before[name], rule)
    ]
    bounds = zip(old.bounds, new.bounds, old.bounds._fields, strict=True)
    found += [f"the bound `{name}` is" for was, now, name in bounds if now < was]
    parts = (
        ("sensitivity is", new.sensitivity > old.sensitivity),
        ("the time it may take is", new.timeout_s < old.timeout_s),
        ("separation is", new.separation != old.separation and new.separation is not None),
        ("a forbidden zone is", not {zone.polygon for zone in new.zones} <= {zone.polygon for zone in old.zones}),
        ("the age of what sensors say is", _fresher(old, new)),
        ("what has to hold afterwards is", not set(new.postconditions) <= set(old.postconditions)),
        ("braking is", new.base_deceleration_mps2 != old.base_deceleration_mps2),
        ("the room it takes is", new.base_radius_m != old.base_radius_m),
    )
    return found + [what for what, stricter in parts if stricter]


def _sooner(before: WatchRule, after: WatchRule) -> bool:
    """Say whether a watch rule may answer sooner or otherwise than it did."""
    same = ("signal", "emits", "response", "above", "method", "failure")
    if any(getattr(before, name) != getattr(after, name) for name in same) or after.for_ms < before.for_ms:
        return True
    if before.threshold is None or after.threshold is None:
        return before.threshold != after.threshold
    return after.threshold < before.threshold if before.above else after.threshold > before.threshold


def _fresher(old: WatchPlan, new: WatchPlan) -> bool:
    ages = old.stale_after_ms
    return any(name not in ages or age < ages[name] for name, age in new.stale_after_ms.items())
