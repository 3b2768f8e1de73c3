import asyncio
import inspect
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from app.agent.approver import Answer, ScriptedApprover, decide, load_habits, parse_habits
from app.agent.client import AsyncReinsClient, Problem
from app.cli import approver
from app.demo import answered, approve, skipped

from .scripted_server import Turn, serve

HABITS = {
    "approver": "operator",
    "reads_s": {"min": 0.0, "max": 0.01},
    "seed": 1,
    "rules": [
        {"match": {"capability": "grasp_object", "risk": ["medium"]}, "decision": "approve", "edit": {"force_n": 40}},
        {"match": {"capability": "operate_tool"}, "decision": "ignore"},
    ],
}


def escalation(**more: object) -> dict[str, object]:
    return {"id": "esc_1", "digest": "sha256:a", "kind": "approval", "capability": "grasp_object", "risk": "medium",
            "agent": "planner", "effective": {"object_id": "mug_1", "force_n": 60}, **more}  # fmt: skip


@pytest.mark.parametrize(
    ("item", "draw", "decision"),
    [
        (escalation(), 0.5, "approve"),
        (escalation(risk="high"), 0.5, "deny"),
        (escalation(capability="operate_tool"), 0.5, "ignore"),
        (escalation(capability="operate_tool"), 0.0, "ignore"),
    ],
)
def test_the_first_matching_rule_decides_and_no_match_denies(item, draw, decision):
    assert decide(parse_habits(HABITS), item, draw).decision == decision


def test_a_session_under_way_is_approved_without_an_edit():
    answer = decide(parse_habits(HABITS), escalation(kind="session"), 0.5)
    assert (answer.decision, answer.edit) == ("approve", {})
    assert decide(parse_habits(HABITS), escalation(), 0.5).edit == {"force_n": 40}


def test_an_error_turns_the_answer_round():
    habits = parse_habits({**HABITS, "error_rate": 0.25})
    assert decide(habits, escalation(), 0.2).decision == "deny"
    assert decide(habits, escalation(), 0.3).decision == "approve"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"speed": 1}, "unknown key `speed`"),
        ({"error_rate": 2}, "valid: 0…1"),
        ({"reads_s": {"min": 2, "max": 1}}, "valid: 0 ≤ min ≤ max"),
        ({"rules": [{"match": {"mood": "good"}}]}, "cannot match on `mood`"),
        ({"rules": [{"match": {"risk": "extreme"}}]}, "names `extreme`; valid: low, medium, high, critical"),
        ({"rules": [{"match": {"kind": ["session", "x"]}}]}, "`match.kind` names `x`; valid: approval, session"),
        ({"rules": [{"decision": "maybe"}]}, "decision `maybe`"),
        ({"rules": 3}, "`rules` is `3`; valid: a list of rules"),
        ({"rules": [3]}, r"`rules\[0\]` is `3`; valid: a mapping with decision, edit, match"),
        ({"rules": [{"decison": "approve"}]}, "unknown key `decison`; valid: decision, edit, match"),
        ({"rules": [{"edit": 3}]}, "`edit` is `3`; valid: a mapping"),
        ({"rules": [{"match": 3}]}, "`match` is `3`; valid: a mapping"),
        ({"rules": [{"match": {"risk": 3}}]}, "`match.risk` is `3`; valid: a name or a list of names"),
        ({"reads_s": {"min": 1}}, "`reads_s.max` is `None`; valid: a number"),
        ({"reads_s": 3}, "`reads_s` is `3`; valid: a mapping with max, min"),
        ({"reads_s": {"min": 0, "max": float("inf")}}, "valid: 0 ≤ min ≤ max"),
        ({"reads_s": {"min": 10**400, "max": 1}}, "`reads_s.min` is out of all range; valid: a number of at most"),
        ({"error_rate": 10**400}, "`error_rate` is out of all range"),
        ({"error_rate": "often"}, "`error_rate` is `often`; valid: a number"),
        ({"seed": "x"}, "`seed` is `x`; valid: a whole number"),
        ({"seed": True}, "`seed` is `True`; valid: a whole number"),
        ({"approver": ["a", "b"]}, "valid: the name of one approver"),
    ],
)
def test_bad_habits_are_refused_with_what_would_be_valid(change, message):
    with pytest.raises(ValueError, match=message):
        parse_habits({**HABITS, **change})


