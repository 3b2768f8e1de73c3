import asyncio
import itertools
import re
from inspect import signature
from urllib.parse import parse_qs, quote, urlsplit

import pytest

from app.agent.client import (
    AsyncReinsClient,
    ExecutionFailed,
    Problem,
    Reason,
    Refused,
    ReinsClient,
    Unreachable,
    Unsendable,
)
from app.agent.conversation import Call, Reply, Sleep, invoke, send
from app.api.wire import ProposalBody
from app.clock import monotonic_s

from .scripted_server import Turn, serve


def invocation(status: str, **more: object) -> dict[str, object]:
    return {
        "id": "inv_1",
        "status": status,
        "capability": "grasp_object",
        "requested": {"force_n": 80},
        "effective": {"force_n": 60},
        "admission": {"outcome": "accept", "reasons": []},
        "policy": {"outcome": "allow", "reasons": [], "changes": []},
        "outcome": None,
        "updated_at": f"t{next(_CLOCK)}",
        **more,
    }


_CLOCK = itertools.count()
DENIED = invocation(
    "denied",
    policy={
        "outcome": "deny",
        "reasons": [{"rule": "organization/hazmat", "code": "rule", "message": "hazardous", "remedy": "ask"}],
    },
)


def test_returns_a_result_when_the_invocation_completes():
    states = iter(["awaiting_approval", "running", "completed"])

    def answer(turn: Turn):
        status = next(states)
        return (201 if turn.method == "POST" else 200), invocation(
            status, outcome="succeeded" if status == "completed" else None
        )

    told: list[str] = []
    with serve(answer) as server, ReinsClient(server.url, "secret") as client:
        result = client.invoke(
            "grasp_object", object_id="mug_1", on_update=lambda document: told.append(document["status"])
        )
    assert result.outcome == "succeeded"
    assert result.effective == {"force_n": 60}
    assert told == ["awaiting_approval", "running", "completed"]
    first, second, _ = server.turns
    assert first.body == {"capability": "grasp_object", "params": {"object_id": "mug_1"}}
    assert first.headers["authorization"] == "Bearer secret"
    assert second.path.startswith("/v1/invocations/inv_1?wait=20")


def _versions():
    """Answer with one version after another of an invocation that completes in the third."""
    times = iter(["2026-01-01T00:00:00.1Z", "2026-01-01T00:00:00.2Z", "2026-01-01T00:00:00.3Z"])

    def answer(_: Turn):
        now = next(times)
        if now.endswith(".3Z"):
            return 200, invocation("completed", outcome="succeeded", updated_at=now)
        return 200, invocation("running", updated_at=now)

    return answer


def _seen(turns: list[Turn]) -> list[list[str] | None]:
    return [parse_qs(urlsplit(turn.path).query).get("seen") for turn in turns]


def test_each_poll_names_the_version_known_already():
    with serve(_versions()) as server, ReinsClient(server.url, "t") as client:
        client.follow("inv_1")
    assert _seen(server.turns) == [None, ["2026-01-01T00:00:00.1Z"], ["2026-01-01T00:00:00.2Z"]]


@pytest.mark.anyio
async def test_each_asynchronous_poll_names_the_version_known_already():
    with serve(_versions()) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            await client.invoke("navigate_to", target="dock")
    assert _seen(server.turns) == [None, ["2026-01-01T00:00:00.1Z"], ["2026-01-01T00:00:00.2Z"]]


OPTIONS = {
    "mode": "careful",
    "cell": "workcell-1",
    "metadata": {"confidence": 0.9},
    "preconditions": ["arm_ready"],
    "recovery_preference": "rollback",
    "capability_version": "^1.0.0",
}
EVERYTHING = {"capability": "mix", "params": {"mode": "fast", "metadata": "none", "speed_mps": 0.1}, **OPTIONS}


def done(_: Turn):
    return 201, invocation("completed", outcome="succeeded")


