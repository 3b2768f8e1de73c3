"""Ends server and cell in the middle of a recovery, and looks at what is there afterwards."""

from __future__ import annotations

import os
import signal

import pytest

from app.audit.archive import verify_file
from tests.conftest import ServerProcess, Servers, until
from tests.test_crash import outcomes

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]


def recovering(servers: Servers, pace: str = "4") -> tuple[ServerProcess, str]:
    """Have a grip slip, and return the invocation while the cell recovers."""
    server = servers.start(None, "--pace", pace, "--profile", "sim-relaxed", "--scenario", "fetch_shared")
    server.await_status(server.launch("navigate_to", target="bench_a_stand")["id"], "completed")
    server.await_status(server.launch("inspect_area", area="bench_a_top")["id"], "completed")
    made = server.launch("grasp_object", object_id="mug_1", force_n=40.0, speed_mps=0.2)
    until(lambda: server.get(f"/v1/invocations/{made['id']}")["status"] == "recovering", what="the cell recovers")
    return server, made["id"]


def approved(server: ServerProcess, question: str) -> bool:
    """Approve a question; what the cell says of its recovery may change it between reading and answering."""
    path = f"/v1/escalations/{question}"
    answer = server.post(f"{path}/resolve", {"decision": "approve", "digest": server.get(path)["digest"]})
    assert answer.is_success or answer.json()["code"] == "digest_mismatch", answer.text
    return answer.is_success


# A server that starts takes longer than a recovery that is not in real time.
@pytest.mark.parametrize(("meanwhile", "pace"), [("the cell recovers", "1"), ("the cell has recovered", "4")])
def test_a_recovery_outlives_its_server_and_one_answer_lets_it_go_on(
    servers: Servers, meanwhile: str, pace: str
) -> None:
    server, invocation = recovering(servers, pace)
    before = server.get("/v1/audit/events?limit=1000")["items"]
    server.kill()
    again = servers.start(server.data, "--pace", pace, wait_cells=False)
    question = again.await_status(invocation, "escalated")["escalation"]
    after = {event["seq"]: event for event in again.get("/v1/audit/events?limit=1000")["items"]}
    assert all(after[event["seq"]] == event for event in before)
    assert question["status"] == "pending"
    until(lambda: again.cell()["online"], what="the cell is back")
    if meanwhile == "the cell has recovered":
        until(lambda: again.cell()["status"] == "escalated", what=meanwhile)
    until(lambda: approved(again, question["id"]), what="an answer to the question as it stands")
    assert again.await_status(invocation, "completed")["outcome"] == "recovered"
    questions = [item["id"] for item in again.get("/v1/escalations")["items"] if item["invocation"] == invocation]
    assert questions == [question["id"]]
    assert verify_file(again.data).ok


def test_a_cell_that_died_while_it_recovered_leaves_a_fault(servers: Servers) -> None:
    server, invocation = recovering(servers)
    pid = server.cell_pid()
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    assert server.await_status(invocation, "failed")["outcome"] == "fault"
    assert outcomes(server, invocation) == ["cell_restarted"]
    until(lambda: server.cell()["online"] and server.cell()["busy"] is None, what="the cell is back, idle")
    assert server.get("/v1/audit/verify")["ok"]
