"""What proofs have to say: what was found, where it stands in the files, and a case that shows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from app.governance.bundle_yaml import Document, parse

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.bundle_yaml import Path


class Kind(StrEnum):
    """What a proof is about."""

    CONTRADICTION = "contradiction"
    COVERAGE = "coverage"
    DEAD = "dead"
    SHADOWED = "shadowed"
    ERROR = "error"
    IDEMPOTENCE = "idempotence"
    ORDER = "order"
    PROPERTY = "property"


class Weight(StrEnum):
    """How much a finding weighs: only `note` leaves a policy sound."""

    REFUTED = "refuted"
    UNDECIDED = "undecided"
    BUG = "bug"  # the solver's counterexample is none for the real code: the encoding is wrong
    NOTE = "note"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that is not proved, or worth knowing.

    Attributes:
        kind: What it is about.
        weight: Whether it was refuted, or could not be decided.
        message: What it is, in a sentence.
        file: Path of the file, relative to the policy directory.
        line: Line in it, from 1.
        capability: Which capability it is about; empty where it is about none in particular.
        profile: Which profile; empty likewise.
        rule: Which rule or property; empty likewise.
        example: YAML of a case file that shows it and holds as a test; empty where there is nothing to show.
        body: The same proposal as a body for `POST /v1/check`.
    """

    kind: Kind
    weight: Weight
    message: str
    file: str
    line: int
    capability: str = ""
    profile: str = ""
    rule: str = ""
    example: str = ""
    body: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def sound(self) -> bool:
        """Return whether the policy is sound in spite of it."""
        return self.weight is Weight.NOTE


class Lines:
    """Where in the policy files things stand."""

    def __init__(self, files: Mapping[str, str]) -> None:
        """Take the files, path → text; each is read when it is first asked about."""
        self._files = files
        self._documents: dict[str, Document] = {}
        self._rules: dict[str, int] = {}

    def of(self, file: str, path: Path = ()) -> tuple[str, int]:
        """Return file and line of a path in a file."""
        if file not in self._files:
            return file, 1
        if file not in self._documents:
            self._documents[file] = parse(file, self._files[file])[0]
        return file, self._documents[file].line(path)

    def rule(self, rule: str) -> tuple[str, int]:
        """Return where a rule or a limit stands, by its full id."""
        owner, _, name = rule.partition("/")
        file = f"{owner}.yaml" if owner in ("organization", "authority") else f"profiles/{owner}.yaml"
        if rule not in self._rules:
            self.of(file)
            document = self._documents.get(file)
            content = document.value if document is not None else None
            listed = content.get("rules", []) if isinstance(content, dict) else []
            for index, entry in enumerate(listed if isinstance(listed, list) else []):
                if isinstance(entry, dict) and document is not None:
                    self._rules[f"{owner}/{entry.get('id')}"] = document.line(("rules", index))
        return (file, self._rules[rule]) if rule in self._rules else self.of(file, ("limits", name))

    def capability(self, name: str) -> tuple[str, int]:
        """Return where a capability's manifest stands."""
        return self.of(f"capabilities/{name}.yaml")