def test_sends_every_option_of_a_proposal_beside_inputs_that_are_called_like_one():
    with serve(done) as server, ReinsClient(server.url, "t") as client:
        client.invoke("mix", {"mode": "fast", "metadata": "none"}, speed_mps=0.1, **OPTIONS)
        client.check("mix", {"mode": "fast", "metadata": "none"}, speed_mps=0.1, **OPTIONS)
        client.check("mix", speed_mps=0.1)
    assert [turn.path for turn in server.turns] == ["/v1/invocations", "/v1/check", "/v1/check"]
    assert [turn.body for turn in server.turns[:2]] == [EVERYTHING, EVERYTHING]
    assert server.turns[2].body == {"capability": "mix", "params": {"speed_mps": 0.1}}


@pytest.mark.anyio
async def test_sends_every_option_of_a_proposal_asynchronously():
    with serve(done) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            await client.invoke("mix", {"mode": "fast", "metadata": "none"}, speed_mps=0.1, **OPTIONS)
            await client.check("mix", {"mode": "fast", "metadata": "none"}, speed_mps=0.1, **OPTIONS)
    assert [turn.body for turn in server.turns] == [EVERYTHING, EVERYTHING]


def test_an_input_that_is_given_twice_is_not_sent():
    with serve(done) as server, ReinsClient(server.url, "t") as client:
        with pytest.raises(Unsendable, match="`speed_mps` is given twice; valid is once"):
            client.check("mix", {"speed_mps": 1}, speed_mps=0.1)
        assert server.turns == []


def test_the_options_are_those_that_the_server_takes():
    own = set(ProposalBody.model_fields) - {"capability", "params"}
    for method in (ReinsClient.invoke, ReinsClient.check, AsyncReinsClient.invoke, AsyncReinsClient.check):
        keywords = {name for name, found in signature(method).parameters.items() if found.kind is found.KEYWORD_ONLY}
        assert keywords - {"idempotency_key", "on_update"} == own == set(OPTIONS)


def test_raises_refused_with_the_reasons_of_a_denial():
    with (
        serve(lambda _: (201, DENIED)) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Refused) as caught,
    ):
        client.invoke("grasp_object", object_id="solvent_1")
    (reason,) = caught.value.reasons
    assert (reason.rule, reason.code, reason.remedy) == ("organization/hazmat", "rule", "ask")
    assert "hazardous" in str(caught.value)


def test_raises_execution_failed_when_a_launched_invocation_ends_without_success():
    failed = invocation("failed", outcome="stopped")
    with (
        serve(lambda _: (201, failed)) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(ExecutionFailed) as caught,
    ):
        client.invoke("grasp_object", object_id="mug_1")
    assert caught.value.outcome == "stopped"


LOST = {"rule": "outcome", "code": "object_lost", "message": "the object fell", "remedy": "look for it"}


@pytest.mark.parametrize("failure", [{"reasons": [LOST]}, LOST])
def test_what_policy_changed_is_no_reason_of_a_failure(failure):
    caught = ExecutionFailed(invocation("failed", outcome="terminated", policy=DENIED["policy"], failure=failure))
    assert caught.reasons == (Reason(**LOST),)
    assert caught.codes == {"object_lost"}
    assert str(caught) == "`grasp_object` failed: the object fell"


def test_what_policy_merely_constrained_comes_behind_what_a_refusal_is_for():
    change = {"param": "grip_force_n", "requested": 90, "effective": 60, "rule": "human-shared/force"}
    cut = {"rule": "human-shared/force", "code": "limited", "message": "cut to 60 N", "remedy": "60 N"}
    denied = {
        "outcome": "modify",
        "changes": [change],
        "reasons": [cut, {**cut, "rule": "authority/approval", "message": "a human denied this"}],
    }
    caught = Refused(invocation("denied", policy=denied))
    assert str(caught) == "`grasp_object` denied: a human denied this; cut to 60 N"
    assert [reason.rule for reason in caught.reasons] == ["authority/approval", "human-shared/force"]


def test_what_a_denied_proposal_was_deferred_for_comes_behind_what_denies_it():
    unmet = {"rule": "admission/object_visible", "code": "precondition_unmet", "message": "not in sight"}
    hazardous = {"rule": "organization/hazardous", "code": "hazardous", "message": "it needs `hazmat`"}
    admission = {"outcome": "defer", "reasons": [unmet], "retry_after_s": 1.0}
    caught = Refused(invocation("denied", admission=admission, policy={"outcome": "deny", "reasons": [hazardous]}))
    assert str(caught) == "`grasp_object` denied: it needs `hazmat`; not in sight"
    waits = Refused(invocation("deferred", admission=admission, policy={"outcome": "allow", "reasons": [hazardous]}))
    assert [reason.code for reason in waits.reasons] == ["precondition_unmet", "hazardous"]


