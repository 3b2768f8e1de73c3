"""The demo as a newcomer runs it: a server, a cell, an agent and an approver of its own, and the record examined."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
from mcap.reader import make_reader

from tests.conftest import PACE, PATIENCE_S, until

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]

ROOT = Path(__file__).parents[1]


def scenes(path: Path) -> list[dict[str, Any]]:
    with path.open("rb") as file:
        return [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics=["/scene"])]


def test_the_demo_shows_every_step_of_algorithm_1(tmp_path: Path):
    command = [sys.executable, "-m", "app.cli", "demo", "--pace", PACE, "--folder", str(tmp_path / "demo")]
    ended = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=170, env={**os.environ, "COLUMNS": "160"}
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert ended.stdout.count("✓") == 13
    (run,) = (tmp_path / "demo").iterdir()
    verified = subprocess.run(
        [sys.executable, "-m", "app.cli", "audit", "verify", "--data", str(run)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert verified.returncode == 0, verified.stdout + verified.stderr
    files = list((run / "telemetry").glob("*.mcap"))
    assert len(files) == 5
    seen = [moment for file in files for moment in scenes(file)]
    assert any(moment["people"] for moment in seen), "the person who walks in"
    assert len({moment["bodies"]["mug_1"][2] for moment in seen if "mug_1" in moment["bodies"]}) > 5, "it is lifted"


def test_a_demo_that_fell_short_keeps_the_server_that_it_was_told_to_keep(tmp_path: Path):
    """A human who is asked in its console denies the first thing, and looks at what came of it."""
    command = [sys.executable, "-m", "app.cli", "demo", "--approver", "console", "--keep", "--pace", PACE]
    demo = subprocess.Popen([*command, "--folder", str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert demo.stdout is not None
    line = next(line for line in demo.stdout if line.startswith("console"))
    url, token = line.split()[-1].split("/#token=")
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=PATIENCE_S) as operator:
        question = until(lambda: operator.get("/v1/escalations").json()["items"])[0]
        denial = {"decision": "deny", "code": "other", "digest": question["digest"]}
        assert operator.post(f"/v1/escalations/{question['id']}/resolve", json=denial).is_success
        assert any("keeps running" in line for line in demo.stdout)
        assert demo.stdout.readline().split() == line.split(), "the link, where people look for it after the story"
        assert operator.get("/readyz").is_success
        demo.send_signal(signal.SIGINT)
        assert demo.wait(30) == 1, "the story fell short"
        demo.stdout.close()
        with pytest.raises(httpx.TransportError):
            operator.get("/healthz")


def test_a_demo_that_is_told_to_end_or_whose_terminal_goes_takes_its_server_along(tmp_path: Path):
    numbers = (signal.SIGTERM, signal.SIGHUP)
    command = [sys.executable, "-m", "app.cli", "demo", "--pace", "1", "--folder"]
    demos = [  # which begin together
        subprocess.Popen([*command, str(tmp_path / number.name)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        for number in numbers
    ]
    for demo, number in zip(demos, numbers, strict=True):
        assert demo.stdout is not None
        url = next(line for line in demo.stdout if line.startswith("server")).split()[-1]
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE_S).status_code == 200
        demo.send_signal(number)
        assert demo.wait(30) > 0
        demo.stdout.close()
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{url}/healthz")


def test_a_demo_whose_address_is_taken_says_so_itself(tmp_path: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        command = [sys.executable, "-m", "app.cli", "demo", "--port", port, "--folder", str(tmp_path)]
        ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=170)
    assert ended.returncode == 2
    assert "valid: a free address" in " ".join(ended.stderr.split())
