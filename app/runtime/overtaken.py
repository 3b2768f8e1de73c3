"""Whether a word on which something moves, or that ends a pause, comes too late.

Other people's, or a pause, may have overtaken it, or whoever said it has given up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.governance.model import EventKind
from app.runtime.cells import PAUSE
from app.runtime.drafts import ACKNOWLEDGE
from app.runtime.errors import Conflict
from app.runtime.recollection import events_of

if TYPE_CHECKING:
    from app.audit.event import Event
    from app.runtime.cells import Cell
    from app.runtime.invocation import Principal
    from app.runtime.register import Register


def check_waiting(principal: Principal) -> None:
    """Refuse a word on which something moves of somebody who waits for its answer no more.

    A server that stood still finds it in a socket beside what they, or others, have said instead since.

    Raises:
        Conflict: `given_up`.
    """
    if not principal.waits():
        message = f"`{principal.name}` has given up waiting for the answer: nothing came of it; valid: say it anew"
        raise Conflict("given_up", message)


async def check_newest(register: Register, cell: Cell, invocation: str, principal: Principal, after: int) -> None:
    """Refuse a word on which something moves that others' words have overtaken, or anybody's pause.

    A link may hold a word back for seconds. It was said of what its speaker saw, and ends no pause that came later.

    Args:
        register: where what was said is read.
        cell: the cell that is to be told.
        invocation: whose session it is about.
        principal: who says it.
        after: the last `seq` of the record that they had seen.

    Raises:
        Conflict: `overtaken`.
    """
    said = await events_of(register.store, invocation=invocation, after=after)
    words = [(event.actor, word) for event in said if (word := _word(event)) is not None]
    newer = [(who, word) for who, word in words if who != principal.name or word == PAUSE]
    if not newer and (PAUSE, invocation) in cell.owed:  # it is not in the log yet
        newer.append(("somebody", PAUSE))
    if newer:
        who, word = newer[-1]
        raise Conflict("overtaken", f"`{who}` said `{word}` after the event `{after}`; valid: look, and say it anew")


async def check_pause(register: Register, cell: Cell, invocation: str, after: int) -> None:
    """Refuse a word that would end a pause of which its speaker had not seen: anybody's, and no other word.

    Args:
        register: where what was said is read.
        cell: the cell that is to be told.
        invocation: whose session it is about.
        after: the last `seq` of the record that they had seen.

    Raises:
        Conflict: `overtaken`.
    """
    if not cell.paused(invocation):
        return
    said = await events_of(register.store, invocation=invocation, after=after)
    if (PAUSE, invocation) in cell.owed or any(_word(event) == PAUSE for event in said):
        who = cell.paused_by(invocation) or "somebody"
        raise Conflict("overtaken", f"`{who}` said `{PAUSE}` after the event `{after}`; valid: look, and say it anew")


def _word(event: Event) -> str | None:
    """Return what a person said of a session by an event.

    No word is that somebody looks at its question, nor a cell's echo, which names no role.
    """
    body = event.payload()
    if event.kind == EventKind.APPROVAL:
        return str(body["decision"])
    said = event.kind == EventKind.HUMAN and "role" in body and body["op"] != ACKNOWLEDGE
    return str(body["op"]) if said else None
