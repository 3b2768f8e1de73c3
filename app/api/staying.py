"""Whoever stays, on a stream or a socket, is asked again who they are.

A request is let in once and is soon over. What lasts outlives its token, which expires, is withdrawn or comes to stand
for another role meanwhile: it ends within about a second of that.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from app.api.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Callable

STILL_KNOWN_S: Final = 1.0
SHOWN_OUT: Final = 4000
CUT: Final = "reins.cut"  # in the scope of a request: what cuts the connection of a peer that reads no farewell


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


def close_code(refusal: Problem) -> int:
    """Return the code that a websocket is closed with: 4401 for a token, 4403 for a role."""
    return SHOWN_OUT + refusal.status
