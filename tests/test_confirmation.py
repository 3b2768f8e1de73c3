"""A phase that policy names waits, holding, for a human: a real server, a real cell, over HTTP."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import LAPSED, PACE, ServerProcess, Servers, until
from tests.test_contract import pending

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]

POLICIES = Path(__file__).resolve().parents[1] / "policies"
ENTRY = "{capability: navigate_to, profile: human-shared, phases: [settle], within_s: %g, on_deny: %s, on_timeout: %s}"


def confirming(
    servers: Servers,
    tmp_path: Path,
    *,
    within_s: float = 60.0,
    on_deny: str = "terminate",
    on_timeout: str = "terminate",
) -> ServerProcess:
    """Serve a policy in which a drive waits for a human before it settles at its target."""
    folder = tmp_path / "policies"
    shutil.copytree(POLICIES, folder)
    file = folder / "authority.yaml"
    entry = ENTRY % (within_s, on_deny, on_timeout)
    file.write_text(file.read_text().replace("confirm_before: []", f"confirm_before: [{entry}]"))
    return servers.start(None, "--pace", PACE, "--policies", str(folder))


def held(server: ServerProcess) -> tuple[str, dict[str, Any]]:
    made = server.propose("navigate_to", target="bench_b_stand")
    server.await_status(made["id"], "escalated")
    question = pending(server, made["id"])
    assert (question["kind"], question["phase"]) == ("session", "settle")
    return made["id"], question


def resolve(server: ServerProcess, question: dict[str, Any], decision: str) -> None:
    answer = {"decision": decision, "digest": question["digest"]}
    assert server.post(f"/v1/escalations/{question['id']}/resolve", answer).is_success


def test_a_confirmed_phase_goes_on_and_a_denied_one_is_undone(servers: Servers, tmp_path: Path) -> None:
    server = confirming(servers, tmp_path, on_deny="rollback")
    session, question = held(server)
    resolve(server, question, "approve")
    assert server.await_status(session, "completed")["outcome"] == "succeeded"
    began = server.cell()["facts"]["base"]
    made = server.propose("navigate_to", target="bench_a_stand")
    server.await_status(made["id"], "escalated")
    resolve(server, pending(server, made["id"]), "deny")
    again = server.post(f"/v1/invocations/{made['id']}/rollback")  # 409 where it is over by then
    assert (again.status_code, again.json().get("code")) in {(200, None), (409, "wrong_status")}, again.text
    ended = server.await_status(made["id"], "completed", "failed")
    assert (ended["outcome"], ended["escalation"]["code"]) == ("rolled_back", "unspecified")
    assert server.cell()["facts"]["base"] == pytest.approx(began, abs=0.15)


@pytest.mark.parametrize(
    ("on_timeout", "outcome", "codes"),
    [("terminate", "terminated", ["expired"]), ("rollback", "rolled_back", ["expired", "verified"])],
)
def test_silence_ends_the_session_and_is_nobodys_answer(
    servers: Servers, tmp_path: Path, on_timeout: str, outcome: str, codes: list[str]
) -> None:
    server = confirming(servers, tmp_path, within_s=1.0, on_timeout=on_timeout)
    session, question = held(server)
    ended = server.await_status(session, "failed")
    assert (ended["outcome"], [why["code"] for why in ended["failure"]["reasons"]]) == (outcome, codes)
    trace = server.get(f"/v1/invocations/{session}/trace", key="agent")["items"]
    (end,) = [event["body"] for event in trace if event["kind"] == "outcome"]
    assert [code for code in (end["failure"], end["code"]) if code] == codes
    (word,) = [event["body"] for event in trace if event["kind"] == "human"]
    assert (word["actor"], word["expired"]) == ("server", True)
    closed = server.get(f"/v1/escalations/{question['id']}")
    assert (closed["status"], closed["approvals"], closed["denial"]) == ("expired", [], None)


KEPT = ("phase", "on_deny", "on_timeout", "expires_at", "digest", "status")


def frozen(servers: Servers, server: ServerProcess) -> ServerProcess:
    """Have a server say nothing until its cell holds for that."""
    before = server.log.read_bytes().count(LAPSED)
    os.kill(server.process.pid, signal.SIGSTOP)
    try:
        until(lambda: server.log.read_bytes().count(LAPSED) > before, what="the cell's link lapses")
    finally:
        os.kill(server.process.pid, signal.SIGCONT)
    return server


def killed(servers: Servers, server: ServerProcess) -> ServerProcess:
    server.kill()
    policies = server.data.parent / "policies"
    return servers.start(server.data, "--pace", PACE, "--policies", str(policies), wait_cells=False)


@pytest.mark.parametrize("lose", [frozen, killed])
@pytest.mark.parametrize(("decision", "outcome"), [("approve", "succeeded"), ("deny", "rolled_back")])
def test_a_phase_waits_on_its_own_terms_over_a_lost_link(
    servers: Servers,
    tmp_path: Path,
    lose: Callable[[Servers, ServerProcess], ServerProcess],
    decision: str,
    outcome: str,
) -> None:
    server = confirming(servers, tmp_path, on_deny="rollback")
    session, question = held(server)
    server = lose(servers, server)

    def asked() -> dict[str, Any]:
        return server.get(f"/v1/escalations/{question['id']}")

    until(lambda: "link" in [reason["code"] for reason in asked()["reasons"]], what="the cell says why it holds")
    assert {name: asked()[name] for name in KEPT} == {name: question[name] for name in KEPT}
    assert asked()["reasons"][: len(question["reasons"])] == question["reasons"]
    shown = server.get(f"/v1/invocations/{session}")["escalation"]
    assert (shown["id"], shown["expires_at"]) == (question["id"], question["expires_at"])
    until(lambda: server.cell()["online"], what="the cell is back")
    resolve(server, question, decision)
    assert server.await_status(session, "completed", "failed")["outcome"] == outcome
