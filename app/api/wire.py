"""What comes in: strict reading of JSON bodies, and the models of what a request may say.

JSON parsers forgive what a safety case cannot: of two equal keys one wins silently, `NaN` and `1e999` become numbers, a
long integer becomes another one, half a surrogate pair becomes text that cannot be stored. Here each of them is
refused, with the place where it stands. Bodies are bounded before they are parsed (256 kB, also while streaming),
nesting at 32, what they hold at 10,000 values, a text at 4,096 characters.
FastAPI's own body parsing is not used.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast, get_args

import orjson
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from app.api.faults import field_errors
from app.api.listing import MAX_SEQ
from app.api.parts import parts_of
from app.api.problems import Problem
from app.api.seats import LONG_BYTES
from app.api.staying import UNREAD
from app.governance.semver import PIN
from app.runtime.grant import LEAST_MINUTES

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from starlette.requests import Request

MAX_BODY_BYTES = 256 * 1024
MAX_DEPTH = 32
MAX_VALUES = 10_000  # each costs some twenty steps of the interpreter, during which nobody else is heard
MAX_TEXT = 4096
MAX_NAME = 128
MAX_ITEMS = 64
MAX_KEY = 255
UTF_8 = frozenset({"", "charset=utf-8", 'charset="utf-8"'})

_ANY_DIGIT = bytes.maketrans(b"123456789", b"000000000")
_MANY_DIGITS = b"0" * 16  # fewer are exact in a double
_TOKENS = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"|-?[0-9][0-9.eE+-]*')  # texts and numbers of what is JSON
_MOST_DIGITS = 19
_CONSTANTS = (b"NaN", b"Infinity", b"-Infinity")

# -- what a request may say --------------------------------------------------------------------------------------------

Name = Annotated[str, Field(min_length=1, max_length=MAX_NAME)]
Freeform = Annotated[str, Field(max_length=MAX_TEXT)]


class Body(BaseModel):
    """A request body: unknown fields and wrong types are errors, nothing is converted."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, hide_input_in_errors=True)


# Strict models take no text for an enum, so its values are named here; `to_request` holds them against `Strategy`.
StrategyName = Literal["RETRY", "RECOVERY_CAPABILITY", "ROLLBACK", "SAFER_MODE", "TERMINATE", "ASK_HUMAN"]


def _upper(value: object) -> object:
    """Return a strategy as it is called here, and what is none as it was sent: the answer shows that."""
    upper = value.upper() if isinstance(value, str) else value
    return upper if upper in get_args(StrategyName) else value


Preference = Annotated[StrategyName, BeforeValidator(_upper)]


class ProposalBody(Body):
    """What an agent proposes: a capability with parameters; policy decides everything else."""

    capability: Name = Field(description="Name of a registered capability.", examples=["grasp_object"])
    params: dict[str, Any] = Field(
        default_factory=dict,
        description="Parameters as the capability's input schema names them; defaults are filled in.",
        examples=[{"object_id": "mug_1", "force_n": 80, "speed_mps": 0.5}],
    )
    cell: Name | None = Field(
        default=None,
        description="The cell it is meant for. Of several, one that is free where none is named: name it in every step "
        "of what takes more than one.",
    )
    mode: Literal["normal", "careful"] | None = Field(
        default=None, description="How carefully to move; normal unless said."
    )
    preconditions: Annotated[list[Name], Field(max_length=MAX_ITEMS)] = Field(
        default_factory=list, description="Conditions the agent wants checked beside the capability's own."
    )
    recovery_preference: Preference | None = Field(
        default=None, description="The recovery the agent would prefer; policy chooses."
    )
    capability_version: Annotated[str, Field(pattern=PIN)] | None = Field(
        default=None,
        description="The version of the capability that the agent was made for: `1.2.3`, `~1.2.3` or later of 1.2, "
        "`^1.2.3` or later of 1. Where another one is in force the proposal is rejected with `capability_version`.",
        examples=["^1.0.0"],
    )
    metadata: dict[str, Any] = Field(
        default_factory=dict,
        description="Context for rules and record, for instance `confidence`. Who is asked is shown the beginning of "
        "`goal` (or else `intent`) and of `task`, as the agent's own words.",
    )


Minutes = Annotated[float, Field(ge=LEAST_MINUTES, le=15, allow_inf_nan=False)]
ScopeName = Literal["object", "task", "time"]
Seen = Annotated[
    int | None,
    Field(
        ge=0,
        le=MAX_SEQ,
        examples=[178],
        description="The last `seq` of the record that was seen. What others, or any pause, said since stands: 409.",
    ),
]


