"""The policy in force, the state of the server, and refusals of a request itself."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from app.api.documents.base import Anything, Document, ReasonDocument
from app.governance.model import Risk


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


class WatchedDocument(Document):
    """What each profile of the policy set in force watches, and from when on a sensor is stale."""

    version: str
    profiles: dict[str, Any]


class Health(Document):
    """The process answers; `degraded` where something is broken, and `broken` says what.

    Without a record (`store`, or a cell's name) stops are obeyed and nothing is launched, there; a `policy` that does
    not pass its proofs goes on deciding.
    """

    status: Literal["ok", "degraded"]
    version: str
    broken: dict[str, str]


class Readiness(Document):
    """Whether something could be launched; `broken` says what is in the way and why."""

    ready: bool
    broken: dict[str, str]
    impaired: dict[str, str] | None = Field(
        default=None, description="What does not work and is in nobody's way, cells above all that others stand in for."
    )


class FieldError(Document):
    """One field that is wrong, and what would be valid."""

    field: str
    message: str
    file: str | None = Field(default=None, description="Of a policy: the file at fault.")
    line: int | None = Field(default=None, description="Of a policy: the line in it, from 1; 0 is the whole file.")


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
    digest: str | None = Field(
        default=None,
        description="Of a hand-back: said with the next one, it approves what the reasons ask people about.",
    )
