"""What an agent uses: proposing, asking what would become of a proposal, and reading what became of its own.

An agent sees and cancels its own invocations alone; the runtime decides that by the name its token carries.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated

from fastapi import Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import Response

from app.api import documents
from app.api.access import caller, speaker
from app.api.listing import Digits, Filter, Identifier, PageQuery
from app.api.openapi import Answers, answer, declare
from app.api.parts import parts_of
from app.api.problems import Problem
from app.api.staying import while_there
from app.api.wire import CheckBody, EmptyBody, ProposalBody, read_body, read_idempotency_key, read_optional
from app.clock import parse_rfc3339
from app.governance.model import Mode, Role, Status, Strategy
from app.runtime.invocation import Principal, ProposalRequest

if TYPE_CHECKING:
    from fastapi import APIRouter

MAX_WAIT_S = 60.0
_STAMP = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}\.\d{3}Z", re.ASCII)  # the one form `updated_at` is written in


def _seen(text: str) -> str:
    if not _STAMP.fullmatch(text):
        raise ValueError(f"`{text}` is no `updated_at`: valid is for instance `2026-03-01T09:30:00.250Z`")
    parse_rfc3339(text)
    return text


class InvocationQuery(PageQuery):
    """Filters of the list of invocations."""

    listed = "invocations"

    status: Status | None = None
    capability: Filter = None
    agent: Filter = None
    cell: Filter = None


class WaitQuery(BaseModel):
    """How long to wait for the next change."""

    model_config = ConfigDict(extra="forbid")

    wait: Annotated[
        float, Field(ge=0, le=MAX_WAIT_S, allow_inf_nan=False, description="Seconds; 0 answers at once."), Digits
    ] = 0.0
    seen: Annotated[
        str | None,
        Field(max_length=40, description="The `updated_at` known already: a newer version is answered at once."),
        AfterValidator(_seen),
    ] = None


async def propose(request: Request) -> Response:
    """Propose that a robot does something.

    Every proposal that could be read is decided, recorded and answered with 201 and `Location`, refusals included:
    `status` and the reasons say what became of it. The header `Idempotency-Key` (1 to 255 printable characters) makes a
    proposal safe to send again: the answer to the first is given once more, with the header `Idempotency-Replayed:
    true`. What would launch, or ask people, counts while its agent waits for the answer: `given_up`.
    """
    key = read_idempotency_key(request)
    body = await read_body(request, ProposalBody)
    document, created = await parts_of(request).governor.propose(speaker(request), to_request(body), key)
    headers = {"Location": f"/v1/invocations/{document['id']}"}
    if not created:
        headers["Idempotency-Replayed"] = "true"
    return answer(document, 201, headers)


async def check(request: Request) -> Response:
    """Say what would become of a proposal now, without recording or launching anything.

    The same body as a proposal, and for people the `agent` it would come from; `status` is `allowed` where it would
    launch.
    """
    body = await read_body(request, CheckBody)
    proposer = _proposer(caller(request), body.agent)
    return answer(await parts_of(request).governor.check(proposer, to_request(body)))


def _proposer(asks: Principal, agent: str | None) -> Principal:
    """Return whom a check is made for: an agent for itself, a person for an agent.

    Raises:
        Problem: `not_yours` where an agent names another, `request_invalid` where a person names none.
    """
    if asks.role is not Role.AGENT:
        if agent is None:
            message = "is missing: name the agent that would propose this"
            raise Problem("request_invalid", f"`agent` {message}", errors=[{"field": "agent", "message": message}])
        return Principal(name=agent, role=Role.AGENT)
    if agent not in (None, asks.name):
        raise Problem("not_yours", f"`{asks.name}` may not ask for `{agent}`: valid is `{asks.name}`, or no `agent`")
    return asks


async def invocation(request: Request, id: Identifier, query: Annotated[WaitQuery, Query()]) -> Response:
    """Return an invocation, with `wait` at its next change or after so many seconds (at most 60).

    Where another request comes behind it on the connection, that is at once.
    """
    parts, principal = parts_of(request), caller(request)
    if not query.wait:
        return answer(await parts.governor.invocation(id, principal))
    with parts.waits.take(principal.name):
        document = await while_there(request, parts.governor.wait(id, principal, query.wait, query.seen))
    principal = caller(request)  # who may have had their token withdrawn meanwhile
    return answer(document or await parts.governor.invocation(id, principal))


async def invocations(request: Request, query: Annotated[InvocationQuery, Query()]) -> Response:
    """List invocations, newest first; an agent's list holds its own. Of long ones a page holds fewer than `limit`."""
    filters = query.model_dump(mode="json", include={"status", "capability", "agent", "cell"})
    items, following = await parts_of(request).governor.list(
        caller(request), filters, limit=query.limit, cursor=query.cursor
    )
    return answer({"items": items, "next": following})