def test_without_a_failure_there_is_no_reason():
    ended = invocation("failed", outcome="terminated", policy=DENIED["policy"], failure=None)
    assert ExecutionFailed(ended).reasons == ()


def test_proposes_a_deferred_invocation_again_under_a_new_key():
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    answers = iter([deferred, deferred, invocation("completed", outcome="succeeded")])
    with serve(lambda _: (201, next(answers))) as server, ReinsClient(server.url, "t") as client:
        client.invoke("navigate_to", target="dock")
    assert len({turn.headers["idempotency-key"] for turn in server.turns}) == 3


def test_whoever_asks_again_under_a_key_finds_what_became_of_it_after_defers():
    """As after a restart: the server keeps one invocation for each key, and only the second attempt was launched."""
    kept: dict[str, dict[str, object]] = {}

    def answer(turn: Turn):
        made = invocation("completed", outcome="succeeded") if kept else deferred
        return 201, kept.setdefault(turn.headers["idempotency-key"], made)

    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    with serve(answer) as server:
        for _ in range(2):
            with ReinsClient(server.url, "t") as client:
                assert client.invoke("grasp_object", idempotency_key="x" * 255).outcome == "succeeded"
    assert [made["status"] for made in kept.values()] == ["deferred", "completed"]


@pytest.mark.anyio
async def test_deferrals_that_are_history_are_neither_waited_out_nor_told_again():
    """As after a restart: of the attempts under a key, the first two were deferred when the program ended."""
    kept: dict[str, dict[str, object]] = {}
    headers: dict[str, str] = {}

    def answer(turn: Turn):
        key = turn.headers["idempotency-key"]
        headers["idempotency-replayed"] = str(key in kept).lower()
        made = invocation("completed", outcome="succeeded") if len(kept) == 2 else deferred
        return 201, kept.setdefault(key, made)

    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    with serve(answer, headers) as server:
        with ReinsClient(server.url, "t", defers=1) as client, pytest.raises(Refused):
            client.invoke("grasp_object", idempotency_key="mine")
        deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 60.0})
        kept = dict.fromkeys(kept, deferred)
        told: list[object] = []
        began_s = monotonic_s()
        with ReinsClient(server.url, "t") as client:
            client.invoke("grasp_object", idempotency_key="mine", on_update=told.append)
        async with AsyncReinsClient(server.url, "t") as client:
            await client.invoke("grasp_object", idempotency_key="mine", on_update=told.append)
        assert monotonic_s() - began_s < 10.0
    assert [document["status"] for document in told] == ["completed", "completed"]


def test_a_deferral_that_is_history_is_told_where_it_is_the_last_word():
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    told: list[object] = []
    with (
        serve(lambda _: (201, deferred), {"idempotency-replayed": "true"}) as server,
        ReinsClient(server.url, "t", defers=1) as client,
        pytest.raises(Refused),
    ):
        client.invoke("navigate_to", target="dock", on_update=told.append)
    assert told == [deferred]


def test_a_deferral_whose_first_answer_was_lost_is_no_history():
    headers = {"idempotency-replayed": "true"}
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    answers = iter([None, (201, deferred), (201, invocation("completed", outcome="succeeded"))])
    told: list[dict[str, object]] = []
    with serve(lambda _: next(answers), headers) as server, ReinsClient(server.url, "t") as client:
        client.invoke("navigate_to", target="dock", on_update=told.append)
    assert [document["status"] for document in told] == ["deferred", "completed"]


def test_gives_a_defer_up_after_the_allowed_number_of_attempts():
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    with (
        serve(lambda _: (201, deferred)) as server,
        ReinsClient(server.url, "t", defers=1) as client,
        pytest.raises(Refused),
    ):
        client.invoke("navigate_to", target="dock")
    assert len(server.turns) == 2


def test_asks_again_under_the_same_key_when_the_answer_was_lost():
    answers = iter(
        [
            None,
            (409, {"code": "in_flight", "detail": "being decided"}),
            (201, invocation("completed", outcome="succeeded")),
        ]
    )
    with serve(lambda _: next(answers)) as server, ReinsClient(server.url, "t") as client:
        client.invoke("navigate_to", target="dock")
    assert len(server.turns) == 3
    assert len({turn.headers["idempotency-key"] for turn in server.turns}) == 1


