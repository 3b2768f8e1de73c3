"""A phase that policy names waits, holding, for a human: a real server, a real cell, over HTTP."""

from __future__ import annotations

import math
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import PACE, ServerProcess, Servers, put_in_profile, until
from tests.test_contract import pending

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]

A_STAND_M = (1.6, 4.6)
POLICIES = Path(__file__).resolve().parents[1] / "policies"
ENTRY = "{capability: %s, profile: %s, phases: [%s], within_s: %g, on_deny: %s, on_timeout: %s}"
DRIVE, LOOK = "navigate_to", "inspect_area"
PHASES = {DRIVE: "settle", LOOK: "retract"}
SHARED, RESTRICTED = "human-shared", "real-restricted"
TERMS = [
    (DRIVE, SHARED, PHASES[DRIVE], 60.0, "rollback", "terminate"),
    (LOOK, SHARED, PHASES[LOOK], 1.0, "terminate", "terminate"),
    (DRIVE, RESTRICTED, PHASES[DRIVE], 1.0, "terminate", "rollback"),
]


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a policy in which a drive waits for a human before it settles at its target."""
    folder = tmp_path_factory.mktemp("confirming") / "policies"
    shutil.copytree(POLICIES, folder)
    file = folder / "authority.yaml"
    entries = ", ".join(ENTRY % terms for terms in TERMS)
    file.write_text(file.read_text().replace("confirm_before: []", f"confirm_before: [{entries}]"))
    return folder


def confirming(servers: Servers, policies: Path, profile: str = SHARED) -> ServerProcess:
    """Have a server whose cell is idle and in that profile: the one of the test before, if it is well."""
    server = servers.newest("--pace", PACE, "--policies", str(policies))
    put_in_profile(server, profile)
    return server


def stands_at(server: ServerProcess) -> str:
    """Return the bench at which the robot stands."""
    at_a = math.dist(server.facts()["base"][:2], A_STAND_M) < 1.0
    return "bench_a" if at_a else "bench_b"


def proposed(server: ServerProcess, capability: str) -> str:
    """Have a drive to the other bench begun, or a look at this one; return the invocation."""
    bench = stands_at(server)
    other = "bench_b" if bench == "bench_a" else "bench_a"
    params = {"target": f"{other}_stand"} if capability == DRIVE else {"area": f"{bench}_top"}
    return server.launch(capability, **params)["id"]


def held(server: ServerProcess, capability: str = DRIVE) -> tuple[str, dict[str, Any]]:
    invocation = proposed(server, capability)
    server.await_status(invocation, "escalated")
    question = pending(server, invocation)
    assert (question["kind"], question["phase"]) == ("session", PHASES[capability])
    return invocation, question


def resolve(server: ServerProcess, question: dict[str, Any], decision: str) -> None:
    answer = {"decision": decision, "digest": question["digest"]}
    assert server.post(f"/v1/escalations/{question['id']}/resolve", answer).is_success


def test_a_confirmed_phase_goes_on_and_a_denied_one_is_undone(kept: Servers, policies: Path) -> None:
    server = confirming(kept, policies)
    session, question = held(server)
    resolve(server, question, "approve")
    assert server.await_status(session, "completed")["outcome"] == "succeeded"
    began = server.facts()["base"]
    denied = proposed(server, DRIVE)
    server.await_status(denied, "escalated")
    resolve(server, pending(server, denied), "deny")
    again = server.post(f"/v1/invocations/{denied}/rollback")  # 409 where it is over by then
    assert (again.status_code, again.json().get("code")) in {(200, None), (409, "wrong_status")}, again.text
    ended = server.await_status(denied, "completed", "failed")
    assert (ended["outcome"], ended["escalation"]["code"]) == ("rolled_back", "unspecified")
    assert server.facts()["base"] == pytest.approx(began, abs=0.15)


@pytest.mark.parametrize(
    ("capability", "profile", "outcome", "codes"),
    [(LOOK, SHARED, "terminated", ["expired"]), (DRIVE, RESTRICTED, "rolled_back", ["expired", "verified"])],
)
def test_silence_ends_the_session_and_is_nobodys_answer(
    kept: Servers, policies: Path, capability: str, profile: str, outcome: str, codes: list[str]
) -> None:
    server = confirming(kept, policies, profile)
    session = proposed(server, capability)
    ended = server.await_status(
        session, "failed"
    )  # by then the question may have been and gone: it is not looked for before
    (question,) = [item for item in server.get("/v1/escalations")["items"] if item["invocation"] == session]
    assert (question["kind"], question["phase"]) == ("session", PHASES[capability])
    assert (ended["outcome"], [why["code"] for why in ended["failure"]["reasons"]]) == (outcome, codes)
    trace = server.get(f"/v1/invocations/{session}/trace", key="agent")["items"]
    (end,) = [event["body"] for event in trace if event["kind"] == "outcome"]
    assert [code for code in (end["failure"], end["code"]) if code] == codes
    (word,) = [event["body"] for event in trace if event["kind"] == "human"]
    assert (word["actor"], word["expired"]) == ("server", True)
    assert (question["status"], question["approvals"], question["denial"]) == ("expired", [], None)


KEPT = ("phase", "on_deny", "on_timeout", "expires_at", "digest", "status")


def frozen(servers: Servers, server: ServerProcess, _policies: Path) -> ServerProcess:
    """Have a server say nothing until its cell holds for that."""
    before = servers.lapses()  # a cell says so in the log of the server that started it
    os.kill(server.process.pid, signal.SIGSTOP)
    try:
        until(lambda: servers.lapses() > before, what="the cell's link lapses")
    finally:
        os.kill(server.process.pid, signal.SIGCONT)
    return server


def killed(servers: Servers, server: ServerProcess, policies: Path) -> ServerProcess:
    server.kill()
    return servers.start(server.data, "--pace", PACE, "--policies", str(policies), wait_cells=False)


@pytest.mark.parametrize("lose", [frozen, killed])
@pytest.mark.parametrize(("decision", "outcome"), [("approve", "succeeded"), ("deny", "rolled_back")])
def test_a_phase_waits_on_its_own_terms_over_a_lost_link(
    kept: Servers,
    policies: Path,
    lose: Callable[[Servers, ServerProcess, Path], ServerProcess],
    decision: str,
    outcome: str,
) -> None:
    server = confirming(kept, policies)
    session, question = held(server)
    server = lose(kept, server, policies)

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
