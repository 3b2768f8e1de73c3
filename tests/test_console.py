"""A console on a real server with a real cell: what is shown of a session while it runs."""

from __future__ import annotations

import contextlib
import math
import struct
from typing import Any

import orjson
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from app.clock import monotonic_s
from tests.conftest import ServerProcess, Servers

pytestmark = [pytest.mark.process, pytest.mark.timeout(120)]
PATIENCE_S = 30.0


class Console:
    """Reads frames and acknowledges them, as a browser would."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.messages: list[dict[str, Any]] = []
        self.frames: list[bytes] = []

    def say(self, **message: Any) -> None:
        self.socket.send(orjson.dumps(message).decode())

    def read(self) -> None:
        frame = self.socket.recv(PATIENCE_S)
        if isinstance(frame, bytes):
            self.frames.append(frame)
            self.say(type="ack", cell=0, frame=struct.unpack_from("<I", frame, 12)[0])
            return
        message = orjson.loads(frame)
        self.messages.append(message)
        if message["type"] == "beat":
            self.say(type="ack", beat=message["n"])

    def until(self, found: Any, what: str) -> Any:
        deadline = monotonic_s() + PATIENCE_S
        while not (value := found()):
            assert monotonic_s() < deadline, f"never shown: {what}"
            self.read()
        return value

    def newest(self, kind: str) -> dict[str, Any] | None:
        return next((message for message in reversed(self.messages) if message["type"] == kind), None)

    def gauge(self, name: str) -> float:
        scene = self.newest("scene")
        assert scene is not None
        bodies = len(scene["bodies"])
        return struct.unpack_from("<f", self.frames[-1], 28 + bodies * 28 + 4 * scene["gauges"].index(name))[0]


@pytest.fixture
def paced(kept: Servers) -> ServerProcess:
    """A server whose cell keeps real time."""
    return kept.newest("--profile", "sim-relaxed", "--pace", "1")


def door(server: ServerProcess) -> ClientConnection:
    url = server.url.replace("http:", "ws:") + "/v1/console"
    return connect(url, subprotocols=[Subprotocol("reins.console.1")], proxy=None, compression=None)


def test_texts_that_are_no_utf_8_end_their_own_socket_alone_and_leave_no_traceback(paced: ServerProcess) -> None:
    with door(paced) as socket:
        console = Console(socket)
        console.say(type="hello", token=paced.tokens["operator"], after=None)
        for _ in range(20):
            with door(paced) as other, contextlib.suppress(ConnectionClosed):
                other.send(b'{"type": "hello \xff"}', text=True)
                other.recv(PATIENCE_S)
            assert other.close_code == 1007
        console.say(type="ping", at_ms=1.5)
        console.until(lambda: console.newest("pong"), "an answer")
    assert "Traceback" not in paced.log.read_text()


def test_a_drive_is_shown_with_its_poses_limits_and_way(paced: ServerProcess) -> None:
    with door(paced) as socket:
        console = Console(socket)
        console.say(type="hello", token=paced.tokens["operator"], after=None)
        console.say(type="watch", cells=["workcell-1"])
        scene = console.until(lambda: console.newest("scene"), "the scene")
        assert "mug_1" in scene["bodies"]
        assert {"zones", "shapes", "fixed", "bounds_m"} <= scene["scene"].keys()
        console.until(lambda: console.frames, "poses")
        assert math.isnan(console.gauge("base_speed_limit_mps"))
        drive = paced.propose("navigate_to", target="dock", speed_mps=1.0)
        assert drive["status"] == "running"
        path = console.until(
            lambda: next((one for one in console.messages if one["type"] == "path" and one["points"]), None), "the way"
        )
        assert path["invocation"] == drive["id"]
        console.until(lambda: console.gauge("base_speed_mps") > 0.2, "a base that moves")
        assert console.gauge("base_speed_limit_mps") == pytest.approx(1.0)
        assert 0.0 < console.gauge("progress") < 1.0
        assert console.gauge("base_radius_m") == pytest.approx(0.45)
        assert math.hypot(console.gauge("tcp_x_m"), console.gauge("tcp_y_m")) > 0.1
        sitting = [
            cell["session"] for one in console.messages for cell in one.get("cells", []) if cell["busy"] == drive["id"]
        ]
        assert {"retract", "drive"} & {one["phase"] for one in sitting if one}
        paced.post(f"/v1/invocations/{drive['id']}/stop")
        console.until(lambda: (console.newest("path") or {}).get("points") == [], "the way's end")
        console.until(lambda: math.isnan(console.gauge("base_speed_limit_mps")), "the session's end")
