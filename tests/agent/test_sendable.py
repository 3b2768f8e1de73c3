import itertools
import re
from functools import partial

import pytest

from app.agent.client import AsyncReinsClient, Problem, ReinsClient, Unreachable, Unsendable

from .scripted_server import Turn, serve

RUNNING = {"id": "inv_1", "status": "running", "updated_at": "t1"}
DONE = {"id": "inv_1", "status": "completed", "outcome": "succeeded", "updated_at": "t2"}
HUGE = 10**5000  # more digits than Python writes
LONG = "x" * 70_000


CIRCLE: list[object] = []
CIRCLE.append(CIRCLE)


async def later(_: object) -> None: ...


class Later:
    async def __call__(self, _: object) -> None: ...

    async def later(self, _: object) -> None: ...


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"force_n": float("nan")}, "`params.force_n` is `nan`; valid are finite numbers"),
        ({"pose": [0.0, float("inf")]}, "`params.pose[1]` is `inf`; valid are finite numbers"),
        ({"object_id": {"mug_1"}}, "`params.object_id` is `{'mug_1'}`, a set; valid are JSON's types"),
        ({"object_id": "\ud800"}, "`params.object_id` is `'\\ud800'`; valid is text without lone surrogates"),
        ({"pose": {1: 2.0}}, "`params.pose` has the key `1`; valid keys are strings"),
        ({"pose": CIRCLE}, "nested too deep; valid are at most 32 levels"),
        ({"metadata": {"confidence": float("nan")}}, "`metadata.confidence` is `nan`"),
        ({"idempotency_key": "clé"}, "idempotency_key `'clé'`: valid are 1 to 255 printable ASCII characters"),
        ({"idempotency_key": ""}, "idempotency_key `''`"),
        ({"idempotency_key": "a\nb"}, "idempotency_key `'a\\nb'`"),
        ({"idempotency_key": 3}, "idempotency_key `3`"),
        ({"idempotency_key": HUGE}, "idempotency_key `<int>`"),
        ({"force_n": HUGE}, "`params.force_n` is a whole number of 16610 bits; valid are numbers up to 1e308"),
        ({"pose": {HUGE: 1}}, "`params.pose` has the key `<int>`; valid keys are strings"),
        ({"pose": {HUGE}}, "`params.pose` is `<set>`, a set"),
        ({"metadata": HUGE}, "`metadata` is a whole number of 16610 bits"),
        ({"on_update": "print"}, "on_update is `'print'`; valid is a function of one document"),
        ({"on_update": later}, "on_update is an `async def`; valid is a plain function of one document"),
        ({"on_update": Later().later}, "on_update is an `async def`"),
        ({"on_update": Later()}, "on_update is an `async def`"),
        ({"on_update": partial(later)}, "on_update is an `async def`"),
    ],
    ids=itertools.count(),  # what a case gives cannot always be written
)
@pytest.mark.anyio
async def test_a_value_that_cannot_be_sent_is_named_and_nothing_is_sent(given, message):
    with serve(lambda _: (201, DONE)) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Unsendable, match=re.escape(message)):
            client.invoke("grasp_object", **given)
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Unsendable, match=re.escape(message)):
                await client.invoke("grasp_object", **given)
    assert server.turns == []


async def refuses(method: str, *args: object, says: str, **named: object) -> None:
    """Expect both clients to refuse a call in these words, and to send nothing."""
    with serve(lambda _: (200, DONE)) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Unsendable, match=re.escape(says)) as caught:
            getattr(client, method)(*args, **named)
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Unsendable, match=re.escape(says)):
                await getattr(client, method)(*args, **named)
    assert server.turns == []
    assert str(caught.value).endswith("; nothing was sent")
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("inputs", [5, "ab", [1], 0])
@pytest.mark.anyio
async def test_inputs_that_are_no_mapping_are_not_sent(inputs):
    says = f"inputs is `{inputs!r}`; valid is a mapping of names and values"
    await refuses("invoke", "grasp_object", inputs, says=says)
    await refuses("check", "grasp_object", inputs, says=says)


