"""The real door on a real socket over the real runtime and a real database; only the cell is a puppet that dials in."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import re
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import jsonschema_rs
import orjson
import pytest
import uvicorn
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fastapi import FastAPI
from starlette.datastructures import Headers
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from app.api import pages
from app.api.application import create_app, described
from app.api.auth import CELL_TOKEN_FILE, PRINCIPALS_FILE, TOKENS_FILE, open_principals
from app.api.exchange import Exchanges
from app.api.problems import MEDIA_TYPE, Problem
from app.api.sockets import Sockets
from app.audit.store import AuditStore
from app.clock import monotonic_s, wall_s
from app.governance.bundle import load
from app.protocol import (
    Estop,
    Hello,
    Human,
    Launch,
    Reset,
    Scene,
    State,
    UpEvent,
    Watch,
    decode_down,
    encode,
    pack_poses,
)
from app.runtime.assembly import Runtime
from tests.conftest import NO_TLS
from tests.examining import examine_here
from tests.lasting import let_states_last

POLICIES = Path(__file__).resolve().parents[2] / "policies"
CELL = "workcell-1"
FACTS: dict[str, Any] = {
    "stamp_s": 1.0,
    "arm_ready": True,
    "arm_retracted": True,
    "gripper_empty": True,
    "holding": None,
    "base": [0.0, 0.0, 0.0],
    "objects": {
        name: {"visible": True, "reachable": True, "x_m": 0.5, "y_m": 0.0, "z_m": 0.8, "stamp_s": 1.0}
        for name in ("mug_1", "glass_1", "driver_1")
    },
    "tools": {},
    "inspected": {},
    "people_count": 0,
    "people_nearest_m": 99.0,
    "sensors_fresh": True,
}
SPOKEN_STATUS = {"pause": "paused", "resume": "running"}
SPOKEN_OUTCOME = {
    "stop": "stopped",
    "cancel": "cancelled",
    "rollback": "rolled_back",
    "resolve_terminate": "terminated",
}


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    return "asyncio"


async def eventually(condition: Callable[[], Any], within_s: float = 10.0) -> Any:
    """Return the condition's first true value; fail when the deadline passes."""
    deadline = monotonic_s() + within_s
    while not (value := condition()):
        assert monotonic_s() < deadline, "the condition did not come true in time"
        await asyncio.sleep(0.01)
    return value


@dataclass
class Puppet:
    """A cell without a robot: says it is there, takes launches and people's words, and does nothing by itself."""

    socket: ClientConnection
    cell: str = CELL
    invocation: str | None = None
    latched: bool = False
    reset: str = ""
    seq: int = 0
    launches: list[dict[str, Any]] = field(default_factory=list)
    words: list[str] = field(default_factory=list)
    watched: list[bool] = field(default_factory=list)

    async def tell(self, kind: str, **body: Any) -> None:
        self.seq += 1
        event = UpEvent(
            seq=self.seq,
            at_s=wall_s(),
            tick=0,
            kind=kind,
            invocation=self.invocation,
            actor=self.cell,
            body=body,
        )
        await self.socket.send(encode(event))

    async def show(self, x_m: float, progress: float) -> None:
        """Send one frame of poses."""
        pose = struct.pack("<7f", x_m, 0.0, 0.8, 1.0, 0.0, 0.0, 0.0)
        await self.socket.send(pack_poses(7, wall_s(), pose, struct.pack("<f", progress)))

    async def end(self, outcome: str) -> None:
        await self.tell("outcome", outcome=outcome)
        self.invocation = None
        await self.say_state()

    async def say_state(self) -> None:
        state = State(
            at_s=wall_s(),
            tick=0,
            invocation=self.invocation,
            status="running" if self.invocation else None,
            latched=self.latched,
            reset=self.reset,
            holding=False,
            policy_digest=None,
            profile=None,
            facts=FACTS,
            gauges={},
        )
        await self.socket.send(encode(state))

    async def obey(self, op: str) -> None:
        self.words.append(op)
        if op in SPOKEN_STATUS:
            await self.tell("status", status=SPOKEN_STATUS[op])
        elif op in SPOKEN_OUTCOME:
            await self.end(SPOKEN_OUTCOME[op])

    async def take(self, frame: str | bytes) -> None:
        match decode_down(frame):
            case Launch(body=body):
                authorization = json.loads(base64.b64decode(body))
                self.launches.append(authorization)
                self.invocation = authorization["invocation"]
                await self.tell("launch")
                await self.tell("status", status="running")
                await self.say_state()
            case Human(op=op):
                await self.obey(op)
            case Estop():
                self.latched = True
                await self.say_state()
            case Reset(id=told):
                self.latched, self.reset = False, told
                await self.say_state()
            case Watch(on=on):
                self.watched.append(on)
                if on:
                    await self.socket.send(encode(Scene(scene={"zones": []}, bodies=["mug_1"], gauges=["progress"])))
            case _:
                pass

    async def live(self) -> None:
        """Follow the server's words and repeat the state, until the link ends."""
        with contextlib.suppress(ConnectionClosed):
            while True:
                try:
                    async with asyncio.timeout(0.1):
                        frame = await self.socket.recv()
                except TimeoutError:
                    await self.say_state()
                else:
                    await self.take(frame)


