"""What the routes work with: the live parts of the server, put together once and read from the application."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, cast

from app.api.seats import Doorstep, Ration, Seats, Turns

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from starlette.requests import HTTPConnection

    from app.api.auth import Principals
    from app.api.roll import Roll
    from app.audit.store import AuditStore
    from app.governance.policy import PolicySet
    from app.runtime.broadcast import Broadcast
    from app.runtime.desk import Desk
    from app.runtime.feed import Feed
    from app.runtime.fleet import Fleet
    from app.runtime.governor import Governor
    from app.runtime.shadow import Shadow
    from app.runtime.versions import Versions

# Every committed event is written once for each stream; a wait costs a timer and a connection.
MAX_STREAMS: Final = 64
EACH_STREAMS: Final = 16
MAX_WAITS: Final = 1024
EACH_WAITS: Final = 256
MAX_CONSOLES: Final = 128
EACH_CONSOLES: Final = 32
MAX_UNGREETED: Final = 64  # sockets that nobody has signed in on yet
# What one person's consoles may say together in a second, as many as they may be.
EACH_WORDS: Final = 4_000
WORDS_WITHIN_S: Final = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """The runtime behind the door.

    `policy` returns the policy set in force (one reference, read once per request). `checks` are further questions
    about cells that `/readyz` asks: each returns what is broken, or None.
    """

    governor: Governor
    desk: Desk
    fleet: Fleet
    feed: Feed
    broadcast: Broadcast
    store: AuditStore
    policy: Callable[[], PolicySet]
    versions: Versions
    shadow: Shadow
    principals: Principals
    roll: Roll
    verifying: asyncio.Lock = field(default_factory=asyncio.Lock)
    replaying: asyncio.Lock = field(default_factory=asyncio.Lock)
    streams: Seats = field(default_factory=lambda: Seats(code="too_many_streams", limit=MAX_STREAMS, each=EACH_STREAMS))
    waits: Seats = field(default_factory=lambda: Seats(code="too_many_waits", limit=MAX_WAITS, each=EACH_WAITS))
    consoles: Seats = field(
        default_factory=lambda: Seats(code="too_many_streams", limit=MAX_CONSOLES, each=EACH_CONSOLES)
    )
    ungreeted: Doorstep = field(default_factory=lambda: Doorstep(code="too_many_streams", limit=MAX_UNGREETED))
    words: Ration = field(default_factory=lambda: Ration(most=EACH_WORDS, within_s=WORDS_WITHIN_S))
    long_bodies: Turns = field(default_factory=Turns)
    checks: Mapping[str, Callable[[], str | None]] = field(default_factory=dict[str, "Callable[[], str | None]"])


def parts_of(connection: HTTPConnection) -> Parts:
    """Return the parts of the application a request came to."""
    return cast("Parts", connection.app.state.parts)
