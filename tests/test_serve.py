"""Starting and ending a server."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import chain
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from app.cli import main
from app.terminal import stop_signals
from tests.conftest import ServerProcess, Servers, until
from tests.test_cli import run

pytestmark = [pytest.mark.process, pytest.mark.timeout(120)]
POLICIES = Path(__file__).parents[1] / "policies"


def reins(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "app.cli", *words], capture_output=True, text=True, timeout=170)


def test_says_how_to_come_in_and_keeps_secrets_to_its_owner(server: ServerProcess) -> None:
    said = server.log.read_text()
    assert f"serves {server.url}" in said
    assert f"{server.url}/#token={server.tokens['operator']}" in said
    assert set(server.tokens) == {"agent", "operator", "operator_2", "engineer", "auditor"}
    for name in ("tokens.json", "kernel.key", "cell.token", "server.json"):
        assert (server.data / name).stat().st_mode & 0o077 == 0


def test_a_start_says_that_nobody_proved_its_directory_here(server: ServerProcess) -> None:
    assert "not proved here: `reins policy propose`" in server.log.read_text()


def test_a_start_with_a_policy_that_does_not_pass_its_proofs_serves_and_says_so(
    servers: Servers, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(POLICIES, tmp_path / "policies"))
    dead = "  - {id: huge, applies_to: [grasp_object], when: target.mass_kg > 50.0, then: deny, because: So.}\n"
    rules = folder / "organization.yaml"
    rules.write_text(rules.read_text().replace("\nrules:\n", f"\nrules:\n{dead}", 1))
    server = servers.start(None, "--prove", "--policies", str(folder), cells=0)
    assert "it is proved in the background" in server.log.read_text()
    until(lambda: server.get("/v1/policies", "engineer")["verdict"] == "refuted", 90, "the verdict")
    health = server.get("/healthz")
    assert (health["status"], health["broken"].keys()) == ("degraded", {"policy"})
    with server.client() as client:
        assert "policy" not in client.get("/readyz").json()["broken"]
    (said,) = server.get("/v1/audit/events?kind=policy_version", "auditor")["items"]
    assert (said["body"]["op"], said["actor"], said["body"]["of"]) == ("refuted", "server", 1)
    assert "a dead rule: `organization/huge` never holds" in said["body"]["problems"][0]
    until(lambda: "a dead rule: `organization/huge`" in server.log.read_text(), what="the start's own words")
    assert "the policy in force is refuted" in server.log.read_text()
    assert server.stop() == 0


def test_the_cells_token_is_in_no_command_line(server: ServerProcess) -> None:
    token = (server.data / "cell.token").read_text().strip()
    pid = server.cell_pid()
    assert token not in Path(f"/proc/{pid}/cmdline").read_text()


def examines(server: int) -> bool:
    """Say whether a server has a process that examines a policy."""
    with suppress(FileNotFoundError, ProcessLookupError):  # a thread or a process that ends just now
        children = (path.read_text().split() for path in Path(f"/proc/{server}/task").glob("*/children"))
        return any("app.assay" in Path(f"/proc/{child}/cmdline").read_text() for child in chain.from_iterable(children))
    return False


@pytest.fixture
def terminal() -> Iterator[None]:
    """Be started from a terminal, whatever the tests were: what ignores SIGHUP passes that on to what it starts."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("terminal")
def test_a_server_and_its_cell_stop_in_order_when_their_terminal_is_closed_or_when_told_to(servers: Servers) -> None:
    server = servers.start(cells=1)
    with server.client() as client:
        assert client.put("/v1/cells/workcell-1/profile", json={"profile": "test-audit"}).is_success
    cell = server.cell_pid()
    server.process.send_signal(signal.SIGHUP)
    assert server.process.wait(20.0) == 0
    assert not Path(f"/proc/{cell}").exists()
    assert not (server.data / "server.json").exists()

    again = servers.start(server.data, "--profile", "human-shared", cells=1)
    assert again.cell()["profile"] == "test-audit"
    assert "not for workcell-1: it stays in test-audit" in again.log.read_text()
    files = {str(path.relative_to(POLICIES)): path.read_text() for path in POLICIES.rglob("*.yaml")}
    with (
        ThreadPoolExecutor() as pool,
        again.client("auditor") as auditor,
        auditor.stream("GET", "/v1/events?after=0") as answer,
    ):
        lines = answer.iter_lines()
        assert next(lines).startswith("retry")
        bringing = pool.submit(again.post, "/v1/policies", {"files": files, "why": "as it is"}, "engineer")
        until(lambda: examines(again.process.pid), what="the policy is being examined")
        again.process.terminate()
        for _ in lines:
            pass  # to its end: an answer that is cut raises
        brought = bringing.result()
        assert (brought.status_code, brought.json()["code"]) == (503, "examination_failed")
    assert again.stop() == 0
    assert "ERROR" not in again.tail()
    assert again.cell_pid() is None