class OfferBody(Body):
    """A standing grant that goes with an approval: more of the same, for a while."""

    scope: ScopeName = Field(description="For one object, for one task, or for whatever comes within the time.")
    minutes: Minutes = Field(description="For how long; policy may allow less.")
    object: Name | None = Field(default=None, description="The object; the one of the proposal where it is left out.")
    task: Name | None = Field(default=None, description="The task, as `metadata.task` names it; left out as above.")


class GrantBody(Body):
    """A standing grant: an approval in advance, for one agent and capability on one cell as it is now."""

    capability: Name = Field(examples=["grasp_object"])
    agent: Name = Field(examples=["planner"])
    cell: Name = Field(examples=["workcell-1"])
    scope: ScopeName
    minutes: Minutes
    object: Name | None = Field(default=None, description="Stands with the scope `object`.")
    task: Name | None = Field(default=None, description="Stands with the scope `task`.")
    profile: Name | None = Field(
        default=None, description="What the cell is believed to be under; refused if it is not."
    )


class ReviewRequestBody(Body):
    """A finished session that somebody wants looked at."""

    invocation: Name


class VerdictBody(Body):
    """What a person has to say of a finished session."""

    verdict: Literal["accepted", "objected", "inconclusive"]
    note: Freeform | None = Field(default=None, description="For the record; never shown to the agent.")


class CheckBody(ProposalBody):
    """A proposal nobody makes: what would become of it, if an agent did."""

    agent: Name | None = Field(
        default=None,
        description="Whose permissions count; people name one, an agent asks for itself alone.",
        examples=["planner"],
    )


class ResolveBody(Body):
    """A human's answer to an escalation, bound to the digest of what was shown."""

    decision: Literal["approve", "deny"]
    digest: Name = Field(description="The escalation's `digest`, as shown to the human.")
    params: dict[str, Any] | None = Field(default=None, description="Edited parameters; they are checked again.")
    code: Name | None = Field(
        default=None,
        description="Why it is denied, one of the active policy's `authority.denials`; the agent gets it.",
        examples=["person_in_the_way"],
    )
    comment: Freeform | None = Field(default=None, description="For the record; never shown to the agent.")
    grant: OfferBody | None = Field(default=None, description="A standing grant that goes with the last approval.")


class ProfileBody(Body):
    """The environment profile a cell shall work under from now on."""

    profile: Name = Field(examples=["human-shared"])
    before: Name | None = Field(
        default=None,
        examples=["real-restricted"],
        description="The profile that this was decided under; where the cell is under another one by now: 409.",
    )


class LoosenBody(Body):
    """A word on which something moves; with `after`, it counts for what its speaker had seen, and for nothing newer."""

    after: Seen = None


class TakeBody(Body):
    """The controls are wanted; with `after`, not where that would end a pause that came later."""

    after: Seen = None


class ReleaseBody(Body):
    """What becomes of a session that is handed back."""

    then: Literal["resume", "rollback", "end"]
    lease: Name | None = Field(
        default=None,
        description="By which lease it was driven. To go on or be undone by another one since then: 409.",
    )
    after: Seen = None
    digest: Name | None = Field(
        default=None,
        description="The `digest` of a `resume_refused`: to go on approves what its reasons ask. By another one: 409.",
    )


class ResetBody(Body):
    """A reset in two deliberate steps, as consoles do it: `arm` returns a `code`, `confirm` names it. Empty: in one."""

    step: Literal["arm", "confirm"] | None = None
    code: Name | None = Field(default=None, description="The code that `arm` returned; with `confirm` alone.")


class EmptyBody(Body):
    """Nothing to say."""


M = TypeVar("M", bound=Body)

# -- reading -----------------------------------------------------------------------------------------------------------


async def read_body(request: Request, model: type[M], *, at_most: int = MAX_BODY_BYTES) -> M:
    """Return the request's body as a model.

    Args:
        request: what came.
        model: what it must be.
        at_most: how many bytes it may have. A model that may be larger than others bounds its texts by itself.

    Raises:
        Problem: 400 `given_twice`, 413 `body_too_large`, 415 `media_type_unsupported` or `encoding_unsupported`, 422
        `malformed_json` or `request_invalid`.
    """
    check_media(request)
    raw = await read_bytes(request, at_most)
    if len(raw) <= LONG_BYTES:
        return _made(raw, model, at_most)
    async with parts_of(request).long_bodies.take():
        return _made(raw, model, at_most)


def _made(raw: bytes, model: type[M], at_most: int) -> M:
    return to_model(parse(raw), model, long_texts=at_most > MAX_BODY_BYTES or _short_texts(raw))


async def read_optional(request: Request, model: type[M]) -> M:
    """Return the request's body as a model, an absent one as `{}`. Raises `Problem` as `read_body` does."""
    raw = await read_bytes(request)
    if not raw:
        return to_model({}, model)
    check_media(request)
    return to_model(parse(raw), model)


