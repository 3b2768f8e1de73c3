"""The kernel: asks governance, and turns what it answers into events, documents and authorizations.

It decides nothing itself. `judge` builds the context Γ_t from what is known now and calls the pure decision; the
policy in force is read once per judgement, so that a proposal is decided under one policy from end to end. `launch`
mints: the authorization becomes durable inside the context, and is sent only when that has succeeded.
"""

from __future__ import annotations

import base64
import logging
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import orjson

from app.audit.event import EventDraft, RowWrite
from app.clock import monotonic_s
from app.governance.admission import RETRY_UNMET_S
from app.governance.authority import handled
from app.governance.continuing import departure, not_comparable
from app.governance.control import TAKEOVER
from app.governance.coverage import covered_recoveries
from app.governance.decision import Decision, decide
from app.governance.model import (
    AdmissionOutcome,
    ApprovalNeed,
    Authorization,
    Context,
    CoveredRecovery,
    EventKind,
    Outcome,
    Proposal,
    Reason,
    Risk,
    Role,
    Status,
    Strategy,
)
from app.governance.permit import mint
from app.governance.plans import confirm_before
from app.governance.recorded import ANEW, circumstances
from app.governance.recorded import KEY as CIRCUMSTANCES
from app.protocol import Launch
from app.runtime.cells import LAUNCH_WITHIN_S, Moment
from app.runtime.drafts import GRANTED, SERVER
from app.runtime.errors import Conflict, GaveWay, InvalidParams
from app.runtime.identity import Identities
from app.runtime.invocation import reasons_document
from app.runtime.link import key_text

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Mapping, Sequence

    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from app.governance.continuing import Departure
    from app.governance.model import Grant
    from app.governance.policy import ParamProblem, PolicySet
    from app.runtime.cells import Cell
    from app.runtime.fleet import Fleet
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.register import Register

log = logging.getLogger(__name__)

ON_DUTY_S: Final = 120.0  # an operator who was heard within this is on duty
SESSION_RULE: Final = "runtime/session"
REFUSED_OUTCOME: Final[Mapping[Status, Outcome]] = {
    Status.REJECTED: Outcome.REJECTED,
    Status.DEFERRED: Outcome.DEFERRED,
    Status.DENIED: Outcome.DENIED,
}
CHANGED: Final = Reason(
    "authority/approval",
    "conditions_changed",
    "policy constrains this differently now than when it was approved",
    "propose again",
)
ANOTHER_PROFILE: Final = Reason(
    "authority/approval",
    "profile_changed",
    "the cell was put under another profile before anybody approved this",
    "propose again",
)
EDITED: Final = Reason(
    "authority/approval",
    "edit_not_approved",
    "nobody approved what a person had made of this, and nobody is asked about it any more",
    "propose again",
)