def test_an_approver_nobody_knows_is_refused_with_who_is_known(tmp_path, capfd):
    (tmp_path / "tokens.json").write_text('{"operator": "t1", "operator_2": "t2"}')
    habits = tmp_path / "habits.yaml"
    habits.write_text("approver: nobody")
    assert approve(habits, "http://127.0.0.1:1", tmp_path) == 2
    said = " ".join(capfd.readouterr().err.split())
    assert "`nobody` has no token" in said
    assert "valid as `approver`: an operator among operator, operator_2" in said


@pytest.mark.parametrize(("made", "why"), [(False, "no such file or directory"), (True, "is a directory")])
def test_habits_that_are_no_file_are_refused_with_what_would_be_valid(tmp_path, capfd, made, why):
    habits = tmp_path / "habits.yaml"
    if made:
        habits.mkdir()
    assert approve(habits, "http://127.0.0.1:1", tmp_path, "t") == 2
    said = " ".join(capfd.readouterr().err.split())
    assert f"no approver: `{habits}` cannot be read: {why}; valid is a YAML file of habits" in said


def test_tokens_that_are_no_file_are_refused_with_what_would_be_valid(tmp_path, capfd):
    (tmp_path / "habits.yaml").write_text("approver: operator")
    (tmp_path / "tokens.json").mkdir()
    assert approve(tmp_path / "habits.yaml", "http://127.0.0.1:1", tmp_path) == 2
    said = " ".join(capfd.readouterr().err.split())
    valid = "valid is the file as a server wrote it"
    assert f"`{tmp_path / 'tokens.json'}` cannot be read: is a directory; {valid}" in said


@pytest.mark.parametrize(("token", "url", "said"), [("t", "nourl", "url `nourl`"), ("\n", "http://x", "token: ")])
def test_an_approver_who_cannot_ask_anybody_is_refused(tmp_path, capfd, token, url, said):
    (tmp_path / "tokens.json").write_text(json.dumps({"operator": token}))
    habits = tmp_path / "habits.yaml"
    habits.write_text("approver: operator")
    assert approve(habits, url, tmp_path) == 2
    assert f"no approver: {said}" in capfd.readouterr().err
    (tmp_path / "server.json").write_text(json.dumps({"url": url}))  # where the server runs, the directory says
    assert approve(habits, None, tmp_path, token) == 2
    assert f"no approver: {said}" in capfd.readouterr().err
    (tmp_path / "tokens.json").write_text("{")
    assert approve(habits, url, tmp_path) == 2
    assert f"`{tmp_path / 'tokens.json'}` cannot be read" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"approver: operator\nrules: [1", r"habits\.yaml:2: not readable as YAML: "),
        (b"approver: operator\n\trules: []", r"habits\.yaml:2: not readable as YAML: "),
        (b"approver: \xff", r"habits\.yaml: not readable as YAML: "),
        (b"approver: \x01", r"habits\.yaml: not readable as YAML: "),
        (b"rules: " + b"[" * 5000, r"habits\.yaml: not readable as YAML: it is nested too deep"),
        (b"approver: 2024-99-99", r"habits\.yaml: not readable as YAML: "),
        (b"", r"habits\.yaml is `None`; valid: a mapping"),
    ],
)
def test_a_habits_file_that_cannot_be_read_is_named(tmp_path: Path, content: bytes, message: str):
    file = tmp_path / "habits.yaml"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load_habits(file)


RUNTIME = Path(__file__).parents[2] / "docs" / "design" / "runtime.md"