async def trace(request: Request, id: Identifier) -> Response:
    """Return τ_t: every event recorded under an invocation, in order.

    What an operator wrote in words is left out for agents.
    """
    return answer({"items": await parts_of(request).governor.trace(id, caller(request)), "next": None})


async def cancel(request: Request, id: Identifier) -> Response:
    """Withdraw an invocation, before or after launch: what moves is stopped.

    For the agent that proposed it, or an operator.
    """
    await read_optional(request, EmptyBody)
    return answer(await parts_of(request).governor.cancel(id, caller(request)))


def to_request(body: ProposalBody) -> ProposalRequest:
    """Translate the wire's model into the runtime's."""
    return ProposalRequest(
        capability=body.capability,
        params=body.params,
        cell=body.cell,
        mode=Mode(body.mode) if body.mode else Mode.NORMAL,
        preconditions=tuple(body.preconditions),
        recovery_preference=Strategy(body.recovery_preference) if body.recovery_preference else None,
        metadata=body.metadata,
        version=body.capability_version,
    )


def register(router: APIRouter) -> None:
    """Add the agents' routes; proposing comes first, for the router tries them in this order."""
    key = {"name": "Idempotency-Key", "in": "header", "required": False, "schema": {"type": "string", "maxLength": 255}}
    declare(
        router,
        "POST /v1/invocations",
        propose,
        Answers(
            model=documents.InvocationDocument,
            status=201,
            headers={
                "Location": "The path of the invocation.",
                "Idempotency-Replayed": "`true` where this is the answer to an earlier request with the same key.",
            },
            codes=(
                "params_invalid",
                "idempotency_key_invalid",
                "idempotency_mismatch",
                "in_flight",
                "given_up",
                "record_unavailable",
            ),
        ),
        body=ProposalBody,
        parameters=[key],
    )
    declare(
        router,
        "POST /v1/check",
        check,
        Answers(model=documents.VerdictDocument, codes=("params_invalid", "not_yours")),
        body=CheckBody,
    )
    declare(
        router,
        "GET /v1/invocations",
        invocations,
        Answers(model=documents.InvocationList, codes=("request_invalid",)),
    )
    declare(
        router,
        "GET /v1/invocations/{id}",
        invocation,
        Answers(model=documents.InvocationDocument, codes=("request_invalid", "invocation_unknown", "too_many_waits")),
    )
    declare(
        router,
        "GET /v1/invocations/{id}/trace",
        trace,
        Answers(model=documents.Trace, codes=("request_invalid", "invocation_unknown")),
    )
    declare(
        router,
        "POST /v1/invocations/{id}/cancel",
        cancel,
        Answers(
            model=documents.InvocationDocument,
            codes=(
                "invocation_unknown",
                "wrong_status",
                "ending",
                "rollback_ordered",
                "control_held",
                "cell_offline",
                "record_unavailable",
            ),
        ),
        body=EmptyBody,
    )
