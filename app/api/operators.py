"""What an operator uses: answering escalations, pausing, stopping and resuming what runs, and seeing to cells.

What restrains (pause, stop, emergency stop) reads nothing of the request but its path, so that no malformed body can
stand in its way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import Query
from pydantic import model_validator
from starlette.requests import Request
from starlette.responses import Response

from app.api import documents
from app.api.access import caller, speaker
from app.api.listing import Identifier, PageQuery, within_the_log
from app.api.openapi import Answers, answer, declare
from app.api.parts import parts_of
from app.api.problems import Problem
from app.api.wire import (
    EmptyBody,
    LoosenBody,
    ProfileBody,
    ReleaseBody,
    ResetBody,
    ResolveBody,
    TakeBody,
    read_body,
    read_optional,
)
from app.governance.model import GrantScope
from app.runtime.grant import Offer

if TYPE_CHECKING:
    from fastapi import APIRouter


class EscalationQuery(PageQuery):
    """Filters of the list of escalations."""

    listed = "escalations"

    status: Literal["pending", "approved", "denied", "expired", "withdrawn"] | None = None
    sort: Literal["newest", "urgency"] = "newest"

    @model_validator(mode="after")
    def _urgent_is_what_waits(self) -> EscalationQuery:
        if self.sort == "urgency" and (self.status != "pending" or self.cursor is not None):
            raise ValueError("`sort=urgency` goes with `status=pending` and without `cursor`")
        return self


async def escalations(request: Request, query: Annotated[EscalationQuery, Query()]) -> Response:
    """List escalations, newest first; with `sort=urgency` the pending ones, the one that ends first first.

    Where there are more than `limit`, each agent's own first ones are among those, and what each held session asks.
    """
    desk = parts_of(request).desk
    if query.sort == "urgency":
        return answer({"items": desk.most_urgent(query.limit), "next": None})
    items, following = await desk.list(**query.model_dump(include={"status", "limit", "cursor"}))
    return answer({"items": items, "next": following})


async def escalation(request: Request, id: Identifier) -> Response:
    """Return one escalation."""
    return answer(await parts_of(request).desk.get(id))


async def resolve(request: Request, id: Identifier) -> Response:
    """Answer an escalation with `approve` or `deny`, bound to the digest of what was shown.

    A denial has a `code`; without one it is the default that policy declares. The agent gets the code, never the
    comment.
    With the last approval of what was shown, `grant` is a standing grant for more of the same.

    Edited `params` are checked again, and void earlier approvals; a session under way cannot be edited. A second
    answer, a late one or another digest is refused with 409.
    """
    body = await read_body(request, ResolveBody)
    offered = body.grant
    offer = None if offered is None else Offer(scope=GrantScope(offered.scope), **offered.model_dump(exclude={"scope"}))
    document = await parts_of(request).desk.resolve(
        id,
        speaker(request),
        body.decision,
        body.digest,
        params=body.params,
        comment=body.comment,
        code=body.code,
        offer=offer,
    )
    return answer(document)


async def acknowledge(request: Request, id: Identifier) -> Response:
    """Say that one looks at an escalation, for every other console to see. Decides nothing; once is enough."""
    await read_optional(request, EmptyBody)
    return answer(await parts_of(request).desk.acknowledge(id, caller(request)))


async def pause(request: Request, id: Identifier) -> Response:
    """Pause a running invocation (category 2: controlled, power kept). Any body is ignored."""
    return answer(await parts_of(request).governor.pause(id, caller(request)))


async def stop(request: Request, id: Identifier) -> Response:
    """Stop an invocation for good (category 1), whatever the profile's authority. Any body is ignored."""
    return answer(await parts_of(request).governor.stop(id, caller(request)))


async def resume(request: Request, id: Identifier) -> Response:
    """Let a paused invocation go on; with `after`, only if nobody has said another word since that event."""
    body = await read_optional(request, LoosenBody)
    within_the_log(request, "after", body.after)
    return answer(await parts_of(request).governor.resume(id, speaker(request), body.after))