@dataclass
class Described:
    """The OpenAPI document; every answer a test gets is held against it, and every body that was taken."""

    document: dict[str, Any]
    validators: dict[tuple[str, str, str, str], Any] = field(default_factory=dict)

    def template(self, path: str) -> str | None:
        for template in self.document["paths"]:
            if re.fullmatch(re.sub(r"\{[a-z]+\}", "[^/]+", template), path):
                return template
        return None

    async def check(self, response: httpx.Response) -> None:
        template = self.template(response.request.url.path)
        bare = response.request.method == "HEAD"  # described as what GET answers with
        method, status = "get" if bare else response.request.method.lower(), str(response.status_code)
        if template is None or method not in self.document["paths"][template]:
            assert response.status_code in {404, 405} or response.request.url.path in (*pages.VIEWS, pages.ICON)
            return
        documented = self.document["paths"][template][method]["responses"]
        assert status in documented, f"{method} {template} answers {status}, described are {sorted(documented)}"
        media_type = response.headers["content-type"].partition(";")[0]
        content = documented[status]["content"]
        assert media_type in content, f"{method} {template} {status} answers {media_type}, not {sorted(content)}"
        described = self.document["paths"][template][method].get("requestBody")  # what restrains reads no body
        if described and response.is_success and (taken := response.request.content):
            schema = described["content"]["application/json"]["schema"]
            self.hold((template, method, "taken", "application/json"), schema, orjson.loads(taken))
        if bare or media_type in {"text/event-stream", "application/octet-stream"}:
            return
        await response.aread()
        self.hold((template, method, status, media_type), content[media_type]["schema"], response.json())
        if media_type == MEDIA_TYPE:
            code = response.json()["code"]
            assert code in content[media_type]["examples"], f"{method} {template} does not describe the code `{code}`"

    def hold(self, place: tuple[str, str, str, str], schema: dict[str, Any], document: object) -> None:
        if place not in self.validators:
            whole = {**schema, "components": self.document["components"]}
            self.validators[place] = jsonschema_rs.Draft202012Validator(whole)
        for error in self.validators[place].iter_errors(document):
            pytest.fail(f"{place}: {error.instance_path}: {error.message}")


DESCRIBED: list[Described] = []


async def held_against(app: FastAPI) -> Described:
    """Return the document that answers are held against, which is the same for every server of a run."""
    if not DESCRIBED:
        DESCRIBED.append(Described(orjson.loads(await described(app))))
    return DESCRIBED[0]