def test_raises_problem_at_once_when_the_request_itself_is_refused():
    body = {"code": "token_invalid", "title": "Unauthorized", "detail": "no such token"}
    with (
        serve(lambda _: (401, body)) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Problem) as caught,
    ):
        client.invoke("navigate_to", target="dock")
    assert (caught.value.status, caught.value.code) == (401, "token_invalid")
    assert len(server.turns) == 1


@pytest.mark.parametrize("client", [ReinsClient, AsyncReinsClient])
@pytest.mark.parametrize("defers", [-1, "3", 1.5, True, None])
def test_a_number_of_times_that_is_none_is_refused_at_once(client, defers):
    with pytest.raises(ValueError, match=f"defers `{defers}`: valid is a whole number from 0 on"):
        client("http://127.0.0.1:1", "t", defers=defers)


def test_a_number_of_times_that_cannot_be_written_is_refused_in_words():
    with pytest.raises(ValueError, match="defers `<int>`: valid is a whole number from 0 on"):
        ReinsClient("http://127.0.0.1:1", "t", defers=-(10**5000))


@pytest.mark.parametrize("answer", [{}, {"id": 5, "status": "running"}, {"id": "inv_1", "status": ["running"]}])
def test_an_answer_that_is_no_invocation_says_under_which_key_it_may_have_begun(answer):
    with (
        serve(lambda _: (201, answer)) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Problem, match="unreadable_answer") as caught,
    ):
        client.invoke("navigate_to", target="dock", idempotency_key="key-1")
    assert caught.value.idempotency_key == "key-1"


@pytest.mark.parametrize(
    ("last", "wrong"),
    [
        ({"id": "inv_2", "status": "running"}, "is not the invocation `inv_1`"),
        ({"id": "inv_2", "status": "completed", "outcome": "succeeded"}, "is not the invocation `inv_1`"),
        ({"id": "inv_1", "status": "resting"}, "has the status 'resting'; valid: awaiting_approval, completed,"),
        ({"id": "inv_1", "status": "completed"}, "is completed otherwise than by success; valid: recovered, succeeded"),
        ({"id": "inv_1", "status": "completed", "outcome": "stopped"}, "is completed otherwise than by success"),
        ({"id": "inv_1", "status": "completed", "outcome": ["succeeded"]}, "is completed otherwise than by success"),
    ],
)
@pytest.mark.anyio
async def test_an_answer_that_is_not_the_invocation_proposed_is_not_believed(last, wrong):
    running = invocation("running")

    def answer(turn: Turn):
        return (201, running) if turn.method == "POST" else (200, last)

    with serve(answer) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Problem, match=re.escape(wrong)) as caught:
            client.invoke("navigate_to", target="dock")
        assert (caught.value.code, caught.value.invocation) == ("unreadable_answer", running)
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Problem, match=re.escape(wrong)):
                await client.follow("inv_1")
        with ReinsClient(server.url, "t") as client, pytest.raises(Problem, match=re.escape(wrong)):
            client.follow("inv_1")


def test_a_poll_that_is_answered_at_once_with_nothing_new_is_followed_by_a_pause():
    same, states = invocation("running"), iter(["running"] * 4 + ["completed"])

    def answer(_: Turn):
        now = next(states)
        return 200, same if now == "running" else invocation("completed", outcome="succeeded")

    begun_s = monotonic_s()
    with serve(answer) as server, ReinsClient(server.url, "t") as client:
        client.follow("inv_1")
    assert monotonic_s() - begun_s > 0.5


@pytest.mark.parametrize("reasons", ["abc", 5, ["abc", 5], {"code": "x"}, [{"code": 5, "message": None}], None])
@pytest.mark.parametrize("status", ["denied", "failed"])
def test_reasons_that_are_none_are_no_reason_not_to_say_how_it_ended(status, reasons):
    ended = {"id": "inv_1", "status": status, "policy": {"reasons": reasons}, "failure": {"reasons": reasons}}
    with (
        serve(lambda _: (201, ended)) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Refused if status == "denied" else ExecutionFailed, match="no reason given") as caught,
    ):
        client.invoke("navigate_to", target="dock")
    assert caught.value.reasons == ()


