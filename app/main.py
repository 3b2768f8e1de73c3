"""The server's wiring: settings in, rooms put together, one process that serves until it is told to stop.

Order at start: the policy (a broken one starts nothing), the address, the record, the runtime, the door, the cells.
Order at the end: the cells come to rest and hand up what they hold, the door closes, the runtime, the record.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import socket
import sys
from typing import TYPE_CHECKING, Any, Final, cast

import orjson
import uvicorn
import uvloop
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app import __version__
from app.api.application import create_app
from app.api.auth import CELL_TOKEN_FILE, PrincipalsUnreadable, open_principals
from app.api.exchange import Exchanges
from app.api.sockets import Sockets
from app.assayer import Assayer
from app.audit.errors import AuditError
from app.audit.store import AuditStore
from app.children import Children
from app.config import ConfigError, find_policies
from app.disk import write_private
from app.governance.bundle import load, read_properties
from app.governance.errors import PolicyErrors
from app.governance.stated import read as read_promises
from app.runtime.assembly import Runtime
from app.runtime.errors import ExaminationFailed
from app.runtime.version import PROVED, UNKNOWN, UNREADABLE
from app.terminal import FINE, MISUSE, complain, counting, err, remark, say, say_error, stop_signals

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Generator
    from pathlib import Path

    from app.api.auth import Principals
    from app.config import Settings
    from app.governance.policy import PolicySet
    from app.runtime.fleet import Fleet
    from app.runtime.proving import Proving
    from app.runtime.versions import Versions

KEY_BYTES: Final = 32
PROVE_AFTER_S: Final = 5.0  # by then the cells are up: a start leaves the processor to them
LEAVE_S: Final = 1  # for requests under way when the server stops
HAND_OVER_S: Final = 0.0001  # after so long a thread that waits for the interpreter gets it


class DoorServer(uvicorn.Server):
    """Uvicorn that says when it listens and takes no signals: the cells stop before the door closes."""

    def __init__(self, config: uvicorn.Config) -> None:
        """Start closed."""
        super().__init__(config)
        self.up = asyncio.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and say so."""
        await super().startup(sockets)
        self.up.set()

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None]:
        """Take no signals."""
        yield


def serve(settings: Settings) -> int:
    """Run a server until it is told to stop; return the exit code.

    Raises:
        ConfigError: a setting cannot be used.
    """
    policies = load_policies(find_policies(settings.policies))
    if policies is None:
        return MISUSE
    if settings.profile not in policies.profiles:
        raise ConfigError("profile", settings.profile, ", ".join(sorted(policies.profiles)))
    check_world(settings)
    with contextlib.closing(listen(settings.host, settings.port)) as listener:
        settings.layout.create()  # not before: a start that is refused leaves nothing behind
        try:
            with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
                return runner.run(_serve(settings, policies, listener))
        except UNREADABLE as error:
            hint = "`--take-policies` puts the directory's version in force instead"
            say_error(f"the version that an engineer put in force cannot be enforced: {error}", hint=hint)
            return MISUSE
        except (AuditError, PrincipalsUnreadable, OSError) as error:
            say_error(f"the server cannot run: {error}")
            return MISUSE


def check_world(settings: Settings) -> None:
    """Refuse a scenario or a robot that no cell could be started with, whether cells are started here or not.

    Raises:
        ConfigError: there is no such scenario or model, or it cannot be used.
    """
    if settings.scenario is None and settings.robot is None:
        return
    from app.workcell import read_scenario, robot_model  # the physics, which a server does without otherwise

    read_scenario(settings.scenario)
    robot_model(settings.robot)


def load_policies(folder: Path) -> PolicySet | None:
    """Return the compiled policies, or None after printing what is wrong with them or with what they promise."""
    try:
        policies = load(folder)
        read_promises(policies, read_properties(folder))
    except PolicyErrors as found:
        say_error(f"the policies in `{folder}` cannot be enforced, so nothing starts")
        for problem in found.problems:
            err.print(f"  {problem}", markup=False)
        return None
    return policies


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 takes a free one.

    Raises:
        ConfigError: the address cannot be listened on.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=2048)
    except (OSError, UnicodeError) as error:  # the second: a name that no name server can be asked for
        valid = f"a free address of this machine ({error.strerror if isinstance(error, OSError) else error})"
        raise ConfigError("host and port", f"{host}:{port}", valid) from error


