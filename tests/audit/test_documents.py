"""What the log says of questions, grants and reviews, and what their tables must say of them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import orjson
import pytest

from app.audit.documents import PAGE, document_problems, documents
from app.audit.event import RowWrite
from app.audit.places import Places
from app.audit.reader import Reader
from app.audit.store import AuditStore
from tests.audit.conftest import TIME, draft

pytestmark = pytest.mark.anyio


def question(name: str = "esc_1", status: str = "pending", **changes: Any) -> dict[str, Any]:
    return {"id": name, "status": status, "needed": 1, "expires_at": None, "updated_at": TIME, **changes}


def kept(table: str, said: dict[str, Any], **changes: Any) -> RowWrite:
    known = {
        "escalations": {"invocation": "inv_1", "expires_at": None},
        "reviews": {"invocation": "inv_1"},
        "grants": {"cell": "workcell-1"},
    }
    values = {"id": said["id"], "status": said["status"], "document": orjson.dumps(said)}
    return RowWrite(table=table, values={**values, **known[table], "created_at": TIME, "updated_at": TIME, **changes})


@pytest.fixture
async def reader(store: AuditStore, data: Path) -> AsyncIterator[Reader]:
    reader = Reader(Places(data).database)
    yield reader
    reader.close()


@pytest.mark.parametrize(("table", "word"), [("escalations", "escalation"), ("grants", "grant"), ("reviews", "review")])
async def test_the_newest_event_says_what_the_table_says(
    store: AuditStore, reader: Reader, table: str, word: str
) -> None:
    first, second = question(), question(status="approved", needed=0)
    await store.append([draft(word, **{word: first})], rows=[kept(table, first)])
    assert document_problems(reader, limit=5) == []
    await store.append([draft(word, **{word: second})])
    assert document_problems(reader, limit=5) == [
        f"`esc_1`: the column of the table `{table}` says `pending`, the log makes it `approved`"
    ]
    await store.append([], rows=[kept(table, second)])
    assert document_problems(reader, limit=5) == []


async def test_what_no_event_says_is_not_compared(store: AuditStore, reader: Reader) -> None:
    given = question("grant_1", "active", uses=0, used_at=None)
    used = {**given, "uses": 3, "used_at": TIME, "updated_at": "2026-03-01T10:00:00.000Z"}
    await store.append([draft("grant", None, grant=given)], rows=[kept("grants", used)])
    assert document_problems(reader, limit=5) == []


async def test_a_session_that_goes_on_withdraws_its_question(store: AuditStore, reader: Reader) -> None:
    gone = question(status="withdrawn")
    await store.append([draft("status", status="escalated", escalation=question())])
    await store.append([draft("status", status="running", withdrawn="esc_1")], rows=[kept("escalations", gone)])
    assert document_problems(reader, limit=5) == []


@pytest.mark.parametrize(
    ("row", "said"),
    [
        (kept("escalations", question(needed=0)), "`needed` in the table `escalations` is not what event `1` says"),
        (kept("escalations", question(risk="low")), "`risk` in the table `escalations` is not what event `1` says"),
        (
            kept("escalations", question(), expires_at=TIME),
            "the column `expires_at` of the table `escalations` is not what its document says",
        ),
        (kept("escalations", question(), status="approved"), "the column of the table `escalations` says `approved`"),
        (
            kept("escalations", question(status="approved"), status="pending"),
            "the document of the table `escalations` says `approved`, the log makes it `pending`",
        ),
        (kept("escalations", question(), document=b"{"), "holds is no document of it"),
        (kept("escalations", question(), document=b"[]"), "holds is no document of it"),
        (kept("escalations", question(), document=orjson.dumps(question("esc_2"))), "holds is no document of it"),
    ],
)
async def test_a_changed_row_is_found(store: AuditStore, reader: Reader, row: RowWrite, said: str) -> None:
    await store.append([draft("escalation", escalation=question())], rows=[row])
    (found,) = document_problems(reader, limit=5)
    assert found.startswith("`esc_1`: ")
    assert said in found


async def test_a_row_too_many_and_one_too_few_are_found(store: AuditStore, reader: Reader) -> None:
    forged = question("grant_1", "active")
    await store.append([draft("escalation", escalation=question())], rows=[kept("grants", forged)])
    lost, alone = document_problems(reader, limit=5)
    assert lost == "`esc_1`: the log knows it, the table `escalations` does not"
    assert alone == "`grant_1`: the table `grants` knows it, the log does not"
    assert document_problems(reader, limit=1) == [lost]


async def test_compares_page_by_page(store: AuditStore, reader: Reader) -> None:
    names = [f"esc_{number:04}" for number in range(2 * PAGE + 1)]
    documents = [question(name) for name in names]
    drafts = [draft("escalation", escalation=document) for document in documents]
    await store.append(drafts, rows=[kept("escalations", document) for document in documents])
    assert document_problems(reader, limit=5) == []
    await store.append([], rows=[kept("escalations", question(names[-1], needed=2))])
    (found,) = document_problems(reader, limit=5)
    assert found.startswith(f"`{names[-1]}`: `needed`")


async def test_an_approval_that_names_its_grant_is_no_document_of_it(store: AuditStore, reader: Reader) -> None:
    given = question("grant_1", "active")
    await store.append([draft("grant", grant=given)], rows=[kept("grants", given)])
    await store.append([draft("approval", grant="grant_1", review=None, escalation="esc_1", withdrawn="esc_1")])
    assert document_problems(reader, limit=5) == []


async def test_reads_the_newest_version_of_each_document_from_the_log(store: AuditStore) -> None:
    approved, granted = question(status="approved"), question("grant_1", "active")
    await store.append(
        [
            draft("escalation", escalation=question()),
            draft("escalation", escalation=question("esc_2")),
            draft("approval", escalation=approved, grant="grant_1"),
            draft("grant", grant=granted),
            draft("status", status="running", withdrawn="esc_2"),
            draft("status", status="running", withdrawn="esc_of_another"),
        ]
    )
    told = await store.events()
    assert documents(told, "escalation") == [approved, question("esc_2", "withdrawn")]
    assert documents(told, "grant") == [granted], "a grant's name alone is no document, and nothing withdraws one"
