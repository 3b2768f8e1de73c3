"""A server's child cells as processes: one that keeps dying is given up, and that is said as long as it is true."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import anyio
import pytest

from app.children import LOCK_FILE, CellRuns, Children, cell_lock, running_cell
from app.clock import monotonic_s
from app.config import Settings

HOLDS_THE_LOCK = """
import json, pathlib, signal, sys
from app.children import cell_lock
with cell_lock(pathlib.Path(sys.argv[1]), json.loads("".join(sys.argv[2:]) or "{}")):
    signal.pause()
"""
pytestmark = [pytest.mark.process, pytest.mark.timeout(120), pytest.mark.anyio]


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


async def until_trouble(children: Children, wanted: bool) -> None:
    deadline_s = monotonic_s() + 60.0
    while (children.trouble() is not None) is not wanted:
        assert monotonic_s() < deadline_s
        await anyio.sleep(0.02)


async def test_who_looks_whether_a_cell_runs_keeps_none_from_starting(tmp_path: Path) -> None:
    with (tmp_path / LOCK_FILE).open("w") as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        threading.Timer(0.03, fcntl.flock, (looking, fcntl.LOCK_UN)).start()
        with cell_lock(tmp_path):
            assert running_cell(tmp_path) == os.getpid()
            with pytest.raises(CellRuns, match=f"process `{os.getpid()}`"), cell_lock(tmp_path):
                pass


@pytest.mark.parametrize("adopted", [False, True])
async def test_a_cell_that_cannot_be_started_as_told_is_given_up_at_once(tmp_path: Path, adopted: bool) -> None:
    settings, said = Settings(data=tmp_path, scenario="nope"), list[str]()
    folder = settings.layout.cell("workcell-1")
    folder.mkdir(parents=True)
    earlier = await anyio.open_process([sys.executable, "-c", HOLDS_THE_LOCK, str(folder)]) if adopted else None
    while adopted and running_cell(folder) is None:
        await anyio.sleep(0.02)
    children = Children(settings, "token", lambda cell, word: said.append(f"{cell}: {word}"))
    children.start()
    try:
        if earlier is not None:
            while not said:
                await anyio.sleep(0.02)
            earlier.terminate()
            await earlier.wait()
        await until_trouble(children, wanted=True)
        assert said[-1] == "workcell-1: cannot be started as it is told: it ended with `2`; not started again"
        assert "starting it again" not in "".join(said)
        assert children.misused.is_set() is not adopted, "a server whose cells have worked goes on without this one"
    finally:
        await children.stop()


async def test_a_cell_that_keeps_dying_is_given_up_until_somebody_starts_it(tmp_path: Path) -> None:
    settings, said = Settings(data=tmp_path), list[str]()
    folder = settings.layout.cell("workcell-1")
    (folder / "journal").mkdir(parents=True)  # cannot be opened now, and might be at the next start
    children = Children(settings, "token", lambda cell, word: said.append(f"{cell}: {word}"), restarts=1)
    children.start()
    try:
        assert children.trouble() is None
        await until_trouble(children, wanted=True)
        assert children.trouble() == "`workcell-1` ended 2 times in a row, the last time with `1`; not started again"
        assert said == ["workcell-1: ended with `1`; starting it again, idle", f"workcell-1: {said[-1][12:]}"]
        assert said[-1].endswith("not started again")
        by_hand = await anyio.open_process([sys.executable, "-c", HOLDS_THE_LOCK, str(folder)])
        await until_trouble(children, wanted=False)
    finally:
        await children.stop()
    assert await by_hand.wait() == -signal.SIGTERM  # it was adopted, so it ends with its server


async def test_a_cell_whose_process_the_system_refuses_once_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, said = Settings(data=tmp_path), list[str]()
    refusals = [BlockingIOError(11, "Resource temporarily unavailable")]  # at the limit of processes
    start = asyncio.create_subprocess_exec

    async def refuse_once(*words: Any, **named: Any) -> Any:
        if refusals:
            raise refusals.pop()
        return await start(sys.executable, "-c", HOLDS_THE_LOCK, words[words.index("--data") + 1], **named)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse_once)
    folder = settings.layout.cell("workcell-1")
    children = Children(settings, "token", lambda _, word: said.append(word))
    children.start()
    try:
        with anyio.fail_after(60):
            while not folder.exists() or running_cell(folder) is None:
                await anyio.sleep(0.02)
        assert said == ["ended with `Resource temporarily unavailable`; starting it again, idle"]
        assert children.trouble() is None
    finally:
        await children.stop()
    assert running_cell(folder) is None


async def test_a_cell_that_nobody_keeps_any_more_is_named_and_the_others_are_ended_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, said = Settings(data=tmp_path, cells=2), list[str]()
    start = asyncio.create_subprocess_exec

    async def break_one(*words: Any, **named: Any) -> Any:
        if "workcell-1" in words:
            raise RuntimeError("a bug")
        return await start(sys.executable, "-c", HOLDS_THE_LOCK, words[words.index("--data") + 1], **named)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", break_one)
    other = settings.layout.cell("workcell-2")
    children = Children(settings, "token", lambda cell, word: said.append(f"{cell} {word}"))
    children.start()
    try:
        with anyio.fail_after(60):
            while not other.exists() or running_cell(other) is None:
                await anyio.sleep(0.02)
        assert children.trouble() == "`workcell-1` is not kept any more: a bug"
        assert said == ["workcell-1 is not kept any more: a bug"]
    finally:
        await children.stop()
    assert running_cell(other) is None


@pytest.mark.parametrize(
    ("started_with", "said"),
    [
        (
            {"pace": 0.0, "seed": 3, "scenario": None, "robot": None},
            "it keeps pace `0` (not `1.5`), scenario `none` (not `s`)",
        ),
        ({"pace": 1.5, "seed": 3, "scenario": "s", "robot": None}, "adopted"),
        ({}, "adopted"),
    ],
)
async def test_an_adopted_cell_is_said_to_keep_what_it_was_started_with(
    tmp_path: Path, started_with: dict[str, object], said: str
) -> None:
    settings, words = Settings(data=tmp_path, pace=1.5, seed=3, scenario="s"), list[str]()
    folder = settings.layout.cell("workcell-1")
    folder.mkdir(parents=True)
    command = [sys.executable, "-c", HOLDS_THE_LOCK, str(folder), json.dumps(started_with)]
    earlier = await anyio.open_process(command)
    while running_cell(folder) is None:
        await anyio.sleep(0.02)
    children = Children(settings, "token", lambda _, word: words.append(word))
    children.start()
    try:
        while not words:
            await anyio.sleep(0.02)
    finally:
        await children.stop()
        await earlier.wait()
    (word,) = words
    assert f"process `{earlier.pid}`" in word
    assert said in word
    assert ("it keeps" in word) is ("it keeps" in said)
