"""What the log says of versions of policy, and what their table must say of them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import orjson
import pytest

from app.audit import versions
from app.audit.event import EventDraft, RowWrite
from app.audit.places import Places
from app.audit.reader import Reader, Row
from app.audit.store import AuditStore
from app.audit.versions import KEPT_ACTIVATIONS, Told, told_of, version_problems
from app.governance.bundle import digest
from tests.audit.conftest import TIME, draft

pytestmark = pytest.mark.anyio
ONE = "sha256:1"
WORD = {"by": "erin", "at": TIME, "why": "faster", "against": "sha256:0"}
ACTIVATION = {"by": ["emil", "erin"], "why": "faster", "former": "sha256:0", "direction": "loosens"}


def said(op: str, actor: str = "erin", **more: Any) -> EventDraft:
    return draft("policy_version", None, actor, op=op, policy_version=ONE, **more)


def entered(**activation: Any) -> EventDraft:
    return draft("policy_activated", None, "erin", policy_version=ONE, **activation)


def kept(**changes: Any) -> RowWrite:
    document = {
        "digest": ONE,
        "by": "erin",
        "proved": "all of it",
        "doubt": "",
        "awaiting": None,
        "promises": None,
        "activations": [],
        **changes,
    }
    values = {"id": ONE, "status": "candidate", "document": orjson.dumps(document)}
    return RowWrite(table="policies", values={**values, "created_at": TIME, "updated_at": TIME})


BROUGHT = said("proposed", proved="all of it", promises=None)


@pytest.fixture
async def reader(store: AuditStore, data: Path) -> AsyncIterator[Reader]:
    reader = Reader(Places(data).database)
    yield reader
    reader.close()


async def told(store: AuditStore, *drafts: EventDraft) -> Told:
    """Return what a log of these events says of the version."""
    await store.append(drafts)
    return told_of(await store.events(limit=100))[ONE]


async def test_who_speaks_of_a_version_first_brought_it(store: AuditStore) -> None:
    known = await told(store, said("offered", "server", promises="order: []\n"), said("proved", "erin", proved="all"))
    assert known == Told("server", promised=True, promises="order: []\n", proved="all")


async def test_what_earlier_releases_did_not_say_of_promises_is_not_compared(store: AuditStore, reader: Reader) -> None:
    assert await told(store, said("offered", "server")) == Told("server")
    await store.append([], [kept(by="server", proved="", promises="order: []\n")])
    assert version_problems(reader, limit=5) == []


@pytest.mark.parametrize("verdict", ["refuted", "undecided"])
async def test_a_verdict_stands_until_another_or_other_promises(store: AuditStore, verdict: str) -> None:
    assert (await told(store, said("offered"), said(verdict, promises=None))).doubt == verdict
    assert await told(store, said("proved", proved="all", promises=None)) == Told("erin", True, None, "all")
    assert await told(store, entered(promises="order: []\n")) == Told("erin", True, "order: []\n", in_force=True)


async def test_a_word_waits_until_it_comes_into_force(store: AuditStore) -> None:
    assert (await told(store, BROUGHT, said("awaiting_second", awaiting=WORD))).awaiting == WORD
    known = await told(store, entered(**ACTIVATION))
    assert (known.awaiting, known.in_force, known.entered) == (None, True, (ACTIVATION,))


async def test_rows_that_say_what_the_log_says_are_no_problem(store: AuditStore, reader: Reader) -> None:
    by_a_start = {"at": TIME, "by": ["server"], "why": "the first start", "former": None, "direction": None}
    await store.append([BROUGHT], [kept()])
    assert version_problems(reader, limit=5) == []
    both = [{"at": TIME, **ACTIVATION}, by_a_start]
    await store.append([entered(**ACTIVATION), entered()], [kept(activations=both)])
    assert version_problems(reader, limit=5) == []


async def test_the_files_that_are_kept_are_those_of_their_digest(store: AuditStore, reader: Reader) -> None:
    files = {"organization.yaml": "rules: []\n"}
    row = {"digest": digest(files), "created_at": TIME}
    for altered in (
        {"organization.yaml": "rules: [ ]\n"},
        {"other.yaml": "rules: []\n"},
        {"organization.yaml": 1},
        [1],
        None,
    ):
        await store.append([], [RowWrite(table="policy_files", values={**row, "files": orjson.dumps(altered)})])
        assert version_problems(reader, limit=5) == [
            f"`{digest(files)}`: the files that are kept of it are not those of its digest"
        ]
    await store.append([], [RowWrite(table="policy_files", values={**row, "files": orjson.dumps(files)})])
    assert version_problems(reader, limit=5) == []


async def test_a_row_keeps_the_newest_activations(store: AuditStore, reader: Reader) -> None:
    all_of_them = [{**ACTIVATION, "why": f"{number}"} for number in range(KEPT_ACTIVATIONS + 2)]
    newest = [{"at": TIME, **one} for one in all_of_them[2:]]
    await store.append([BROUGHT, *(entered(**one) for one in all_of_them)], [kept(activations=newest)])
    assert version_problems(reader, limit=5) == []
    await store.append([], [kept(activations=[{"at": TIME, **all_of_them[0]}, *newest[1:]])])
    assert version_problems(reader, limit=5) == [
        f"`{ONE}`: `activations` in the table `policies` is not what the log says"
    ]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"by": "emil"}, "`by`"),
        ({"proved": "more", "doubt": "refuted"}, "`proved`, `doubt`"),
        ({"awaiting": WORD}, "`awaiting`"),
        ({"promises": "order: []\n"}, "`promises`"),
        ({"activations": [{"at": TIME, **ACTIVATION}]}, "`activations`"),
        ({"activations": [{"at": TIME, **ACTIVATION, "by": ["server"]}]}, "`activations`"),
        ({"activations": [{"at": TIME}]}, "`activations`"),
        ({"activations": None}, "`activations`"),
    ],
)
async def test_names_what_a_row_says_otherwise(
    store: AuditStore, reader: Reader, changes: dict[str, Any], named: str
) -> None:
    await store.append([BROUGHT], [kept(**changes)])
    assert version_problems(reader, limit=5) == [f"`{ONE}`: {named} in the table `policies` is not what the log says"]


@pytest.mark.parametrize("document", [b"no JSON", b"[]", b"{}"])
async def test_a_row_that_holds_no_version_is_named(store: AuditStore, reader: Reader, document: bytes) -> None:
    row = kept()
    await store.append([BROUGHT], [RowWrite(table="policies", values={**row.values, "document": document})])
    assert version_problems(reader, limit=5) == [f"`{ONE}`: what the table `policies` holds is no document of it"]


async def test_a_row_without_an_event_and_an_event_without_a_row_are_named(store: AuditStore, reader: Reader) -> None:
    await store.append([], [kept()])
    assert version_problems(reader, limit=5) == [f"`{ONE}`: the table `policies` knows it, the log does not"]
    await store.append([BROUGHT, draft("policy_activated", None, policy_version="sha256:2")])
    assert version_problems(reader, limit=5) == ["`sha256:2`: the log knows it, the table `policies` does not"]


async def test_a_row_that_changes_while_the_log_is_read_waits_for_the_next_time(
    store: AuditStore, reader: Reader, monkeypatch: pytest.MonkeyPatch
) -> None:
    await store.append([BROUGHT], [kept()])
    rows, seen = reader.rows, list[list[Row]]()

    def changing(table: str) -> list[Row]:
        found = rows(table) if seen else [{**row, "updated_at": "before"} for row in rows(table)]
        seen.append(found)
        return found

    monkeypatch.setattr(reader, "rows", changing)
    await store.append([], [kept(by="emil")])
    assert version_problems(reader, limit=5) == []


async def test_reads_the_log_page_by_page(store: AuditStore, reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions, "PAGE", 1)
    await store.append([BROUGHT, said("proved", proved="more of it")], [kept(proved="more of it")])
    assert version_problems(reader, limit=5) == []