def kernel_key(path: Path, *, first: bool) -> Ed25519PrivateKey:
    """Return the key that authorizations are signed with; the `first` start makes it (mode 0600).

    Raises:
        ConfigError: the file is no key, others may read it, or it is gone: no cell would take what another one signs.
        OSError: it cannot be read or written.
    """
    if not path.exists():
        if not first:
            raise ConfigError("kernel.key", "missing", f"`{path}` restored: it is the key that every cell knows")
        write_private(path, secrets.token_bytes(KEY_BYTES))
    seed = path.read_bytes()
    if path.stat().st_mode & 0o077 or len(seed) != KEY_BYTES:
        raise ConfigError("kernel.key", path, f"{KEY_BYTES} bytes that only their owner may read (mode 600)")
    return Ed25519PrivateKey.from_private_bytes(seed)


def read_cell_token(path: Path) -> str:
    """Return the token that cells started here dial in with.

    Raises:
        ConfigError: the file holds no token, or is gone.
        OSError: it cannot be read.
    """
    try:
        token = path.read_bytes().strip()
    except FileNotFoundError as error:
        new = f"`reins token issue cell --role cell --data {path.parent} > {path}`"
        raise ConfigError("cell.token", "missing", f"`{path}` restored, or a new token of a cell: {new}") from error
    if not token or not token.isascii():
        raise ConfigError("cell.token", path, "the token of a cell: `reins token issue --role cell` makes one")
    return token.decode()


async def _serve(settings: Settings, policies: PolicySet, listener: socket.socket) -> int:
    # A commit asks for the interpreter before, between and after its two writes. At the usual 5 ms the event loop runs
    # out of requests before it lets go, and then waits for the disk; a verification holds the loop up as long.
    sys.setswitchinterval(HAND_OVER_S)
    layout = settings.layout
    principals = open_principals(layout.root)
    token = read_cell_token(layout.root / CELL_TOKEN_FILE)
    url = address(listener)
    examine = Assayer()
    async with open_house(settings, policies, principals, examine) as house:
        children = Children(settings, token, lambda cell, word: remark(f"{cell}: {word}"), expect=house["fleet"].expect)
        door = DoorServer(_door(create_app(**house, principals=principals, checks={"children": children.trouble})))
        serving = asyncio.create_task(door.serve(sockets=[listener]))
        opened = asyncio.create_task(door.up.wait())
        await asyncio.wait({serving, opened}, return_when=asyncio.FIRST_COMPLETED)
        try:
            write_private(layout.server, orjson.dumps({"url": url, "pid": os.getpid()}))
            version = await house["versions"].load(house["versions"].in_force.digest)
            introduce(
                settings, house["fleet"], house["versions"], policies.digest, url, principals, verdict=version.verdict
            )
            children.start()
            proving = asyncio.create_task(_prove(house["versions"].proving)) if settings.prove else None
            await _told_to_stop(serving, children.misused)
            if proving is not None:
                await _ended(proving)
        finally:
            await children.stop()
            layout.server.unlink(missing_ok=True)
            house["feed"].close()  # streams end, or the door would wait for them; so do long polls and examinations
            house["governor"].let_go()
            examine.close()
            door.should_exit = True
            await serving
    return MISUSE if children.misused.is_set() else FINE


async def _prove(proving: Proving) -> None:
    """Have what is in force proved once the start is over, and say what came of it."""
    await asyncio.sleep(PROVE_AFTER_S)
    try:
        version, problems = await proving.in_force()
    except (ExaminationFailed, AuditError) as error:
        complain(f"whether the policy in force is sound is not known: {error}")
        return
    if version.proved:
        remark(f"policy {version.digest}: {version.proved}")
        return
    hint = "it goes on deciding; `reins policy check` of the same directory says this too"
    complain(f"the policy in force is {version.verdict}: {version.digest}", map(str, problems), hint=hint)


async def _ended(task: asyncio.Task[None]) -> None:
    """End a task; what it failed of is raised."""
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


