"""The shape of `properties.yaml`: what a policy promises of itself. It decides nothing; `app.proofs` proves it."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from app.governance.bundle_shapes import Name, Shape, Slug, Text

Barred: TypeAlias = Literal["allowed", "awaiting_approval"]


class PropertyShape(Shape):
    """One promise: whatever the rules say in detail, this comes of it."""

    id: Slug
    says: Text
    applies_to: Annotated[list[Name], Field(min_length=1)] | None = None
    profiles: Annotated[list[Slug], Field(min_length=1)] | None = None
    when: str | None = None
    never: list[Barred] = Field(default_factory=list[Barred])
    always: str | None = None
    approvers: Annotated[int, Field(ge=1, le=9)] | None = None


class PropertiesShape(Shape):
    """What is promised: an order of profiles, and properties."""

    order: list[Slug] = Field(default_factory=list[Slug])
    properties: list[PropertyShape] = Field(default_factory=list[PropertyShape])
