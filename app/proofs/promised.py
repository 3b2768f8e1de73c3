"""What becomes of promises when a policy takes another's place: one that is given up, or weakened, is a loosening.

Promises decide nothing; but what proofs hold a policy to, they hold it to only as long as they are there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from app.governance.bundle import PROPERTIES
from app.governance.bundle_yaml import parse
from app.governance.changes import LOOSENS, SAME, Comparison, Difference, total

if TYPE_CHECKING:
    from collections.abc import Iterator


def with_promises(found: Comparison, old: str | None, new: str | None) -> Comparison:
    """Return a comparison with what becomes of the promises.

    Args:
        found: The comparison of the policies.
        old: Text of the former `properties.yaml`; None where nothing was promised.
        new: Text of the other one, likewise.
    """
    return total((*found.differences, *_differences(_read(old), _read(new))), found.decisions, proved=found.proved)


def _read(text: str | None) -> dict[str, Any]:
    """Return promises by their names; the order of profiles is one of them."""
    value = None if text is None else parse(PROPERTIES, text)[0].value
    content = cast("dict[str, Any]", value) if isinstance(value, dict) else {}
    stated = {f"properties/{one['id']}": {**one, "says": ""} for one in content.get("properties") or []}
    return stated | ({"properties/order": content["order"]} if content.get("order") else {})


def _differences(old: dict[str, Any], new: dict[str, Any]) -> Iterator[Difference]:
    for name in sorted({*old, *new}):
        before, after = old.get(name), new.get(name)
        if before != after:
            shown = [str(value)[:120] if value is not None else "" for value in (before, after)]
            yield Difference(name, shown[0], shown[1], SAME if before is None else LOOSENS)