@pytest.mark.parametrize("text", [str(inspect.getdoc(approver)), RUNTIME.read_text()], ids=["help", "page"])
def test_the_explained_habits_can_be_used_and_leave_out_no_key(text):
    found = re.search(r"^( *)approver: operator .*\n(?:\1.*\n)+?(?=\n|```)", text, re.MULTILINE)
    shown = parse_habits(yaml.safe_load(found.group()))
    assert shown.rules[0].edit == {"force_n": 40}
    assert [rule.decision for rule in shown.rules] == ["approve", "approve"]
    for word in ("reads_s", "error_rate", "seed", "deny", "ignore", "capability", "risk", "kind", "agent"):
        assert re.search(rf"\b{word}\b", text), word


def test_habits_that_are_no_mapping_are_refused():
    with pytest.raises(ValueError, match="habits is `3`; valid: a mapping with approver"):
        parse_habits(3)


@pytest.mark.anyio
async def test_answers_each_escalation_once_with_its_digest_and_edit():
    def answer(turn: Turn):
        if turn.method == "GET":
            return 200, {"items": [escalation()], "next": None}
        return 200, escalation(status="approved")

    answered = asyncio.Event()
    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            approver = ScriptedApprover(client, parse_habits(HABITS), on_answer=lambda _e, _a: answered.set())
            task = asyncio.create_task(approver.run())
            await asyncio.wait_for(answered.wait(), 5)
            polls = len(server.turns)
            while len(server.turns) < polls + 2:
                await asyncio.sleep(0.01)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    posts = [turn.body for turn in server.turns if turn.method == "POST"]
    assert posts == [{"decision": "approve", "digest": "sha256:a", "params": {"object_id": "mug_1", "force_n": 40}}]


async def _answered(answer: Callable[[Turn], tuple[int, object]], habits: dict[str, object]) -> list[Turn]:
    """Let an approver answer until it has given its first answer that counts; return what it posted."""
    given = asyncio.Event()
    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            approver = ScriptedApprover(client, parse_habits(habits), on_answer=lambda _e, _a: given.set())
            task = asyncio.create_task(approver.run())
            await asyncio.wait_for(given.wait(), 5)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    return [turn for turn in server.turns if turn.method == "POST"]


@pytest.mark.anyio
async def test_questions_it_ignores_hide_no_older_one():
    ignored = [escalation(id=f"esc_{place}", capability="operate_tool") for place in range(2, 52)]

    def answer(turn: Turn):
        if turn.method == "POST":
            return 200, escalation(status="approved")
        if "cursor=older" in turn.path:
            return 200, {"items": [escalation()], "next": None}
        return 200, {"items": ignored, "next": "older"}

    assert [turn.path for turn in await _answered(answer, HABITS)] == ["/v1/escalations/esc_1/resolve"]


@pytest.mark.anyio
async def test_answers_again_once_the_cell_that_was_away_may_be_back():
    away = iter([True, False])

    def answer(turn: Turn):
        if turn.method == "GET":
            return 200, {"items": [escalation(kind="session")], "next": None}
        if next(away):
            return 409, {"code": "cell_offline", "detail": "the cell is away"}
        return 200, escalation(status="approved")

    posts = await _answered(answer, HABITS)
    assert [turn.body for turn in posts] == [{"decision": "approve", "digest": "sha256:a"}] * 2


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("code", "decision", "became", "told"),
    [
        ("already_resolved", "approve", {"status": "approved", "approvals": [{"by": "operator"}]}, ["approved"]),
        ("already_approved", "approve", {"status": "pending", "approvals": [{"by": "operator"}]}, ["pending"]),
        ("already_resolved", "approve", {"status": "approved", "approvals": [{"by": "operator_2"}]}, []),
        ("already_resolved", "approve", {"status": "denied", "approvals": [], "denial": {"by": "operator"}}, []),
        ("already_resolved", "deny", {"status": "denied", "approvals": [], "denial": {"by": "operator"}}, ["denied"]),
        ("already_resolved", "deny", {"status": "denied", "approvals": [], "denial": {"by": "operator_2"}}, []),
        ("escalation_expired", "approve", {"status": "expired", "approvals": [], "denial": None}, []),
    ],
)
async def test_an_answer_whose_reply_was_lost_is_told_as_its_own(code, decision, became, told):
    lost = iter([True])
    asked: list[str] = []
    given: list[str] = []

    def answer(turn: Turn):
        asked.append(turn.path)
        if turn.method == "POST":
            return None if next(lost, False) else (409, {"code": code, "detail": "the escalation is answered"})
        if turn.path == "/v1/escalations/esc_1":
            return 200, escalation(**became)
        return 200, {"items": [escalation()] if len(asked) == 1 else [], "next": None}

    habits = parse_habits({**HABITS, "rules": [{"match": {}, "decision": decision}]})
    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            approver = ScriptedApprover(client, habits, on_answer=lambda _e, a: given.append(a.status))
            task = asyncio.create_task(approver.run())
            while sum(path.endswith("/resolve") for path in asked) < 2 or "?" not in asked[-1]:
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.2)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert given == told


