"""Ends server and cell in the middle of things, and looks at what is there afterwards."""

from __future__ import annotations

import math
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from app.audit.archive import verify_file
from tests.conftest import ServerProcess, Servers, put_in_profile, until

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]
FAR, FAR_M, ELSEWHERE = "tool_stand", (3.4, 1.4), "dock"


@pytest.fixture
def server(kept: Servers) -> ServerProcess:
    server = kept.newest("--pace", "3")
    if server.facts()["holding"] is not None:
        server = kept.start(None, "--pace", "3")
    put_in_profile(server, "human-shared")
    return server


def drive(server: ServerProcess) -> str:
    """Set the robot going, to where it is not yet, and return the invocation once it moves."""
    there = math.dist(server.facts()["base"][:2], FAR_M) < 1.0
    made = server.launch("navigate_to", target=ELSEWHERE if there else FAR)
    moving = lambda: (server.cell()["gauges"] or {}).get("base_speed_mps", 0.0) > 0.05  # noqa: E731
    until(moving, what="the robot moves")
    return made["id"]


def stand_at_the_bench(server: ServerProcess) -> str:
    """Have the robot where each world begins, and return the invocation that brought it there."""
    made = server.launch("navigate_to", target="bench_a_stand")
    server.await_status(made["id"], "completed")
    return made["id"]


def restarted(servers: Servers, server: ServerProcess) -> ServerProcess:
    return servers.start(server.data, "--pace", "3", wait_cells=False)


def test_a_session_outlives_its_server_and_waits_for_a_human(kept: Servers, server: ServerProcess) -> None:
    invocation = drive(server)
    before = server.get("/v1/audit/events?limit=500")["items"]
    pid = server.cell_pid()
    server.kill()
    again = restarted(kept, server)
    found = again.await_status(invocation, "escalated")
    assert again.cell_pid() == pid
    assert found["escalation"]["status"] == "pending"
    after = {event["seq"]: event for event in again.get("/v1/audit/events?limit=500")["items"]}
    assert all(after[event["seq"]] == event for event in before)
    until(lambda: again.cell()["online"])
    resting = again.facts()
    until(lambda: again.facts()["stamp_s"] > resting["stamp_s"] + 1.0, what="a second of its time")
    assert again.facts()["base"][:2] == pytest.approx(resting["base"][:2], abs=0.05)
    assert verify_file(again.data).ok
    question = again.get(f"/v1/escalations/{found['escalation']['id']}")
    answer = {"decision": "approve", "digest": question["digest"]}
    assert again.post(f"/v1/escalations/{question['id']}/resolve", answer).is_success
    assert again.await_status(invocation, "completed")["outcome"] in {"succeeded", "recovered"}


def test_a_cell_that_died_leaves_a_fault_comes_back_idle_and_reports_nothing_again(server: ServerProcess) -> None:
    invocation = drive(server)
    end_the_cell(server)
    assert server.await_status(invocation, "failed")["outcome"] == "fault"
    assert outcomes(server, invocation) == ["cell_restarted"]
    asked = [one["invocation"] for one in server.get("/v1/escalations")["items"]]
    assert invocation not in asked, "a cell that is being started says itself what became of its session"
    await_another_cell(server)
    stand_at_the_bench(server)
    end_the_cell(server)
    await_another_cell(server)
    stand_at_the_bench(server)
    events = server.get("/v1/audit/events?limit=1000")["items"]
    assert len(events) < 1000, "these are all"
    numbers = [event["body"]["cell_seq"] for event in events if "cell_seq" in event["body"]]
    assert numbers == list(range(1, len(numbers) + 1))
    hellos = [event["body"] for event in events if event["body"].get("link") == "attached"]
    assert [hello["last_seq"] > 0 for hello in hellos] == [False, *[True] * (len(hellos) - 1)]
    assert len(hellos) > 2
    assert len({hello["journal"] for hello in hellos}) == 1
    assert server.get("/v1/audit/verify")["ok"]


def end_the_cell(server: ServerProcess) -> None:
    pid = server.cell_pid()
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    until(lambda: server.cell_pid() not in {None, pid}, what="another process is the cell")


