"""Errors as `application/problem+json` (RFC 9457): one exception for the door itself, and one table for the rest.

Domain code never imports HTTP. What it raises becomes a response by its class, in `PROBLEMS`; what the door itself
refuses is a `Problem`. Every problem bears a stable `code`; `type` is that code as a URN. Nothing internal is ever
shown: an exception nobody listed is logged and answered with the code `internal`.
"""

from __future__ import annotations

import http
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import orjson
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Match

from app.api.faults import field_errors
from app.audit.errors import RecordDamaged, RecordUnavailable, RecordUnreadable, RowUnreadable
from app.governance.errors import PolicyErrors
from app.runtime.errors import CONFLICTS, Conflict, ExaminationFailed, Forbidden, InvalidParams, NotFound

if TYPE_CHECKING:
    from fastapi import FastAPI
    from starlette.requests import Request

MEDIA_TYPE = "application/problem+json"
URN = "urn:reins:problem:"
AGAIN: Mapping[str, str] = {"Retry-After": "5"}


# Every code the server may answer with, its status and what it means. Codes are stable; the words are not.
CODES: Mapping[str, tuple[int, str]] = {
    "http_malformed": (400, "what was sent is no HTTP/1.1 request; the connection ends"),
    "handshake_invalid": (400, "what was sent does not open a websocket; the connection ends"),
    "body_incomplete": (400, "the connection ended within the body, or another protocol is wished for (`Upgrade`)"),
    "given_twice": (400, "a header or query parameter that counts once was given more than once"),
    "token_missing": (401, "the request bears no bearer token"),
    "token_invalid": (401, "the token is not known"),
    "token_expired": (401, "the token is no longer valid"),
    "role_forbidden": (403, "the token's role may not use this route"),
    "not_yours": (403, "the thing belongs to somebody else"),
    "own_proposal": (403, "nobody answers for what they proposed themselves"),
    "not_found": (404, "there is nothing at this path"),
    "invocation_unknown": (404, "there is no such invocation, or it is not the caller's to see"),
    "escalation_unknown": (404, "there is no such escalation"),
    "grant_unknown": (404, "there is no such grant"),
    "review_unknown": (404, "there is no such review"),
    "cell_unknown": (404, "there is no such cell"),
    "profile_unknown": (404, "there is no such profile"),
    "policy_unknown": (404, "there is no such version of policy; one with faults is never kept"),
    "schema_unknown": (404, "there is no such kind of policy file"),
    "log_empty": (404, "nothing is recorded yet"),
    "telemetry_unknown": (404, "the invocation left no such telemetry file"),
    "method_not_allowed": (405, "the path does not know the method"),
    "body_late": (408, "a part of the body was waited for in vain; the connection ends"),
    "body_too_large": (413, "the body is over 256 kB, or that of a candidate policy over 4 MB"),
    "head_too_large": (431, "what is no body, header fields mostly, is over 64 kB; the connection ends"),
    "media_type_unsupported": (415, "the body is not `application/json`"),
    "encoding_unsupported": (415, "the body is compressed; it is read as it is alone"),
    "malformed_json": (422, "the body is no strict JSON: the detail says where"),
    "request_invalid": (422, "a field or parameter is unknown, missing, or of another type: `errors` says which"),
    "policy_invalid": (422, "the policy has faults: `errors` names each with its file and line"),
    "params_invalid": (422, "the parameters do not fit the capability's input schema: `errors` says which"),
    "idempotency_key_invalid": (422, "the header `Idempotency-Key` is not 1 to 255 printable ASCII characters"),
    "internal": (500, "the server failed; its log says why"),
    "row_unreadable": (
        500,
        "what the database holds under this name cannot be read: it was damaged or changed",
    ),
    "record_damaged": (500, "the database cannot be read as a log, or as the server's state"),
    "telemetry_damaged": (500, "the telemetry file cannot be read"),
    "too_many_streams": (503, "as many event streams are open as the server, or one caller, may hold"),
    "too_many_waits": (503, "as many long polls are open as the server, or one caller, may hold"),
    "examination_failed": (503, "a policy could not be examined, so nothing has changed"),
    "record_unavailable": (503, "the record cannot be written, so nothing is let move, or it cannot be read now"),
    **{code: (status, f"refused by the runtime: {code.replace('_', ' ')}") for code, status in CONFLICTS.items()},
}