@pytest.mark.parametrize("method", [None, 5, "", "é", "G T", "GET\n", "A" * 70_000], ids=itertools.count())
@pytest.mark.anyio
async def test_what_is_no_method_is_not_sent(method):
    says = f"the method is `{method!r}"[:100]
    await refuses("call", method, "/v1/cells", says=says)
    await refuses("call", method, "/v1/cells", says="valid is one of HTTP's, for instance `GET`")


@pytest.mark.parametrize("path", [None, 5, b"/v1/cells", "/v1\n", "/\ud800"])
@pytest.mark.anyio
async def test_what_is_no_path_is_not_asked_for(path):
    await refuses("call", "GET", path, says=f"the path is `{path!r}`; valid is text in printable characters")


@pytest.mark.parametrize("query", [5, 0, "ab", [("after", "1")]])
@pytest.mark.anyio
async def test_a_query_that_is_no_mapping_is_not_sent(query):
    await refuses("call", "GET", "/v1/cells", query=query, says=f"`query` is `{query!r}`; valid is a mapping")


@pytest.mark.anyio
async def test_a_number_that_cannot_be_written_is_not_asked_for():
    says = "`query.after` is a whole number of 16610 bits; valid are numbers up to 1e308"
    await refuses("call", "GET", "/v1/audit/events", query={"after": HUGE}, says=says)
    await refuses("call", "GET", HUGE, says="the path is `<int>`")
    await refuses("follow", HUGE, says="the invocation is `<int>`; valid is the `id` of one")
    await refuses("invoke", HUGE, says="`capability` is a whole number of 16610 bits")


@pytest.mark.anyio
async def test_what_is_too_long_for_an_address_is_not_asked_for():
    for method in ("follow", "trace"):
        await refuses(method, LONG, says=" octets with its query; valid are at most 8000")
    await refuses("call", "GET", f"/{LONG}", says="has 70001 octets with its query; valid are at most 8000")
    await refuses("call", "GET", "/v1/cells", query={"a": LONG}, says="the path `/v1/cells` has 70011 octets")
    await refuses("call", "GET", "/v1/cells", query={"a": "é" * 2000}, says="the path `/v1/cells` has 12011 octets")


def test_what_fills_an_address_is_asked_for():
    with serve(lambda _: (200, DONE)) as server, ReinsClient(server.url, "t") as client:
        client.call("GET", "/v1/cells", query={"a": "x" * 7989})
        with pytest.raises(Unsendable, match="has 8001 octets"):
            client.call("GET", "/v1/cells", query={"a": "x" * 7990})
    assert len(server.turns) == 1


@pytest.mark.parametrize(("method", "path"), [("G T", "/v1/cells"), ("GET", f"/{LONG}")], ids=["method", "path"])
@pytest.mark.anyio
async def test_what_http_itself_would_not_send_is_no_lost_answer(method, path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.agent.sendable._METHOD", re.compile(".*"))  # as if we had not looked ourselves
    monkeypatch.setattr("app.agent.sendable._MAX_TARGET", 10**6)
    with serve(lambda _: (200, DONE)) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Unsendable, match="nothing was sent"):
            client.call(method, path)
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Unsendable, match="nothing was sent"):
                await client.call(method, path)
    assert server.turns == []


CLOSED = "the client was closed; valid is a new one; nothing was sent"


@pytest.mark.anyio
async def test_a_closed_client_says_that_it_is():
    with serve(lambda _: (200, DONE)) as server:
        client, other = ReinsClient(server.url, "t"), AsyncReinsClient(server.url, "t")
        client.close()
        await other.close()
        for ask in (("capabilities",), ("invoke", "grasp_object"), ("follow", "inv_1"), ("call", "GET", "/v1/cells")):
            with pytest.raises(Unsendable, match=CLOSED):
                getattr(client, ask[0])(*ask[1:])
            with pytest.raises(Unsendable, match=CLOSED):
                await getattr(other, ask[0])(*ask[1:])
    assert server.turns == []