def await_another_cell(server: ServerProcess) -> None:
    until(lambda: server.cell()["online"] and server.cell()["busy"] is None, what="the cell is back, idle")


def outcomes(server: ServerProcess, invocation: str) -> list[str]:
    trace = server.get(f"/v1/invocations/{invocation}/trace")["items"]
    return [event["body"]["code"] for event in trace if event["kind"] == "outcome"]


def test_a_server_and_a_cell_that_died_together_leave_one_fault(kept: Servers, server: ServerProcess) -> None:
    invocation = drive(server)
    pid = server.cell_pid()
    assert pid is not None
    server.kill()
    os.kill(pid, signal.SIGKILL)
    again = restarted(kept, server)
    assert again.await_status(invocation, "failed")["outcome"] == "fault"
    await_another_cell(again)
    assert outcomes(again, invocation) == ["cell_restarted"]


def test_what_is_proposed_right_after_a_reset_is_launched(server: ServerProcess) -> None:
    stand_at_the_bench(server)
    put_in_profile(server, "sim-relaxed")
    for _ in range(3):
        assert server.post("/v1/cells/workcell-1/estop").json()["latched"]
        answer = server.post("/v1/cells/workcell-1/reset").json()
        assert not answer["latched"]
        made = server.propose("grasp_object", object_id="mug_1", force_n=40)
        assert made["status"] == "running", made["admission"]
        assert server.post(f"/v1/invocations/{made['id']}/stop").is_success
        assert server.await_status(made["id"], "failed")["outcome"] == "stopped"


def test_a_full_disk_launches_nothing_and_stops_all_the_same(server: ServerProcess) -> None:
    invocation = drive(server)
    hard = resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE)[1]
    resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (1024, hard))
    stopped = server.post(f"/v1/invocations/{invocation}/stop")
    assert (stopped.status_code, stopped.json()["recorded"]) == (200, False)
    until(lambda: server.cell()["status"] is None, what="the cell has ended its session")
    refused = server.post("/v1/invocations", {"capability": "navigate_to", "params": {"target": FAR}}, key="agent")
    assert refused.status_code == 503
    with server.client() as client:
        health, life = client.get("/readyz"), client.get("/healthz")
    assert health.status_code == 503
    assert "disk" in health.json()["broken"]["store"]
    assert (life.status_code, life.json()["status"]) == (200, "degraded")
    assert "disk" in life.json()["broken"]["store"]
    resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (hard, hard))
    assert server.await_status(invocation, "failed")["outcome"] == "stopped"
    until(lambda: httpx_ready(server), what="the server is ready again")
    assert server.get("/v1/audit/verify")["ok"]


def fill_the_disk_of_the_cell(server: ServerProcess) -> Callable[[], None]:
    """Let no file of the cell's process grow any more, its log included; returns what makes room again."""
    pid = server.cell_pid()
    assert pid is not None
    hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, hard))

    def make_room() -> None:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))

    return make_room


def shows_the_fault(server: ServerProcess) -> None:
    cell = until(lambda: (found := server.cell())["fault"] and found, what="the cell says why nothing moves")
    assert "cannot write the journal" in cell["fault"]
    assert (cell["busy"], cell["status"], cell["session"]) == (None, None, None)
    with server.client() as client:
        health, ready = client.get("/healthz"), client.get("/readyz")
    assert (health.status_code, health.json()["status"]) == (200, "degraded")
    assert "cannot write the journal" in health.json()["broken"]["cell/workcell-1"]
    assert str(server.data) not in health.text + ready.text  # both are answered to anybody
    assert (ready.status_code, ready.json()["broken"]) == (503, health.json()["broken"])


def is_well_again(server: ServerProcess, invocation: str) -> None:
    until(lambda: httpx_ready(server), what="the server is ready again")
    assert server.cell()["fault"] is None
    assert "workcell-1: the journal can be written again" in server.log.read_text()
    trace = server.get(f"/v1/invocations/{invocation}/trace")["items"]
    assert [event["kind"] for event in trace].count("outcome") == 1
    assert server.get("/v1/audit/verify")["ok"]
    again = server.propose("navigate_to", target="dock")["id"]
    server.await_status(again, "completed")


