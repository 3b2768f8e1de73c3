"""Taking over on a real server with a real cell: one lease, a hand on the robot over the socket, and every way back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import orjson
import pytest
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from app.api.auth import issue_token
from app.clock import monotonic_s
from app.governance.control import LATE_S
from app.governance.model import Role
from tests.conftest import ServerProcess, Servers, until

pytestmark = [pytest.mark.process, pytest.mark.timeout(120)]
PATIENCE_S = 30.0
CELL = "/v1/cells/workcell-1"
STILL = {"base": [0.0, 0.0, 0.0], "tool": [0.0, 0.0, 0.0], "grip": None}


class Hand:
    """A console with its keys."""

    def __init__(self, socket: ClientConnection, lease: dict[str, Any]) -> None:
        self.socket, self.lease, self.number = socket, lease["lease"], 0
        self.said: list[Any] = []
        self.beat, self.beaten_s = 0, 0.0

    def say(self, **wish: Any) -> None:
        self.number += 1
        word = {
            "type": "jog",
            "cell": "workcell-1",
            "lease": self.lease,
            "n": self.number,
            **STILL,
            **self.of_now(),
            **wish,
        }
        self.socket.send(orjson.dumps(word).decode())

    def of_now(self) -> dict[str, Any]:
        return {"beat": self.beat, "since_ms": 1000.0 * (monotonic_s() - self.beaten_s)} if self.beat else {}

    def listen(self, timeout_s: float) -> None:
        try:
            message = orjson.loads(self.socket.recv(timeout_s))
        except TimeoutError:
            return
        if message["type"] == "beat":
            self.beat, self.beaten_s = message["n"], monotonic_s()
            self.socket.send(orjson.dumps({"type": "ack", "beat": message["n"]}).decode())
        elif message["type"] == "jogged":
            self.said.append(message["refused"])

    def hold(self, until: Any, what: str, **wish: Any) -> None:
        """Hold a key until something is so."""
        deadline = monotonic_s() + PATIENCE_S
        while not until():
            assert monotonic_s() < deadline, f"never so: {what}; said {self.said}"
            self.say(**wish)
            self.listen(0.05)


@contextmanager
def hand(server: ServerProcess, lease: dict[str, Any], token: str) -> Iterator[Hand]:
    url = server.url.replace("http:", "ws:") + "/v1/console"
    with connect(url, subprotocols=[Subprotocol("reins.console.1")], proxy=None, compression=None) as socket:
        socket.send(orjson.dumps({"type": "hello", "token": token, "after": None}).decode())
        yield Hand(socket, lease)


@pytest.fixture
def server(kept: Servers) -> ServerProcess:
    return kept.newest("--profile", "real-restricted", "--pace", "1")


def base(server: ServerProcess) -> list[float]:
    return server.facts()["base"]


def control(server: ServerProcess) -> dict[str, Any] | None:
    return server.cell()["control"]


def trace(server: ServerProcess, lease: dict[str, Any]) -> list[Any]:
    return server.get(f"/v1/invocations/{lease['invocation']}/trace")["items"]


def moved(server: ServerProcess, by_m: float) -> Any:
    x, y, _ = base(server)
    return lambda: abs(base(server)[0] - x) + abs(base(server)[1] - y) > by_m


def test_an_idle_cell_is_driven_by_one_hand_and_a_local_one_takes_it_away(server: ServerProcess) -> None:
    lease = server.post(f"{CELL}/takeover").json()
    assert lease.items() >= {"cell": "workcell-1", "holder": "operator", "where": "remote"}.items(), lease
    second = server.post(f"{CELL}/takeover", key="operator_2")
    assert (second.status_code, second.json()["code"]) == (409, "control_held")
    assert "`operator`" in second.json()["detail"]
    with hand(server, lease, server.tokens["operator"]) as remote:
        remote.hold(lambda: remote.said == [None], "a lease that counts")
        remote.hold(moved(server, 0.1), "a base that moves", base=[-0.3, 0.0, 0.0])
        local = issue_token(server.data, name="lena", role=Role.OPERATOR, station="workcell-1")
        deadline = monotonic_s() + 5.0
        while (taken := post(server, f"{CELL}/takeover", local)).status_code == 401:
            assert monotonic_s() < deadline
        assert taken.json().items() >= {"holder": "lena", "where": "local", "invocation": lease["invocation"]}.items()
        remote.hold(lambda: remote.said[-1] == "not_holder", "a hand that is off", base=[-0.3, 0.0, 0.0])
    done = post(server, f"/v1/invocations/{lease['invocation']}/release", local, then="end").json()
    assert (done["outcome"], done["takeover"]["state"]) == ("taken_over", "ended"), done
    assert done["takeover"]["facts"]["gripper_empty"] is True
    assert control(server) is None
    told = [event["body"] for event in trace(server, lease)]
    assert [body["how"] for body in told if body.get("op") == "takeover"] == ["granted", "preempted"]
    assert next(body["base"] for body in told if body.get("op") == "jog") == [-0.3, 0.0, 0.0]


def test_what_a_slow_line_brings_late_moves_nothing_but_letting_go_is_never_late(server: ServerProcess) -> None:
    lease = server.post(f"{CELL}/takeover").json()
    with hand(server, lease, server.tokens["operator"]) as slow:
        slow.hold(lambda: slow.beat > 2, "beats")
        first, begun_s = slow.beat, slow.beaten_s
        slow.hold(lambda: monotonic_s() - begun_s > LATE_S, "a beat of some time ago")
        late = {"beat": first, "since_ms": 0.0}  # as if it had been said when that beat came
        slow.hold(lambda: slow.said[-1] == "too_late", "a command that is refused", base=[-0.3, 0.0, 0.0], **late)
        slow.hold(lambda: slow.said[-1] is None, "a release that counts", **late)
        of_nothing = {"beat": first + 10_000, "since_ms": 0.0}
        slow.hold(lambda: slow.said[-1] == "too_late", "of no beat at all", base=[-0.3, 0.0, 0.0], **of_nothing)
        slow.hold(lambda: slow.said[-1] is None, "hands off")
        assert "jog" not in {event["body"].get("op") for event in trace(server, lease)}
        slow.hold(moved(server, 0.1), "a base that moves, in time", base=[-0.3, 0.0, 0.0])
    assert server.post(f"/v1/invocations/{lease['invocation']}/release", {"then": "end"}).is_success


def test_a_session_is_taken_over_lapses_and_goes_on_only_as_decided_anew(server: ServerProcess) -> None:
    x, y, yaw = base(server)
    drive = server.propose("navigate_to", x_m=x, y_m=y - 1.0, yaw_rad=yaw, speed_mps=0.3)
    assert drive["status"] == "running", drive
    assert moved_within(server, 0.1)
    lease = server.post(f"/v1/invocations/{drive['id']}/takeover").json()
    assert lease["invocation"] == drive["id"], lease
    with hand(server, lease, server.tokens["operator"]) as driver:
        driver.hold(lambda: driver.said[-1:] == [None], "a robot at rest")
        driver.hold(moved(server, 0.1), "a base that moves", base=[0.0, 0.2, 0.0])
        driver.say()
        refused = server.post(f"/v1/invocations/{drive['id']}/rollback")
        assert refused.json()["code"] == "control_held"
    server.await_status(drive["id"], "escalated")

    def lapsed() -> bool:  # the cell holds and says so; that the lease is gone is for the server to say
        return server.get(f"/v1/invocations/{drive['id']}")["takeover"]["state"] == "lapsed"

    until(lapsed, what="the lease has lapsed")
    again = server.post(f"/v1/invocations/{drive['id']}/takeover").json()
    with hand(server, again, server.tokens["operator"]) as driver:
        driver.hold(lambda: driver.said[-1:] == [None], "a robot in hand again")
        back = server.post(f"/v1/invocations/{drive['id']}/release", {"then": "resume"}).json()
    assert back.get("takeover", {}).get("state") == "returned", back
    assert control(server) is None
    ended = server.await_status(drive["id"], "completed")
    assert ended["outcome"] == "recovered"
    assert base(server)[:2] == pytest.approx([x, y - 1.0], abs=0.1)


def test_leaving_a_latched_stop_takes_two_steps_of_one_person(server: ServerProcess) -> None:
    server.post(f"{CELL}/estop")
    armed = server.post(f"{CELL}/reset", {"step": "arm"}).json()
    assert armed["latched"] is True
    code = armed["arming"]["code"]
    assert server.post(f"{CELL}/reset", confirm(code), key="operator_2").json()["code"] == "not_armed"
    code = server.post(f"{CELL}/reset", {"step": "arm"}).json()["arming"]["code"]
    server.post(f"{CELL}/estop", key="agent")
    assert server.post(f"{CELL}/reset", confirm(code)).json()["code"] == "not_armed"
    code = server.post(f"{CELL}/reset", {"step": "arm"}).json()["arming"]["code"]
    assert server.post(f"{CELL}/reset", confirm(code)).json()["latched"] is False


def confirm(code: str) -> dict[str, str]:
    return {"step": "confirm", "code": code}


def moved_within(server: ServerProcess, by_m: float) -> bool:
    far, deadline = moved(server, by_m), monotonic_s() + PATIENCE_S
    while not far():
        assert monotonic_s() < deadline
    return True


def post(server: ServerProcess, path: str, token: str, **body: Any) -> httpx.Response:
    headers = {"Authorization": f"Bearer {token}"}
    return httpx.post(server.url + path, headers=headers, json=body, timeout=10.0, trust_env=False)
