"""What people say in advance and afterwards: standing grants, and verdicts on finished sessions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import Query
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from app.api import documents
from app.api.access import caller, speaker
from app.api.listing import Filter, Identifier, PageQuery
from app.api.openapi import Answers, answer, declare
from app.api.parts import parts_of
from app.api.wire import GrantBody, ReviewRequestBody, VerdictBody, read_body
from app.governance.model import GrantScope
from app.runtime.grant import GrantRequest

if TYPE_CHECKING:
    from fastapi import APIRouter


class GrantQuery(PageQuery):
    """Filters of the list of grants."""

    listed = "grants"

    status: Literal["active", "ended"] | None = None


class ReviewQuery(PageQuery):
    """Filters of the list of reviews."""

    listed = "reviews"

    status: Annotated[
        Literal["waiting", "judged", "accepted", "objected", "inconclusive"] | None,
        Field(description="`judged` is whatever has a verdict."),
    ] = None
    invocation: Filter = None


async def grants(request: Request, query: Annotated[GrantQuery, Query()]) -> Response:
    """List standing grants, newest first."""
    items, following = await parts_of(request).desk.grants.list(**query.model_dump())
    return answer({"items": items, "next": following})


async def give(request: Request) -> Response:
    """Approve in advance what policy would ask one person about, for one agent on one cell, for at most 15 minutes.

    Never for critical risk, for what takes two people, or for what a rule escalates. What policy or server does not
    know, or policy does not allow for so long, is `grant_refused`; a cell under another profile than the one that is
    named, `profile_changed`. It ends with its time, when it is revoked, with an emergency stop of the cell, and with
    another profile or policy.
    """
    body = await read_body(request, GrantBody)
    wanted = GrantRequest(scope=GrantScope(body.scope), **body.model_dump(exclude={"scope"}))
    return answer(await parts_of(request).desk.grants.give(speaker(request), wanted), 201)


async def revoke(request: Request, id: Identifier) -> Response:
    """End a standing grant. It holds at once; `recorded` says whether the record has it. Any body is ignored."""
    return answer(await parts_of(request).desk.grants.revoke(id, caller(request)))


async def reviews(request: Request, query: Annotated[ReviewQuery, Query()]) -> Response:
    """List finished sessions that wait for a verdict or have one, newest first."""
    items, following = await parts_of(request).desk.reviews.list(**query.model_dump())
    return answer({"items": items, "next": following})


async def request_review(request: Request) -> Response:
    """Put a finished session up for review, where its profile's authority has the mode `review-only`."""
    body = await read_body(request, ReviewRequestBody)
    return answer(await parts_of(request).desk.reviews.request(body.invocation, caller(request)), 201)


async def judge(request: Request, id: Identifier) -> Response:
    """Give the verdict on a finished session, once. The note stays in the record and never reaches the agent."""
    body = await read_body(request, VerdictBody)
    document = await parts_of(request).desk.reviews.resolve(id, caller(request), body.verdict, body.note)
    return answer(document)


def register(router: APIRouter) -> None:
    """Add the routes."""
    declare(router, "GET /v1/grants", grants, Answers(model=documents.GrantList, codes=("request_invalid",)))
    declare(
        router,
        "POST /v1/grants",
        give,
        Answers(
            model=documents.GrantDocument,
            status=201,
            codes=(
                "params_invalid",
                "own_proposal",
                "grant_refused",
                "profile_changed",
                "given_up",
                "record_unavailable",
            ),
        ),
        body=GrantBody,
    )
    declare(
        router,
        "POST /v1/grants/{id}/revoke",
        revoke,
        Answers(model=documents.GrantDocument, codes=("request_invalid", "grant_unknown", "grant_ended")),
    )
    declare(router, "GET /v1/reviews", reviews, Answers(model=documents.ReviewList, codes=("request_invalid",)))
    declare(
        router,
        "POST /v1/reviews",
        request_review,
        Answers(
            model=documents.ReviewDocument,
            status=201,
            codes=(
                "invocation_unknown",
                "wrong_status",
                "review_not_enabled",
                "already_reviewed",
                "record_unavailable",
            ),
        ),
        body=ReviewRequestBody,
    )
    declare(
        router,
        "POST /v1/reviews/{id}/resolve",
        judge,
        Answers(
            model=documents.ReviewDocument,
            codes=("request_invalid", "review_unknown", "already_reviewed", "own_proposal", "record_unavailable"),
        ),
        body=VerdictBody,
    )