async def rollback(request: Request, id: Identifier) -> Response:
    """Have an invocation undone, along the path it came; `after` as in `resume`."""
    body = await read_optional(request, LoosenBody)
    within_the_log(request, "after", body.after)
    return answer(await parts_of(request).governor.rollback(id, speaker(request), body.after))


async def estop(request: Request, id: Identifier) -> Response:
    """Stop a cell at once (category 0) and latch it.

    For every role; any body is ignored. `recorded` says whether the record took it: the stop is sent either way.
    """
    return answer(await parts_of(request).governor.estop(id, caller(request)))


async def reset(request: Request, id: Identifier) -> Response:
    """Leave a latched emergency stop. Moves nothing.

    In two steps: `arm` returns a code, `confirm` with it within 10 s resets, by the same person and only if no stop
    came in between. An empty body does both at once, for scripts that have made sure by other means.
    """
    body = await read_optional(request, ResetBody)
    governor, who = parts_of(request).governor, speaker(request)
    match body:
        case ResetBody(step="arm", code=None):
            return answer(governor.arm_reset(id, who))
        case ResetBody(step="confirm", code=str(code)):
            return answer(await governor.reset(id, who, code))
        case ResetBody(step=None, code=None):
            return answer(await governor.reset(id, who))
        case _:
            raise Problem("request_invalid", "`confirm` comes with its `code`; nothing else does")


async def takeover(request: Request, id: Identifier) -> Response:
    """Take the controls of a session: it comes to rest, and whoever holds the lease drives, hold-to-run.

    One lease for each cell. Who stands at the cell (a token with that station) pre-empts who does not. With `after`,
    refused where it would end a pause that came since that event.
    """
    body = await read_optional(request, TakeBody)
    within_the_log(request, "after", body.after)
    return answer(await parts_of(request).governor.take_over(id, speaker(request), body.after))


async def take_cell(request: Request, id: Identifier) -> Response:
    """Take the controls of an idle cell, as an invocation of its own; `after` as in the takeover of a session."""
    body = await read_optional(request, TakeBody)
    within_the_log(request, "after", body.after)
    return answer(await parts_of(request).governor.take_cell(id, speaker(request), body.after))


async def release(request: Request, id: Identifier) -> Response:
    """Hand a session back: to go on from here (decided and bound anew), to be undone, or done with.

    Where policy has people asked about going on from here, that is refused (`resume_refused`) with a `digest`. Said
    again with that `digest`, it approves what the reasons say; what is to be approved by then has another one.
    """
    body = await read_body(request, ReleaseBody)
    if body.then != "end":  # which counts whatever else is said
        within_the_log(request, "after", body.after)
    said = body.model_dump(include={"lease", "after", "digest"})
    return answer(await parts_of(request).governor.release(id, speaker(request), body.then, **said))


async def set_profile(request: Request, id: Identifier) -> Response:
    """Put a cell under another environment profile.

    What runs keeps the one it was authorized under. What waits for approval is decided again: it is asked anew, or,
    where the new profile asks nobody, deferred (`profile_changed`), for nothing begins by a change of profile. With
    `before`, only if that is the one the cell is under.
    """
    body = await read_body(request, ProfileBody)
    return answer(await parts_of(request).governor.set_profile(id, body.profile, speaker(request), body.before))


async def cells(request: Request) -> Response:
    """List the cells the server knows, with what each says of itself."""
    return answer({"items": parts_of(request).governor.cells(), "next": None})


def register(router: APIRouter) -> None:
    """Add the operators' routes."""
    _questions(router)
    _sessions(router)
    _controls(router)
    _cells(router)


SESSION_CODES = ("request_invalid", "invocation_unknown", "wrong_status")
CELL_CODES = ("request_invalid", "cell_unknown", "record_unavailable")


