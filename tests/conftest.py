"""Real servers for tests: started as a user starts them, on a free port, with a data directory of their own."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import httpx
import hypothesis
import pytest

from app.audit.examination import examine_file
from app.children import running_cell
from app.clock import monotonic_s

# How long an example takes is the machine's matter, and a first one also makes what all others share.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

START_S = 120.0
END_S = 30.0
PATIENCE_S = 120.0  # for what gives way to everything else on a busy machine; only a failure takes as long
STEP_S, STEPS_S = 0.02, 0.1  # between two looks, at first and in the end: what takes long is looked at less often
PACE = "10"
"""Simulated seconds per second: a cell that computes all the time (0) misses its link's lease on a busy machine."""
# Servers under test speak no TLS. A client that is not given this reads every certificate there is, and a test that
# looks fifty times a second would do little else.
NO_TLS = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
BEFORE_OTHERS = -10  # how nice servers and cells under test are
LAPSED = b"link down: nothing heard for"
INTRODUCED = b"\n  console  http"  # the last line of what a server says of itself, which it begins once it answers


# A shell that starts a run in the background has it ignore Ctrl-C, and so would all that is started here.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

LAPSES: pytest.StashKey[int] = pytest.StashKey()


class LinkLapsed(AssertionError):
    """A test failed while a cell's link lapsed: the machine was too busy for a lease of 300 ms. It runs once more."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Where `REINS_TESTS_AGAIN` is set, run what fails in real time once more; how it failed first is told whole.

    A link that lapses says that nobody ran for 300 ms: what fails of that alone runs up to three times more.
    """
    if os.environ.get("REINS_TESTS_AGAIN"):
        for item in items:
            # What awaits something, awaits a clock: much of the server counts tenths of seconds.
            if any(item.get_closest_marker(name) for name in ("process", "browser", "anyio")):
                item.add_marker(pytest.mark.flaky(reruns=3, only_rerun=".*", condition=partial(run_again, item)))


def run_again(item: Any, error: BaseException | None) -> bool:
    """Say whether a test that failed of this runs once more."""
    return isinstance(error, LinkLapsed) or item.execution_count == 1


def pytest_collection_finish() -> None:
    """Leave what was imported out of collections of garbage, and have fewer: they took a tenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 100)
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, object, object]:
    """Count from here on: a server may be the test's own, and what it was brought to be what the test is about."""
    item.stash[LAPSES] = Servers.lapses()
    return (yield from telling_lapses(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from telling_lapses(item))


def telling_lapses(item: pytest.Item) -> Generator[None, object, object]:
    """Tell a test whose cell held by design, because nobody was heard in time, from one that found something."""
    try:
        return (yield)
    except (Exception, pytest.fail.Exception) as error:
        before = item.stash[LAPSES]
        if Servers.lapses() > before:
            raise LinkLapsed(f"links lapsed {Servers.lapses() - before} times meanwhile") from error
        raise


def until(condition: Callable[[], Any], within_s: float = PATIENCE_S, what: str = "") -> Any:
    """Return the condition's first true value; fail with `what` when the deadline passes."""
    deadline = monotonic_s() + within_s
    step_s = STEP_S
    while True:
        value = condition()
        if value:
            return value
        if monotonic_s() > deadline:
            pytest.fail(f"not within {within_s} s: {what or condition}")
        time.sleep(step_s)
        step_s = min(STEPS_S, 1.2 * step_s)


def put_first(pid: int, nice: int) -> None:
    """Give a process that began a session its turns before others, where the system permits: as on a robot's computer.

    A cell's lease is 300 ms of real time, whoever else computes. Linux weighs processes within their session alone, and
    the sessions against each other (sched(7), autogroup): so both are said.
    """
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, pid, nice)
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(nice), encoding="ascii")


