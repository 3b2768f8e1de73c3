"""What is too long to be shown, without its longest parts: an agent may say a lot, and consoles are sent everything.

A proposal may have as much of parameters and metadata as a body holds. A hundred of those, refused, would be more than
a console may be behind: none could come in any more. The log has all of it, and so has the audit API.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import orjson

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from app.audit.event import Event
    from app.runtime.invocation import Invocation

LONG_BYTES: Final = 8192  # of an event or a document, as JSON; hardly any is as long that nobody blew up
LEFT_OUT: Final = "left_out"
MOST_NAMED: Final = 20
PARAMS: Final = frozenset({"requested", "effective"})
"""What of an invocation its agent fills; everything else is bounded, and those who read it rely on its form."""


def shown_event(event: Event) -> Event:
    """Return an event with the bytes that were hashed, a long one with its body `shortened`."""
    if len(event.body) <= LONG_BYTES:
        return event
    record: dict[str, Any] = orjson.loads(event.body)
    return event._replace(body=orjson.dumps({**record, "body": shortened(record["body"])}))


def shown_invocation(invocation: Invocation) -> bytes:
    """Return an invocation's document as JSON, a long one with its parameters `shortened`."""
    document = invocation.public()
    content = orjson.dumps(document)
    return content if len(content) <= LONG_BYTES else orjson.dumps(shortened(document, PARAMS))


def shortened(document: Mapping[str, Any], parts: Collection[str] | None = None) -> dict[str, Any]:
    """Return a document with the longest of its parts empty, as many as it takes; `left_out` names them.

    Args:
        document: what is too long.
        parts: which of its members may be left out; None: all that are objects, lists or texts.
    """
    sizes = {name: len(name) + len(orjson.dumps(value)) for name, value in document.items()}
    over = sum(sizes.values()) - LONG_BYTES
    short, left_out = dict(document), list[str]()
    for name in sorted(sizes, key=lambda name: -sizes[name]):
        empty = _empty(document[name])
        if over > 0 and empty is not None and (parts is None or name in parts):
            short[name] = empty
            over -= sizes[name]
            left_out.append(name)
    return {**short, LEFT_OUT: left_out[:MOST_NAMED]}


def _empty(value: object) -> dict[str, Any] | list[Any] | str | None:
    """Return an empty value of the same kind, so that no reader stumbles; None where there is none."""
    match value:
        case dict():
            return {}
        case list():
            return []
        case str():
            return ""
        case _:
            return None
