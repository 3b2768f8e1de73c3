from __future__ import annotations

import asyncio
import errno
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from starlette.datastructures import Headers

from app import clock
from app.api.auth import (
    CELL_TOKEN_FILE,
    PRINCIPALS_FILE,
    TOKENS_FILE,
    Principals,
    PrincipalsUnreadable,
    issue_token,
    issued,
    open_principals,
    withdraw_tokens,
)
from app.api.problems import Problem
from app.audit.errors import RecordDamaged
from app.governance.model import Role
from tests.api.conftest import House


def bearer(token: str) -> Headers:
    return Headers({"authorization": f"Bearer {token}"})


def tokens(folder: Path) -> dict[str, str]:
    return json.loads((folder / TOKENS_FILE).read_text())


def test_first_start_writes_tokens_that_only_their_owner_may_read(tmp_path: Path) -> None:
    open_principals(tmp_path)
    assert sorted(tokens(tmp_path)) == ["agent", "auditor", "engineer", "operator", "operator_2"]
    for name in (TOKENS_FILE, CELL_TOKEN_FILE, PRINCIPALS_FILE):
        assert stat.S_IMODE((tmp_path / name).stat().st_mode) == 0o600


def test_tokens_are_not_kept_where_principals_are(tmp_path: Path) -> None:
    open_principals(tmp_path)
    kept = (tmp_path / PRINCIPALS_FILE).read_text()
    assert not any(token in kept for token in tokens(tmp_path).values())


@pytest.mark.parametrize(
    ("key", "name", "role"),
    [
        ("agent", "planner", Role.AGENT),
        ("operator", "operator", Role.OPERATOR),
        ("operator_2", "operator_2", Role.OPERATOR),
        ("engineer", "engineer", Role.ENGINEER),
        ("auditor", "auditor", Role.AUDITOR),
    ],
)
def test_each_first_token_stands_for_its_principal(tmp_path: Path, key: str, name: str, role: Role) -> None:
    principal = open_principals(tmp_path).authenticate(bearer(tokens(tmp_path)[key]))
    assert (principal.name, principal.role) == (name, role)


def test_cells_have_a_token_of_their_own(tmp_path: Path) -> None:
    principals = open_principals(tmp_path)
    assert principals.authenticate(bearer((tmp_path / CELL_TOKEN_FILE).read_text().strip())).role is Role.CELL


def test_a_second_start_keeps_the_tokens(tmp_path: Path) -> None:
    open_principals(tmp_path)
    first = tokens(tmp_path)
    open_principals(tmp_path).authenticate(bearer(first["agent"]))
    assert tokens(tmp_path) == first


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({}, "token_missing"),
        ({"authorization": ""}, "token_missing"),
        ({"authorization": "Bearer"}, "token_missing"),
        ({"authorization": "Bearer "}, "token_missing"),
        ({"authorization": "Basic b3BlcmF0b3I6"}, "token_missing"),
        ({"authorization": "Bearer nobody"}, "token_invalid"),
        ({"authorization": "Bearer ünknown"}, "token_invalid"),
    ],
)
def test_refuses_whoever_has_no_token_that_is_known(tmp_path: Path, headers: dict[str, str], code: str) -> None:
    with pytest.raises(Problem) as refused:
        open_principals(tmp_path).authenticate(Headers(headers))
    assert (refused.value.status, refused.value.code) == (401, code)
    assert refused.value.headers["WWW-Authenticate"].startswith('Bearer realm="reins"')


def test_refuses_a_token_whose_time_is_over(tmp_path: Path) -> None:
    open_principals(tmp_path)
    token = issue_token(tmp_path, name="visitor", role=Role.AUDITOR, ttl_s=-1.0)
    with pytest.raises(Problem) as refused:
        open_principals(tmp_path).authenticate(bearer(token))
    assert (refused.value.status, refused.value.code) == (401, "token_expired")


def test_a_token_holds_until_its_time_is_over(tmp_path: Path) -> None:
    open_principals(tmp_path)
    token = issue_token(tmp_path, name="visitor", role=Role.AUDITOR, ttl_s=60.0)
    assert open_principals(tmp_path).authenticate(bearer(token)).name == "visitor"