@pytest.mark.anyio
async def test_approves_the_constrained_question_when_policy_constrains_its_edit():
    asked = {"now": escalation(effective={"object_id": "mug_1", "force_n": 10}, status="pending")}

    def answer(turn: Turn):
        if turn.method == "GET":
            return 200, {"items": [asked["now"]] if asked["now"]["status"] == "pending" else [], "next": None}
        edit = turn.body.get("params")
        asked["now"] = (
            {**asked["now"], "effective": {**edit, "force_n": 20}, "digest": "sha256:b"}
            if edit
            else {**asked["now"], "status": "approved"}
        )
        return 200, asked["now"]

    told: list[tuple[str, str]] = []
    approved = asyncio.Event()

    def note(_asked: dict[str, object], given: Answer) -> None:
        told.append((given.decision, given.status))
        if given.status == "approved":
            approved.set()

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            task = asyncio.create_task(ScriptedApprover(client, parse_habits(HABITS), on_answer=note).run())
            await asyncio.wait_for(approved.wait(), 5)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert told == [("approve", "pending"), ("approve", "approved")]
    assert [turn.body for turn in server.turns if turn.method == "POST"] == [
        {"decision": "approve", "digest": "sha256:a", "params": {"object_id": "mug_1", "force_n": 40}},
        {"decision": "approve", "digest": "sha256:b"},
    ]


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("code", "since"),
    [
        ("cell_offline", {}),
        ("digest_mismatch", {"digest": "sha256:b", "effective": {"object_id": "mug_1", "force_n": 90}}),
    ],
)
async def test_approves_nothing_less_than_its_edit_after_one_that_was_not_taken(code: str, since: dict[str, object]):
    """The question that waits on is as it was asked, or as somebody else edited it: nobody has taken the edit."""
    refused = iter([True])
    asked = {"now": escalation()}

    def answer(turn: Turn):
        if turn.method == "GET":
            return 200, {"items": [asked["now"]], "next": None}
        if next(refused, False):
            asked["now"] = escalation(**since)
            return 409, {"code": code, "detail": "not now"}
        return 200, escalation(status="approved")

    posts = await _answered(answer, HABITS)
    assert [turn.body["params"] for turn in posts] == [{"object_id": "mug_1", "force_n": 40}] * 2


@pytest.mark.anyio
async def test_approves_what_policy_made_of_its_edit_although_the_reply_was_lost():
    """It edits once more, to the same end: what it then approves is what its edit has come to."""
    cut = {"object_id": "mug_1", "force_n": 20}
    asked = {"now": escalation(status="pending")}
    lost = iter([True])

    def answer(turn: Turn):
        if turn.method == "GET":
            return 200, {"items": [asked["now"]], "next": None}
        if turn.body["digest"] != asked["now"]["digest"]:
            return 409, {"code": "digest_mismatch", "detail": "that is not what is asked"}
        if "params" not in turn.body:
            asked["now"] = {**asked["now"], "status": "approved"}
            return 200, asked["now"]
        asked["now"] = escalation(status="pending", digest="sha256:b", effective=cut)
        return None if next(lost, False) else (200, asked["now"])

    approved = asyncio.Event()
    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            approver = ScriptedApprover(
                client,
                parse_habits(HABITS),
                on_answer=lambda _e, given: approved.set() if given.status == "approved" else None,
            )
            task = asyncio.create_task(approver.run())
            await asyncio.wait_for(approved.wait(), 5)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert asked["now"]["effective"] == cut