@pytest.mark.parametrize("odd", ["abc", 5, ["abc"], None])
def test_a_result_without_what_policy_says_shows_none(odd):
    bare = {"id": "inv_1", "status": "completed", "outcome": "succeeded", "effective": odd, "policy": {"changes": odd}}
    with serve(lambda _: (201, bare)) as server, ReinsClient(server.url, "t") as client:
        result = client.invoke("navigate_to", target="dock")
    assert (result.id, result.outcome, result.effective, result.changes) == ("inv_1", "succeeded", {}, [])


@pytest.mark.parametrize("answer", [{}, {"items": "abc"}, {"items": ["abc"]}, {"items": None}])
@pytest.mark.anyio
async def test_a_list_that_is_none_is_a_problem(answer):
    with serve(lambda _: (200, answer)) as server:
        with ReinsClient(server.url, "t") as client:
            for ask in (client.capabilities, lambda: client.trace("inv_1")):
                with pytest.raises(Problem, match="is no list of documents"):
                    ask()
        async with AsyncReinsClient(server.url, "t") as client:
            for ask in (client.capabilities, lambda: client.trace("inv_1")):
                with pytest.raises(Problem, match="is no list of documents"):
                    await ask()


@pytest.mark.parametrize("after", ["9" * 30, "\u00b2", "-1", "soon"])
def test_a_time_that_cannot_be_waited_breaks_nothing_off(after):
    answers = iter([(503, {"code": "record_unavailable"}), (201, invocation("completed", outcome="succeeded"))])
    with serve(lambda _: next(answers), {"retry-after": after}) as server, ReinsClient(server.url, "t") as client:
        assert client.invoke("navigate_to", target="dock").outcome == "succeeded"


@pytest.mark.parametrize("status", [408, 429, 503])
def test_who_is_asked_to_come_back_later_does_and_after_a_minute_at_the_latest(status: int):
    talk = send(Call(method="GET", path="/v1/capabilities"))
    next(talk)
    waited: list[float] = []
    for asked_s in (None, 1.0, 86_400.0, 86_400.0, 2.0, 2.0, 2.0):
        slept = talk.send(Reply(status=status, json={"code": "busy", "detail": "busy"}, retry_after_s=asked_s))
        assert isinstance(slept, Sleep)
        waited.append(slept.seconds)
        next(talk)
    assert waited == [0.2, 1.0, 60.0, 60.0, 2.0, 2.0, 2.0]
    with pytest.raises(Problem, match=rf"{status} busy: busy; .* after `86400` s, of which at most 60 are waited"):
        talk.send(Reply(status=status, json={"code": "busy", "detail": "busy"}, retry_after_s=86_400.0))


@pytest.mark.parametrize(("asked_s", "waited_s"), [(2, 2.0), (999_999, 60.0), (float("inf"), 60.0), (10**400, 60.0)])
def test_a_deferral_is_proposed_again_after_a_minute_at_the_latest_and_says_what_was_asked(
    asked_s: float, waited_s: float
):
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": asked_s})
    told: list[dict[str, object]] = []
    talk = invoke({"capability": "navigate_to"}, None, 1, told.append)
    next(talk)
    assert talk.send(Reply(status=201, json=deferred)) == Sleep(seconds=waited_s)
    next(talk)
    with pytest.raises(Refused, match=f"deferred: .* to be proposed again after `{asked_s}` s"):
        talk.send(Reply(status=201, json=deferred))
    assert told == [deferred, deferred]


@pytest.mark.parametrize("asked_s", [float("nan"), -5, 0, "soon", None])
def test_a_deferral_that_names_no_time_is_proposed_again_after_a_second(asked_s: object):
    talk = invoke({"capability": "navigate_to"}, None, 1, None)
    next(talk)
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": asked_s})
    assert talk.send(Reply(status=201, json=deferred)) == Sleep(seconds=1.0)


def test_an_answer_that_is_no_document_is_shown():
    with (
        serve(lambda _: (200, "welcome to another server")) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Problem, match="200 unreadable_answer: `welcome to another server` is no JSON document"),
    ):
        client.invoke("navigate_to", target="dock")