@contextlib.asynccontextmanager
async def open_house(
    settings: Settings, policies: PolicySet, principals: Principals, examine: Assayer
) -> AsyncGenerator[dict[str, Any]]:
    """Open the record and run the governor on it; yields what the application serves, and closes in the other order."""
    layout = settings.layout
    promises = await asyncio.to_thread(read_properties, find_policies(settings.policies))
    with counting("verifying the record") as progress:
        store = await asyncio.to_thread(AuditStore.open, layout.root, progress=progress)
    try:
        runtime = Runtime(
            store,
            policies,
            kernel_key(layout.kernel_key, first=not store.size),
            default_profile=settings.profile,
            examine=examine,
            promises=promises,
            take_directory=settings.take_policies,
            may_give=principals.may_give,
            may_vouch=principals.may_vouch,
        )
        async with runtime.running():
            yield {
                "governor": runtime.governor,
                "desk": runtime.desk,
                "fleet": runtime.fleet,
                "feed": runtime.feed,
                "broadcast": runtime.broadcast,
                "store": store,
                "policy": lambda: runtime.kernel.policy,
                "versions": runtime.versions,
                "shadow": runtime.shadow,
            }
        if lost := runtime.register.unsaid():
            complain("the record took no more, so this is not in it:", lost)
    finally:
        examine.close()
        await store.close()


def _door(app: Any) -> uvicorn.Config:  # noqa: ANN401  # an ASGI application
    return uvicorn.Config(
        app,
        loop="none",
        http=Exchanges,
        ws=Sockets,
        ws_per_message_deflate=False,
        ws_ping_interval=None,  # the link beats by itself
        lifespan="on",
        access_log=False,
        proxy_headers=False,  # nothing here asks who forwarded a request, and a client may write what it likes there
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=LEAVE_S,
    )


async def _told_to_stop(serving: asyncio.Task[None], misused: asyncio.Event) -> None:
    """Return on a signal to stop, when serving ended by itself, or when a cell cannot be started with the settings."""
    told = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in stop_signals():
        loop.add_signal_handler(number, told.set)
    waiting = {asyncio.create_task(told.wait()), asyncio.create_task(misused.wait())}
    await asyncio.wait({serving, *waiting}, return_when=asyncio.FIRST_COMPLETED)
    for task in waiting:
        task.cancel()


def address(listener: socket.socket) -> str:
    """Return the address a listening socket is reached at from this machine."""
    name: tuple[str, int] = listener.getsockname()[:2]
    host, port = name
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  # what listens everywhere is here too
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _next_proof(settings: Settings) -> str:
    if settings.prove:
        return "it is proved in the background, and GET /v1/policies says what came of it"
    return "`reins policy propose` of the same directory has it proved, and says so"


def operator_token(path: Path, principals: Principals) -> str:
    """Return the operator's token from the note of the first start; empty, and said, where none of it holds.

    The note is for people: the server knows tokens by their digests, and starts without it.
    """
    try:
        note: object = orjson.loads(path.read_bytes())
    except FileNotFoundError:
        return ""
    except (OSError, ValueError) as error:
        remark(f"  `{path}` cannot be read, so the console's address bears no token: {error}")
        return ""
    token = cast("dict[str, object]", note).get("operator") if isinstance(note, dict) else None
    if not isinstance(token, str):
        remark(f"  `{path}` holds no token of `operator`, so the console's address bears none")
        return ""
    if not principals.has(token):  # withdrawn since: what was issued in its place stands in no file
        remark(f"  the token of `operator` in `{path}` holds no more, so the console's address bears none")
        return ""
    return token


def introduce(
    settings: Settings,
    fleet: Fleet,
    versions: Versions,
    directory: str,
    url: str,
    principals: Principals,
    *,
    verdict: str,
) -> None:
    """Print where the server is, what holds there, and how to come in."""
    tokens = settings.layout.tokens
    say(f"reins {__version__} serves {url}")
    say(f"  profile  {settings.profile}")
    for cell in fleet.cells():
        if cell.profile != settings.profile:
            say(f"           not for {cell.id}: it stays in {cell.profile}, which it was put into")
    say(f"  policy   {versions.in_force.digest}")
    say(f"           {versions.reason}")
    if verdict != PROVED:
        doubt = "not proved here" if verdict == UNKNOWN else f"{verdict} when it was proved here"
        say(f"           {doubt}: {_next_proof(settings)}")
    if versions.in_force.digest != directory:
        say(f"           not in force: {directory}, the directory's (`reins policy activate`, or --take-policies)")
    say(f"  data     {settings.layout.root}")
    say(f"  tokens   {tokens}")
    say(f"  console  {url}/#token={operator_token(tokens, principals)}")