class Judgement(NamedTuple):
    """A decision together with the policy and profile it was made under, and what it was made on."""

    decision: Decision
    policy: PolicySet
    profile: str
    proposal: Proposal
    context: Context

    @property
    def need(self) -> ApprovalNeed | None:
        """Return what authority asks for before launch."""
        return self.decision.need

    @property
    def grant(self) -> str | None:
        """Return the standing grant that answers what authority asks for."""
        grant = self.decision.grant
        return None if grant is None else grant.id

    @property
    def status(self) -> Status:
        """Return the status an invocation begins in; `allowed` begins a session."""
        status = self.decision.status
        return Status.RUNNING if status == "allowed" else status

    @property
    def refused(self) -> bool:
        """Say whether governance will not have it at all, now or later."""
        return self.decision.status in (Status.REJECTED, Status.DENIED)

    def effective(self, requested: Mapping[str, Any]) -> dict[str, Any]:
        """Return the constrained parameters; those requested, where nothing was checked."""
        verdict = self.decision.verdict
        return dict(requested if verdict is None else verdict.effective)

    def conforms(self, approved: Mapping[str, Any]) -> bool:
        """Say whether an approved proposal may launch now, with exactly these parameters."""
        if self.refused or self.decision.admission.outcome is AdmissionOutcome.DEFER:
            return False
        return self.effective({}) == dict(approved)

    @property
    def by_grant(self) -> tuple[str, ...]:
        """Return who approved what nobody is asked about: that grant, in an approver's place, or nobody."""
        return () if self.grant is None else (f"{GRANTED}{self.grant}",)

    def reasons(self) -> tuple[Reason, ...]:
        """Return all reasons, admission's first."""
        verdict = self.decision.verdict
        return (*self.decision.admission.reasons, *(() if verdict is None else verdict.reasons))

    def parts(self) -> dict[str, Any]:
        """Return what an invocation says of its decision: admission, policy, profile and policy version."""
        return {
            "admission": self.admission_document(),
            "policy": self.policy_document(),
            "profile": self.profile,
            "policy_version": self.policy.digest,
        }

    def admission_document(self) -> dict[str, Any]:
        """Return the admission as JSON; `retry_after_s` stands with a defer."""
        admission = self.decision.admission
        document: dict[str, Any] = {"outcome": admission.outcome, "reasons": reasons_document(admission.reasons)}
        if admission.retry_after_s is not None:
            document["retry_after_s"] = admission.retry_after_s
        return document

    def policy_document(self) -> dict[str, Any] | None:
        """Return the verdict as JSON; None where admission left nothing to check."""
        verdict = self.decision.verdict
        if verdict is None:
            return None
        return {
            "outcome": verdict.outcome,
            "reasons": reasons_document(verdict.reasons),
            "changes": [change._asdict() for change in verdict.changes],
        }

    def asking_document(self) -> dict[str, Any] | None:
        """Return as JSON what people would be asked; None where nobody is."""
        need = self.need
        if need is None:
            return None
        return {"reasons": reasons_document(need.reasons), "needed": need.approvers, "within_s": need.within_s}

    def events(self, invocation: Invocation) -> list[EventDraft]:
        """Return the events of the decision, as the invocation shows it."""
        mark = {} if invocation.grant is None else {"grant": invocation.grant}
        return self._events(invocation, invocation.admission, invocation.policy, mark)

    def taking_events(self, driving: Invocation) -> list[EventDraft]:
        """Return the events of deciding on how somebody drives what runs; they say nothing of the session itself."""
        return self._events(driving, self.admission_document(), self.policy_document(), {TAKEOVER: True})

    def refused_back(self, session: Invocation, by: str, bound: str) -> list[EventDraft]:
        """Return the events of deciding again on a session that somebody hands back, and has to be told of first."""
        mark = {"recheck": True, "hand_back": {"by": by, "digest": bound, "refused": self.asking_document()}}
        return self._events(session, self.admission_document(), self.policy_document(), mark)

    def recheck_events(self, invocation: Invocation) -> list[EventDraft]:
        """Return the events of deciding again, with the last approval, on what was approved; `recheck` marks them."""
        if invocation.final:  # it ended by this decision, and shows what leads there from the request
            mark = {"recheck": True, ANEW: self.policy_document()}
            return self._events(invocation, invocation.admission, invocation.policy, mark)
        return self._events(invocation, self.admission_document(), self.policy_document(), {"recheck": True})

    def _events(
        self,
        invocation: Invocation,
        admission: Mapping[str, Any],
        policy: Mapping[str, Any] | None,
        mark: Mapping[str, Any],
    ) -> list[EventDraft]:
        body = {
            **admission,
            **mark,
            "cell": invocation.cell,
            "profile": self.profile,
            "status": invocation.status,  # what admission and guard come to together
            CIRCUMSTANCES: circumstances(self.proposal, self.context, self.policy, self.decision),
        }
        drafts = [EventDraft(kind=EventKind.ADMISSION, actor=SERVER, invocation=invocation.id, body=body)]
        if policy is not None:
            body = {
                **policy,
                **mark,
                "effective": invocation.effective,
                "profile": self.profile,
                "policy_version": self.policy.digest,
            }
            drafts.append(EventDraft(kind=EventKind.POLICY, actor=SERVER, invocation=invocation.id, body=body))
        return drafts

    def refuse(self, invocation: Invocation, because: Reason = CHANGED) -> Invocation:
        """Return the invocation ended as this decision says; for `because`, where this would let it launch."""
        effective = self.effective(invocation.effective or {})
        status, invocation = self.status, replace(invocation, effective=effective, **self.parts())
        if status not in REFUSED_OUTCOME:  # it may launch, but not with what was approved
            admission = {
                "outcome": AdmissionOutcome.DEFER,
                "reasons": [*invocation.admission["reasons"], because._asdict()],
                "retry_after_s": RETRY_UNMET_S,
            }
            return replace(invocation, status=Status.DEFERRED, outcome=Outcome.DEFERRED, admission=admission)
        return replace(invocation, status=status, outcome=REFUSED_OUTCOME[status])

    def ending_reasons(self, because: Reason = CHANGED) -> list[dict[str, str]]:
        """Return why a proposal that was asked about did not launch; `because` where the decision would let it."""
        if self.status not in REFUSED_OUTCOME:
            return [because._asdict()]
        return reasons_document(self.reasons())


