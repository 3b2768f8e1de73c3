"""Cells, and who drives them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from app.api.documents.base import Document


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


class SittingDocument(Document):
    """What a cell says of its session: phase, what is bound, the rules violated now, and why it does not go on."""

    profile: str = Field(description="The one the session was authorized under, whatever the cell's is by now.")
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
    fault: str | None = Field(description="Why the cell can record nothing: nothing moves there until it can.")
    robot: str | None
    policy_version: str | None
    facts: dict[str, Any] | None
    gauges: dict[str, float]
    control: LeaseDocument | None = None
    arming: ArmingDocument | None = Field(
        default=None, description="Stands in the answer to the first step of a reset."
    )
    armed_by: str | None = Field(description="Who may take the second step of a reset now.")
    session: SittingDocument | None
    recorded: bool | None = Field(default=None, description="Stands in the answer to an emergency stop alone.")


class CellList(Document):
    """All cells; `next` is always null."""

    items: list[CellDocument]
    next: None
