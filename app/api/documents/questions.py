"""What people are asked, what they answer in advance (grants), and what they say afterwards (reviews)."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import ConfigDict, Field

from app.api.documents.base import EXAMPLE_REASON, Document, ReasonDocument
from app.api.documents.invocations import EXAMPLE_INVOCATION
from app.governance.model import Outcome, Risk
from app.runtime.escalation import STATED_AT_MOST

EXAMPLE_ESCALATION: dict[str, Any] = {
    "id": "esc_01KAHZ5E8N",
    "invocation": EXAMPLE_INVOCATION["id"],
    "kind": "approval",
    "phase": None,
    "capability": "grasp_object",
    "agent": EXAMPLE_INVOCATION["agent"],
    "cell": "workcell-1",
    "profile": "human-shared",
    "risk": "medium",
    "reasons": [EXAMPLE_REASON],
    "requested": EXAMPLE_INVOCATION["requested"],
    "constrained": EXAMPLE_INVOCATION["effective"],
    "effective": EXAMPLE_INVOCATION["effective"],
    "approved": None,
    "digest": "sha256:51ab…",
    "former_digests": [],
    "renewed": None,
    "names_task": False,
    "goal": "fetch mug_1 and deliver it to bench_b",
    "task": None,
    "carried": None,
    "policy_version": EXAMPLE_INVOCATION["policy_version"],
    "status": "pending",
    "approvals": [],
    "edits": [],
    "needed": 1,
    "acknowledged": [{"by": "operator", "since": "2026-03-01T09:30:04.000Z"}],
    "denial": None,
    "grant": None,
    "expires_at": "2026-03-01T09:32:00.000Z",
    "on_deny": "deny",
    "on_timeout": "deny",
    "created_at": "2026-03-01T09:30:00.250Z",
    "updated_at": "2026-03-01T09:30:04.000Z",
}


class ApprovalDocument(Document):
    """One person's approval, of the parameters with this digest; taken off once they may approve nothing any more."""

    by: str
    at: str
    digest: str


class EditDocument(Document):
    """What an approver's edit came to after policy; it voided the approvals before it."""

    by: str
    at: str
    params: dict[str, Any]
    digest: str


class AcknowledgementDocument(Document):
    """Who looks at a question, and since when."""

    by: str
    since: str


class DenialDocument(Document):
    """Who denied it, and why by code; `says` is what policy has to say of the code."""

    by: str
    at: str
    code: str
    says: str


class EscalationDocument(Document):
    """A question to a human: what is to be decided, bound to a digest, by when.

    `requested`, `constrained` and `approved` are the three versions of the parameters, `effective` is what is asked
    about now. `phase` is what waits for a confirmation. `on_deny` and `on_timeout` say what a denial and silence do.
    """

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [EXAMPLE_ESCALATION]})

    id: str
    invocation: str
    kind: Literal["approval", "session"]
    phase: str | None
    capability: str
    agent: str
    cell: str | None
    profile: str | None
    risk: Risk
    reasons: list[ReasonDocument]
    requested: dict[str, Any]
    constrained: dict[str, Any]
    effective: dict[str, Any]
    approved: dict[str, Any] | None
    digest: str
    former_digests: list[str] = Field(description="What it was bound to before it was asked anew.")
    renewed: Literal["policy_changed", "profile_changed"] | None = Field(
        description="Why it was asked anew: another policy is in force since, or its cell is under another profile."
    )
    names_task: bool = Field(
        default=False,
        description="Whether the proposal names its task, so that a grant may be for it.",
    )
    goal: str | None = Field(
        default=None,
        description="What the agent says it is after, in its own words (`metadata.goal`, else `metadata.intent`): the "
        f"first {STATED_AT_MOST} characters in one line. Nobody has checked it, and the digest is not of it.",
    )
    task: str | None = Field(default=None, description="What the agent calls its task (`metadata.task`); as `goal`.")
    carried: str | None = Field(
        default=None,
        description="What the gripper held when this was asked, where that is what is handled: no parameter names it, "
        "and the digest is of it as well.",
    )
    policy_version: str | None
    status: Literal["pending", "approved", "denied", "expired", "withdrawn"]
    approvals: list[ApprovalDocument]
    edits: list[EditDocument]
    needed: int
    acknowledged: list[AcknowledgementDocument]
    denial: DenialDocument | None
    grant: str | None = Field(description="The standing grant that was given with the approval.")
    expires_at: str | None
    on_deny: Literal["deny", "terminate", "rollback"]
    on_timeout: Literal["deny", "terminate", "rollback"]
    created_at: str
    updated_at: str


class EscalationList(Document):
    """Escalations, newest first; `next` is the cursor of the next page."""

    items: list[EscalationDocument]
    next: str | None


class GrantEnd(Document):
    """Why a grant ended, by whom and when."""

    code: Literal["revoked", "expired", "estop", "profile_changed", "policy_changed", "giver_withdrawn"]
    by: str
    at: str


class GrantDocument(Document):
    """A standing grant: an approval in advance, bound to agent, capability, cell, profile and policy."""

    id: str
    status: Literal["active", "ended"]
    capability: str
    agent: str
    cell: str
    profile: str
    policy_version: str
    scope: Literal["object", "task", "time"]
    object: str | None
    task: str | None
    issued_by: str
    issued_at: str
    expires_at: str
    escalation: str | None = Field(description="The question with whose answer it was given.")
    invocation: str | None
    uses: int
    used_at: str | None
    ended: GrantEnd | None
    created_at: str
    updated_at: str
    recorded: bool | None = Field(default=None, description="Stands in the answer to a revocation alone.")


class GrantList(Document):
    """Standing grants, newest first; `next` is the cursor of the next page."""

    items: list[GrantDocument]
    next: str | None


class VerdictGiven(Document):
    """What a person had to say of a finished session."""

    by: str
    at: str
    verdict: Literal["accepted", "objected", "inconclusive"]
    note: str | None


class ReviewDocument(Document):
    """A finished session that waits for a person's verdict, or has one; `reasons` say why it does."""

    id: str
    invocation: str
    status: Literal["waiting", "accepted", "objected", "inconclusive"]
    capability: str
    agent: str
    cell: str | None
    profile: str
    risk: Risk
    outcome: Outcome
    reasons: list[ReasonDocument]
    verdict: VerdictGiven | None
    created_at: str
    updated_at: str


class ReviewList(Document):
    """Reviews, newest first; `next` is the cursor of the next page."""

    items: list[ReviewDocument]
    next: str | None