def test_no_token_holds_longer_because_the_clock_is_put_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_principals(tmp_path)
    token = issue_token(tmp_path, name="gus", role=Role.OPERATOR, ttl_s=60.0)
    principals = Principals(tmp_path / PRINCIPALS_FILE)
    wall_s, monotonic_s = clock.wall_s(), clock.monotonic_s()
    monkeypatch.setattr(clock, "wall_s", lambda: wall_s - 7200.0)
    monkeypatch.setattr(clock, "monotonic_s", lambda: monotonic_s + 50.0)
    issue_token(tmp_path, name="another", role=Role.AGENT)  # so that the file is read again
    assert principals.authenticate(bearer(token)).name == "gus"
    monkeypatch.setattr(clock, "monotonic_s", lambda: monotonic_s + 61.0)
    with pytest.raises(Problem) as refused:
        principals.authenticate(bearer(token))
    assert refused.value.code == "token_expired"
    assert not principals.has(token)
    assert not principals.may_give("gus"), "nor does what they approved count"


def test_a_running_server_learns_of_a_new_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    principals = open_principals(tmp_path)
    token = issue_token(tmp_path, name="second", role=Role.AGENT)
    later_s = clock.monotonic_s() + 2.0
    monkeypatch.setattr(clock, "monotonic_s", lambda: later_s)
    assert principals.authenticate(bearer(token)).name == "second"


def test_what_was_read_last_holds_while_the_file_is_broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    principals = open_principals(tmp_path)
    (tmp_path / PRINCIPALS_FILE).write_text("{")
    later_s = clock.monotonic_s() + 2.0
    monkeypatch.setattr(clock, "monotonic_s", lambda: later_s)
    assert principals.authenticate(bearer(tokens(tmp_path)["operator"])).role is Role.OPERATOR


@pytest.mark.parametrize(("how", "why"), [("damaged", "line 1"), ("gone", "No such file")])
def test_a_file_that_cannot_be_read_is_said_once_until_it_can(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, how: str, why: str
) -> None:
    principals = open_principals(tmp_path)
    listed, kept = tmp_path / PRINCIPALS_FILE, tmp_path / "kept.json"
    assert principals.trouble() is None
    listed.rename(kept)
    if how == "damaged":
        listed.write_text('{"principals": [')
    for _ in range(3):
        principals.look()
        said = principals.trouble() or ""
        assert said.startswith(f"`{PRINCIPALS_FILE}`: ")
        assert why in said
        assert str(tmp_path) not in said
    assert len(caplog.messages) == 1
    assert str(listed) in caplog.messages[0]
    kept.replace(listed)  # the very file that was read before
    for _ in range(3):
        principals.look()
        assert principals.trouble() is None
    assert len(caplog.messages) == 2


