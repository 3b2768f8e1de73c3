"""The record: events, the signed log, and the telemetry of sessions."""

from __future__ import annotations

from typing import Any

from pydantic import ConfigDict, Field, RootModel

from app.api.documents.base import Document
from app.api.documents.invocations import EXAMPLE_INVOCATION

EXAMPLE_EVENT: dict[str, Any] = {
    "seq": 42,
    "at": "2026-03-01T09:30:00.250Z",
    "kind": "policy",
    "invocation": EXAMPLE_INVOCATION["id"],
    "actor": "planner",
    "body": {"outcome": "modify"},
}


class EventDocument(Document):
    """One event of the log; `body` is what was recorded."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [EXAMPLE_EVENT]})

    seq: int
    at: str
    kind: str
    invocation: str | None
    actor: str
    body: dict[str, Any]


class Searched(Document):
    """How far a search has come: how many events it looked at, and the last of them."""

    events: int
    seq: int | None
    at: str | None


class EventList(Document):
    """Events by `seq`; `next` is the `after` of the next page, or its `before` where the newest come first."""

    items: list[EventDocument]
    next: int | None
    searched: Searched | None = Field(default=None, description="Stands in the answer to a search, `text`, alone.")


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