@pytest.mark.anyio
async def test_leaves_where_no_server_of_this_kind_answers():
    with serve(lambda _turn: (200, [])) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Problem, match=r"unreadable_answer: `\[\]` is no JSON document; valid is the URL"):
                await ScriptedApprover(client, parse_habits(HABITS)).run()


@pytest.mark.anyio
async def test_leaves_with_the_servers_own_words_when_it_is_refused():
    refusal = {"code": "token_invalid", "detail": "the token is not known"}
    with serve(lambda _turn: (401, refusal)) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Problem, match="token_invalid: the token is not known"):
                await ScriptedApprover(client, parse_habits(HABITS)).run()


@pytest.mark.anyio
async def test_leaves_with_the_servers_own_words_when_an_answer_is_refused():
    def answer(turn: Turn):
        if turn.method == "GET":
            return 200, {"items": [escalation(), escalation(id="esc_2")], "next": None}
        return 403, {"code": "role_forbidden", "detail": "not this role"}

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            with pytest.raises(Problem, match="role_forbidden: not this role"):
                await ScriptedApprover(client, parse_habits(HABITS)).run()


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("status", "code"), [(422, "params_invalid"), (422, "malformed_json"), (409, "edit_refused"), (403, "own_proposal")]
)
async def test_leaves_a_question_that_its_edit_does_not_fit_and_answers_the_others(status, code):
    pending = [escalation(id="esc_1"), escalation(id="esc_2", risk="high")]

    def answer(turn: Turn):
        if turn.method == "GET":
            return 200, {"items": pending, "next": None}
        if "params" in turn.body:
            pending[0] = escalation(id="esc_1", digest="sha256:b")  # put anew, say under another profile
            return status, {"code": code, "detail": "`force_n` does not fit"}
        return 200, escalation(status="denied")

    given: list[str] = []
    left: list[tuple[str, str]] = []
    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            approver = ScriptedApprover(
                client, parse_habits(HABITS),
                on_answer=lambda asked, _: given.append(asked["id"]),
                on_skip=lambda asked, why: left.append((asked["digest"], str(why))),
            )  # fmt: skip
            task = asyncio.create_task(approver.run())
            while not given or len(left) < 2:
                await asyncio.sleep(0.01)
                assert not task.done(), task.exception()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert given == ["esc_2"]
    assert [digest for digest, _ in left] == ["sha256:a", "sha256:b"]
    assert left[0][1] == f"{status} {code}: `force_n` does not fit"
    edits = [turn.body["params"] for turn in server.turns if turn.method == "POST" and "esc_1" in turn.path]
    assert edits == [{"object_id": "mug_1", "force_n": 40}] * 2


@pytest.mark.anyio
async def test_leaves_a_question_whose_edit_cannot_be_sent():
    habits = parse_habits({**HABITS, "rules": [{"decision": "approve", "edit": {"force_n": float("nan")}}]})
    left = asyncio.Event()
    with serve(lambda _turn: (200, {"items": [escalation()], "next": None})) as server:
        async with AsyncReinsClient(server.url, "t") as client:
            approver = ScriptedApprover(client, habits, on_skip=lambda _asked, _why: left.set())
            task = asyncio.create_task(approver.run())
            await asyncio.wait_for(left.wait(), 5)
            assert not task.done()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert {turn.method for turn in server.turns} == {"GET"}


def test_says_which_question_was_left_and_why():
    why = Problem(422, "params_invalid", "`farce_n` is unknown")
    said = f"operate_tool esc_1: left to somebody else, the answer was not taken: {why}"
    assert skipped({"id": "esc_1", "capability": "operate_tool"}, why) == said


def test_says_what_became_of_the_question_beside_what_was_answered():
    answer = Answer(escalation="esc_1", decision="approve", erred=False, edit={}, status="pending")
    asked = {"id": "esc_1", "capability": "operate_tool"}
    assert answered(asked, answer) == "operate_tool esc_1: approve, now pending"
