"""Whoever stays, on a stream or a socket, is asked again who they are; whoever has hung up stays no longer.

A request is let in once and is soon over. What lasts outlives its token, which expires, is withdrawn or comes to stand
for another role meanwhile: it ends within about a second of that.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, TypeVar

from app.api.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from starlette.requests import Request

T = TypeVar("T")

STILL_KNOWN_S: Final = 1.0
SHOWN_OUT: Final = 4000
CUT: Final = "reins.cut"  # in the scope of a request: what cuts the connection of a peer that reads no farewell
GONE: Final = "reins.gone"  # likewise: what says whether its peer has ended the connection
FOLLOWED: Final = "reins.followed"  # likewise: what says whether another request waits for its end
UNREAD: Final = "reins.unread"  # likewise: whether it has a body that is not read as one


async def until_refused(let_in: Callable[[], object]) -> Problem:
    """Ask once a second whether somebody would still be let in; return why not as soon as they would not.

    Args:
        let_in: what let them in. Raises `Problem` where it would not do so now; anything else it raises is a bug, and
            whoever waits here has to end what stays.
    """
    while True:
        await asyncio.sleep(STILL_KNOWN_S)
        try:
            let_in()
        except Problem as problem:
            return problem


async def while_there(request: Request, waiting: Coroutine[Any, Any, T]) -> T | None:
    """Return what somebody waits for, or None where they have hung up, or asked on, before it came.

    Args:
        request: theirs, its body read.
        waiting: what they wait for; it is cancelled once nobody does.
    """
    waited, gone = asyncio.ensure_future(waiting), asyncio.ensure_future(_waits_no_more(request))
    try:
        await asyncio.wait({waited, gone}, return_when=asyncio.FIRST_COMPLETED)
        return waited.result() if waited.done() else None
    finally:
        waited.cancel()
        gone.cancel()


async def _waits_no_more(request: Request) -> None:
    """Return once whoever made a request, its body read, has hung up or asked on: what came behind it may be a stop."""
    followed: Callable[[], bool] = request.scope.get(FOLLOWED, bool)
    while (await request.receive())["type"] != "http.disconnect" and not followed():
        pass


def close_code(refusal: Problem) -> int:
    """Return the code that a websocket is closed with: 4401 for a token, 4403 for a role."""
    return SHOWN_OUT + refusal.status
