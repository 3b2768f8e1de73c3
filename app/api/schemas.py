"""The JSON Schema of every kind of policy file, for editors and for whoever checks before asking."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Annotated

import orjson
from fastapi import Path
from starlette.requests import Request
from starlette.responses import Response

from app.api import documents
from app.api import policy_documents as models
from app.api.openapi import Answers, answer, declare
from app.api.problems import Problem
from app.governance.bundle_schema import KINDS, schema

if TYPE_CHECKING:
    from fastapi import APIRouter

Name = Annotated[str, Path(max_length=64, description="A kind of policy file, for instance `profile`.")]
MEDIA_TYPE = "application/schema+json"


async def schemas(request: Request) -> Response:
    """List the kinds of policy files, and where the JSON Schema of each is."""
    del request
    items = [{"name": kind.name, "files": kind.files, "href": f"/v1/schemas/{kind.name}"} for kind in KINDS.values()]
    return answer({"items": items, "next": None})


async def one_schema(request: Request, name: Name) -> Response:
    """Return the JSON Schema (2020-12) of a kind of policy file, as loading holds files to it."""
    del request
    if name not in KINDS:
        raise Problem("schema_unknown", f"there is no kind of policy file `{name}`: valid are {', '.join(KINDS)}")
    return Response(_written(name), media_type=MEDIA_TYPE)


@cache
def _written(name: str) -> bytes:
    return orjson.dumps(schema(name))


def register(router: APIRouter) -> None:
    """Add the routes."""
    declare(router, "GET /v1/schemas", schemas, Answers(model=models.SchemaList))
    declare(
        router,
        "GET /v1/schemas/{name}",
        one_schema,
        Answers(model=documents.Anything, codes=("request_invalid", "schema_unknown"), media_type=MEDIA_TYPE),
    )
