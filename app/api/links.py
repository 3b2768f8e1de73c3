"""The cells' door: a websocket that carries frames between one cell and its attachment in the fleet, and nothing else.

Frames wait in the attachment's own bounded outlet; a socket that does not drain is closed there, and the cell then
holds by itself. So it does when its token expires or is withdrawn: the link ends with 4401, and no other is let in.
"""

from __future__ import annotations

import asyncio
import contextlib
from functools import partial
from typing import TYPE_CHECKING

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from app.api.access import WEBSOCKET, allowed_roles, authorize
from app.api.auth import MACHINES, as_read
from app.api.parts import parts_of
from app.api.problems import Problem
from app.api.staying import close_code, until_refused
from app.audit.errors import AuditError
from app.clock import monotonic_s
from app.config import CELL_ID, VALID_CELL_ID
from app.runtime.link import SILENT_S, TRY_LATER

if TYPE_CHECKING:
    from collections.abc import Callable

    from fastapi import APIRouter

    from app.api.parts import Parts
    from app.runtime.link import Attachment

PATH = "/v1/cells/{id}/link"
POLICY_VIOLATION = 1008
NO_HELLO = 4408
TURN_S = 0.01  # of one cell's messages, however many wait: the others' leases are of 300 ms
MOST_BYTES = 120  # of why a socket is closed; one that is closed for more is cut without a word


class SocketLink:
    """One websocket as the runtime's `Link`."""

    def __init__(self, socket: WebSocket) -> None:
        """Wrap an accepted websocket."""
        self._socket = socket

    async def send(self, frame: str) -> None:
        """Send one text frame; raises when the socket is gone."""
        await self._socket.send_text(frame)

    async def close(self, code: int, reason: str) -> None:
        """Close the socket, if it is still open."""
        if self._socket.application_state is WebSocketState.CONNECTED:
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # it closed from the other side meanwhile
                await self._socket.close(code, reason.encode()[:MOST_BYTES].decode(errors="ignore"))


async def link(socket: WebSocket) -> None:
    """Carry frames until either side ends it; refused with the problem's own status before the handshake."""
    cell_id = str(socket.path_params["id"])
    let_in = partial(_let_in, socket, cell_id)
    try:
        let_in()
        _check_name(cell_id, parts_of(socket))
    except Problem as problem:
        await socket.send_denial_response(problem.response(socket.url.path))
        return
    await socket.accept()
    carrier = SocketLink(socket)
    try:
        attachment = await parts_of(socket).fleet.attach(cell_id, carrier)
    except AuditError as error:
        await carrier.close(TRY_LATER, str(error))
        return
    try:
        async with asyncio.TaskGroup() as tasks:  # whichever breaks ends the other: nobody stays who is not asked
            watches = [tasks.create_task(_stay_known(attachment, let_in)), tasks.create_task(_greeted(attachment))]
            await _carry(socket, attachment)
            for watch in watches:
                watch.cancel()
    finally:
        await attachment.detach()


async def _carry(socket: WebSocket, attachment: Attachment) -> None:
    """Hand on what comes. What waits already would be taken without a pause: others have as much time in between."""
    spent_s = 0.0
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        text = message.get("text")
        began_s = monotonic_s()
        await attachment.receive(message["bytes"] if text is None else text)
        spent_s += monotonic_s() - began_s
        if spent_s > TURN_S:
            await asyncio.sleep(TURN_S)
            spent_s = 0.0


async def _stay_known(attachment: Attachment, let_in: Callable[[], object]) -> None:
    """Shut the link when its token is withdrawn or expires: nothing more is taken from it, and nothing sent."""
    refusal = await until_refused(let_in)
    attachment.shut(close_code(refusal), refusal.detail)


async def _greeted(attachment: Attachment) -> None:
    """Shut a link on which nobody has said who dials in: no more of it is looked after than its socket."""
    await asyncio.sleep(SILENT_S)
    if attachment.hello is None:
        attachment.shut(NO_HELLO, f"no `hello` came within {SILENT_S:g} s")


def _let_in(socket: WebSocket, cell_id: str) -> None:
    """Let in whoever has a cell's token, in the name of the cell that it was issued for if it was. Raises `Problem`."""
    who = authorize(socket, parts_of(socket).principals, allowed_roles(WEBSOCKET, PATH))
    if who is not None and who.station not in {None, cell_id}:
        raise Problem("role_forbidden", f"the token is of the cell `{who.station}`: valid is that name")


def _check_name(cell_id: str, parts: Parts) -> None:
    """Refuse a name that is none, or under which the record would hold somebody else's words. Raises `Problem`."""
    if CELL_ID.fullmatch(cell_id) is None:
        raise Problem("request_invalid", f"`{cell_id}` is no name of a cell: valid are {VALID_CELL_ID}")
    read = as_read(cell_id)
    taken = next((name for name in (*MACHINES, *parts.policy().agents) if as_read(name) == read), None)
    taken = taken or parts.roll.alike(cell_id)
    if taken is not None:
        raise Problem(
            "request_invalid", f"`{cell_id}` reads like `{taken}`, whom the record calls so: valid is another name"
        )


def register(router: APIRouter) -> None:
    """Add the link."""
    router.add_api_websocket_route(PATH, link)
