"""What can be sent: every value of a request is looked at before anything is, and named where it has no place there."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import cast
from urllib.parse import quote, urlencode

from app.agent.answers import Unsendable

_MAX_TARGET = 8000  # octets that every recipient should take (RFC 9110, 4.1)
_MAX_DEPTH = 32
_MAX_SHOWN = 120
_LARGEST = 10**308  # about what a double holds: JSON promises no more (RFC 8259, 6)
_METHOD = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]{1,32}")  # a token (RFC 9110, 5.6.2); registered ones are shorter


def shown(value: object, look: Callable[[object], str] = repr) -> str:
    """Return how a value looks, in brief and in characters that can be printed, whatever it is."""
    try:
        text = look(value)
    except Exception:  # a number of too many digits, say, or what holds one: its type says enough
        text = f"<{type(value).__name__}>"
    text = text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}…"
    return text.encode(errors="backslashreplace").decode()


def check_sendable(method: object, path: object, json: object, query: object) -> None:
    """Raise `Unsendable` for the first value that has no place in a request, before anything is sent."""
    wrong = next(chain(_wrong_line(method, path), _misfits(json, "json"), _wrong_target(path, query)), None)
    if wrong is not None:
        raise Unsendable(f"{wrong}; nothing was sent")


def _wrong_line(method: object, path: object) -> Iterator[str]:
    if not isinstance(method, str) or not _METHOD.fullmatch(method):
        yield f"the method is `{shown(method)}`; valid is one of HTTP's, for instance `GET`"
    if not isinstance(path, str) or not path.isprintable():
        yield f"the path is `{shown(path)}`; valid is text in printable characters"
    elif not path.startswith("/") or path.startswith("//"):  # the token is for this client's server alone
        yield f"the path is `{shown(path, str)}`; valid is one that begins with a single `/`"


def _wrong_target(path: object, query: object) -> Iterator[str]:
    """Say what is wrong with a query; and of what is asked for as a whole, which can be measured only then."""
    if not isinstance(query, Mapping):
        yield f"`query` is `{shown(query)}`; valid is a mapping of names and values"
        return
    asked = dict(cast("Mapping[str, object]", query))
    yield from _misfits(asked, "query")
    octets = len(quote(str(path), safe="/?&=%")) + len(urlencode(asked, doseq=True))
    if octets > _MAX_TARGET:
        yield f"the path `{shown(path, str)}` has {octets} octets with its query; valid are at most {_MAX_TARGET}"


def _misfits(value: object, name: str, depth: int = 0) -> Iterator[str]:
    """Say of every value in a document that is no JSON where it stands, what it is, and what would be valid."""
    if depth > _MAX_DEPTH:
        yield f"`{name}` is nested too deep; valid are at most {_MAX_DEPTH} levels"
    elif isinstance(value, dict):
        for key, item in cast("dict[object, object]", value).items():
            if not isinstance(key, str):
                yield f"`{name}` has the key `{shown(key)}`; valid keys are strings"
            yield from _misfits(key, f"{name}, key {shown(key)}", depth + 1)
            yield from _misfits(item, f"{name}.{shown(key, str)}".removeprefix("json."), depth + 1)
    elif isinstance(value, list | tuple):
        for place, item in enumerate(cast("list[object]", value)):
            yield from _misfits(item, f"{name}[{place}]", depth + 1)
    else:
        yield from _misfit(value, name)


def _misfit(value: object, name: str) -> Iterator[str]:
    if isinstance(value, float) and not math.isfinite(value):
        yield f"`{name}` is `{value}`; valid are finite numbers"
    elif isinstance(value, int) and abs(value) > _LARGEST:  # not shown: Python refuses to write thousands of digits
        yield f"`{name}` is a whole number of {value.bit_length()} bits; valid are numbers up to 1e308"
    elif isinstance(value, str) and any("\ud800" <= character <= "\udfff" for character in value):
        yield f"`{name}` is `{shown(value)}`; valid is text without lone surrogates"
    elif not isinstance(value, str | int | float | None):
        yield f"`{name}` is `{shown(value)}`, a {type(value).__name__}; valid are JSON's types: text, numbers, lists, …"


def header_text(name: str, value: object, most: int) -> str:
    """Return a value that may stand in a header. Raises `Unsendable` naming it; a token is not repeated."""
    if not isinstance(value, str) or not (0 < len(value) <= most and value.isascii() and value.isprintable()):
        seen = "" if name == "token" else f" `{shown(value)}`"
        raise Unsendable(f"{name}{seen}: valid are 1 to {most} printable ASCII characters; nothing was sent")
    return value


def path_of(invocation: object) -> str:
    """Return the path of an invocation; whatever stands in its name leads nowhere else.

    Raises `Unsendable` for what is no name.
    """
    if not isinstance(invocation, str) or not invocation or next(_misfit(invocation, "invocation"), None):
        raise Unsendable(f"the invocation is `{shown(invocation)}`; valid is the `id` of one; nothing was sent")
    return f"/v1/invocations/{quote(invocation, safe='')}"
