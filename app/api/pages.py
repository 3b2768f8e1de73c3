"""The built console as pages: read once at start, answered from memory, compressed when it was built.

Only what the build wrote can be asked for, by its exact name, so no path leads out of it. What bears a hash in its name
never changes and may be kept for good; everything else is asked for again each time. Every page is sent with a policy
that lets it load, run and call nothing but this server's own, and hand no text to a script sink (Trusted Types).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from mimetypes import guess_type
from pathlib import Path
from typing import TYPE_CHECKING, Final

from starlette.requests import Request
from starlette.responses import Response

from app.api.frame import HEADERS, best_form
from app.api.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fastapi import APIRouter

FOLDER: Final = Path(__file__).resolve().parents[1] / "console"
INDEX: Final = "index.html"
VIEWS: Final = ("/", "/live", "/audit", "/policy", "/fleet")  # one page, which reads its own address
ICON: Final = "/icon.svg"
ASSETS: Final = "/assets/{file}"
ENCODINGS: Final = {"br": ".br", "gzip": ".gz"}  # by what the build adds to a name
HASHED: Final = re.compile(r"assets/.+-[A-Za-z0-9_-]{8}\.[a-z0-9]+")
FOR_GOOD: Final = "public, max-age=31536000, immutable"

CONTENT_SECURITY_POLICY: Final = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data:",
        "connect-src 'self'",
        "font-src 'self'",
        "worker-src 'self'",
        "require-trusted-types-for 'script'",
        "trusted-types svelte-trusted-html reins-worker",  # Svelte's own templates; the address of the socket's worker
        "frame-ancestors 'none'",
        "base-uri 'none'",
        "form-action 'none'",
    )
)
PAGE_HEADERS: Final = (
    (b"content-security-policy", CONTENT_SECURITY_POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"DENY"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
PART_HEADERS: Final = tuple(
    (name, value)
    for name, value in PAGE_HEADERS
    if name in {b"x-content-type-options", b"cross-origin-resource-policy"}
)
PARTS: Final = ("text/css", "text/javascript", "font/")
"""What a page is made of and never is one itself."""
WORKER: Final = re.compile(r"assets/worker-[^/]+")
"""A script that runs by itself: the policy of the page that begins it does not hold for it (HTML, "run a worker")."""
WORKER_HEADERS: Final = (*PART_HEADERS, (b"content-security-policy", b"default-src 'none'; connect-src 'self'"))
PICTURE: Final = "image/"
PICTURE_HEADERS: Final = (*PART_HEADERS, (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"))
"""One may be opened alone, and is a document then, which has nothing to load or to run."""
NOT_BUILT: Final = b"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Reins: the console is not built</title>
<h1>The console is not built</h1>
<p>This server runs, but it was started from sources without the pages of its console. Build them, then start it again:
<pre>make console
reins serve</pre>
<p>Everything else is there: <a href="/healthz">/healthz</a>, <a href="/readyz">/readyz</a>,
<a href="/openapi.json">/openapi.json</a>.
</html>
"""


@dataclass(frozen=True, slots=True)
class Page:
    """One file of the build: its bytes, and those of its compressed forms by encoding."""

    media_type: str
    kept: str
    headers: tuple[tuple[bytes, bytes], ...]  # what holds it to its own server
    forms: Mapping[str, bytes]

    def response(self, accepted: str) -> Response:
        """Return the page in the best form that is accepted."""
        body, headers = best_form(self.forms, accepted)
        return Response(body, 200, {"Cache-Control": self.kept, **headers}, self.media_type)


def read_pages(folder: Path) -> dict[str, Page]:
    """Return what a build wrote, by path within it; nothing where there is no build.

    Raises:
        OSError: a file of it cannot be read.
    """
    if not (folder / INDEX).is_file():
        return {}
    pages: dict[str, Page] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and path.suffix not in ENCODINGS.values() and not path.name.startswith("."):
            media_type = guess_type(name)[0] or "application/octet-stream"
            pages[name] = Page(
                media_type=media_type,
                kept=FOR_GOOD if HASHED.fullmatch(name) else "no-cache",
                headers=_headers(name, media_type),
                forms=_forms(path),
            )
    return pages


def _headers(name: str, media_type: str) -> tuple[tuple[bytes, bytes], ...]:
    if WORKER.fullmatch(name):
        return WORKER_HEADERS
    if media_type.startswith(PICTURE):
        return PICTURE_HEADERS
    return PART_HEADERS if media_type.startswith(PARTS) else PAGE_HEADERS


def _forms(path: Path) -> dict[str, bytes]:
    forms = {"": path.read_bytes()}
    for encoding, suffix in ENCODINGS.items():
        beside = path.with_name(path.name + suffix)
        if beside.is_file():
            forms[encoding] = beside.read_bytes()
    return forms


async def view(request: Request) -> Response:
    """Return the console, whichever of its views is asked for."""
    pages: Mapping[str, Page] = request.app.state.pages
    request.scope[HEADERS] = PAGE_HEADERS
    if not pages:
        return Response(NOT_BUILT, 503, {"Cache-Control": "no-store"}, "text/html")
    return pages[INDEX].response(request.headers.get("accept-encoding", ""))


async def file(request: Request) -> Response:
    """Return a file of the console."""
    pages: Mapping[str, Page] = request.app.state.pages
    page = pages.get(request.url.path.removeprefix("/"))
    if page is None:
        raise Problem("not_found", "there is nothing at this path")
    request.scope[HEADERS] = page.headers
    return page.response(request.headers.get("accept-encoding", ""))


def register(router: APIRouter) -> None:
    """Add the pages."""
    for path in VIEWS:
        router.add_api_route(path, view, methods=["GET"], include_in_schema=False)
    for path in (ICON, ASSETS):
        router.add_api_route(path, file, methods=["GET"], include_in_schema=False)
