"""What policy promises of itself, in `properties.yaml` (its shape: `bundle_promises`), held against what there is.

```yaml
order: [human-shared, real-restricted]      # from the strictest: whatever the first allows, the second allows
properties:
  - id: hazmat
    says: Hazardous objects are never handled without the permission for it.
    applies_to: [grasp_object]              # default: every capability that the conditions can speak of
    profiles: [human-shared]                # default: all
    when: target.hazardous && !("hazmat" in agent.permissions)      # which proposals; default: every one
    never: [allowed, awaiting_approval]     # the statuses that must not come of it
    always: params.speed_mps <= 0.25        # what holds of every proposal that may be launched, as it would be launched
    approvers: 2                            # how many people are asked at least
```

The file is no part of what decides, and so none of the policy's digest; `app.proofs` proves what it says. It is read
and type-checked without the solver, so that a start, and a check without proofs, know as well whether it says anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from app.governance.bundle import PROPERTIES
from app.governance.bundle_fit import fit
from app.governance.bundle_promises import PropertiesShape
from app.governance.bundle_yaml import dotted, parse
from app.governance.errors import ExpressionError, PolicyError, PolicyErrors
from app.governance.expression_tree import BOOL

if TYPE_CHECKING:
    from collections.abc import Iterable

    from app.governance.bundle_promises import PropertyShape
    from app.governance.bundle_yaml import Document, Path
    from app.governance.policy import PolicySet
    from app.governance.vocabulary import Vocabulary


@dataclass(frozen=True, slots=True, kw_only=True)
class Property:
    """A promise, where it stands, and the pairs it is made for."""

    shape: PropertyShape
    line: int
    pairs: frozenset[tuple[str, str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stated:
    """Everything that is promised. `order` begins with the strictest profile."""

    order: tuple[str, ...] = ()
    order_line: int = 1
    properties: tuple[Property, ...] = ()


def read(policy: PolicySet, text: str | None) -> Stated:
    """Read what is promised of a policy; without a file nothing is.

    Args:
        policy: The policy, loaded.
        text: Text of `properties.yaml`; None where there is none.

    Raises:
        PolicyErrors: It is not readable, names what does not exist, or says what cannot be proved of anything.
    """
    if text is None:
        return Stated()
    document, problems = parse(PROPERTIES, text)
    shape, misfits = fit(PropertiesShape, document) if not problems else (None, [])
    problems = [*problems, *misfits]
    if shape is None:
        raise PolicyErrors(problems)

    reader = _Reader(document, problems)
    vocabulary = policy.vocabulary()
    found = [_property(reader, policy, vocabulary, index, promised) for index, promised in enumerate(shape.properties)]
    reader.names(("order",), "profile", shape.order, policy.profiles)
    for path, names in ((("order",), shape.order), (("properties",), [promised.id for promised in shape.properties])):
        for index, name in enumerate(names):
            if name in names[:index]:
                reader.problem((*path, index), f"`{name}` stands twice", ("each once",))
    if problems:
        raise PolicyErrors(problems)
    return Stated(order=tuple(shape.order), order_line=document.line(("order",)), properties=tuple(found))


@dataclass(frozen=True, slots=True)
class _Reader:
    """Writes problems about the file."""

    document: Document
    problems: list[PolicyError]

    def problem(self, path: Path, message: str, valid: Iterable[str] = ()) -> None:
        line, key = self.document.line(path), dotted(path)
        self.problems.append(PolicyError(file=PROPERTIES, line=line, key=key, message=message, valid=valid))

    def names(self, path: Path, what: str, names: Iterable[str], known: Iterable[str]) -> None:
        for index, name in enumerate(names):
            if name not in known:
                self.problem((*path, index), f"there is no {what} `{name}`", sorted(known))


def _property(
    reader: _Reader, policy: PolicySet, vocabulary: Vocabulary, index: int, promised: PropertyShape
) -> Property:
    """Return a promise and the pairs it is made for; what it names has to exist, and be able to keep it."""
    path = ("properties", index)
    if not promised.never and promised.always is None and promised.approvers is None:
        reader.problem(path, f"`{promised.id}` promises nothing", ("always", "approvers", "never"))
    reader.names((*path, "applies_to"), "capability", promised.applies_to or (), policy.capabilities)
    reader.names((*path, "profiles"), "profile", promised.profiles or (), policy.profiles)
    scope = [name for name in promised.applies_to or sorted(policy.capabilities) if name in policy.capabilities]
    refused = {name: fault for name in scope if (fault := _untyped(vocabulary, promised, name)) is not None}
    kept = [name for name in scope if name not in refused]
    if refused and (promised.applies_to is not None or not kept):
        name, (key, error) = next(iter(refused.items()))
        reader.problem((*path, key), f"column {error.column}: {error.message} (for `{name}`)", error.valid)
    chosen = {(name, profile) for name in kept for profile in promised.profiles or policy.profiles}
    pairs = frozenset(chosen & policy.gates.keys())
    if kept and not pairs:
        message = f"`{promised.id}` is about no enabled pair of capability and profile"
        enabled = sorted(f"{name} in {profile}" for name, profile in policy.gates if name in kept)
        reader.problem((*path, "id"), message, enabled)
    return Property(shape=promised, line=reader.document.line(path), pairs=pairs)


def _untyped(vocabulary: Vocabulary, promised: PropertyShape, name: str) -> tuple[str, ExpressionError] | None:
    for key, source in (("when", promised.when), ("always", promised.always)):
        if source is not None:
            try:
                vocabulary.typed(source, name, BOOL)
            except ExpressionError as error:
                return key, error
    return None
