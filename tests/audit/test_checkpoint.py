"""Checkpoints in the C2SP forms."""

from __future__ import annotations

from base64 import b64decode, b64encode
from hashlib import sha256

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from hypothesis import given
from hypothesis import strategies as st

from app.audit.checkpoint import (
    Checkpoint,
    NoteInvalid,
    Signer,
    Verifier,
    parse_checkpoint,
    parse_signer,
    parse_verifier,
)

SIGNER = Signer(name="reins/log-1", seed=bytes(range(32)))
ROOT = bytes(range(32, 64))
NOTE = SIGNER.sign(7, ROOT)


@given(st.integers(0, 2**60), st.binary(min_size=32, max_size=32))
def test_opens_what_it_signed(size: int, root: bytes) -> None:
    assert SIGNER.verifier.open(SIGNER.sign(size, root)) == Checkpoint(origin="reins/log-1", size=size, root=root)


def test_note_has_the_form_the_specification_draws() -> None:
    lines = NOTE.split("\n")
    assert lines[:4] == ["reins/log-1", "7", b64encode(ROOT).decode(), ""]
    mark, name, blob = lines[4].split(" ")
    assert (mark, name, lines[5:]) == ("—", "reins/log-1", [""])
    raw = b64decode(blob)
    key = SIGNER.verifier.key
    assert raw[:4] == sha256(b"reins/log-1\n\x01" + key).digest()[:4]
    Ed25519PublicKey.from_public_bytes(key).verify(raw[4:], "\n".join([*lines[:3], ""]).encode())


def test_reads_a_key_that_another_implementation_wrote() -> None:
    """The example key in the documentation of Go's `sumdb/note`."""
    text = "PeterNeumann+c74f20a3+ARpc2QcUPDhMQegwxbzhKqiBfsVkmqq/LDE4izWy10TW"
    assert parse_verifier(text).text() == text


@given(st.integers(0, len(NOTE) - 1), st.characters(codec="utf-8"))
def test_refuses_a_note_with_any_character_changed(place: int, character: str) -> None:
    forged = NOTE[:place] + character + NOTE[place + 1 :]
    if forged != NOTE:
        with pytest.raises(NoteInvalid):
            SIGNER.verifier.open(forged)


def test_passes_over_the_signatures_of_others() -> None:
    other = Signer(name="witness", seed=bytes(32)).sign(7, ROOT).split("\n")[4]
    twin = Signer(name="reins/log-1", seed=bytes(32)).sign(7, ROOT).split("\n")[4]
    text, own = NOTE.split("\n\n")
    assert SIGNER.verifier.open(f"{text}\n\n{other}\n{twin}\n{own}").size == 7


@pytest.mark.parametrize(
    ("note", "problem"),
    [
        ("", "a note is"),
        (NOTE[:-1], "a note is"),
        (NOTE.replace("— ", "- "), "no signature line"),
        (Signer(name="other", seed=bytes(32)).sign(7, ROOT), "no signature by"),
        (NOTE.replace("reins/log-1 ", "reins/log-1 !"), "base64"),
        (NOTE.replace("\n7\n", "\n8\n"), "does not hold"),
    ],
)
def test_says_what_is_wrong_with_a_note(note: str, problem: str) -> None:
    with pytest.raises(NoteInvalid, match=problem):
        SIGNER.verifier.open(note)


def test_refuses_the_checkpoint_of_another_log() -> None:
    text = Checkpoint(origin="another", size=1, root=ROOT).text()
    signature = SIGNER.verifier.key_id + SIGNER._key.sign(text.encode())
    note = f"{text}\n— reins/log-1 {b64encode(signature).decode()}\n"
    with pytest.raises(NoteInvalid, match="of `another`"):
        SIGNER.verifier.open(note)


@pytest.mark.parametrize("size", ["", "01", "-1", "+1", "²", "1.0", "9" * 5000])
def test_refuses_a_size_that_is_none(size: str) -> None:
    with pytest.raises(NoteInvalid, match="tree size"):
        parse_checkpoint(f"a\n{size}\n{b64encode(ROOT).decode()}\n")


@pytest.mark.parametrize("text", ["", "a\n1\n", "\n1\nAA==\n", "a\n1\nAA==\n", "a\n1\nAA==", "a\n1\n!\n"])
def test_refuses_a_text_that_is_no_checkpoint(text: str) -> None:
    with pytest.raises(NoteInvalid):
        parse_checkpoint(text)


def test_keys_survive_being_written() -> None:
    assert parse_verifier(SIGNER.verifier.text()) == SIGNER.verifier
    assert parse_signer(SIGNER.text() + "\n").sign(7, ROOT) == NOTE


@pytest.mark.parametrize(
    "text",
    [
        "nothing",
        "a+zz+AA==",
        "a+00000000+AA==",
        f"a+00000000+{b64encode(bytes([2]) + bytes(32)).decode()}",
        f"a+00000000+{b64encode(bytes([1]) + bytes(32)).decode()}",
        f"a b+00000000+{b64encode(bytes([1]) + bytes(32)).decode()}",
    ],
)
def test_refuses_texts_that_are_no_keys(text: str) -> None:
    with pytest.raises(NoteInvalid):
        parse_verifier(text)
    with pytest.raises(NoteInvalid):
        parse_signer("PRIVATE+KEY+" + text)
    with pytest.raises(NoteInvalid):
        parse_signer(text)


def test_refuses_keys_of_another_length() -> None:
    with pytest.raises(NoteInvalid, match="32"):
        Verifier(name="a", key=b"short")
    with pytest.raises(NoteInvalid, match="32"):
        Signer(name="a", seed=b"short")


def test_an_error_never_repeats_the_secret() -> None:
    secret = b64encode(bytes([1]) + bytes(range(32))).decode()
    with pytest.raises(NoteInvalid) as raised:
        parse_signer(f"PRIVATE+KEY+a+00000000+{secret}")
    assert secret not in str(raised.value)
