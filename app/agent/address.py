"""Which server is asked, and by which way: what a URL names, and what the environment puts in between."""

from __future__ import annotations

import os
import re
from collections.abc import Generator
from contextlib import contextmanager

import httpx

from app.agent.sendable import shown

MAX_PORT = 65535
_MAX_URL = 8000  # with what is asked for, still far below what httpx takes
_EXAMPLE = "for instance `http://127.0.0.1:8000`"
_READ_BY_HTTPX = re.compile(r"(HTTP|HTTPS|ALL|NO)_PROXY|SSL_CERT_(FILE|DIR)", re.IGNORECASE)


def address(url: object) -> httpx.URL:
    """Return a server's address. Raises `ValueError` where there is no server to ask; a password is not repeated."""
    text = shown(url, str)
    if isinstance(url, str) and "@" in url:  # what stands before it may be a password, wherever the name begins
        text = f"…@{shown(url.rpartition('@')[2], str)}"
    if wrong := _wrong(url):
        raise ValueError(f"url `{text}`: {wrong}, {_EXAMPLE}")
    return httpx.URL(str(url))


def _wrong(url: object) -> str:
    """Say what is wrong with an address, and what would be valid; nothing is an empty text."""
    if not isinstance(url, str) or len(url) > _MAX_URL:
        return f"valid is a text of at most {_MAX_URL} octets"
    try:
        found = httpx.URL(url)
    except (httpx.InvalidURL, UnicodeError) as error:
        why = "" if "@" in url else f"{error}; "
        return f"{why}valid is an address"
    if len(str(found)) > _MAX_URL:  # as it is written on the wire
        return f"valid is a text of at most {_MAX_URL} octets"
    if found.userinfo:  # httpx would send it in place of the token
        return "valid is one without a user name or password: the token says who asks"
    if found.port is not None and not 0 < found.port <= MAX_PORT:
        return f"valid is a port from 1 to {MAX_PORT}"
    return "" if found.scheme in ("http", "https") and found.host else "valid is http:// or https:// and a host"


@contextmanager
def blaming_environment() -> Generator[None]:
    """Say of what goes wrong within that the environment is to blame: for what stands there all else was checked."""
    try:
        yield
    except (ValueError, ImportError, OSError, httpx.InvalidURL) as error:
        names = ", ".join(f"`{name}`" for name in sorted(os.environ) if _READ_BY_HTTPX.fullmatch(name))
        raise ValueError(
            f"the environment ({names or 'its proxies and certificates'}): {error}; valid are proxies like "
            "`http://127.0.0.1:3128` and files that are there, or none of these variables"
        ) from error