@dataclass
class House:
    """A server under test."""

    url: str
    folder: Path
    runtime: Runtime
    app: FastAPI
    tokens: dict[str, str]
    cell_token: str
    described: Described

    def knows(self, key: str) -> bool:
        """Say whether a token counts."""
        try:
            self.app.state.parts.principals.authenticate(Headers({"authorization": f"Bearer {self.token(key)}"}))
        except Problem:
            return False
        return True

    def token(self, key: str) -> str:
        return self.cell_token if key == "cell" else self.tokens[key]

    @asynccontextmanager
    async def withdrawn(self, name: str) -> AsyncIterator[None]:
        """Have the tokens of somebody withdrawn meanwhile; they count again afterwards."""
        listed = self.folder / PRINCIPALS_FILE
        everyone = listed.read_bytes()
        rows = [row for row in orjson.loads(everyone)["principals"] if row["name"] != name]
        listed.write_bytes(orjson.dumps({"principals": rows}))
        try:
            yield
        finally:
            listed.write_bytes(everyone)
            await eventually(lambda: self.knows(name))

    def client(self, key: str | None = "agent") -> httpx.AsyncClient:
        token = None if key is None else self.token(key)
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        hooks: dict[str, list[Any]] = {"response": [self.described.check]}
        return httpx.AsyncClient(
            base_url=self.url, headers=headers, timeout=30.0, trust_env=False, event_hooks=hooks, verify=NO_TLS
        )

    @asynccontextmanager
    async def cell(self, name: str = CELL) -> AsyncIterator[Puppet]:
        """Have a cell dial in; leaves with its link closed and the server knowing it."""
        headers = {"Authorization": f"Bearer {self.cell_token}"}
        fleet = self.runtime.fleet
        last_seq = fleet.cell(name).up_seq if fleet.knows(name) else 0
        url = self.url.replace("http:", "ws:") + f"/v1/cells/{name}/link"
        async with connect(url, additional_headers=headers, proxy=None, compression=None) as socket:
            puppet = Puppet(socket, cell=name, seq=last_seq)
            await socket.send(
                encode(
                    Hello(
                        cell=name,
                        boot="boot-1",
                        robot="puppet",
                        policy_digest=self.runtime.kernel.policy.digest,
                        profile=None,
                        invocation=None,
                        latched=False,
                        journal="jrn-1",
                        last_seq=last_seq,
                    )
                )
            )
            await puppet.say_state()
            living = asyncio.create_task(puppet.live())
            await eventually(lambda: fleet.knows(name) and fleet.cell(name).fresh and not fleet.cell(name).behind)
            try:
                yield puppet
            finally:
                living.cancel()
                await asyncio.wait({living})
        await eventually(lambda: not fleet.attached(fleet.cell(name)))


@asynccontextmanager
async def open_house(folder: Path, profile: str) -> AsyncIterator[House]:
    """Serve a data directory on a free port of this machine."""
    store = AuditStore.open(folder)
    principals = open_principals(folder)
    runtime = Runtime(
        store,
        load(POLICIES),
        Ed25519PrivateKey.generate(),
        default_profile=profile,
        examine=examine_here,
        may_give=principals.may_give,
        may_vouch=principals.may_vouch,
    )
    async with runtime.running() as governor:
        app = create_app(
            governor=governor,
            desk=runtime.desk,
            fleet=runtime.fleet,
            feed=runtime.feed,
            broadcast=runtime.broadcast,
            store=store,
            policy=lambda: runtime.kernel.policy,
            versions=runtime.versions,
            shadow=runtime.shadow,
            principals=principals,
        )
        server = Door(
            uvicorn.Config(app, port=0, log_level="warning", ws=Sockets, ws_per_message_deflate=False, http=Exchanges)
        )
        serving = asyncio.create_task(server.serve())
        await eventually(lambda: server.started)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield House(
            url=f"http://127.0.0.1:{port}",
            folder=folder,
            runtime=runtime,
            app=app,
            tokens=orjson.loads((folder / TOKENS_FILE).read_bytes()),
            cell_token=(folder / CELL_TOKEN_FILE).read_text().strip(),
            described=await held_against(app),
        )
        runtime.feed.close()
        server.should_exit = True
        await serving
    await store.close()


class Door(uvicorn.Server):
    """Uvicorn without signal handlers: the test runner keeps its own."""

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        yield


@pytest.fixture(scope="module", autouse=True)
def lasting() -> Iterator[None]:
    """Let what a puppet said last count however long nobody ran: it and the server that hears it are one process."""
    with pytest.MonkeyPatch.context() as patch:
        let_states_last(patch)
        yield


@pytest.fixture(scope="module")
async def house(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[House]:
    """Serve profile sim-relaxed, where low risk launches without asking; no cell yet."""
    async with open_house(tmp_path_factory.mktemp("house"), "sim-relaxed") as house:
        yield house


@pytest.fixture(scope="module")
async def shared_house(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[House]:
    """Serve profile human-shared, where medium risk asks a human."""
    async with open_house(tmp_path_factory.mktemp("shared"), "human-shared") as house:
        yield house