@pytest.mark.anyio
async def test_a_withdrawal_that_breaks_the_file_stands_in_healthz_until_it_can_be_read(house: House) -> None:
    async def broken(client: httpx.AsyncClient) -> str | None:
        health = (await client.get("/healthz")).json()
        assert (health["status"] == "degraded") is bool(health["broken"])
        return health["broken"].get("principals")

    listed = house.folder / PRINCIPALS_FILE
    everyone = listed.read_bytes()
    async with house.client() as client, asyncio.timeout(30):
        assert await broken(client) is None
        listed.write_bytes(everyone.replace(b'"engineer"', b'"engineer', 1))
        try:
            while (said := await broken(client)) is None:
                await asyncio.sleep(0.02)
        finally:
            listed.write_bytes(everyone)
        assert f"`{PRINCIPALS_FILE}`: line " in said
        assert house.knows("engineer"), "a typo locks nobody out"
        while await broken(client) is not None:
            await asyncio.sleep(0.02)


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        "{}",
        '{"principals": [1]}',
        '{"principals": [{"name": "x", "role": "king", "sha256": "00", "expires_at": null}]}',
        '{"principals": [{"name": "x", "role": "agent", "sha256": "zz", "expires_at": null}]}',
        '{"principals": [{"name": "x", "role": "agent", "sha256": "00", "expires_at": "tomorrow"}]}',
        '{"principals": [{"name": "x", "role": "agent", "sha256": "00"}]}',
        '{"principals": [{"name": "x", "role": "agent", "sha256": "00", "expires_at": 0}]}',
        '{"principals": [{"name": "x", "role": "agent", "sha256": "00", "expires_at": "9999-12-31T23:59:59-23:00"}]}',
        '{"principals": [{"name": "server", "role": "operator", "sha256": "00", "expires_at": null}]}',
        '{"principals": [{"name": "governance", "role": "agent", "sha256": "00", "expires_at": null}]}',
    ],
)
def test_does_not_start_on_principals_it_cannot_read(tmp_path: Path, content: str) -> None:
    (tmp_path / PRINCIPALS_FILE).write_text(content)
    with pytest.raises(PrincipalsUnreadable, match=PRINCIPALS_FILE):
        open_principals(tmp_path)
    with pytest.raises(PrincipalsUnreadable, match=PRINCIPALS_FILE):
        issue_token(tmp_path, name="maria", role=Role.OPERATOR)
    with pytest.raises(PrincipalsUnreadable, match=PRINCIPALS_FILE):
        withdraw_tokens(tmp_path, "maria")


@pytest.mark.parametrize("role", sorted(set(Role) - {Role.OPERATOR, Role.CELL}))
def test_nobody_but_an_operator_or_the_cell_itself_stands_at_one(tmp_path: Path, role: Role) -> None:
    open_principals(tmp_path)
    with pytest.raises(ValueError, match=f"valid is none with `{role}`"):
        issue_token(tmp_path, name="maria", role=role, station="workcell-1")


@pytest.mark.parametrize("station", ["", "workcell 1", "Workcell-1"])
def test_refuses_a_station_that_no_cell_can_be(tmp_path: Path, station: str) -> None:
    open_principals(tmp_path)
    with pytest.raises(ValueError, match="the station"):
        issue_token(tmp_path, name="maria", role=Role.OPERATOR, station=station)


@pytest.mark.parametrize("name", ["", "x" * 129, "a\nb", " operator", "operator "])
def test_refuses_to_issue_a_token_for_no_name(tmp_path: Path, name: str) -> None:
    open_principals(tmp_path)
    with pytest.raises(ValueError, match="principal name"):
        issue_token(tmp_path, name=name, role=Role.AGENT)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("server", "a machine"),
        ("Server", "a machine"),
        ("governance", "a machine"),
        ("Governance", "a machine"),
        ("workcell-7", "a machine"),
        ("WorkCell-7", "a machine"),
        ("grant:gr_01M8KMFVGCZ1DEF8SQW28MZC6R", "a standing grant"),
        ("Grant: lena", "a standing grant"),
        ("operator", "the role `operator` already"),
        ("Operator", "reads like `operator`"),
        ("\N{FULLWIDTH LATIN SMALL LETTER O}perator", "reads like `operator`"),
    ],
)
def test_refuses_a_token_for_a_name_that_means_somebody_else(tmp_path: Path, name: str, said: str) -> None:
    open_principals(tmp_path)
    (tmp_path / "cells" / "workcell-7").mkdir(parents=True)
    before = (tmp_path / PRINCIPALS_FILE).read_bytes()
    with pytest.raises(ValueError, match=said):
        issue_token(tmp_path, name=name, role=Role.AGENT)
    assert (tmp_path / PRINCIPALS_FILE).read_bytes() == before


@pytest.mark.anyio
async def test_refuses_a_token_in_the_name_of_a_cell_that_joined(house: House) -> None:
    async with house.cell("workcell-9"):
        pass
    assert not (house.folder / "cells" / "workcell-9").exists(), "nobody here has started it"
    for name in ("workcell-9", "Workcell-9"):
        with pytest.raises(ValueError, match="a machine"):
            issue_token(house.folder, name=name, role=Role.OPERATOR)
    assert issue_token(house.folder, name="workcell-9", role=Role.CELL)