def test_a_client_that_is_closed_under_way_says_under_which_key_the_robot_moves():
    with serve(lambda _: (200, RUNNING)) as server:
        client = ReinsClient(server.url, "t")
        with pytest.raises(Unreachable, match="no answer to `GET /v1/invocations/inv_1`: the client was") as caught:
            client.invoke("grasp_object", idempotency_key="key-1", on_update=lambda _: client.close())
    assert (caught.value.idempotency_key, caught.value.invocation) == ("key-1", RUNNING)


def test_a_client_that_is_closed_after_a_lost_answer_says_under_which_key_it_proposed():
    with serve(lambda _: client.close()) as server:
        client = ReinsClient(server.url, "t")
        with pytest.raises(Unreachable, match="no answer to `POST /v1/invocations`: the client was") as caught:
            client.invoke("grasp_object", idempotency_key="key-1")
    assert (caught.value.idempotency_key, len(server.turns)) == ("key-1", 1)


@pytest.mark.parametrize("version", [LONG, "\ud800", "a\nb", ["t1"], 5], ids=itertools.count())
def test_a_version_that_cannot_be_sent_is_not_named(version):
    def answer(turn: Turn):
        return (201, {**RUNNING, "updated_at": version}) if turn.method == "POST" else (200, DONE)

    with serve(answer) as server, ReinsClient(server.url, "t") as client:
        assert client.invoke("grasp_object").outcome == "succeeded"
    assert server.turns[1].path == "/v1/invocations/inv_1?wait=20"


@pytest.mark.parametrize("name", ["", LONG], ids=["empty", "long"])
def test_an_answer_whose_name_cannot_be_asked_for_says_under_which_key_it_may_have_begun(name):
    with (
        serve(lambda _: (201, {**RUNNING, "id": name})) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Problem, match="unreadable_answer") as caught,
    ):
        client.invoke("grasp_object", idempotency_key="key-1")
    assert caught.value.idempotency_key == "key-1"


@pytest.mark.parametrize("name", [None, "", 7, "\ud800", ["inv_1"]])
@pytest.mark.anyio
async def test_what_is_no_name_of_an_invocation_is_not_asked_for(name):
    with serve(lambda _: (200, {})) as server:
        for ask in ("follow", "trace"):
            with ReinsClient(server.url, "t") as client, pytest.raises(Unsendable, match="valid is the `id` of one"):
                getattr(client, ask)(name)
            async with AsyncReinsClient(server.url, "t") as client:
                with pytest.raises(Unsendable, match="valid is the `id` of one"):
                    await getattr(client, ask)(name)
    assert server.turns == []


@pytest.mark.anyio
async def test_a_path_that_leads_to_another_host_is_not_asked():
    with serve(lambda _: (200, {})) as server, serve(lambda _: (200, {})) as other:
        host = other.url.removeprefix("http:")
        for path in (f"{other.url}/x", f"{host}/x", "v1/capabilities", ""):
            valid = re.escape(f"the path is `{path}`; valid is one that begins with a single `/`")
            with ReinsClient(server.url, "t") as client, pytest.raises(Unsendable, match=valid):
                client.call("GET", path)
            async with AsyncReinsClient(server.url, "t") as client:
                with pytest.raises(Unsendable, match=valid):
                    await client.call("GET", path)
    assert server.turns == other.turns == []


@pytest.mark.parametrize("client", [ReinsClient, AsyncReinsClient])
def test_a_token_that_fits_no_header_is_refused_without_repeating_it(client):
    with pytest.raises(Unsendable, match="token: valid are") as caught:
        client("http://127.0.0.1:1", "geheimschlüssel")
    assert "geheim" not in str(caught.value)
