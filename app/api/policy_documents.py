"""What is said about versions of policy, as OpenAPI describes it, and what may be said to change them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from app.api.documents import Document
from app.api.wire import MAX_NAME, Body, Freeform

MAX_POLICY_BYTES = 4 * 1024 * 1024
MAX_FILES = 2000

Why = Annotated[Freeform, Field(min_length=1, description="Why; it stays in the record.")]
Verdict = Literal["proved", "refuted", "undecided", "unknown"]
FileName = Annotated[str, Field(min_length=1, max_length=MAX_NAME)]
Text = Annotated[str, Field(max_length=MAX_POLICY_BYTES)]


class CandidateBody(Body):
    """A candidate: every file of a policy directory as text, by its path in it, cases (`tests/…`) included.

    So is `properties.yaml`, what the policy promises: it is proved, and giving up a promise counts as a loosening.
    """

    files: Annotated[dict[FileName, Text], Field(min_length=1, max_length=MAX_FILES)]
    why: Why


class ActivationBody(Body):
    """Why a version should be in force, and in the place of which."""

    why: Why
    before: str | None = Field(
        default=None,
        pattern=r"^sha256:[0-9a-f]{64}$",
        description="The version it was compared with; where another one is in force by now: 409.",
    )


class ShadowBody(Body):
    """Whether a candidate shall decide beside the live policy, and why; nothing follows from what it decides."""

    on: bool
    why: Why


class AwaitingDocument(Document):
    """The first of two engineers' word on a version that loosens something, and what it would take the place of."""

    by: str
    at: str
    why: str
    against: str


class ActivationDocument(Document):
    """One time that a version came into force; `by` names the server where a start did it."""

    at: str
    by: list[str]
    why: str
    former: str | None
    direction: Literal["same", "tightens", "loosens", "both"] | None


class VersionDocument(Document):
    """A version of policy: whose it is, and what became of it."""

    digest: str
    status: Literal["candidate", "awaiting_second", "active", "former"]
    source: Literal["request", "directory"]
    by: str
    why: str
    against: str | None = Field(description="What was in force when it was brought.")
    rules: int
    cases: int = Field(description="How many cases came with it, all of which it passed.")
    proved: str = Field(description="What was proved of it; empty as long as nothing was.")
    verdict: Verdict = Field(description="What is known of its proofs; `unknown` where nobody has tried.")
    awaiting: AwaitingDocument | None
    activations: list[ActivationDocument]
    created_at: str
    updated_at: str


class VersionList(Document):
    """Versions, the newest first; `active` is in force, `why` says why, and `verdict` what its proofs say."""

    items: list[VersionDocument]
    next: str | None
    active: str
    why: str
    verdict: Verdict


class DifferenceDocument(Document):
    """One part that is another than in the version in force."""

    part: str
    before: str
    after: str
    direction: Literal["same", "tightens", "loosens", "both"]


class OutcomeDocument(Document):
    """What becomes of a proposal under one version, whatever keeps it waiting at the moment."""

    what: Literal["allow", "approve", "deny"]
    approvers: int
    values: dict[str, Any] = Field(description="The effective parameters; none of what is denied.")
    rules: list[str] = Field(description="By which rules.")


class TransitionDocument(Document):
    """One way in which decisions come out otherwise, with the smallest example."""

    capability: str
    profile: str
    change: str = Field(description="What becomes of what: `deny -> allow`, `looser speed_mps`, `fewer approvers` …")
    direction: Literal["tightens", "loosens"]
    decided: bool = Field(description="What could not be decided counts as a loosening, and has no example.")
    message: str
    example: str = Field(description="A case file (YAML); what it expects is what this version does.")
    body: dict[str, Any] = Field(description="The example's proposal, as a body with which people `POST /v1/check`.")
    before: OutcomeDocument | None = Field(description="What becomes of it by the version in force.")
    after: OutcomeDocument | None = Field(description="What becomes of it by this version.")


class ComparisonDocument(Document):
    """What a version would change of what is in force."""

    direction: Literal["same", "tightens", "loosens", "both"]
    proved: bool = Field(description="Whether it was proved of every decision that nothing else changes.")
    differences: list[DifferenceDocument]
    decisions: list[TransitionDocument]


class SchemaItem(Document):
    """A kind of policy file: where such files stand in a policy directory, and where their schema is."""

    name: str
    files: str
    href: str


class SchemaList(Document):
    """All kinds of policy files."""

    items: list[SchemaItem]
    next: None


class FilesDocument(Document):
    """The files of a version, by their path; `promises` is the text of its `properties.yaml`, if it has any."""

    digest: str
    files: dict[str, str]
    promises: str | None


class ShadowGroup(Document):
    """Differences with everything in common, and the newest invocations among them."""

    capability: str
    profile: str
    live: str
    candidate: str
    count: int
    examples: list[str]


class ShadowDocument(Document):
    """What a candidate would have decided otherwise, since it is under shadow or the server started."""

    digest: str
    on: bool
    by: str | None
    why: str | None
    since: str | None
    decisions: int
    differing: int
    groups: list[ShadowGroup]