def test_refuses_a_token_while_nobody_knows_which_cells_there_are(tmp_path: Path) -> None:
    open_principals(tmp_path)
    (tmp_path / "reins.db").write_bytes(b"no database" * 500)
    with pytest.raises(RecordDamaged, match=r"reins\.db"):
        issue_token(tmp_path, name="late", role=Role.AGENT)
    assert issue_token(tmp_path, name="cell", role=Role.CELL), "a cell's token is for no name"


def test_nobody_is_named_as_somebody_else_of_the_same_role_reads(tmp_path: Path) -> None:
    open_principals(tmp_path)
    issue_token(tmp_path, name="Lena  M", role=Role.OPERATOR)
    for name in ("lena M", "Lena M"):
        with pytest.raises(ValueError, match="reads like `Lena  M`"):
            issue_token(tmp_path, name=name, role=Role.OPERATOR)
    assert issue_token(tmp_path, name="Lena  M", role=Role.OPERATOR)


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_principals(tmp_path)
    before = (tmp_path / PRINCIPALS_FILE).read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        issue_token(tmp_path, name="late", role=Role.AGENT)
    assert (tmp_path / PRINCIPALS_FILE).read_bytes() == before
    assert Principals(tmp_path / PRINCIPALS_FILE)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(f".{PRINCIPALS_FILE}.")]


def test_whoever_has_an_operators_token_left_may_give(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_principals(tmp_path)
    issue_token(tmp_path, name="gus", role=Role.OPERATOR, ttl_s=60.0)
    issue_token(tmp_path, name="gus", role=Role.OPERATOR, ttl_s=120.0)
    principals = Principals(tmp_path / PRINCIPALS_FILE)
    principals.keep_roll()  # nobody is in the record yet
    assert [principals.may_give(name) for name in ("gus", "operator", "engineer", "nobody")] == [
        True,
        True,
        False,
        False,
    ]
    now_s = clock.wall_s()
    monkeypatch.setattr(clock, "wall_s", lambda: now_s + 90.0)
    assert principals.may_give("gus"), "one of their tokens holds still"
    monkeypatch.setattr(clock, "wall_s", lambda: now_s + 130.0)
    assert not principals.may_give("gus")


def test_whoever_has_an_engineers_token_left_may_vouch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_principals(tmp_path)
    issue_token(tmp_path, name="eva", role=Role.ENGINEER, ttl_s=60.0)
    principals = Principals(tmp_path / PRINCIPALS_FILE)
    assert [principals.may_vouch(name) for name in ("eva", "engineer", "operator", "nobody")] == [
        True,
        True,
        False,
        False,
    ]
    now_s = clock.wall_s()
    monkeypatch.setattr(clock, "wall_s", lambda: now_s + 90.0)
    assert not principals.may_vouch("eva")


def test_older_tokens_are_withdrawn_while_the_newest_holds(tmp_path: Path) -> None:
    open_principals(tmp_path)
    first = json.loads((tmp_path / TOKENS_FILE).read_text())["agent"]
    newest = [issue_token(tmp_path, name="planner", role=Role.AGENT) for _ in range(2)][-1]
    assert withdraw_tokens(tmp_path, "planner", but_newest=True) == 2
    principals = open_principals(tmp_path)
    assert (principals.has(first), principals.has(newest)) == (False, True)
    assert withdraw_tokens(tmp_path, "planner", but_newest=True) == 0
    assert withdraw_tokens(tmp_path, "planner") == 1


def test_a_token_is_withdrawn_on_a_full_disk_again_and_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_principals(tmp_path)
    sync = os.fsync
    for name in ("auditor", "engineer"):
        refusals = iter((True, False, False, False, False))  # the draft alone: what it would replace makes room

        def full(descriptor: int, refusals: Iterator[bool] = refusals) -> None:
            if next(refusals):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            sync(descriptor)

        monkeypatch.setattr(os, "fsync", full)
        assert withdraw_tokens(tmp_path, name) == 1
    monkeypatch.undo()
    assert {one.principal.name for one in issued(tmp_path)} == {"planner", "operator", "operator_2", "cell"}
