from __future__ import annotations

import pytest
from websockets.client import ClientProtocol
from websockets.extensions.permessage_deflate import PerMessageDeflate
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from app.api.sockets import KEPT_FRAMES, Frames


def read(frame: bytes) -> Frame:
    """Return what a browser would make of it."""
    peer = ClientProtocol(parse_uri("ws://here/"), state=State.OPEN, max_size=None)
    peer.extensions = [PerMessageDeflate(True, True, 15, 15)]
    peer.receive_data(frame)
    (found,) = peer.events_received()
    assert isinstance(found, Frame)
    return found


@pytest.mark.parametrize("deflated", [True, False])
@pytest.mark.parametrize("length", [1, 125, 126, 65_535, 65_536, 300_000, 5_000_000])
def test_a_frame_holds_the_whole_text(length: int, deflated: bool) -> None:
    found = read(Frames().of("m" * length, deflated))
    assert (found.opcode, found.fin, bytes(found.data)) == (Opcode.TEXT, True, b"m" * length)


def test_texts_are_sent_in_utf_8_and_poses_as_bytes() -> None:
    frames = Frames()
    assert bytes(read(frames.of("τ ≤ 1", True)).data).decode() == "τ ≤ 1"
    found = read(frames.of(b"RPF1\xff", True))
    assert (found.opcode, bytes(found.data)) == (Opcode.BINARY, b"RPF1\xff")


def test_what_all_are_sent_is_made_into_a_frame_once() -> None:
    frames, update, poses = Frames(), "update " * 10, b"poses" * 10
    first = frames.of(update, True)
    assert frames.of(poses, True) is frames.of(poses, True)
    assert frames.of(update, True) is first


def test_only_long_texts_are_compressed_and_only_for_who_reads_that() -> None:
    frames, update, poses = Frames(), "update " * 1000, b"poses" * 1000
    plain = frames.of(update, False)
    assert len(frames.of(update, True)) < len(plain) / 10
    assert frames.of(update, False) is plain
    assert frames.of(poses, True) == frames.of(poses, False)


def test_what_comes_later_takes_the_place_of_what_was_sent_before() -> None:
    frames = Frames()
    texts = [f"text {number}" for number in range(KEPT_FRAMES + 1)]
    made = [frames.of(text, True) for text in texts]
    assert [bytes(read(frame).data).decode() for frame in made] == texts
    assert frames.of(texts[0], True) == made[0]
