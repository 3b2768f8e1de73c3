"""The one channel: minting and verifying authorizations (design, rule 1).

An `Authorization` is written as canonical JSON, signed with the governance kernel's Ed25519 key, and verified by the
cell before anything is bound. `verify` is the only maker of a `Grant`, and a substrate binds nothing else. The order
of the checks is the order of trust:

1. the signature, over the exact bytes received; nothing of an unsigned body is even parsed;
2. the form: every field present, none unknown, each of its type, every number finite;
3. the cell, the policy digest, the time, and that the permit was not used before.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, NoReturn, TypeVar, cast

from cryptography.exceptions import InvalidSignature

from app.governance.errors import GovernanceError
from app.governance.model import Authorization, CoveredRecovery, Mode, Strategy

if TYPE_CHECKING:
    from collections.abc import Set as AbstractSet

    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

    from app.governance.model import Json, Params

PermitCode = Literal[
    "bad_signature",
    "malformed",
    "wrong_cell",
    "wrong_policy",
    "not_yet_valid",
    "expired",
    "clock_put_back",
    "used",
]

CLOCK_TOLERANCE_S: Final = 2.0
"""How far the kernel's clock may run ahead of the cell's; expiry gets no such tolerance."""

_PROOF: Final = object()
_EXACT_INTEGERS: Final = 2**53


class PermitError(GovernanceError):
    """An authorization that does not permit anything here and now.

    Attributes:
        code: Which check it failed, stable.
        detail: What was found and what would be valid.
        invocation: Which invocation it was for, once the signature was found good; None before that.
        permit: Which authorization it is, likewise.
        expires_at_s: When that expires, wall time in seconds.
    """

    def __init__(self, code: PermitCode, detail: str, permit: Authorization | None = None) -> None:
        """Keep the facts, and whose they are; the message is made of them."""
        self.code: PermitCode = code
        self.detail = detail
        self.invocation = None if permit is None else permit.invocation
        self.permit = None if permit is None else permit.id
        self.expires_at_s = math.inf if permit is None else permit.expires_at_s
        super().__init__(f"{code}: {detail}")


class SignedAuthorization(NamedTuple):
    """The exact bytes that were signed, and the raw Ed25519 signature over them."""

    body: bytes
    signature: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """A verified authorization: what a substrate needs to see before it moves. Only `verify` can make one."""

    authorization: Authorization
    _proof: object = field(repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse to exist outside of `verify`."""
        if self._proof is not _PROOF:
            raise TypeError("a `Grant` is made by `verify` alone; valid: mint an authorization and verify it")

    def covers(self, capability: str, params: Params) -> bool:
        """Say whether exactly this may be bound: the authorized capability itself, or a recovery it names."""
        permit = self.authorization
        if capability == permit.capability and _same(params, permit.params):
            return True
        return any(capability == known.capability and _same(params, known.params) for known in permit.recoveries)


def canonical(value: object) -> bytes:
    """Write a JSON value in the one form that is signed: sorted keys, no spaces, UTF-8, finite numbers only.

    Raises:
        ValueError: a number is not finite, a string is no valid text, or something is not JSON.
    """
    try:
        return json.dumps(
            _plain(value), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        ).encode()
    except TypeError as error:
        raise ValueError(f"not JSON: {error}") from error


def mint(authorization: Authorization, private_key: Ed25519PrivateKey) -> SignedAuthorization:
    """Sign an authorization.

    Raises:
        ValueError: a field cannot be written as canonical JSON.
    """
    body = canonical({entry.name: getattr(authorization, entry.name) for entry in fields(authorization)})
    return SignedAuthorization(body, private_key.sign(body))


def verify(  # noqa: PLR0913  # all that a permit is held against, each by its name
    signed: SignedAuthorization,
    *,
    key: Ed25519PublicKey,
    cell: str,
    policy_digest: str,
    now_s: float,
    used: AbstractSet[str],
    forgotten_s: float = -math.inf,
    begun_s: float = -math.inf,
    former: AbstractSet[str] = frozenset(),
) -> Grant:
    """Return the grant that a signed authorization is worth on this cell, under this policy, now.

    Args:
        signed: What the kernel sent.
        key: The kernel's public key.
        cell: Name of the cell that verifies.
        policy_digest: Digest of the policy the cell holds.
        now_s: Wall time, seconds since the epoch.
        used: Identifiers of permits this cell has bound or refused before.
        forgotten_s: The latest expiry of those that are not among them any more: whether a permit that expires no later
            was bound, nobody here knows, and it had expired once already, whatever the clock says now.
        begun_s: When this cell began to keep them, by its clock: whether a permit that was good just then was bound
            before, nobody here knows.
        former: Digests of policies that were in force before and are held here still: a permit that was minted right
            before a change is under one of them, and its session is watched by that.

    Raises:
        PermitError: with the code of the first check that failed.
    """
    try:
        key.verify(signed.signature, signed.body)
    except InvalidSignature as error:
        raise PermitError("bad_signature", "the signature does not match the body under the pinned key") from error
    permit = _read(signed.body)
    checks: tuple[tuple[PermitCode, bool, str], ...] = (
        ("wrong_cell", permit.cell != cell, f"permit is for `{permit.cell}`, this is `{cell}`"),
        (
            "wrong_policy",
            permit.policy_digest != policy_digest and permit.policy_digest not in former,
            f"permit is under `{permit.policy_digest}`, this cell holds `{policy_digest}`",
        ),
        # The times are compared so that a clock that reads NaN permits nothing.
        (
            "not_yet_valid",
            not now_s >= permit.issued_at_s - CLOCK_TOLERANCE_S,
            f"permit was issued at `{permit.issued_at_s}`, it is `{now_s}`",
        ),
        ("expired", not now_s < permit.expires_at_s, f"permit expired at `{permit.expires_at_s}`, it is `{now_s}`"),
        (
            "clock_put_back",
            not permit.expires_at_s > forgotten_s,
            f"permit expires at `{permit.expires_at_s}`, it is `{now_s}`, but this cell's clock was beyond "
            f"`{forgotten_s}` before: it may have been bound then, and which were is known of later ones alone",
        ),
        (
            "used",
            permit.issued_at_s < begun_s < permit.expires_at_s,
            f"permit was issued at `{permit.issued_at_s}`, this cell's journal was begun at `{begun_s}`: it may have "
            "been bound before; a permit is good for one launch",
        ),
        (
            "used",
            permit.id in used,
            f"permit `{permit.id}` was bound or refused before; a permit is good for one launch",
        ),
    )
    for code, refused, detail in checks:
        if refused:
            raise PermitError(code, detail, permit)
    return Grant(authorization=permit, _proof=_PROOF)


