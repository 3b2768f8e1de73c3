"""A server that stood still finds what was said meanwhile in its sockets, some of it by people who have gone since."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import orjson
import pytest

from tests.conftest import ServerProcess
from tests.test_contract import pending

pytestmark = [pytest.mark.process, pytest.mark.timeout(120)]


@contextmanager
def standing_still(server: ServerProcess) -> Generator[None]:
    os.kill(server.process.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(server.process.pid, signal.SIGCONT)


def answering(server: ServerProcess, key: str, question: dict[str, Any], decision: str) -> socket.socket:
    address, body = urlsplit(server.url), orjson.dumps({"decision": decision, "digest": question["digest"]})
    sender = socket.create_connection((address.hostname or "", address.port or 0))
    head = f"POST /v1/escalations/{question['id']}/resolve HTTP/1.1\r\nHost: x\r\n"
    bearer = f"Authorization: Bearer {server.tokens[key]}\r\nContent-Length: {len(body)}\r\n"
    sender.sendall(f"{head}{bearer}Connection: close\r\n\r\n".encode() + body)
    return sender


def test_an_approval_that_was_given_up_while_the_server_stood_still_is_none(server: ServerProcess) -> None:
    for _ in range(5):
        question = pending(server, server.launch("grasp_object", object_id="mug_1")["id"])
        with standing_still(server):
            answering(server, "operator", question, "approve").close()
            denied = answering(server, "operator", question, "deny")
        with denied, denied.makefile("rb") as answer:
            assert answer.read().startswith(b"HTTP/1.1 200 ")
        ended = server.get(f"/v1/invocations/{question['invocation']}")
        assert (ended["status"], ended["outcome"]) == ("denied", "denied")
        trace = server.get(f"/v1/invocations/{question['invocation']}/trace")["items"]
        assert [event["body"]["decision"] for event in trace if event["kind"] == "approval"] == ["deny"]
