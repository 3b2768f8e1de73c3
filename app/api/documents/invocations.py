"""Proposals: what was decided about them, and what became of them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import ConfigDict, Field

from app.api.documents.base import EXAMPLE_REASON, Document, ReasonDocument
from app.governance.model import AdmissionOutcome, Outcome, PolicyOutcome, Status

EXAMPLE_INVOCATION: dict[str, Any] = {
    "id": "inv_01KAHZ5E8M3V0Q4T9B7C2D6F1G",
    "status": "running",
    "capability": "grasp_object",
    "agent": "planner",
    "cell": "workcell-1",
    "profile": "human-shared",
    "policy_version": "sha256:9f2b…",
    "requested": {"object_id": "mug_1", "force_n": 80, "speed_mps": 0.5},
    "effective": {"object_id": "mug_1", "force_n": 60, "speed_mps": 0.25},
    "admission": {"outcome": "accept", "reasons": []},
    "policy": {
        "outcome": "modify",
        "reasons": [EXAMPLE_REASON],
        "changes": [{"param": "speed_mps", "requested": 0.5, "effective": 0.25, "rule": "human-shared/tcp_speed_mps"}],
    },
    "escalation": {"id": "esc_01KAHZ5E8N", "status": "approved", "expires_at": "2026-03-01T09:32:00.000Z"},
    "outcome": None,
    "created_at": "2026-03-01T09:30:00.250Z",
    "updated_at": "2026-03-01T09:30:12.100Z",
}


class ChangeDocument(Document):
    """One parameter that policy constrained."""

    param: str
    requested: Any = None
    effective: Any = None
    rule: str


class AdmissionDocument(Document):
    """Whether the proposal may be considered at all; `retry_after_s` stands with `defer`."""

    outcome: AdmissionOutcome
    reasons: list[ReasonDocument]
    retry_after_s: float | None = None


class PolicyDocument(Document):
    """What the rules say; `changes` stand with `modify` and `escalate`."""

    outcome: PolicyOutcome
    reasons: list[ReasonDocument]
    changes: list[ChangeDocument]


class EscalationReference(Document):
    """The question a human was asked about an invocation; `code` stands with a denial."""

    id: str
    status: Literal["pending", "approved", "denied", "expired", "withdrawn"]
    expires_at: str | None
    code: str | None = None


class FailureDocument(Document):
    """Why a session ended without its task done: what went wrong first, then how it ended."""

    reasons: list[ReasonDocument]


class TakeoverDocument(Document):
    """In whose hands a session is; `facts` is the state that whoever plans on faces now."""

    state: Literal["held", "returning", "lapsed", "returned", "ended"]
    where: Literal["local", "remote"]
    since: str
    then: Literal["resume", "rollback"] | None = None
    refused: str | None = None
    facts: dict[str, Any] | None = None


class InvocationDocument(Document):
    """One proposal and everything that became of it."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [EXAMPLE_INVOCATION]})

    id: str
    status: Status
    capability: str
    agent: str
    cell: str | None
    profile: str
    policy_version: str
    requested: dict[str, Any]
    effective: dict[str, Any] | None
    admission: AdmissionDocument
    policy: PolicyDocument | None
    escalation: EscalationReference | None
    grant: str | None = Field(
        default=None, description="The standing grant that spared a human the question; absent otherwise."
    )
    outcome: Outcome | None
    failure: FailureDocument | None = Field(
        default=None, description="Why a session that was launched ended without its task done; absent otherwise."
    )
    takeover: TakeoverDocument | None = Field(
        default=None, description="Stands where a human took the controls: in whose hands the session is."
    )
    created_at: str
    updated_at: str
    recorded: bool | None = Field(default=None, description="Stands in the answer to a pause, stop or cancel alone.")


class InvocationList(Document):
    """Invocations, newest first; `next` is the cursor of the next page."""

    items: list[InvocationDocument]
    next: str | None


class AskingDocument(Document):
    """What authority asks for before launch: so many different people's approval, within so many seconds, and why."""

    reasons: list[ReasonDocument]
    needed: int
    within_s: float


class VerdictDocument(Document):
    """What would become of a proposal now: an invocation without id and times; `allowed` where it would launch."""

    status: Literal["allowed", "rejected", "deferred", "denied", "awaiting_approval"]
    capability: str
    agent: str
    cell: str | None
    profile: str
    policy_version: str
    requested: dict[str, Any]
    effective: dict[str, Any] | None
    admission: AdmissionDocument
    policy: PolicyDocument | None
    escalation: EscalationReference | None
    asks: AskingDocument | None = Field(
        default=None, description="Why people would be asked, and how many; stands with `awaiting_approval` alone."
    )
    grant: str | None = Field(default=None, description="The standing grant under which it would launch.")
    outcome: Outcome | None