@dataclass(frozen=True, slots=True, kw_only=True)
class Launching:
    """A launch in the making: what has to be durable before it is sent."""

    invocation: Invocation
    events: tuple[EventDraft, ...]
    rows: tuple[RowWrite, ...]


class Kernel:
    """Decides by the policy in force, and signs what may move."""

    def __init__(
        self,
        register: Register,
        fleet: Fleet,
        policy: PolicySet,
        signing_key: Ed25519PrivateKey,
    ) -> None:
        """Put a policy in force, under a signing key."""
        self.policy = policy
        self.identities = Identities(register.now_s)
        self._register = register
        self._fleet = fleet
        self._key = signing_key
        self._operator_heard_s: float | None = None
        self.outlived: Callable[[Invocation, Judgement, bool], tuple[Reason, ...]] = lambda _, __, ___: ()
        self.abandon: Callable[[str, tuple[Reason, ...]], None] = lambda _, __: None
        self.standing: Callable[[Cell | None], tuple[Grant, ...]] = lambda _: ()
        self.enforce(policy)

    def enforce(self, policy: PolicySet) -> None:
        """Put a policy in force, here and on every cell: one reference moves, and nothing is awaited."""
        self.policy = policy
        self._fleet.enforce(
            kernel_key=key_text(self._key.public_key().public_bytes_raw()),
            policy_digest=policy.digest,
            policy_files=policy.files,
            profiles=self.profiles(),
        )

    # -- what the context knows --------------------------------------------------------------------------------------

    def heard(self, principal: Principal) -> None:
        """Note that somebody spoke; an operator heard lately is on duty."""
        if principal.role is Role.OPERATOR:
            self._operator_heard_s = monotonic_s()

    @property
    def operator_on_duty(self) -> bool:
        """Say whether an operator was heard within the last `ON_DUTY_S`."""
        return self._operator_heard_s is not None and monotonic_s() - self._operator_heard_s <= ON_DUTY_S

    def risk(self, capability: str) -> str:
        """Return the risk a capability declares; the worst, where policy dropped it while a session of it lives."""
        known = self.policy.capabilities.get(capability)
        return (Risk.CRITICAL if known is None else known.risk).value

    def profiles(self) -> frozenset[str]:
        """Return the profiles that policy knows."""
        return frozenset(self.policy.profiles)

    def fill_in(self, capability: str, params: Mapping[str, Any], version: str | None = None) -> dict[str, Any]:
        """Return parameters held against the capability's schema, defaults filled in.

        A capability nobody registered has no schema here, nor has another version than is in force: parameters stay as
        they are, and admission rejects the proposal.

        Raises:
            InvalidParams: what does not fit, each with its place.
        """
        found = self.policy.validate_params(capability, params, version)
        if isinstance(found, tuple):
            raise InvalidParams([{"path": _path(problem), "message": _message(problem)} for problem in found])
        return dict(found)

    def judge(
        self, proposal: Proposal, agent: str | None, cell: Cell | None, *, within: Invocation | None = None
    ) -> Judgement:
        """Decide on a proposal with everything known now.

        Args:
            proposal: what is proposed.
            agent: by whom; None: by governance itself, which is no name that somebody could bear.
            cell: where.
            within: the session that has the cell, where the proposal is about that very session: it keeps its profile,
                and is not in its own way.
        """
        policy = self.policy
        profile = self._fleet.profile(cell) if within is None else within.profile
        facts = self._fleet.facts(cell)
        context = Context(
            time_s=self._register.now_s(),
            profile=profile,
            agent=policy.governance() if agent is None else policy.agent(agent),
            cell=facts if within is None else replace(facts, busy=None),
            operator_on_duty=self.operator_on_duty,
            grants=self.standing(cell),
        )
        return Judgement(decide(policy, proposal, context), policy, profile, proposal, context)

    def carried(self, invocation: Invocation, params: Mapping[str, Any]) -> str | None:
        """Return the object in the gripper where that is what an invocation handles: no parameter of it names one."""
        found = self.handled(invocation, params)
        return None if found in params.values() else found

    def handled(self, invocation: Invocation, params: Mapping[str, Any]) -> str | None:
        """Return the object that an invocation handles: the one that a parameter names, else the one in the gripper."""
        context = self.context(invocation.capability, invocation.agent, invocation)
        return handled(self.policy, invocation.proposal(params), context)

    def context(self, capability: str, agent: str, within: Invocation, *, profile: str | None = None) -> Context:
        """Return Γ_t as it is now around an invocation that is there already, and is not in its own way."""
        cell = self._fleet.cell(within.cell) if within.cell else None
        policy = self.policy
        return Context(
            time_s=self._register.now_s(),
            profile=within.profile if profile is None else profile,
            agent=policy.governance() if capability == TAKEOVER else policy.agent(agent),
            cell=replace(self._fleet.facts(cell), busy=None),
            operator_on_duty=self.operator_on_duty,
        )

    def departure(
        self,
        old: PolicySet | None,
        proposal: Proposal,
        context: Context,
        covered: Sequence[CoveredRecovery] | None = None,
        *,
        led: bool = False,
    ) -> Departure:
        """Say how what was authorized under another policy departs from the one in force.

        What cannot be compared departs: whatever is wrong with that, all others have to be compared as well, and held.
        """
        try:
            return departure(old, self.policy, proposal, context, covered, led=led)
        except Exception as error:
            log.exception("`%s` cannot be compared with the policy in force", proposal.capability)
            return not_comparable(error)

    # -- launching ---------------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def launch(
        self,
        invocation: Invocation,
        judgement: Judgement,
        approvals: tuple[str, ...] = (),
        *,
        anew: Moment | None = None,
    ) -> AsyncGenerator[Launching]:
        """Claim the cell, mint, let the caller make it durable inside, and only then send it.

        Nothing is awaited between the decision and the claim, so one cell cannot be promised twice. If the inside
        raises, the claim is given back and nothing was sent. A cell that is gone by then never gets it: the session
        is resolved when the cell is back, or has been away too long.

        Args:
            invocation: what is launched.
            judgement: what was decided on it.
            approvals: who approved it.
            anew: it is a session that has the cell already and keeps it, whatever becomes of this: it changes hands. So
                the cell stood when that was decided.

        Raises:
            Conflict: `cell_offline`, the cell of a session that is to change hands was away meanwhile.
            GaveWay: a grant, policy or profile that such a session was to go on under gave way while that was recorded,
                or its cell was away; nothing is sent.
            RecordUnavailable: the log was found to be damaged; nothing is sent.
        """
        cell = self._fleet.cell(invocation.cell or "")
        restraints = cell.restraints
        if anew is not None:
            self._fleet.check(cell, anew)
        try:
            self._register.check_undamaged()
            self._fleet.claim(cell, invocation.id)
            authorization = self._authorization(invocation, judgement, approvals)
            signed = mint(authorization, self._key)
            launching = self._launching(invocation, judgement, authorization, signed.body.decode())
            yield launching
        except BaseException:
            if anew is None:
                self._fleet.release(cell.id, invocation.id)
            raise
        if reasons := self.outlived(launching.invocation, judgement, anew is not None):
            if anew is not None:
                raise GaveWay(*reasons)
            self.abandon(invocation.id, reasons)
            return
        message = Launch(
            body=base64.b64encode(signed.body).decode(),
            signature=base64.b64encode(signed.signature).decode(),
            anew=anew is not None,
        )
        try:
            self._fleet.order(cell, message, decided=anew or Moment(restraints, cell.attachment))
        except Conflict as error:
            if anew is None or invocation.capability == TAKEOVER:
                return  # what has not begun, or a hand, is seen to when the cell is back and knows of neither
            remedy = "once it is back: take it over, or answer"
            raise GaveWay(Reason(SESSION_RULE, error.code, str(error), remedy)) from error

    def _launching(
        self, invocation: Invocation, judgement: Judgement, authorization: Authorization, body: str
    ) -> Launching:
        now, grant = self._register.now(), judgement.grant or invocation.grant
        by_grant = f"{GRANTED}{grant}" in authorization.approvals  # and not by whoever has it in hand since
        return Launching(
            invocation=replace(
                invocation,
                status=Status.RUNNING,
                terms=replace(
                    invocation.terms,
                    authorization=authorization.id,
                    launched_at_s=authorization.issued_at_s,
                    recoveries=authorization.recoveries,
                ),
            ),
            events=(
                EventDraft(
                    kind=EventKind.AUTHORIZATION,
                    actor=SERVER,
                    invocation=invocation.id,
                    body={
                        "authorization": orjson.loads(body),
                        "cell": invocation.cell,
                        **({"grant": grant} if by_grant else {}),
                    },
                ),
            ),
            rows=(
                RowWrite(
                    table="permits_used",
                    values={"permit": authorization.id, "invocation": invocation.id, "used_at": now},
                    once=True,
                ),
            ),
        )

    def _authorization(self, invocation: Invocation, judgement: Judgement, approvals: tuple[str, ...]) -> Authorization:
        policy = judgement.policy
        now_s = self._register.now_s()
        effective = dict(invocation.effective or {})
        return Authorization(
            id=self.identities.make("auth"),
            invocation=invocation.id,
            cell=invocation.cell or "",
            capability=invocation.capability,
            version=policy.capabilities[invocation.capability].version,
            params=effective,
            mode=invocation.terms.mode,
            profile=judgement.profile,
            policy_digest=policy.digest,
            issued_at_s=now_s,
            expires_at_s=now_s + LAUNCH_WITHIN_S,
            recoveries=self._recoveries(invocation, judgement),
            approvals=approvals,
            confirm_before=confirm_before(policy, invocation.capability, judgement.profile),
        )

    def _recoveries(self, invocation: Invocation, judgement: Judgement) -> tuple[CoveredRecovery, ...]:
        policy, terms = judgement.policy, invocation.terms
        launched = Proposal(
            capability=invocation.capability,
            params=dict(invocation.effective or {}),
            metadata=terms.metadata,
            mode=terms.mode,
        )
        context = Context(
            time_s=self._register.now_s(),
            profile=judgement.profile,
            agent=policy.agent(invocation.agent),
            cell=self._fleet.facts(self._fleet.cell(invocation.cell or "")),
            operator_on_duty=self.operator_on_duty,
        )
        found = covered_recoveries(policy, launched, context)
        if invocation.capability == TAKEOVER:  # while a human drives nothing recovers by itself
            alone = self._register.newest(invocation.id) is None  # else the session has its own rollback
            return tuple(one for one in found if alone and one.strategy is Strategy.ROLLBACK)
        return found


def _path(problem: ParamProblem) -> str:
    return f"params.{problem.param}" if problem.param else "params"


def _message(problem: ParamProblem) -> str:
    return f"{problem.message}; valid: {problem.remedy}" if problem.remedy else problem.message