class Problem(Exception):
    """A request that is refused: a stable code, what is wrong and what would be valid.

    `errors` name single fields, each `{field, message}`; `reasons` are policy's, and `digest` is what they are approved
    by; `headers` ride along (`WWW-Authenticate`, `Retry-After`).
    """

    def __init__(
        self,
        code: str,
        detail: str,
        *,
        errors: Sequence[Mapping[str, Any]] = (),
        reasons: Sequence[Mapping[str, Any]] = (),
        digest: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        """Keep the parts; status and title follow from the code."""
        self.status = CODES[code][0]
        self.code = code
        self.detail = detail
        self.errors = tuple(errors)
        self.reasons = tuple(reasons)
        self.digest = digest
        self.headers = dict(headers or {})
        super().__init__(f"{self.status} {code}: {detail}")

    def document(self, instance: str) -> dict[str, Any]:
        """Return the problem as RFC 9457 writes it; `instance` is the path that was asked for."""
        document: dict[str, Any] = {
            "type": URN + self.code,
            "title": http.HTTPStatus(self.status).phrase,
            "status": self.status,
            "detail": self.detail,
            "code": self.code,
            "instance": quote(instance, errors="replace"),  # a path may hold what JSON cannot say
        }
        if self.errors:
            document["errors"] = self.errors
        if self.reasons:
            document["reasons"] = self.reasons
        if self.digest:
            document["digest"] = self.digest
        return document

    def response(self, instance: str) -> Response:
        """Return the problem as a response."""
        return Response(orjson.dumps(self.document(instance)), self.status, self.headers, MEDIA_TYPE)


def as_problem(error: Exception) -> Problem:
    """Return the problem an exception stands for; `internal` for one nobody listed."""
    for kind, translate in PROBLEMS:
        if isinstance(error, kind):
            return translate(error)
    return Problem("internal", "the server failed while answering; the cause is in its log")


def _itself(error: Problem) -> Problem:
    return error


def _from_router(error: HTTPException) -> Problem:
    headers = error.headers
    match error.status_code:
        case 404:
            return Problem("not_found", "there is nothing at this path", headers=headers)
        case 405:
            return Problem("method_not_allowed", "valid methods stand in the header `Allow`", headers=headers)
        case _:
            return Problem("internal", "the server refused the request for a reason it does not know", headers=headers)


def _from_parameters(error: RequestValidationError) -> Problem:
    errors = field_errors(error.errors())
    first = errors[0]
    return Problem("request_invalid", f"a parameter is not valid: `{first['field']}` {first['message']}", errors=errors)


def _from_params(error: InvalidParams) -> Problem:
    errors = [{"field": problem["path"], "message": problem["message"]} for problem in error.problems]
    return Problem("params_invalid", str(error), errors=errors)


def _from_missing(error: NotFound) -> Problem:
    code = f"{error.what}_unknown"
    return Problem(code if code in CODES else "not_found", str(error))


def _from_forbidden(error: Forbidden) -> Problem:
    return Problem(error.code if error.code in CODES else "not_yours", str(error))


def _from_conflict(error: Conflict) -> Problem:
    return Problem(error.code, str(error), reasons=error.reasons, digest=error.digest)


def _from_policy(error: PolicyErrors) -> Problem:
    errors = [
        {
            "field": problem.key or problem.file,
            "message": _or_else(problem.message, problem.valid),
            "file": problem.file,
            "line": problem.line,
        }
        for problem in error.problems
    ]
    return Problem("policy_invalid", f"{len(errors)} faults, the first: {error.problems[0]}", errors=errors)


def _or_else(message: str, valid: Sequence[str]) -> str:
    return f"{message}; valid: {', '.join(f'`{name}`' for name in valid)}" if valid else message


def _from_examination(error: ExaminationFailed) -> Problem:
    return Problem("examination_failed", str(error))


def _from_record(error: RecordUnavailable) -> Problem:
    detail = f"{error}; nothing was let move; a pause, a stop and an emergency stop are obeyed all the same"
    return Problem("record_unavailable", detail, headers=AGAIN)


def _from_unread(error: RecordUnreadable) -> Problem:
    return Problem("record_unavailable", f"{error}; it may be as good as ever: valid is to ask again", headers=AGAIN)


def _from_row(error: RowUnreadable) -> Problem:
    return Problem("row_unreadable", f"{error}; valid: look with `reins audit verify`")


def _from_damage(_: RecordDamaged) -> Problem:  # its words hold paths of this machine
    return Problem("record_damaged", "the database cannot be read; valid: look with `reins audit verify`")


# The one place where the exceptions of the house become HTTP.
PROBLEMS: tuple[tuple[type[Exception], Callable[[Any], Problem]], ...] = (
    (Problem, _itself),
    (HTTPException, _from_router),
    (RequestValidationError, _from_parameters),
    (InvalidParams, _from_params),
    (NotFound, _from_missing),
    (Forbidden, _from_forbidden),
    (Conflict, _from_conflict),
    (PolicyErrors, _from_policy),
    (ExaminationFailed, _from_examination),
    (RecordUnavailable, _from_record),
    (RecordUnreadable, _from_unread),
    (RowUnreadable, _from_row),
    (RecordDamaged, _from_damage),
)


def install(app: FastAPI) -> None:
    """Answer every exception the table knows with its problem."""

    async def known(request: Request, error: Exception) -> Response:
        return as_problem(error).response(request.url.path)

    async def other_method(request: Request, _: Exception) -> Response:
        """The router names the methods of the first route at a path; a path has one route for each method."""
        matching = [route for route in app.routes if route.matches(request.scope)[0] is not Match.NONE]
        methods = {method for route in matching for method in getattr(route, "methods", ())}
        methods |= {"HEAD"} if "GET" in methods else set()
        return as_problem(HTTPException(405, headers={"Allow": ", ".join(sorted(methods))})).response(request.url.path)

    for kind, _ in PROBLEMS:
        app.add_exception_handler(kind, known)
    app.add_exception_handler(405, other_method)