def test_what_is_to_outlive_its_terminal_does(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {signal.SIGINT, signal.SIGTERM}
    for handler, stops in ((signal.SIG_DFL, {*asked, signal.SIGHUP}), (signal.SIG_IGN, asked)):  # the second: `nohup`
        monkeypatch.setattr(signal, "getsignal", lambda _, handler=handler: handler)
        assert set(stop_signals()) == stops


@pytest.mark.parametrize(("token", "status"), [(None, 401), ("nonsense", 401), ("agent", 403)])
def test_a_link_that_is_refused_is_answered_and_makes_no_noise(
    server: ServerProcess, token: str | None, status: int
) -> None:
    before = server.log.read_text()
    headers = {} if token is None else {"Authorization": f"Bearer {server.tokens.get(token, token)}"}
    url = server.url.replace("http", "ws", 1) + "/v1/cells/workcell-1/link"
    with pytest.raises(InvalidStatus) as refused, connect(url, additional_headers=headers, proxy=None):
        pass
    assert refused.value.response.status_code == status
    assert json.loads(refused.value.response.body or b"")["status"] == status
    assert httpx.get(f"{server.url}/healthz", trust_env=False).is_success  # whatever was to be printed is by now
    assert "ERROR" not in server.log.read_text().removeprefix(before)


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01\r\n\r\n",
        b"GET /healthz HTTP/1.1\r\nHost: here\r\nConnection: Upgrade\r\nUpgrade: h2c\r\n\r\n",
    ],
)
def test_what_anybody_may_send_without_a_token_is_answered_and_makes_no_noise(
    server: ServerProcess, sent: bytes
) -> None:
    before = server.log.read_text()
    with socket.create_connection(("127.0.0.1", urlsplit(server.url).port or 0), timeout=10) as peer:
        peer.sendall(sent)
        assert peer.recv(9) == b"HTTP/1.1 "
    assert httpx.get(f"{server.url}/healthz", trust_env=False).is_success  # whatever was to be printed is by now
    assert "WARNING" not in server.log.read_text().removeprefix(before)


def test_a_second_server_on_the_same_data_does_not_start(server: ServerProcess) -> None:
    second = reins("serve", "--port", "0", "--data", str(server.data))
    assert second.returncode == 2
    assert "in use" in second.stderr


def test_a_broken_policy_does_not_start_and_says_where(tmp_path: Path) -> None:
    folder = tmp_path / "policies"
    shutil.copytree(POLICIES, folder)
    profile = folder / "profiles" / "human-shared.yaml"
    lines = profile.read_text().splitlines()
    place = next(number for number, line in enumerate(lines) if line.startswith("sensitivity"))
    lines[place] = "sensitivity: lots"
    profile.write_text("\n".join(lines))
    broken = reins("serve", "--port", "0", "--data", str(tmp_path / "data"), "--policies", str(folder))
    assert broken.returncode == 2
    assert f"profiles/human-shared.yaml:{place + 1}" in broken.stderr
    assert not (tmp_path / "data").exists()
    code, said = run("policy", "check", str(folder))
    assert code == 1
    assert f"profiles/human-shared.yaml:{place + 1}" in said


def test_promises_that_cannot_be_read_do_not_start_and_say_where(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(POLICIES, tmp_path / "policies"))
    (folder / "properties.yaml").write_text("order: []\nproperties: [{id: a, says: So., nevr: [allowed]}]\n")
    code, said = run("serve", "--port", "0", "--data", str(tmp_path / "data"), "--policies", str(folder))
    assert code == 2
    assert "properties.yaml:2: properties[0].nevr: unknown key `nevr`" in said
    assert not (tmp_path / "data").exists()


def test_a_start_that_is_refused_leaves_nothing_behind(
    tmp_path: Path, server: ServerProcess, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    port = server.url.rpartition(":")[2]
    for said, word in (("nowhere", ("--profile", "nowhere")), ("a free address", ("--port", port))):
        words = ["serve", "--port", "0", "--data", str(tmp_path / "data"), *word]
        monkeypatch.setattr(sys, "argv", ["reins", *words])
        with pytest.raises(SystemExit, match="2"):
            main()
        assert said in capsys.readouterr().err
        assert not (tmp_path / "data").exists()


def test_a_start_without_the_key_that_every_cell_knows_is_refused_and_makes_no_other(servers: Servers) -> None:
    server = servers.start(None, cells=0)
    server.stop()
    key = server.data / "kernel.key"
    key.unlink()
    again = reins("serve", "--port", "0", "--cells", "0", "--data", str(server.data))
    assert again.returncode == 2
    assert f"`{key}` restored" in again.stderr.replace("\n", "")
    assert not key.exists()


def test_an_auditor_verifies_beside_the_running_server(server: ServerProcess) -> None:
    code, said = run("audit", "verify", "--data", str(server.data))
    assert code == 0
    assert "as it was signed" in said
