"""What routes that name or list things have in common: identifiers, filters, places in the log, pages of a list."""

from __future__ import annotations

from typing import Annotated, ClassVar

from fastapi import Path
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator
from starlette.requests import Request

from app.api.parts import parts_of
from app.api.problems import Problem
from app.audit.reader import parse_cursor

MAX_LIMIT = 200
MAX_SEQ = 2**63 - 1


def _plain(value: object) -> object:
    """Refuse what Python alone takes for a number: `1_0`, and blanks around it. What a number is, its type says."""
    if isinstance(value, str) and ("_" in value or value != value.strip()):
        raise ValueError(f"is `{value}`: valid is a number in plain digits")
    return value


Digits = BeforeValidator(_plain)
"""On numbers of a query, which come as text."""

Identifier = Annotated[str, Path(min_length=1, max_length=128)]
Filter = Annotated[str | None, Field(min_length=1, max_length=128)]


Cursor = Annotated[str, Field(max_length=256, description="The `next` of the page before.")]


class PageQuery(BaseModel):
    """How much of a list, and from where on; the lists add their filters."""

    model_config = ConfigDict(extra="forbid")

    listed: ClassVar[str]
    """The table that is listed: its cursors count for no other list."""

    limit: Annotated[int, Field(ge=1, le=MAX_LIMIT), Digits] = 50
    cursor: Cursor | None = None

    @field_validator("cursor")
    @classmethod
    def _of_this_list(cls, cursor: str | None) -> str | None:
        if cursor is not None:
            parse_cursor(cls.listed, cursor)
        return cursor


def within_the_log(request: Request, field: str, after: int | None) -> None:
    """Refuse a place that the log has not reached: whoever has seen that much has seen another log.

    Raises:
        Problem: 422 `request_invalid`, naming the `field`.
    """
    size = parts_of(request).store.size
    if after is not None and after > size:
        message = f"`{after}` is ahead of this log, which holds `{size}` events; valid: 0 to {size}, or none"
        raise Problem("request_invalid", f"`{field}`: {message}", errors=[{"field": field, "message": message}])