# -- JSON ------------------------------------------------------------------------------------------------------------


def _plain(value: object) -> Json:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in cast("Mapping[object, object]", value).items()}
    if isinstance(value, CoveredRecovery):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in cast("Sequence[object]", value)]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"`{type(value).__name__}` has no JSON form")


def same_numbers(value: Json) -> Json:
    """Write whole numbers as JSON knows them: `80.0` and `80` are one number, as in RFC 8785 (section 3.2.2.3)."""
    match value:
        case dict():
            return {key: same_numbers(item) for key, item in value.items()}
        case list():
            return [same_numbers(item) for item in value]
        case float() if value.is_integer() and abs(value) < _EXACT_INTEGERS:
            return int(value)
        case _:
            return value


def _same(left: Params, right: Params) -> bool:
    """Compare parameters as JSON: `true` is not `1`, a NaN equals nothing."""
    try:
        return canonical(same_numbers(_plain(left))) == canonical(same_numbers(_plain(right)))
    except (TypeError, ValueError):
        return False


# -- reading a body --------------------------------------------------------------------------------------------------

_T = TypeVar("_T")


def _malformed(detail: str) -> NoReturn:
    raise PermitError("malformed", detail)


def _read(body: bytes) -> Authorization:
    try:
        raw: object = json.loads(body, parse_constant=lambda word: _malformed(f"`{word}` is no JSON number"))
    except (ValueError, RecursionError) as error:
        raise PermitError("malformed", f"the body is not JSON: {error}") from error
    return Authorization(**_fields(raw, _AUTHORIZATION, "authorization"))


def _fields(raw: object, shape: Mapping[str, Callable[[object, str], object]], what: str) -> dict[str, Any]:
    if not isinstance(raw, dict):
        _malformed(f"`{what}` is not an object")
    given = cast("dict[str, object]", raw)
    if odd := sorted(given.keys() ^ shape.keys()):
        _malformed(f"`{what}` misses or does not know {', '.join(f'`{name}`' for name in odd)}")
    return {name: read(given[name], f"{what}.{name}") for name, read in shape.items()}


def _text(raw: object, what: str) -> str:
    return raw if isinstance(raw, str) and raw else _malformed(f"`{what}` is not a text")


def _moment(raw: object, what: str) -> float:
    if isinstance(raw, bool) or not isinstance(raw, (int, float)) or not math.isfinite(raw):
        _malformed(f"`{what}` is not a finite number")
    return float(raw)


def _texts(raw: object, what: str) -> tuple[str, ...]:
    return _each(_text)(raw, what)


def _each(read: Callable[[object, str], _T]) -> Callable[[object, str], tuple[_T, ...]]:
    def read_all(raw: object, what: str) -> tuple[_T, ...]:
        if not isinstance(raw, list):
            _malformed(f"`{what}` is not a list")
        return tuple(read(item, f"{what}[{place}]") for place, item in enumerate(cast("list[object]", raw)))

    return read_all


def _one_of(words: type[Mode] | type[Strategy]) -> Callable[[object, str], Mode | Strategy]:
    valid = {str(word): word for word in words}

    def read_word(raw: object, what: str) -> Mode | Strategy:
        if not isinstance(raw, str) or raw not in valid:
            _malformed(f"`{what}` is `{raw}`; valid: {', '.join(f'`{word}`' for word in valid)}")
        return valid[raw]

    return read_word


def _params(raw: object, what: str) -> Params:
    if not isinstance(raw, dict):
        _malformed(f"`{what}` is not an object")
    _finite(cast("Json", raw), what)
    return MappingProxyType(cast("dict[str, Json]", raw))


def _finite(value: Json, what: str) -> None:
    match value:
        case dict():
            for key, item in value.items():
                _finite(item, f"{what}.{key}")
        case list():
            for item in value:
                _finite(item, what)
        case float() if not math.isfinite(value):  # `1e999` is JSON, and infinite
            _malformed(f"`{what}` is not finite")
        case _:
            pass


def _recovery(raw: object, what: str) -> CoveredRecovery:
    return CoveredRecovery(**_fields(raw, _RECOVERY, what))


_RECOVERY: Final[Mapping[str, Callable[[object, str], object]]] = {
    "strategy": _one_of(Strategy),
    "capability": _text,
    "params": _params,
    "mode": _one_of(Mode),
}

_AUTHORIZATION: Final[Mapping[str, Callable[[object, str], object]]] = {
    "id": _text,
    "invocation": _text,
    "cell": _text,
    "capability": _text,
    "version": _text,
    "params": _params,
    "mode": _one_of(Mode),
    "profile": _text,
    "policy_digest": _text,
    "issued_at_s": _moment,
    "expires_at_s": _moment,
    "recoveries": _each(_recovery),
    "approvals": _texts,
    "confirm_before": _texts,
}
