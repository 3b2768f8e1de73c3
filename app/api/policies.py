"""Policy: the capabilities there are, the set in force, and its versions: brought, compared, put in force."""

from __future__ import annotations

import gzip
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final

import orjson
from fastapi import Path, Query
from starlette.requests import Request
from starlette.responses import Response

from app.api import documents
from app.api import policy_documents as models
from app.api.access import caller, speaker
from app.api.frame import Json, best_form
from app.api.listing import PageQuery
from app.api.openapi import Answers, answer, declare
from app.api.parts import parts_of
from app.api.wire import read_body

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fastapi import APIRouter

    from app.governance.policy import PolicySet

Digest = Annotated[str, Path(pattern=r"^sha256:[0-9a-f]{64}$", description="`sha256:…` over the files of a version.")]
UNKNOWN = ("request_invalid", "policy_unknown")
COMPRESSED_B: Final = 200_000  # at most: what is longer would hold other requests up while it is compressed


async def capabilities(request: Request) -> Response:
    """List the registered capabilities, each with the JSON Schema of its inputs."""
    return _described(_capabilities(parts_of(request).policy()), request)


class VersionQuery(PageQuery):
    """Which part of the list of versions."""

    listed = "policies"


async def active(request: Request) -> Response:
    """Describe the policy set in force: its digest, profiles, limits and rules."""
    return _described(_active(parts_of(request).policy()), request)


async def watched(request: Request) -> Response:
    """Describe what each profile of the set in force watches: signals, thresholds and responses."""
    return answer(parts_of(request).policy().watched())


async def versions(request: Request, query: Annotated[VersionQuery, Query()]) -> Response:
    """List every version of policy: whose it is, why it was brought, and when it was in force; the newest first."""
    known = parts_of(request).versions
    items, following = await known.list(**query.model_dump())
    active = await known.load(known.in_force.digest)
    said = {"active": active.digest, "why": known.reason, "verdict": active.verdict}
    return answer({"items": items, "next": following, **said})


async def version(request: Request, digest: Digest) -> Response:
    """Return one version of policy."""
    return answer((await parts_of(request).versions.load(digest)).public())


async def files(request: Request, digest: Digest) -> Response:
    """Return the files of a version: what its digest is over, and what it promises."""
    versions = parts_of(request).versions
    found, version = await versions.compiled(digest), await versions.load(digest)
    return answer({"digest": found.digest, "files": dict(found.files), "promises": version.promises})


async def difference(request: Request, digest: Digest) -> Response:
    """Say what a version would change of what is in force, part by part, and which way that goes."""
    return answer((await parts_of(request).versions.difference(digest)).document())


async def propose(request: Request) -> Response:
    """Bring a candidate. It is checked and proved as `reins policy check` and `test` do, and kept; nothing changes.

    One with a fault is not kept: `errors` names every fault with its file and line, and every refuted proof with a case
    that shows it. What is not decided is a fault too. 200 where it was known already.
    """
    body = await read_body(request, models.CandidateBody, at_most=models.MAX_POLICY_BYTES)
    document, new = await parts_of(request).versions.propose(body.files, caller(request), body.why)
    if not new:
        return answer(document)
    return answer(document, 201, {"Location": f"/v1/policies/{document['digest']}"})


async def activate(request: Request, digest: Digest) -> Response:
    """Put a version in force, or one that was before.

    What loosens anything takes two engineers: the first gets a 202, and another one's word puts it in force; whoever
    brought it counts as the first. From then on every decision is made under it. Sessions that it would not let go on
    hold and ask a human; what waits for approval is decided again, and older answers to it are refused.
    """
    body = await read_body(request, models.ActivationBody)
    document, entered = await parts_of(request).versions.activate(digest, speaker(request), body.why, body.before)
    return answer(document, 200 if entered else 202)


async def shadow(request: Request, digest: Digest) -> Response:
    """Return what a candidate under shadow would have decided otherwise, in groups; the log holds every difference."""
    parts = parts_of(request)
    await parts.versions.load(digest)
    return answer(parts.shadow.document(digest))


async def set_shadow(request: Request, digest: Digest) -> Response:
    """Have a candidate decide beside the live policy, in the place of another one, or not any more.

    Differences are recorded and shown; what is done never depends on them.
    """
    body = await read_body(request, models.ShadowBody)
    return answer(await parts_of(request).shadow.set(digest, caller(request), body.why, on=body.on))


# A set is immutable and may hold ten thousand rules: it is described once.
@lru_cache(maxsize=1)
def _capabilities(policy: PolicySet) -> Mapping[str, bytes]:
    return _forms(orjson.dumps({"items": policy.manifests(), "next": None}))


@lru_cache(maxsize=1)
def _active(policy: PolicySet) -> Mapping[str, bytes]:
    return _forms(orjson.dumps(policy.describe()))


def _forms(body: bytes) -> Mapping[str, bytes]:
    return {"": body} if len(body) > COMPRESSED_B else {"": body, "gzip": gzip.compress(body, mtime=0)}


def _described(forms: Mapping[str, bytes], request: Request) -> Response:
    body, headers = best_form(forms, request.headers.get("accept-encoding", ""))
    return Json(body, headers=headers)


def register(router: APIRouter) -> None:
    """Add the routes."""
    declare(router, "GET /v1/capabilities", capabilities, Answers(model=documents.CapabilityList))
    declare(router, "GET /v1/policies/active", active, Answers(model=documents.PolicySetDocument))
    declare(router, "GET /v1/policies/active/watch", watched, Answers(model=documents.WatchedDocument))
    declare(
        router,
        "GET /v1/policies",
        versions,
        Answers(model=models.VersionList, codes=("request_invalid",)),
    )
    declare(
        router,
        "POST /v1/policies",
        propose,
        Answers(
            model=models.VersionDocument,
            status=201,
            headers={"Location": "The path of the version."},
            also={200: models.VersionDocument},
            codes=("policy_invalid", "examination_failed", "record_unavailable"),
        ),
        body=models.CandidateBody,
    )
    declare(router, "GET /v1/policies/{digest}", version, Answers(model=models.VersionDocument, codes=UNKNOWN))
    declare(
        router,
        "GET /v1/policies/{digest}/files",
        files,
        Answers(model=models.FilesDocument, codes=(*UNKNOWN, "policy_invalid", "examination_failed")),
    )
    declare(
        router,
        "GET /v1/policies/{digest}/diff",
        difference,
        Answers(model=models.ComparisonDocument, codes=(*UNKNOWN, "policy_invalid", "examination_failed")),
    )
    declare(
        router,
        "POST /v1/policies/{digest}/activate",
        activate,
        Answers(
            model=models.VersionDocument,
            also={202: models.VersionDocument},
            codes=(
                *UNKNOWN,
                "policy_active",
                "second_engineer_needed",
                "policy_changed",
                "given_up",
                "policy_invalid",
                "examination_failed",
                "record_unavailable",
            ),
        ),
        body=models.ActivationBody,
    )
    declare(router, "GET /v1/policies/{digest}/shadow", shadow, Answers(model=models.ShadowDocument, codes=UNKNOWN))
    declare(
        router,
        "POST /v1/policies/{digest}/shadow",
        set_shadow,
        Answers(
            model=models.ShadowDocument, codes=(*UNKNOWN, "policy_invalid", "examination_failed", "record_unavailable")
        ),
        body=models.ShadowBody,
    )
