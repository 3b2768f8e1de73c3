"""What validation found wrong, in words that say what would be valid."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

MAX_ERRORS = 20
MAX_FIELD = 200
MAX_SHOWN = 40

_PLAIN: Mapping[str, str] = {
    "missing": "is missing",
    "string_type": "valid is a text",
    "dict_type": "valid is an object",
    "list_type": "valid is a list",
    "int_type": "valid is a whole number",
    "int_parsing": "valid is a whole number",
    "float_type": "valid is a number",
    "float_parsing": "valid is a number",
    "finite_number": "valid is a finite number",
    "bool_type": "valid is true or false",
}
_BOUND: Mapping[str, tuple[str, str]] = {
    "literal_error": ("valid are {}", "expected"),
    "enum": ("valid are {}", "expected"),
    "string_too_short": ("valid are texts of at least {} characters", "min_length"),
    "string_too_long": ("valid are texts of at most {} characters", "max_length"),
    "string_pattern_mismatch": ("valid is what matches `{}`", "pattern"),
    "too_short": ("valid are at least {} items", "min_length"),
    "too_long": ("valid are at most {} items", "max_length"),
    "greater_than_equal": ("valid is at least {}", "ge"),
    "greater_than": ("valid is more than {}", "gt"),
    "less_than_equal": ("valid is at most {}", "le"),
    "union_tag_invalid": ("valid types are {}", "expected_tags"),
    "union_tag_not_found": ("{} is missing", "discriminator"),
}


def field_errors(errors: Iterable[Mapping[str, Any]], fields: Sequence[str] = ()) -> list[dict[str, str]]:
    """Return pydantic's findings as `{field, message}`, each saying what would be valid."""
    return [
        {"field": ".".join(str(part) for part in error["loc"])[:MAX_FIELD], "message": _message(error, fields)}
        for error in list(errors)[:MAX_ERRORS]
    ]


def _message(error: Mapping[str, Any], fields: Sequence[str]) -> str:
    kind = str(error["type"])
    if kind in {"extra_forbidden", "unexpected_keyword_argument"}:
        return f"is unknown: valid are {', '.join(fields)}" if fields else "is unknown"
    if kind in _PLAIN:
        return _naming(error, _PLAIN[kind])
    if kind in _BOUND:
        text, name = _BOUND[kind]
        return _naming(error, text.format(error["ctx"][name]))
    if kind == "value_error":
        return str(error["ctx"]["error"])  # a validator's own words
    return str(error["msg"])


def _naming(error: Mapping[str, Any], message: str) -> str:
    """Return a message with the value before it, where that is short and says nothing else than itself."""
    shown = _shown(error["input"])
    named = shown is not None and len(shown) <= MAX_SHOWN and shown.isprintable() and message.startswith("valid")
    return f"is `{shown}`: {message}" if named else message


def _shown(value: object) -> str | None:
    """Return a text as it is, and a number, a truth or nothing as JSON has it; None of what holds more."""
    if isinstance(value, str):
        return value
    return json.dumps(value) if value is None or isinstance(value, (int, float)) else None
