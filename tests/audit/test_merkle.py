"""The incremental tree against RFC 9162's recursive definition."""

from __future__ import annotations

from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.audit.merkle import EMPTY_ROOT, Frontier, leaf_hash, node_hash, split_hashes

bodies = st.lists(st.binary(max_size=8), max_size=80)


def recursive_root(leaves: list[bytes]) -> bytes:
    """MTH as section 2.1.1 writes it: split at the largest power of two below n."""
    if not leaves:
        return sha256(b"").digest()
    if len(leaves) == 1:
        return leaves[0]
    split = 1
    while split * 2 < len(leaves):
        split *= 2
    return sha256(b"\x01" + recursive_root(leaves[:split]) + recursive_root(leaves[split:])).digest()


@given(bodies)
def test_root_is_that_of_the_recursive_definition(bodies: list[bytes]) -> None:
    leaves = [leaf_hash(body) for body in bodies]
    assert Frontier().extend(leaves).root() == recursive_root(leaves)


@given(bodies, st.integers(0, 80))
def test_appending_in_pieces_and_restoring_between_gives_the_same_tree(bodies: list[bytes], cut: int) -> None:
    leaves = [leaf_hash(body) for body in bodies]
    first = Frontier().extend(leaves[:cut])
    restored = Frontier.unpack(first.size, first.pack())
    assert restored == first
    for leaf in leaves[cut:]:
        restored = restored.append(leaf)
    assert restored == Frontier().extend(leaves)


@given(bodies, st.integers(0, 79), st.binary(max_size=8))
def test_any_other_leaf_gives_another_root(bodies: list[bytes], place: int, body: bytes) -> None:
    if place < len(bodies) and bodies[place] != body:
        changed = [*bodies[:place], body, *bodies[place + 1 :]]
        original, forged = (Frontier().extend(map(leaf_hash, each)).root() for each in (bodies, changed))
        assert original != forged


def test_appending_leaves_the_old_frontier_as_it_was() -> None:
    old = Frontier().append(leaf_hash(b"a"))
    root = old.root()
    old.append(leaf_hash(b"b"))
    assert (old.size, old.root()) == (1, root)


def test_leaf_and_node_hashes_cannot_be_taken_for_each_other() -> None:
    left, right = leaf_hash(b"a"), leaf_hash(b"b")
    assert node_hash(left, right) != leaf_hash(left + right)
    assert node_hash(left, right) == sha256(b"\x01" + left + right).digest()


def test_empty_tree_has_the_hash_of_nothing() -> None:
    assert Frontier().root() == EMPTY_ROOT
    assert EMPTY_ROOT.hex() == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


@pytest.mark.parametrize(
    ("size", "packed"), [(1, b""), (0, bytes(32)), (3, bytes(32)), (-1, bytes(32)), (1, bytes(31)), (2, bytes(33))]
)
def test_refuses_a_frontier_that_no_tree_has(size: int, packed: bytes) -> None:
    with pytest.raises(ValueError, match=r"valid|bytes"):
        Frontier.unpack(size, packed)


def test_refuses_a_node_of_another_length() -> None:
    with pytest.raises(ValueError, match="32"):
        Frontier(1, (b"short",))


def test_splits_hashes() -> None:
    assert split_hashes(bytes(32) + b"\x01" * 32) == (bytes(32), b"\x01" * 32)
