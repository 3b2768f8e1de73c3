"""`reins demo`: the paper's Algorithm 1 on a server of its own, told as it happens, and examined in the record."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import httpx
import orjson

from app.agent.approver import ScriptedApprover, load_habits, parse_habits
from app.agent.client import AsyncReinsClient, ReinsError, Unsendable
from app.agent.story import fetch
from app.clock import monotonic_s, rfc3339, wall_s
from app.config import DEFAULT_PROFILE, DataDir
from app.terminal import FINDING, FINE, MISUSE, err, out, say, say_error, stop_signals

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from app.agent.approver import Answer, Habits
    from app.agent.client import Document
    from app.agent.story import Fetched, Line

START_S: Final = 60.0
END_S: Final = 8.0
LOOK_S: Final = 0.1
SAID_LINES: Final = 4
SCENARIO: Final = "fetch_shared"
STYLES: Final[Mapping[str, str]] = {
    "agent": "cyan", "policy": "yellow", "human": "magenta", "warn": "bold yellow", "act": "white", "good": "green",
}  # fmt: skip
HABITS: Final[Mapping[str, Any]] = {
    "approver": "operator",
    "reads_s": {"min": 0.5, "max": 1.0},
    "seed": 7,
    "rules": [{"match": {}, "decision": "approve"}],
}


class ServerFailed(Exception):
    """The demo's server ended, or was not ready in time.

    Attributes:
        misused: it was started with something that cannot be.
    """

    def __init__(self, what: str, *, misused: bool = False) -> None:
        """Say what went wrong with it."""
        self.misused = misused
        super().__init__(what)


def demo(folder: Path, *, scripted: bool, keep: bool, pace: float, port: int) -> int:
    """Run the demo in a new directory under `folder`; return 0 only if the record shows every step.

    `keep` leaves its server running until somebody ends it, also where the story fell short: there is more to look at.
    """
    code = FINDING
    data = DataDir(root=(folder / rfc3339(wall_s()).replace(":", "-")).resolve())
    data.create()
    habits = parse_habits(dict(HABITS)) if scripted else None
    for number in stop_signals():
        signal.signal(number, signal.default_int_handler)  # told to end, it takes its server along
    try:
        with _server(data, pace=pace, port=port) as (process, url):
            code = _play(data, url, habits)
            if keep:
                tokens = orjson.loads(data.tokens.read_bytes())
                say(f"\nthe server keeps running at {url}; Ctrl-C ends it")
                say(f"  console     {_console(url, tokens)}\ntokens")
                for name, token in tokens.items():
                    say(f"  {name:<11} {token}")
                process.wait()
    except KeyboardInterrupt:
        return code
    except (ServerFailed, ReinsError) as error:  # also one that ends while the story is told
        say_error(str(error), hint=f"the server's own words: {_said(data.root / 'server.log')}")
        return MISUSE if isinstance(error, ServerFailed) and error.misused else FINDING
    return code


def approve(habits_file: Path, url: str | None, data: Path, token: str | None = None) -> int:
    """Answer escalations by habit until interrupted; return the exit code.

    Without `url` the server is asked that runs on the data directory; without `token` the one in its `tokens.json`.
    """
    layout = DataDir(root=data)
    try:
        habits = load_habits(habits_file)
        known = token or _token_of(habits.name, layout.tokens)
        client = AsyncReinsClient(url or str(_read(layout.server).get("url")), known)
    except (OSError, ValueError, Unsendable) as error:
        say_error(f"no approver: {error}")
        return MISUSE
    try:
        asyncio.run(_approve(client, habits))
    except KeyboardInterrupt:
        return FINE
    except ReinsError as error:
        say_error(f"the approver leaves: {error}")
        return FINDING
    return FINE


def _read(file: Path) -> dict[str, Any]:
    """Return what a file of a data directory holds. Raises `ValueError` naming one that is gone or none."""
    try:
        document: object = orjson.loads(file.read_bytes())
    except FileNotFoundError as error:
        valid = "the data directory of a server that runs, or --server and --token"
        raise ValueError(f"there is no `{file}`; valid: {valid}") from error
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise ValueError(f"`{file}` cannot be read: {why}; valid is the file as a server wrote it") from error
    except orjson.JSONDecodeError as error:
        raise ValueError(f"`{file}` cannot be read: {error}; valid is the file as a server wrote it") from error
    return cast("dict[str, Any]", document) if isinstance(document, dict) else {}


def _token_of(name: str, tokens: Path) -> str:
    """Return who it is to the server. Raises `ValueError` naming who is known."""
    known = _read(tokens)
    if name not in known:
        raise ValueError(
            f"`{name}` has no token in `{tokens}`; valid as `approver`: an operator among {', '.join(known) or 'none'}"
        )
    return known[name]


async def _approve(client: AsyncReinsClient, habits: Habits) -> None:
    async with client:
        approver = ScriptedApprover(
            client,
            habits,
            on_answer=lambda asked, answer: say(answered(asked, answer)),
            on_skip=lambda asked, why: say_error(skipped(asked, why)),
        )
        await approver.run()


def answered(asked: Document, answer: Answer) -> str:
    """Say what was asked, what the approver said, and what the question is since: an approval may leave it pending."""
    return f"{asked['capability']} {asked['id']}: {answer.decision}, now {answer.status}"


def skipped(asked: Document, why: ReinsError) -> str:
    """Say what was asked, and why the approver leaves it to somebody else."""
    return f"{asked['capability']} {asked['id']}: left to somebody else, the answer was not taken: {why}"


def _play(data: DataDir, url: str, habits: Habits | None) -> int:
    tokens = orjson.loads(data.tokens.read_bytes())
    say(f"server  {url}")
    say(f"console {_console(url, tokens)}")
    if habits is None:
        say(f"tokens  {data.tokens}\nwaiting for a human to approve; by hand: POST {url}/v1/escalations/ID/resolve")
    say("")
    found = asyncio.run(fetch(url, tokens, data.root / "agent.json", habits=habits, on_line=_tell))
    return _conclude(data, found)


def _console(url: str, tokens: dict[str, str]) -> str:
    """Return the link that opens the operator's console."""
    return f"{url}/#token={tokens['operator']}"