def test_a_cell_without_room_for_its_journal_launches_nothing_and_says_why(server: ServerProcess) -> None:
    make_room = fill_the_disk_of_the_cell(server)
    resting = server.facts()["base"]
    refused = server.propose("navigate_to", target=FAR)["id"]
    ended = server.await_status(refused, "failed", within_s=5.0)
    assert ended["outcome"] == "fault"
    assert [reason["code"] for reason in ended["failure"]["reasons"]] == ["journal_unavailable"]
    shows_the_fault(server)
    assert server.facts()["base"] == pytest.approx(resting, abs=0.02)
    later = server.propose("navigate_to", target=FAR)
    assert later["status"] == "deferred"
    assert [reason["code"] for reason in later["admission"]["reasons"]] == ["journal_unavailable"]
    make_room()
    is_well_again(server, refused)


def test_a_stop_shows_although_the_cell_cannot_write_it_down(server: ServerProcess) -> None:
    invocation = drive(server)
    make_room = fill_the_disk_of_the_cell(server)
    assert server.post(f"/v1/invocations/{invocation}/stop").status_code == 200
    assert server.await_status(invocation, "failed", within_s=5.0)["outcome"] == "stopped"
    shows_the_fault(server)
    until(
        lambda: server.cell()["gauges"]["base_speed_mps"] < 0.02,
        what="the base stands still, but for its sensor's noise",
    )
    make_room()
    is_well_again(server, invocation)


def httpx_ready(server: ServerProcess) -> bool:
    with server.client() as client:
        return client.get("/readyz").is_success


def test_a_cell_whose_journal_was_lost_begins_another_and_nothing_of_it_is_missed(
    kept: Servers, server: ServerProcess
) -> None:
    first = stand_at_the_bench(server)
    server.stop()
    (server.data / "cells" / "workcell-1" / "journal").unlink()
    again = kept.start(server.data, "--pace", "3")
    second = stand_at_the_bench(again)
    events = again.get("/v1/audit/events?limit=1000")["items"]
    assert len(events) < 1000, "these are all"
    journals = [event["body"]["journal"] for event in events if event["body"].get("link") == "attached"]
    assert set(journals[:-1]) == {journals[0]} != {journals[-1]}
    told = {
        of: [event for event in events if event["invocation"] == of and "cell_seq" in event["body"]]
        for of in (first, second)
    }
    for found in told.values():
        assert found[0]["kind"] == "launch"
        numbers = [event["body"]["cell_seq"] for event in found]
        assert numbers == sorted(set(numbers))
    assert told[second][0]["body"]["cell_seq"] == 1, "each journal counts for itself"


def test_a_pending_approval_keeps_its_deadline_across_a_restart(kept: Servers, server: ServerProcess) -> None:
    stand_at_the_bench(server)
    made = server.launch("grasp_object", object_id="mug_1")
    assert made["status"] == "awaiting_approval"
    (before,) = server.get("/v1/escalations?status=pending")["items"]
    server.kill()
    again = kept.start(server.data, "--pace", "3")
    (after,) = again.get("/v1/escalations?status=pending")["items"]
    assert (after["id"], after["digest"], after["expires_at"]) == (before["id"], before["digest"], before["expires_at"])
    answer = {"decision": "approve", "digest": after["digest"]}
    assert again.post(f"/v1/escalations/{after['id']}/resolve", answer).is_success
    again.await_status(made["id"], "completed")


def test_a_damaged_journal_starts_no_cell_and_says_so(servers: Servers, tmp_path: Path) -> None:
    folder = tmp_path / "damaged" / "cells" / "workcell-1"
    folder.mkdir(parents=True)
    (folder / "journal").write_bytes(b"nonsense\nmore\n")
    server = servers.start(tmp_path / "damaged", wait_cells=False)
    until(lambda: "is damaged" in server.log.read_text(), what="the complaint")
    with server.client() as client:
        health = client.get("/readyz")
        assert health.status_code == 503
        given_up = lambda: client.get("/readyz").json()["broken"].get("children")  # noqa: E731
        said = until(given_up, what="the server gives the cell up")
        assert client.get("/healthz").is_success
    assert said == "`workcell-1` cannot go on from a damaged journal: it ended with `65`; not started again"
    assert "not started again" in server.log.read_text()