def test_an_answer_that_leads_elsewhere_is_not_followed_and_told_as_that():
    with (
        serve(lambda _: (200, {})) as other,
        serve(lambda _: (307, ""), {"location": other.url}) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Problem, match=r"307 redirected: .* valid is the URL"),
    ):
        client.invoke("navigate_to", target="dock")
    assert other.turns == []


def test_raises_unreachable_when_nothing_ever_answers(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.agent.conversation._BACKOFF_S", 0.001)
    with serve(lambda _: None) as server:
        url = server.url
    with ReinsClient(url, "t") as client, pytest.raises(Unreachable, match=rf"attempts; `{url}/?`: .*[Rr]efused"):
        client.invoke("navigate_to", target="dock")


def test_what_breaks_a_proposal_off_says_the_key_under_which_it_is_found_again(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.agent.conversation._SEND_ATTEMPTS", 1)
    with (
        serve(lambda _: None) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Unreachable) as caught,
    ):
        client.invoke("navigate_to", target="dock")
    key = server.turns[0].headers["idempotency-key"]
    assert (caught.value.idempotency_key, caught.value.invocation) == (key, None)
    (said,) = caught.value.__notes__  # what a program prints that lets it through
    assert f"`{key}`: invoking again under it takes it up" in said


def test_what_breaks_a_poll_off_says_the_key_and_the_invocation_last_heard_of():
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    running = invocation("running", id="inv_2")
    posts = iter([deferred, running])

    def answer(turn: Turn):
        return (201, next(posts)) if turn.method == "POST" else (401, {"code": "token_invalid", "detail": "expired"})

    with (
        serve(answer) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Problem) as caught,
    ):
        client.invoke("navigate_to", target="dock")
    assert caught.value.idempotency_key == server.turns[0].headers["idempotency-key"]
    assert caught.value.invocation == running


def test_a_second_attempt_that_is_lost_has_no_invocation_yet(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.agent.conversation._SEND_ATTEMPTS", 1)
    deferred = invocation("deferred", admission={"outcome": "defer", "reasons": [], "retry_after_s": 0.01})
    answers = iter([(201, deferred), None])
    with (
        serve(lambda _: next(answers)) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Unreachable) as caught,
    ):
        client.invoke("navigate_to", idempotency_key="mine", target="dock")
    assert (caught.value.idempotency_key, caught.value.invocation) == ("mine", None)


class Boom(Exception):
    pass


def _raises(_: object) -> None:
    raise Boom("no room")


NOTE = "proposed under the idempotency key `key-1`, invocation `inv_1`: invoking again under it takes it up"


@pytest.mark.anyio
async def test_what_on_update_raises_comes_through_with_a_note_of_the_key():
    with serve(lambda _: (201, invocation("running"))) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Boom) as caught:
            client.invoke("navigate_to", idempotency_key="key-1", on_update=_raises)
        assert (str(caught.value), caught.value.__notes__) == ("no room", [NOTE])
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Boom) as caught:
                await client.invoke("navigate_to", idempotency_key="key-1", on_update=_raises)
        assert caught.value.__notes__ == [NOTE]
        with ReinsClient(server.url, "t") as client, pytest.raises(Boom) as caught:
            client.follow("inv_1", on_update=_raises)  # whoever follows knows the name
        assert not hasattr(caught.value, "__notes__")


def test_what_a_proposal_within_on_update_says_of_itself_is_kept():
    def answer(turn: Turn):
        mine = turn.headers.get("idempotency-key") == "key-1"
        return (201, invocation("running")) if mine else (401, {"code": "token_invalid", "detail": "expired"})

    with serve(answer) as server, ReinsClient(server.url, "t") as client, pytest.raises(Problem) as caught:
        client.invoke(
            "navigate_to", idempotency_key="key-1", on_update=lambda _: client.invoke("wave", idempotency_key="key-2")
        )
    assert (caught.value.idempotency_key, caught.value.invocation) == ("key-2", None)
    assert caught.value.__notes__ == [NOTE]


def test_a_misuse_within_on_update_does_not_lose_the_key():
    with (
        serve(lambda _: (201, invocation("running"))) as server,
        ReinsClient(server.url, "t") as client,
        pytest.raises(Unsendable) as caught,
    ):
        client.invoke("navigate_to", idempotency_key="key-1", on_update=lambda _: client.follow(""))
    assert caught.value.__notes__ == [NOTE]