@dataclass
class ServerProcess:
    """A server process under test, with its cells."""

    data: Path
    process: subprocess.Popen[bytes]
    log: Path
    url: str = ""
    tokens: dict[str, str] = field(default_factory=dict)

    def client(self, key: str = "operator") -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.tokens[key]}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=70.0, trust_env=False, verify=NO_TLS)

    def get(self, path: str, key: str = "operator") -> Any:
        with self.client(key) as client:
            answer = client.get(path)
        assert answer.is_success, f"{path}: {answer.status_code} {answer.text}"
        return answer.json()

    def post(self, path: str, body: Any = None, key: str = "operator") -> httpx.Response:
        with self.client(key) as client:
            return client.post(path, json={} if body is None else body)

    def propose(self, capability: str, **params: Any) -> dict[str, Any]:
        answer = self.post("/v1/invocations", {"capability": capability, "params": params}, key="agent")
        assert answer.status_code == 201, answer.text
        return answer.json()

    def facts(self) -> dict[str, Any]:
        """Return what the cell says of the world; on a busy machine it may have been silent for a moment."""
        return until(lambda: self.cell()["facts"], what="a cell that is heard")

    def launch(
        self, capability: str, cell: str = "workcell-1", *, metadata: dict[str, Any] | None = None, **params: Any
    ) -> dict[str, Any]:
        """Propose, and again where it is deferred, as an agent does: on a busy machine links may lapse a moment."""

        def made() -> dict[str, Any] | None:
            body = {"capability": capability, "params": params, "cell": cell, "metadata": metadata or {}}
            answer = self.post("/v1/invocations", body, key="agent").json()
            return None if answer["status"] == "deferred" else answer

        return until(made, what=f"`{capability}` is decided")

    def await_status(self, invocation: str, *statuses: str, within_s: float = 60.0) -> dict[str, Any]:
        """Follow an invocation by long poll until its status is one of those, or it is final."""
        deadline = monotonic_s() + within_s
        final = {"rejected", "deferred", "denied", "completed", "failed"}
        document = self.get(f"/v1/invocations/{invocation}")  # what is so already is no change to wait for
        while document["status"] not in statuses:
            if document["status"] in final or monotonic_s() > deadline:
                pytest.fail(f"`{invocation}` is {document['status']}, not {statuses}: {document}\n{self.tail()}")
            document = self.get(f"/v1/invocations/{invocation}?wait=1")
        return document

    def cell(self, name: str = "workcell-1") -> dict[str, Any]:
        return next(cell for cell in self.get("/v1/cells")["items"] if cell["id"] == name)

    def cell_pid(self, name: str = "workcell-1") -> int | None:
        return running_cell(self.data / "cells" / name)

    def is_free(self) -> bool:
        """Say whether another test can have it: it is well, and its cell idle, unlatched and in nobody's hand."""
        if self.process.poll() is not None:
            return False
        with self.client() as client:
            if not client.get("/readyz").is_success:
                return False
        cell = self.cell()
        return cell["online"] and not (cell["latched"] or cell["busy"] or cell["control"])

    def kill(self) -> None:
        """End the server at once, as a power cut would; its cells live on."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(END_S)

    def stop(self) -> int:
        """Ask the server to stop; return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(END_S)

    def tail(self) -> str:
        return self.log.read_text()[-4000:]


