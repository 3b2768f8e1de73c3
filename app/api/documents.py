"""What goes out, as OpenAPI describes it: one model for every document the server answers with.

Answers are written from plain documents and not run through these models (that would cost the hot path more than the
decision itself); the tests hold every real answer against them instead.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, RootModel

from app.governance.model import AdmissionOutcome, Outcome, PolicyOutcome, Risk, Status

EXAMPLE_REASON = {
    "rule": "human-shared/tcp_speed_mps",
    "code": "limit",
    "message": "at most 0.25 m/s here",
    "remedy": "propose speed_mps ≤ 0.25",
}
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
EXAMPLE_EVENT: dict[str, Any] = {
    "seq": 42,
    "at": "2026-03-01T09:30:00.250Z",
    "kind": "policy",
    "invocation": EXAMPLE_INVOCATION["id"],
    "actor": "planner",
    "body": {"outcome": "modify"},
}


class Document(BaseModel):
    """A document of the server; a field that is not described here does not occur."""

    model_config = ConfigDict(extra="forbid")


class ReasonDocument(Document):
    """Why a decision fell as it did: the rule, a stable code, words for people, and what would be accepted."""

    rule: str
    code: str
    message: str
    remedy: str


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


class LeaseDocument(Document):
    """Who drives a cell by hand; `refused` is why it does not do the newest command."""

    lease: str
    cell: str
    holder: str
    where: Literal["local", "remote"]
    since: str
    invocation: str
    phase: Literal["held", "returning"]
    refused: str | None


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
    grant: str | None = Field(default=None, description="The standing grant under which it would launch.")
    outcome: Outcome | None


class ApprovalDocument(Document):
    """One person's approval, of the parameters with this digest."""

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


class GrantEnd(Document):
    """Why a grant ended, by whom and when."""

    code: Literal["revoked", "expired", "estop", "profile_changed", "policy_changed"]
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


class EventDocument(Document):
    """One event of the log; `body` is what was recorded."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [EXAMPLE_EVENT]})

    seq: int
    at: str
    kind: str
    invocation: str | None
    actor: str
    body: dict[str, Any]


class InvocationList(Document):
    """Invocations, newest first; `next` is the cursor of the next page."""

    items: list[InvocationDocument]
    next: str | None


class EscalationList(Document):
    """Escalations, newest first; `next` is the cursor of the next page."""

    items: list[EscalationDocument]
    next: str | None


class GrantList(Document):
    """Standing grants, newest first; `next` is the cursor of the next page."""

    items: list[GrantDocument]
    next: str | None


class ReviewList(Document):
    """Reviews, newest first; `next` is the cursor of the next page."""

    items: list[ReviewDocument]
    next: str | None


class EventList(Document):
    """Events by `seq`; `next` is the `after` of the next page."""

    items: list[EventDocument]
    next: int | None


class Trace(Document):
    """τ_t: everything recorded under one invocation, in order."""

    items: list[EventDocument]
    next: None


class CheckpointDocument(Document):
    """The signed tree head of the log: a C2SP checkpoint (Ed25519), and the key that verifies it."""

    size: int
    root: str
    checkpoint: str
    key: str


class VerificationDocument(Document):
    """The log recomputed from its stored bytes: `size` events hold, `first_bad` is the first that does not.

    Where the log is good: what is wrong beside it, ten findings of each sort at most; `problem` is the first of all.
    """

    ok: bool
    size: int
    root: str
    checkpoint: str | None
    first_bad: int | None
    problem: str | None
    database: list[str] | None = Field(
        description="Damaged pages, and indexes that are not their tables; null where it took too long to look."
    )
    state: list[str] = Field(description="Invocations whose stored row is not what the log makes of them.")
    telemetry: list[str] = Field(description="Telemetry files that are not those whose digest the log holds.")


class PeopleDocument(Document):
    """Whom the tracker saw at each `time_s`: (number, x, y), metres in the world frame. Empty: none was recorded."""

    time_s: list[float]
    tracks: list[list[tuple[int, float, float]]]


class WayDocument(Document):
    """A thing's poses (x, y, z, qw, qx, qy, qz, world frame), each from its `time_s` until the next."""

    time_s: list[float]
    pose: list[list[float]]


class TelemetryDocument(Document):
    """What was measured during a session: values by channel, every `every`-th of the file's `rows` and the last one.

    `intact` says whether the file is the one whose digest the log holds. Times are the channel `time_s`, in seconds;
    the first row was at `start_at`.
    """

    invocation: str
    part: int
    parts: int
    file: str
    sha256: str
    intact: bool
    start_at: str
    rows: int
    every: int
    units: dict[str, str]
    columns: dict[str, list[float | None]]
    people: PeopleDocument = Field(description="Where people were, as the tracker saw them.")
    bodies: dict[str, WayDocument] = Field(
        description="Where objects and tools were, by name, as displays showed them."
    )


class McapFile(RootModel[str]):
    """A telemetry file."""

    model_config = ConfigDict(json_schema_extra={"format": "binary"})


class SittingDocument(Document):
    """What a cell says of its session: phase, what is bound, the rules violated now, and why it does not go on."""

    phase: str
    doing: str
    violated: list[str]
    paused_by: list[str]
    waits_for: str


class ArmingDocument(Document):
    """A reset that waits for its second step: the code to confirm it with, and until when."""

    code: str
    expires_at: str


class CellDocument(Document):
    """A cell as the server knows it; `facts` and `gauges` are what it says of itself."""

    id: str
    online: bool
    latched: bool
    profile: str
    busy: str | None
    status: str | None
    holding_link: bool
    robot: str | None
    policy_version: str | None
    facts: dict[str, Any] | None
    gauges: dict[str, float]
    control: LeaseDocument | None = None
    arming: ArmingDocument | None = Field(
        default=None, description="Stands in the answer to the first step of a reset."
    )
    session: SittingDocument | None
    recorded: bool | None = Field(default=None, description="Stands in the answer to an emergency stop alone.")


class CellList(Document):
    """All cells; `next` is always null."""

    items: list[CellDocument]
    next: None


class Anything(BaseModel):
    """A document described elsewhere."""

    model_config = ConfigDict(extra="allow")


class CapabilityDocument(Anything):
    """A capability package; `inputs` is a JSON Schema 2020-12 whose numbers carry `unit`."""

    name: str
    version: str
    summary: str
    inputs: dict[str, Any]
    risk: Risk


class CapabilityList(Document):
    """The registered capabilities; `next` is always null."""

    items: list[CapabilityDocument]
    next: None


class PolicySetDocument(Document):
    """The policy set in force: `version` is the digest of its files, which invocations name as `policy_version`."""

    version: str
    capabilities: list[str]
    profiles: dict[str, Any]
    rules: list[dict[str, Any]]
    agents: dict[str, Any]
    authority: dict[str, Any]
    files: list[str]
    site: dict[str, Any]


class Health(Document):
    """The process answers; `degraded` where stops are obeyed but nothing is launched, and `broken` says why."""

    status: Literal["ok", "degraded"]
    version: str
    broken: dict[str, str]


class Readiness(Document):
    """Whether something could be launched; `broken` says what is in the way and why."""

    ready: bool
    broken: dict[str, str]


class FieldError(Document):
    """One field that is wrong, and what would be valid."""

    field: str
    message: str


class ProblemDocument(Document):
    """A refusal of the request itself (RFC 9457); `code` is stable."""

    type: str = Field(examples=["urn:reins:problem:malformed_json"])
    title: str
    status: int
    detail: str
    code: str
    instance: str
    errors: list[FieldError] | None = None
    reasons: list[ReasonDocument] | None = None