def _questions(router: APIRouter) -> None:
    question = documents.EscalationDocument
    late = ("already_resolved", "escalation_expired", "record_unavailable")
    answering = (
        "own_proposal",
        "control_held",
        "cell_offline",
        "params_invalid",
        "already_approved",
        "digest_mismatch",
        "given_up",
    )
    refused = ("edit_refused", "grant_refused", "resume_refused", "ending", "policy_changed", "profile_changed")
    declare(
        router,
        "GET /v1/escalations",
        escalations,
        Answers(model=documents.EscalationList, codes=("request_invalid",)),
    )
    declare(
        router,
        "GET /v1/escalations/{id}",
        escalation,
        Answers(model=question, codes=("request_invalid", "escalation_unknown")),
    )
    declare(
        router,
        "POST /v1/escalations/{id}/resolve",
        resolve,
        Answers(model=question, codes=("escalation_unknown", *late, *answering, *refused)),
        body=ResolveBody,
    )
    declare(
        router,
        "POST /v1/escalations/{id}/acknowledge",
        acknowledge,
        Answers(model=question, codes=("escalation_unknown", *late, "profile_changed")),
        body=EmptyBody,
    )


def _sessions(router: APIRouter) -> None:
    interrupt = (*SESSION_CODES, "interrupt_not_enabled", "ending", "estop_latched")
    loosening = (*interrupt, "overtaken", "given_up", "cell_offline", "record_unavailable")
    for word, endpoint, body, codes in (
        ("pause", pause, None, interrupt),
        ("stop", stop, None, (*SESSION_CODES, "record_unavailable")),
        ("resume", resume, LoosenBody, (*loosening, "resume_refused")),
        ("rollback", rollback, LoosenBody, (*loosening, "control_held")),
    ):
        answers = Answers(model=documents.InvocationDocument, codes=codes)
        declare(router, f"POST /v1/invocations/{{id}}/{word}", endpoint, answers, body=body)


def _controls(router: APIRouter) -> None:
    present = ("control_held", "ending", "cell_offline", "estop_latched")
    taking = (*present, "takeover_not_enabled", "takeover_refused", "overtaken", "given_up")
    refused = ("nothing_to_resume", "resume_refused", "facts_stale", "paused")
    returning = (*present, "not_taken_over", "overtaken", "given_up", *refused)
    declare(
        router,
        "POST /v1/invocations/{id}/takeover",
        takeover,
        Answers(model=documents.LeaseDocument, codes=(*SESSION_CODES, *taking, "record_unavailable")),
        body=TakeBody,
    )
    declare(
        router,
        "POST /v1/cells/{id}/takeover",
        take_cell,
        Answers(model=documents.LeaseDocument, codes=(*CELL_CODES, *taking, "cell_busy", "wrong_status")),
        body=TakeBody,
    )
    declare(
        router,
        "POST /v1/invocations/{id}/release",
        release,
        Answers(model=documents.InvocationDocument, codes=(*SESSION_CODES, *returning, "record_unavailable")),
        body=ReleaseBody,
    )


def _cells(router: APIRouter) -> None:
    cell = documents.CellDocument
    resetting = ("not_latched", "cell_offline", "not_armed", "given_up")
    declare(router, "GET /v1/cells", cells, Answers(model=documents.CellList))
    declare(router, "POST /v1/cells/{id}/estop", estop, Answers(model=cell, codes=CELL_CODES))
    declare(
        router,
        "POST /v1/cells/{id}/reset",
        reset,
        Answers(model=cell, codes=(*CELL_CODES, *resetting)),
        body=ResetBody,
    )
    declare(
        router,
        "PUT /v1/cells/{id}/profile",
        set_profile,
        Answers(model=cell, codes=(*CELL_CODES, "profile_unknown", "profile_changed", "given_up")),
        body=ProfileBody,
    )
