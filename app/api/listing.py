"""What routes that name or list things have in common: identifiers, filters, and pages of a list, newest first."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from app.audit.reader import parse_cursor

MAX_LIMIT = 200

Identifier = Annotated[str, Path(min_length=1, max_length=128)]
Filter = Annotated[str | None, Field(min_length=1, max_length=128)]


def _cursor(text: str) -> str:
    parse_cursor(text)
    return text


Cursor = Annotated[str, Field(max_length=256, description="The `next` of the page before."), AfterValidator(_cursor)]


class PageQuery(BaseModel):
    """How much of a list, and from where on; the lists add their filters."""

    model_config = ConfigDict(extra="forbid")

    limit: Annotated[int, Field(ge=1, le=MAX_LIMIT)] = 50
    cursor: Cursor | None = None
