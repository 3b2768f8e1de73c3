"""How a route describes itself: every answer it can give, what its body may say, and who may use it.

`declare` is the only way routes are added, so that none is described by half. Bodies and answers bypass FastAPI's own
parsing and serializing; their models enter the description here.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import orjson
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema
from starlette.responses import JSONResponse, Response

from app.api import documents
from app.api.access import PUBLIC, allowed_roles
from app.api.frame import Json
from app.api.problems import CODES, MEDIA_TYPE, Problem

if TYPE_CHECKING:
    from fastapi import APIRouter, FastAPI
    from pydantic import BaseModel

REFERENCE = "#/components/schemas/{model}"
BODIES: dict[str, type[BaseModel]] = {}
"""What routes take, by the name that they refer to: `declare` enters it, so that no reference leads nowhere."""

ON_EVERY_ROUTE = (
    "internal",
    "row_unreadable",
    "record_damaged",
    "given_twice",
    "http_malformed",
    "head_too_large",
)
ON_GUARDED = ("token_missing", "token_invalid", "token_expired", "role_forbidden", "record_unavailable")
WITH_PROBLEMS: Mapping[int, Mapping[str, str]] = {
    401: {"WWW-Authenticate": "What the request needs: a bearer token (RFC 6750, 3)."},
    415: {"Accept-Encoding": "`identity`; stands with `encoding_unsupported` alone (RFC 9110, 15.5.16)."},
    503: {"Retry-After": "After how many seconds to ask again; left out where nobody knows."},
}
"""The headers that come with problems, by status."""
ON_READING = ("request_invalid",)  # by a query that the route does not know
ON_BODY = (
    "body_incomplete",
    "body_late",
    "body_too_large",
    "media_type_unsupported",
    "encoding_unsupported",
    "malformed_json",
    "request_invalid",
)


def answer(document: object, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """Return a document of plain JSON as a response."""
    return Json(orjson.dumps(document), status, headers)


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers:
    """What a route may answer with.

    `model` and `status` are the ordinary answer, `also` further ones that are no problems, `codes` the problem codes
    beside those that every such route has; `headers` come with the ordinary answer, each with what it says.
    """

    model: type[BaseModel]
    status: int = 200
    codes: tuple[str, ...] = ()
    also: Mapping[int, type[BaseModel]] = field(default_factory=dict[int, "type[BaseModel]"])
    media_type: str = "application/json"
    headers: Mapping[str, str] = field(default_factory=dict[str, str])


def declare(
    router: APIRouter,
    route: str,
    endpoint: Callable[..., Awaitable[Response]],
    answers: Answers,
    *,
    body: type[BaseModel] | None = None,
    parameters: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Add a route, guarded and described.

    Args:
        router: where it goes.
        route: method and path, as `ACCESS` names them: `GET /v1/cells`.
        endpoint: what answers; its docstring is the description.
        answers: what it may answer with.
        body: the model of the request body, if there is one; it may be left out where no field of it is required.
        parameters: headers that FastAPI does not see, as OpenAPI writes them.

    Raises:
        RouteUnguarded: `ACCESS` does not name the route.
    """
    method, _, path = route.partition(" ")
    roles = allowed_roles(method, path)
    public = roles is PUBLIC
    guarded = () if public else (*ON_GUARDED, *(ON_READING if method == "GET" else ()))
    codes = (*answers.codes, *ON_EVERY_ROUTE, *guarded, *(ON_BODY if body else ()))
    described = _answers({answers.status: answers.model, **answers.also})
    described[answers.status].update(_headers(answers.headers))
    operation: dict[str, Any] = {"security": [] if public else [{"bearer": []}], "parameters": list(parameters)}
    if body is not None:
        BODIES[body.__name__] = body
        schema = {"$ref": REFERENCE.format(model=body.__name__)}
        required = any(known.is_required() for known in body.model_fields.values())
        operation["requestBody"] = {"required": required, "content": {"application/json": {"schema": schema}}}
    router.add_api_route(
        path,
        endpoint,
        methods=[method],
        status_code=answers.status,
        response_model=None,
        # Never used to answer; as a JSON class it keeps FastAPI from describing every answer as a text.
        response_class=type("Described", (JSONResponse,), {"media_type": answers.media_type}),
        description=_description(endpoint, roles),
        responses={**described, **_refusals(codes)},
        openapi_extra=operation,
    )


def describe(app: FastAPI, description: str) -> dict[str, Any]:
    """Return the OpenAPI document of an application."""
    document = get_openapi(title=app.title, version=app.version, description=description, routes=app.routes)
    schemas: dict[str, Any] = document["components"]["schemas"]
    models = [(model, "validation") for model in (*BODIES.values(), documents.ProblemDocument)]
    _, definitions = models_json_schema(models, ref_template=REFERENCE)  # type: ignore[arg-type]
    schemas.update(definitions["$defs"])
    document["components"]["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
    return document


def _description(endpoint: Callable[..., Any], roles: frozenset[Any] | None) -> str:
    who = "anyone, without a token" if roles is PUBLIC else ", ".join(sorted(role.value for role in roles or ()))
    return f"{(endpoint.__doc__ or '').strip()}\n\nRoles: {who}."


def _answers(models: Mapping[int, type[BaseModel]]) -> dict[int | str, dict[str, Any]]:
    return {status: {"model": model, "description": (model.__doc__ or "").strip()} for status, model in models.items()}


def _headers(said: Mapping[str, str]) -> dict[str, Any]:
    described = {name: {"description": words, "schema": {"type": "string"}} for name, words in said.items()}
    return {"headers": described} if described else {}


def _refusals(codes: tuple[str, ...]) -> dict[int | str, dict[str, Any]]:
    """Return the problem responses by status, each with an example for every code it may bear."""
    by_status: dict[int | str, dict[str, Any]] = {}
    for code in dict.fromkeys(codes):
        status, meaning = CODES[code]
        entry = by_status.setdefault(status, {"description": "", "examples": {}})
        entry["description"] += f"{'; ' if entry['description'] else ''}`{code}`: {meaning}"
        example = Problem(code, meaning).document("/v1/…")
        entry["examples"][code] = {"value": example}
    return {
        status: {
            "description": entry["description"],
            **_headers(WITH_PROBLEMS.get(int(status), {})),
            "content": {
                MEDIA_TYPE: {
                    "schema": {"$ref": REFERENCE.format(model=documents.ProblemDocument.__name__)},
                    "examples": entry["examples"],
                }
            },
        }
        for status, entry in by_status.items()
    }
