"""Signed tree heads in the C2SP forms: a checkpoint (`tlog-checkpoint`) inside a `signed-note`, Ed25519.

    origin
    size
    base64(root)
                                        an empty line ends the signed text
    — name base64(key id ‖ signature)

The key id is the first four bytes of SHA-256(name ‖ LF ‖ 0x01 ‖ public key). Keys are written in the note format as
well: `name+id+base64`, the secret one behind `PRIVATE+KEY+`. Pure: no files, no clock, no randomness (Ed25519 signs
deterministically; the seed comes from outside).
"""

from __future__ import annotations

import binascii
from base64 import b64decode, b64encode
from dataclasses import dataclass
from hashlib import sha256

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from app.audit.merkle import HASH_BYTES

ED25519 = b"\x01"
KEY_BYTES = 32
SIGNATURE_BYTES = 64
MAX_DIGITS = 19
SIGNATURE_MARK = "— "
SECRET_MARK = "PRIVATE+KEY+"  # noqa: S105  # the note format's own prefix, not a secret


class NoteInvalid(ValueError):
    """A note, checkpoint or key text is not in its form, or its signature does not hold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """A tree head: how many events, and the root over them, for the log named by `origin`."""

    origin: str
    size: int
    root: bytes

    def text(self) -> str:
        """Return the three lines that are signed."""
        return f"{self.origin}\n{self.size}\n{b64encode(self.root).decode()}\n"


def parse_checkpoint(text: str) -> Checkpoint:
    """Read the signed text of a note as a checkpoint.

    Raises:
        NoteInvalid: not exactly origin, size in plain decimal, and a root of 32 bytes.
    """
    lines = text.split("\n")
    if len(lines) != 4 or lines[3] or not lines[0]:
        raise NoteInvalid("a checkpoint has three lines: origin, size, root")
    origin, size, root = lines[:3]
    if not (size.isascii() and size.isdigit()) or len(size) > MAX_DIGITS or str(int(size)) != size:
        raise NoteInvalid(f"`{size[:40]}` is no tree size: valid is a decimal number without leading zeros")
    return Checkpoint(origin=origin, size=int(size), root=_decode(root, HASH_BYTES, "root"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Verifier:
    """The public half of a log's key: opens notes that this key signed."""

    name: str
    key: bytes

    def __post_init__(self) -> None:
        """Refuse a name that the note format cannot carry, and a key of another length."""
        if not self.name or any(character.isspace() or character == "+" for character in self.name):
            raise NoteInvalid(f"`{self.name}` is no key name: valid is text without spaces and `+`")
        if len(self.key) != KEY_BYTES:
            raise NoteInvalid(f"an Ed25519 public key has `{KEY_BYTES}` bytes, not `{len(self.key)}`")

    @property
    def key_id(self) -> bytes:
        """The four bytes that tell keys of one name apart."""
        return sha256(self.name.encode() + b"\n" + ED25519 + self.key).digest()[:4]

    def text(self) -> str:
        """Return the key as one line, `name+id+base64`."""
        return f"{self.name}+{self.key_id.hex()}+{b64encode(ED25519 + self.key).decode()}"

    def open(self, note: str) -> Checkpoint:
        """Verify a note and return the checkpoint in it.

        Raises:
            NoteInvalid: not in the note form, not signed by this key, a signature that does not hold, or the
            checkpoint of another log.
        """
        text, separator, signatures = note.partition("\n\n")
        if not separator or not signatures.endswith("\n"):
            raise NoteInvalid("a note is a text, an empty line, and signature lines")
        blob = _signature(signatures, self.name, self.key_id)
        text += "\n"
        try:
            Ed25519PublicKey.from_public_bytes(self.key).verify(blob, text.encode())
        except InvalidSignature:
            raise NoteInvalid(f"the signature by `{self.name}` does not hold") from None
        checkpoint = parse_checkpoint(text)
        if checkpoint.origin != self.name:
            raise NoteInvalid(f"the checkpoint is of `{checkpoint.origin}`, not of `{self.name}`")
        return checkpoint


