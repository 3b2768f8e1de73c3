from __future__ import annotations

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from app.protocol import ROW, ProtocolError, pack_batch, unpack_batch
from tests.api.conftest import CELL, House

pytestmark = pytest.mark.anyio


def link_url(house: House, name: str = CELL) -> str:
    return house.url.replace("http:", "ws:") + f"/v1/cells/{name}/link"


@pytest.mark.parametrize("key", ["agent", "operator", "operator_2", "engineer", "auditor", None])
async def test_only_a_cell_may_dial_in(house: House, key: str | None) -> None:
    headers = {} if key is None else {"Authorization": f"Bearer {house.tokens[key]}"}
    with pytest.raises(InvalidStatus) as refused:
        async with connect(link_url(house), additional_headers=headers, proxy=None):
            pass
    assert refused.value.response.status_code == (401 if key is None else 403)


@pytest.mark.parametrize("frame", ["{", '{"type": "state"}', b"\x00", '{"type": "beat"}'])
async def test_a_frame_that_is_no_greeting_ends_the_link(house: House, frame: str | bytes) -> None:
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    async with connect(link_url(house, "stranger"), additional_headers=headers, proxy=None) as socket:
        await socket.send(frame)
        with pytest.raises(ConnectionClosed) as ended:
            await socket.recv()
    assert ended.value.rcvd is not None
    assert ended.value.rcvd.code == 1002
    assert not house.runtime.fleet.knows("stranger")


@pytest.mark.parametrize("name", [b"inv_\xff", "übung".encode()])
def test_a_frame_of_telemetry_that_names_no_invocation_is_malformed(name: bytes) -> None:
    frame = bytearray(pack_batch("", bytes(ROW.size)))
    assert unpack_batch(bytes(frame))[0] == ""
    frame[8 : 8 + len(name)] = name
    with pytest.raises(ProtocolError, match="valid are ASCII characters"):
        unpack_batch(bytes(frame))


async def test_refuses_a_cell_whose_name_cannot_be_recorded(house: House) -> None:
    headers = {"Authorization": f"Bearer {house.cell_token}"}
    with pytest.raises(InvalidStatus) as refused:
        async with connect(link_url(house, "x" * 129), additional_headers=headers, proxy=None):
            pass
    assert refused.value.response.status_code == 422
