"""The Merkle tree over the log's events, as RFC 9162 (section 2.1) defines it, kept incrementally.

A tree of n leaves is, for its root, no more than one hash for every bit set in n: the roots of the complete subtrees
from left to right, the largest first. A `Frontier` is that list as a value. Appending returns another frontier and
leaves the old one as it was, so that a tree of events not yet durable can be dropped by forgetting it. Leaves are not
kept here; inclusion and consistency proofs can be computed from the leaf hashes that checkpoints store.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

HASH_BYTES = 32
EMPTY_ROOT = sha256(b"").digest()


def leaf_hash(body: bytes) -> bytes:
    """Return SHA-256(0x00 ‖ body), RFC 9162 section 2.1.1."""
    return sha256(b"\x00" + body).digest()


def node_hash(left: bytes, right: bytes) -> bytes:
    """Return SHA-256(0x01 ‖ left ‖ right), RFC 9162 section 2.1.1."""
    return sha256(b"\x01" + left + right).digest()


@dataclass(frozen=True, slots=True)
class Frontier:
    """The right edge of a tree: its size and the roots of its complete subtrees, largest first.

    Raises:
        ValueError: the number or the length of the nodes does not fit the size.
    """

    size: int = 0
    nodes: tuple[bytes, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a frontier that no tree has."""
        if self.size < 0 or len(self.nodes) != self.size.bit_count():
            raise ValueError(
                f"a tree of `{self.size}` leaves has no frontier of `{len(self.nodes)}` nodes: valid is one per bit set"
            )
        if any(len(node) != HASH_BYTES for node in self.nodes):
            raise ValueError(f"a node has `{HASH_BYTES}` bytes")

    def extend(self, leaves: Iterable[bytes]) -> Frontier:
        """Return the frontier after appending leaf hashes in order."""
        size, nodes = self.size, list(self.nodes)
        for leaf in leaves:
            node = leaf
            size += 1
            carry = size
            while not carry & 1:  # every trailing zero of the new size is one pair of equal subtrees that closes
                node = node_hash(nodes.pop(), node)
                carry >>= 1
            nodes.append(node)
        return Frontier(size, tuple(nodes))

    def append(self, leaf: bytes) -> Frontier:
        """Return the frontier after appending one leaf hash."""
        return self.extend((leaf,))

    def root(self) -> bytes:
        """Return the tree's root hash; that of the empty tree is SHA-256 of nothing."""
        if not self.nodes:
            return EMPTY_ROOT
        root = self.nodes[-1]
        for node in reversed(self.nodes[:-1]):
            root = node_hash(node, root)
        return root

    def pack(self) -> bytes:
        """Return the nodes one after the other, for storing beside the size."""
        return b"".join(self.nodes)

    @classmethod
    def unpack(cls, size: int, packed: bytes) -> Frontier:
        """Restore a frontier from what `pack` returned.

        Raises:
            ValueError: the bytes are no frontier of a tree of that size.
        """
        return cls(size, split_hashes(packed))


def split_hashes(packed: bytes) -> tuple[bytes, ...]:
    """Cut a string of hashes into its hashes.

    Raises:
        ValueError: the length is no multiple of a hash's.
    """
    if len(packed) % HASH_BYTES:
        raise ValueError(f"`{len(packed)}` bytes are no whole number of hashes: valid are multiples of `{HASH_BYTES}`")
    return tuple(packed[start : start + HASH_BYTES] for start in range(0, len(packed), HASH_BYTES))
