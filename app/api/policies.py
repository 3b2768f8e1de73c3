"""What anyone may know of policy: the capabilities there are, and the set in force."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import Response

from app.api import documents
from app.api.openapi import Answers, answer, declare
from app.api.parts import parts_of

if TYPE_CHECKING:
    from fastapi import APIRouter


async def capabilities(request: Request) -> Response:
    """List the registered capabilities, each with the JSON Schema of its inputs."""
    return answer({"items": parts_of(request).policy().describe()["capabilities"], "next": None})


async def active(request: Request) -> Response:
    """Describe the policy set in force: its digest, profiles, limits and rules."""
    return answer(parts_of(request).policy().describe())


def register(router: APIRouter) -> None:
    """Add the routes."""
    declare(router, "GET /v1/capabilities", capabilities, Answers(model=documents.CapabilityList))
    declare(router, "GET /v1/policies/active", active, Answers(model=documents.PolicySetDocument))