@pytest.mark.anyio
@pytest.mark.parametrize("status", ["running", "deferred"])
async def test_a_cancelled_invocation_leaves_a_note_of_the_key(status: str):
    told = asyncio.Event()
    with serve(lambda _: (201, invocation(status))) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            asked = client.invoke("navigate_to", idempotency_key="key-1", on_update=lambda _: told.set())
            task = asyncio.ensure_future(asked)
            await told.wait()
            task.cancel()
            with pytest.raises(asyncio.CancelledError) as caught:
                await task
    assert caught.value.__notes__ == [NOTE]


@pytest.mark.anyio
async def test_what_cannot_be_called_with_changes_is_refused_before_the_first():
    with serve(lambda _: (200, invocation("running"))) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Unsendable, match="on_update is `5`"):
            client.follow("inv_1", on_update=5)
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Unsendable, match="on_update is `5`"):
                await client.follow("inv_1", on_update=5)
    assert server.turns == []


@pytest.mark.parametrize("kind", ["text/plain", "application/json"])
@pytest.mark.parametrize("charset", ["undefined", "idna", "rot13", "hex", "latin-1", "nonsense"])
@pytest.mark.anyio
async def test_a_charset_that_decodes_nothing_is_an_unreadable_answer(charset, kind):
    with serve(lambda _: (200, b"\xffwelcome.."), {"content-type": f"{kind}; charset={charset}"}) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Problem, match=r"`.welcome\.\.` is no") as caught:
            client.invoke("navigate_to", idempotency_key="key-1")
        assert (caught.value.code, caught.value.idempotency_key) == ("unreadable_answer", "key-1")
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Problem, match="unreadable_answer"):
                await client.invoke("navigate_to")


@pytest.mark.anyio
async def test_no_cookie_is_kept_that_could_not_be_sent_back():
    states = iter(["running", "completed"] * 2)

    def answer(_: Turn):
        return 200, invocation(next(states), outcome="succeeded")

    with serve(answer, {"set-cookie": "a=\xff; path=/"}) as server:
        with ReinsClient(server.url, "t") as client:
            client.invoke("navigate_to")
        async with AsyncReinsClient(server.url, "t") as client:
            await client.invoke("navigate_to")
    assert len(server.turns) == 4
    assert not any("cookie" in turn.headers for turn in server.turns)


@pytest.mark.anyio
async def test_an_answer_that_cannot_be_decoded_is_none(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.agent.conversation._SEND_ATTEMPTS", 1)
    with serve(lambda _: (200, {}), {"content-encoding": "gzip"}) as server:
        with ReinsClient(server.url, "t") as client, pytest.raises(Unreachable):
            client.capabilities()
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Unreachable):
                await client.capabilities()


@pytest.mark.anyio
async def test_the_asynchronous_client_holds_the_same_conversation():
    states = iter(["running", "completed"])

    def answer(turn: Turn):
        if turn.path.endswith("/trace"):
            return 200, {"items": [{"seq": 1, "kind": "proposal"}], "next": None}
        return 201, invocation(next(states), outcome="recovered")

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            result = await client.invoke("grasp_object", object_id="mug_1", metadata={"confidence": 0.9})
            trace = await client.trace(result.id)
    assert result.outcome == "recovered"
    assert trace == [{"seq": 1, "kind": "proposal"}]
    assert server.turns[0].body["metadata"] == {"confidence": 0.9}


@pytest.mark.parametrize("name", ["../cells", "inv_1?wait=0", "inv_1#x", "a b"])
def test_the_name_of_an_invocation_leads_nowhere_else(name: str):
    asked: list[str] = []

    def answer(turn: Turn):
        asked.append(turn.path)
        return 404, {"code": "invocation_unknown", "detail": "no such invocation"}

    with serve(answer) as server, ReinsClient(server.url, "secret") as client:
        for ask in (client.follow, client.trace):
            with pytest.raises(Problem, match="invocation_unknown"):
                ask(name)
    asked_for = f"/v1/invocations/{quote(name, safe='')}"
    assert asked == [asked_for, f"{asked_for}/trace"]