def _conclude(data: DataDir, found: Fetched) -> int:
    say("\nAlgorithm 1, step by step, as the record shows it:")
    for step in found.steps:
        mark = "[green]✓[/]" if step.seq is not None else "[bold red]✗[/]"
        out.print(f"  {mark} {step.words}" + ("" if step.seq is None else f" [dim](event {step.seq})[/]"))
    say(f"\nthe trace lies in {data.root}; look at it with")
    for invocation in found.invocations[-1:]:
        say(f"  {_command()} audit show {invocation} --data {data.root}")
    say(f"  {_command()} audit verify --data {data.root}")
    say(f"  {data.root / 'telemetry'}/*.mcap open in Foxglove")
    if found.failure:
        say_error(found.failure)
    return FINE if found.complete else FINDING


def _command() -> str:
    """Return what to type for `reins` here: an environment that is not activated has it on no path."""
    beside = Path(sys.executable).with_name("reins")
    if shutil.which("reins") or not beside.exists():
        return "reins"
    return str(beside.relative_to(Path.cwd())) if beside.is_relative_to(Path.cwd()) else str(beside)


def _tell(line: Line) -> None:
    style = STYLES.get(line.mood, "white")
    out.print(f"{line.who:>12}  ", style="dim", end="", markup=False)
    out.print(line.words, style=style, markup=False)


@contextmanager
def _server(data: DataDir, *, pace: float, port: int) -> Generator[tuple[subprocess.Popen[bytes], str]]:
    """Start a server with one cell, wait until it is ready, and end it afterwards."""
    words = ["serve", "--port", str(port), "--data", str(data.root), "--profile", DEFAULT_PROFILE]
    words += ["--pace", str(pace), "--scenario", SCENARIO]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("REINS_")}
    with (data.root / "server.log").open("wb") as log:
        process = subprocess.Popen(  # noqa: S603  # this program itself
            [sys.executable, "-m", "app.cli", *words],
            stdout=log,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
        )
    try:
        with err.status("starting a server and a simulated cell …"):
            url = _await_ready(process, data)
        yield process, url
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _await_ready(process: subprocess.Popen[bytes], data: DataDir) -> str:
    end_s = monotonic_s() + START_S
    while monotonic_s() < end_s:
        try:
            code = process.wait(LOOK_S)
        except subprocess.TimeoutExpired:
            if data.server.exists():
                url = str(orjson.loads(data.server.read_bytes())["url"])
                if _ready(url):
                    return url
        else:
            raise ServerFailed(f"the server ended with `{code}`", misused=code == MISUSE)
    raise ServerFailed(f"the server was not ready within {START_S:.0f} s")


def _said(log: Path) -> str:
    """Return the last lines of a log, for who would have to open it."""
    last = log.read_text(errors="replace").strip().splitlines()[-SAID_LINES:]
    return "\n".join([*last, f"(all of it: {log})"])


def _ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", trust_env=False).is_success
    except httpx.TransportError:
        return False