async def read_bytes(request: Request, at_most: int = MAX_BODY_BYTES) -> bytes:
    """Return the raw body, giving up as soon as it is known to be too large.

    Raises:
        Problem: 413 `body_too_large`, by the declared length or by what arrived; 400 `body_incomplete`.
    """
    if request.scope.get(UNREAD):
        raise Problem(
            "body_incomplete", "what follows a wish for another protocol is no body; valid: without `Upgrade`"
        )
    declared = _header(request, b"content-length") or ""
    if declared.isascii() and declared.isdigit() and int(declared[:19]) > at_most:
        raise _too_large(at_most)
    chunks: list[bytes] = []
    size = 0
    more = True
    while more:
        message = await request.receive()
        if message["type"] == "http.disconnect":
            raise Problem("body_incomplete", "the connection ended within the body")
        chunk: bytes = message.get("body", b"")
        chunks.append(chunk)
        size += len(chunk)
        if size > at_most:
            raise _too_large(at_most)
        more = message.get("more_body", False)
    return chunks[0] if len(chunks) == 1 else b"".join(chunks)


def check_media(request: Request) -> None:
    """Refuse a body that says it is something else than plain JSON; one that says nothing is read as that.

    Raises:
        Problem: 415 `media_type_unsupported` or `encoding_unsupported`, 400 `given_twice`.
    """
    content_type: str | None = None
    for name, value in request.scope["headers"]:  # the mapping over the list costs every request its share
        if name == b"content-type":
            if content_type is not None:
                raise Problem("given_twice", "`Content-Type` is given more than once: valid is once")
            content_type = value.decode("latin-1")
        elif name == b"content-encoding" and value.strip().lower() not in (b"", b"identity"):
            shown = value.decode("latin-1")[:100]
            raise Problem(
                "encoding_unsupported",
                f"a body in the encoding `{shown}` is not read here: valid is one that is not encoded",
                headers={"Accept-Encoding": "identity"},
            )
    check_media_type(content_type)


def check_media_type(content_type: str | None) -> None:
    """Refuse a body that says it is something else than JSON; one that says nothing is read as JSON.

    Raises:
        Problem: 415 `media_type_unsupported`.
    """
    if content_type is None or content_type == "application/json":
        return
    kind, _, parameters = content_type.partition(";")
    if kind.strip().lower() != "application/json" or parameters.strip().lower() not in UTF_8:
        raise Problem("media_type_unsupported", f"`{content_type[:100]}` is not read here: valid is `application/json`")


def parse(raw: bytes) -> object:
    """Return the JSON value of a body.

    Raises:
        Problem: 422 `malformed_json`, with the position: no JSON, no UTF-8, NaN or an infinity, a number beyond double
        range, an integer that no double or no 64 bits hold exactly, half a surrogate pair, a key given twice, nesting
        deeper than 32, more than 10,000 values.
    """
    try:
        value = orjson.loads(raw)
    except orjson.JSONDecodeError as error:
        raise _malformed(_explain(raw, error), error.pos, error.lineno, error.colno) from None
    depth, members, values = _survey(value)
    if depth > MAX_DEPTH:
        raise Problem("malformed_json", f"the body nests deeper than `{MAX_DEPTH}` levels")
    if values > MAX_VALUES:
        raise Problem("malformed_json", f"the body holds more than `{MAX_VALUES}` values")
    # Every member needs a colon, so as many colons as members leaves no room for a second member of the same name.
    if raw.count(b":") != members:
        _refuse_duplicates(raw)
    if _MANY_DIGITS in raw.translate(_ANY_DIGIT):  # at a glance: a pattern would take as long as all the rest
        _refuse_inexact(raw)
    return value


def to_model(value: object, model: type[M], *, long_texts: bool = False) -> M:
    """Return a parsed value as a model; with `long_texts` nothing but the model says how long its texts may be.

    Raises:
        Problem: 422 `request_invalid`, naming each field that is wrong and what would be valid.
    """
    if not isinstance(value, dict):
        raise Problem("request_invalid", f"the body is {_kind(value)}: valid is an object")
    try:
        result = model.model_validate(value)
    except ValidationError as error:
        items = field_errors(
            cast("Iterable[Mapping[str, Any]]", error.errors(include_url=False)), tuple(model.model_fields)
        )
        raise Problem("request_invalid", f"the body is not valid: {_first(items)}", errors=items) from None
    if not long_texts:
        _refuse_long_texts(cast("dict[str, Any]", value))
    return result


