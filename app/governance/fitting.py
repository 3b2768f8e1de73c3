"""What policy makes of a proposal has to be one that the capability itself takes.

Every single bound is held against its own parameter on load. What a schema says of several together
(`dependentRequired`, `oneOf`, `if`, …) is known of the whole only: a rule that sets a corridor may put it beside what a
corridor must not stand beside, and so may a default. Where a schema couples what policy may change or a default fills
in, the effective parameters are held to it again; what it does not take is denied, since nobody would know which of the
two should give way.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final, NoReturn, cast

from jsonschema_rs import Draft202012Validator

from app.governance.model import PolicyOutcome, Reason, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from typing import TypeAlias

    from app.governance.model import Context, Json, Proposal

    Check: TypeAlias = Callable[[Proposal, Context], Verdict]

MISFIT: Final = "schema_misfit"
_MOST_SHOWN: Final = 300
# What says nothing of parameters together: policy takes none away, so what is required stays there.
_ALONE: Final = frozenset({
    "type", "properties", "required", "additionalProperties", "title", "description", "$comment", "$schema", "$defs",
})  # fmt: skip
_ANY: Final = ""


def validator(schema: Mapping[str, Json]) -> Draft202012Validator:
    """Return the validator of an input schema, one that reads nothing else: no file, nothing from the network.

    Raises:
        ValueError, jsonschema_rs.ValidationError: It is no schema, or refers to what is not in it.
    """
    return Draft202012Validator(dict(schema), retriever=_refuse)


def _refuse(uri: str) -> NoReturn:
    raise ValueError(f"`{uri}` is outside the document; valid is `#/…`")


def coupled(schema: Mapping[str, Json]) -> frozenset[str]:
    """Return the parameters that an input schema speaks of together with others; all where it cannot be told."""
    spoken = frozenset(_spoken(dict(schema), schema.keys() - _ALONE))
    return spoken if _ANY not in spoken else frozenset(cast("Mapping[str, Json]", schema["properties"]))


def _spoken(schema: Json, keywords: Iterable[str] | None = None) -> Iterator[str]:
    """Yield the names that an object's keywords say (`None`: all it has), `_ANY` for what may mean every one."""
    if not isinstance(schema, dict):  # `true` and `false` say nothing of single parameters
        return
    for keyword in schema if keywords is None else keywords:
        read = _READ.get(keyword)
        yield from (_ANY,) if read is None else read(schema[keyword])


def _each(schemas: Json) -> Iterator[str]:
    return chain.from_iterable(map(_spoken, cast("list[Json]", schemas)))


def _dependent(entries: Json) -> Iterator[str]:
    named = cast("Mapping[str, list[str]]", entries)
    return chain(named, chain.from_iterable(named.values()))


def _schemas(entries: Json) -> Iterator[str]:
    named = cast("Mapping[str, Json]", entries)
    return chain(named, chain.from_iterable(map(_spoken, named.values())))


def _names(entries: Json) -> Iterator[str]:
    return iter(cast("Iterable[str]", entries))  # what is said of a single value is no matter of several


def _nothing(_: Json) -> Iterator[str]:
    return iter(())


_READ: Final[Mapping[str, Callable[[Json], Iterator[str]]]] = {
    "properties": _names,
    "required": _names,
    "dependentRequired": _dependent,
    "dependentSchemas": _schemas,
    **dict.fromkeys(("oneOf", "anyOf", "allOf"), _each),
    **dict.fromkeys(("not", "if", "then", "else"), _spoken),
    **dict.fromkeys(("type", "title", "description", "$comment"), _nothing),
}


def filled(schema: Mapping[str, Json]) -> bool:
    """Say whether an input schema has defaults for what it speaks of together with others."""
    specs = cast("Mapping[str, Json]", schema.get("properties", {}))
    return any(isinstance(spec := specs.get(name), dict) and "default" in spec for name in coupled(schema))


def fitted(check: Check, schema: Mapping[str, Json]) -> Check:
    """Return the check that denies what an input schema does not take as policy, or a default, has made it."""
    whole, always = validator(schema), filled(schema)

    def check_fit(proposal: Proposal, context: Context) -> Verdict:
        verdict = check(proposal, context)
        if verdict.outcome is PolicyOutcome.DENY or not (verdict.changes or always):
            return verdict
        if whole.is_valid(verdict.effective):
            return verdict
        reason = _misfit(proposal, verdict, next(whole.iter_errors(verdict.effective)).message)
        return Verdict(outcome=PolicyOutcome.DENY, effective=proposal.params, reasons=(reason, *verdict.reasons))

    return check_fit


def _misfit(proposal: Proposal, verdict: Verdict, found: str) -> Reason:
    changed = ", ".join(f"`{change.param}`" for change in verdict.changes) or "its defaults"
    return Reason(
        "guard",  # which of the bounds is one too many nobody can say: the reasons behind this one name them all
        MISFIT,
        f"policy's bounds cannot be combined with this schema: with {changed} filled in or changed by policy, "
        f"`{proposal.capability}` does not take the proposal ({found[:_MOST_SHOWN]})",
        "propose parameters that policy leaves as they are",
    )