@dataclass
class Servers:
    """Starts servers and ends every process that came of them."""

    folder: Path
    started: list[ServerProcess] = field(default_factory=list)
    logs: ClassVar[set[Path]] = set()

    @classmethod
    def lapses(cls) -> int:
        """Return how often a cell of any server so far heard nothing for the length of its lease."""
        return sum(log.read_bytes().count(LAPSED) for log in cls.logs)

    def start(self, data: Path | None = None, *flags: str, cells: int = 1, wait_cells: bool = True) -> ServerProcess:
        return self.await_up(self.begin(data, *flags, cells=cells), "/readyz" if wait_cells and cells else "/healthz")

    def newest(self, *flags: str) -> ServerProcess:
        """Hand on the newest server, if it is well and its cell has nothing to do; start another where not."""
        if self.started and self.started[-1].is_free():
            return self.started[-1]
        return self.start(None, *flags)

    def begin(self, data: Path | None = None, *flags: str, cells: int = 1) -> ServerProcess:
        """Start a server, and do not wait for it."""
        data = data or self.folder / f"data-{len(self.started)}"
        log = self.folder / f"server-{len(self.started)}.log"
        (data / "server.json").unlink(missing_ok=True)
        words = ["serve", "--port", "0", "--data", str(data), "--cells", str(cells), "--no-prove"]
        words += flags or ("--pace", PACE)
        with log.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, "-m", "app.cli", *words],
                stdout=out,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env={name: value for name, value in os.environ.items() if not name.startswith("REINS_")},
                start_new_session=True,
            )
        put_first(process.pid, BEFORE_OTHERS)
        server = ServerProcess(data, process, log)
        self.started.append(server)
        self.logs.add(log)
        return server

    def await_up(self, server: ServerProcess, path: str) -> ServerProcess:
        until(lambda: self._answers(server, path), START_S, f"the server answers at {path}; see {server.log}")
        until(lambda: INTRODUCED in server.log.read_bytes(), START_S, f"it says who it is; see {server.log}")
        for folder in (server.data / "cells").glob("*"):
            if pid := running_cell(folder):
                put_first(pid, BEFORE_OTHERS)
        return server

    def _answers(self, server: ServerProcess, path: str) -> bool:
        if server.process.poll() is not None:
            pytest.fail(f"the server ended with {server.process.returncode}\n{server.tail()}")
        if not server.url:
            with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
                server.url = json.loads((server.data / "server.json").read_text())["url"]
                server.tokens = json.loads((server.data / "tokens.json").read_text())
            return False
        try:
            return httpx.get(f"{server.url}{path}", trust_env=False, verify=NO_TLS).is_success
        except httpx.TransportError:
            return False

    def end(self) -> None:
        for server in self.started:
            if server.process.poll() is None:
                server.process.send_signal(signal.SIGTERM)
        for server in self.started:
            try:
                server.process.wait(END_S)
            except subprocess.TimeoutExpired:
                server.process.kill()
                server.process.wait(END_S)
            for folder in (server.data / "cells").glob("*"):
                if (pid := running_cell(folder)) is not None:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)

    def examine(self) -> None:
        """Have everything that was left behind compared with the log: whatever was tested, they say the same."""
        for data in {server.data for server in self.started}:
            found = examine_file(data)
            assert found.ok, found


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[Servers]:
    """Start servers at will; all of them, and their cells, end with this, and what they left behind is examined."""
    made = Servers(folder)
    try:
        yield made
    finally:
        made.end()
    made.examine()


@pytest.fixture
def servers(tmp_path: Path) -> Iterator[Servers]:
    """Start servers that end with the test."""
    with serving(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Servers]:
    """Start servers that end with the module: its tests hand them on."""
    with serving(tmp_path_factory.mktemp("kept")) as made:
        yield made


def put_in_profile(server: ServerProcess, profile: str, cell: str = "workcell-1") -> None:
    with server.client() as client:
        assert client.put(f"/v1/cells/{cell}/profile", json={"profile": profile}).is_success
    until(lambda: server.cell(cell)["profile"] == profile, what="the cell is in that profile")


class Ahead:
    """The servers of modules: the next module's starts while the last of this one's tests runs.

    No earlier, for a cell is never idle: two of them take as much of the processor as two consoles.
    """

    def __init__(self, request: pytest.FixtureRequest, begin: Callable[[], Servers]) -> None:
        items = [item for item in request.session.items if isinstance(item, pytest.Function)]
        self._last = {item.module: item for item in items if request.fixturename in item.fixturenames}
        self._to_come = len(self._last)
        self._begin = begin
        self._next: Servers | None = None
        self._plugins = request.config.pluginmanager
        self._plugins.register(self)

    @pytest.hookimpl
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        if item in self._last.values() and self._to_come > 0:
            self._next = self._next or self._begin()

    @contextlib.contextmanager
    def take(self) -> Iterator[ServerProcess]:
        """Have a server for one module; when it has ended, what it left behind is compared with its log."""
        taken = self._next or self._begin()
        self._to_come -= 1
        self._next = None
        try:
            yield taken.await_up(taken.started[0], "/readyz")
        finally:
            taken.end()
        taken.examine()

    def end(self) -> None:
        self._plugins.unregister(self)
        if self._next is not None:
            self._next.end()


@pytest.fixture(scope="session")
def ahead(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ahead]:
    def begin() -> Servers:
        made = Servers(tmp_path_factory.mktemp("server"))
        made.begin()
        return made

    made = Ahead(request, begin)
    yield made
    made.end()


@pytest.fixture(scope="module")
def server(ahead: Ahead) -> Iterator[ServerProcess]:
    """One server with one cell, shared by a module's tests."""
    with ahead.take() as server:
        yield server
