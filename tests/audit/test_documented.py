"""An export is checked by what the documentation prints, which is not a line of this program."""

from __future__ import annotations

import asyncio
import re
import subprocess
import sys
from pathlib import Path

import pytest

from app.audit.archive import export
from app.audit.event import EventDraft
from app.audit.store import AuditStore

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "record.md"


async def keep(data: Path) -> None:
    store = AuditStore.open(data)
    for count in (1, 4, 2):
        await store.append([EventDraft(kind="human", actor="operator", body={"n": n}) for n in range(count)])
    await store.close()


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """Seven events in three batches, exported, and the checker beside them."""
    (script,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    (tmp_path / "check.py").write_text(script)
    asyncio.run(keep(tmp_path / "data"))
    export(tmp_path / "data", out := tmp_path / "log.jsonl")
    return out


def checked(log: Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, str(log.with_name("check.py")), str(log), str(log.with_name("data") / "log.pub")]
    return subprocess.run(words, capture_output=True, text=True, timeout=60)


def test_an_export_is_good_by_the_checker_of_the_documentation(exported: Path) -> None:
    found = checked(exported)
    assert (found.returncode, found.stdout[:15]) == (0, "good: 7 events "), found.stderr


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        (b'"n":3', b'"n":4', "an event was changed"),
        (b'"actor":"operator"', b'"actor":"somebody"', "an event was changed"),
        (b'{"actor":"operator"', b'\n{"actor":"operator"', "vouches for 7 events, here are 8"),
    ],
)
def test_a_changed_export_is_not(exported: Path, before: bytes, after: bytes, named: str) -> None:
    exported.write_bytes(exported.read_bytes().replace(before, after, 1))
    found = checked(exported)
    assert (found.returncode, named in found.stderr) == (1, True), found.stderr


def test_an_export_with_something_behind_its_last_line_is_not(exported: Path) -> None:
    exported.write_bytes(exported.read_bytes() + b'{"actor":"operator"}')
    found = checked(exported)
    assert (found.returncode, "is no event" in found.stderr) == (1, True), found.stdout


@pytest.mark.parametrize(
    ("before", "after", "named"), [("\n7\n", "\n6\n", "InvalidSignature"), ("reins", "other", "another log")]
)
def test_a_changed_checkpoint_is_not(exported: Path, before: str, after: str, named: str) -> None:
    note = exported.with_name(exported.name + ".checkpoint")
    text = note.read_text()
    assert before in text
    note.write_text(text.replace(before, after, 1))
    found = checked(exported)
    assert (found.returncode, named in found.stderr) == (1, True), found.stderr
