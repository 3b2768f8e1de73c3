"""A cell that is started by hand, as on another machine, joins a server that runs and is governed by it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.config import CELL_TOKEN_VARIABLE
from tests.conftest import PACE, ServerProcess, Servers, until

pytestmark = [pytest.mark.process, pytest.mark.timeout(120)]
NAME = "workcell-7"


class Hand:
    """Starts cells by hand and ends every one of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen[bytes]] = []

    def join(self, server: ServerProcess, token: str, *flags: str) -> tuple[subprocess.Popen[bytes], Path]:
        log = self.folder / f"cell-{len(self.started)}.log"
        words = [
            "cell",
            "--server",
            server.url,
            "--id",
            NAME,
            "--data",
            str(self.folder / NAME),
            "--pace",
            PACE,
            *flags,
        ]
        with log.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, "-m", "app.cli", *words],
                stdout=out,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env={**os.environ, CELL_TOKEN_VARIABLE: token},
            )
        self.started.append(process)
        Servers.logs.add(log)  # where its link lapses, it says so here
        return process, log

    def end(self) -> None:
        for process in self.started:
            if process.poll() is None:
                process.kill()
            process.wait(10.0)


@pytest.fixture(scope="module")
def server(kept: Servers) -> ServerProcess:
    """One server without cells of its own, for all who want to join."""
    return kept.start(cells=0)


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[Hand]:
    made = Hand(tmp_path)
    yield made
    made.end()


def token_of(server: ServerProcess) -> str:
    return (server.data / "cell.token").read_text().strip()


def online(server: ServerProcess) -> bool:
    cells: list[dict[str, Any]] = server.get("/v1/cells")["items"]
    return any(cell["id"] == NAME and cell["online"] for cell in cells)


def test_a_cell_joins_by_hand_runs_what_it_is_sent_and_leaves_when_told_to(server: ServerProcess, hand: Hand) -> None:
    process, log = hand.join(server, token_of(server))
    until(lambda: online(server), 60.0, f"the cell is online; see {log}")
    asked = {"capability": "navigate_to", "params": {"target": "tool_stand"}, "cell": NAME}
    until(lambda: server.post("/v1/check", asked, key="agent").json()["status"] == "allowed", what="it is ready")
    made = server.post("/v1/invocations", asked, key="agent").json()
    done = server.await_status(made["id"], "completed")
    assert (done["cell"], done["outcome"]) == (NAME, "succeeded")
    kinds = lambda: {event["kind"] for event in server.get(f"/v1/invocations/{made['id']}/trace")["items"]}  # noqa: E731
    assert {"authorization", "launch", "outcome"} <= kinds()
    until(lambda: "telemetry" in kinds(), what="the telemetry is sealed, which its last rows precede")
    process.send_signal(signal.SIGTERM)
    assert process.wait(20.0) == 0
    until(lambda: not online(server), what="the server sees it leave")


def test_a_wrong_token_does_not_get_in(server: ServerProcess, hand: Hand) -> None:
    process, log = hand.join(server, "not-the-token")
    until(
        lambda: "answered 401: is the cell's token valid?" in log.read_text(), 60.0, "the cell says that it is refused"
    )
    assert process.poll() is None  # it dials on: tokens can be renewed
    assert not online(server)


def test_a_cell_in_the_name_of_a_person_is_told_why_it_does_not_get_in(server: ServerProcess, hand: Hand) -> None:
    process, log = hand.join(server, token_of(server), "--id", "operator")
    until(lambda: "answered 422: `operator` reads like `operator`" in log.read_text(), 60.0, "the cell says why")
    assert process.poll() is None
    assert "operator" not in {cell["id"] for cell in server.get("/v1/cells")["items"]}


def test_a_cell_with_a_robot_that_cannot_be_driven_does_not_start(
    server: ServerProcess, hand: Hand, tmp_path: Path
) -> None:
    model = tmp_path / "robot.xml"
    model.write_text("<mujoco><worldbody><body name='box'><geom size='0.1'/></body></worldbody></mujoco>")
    process, log = hand.join(server, token_of(server), "--robot", str(model))
    assert process.wait(60.0) == 2
    assert "lacks body `gripper`, joint `base_x`" in " ".join(log.read_text().split())
    assert not online(server)
