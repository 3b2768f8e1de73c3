"""What anyone may know of policy: the capabilities there are, and the set in force."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import orjson
from starlette.requests import Request
from starlette.responses import Response

from app.api import documents
from app.api.openapi import Answers, Json, declare
from app.api.parts import parts_of

if TYPE_CHECKING:
    from fastapi import APIRouter

    from app.governance.policy import PolicySet


async def capabilities(request: Request) -> Response:
    """List the registered capabilities, each with the JSON Schema of its inputs."""
    return Json(_capabilities(parts_of(request).policy()))


async def active(request: Request) -> Response:
    """Describe the policy set in force: its digest, profiles, limits and rules."""
    return Json(_active(parts_of(request).policy()))


# A set is immutable and may hold ten thousand rules: it is described once.
@lru_cache(maxsize=1)
def _capabilities(policy: PolicySet) -> bytes:
    return orjson.dumps({"items": policy.manifests(), "next": None})


@lru_cache(maxsize=1)
def _active(policy: PolicySet) -> bytes:
    return orjson.dumps(policy.describe())


def register(router: APIRouter) -> None:
    """Add the routes."""
    declare(router, "GET /v1/capabilities", capabilities, Answers(model=documents.CapabilityList))
    declare(router, "GET /v1/policies/active", active, Answers(model=documents.PolicySetDocument))
