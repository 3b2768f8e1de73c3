"""A disk says whether it takes more, before anything is written to it."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from app.disk import displaced, full, lay_by, replace_private, write_private


def test_says_of_a_disk_whether_it_takes_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert full(tmp_path, "record") is None
    assert "No such file" in (full(tmp_path / "gone", "record") or "")
    disk = os.statvfs(tmp_path)
    for changed, why in (
        ((*disk[:3], 0, 0, *disk[5:]), "is full: `0` bytes are free"),
        ((*disk[:8], disk.f_flag | os.ST_RDONLY, *disk[9:]), "is read-only"),
    ):
        monkeypatch.setattr(os, "statvfs", lambda _, changed=changed: os.statvfs_result(changed))
        assert why in (full(tmp_path, "record") or "")
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((*disk[:2], 0, 0, 0, *disk[5:])))
    assert full(tmp_path, "record") is None  # it does not say


def test_an_open_file_names_its_disk_as_a_folder_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = os.statvfs(tmp_path)
    with (tmp_path / "journal").open("wb") as file:
        assert full(file.fileno(), "journal") is None
        monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((*disk[:3], 0, 0, *disk[5:])))
        assert full(file.fileno(), "journal") == (
            "the disk of the journal is full: `0` bytes are free; valid: `65536` or more"
        )


def test_an_open_file_that_is_not_the_one_under_its_name_any_more_is_said_to_be_lost(tmp_path: Path) -> None:
    path, aside = tmp_path / "folder" / "journal", tmp_path / "aside"
    path.parent.mkdir()
    path.write_text("")
    held = path.stat()
    assert displaced(path, held, "journal") is None
    path.rename(aside)
    assert displaced(path, held, "journal") == (
        "the journal was deleted under the process that writes it: nothing more would be kept"
    )
    path.write_text("")
    assert displaced(path, held, "journal") == "another file stands in the place of the journal"
    aside.replace(path)
    assert displaced(path, held, "journal") is None
    aside.write_text("")
    assert displaced(aside / "journal", held, "journal") == "the journal cannot be looked at: Not a directory"


def test_what_was_put_in_place_is_there_after_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[tuple[bool, list[str]]] = []
    path, fsync = tmp_path / "key", os.fsync

    def sync(descriptor: int) -> None:
        names = [one.name for one in tmp_path.iterdir()]
        synced.append((os.path.samestat(os.fstat(descriptor), tmp_path.stat()), names))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", sync)
    write_private(path, b"secret")
    (_, before), after = synced
    assert "key" not in before, "the bytes come before the name"
    assert after == (True, ["key"])
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"secret", 0o600)


def fills_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a disk take no new bytes, once."""

    def refuse(_: int) -> None:
        monkeypatch.undo()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)


def test_a_shorter_file_is_put_in_place_on_a_full_disk_where_room_was_laid_by(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "listed"
    write_private(path, b"one, two")
    lay_by(path)
    fills_up(monkeypatch)
    replace_private(path, b"one")
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"one", 0o600)
    assert [one.name for one in tmp_path.iterdir()] == ["listed"]
    for laid_by in (False, True):  # none, and one that is too short
        if laid_by:
            lay_by(path)
        fills_up(monkeypatch)
        with pytest.raises(OSError, match="No space left"):
            replace_private(path, b"one, two")
        assert path.read_bytes() == b"one"