class Signer:
    """The secret half of a log's key: turns checkpoints into notes."""

    __slots__ = ("_key", "_prefix", "name", "seed", "verifier")

    def __init__(self, *, name: str, seed: bytes) -> None:
        """Take the key's name and its 32 secret bytes.

        Raises:
            NoteInvalid: the name or the seed is not in its form.
        """
        if len(seed) != KEY_BYTES:
            raise NoteInvalid(f"an Ed25519 seed has `{KEY_BYTES}` bytes, not `{len(seed)}`")
        self.name = name
        self.seed = seed
        self._key = Ed25519PrivateKey.from_private_bytes(seed)
        self.verifier = Verifier(name=name, key=self._key.public_key().public_bytes_raw())
        self._prefix = self.verifier.key_id

    def sign(self, size: int, root: bytes) -> str:
        """Return the signed note for a tree head."""
        text = Checkpoint(origin=self.name, size=size, root=root).text()
        return (
            f"{text}\n{SIGNATURE_MARK}{self.name} {b64encode(self._prefix + self._key.sign(text.encode())).decode()}\n"
        )

    def text(self) -> str:
        """Return the secret key as one line, `PRIVATE+KEY+name+id+base64`. Never log it."""
        return f"{SECRET_MARK}{self.name}+{self._prefix.hex()}+{b64encode(ED25519 + self.seed).decode()}"


def parse_verifier(text: str) -> Verifier:
    """Read a public key line.

    Raises:
        NoteInvalid: not in the form `name+id+base64`, or the id is not that of the key.
    """
    name, key_id, key = _key_parts(text)
    verifier = Verifier(name=name, key=key)
    if verifier.key_id != key_id:
        raise NoteInvalid(f"the key of `{name}` has another id than its text says")
    return verifier


def parse_signer(text: str) -> Signer:
    """Read a secret key line; messages never repeat it.

    Raises:
        NoteInvalid: not in the form `PRIVATE+KEY+name+id+base64`, or the id is not that of the key.
    """
    if not text.startswith(SECRET_MARK):
        raise NoteInvalid(f"a secret key starts with `{SECRET_MARK}`")
    name, key_id, seed = _key_parts(text.removeprefix(SECRET_MARK))
    signer = Signer(name=name, seed=seed)
    if signer.verifier.key_id != key_id:
        raise NoteInvalid(f"the key of `{name}` has another id than its text says")
    return signer


def _key_parts(text: str) -> tuple[str, bytes, bytes]:
    parts = text.strip().split("+", 2)
    if len(parts) != 3:
        raise NoteInvalid("a key is written `name+id+base64`")
    try:
        key_id = bytes.fromhex(parts[1])
    except ValueError:
        raise NoteInvalid("a key's id is written in hexadecimal") from None
    data = _decode(parts[2], 1 + KEY_BYTES, "key")
    if data[:1] != ED25519:
        raise NoteInvalid(f"a key of algorithm `{data[0]}`: valid is Ed25519, `1`")
    return parts[0], key_id, data[1:]


def _signature(lines: str, name: str, key_id: bytes) -> bytes:
    for line in lines.splitlines():
        parts = line.removeprefix(SIGNATURE_MARK).split(" ")
        if not line.startswith(SIGNATURE_MARK) or len(parts) != 2:
            raise NoteInvalid(f"`{line}` is no signature line")
        if parts[0] == name:
            blob = _decode(parts[1], len(key_id) + SIGNATURE_BYTES, "signature")
            if blob.startswith(key_id):  # other keys, witnesses among them, may sign under the same name
                return blob[len(key_id) :]
    raise NoteInvalid(f"the note bears no signature by `{name}`")


def _decode(text: str, length: int, what: str) -> bytes:
    try:
        data = b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise NoteInvalid(f"the {what} is not in base64") from None
    if len(data) != length:
        raise NoteInvalid(f"a {what} has `{length}` bytes, not `{len(data)}`")
    return data