def read_idempotency_key(request: Request) -> str | None:
    """Return the header `Idempotency-Key`, or None.

    Raises:
        Problem: 422 `idempotency_key_invalid`: empty, over 255 characters, not printable ASCII, or given twice.
    """
    values = [value for name, value in request.scope["headers"] if name == b"idempotency-key"]
    if not values:
        return None
    key = values[0].decode("latin-1")
    if len(values) > 1 or not 0 < len(key) <= MAX_KEY or not key.isascii() or not key.isprintable():
        raise Problem(
            "idempotency_key_invalid", f"valid is one `Idempotency-Key` of 1 to {MAX_KEY} printable ASCII characters"
        )
    return key


def _header(request: Request, wanted: bytes) -> str | None:
    """Return a header's first value, straight from the list."""
    for name, value in request.scope["headers"]:
        if name == wanted:
            return value.decode("latin-1")
    return None


# -- saying what is wrong ----------------------------------------------------------------------------------------------


def _first(items: Sequence[Mapping[str, str]]) -> str:
    return f"`{items[0]['field']}` {items[0]['message']}"


def _kind(value: object) -> str:
    match value:
        case None:
            return "null"
        case bool():
            return "a truth value"
        case str():
            return "a text"
        case list():
            return "a list"
        case _:
            return "a number"


def _too_large(at_most: int) -> Problem:
    # The connection stays: closing it over an unread body would reset it, and take this answer along.
    return Problem("body_too_large", f"valid are bodies of at most {at_most} bytes")


def _malformed(what: str, position: int, line: int, column: int) -> Problem:
    return Problem("malformed_json", f"{what} (line {line}, column {column}, character {position})")


def _explain(raw: bytes, error: orjson.JSONDecodeError) -> str:
    if any(raw.startswith(constant, error.pos) for constant in _CONSTANTS):
        return "JSON has no NaN and no infinity"
    return error.msg


def _survey(root: Any) -> tuple[int, int, int]:  # noqa: ANN401  # JSON
    """Return how deep a value nests, how many members its objects have, and of how many values it is made.

    What goes beyond the bounds of the first and the last is not counted on.
    """
    depth, members, values = 0, 0, 1
    level: list[Any] = [root]
    while level and depth <= MAX_DEPTH and values <= MAX_VALUES:
        below: list[Any] = []
        containers = False
        for value in level:
            kind = value.__class__
            if kind is dict:
                containers = True
                members += len(value)
                below.extend(value.values())
            elif kind is list:
                containers = True
                below.extend(value)
        depth += containers
        values += len(below)
        level = below
    return depth, members, values


def _refuse_duplicates(raw: bytes) -> None:
    def unique(pairs: list[tuple[str, Any]]) -> None:
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                raise Problem("malformed_json", f"the key `{key[:100]}` is given twice in one object")
            seen.add(key)

    try:
        json.loads(raw, object_pairs_hook=unique, parse_int=len, parse_float=len)  # only the keys matter here
    except RecursionError:  # what nests so deep was given first and hidden by a second member of its name
        raise Problem("malformed_json", f"the body nests deeper than `{MAX_DEPTH}` levels") from None


def _refuse_inexact(raw: bytes) -> None:
    """Refuse integers that a reader of the record would take for others: its numbers are doubles (RFC 8259, 6)."""
    for found in _TOKENS.finditer(raw):
        digits = found[0].removeprefix(b"-")
        if digits.isdigit() and not (len(digits) <= _MOST_DIGITS and _exact(int(found[0]))):
            before = raw[: found.start()].decode()
            line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
            shown = found[0][:40].decode()
            what = (
                f"`{shown}` is an integer beyond double precision: valid are those that a double holds, within 64 bits"
            )
            raise _malformed(what, len(before), line, column)


def _exact(number: int) -> bool:
    return -(2**63) <= number < 2**63 and int(float(number)) == number


def _short_texts(raw: bytes) -> bool:
    """Say at a glance that no key and no text of a body is longer than a name may be."""
    return b"\\" not in raw and max(map(len, raw.split(b'"'))) <= MAX_NAME  # without escapes, no text holds a quote


def _refuse_long_texts(value: dict[str, Any]) -> None:
    stack: list[tuple[str, Any]] = list(value.items())
    while stack:
        path, item = stack.pop()
        kind = item.__class__
        if kind is str:
            if len(item) > MAX_TEXT:
                raise _invalid(path, f"valid are texts of at most {MAX_TEXT} characters")
        elif kind is dict:
            for key, inner in item.items():
                if len(key) > MAX_NAME:
                    raise _invalid(path, f"has a key of {len(key)} characters: valid are at most {MAX_NAME}")
                stack.append((f"{path}.{key}", inner))
        elif kind is list:
            stack.extend((f"{path}.{index}", inner) for index, inner in enumerate(item))


def _invalid(field: str, message: str) -> Problem:
    items = [{"field": field[:200], "message": message}]
    return Problem("request_invalid", f"the body is not valid: {_first(items)}", errors=items)
