"""Policy changed on a running server with a real cell: by the command line, in mid-session, and over a restart."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from app.api.auth import issue_token
from app.cli import app
from app.governance.model import Role
from tests.conftest import ServerProcess, until

pytestmark = [pytest.mark.process, pytest.mark.timeout(240)]
POLICIES = Path(__file__).parents[1] / "policies"
SHARED = "profiles/human-shared.yaml"


def variant(folder: Path, *edits: tuple[str, str], file: str = SHARED) -> Path:
    """Return a copy of the shipped policy with one file edited, without its cases."""
    if not folder.exists():
        shutil.copytree(POLICIES, folder, ignore=shutil.ignore_patterns("tests"))
    path = folder / file
    for before, after in edits:
        assert before in path.read_text()
        path.write_text(path.read_text().replace(before, after, 1))
    return folder


def reins(server: ServerProcess, *words: str, as_: str = "engineer") -> Result:
    """Run `reins policy …` as an engineer would."""
    options = ["--data", str(server.data), "--token", server.tokens[as_]]
    return CliRunner().invoke(app, ["policy", *words, *options], env={"COLUMNS": "200", "TERM": "dumb"})


def proposed(server: ServerProcess, folder: Path) -> str:
    answer = reins(server, "propose", str(folder), "--why", "a try")
    assert answer.exit_code == 0, answer.stderr
    return answer.stdout.split()[0]


def pending(server: ServerProcess, invocation: str) -> Any:
    return until(
        lambda: next(
            (one for one in server.get("/v1/escalations?status=pending")["items"] if one["invocation"] == invocation),
            None,
        ),
        what="the question",
    )


def test_a_session_meets_a_tightening_at_once_and_the_next_one_is_bound_by_it(servers: Any, tmp_path: Path) -> None:
    server = servers.start(None, "--pace", "1")
    slower = variant(tmp_path / "slower", ("base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.2"))
    digest = proposed(server, slower)
    made = server.propose("navigate_to", target="tool_stand", speed_mps=0.3)
    server.await_status(made["id"], "running")
    until(lambda: server.cell()["status"] == "running", what="the cell runs it")
    done = reins(server, "activate", digest, "--why", "a visitor")
    assert (done.exit_code, "in force (tightens)" in done.stdout) == (0, True), done
    held = server.await_status(made["id"], "escalated")
    assert held["policy_version"] != digest
    question = pending(server, made["id"])
    assert "human-shared/base_speed_mps" in {one["rule"] for one in question["reasons"]}
    refused = server.post(
        f"/v1/escalations/{question['id']}/resolve", {"decision": "approve", "digest": question["digest"]}
    )
    assert (refused.status_code, refused.json()["code"]) == (409, "resume_refused")
    assert server.post(
        f"/v1/escalations/{question['id']}/resolve", {"decision": "deny", "digest": question["digest"]}
    ).is_success
    assert server.await_status(made["id"], "failed")["outcome"] == "terminated"
    until(lambda: server.cell()["policy_version"] == digest, what="the cell holds the new version")
    again = server.propose("navigate_to", target="bench_a_stand", speed_mps=0.3)
    assert (again["policy_version"], again["effective"]["speed_mps"]) == (digest, 0.2)
    server.await_status(again["id"], "running", "completed")
    kinds = [event["kind"] for event in server.get(f"/v1/invocations/{made['id']}/trace")["items"]]
    assert kinds.index("intervention") < kinds.index("outcome")


def test_what_two_engineers_chose_is_in_force_after_a_restart_until_one_goes_back(servers: Any, tmp_path: Path) -> None:
    server = servers.start()
    server.tokens["engineer_2"] = issue_token(server.data, name="engineer_2", role=Role.ENGINEER, station=None)
    first = server.get("/v1/policies/active")["version"]
    faster = variant(tmp_path / "faster", ("base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.4"))
    refused = reins(server, "propose", str(faster), "--why", "nobody looked")
    assert (refused.exit_code, "slow-base-among-people" in refused.stderr) == (1, True), refused
    promise = "profile.shared_floor\n    always: params.speed_mps <= {}"
    digest = proposed(server, variant(faster, (promise.format("0.3"), promise.format("0.4")), file="properties.yaml"))
    promises = faster / "properties.yaml"
    promises.write_text(f"{promises.read_text()}# one more line\n")
    known = reins(server, "propose", str(faster), "--why", "what was it again")
    assert (known.exit_code, known.stdout.split()[0]) == (0, digest), known
    assert "known since" in known.stdout
    assert "\nproved of 48 pairs: no contradiction" in known.stdout
    assert "`properties.yaml` is not the one it is kept with" in known.stdout
    assert "another engineer's word" in reins(server, "activate", digest[:20], "--why", "faster").stdout
    until(lambda: server.post("/v1/policies", key="engineer_2").status_code == 422, what="the second token counts")
    assert "in force (loosens)" in reins(server, "activate", digest, "--why", "I agree", as_="engineer_2").stdout
    made = server.propose("navigate_to", target="bench_a_stand", speed_mps=1.0)
    assert (made["policy_version"], made["effective"]["speed_mps"]) == (digest, 0.4)
    assert server.await_status(made["id"], "completed")["outcome"] == "succeeded"
    assert server.stop() == 0

    back = servers.start(server.data)
    assert back.get("/v1/policies/active")["version"] == digest
    assert "an engineer put it in force: I agree" in back.tail()
    assert f"not in force: {first}" in back.tail()
    back.tokens["engineer_2"] = server.tokens["engineer_2"]
    # The limit is tighter again, but the promise is another one: what that gives up is not known, so it takes two.
    assert "another engineer's word" in reins(back, "rollback", "--why", "too fast after all").stdout
    assert "in force (both)" in reins(back, "rollback", "--why", "I agree", as_="engineer_2").stdout
    assert back.get("/v1/policies/active")["version"] == first
    until(lambda: back.cell()["policy_version"] == first, what="the cell follows")
    listed = reins(back, "versions").stdout
    assert (listed.count("in force 2"), listed.count("; proofs: proved\n")) == (3, 1)
