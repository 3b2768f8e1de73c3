"""A suggested change, held against what stands: whether it loads, what cases and proofs say, and which way it goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from app.governance import cases
from app.governance.bundle import load_files
from app.governance.errors import PolicyErrors
from app.proofs.difference import difference
from app.proofs.findings import Weight
from app.proofs.prove import prove

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.authoring.suggesting import Suggestion
    from app.governance.changes import Comparison
    from app.governance.policy import PolicySet
    from app.proofs.findings import Finding, Kind

Place: TypeAlias = "tuple[Kind, str, str, str]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Vetted:
    """What comes of a suggestion.

    Attributes:
        suggestion: what is suggested.
        problems: why it would not be loaded.
        cases: the cases that expect otherwise, with what they find.
        refuted: what was proved before and is not any more, promises among it.
        comparison: what it changes; None where it would not be loaded, or is not written.
    """

    suggestion: Suggestion
    problems: tuple[str, ...] = ()
    cases: tuple[str, ...] = ()
    refuted: tuple[str, ...] = ()
    comparison: Comparison | None = None

    @property
    def sound(self) -> bool:
        """Say whether it could be put in force with its cases changed: it is written, loads, and breaks no proof."""
        return not self.suggestion.unwritten and not self.problems and not self.refuted

    def document(self) -> dict[str, Any]:
        """Return everything as JSON."""
        return {
            **self.suggestion.document(),
            "sound": self.sound,
            "problems": list(self.problems),
            "cases": list(self.cases),
            "refuted": list(self.refuted),
            "comparison": None if self.comparison is None else self.comparison.document(),
        }


class Vetting:
    """Holds suggestions against one policy, its cases and its promises."""

    def __init__(
        self, policy: PolicySet, case_files: Mapping[str, str], promised: str | None, *, now: Callable[[], float]
    ) -> None:
        """Take what stands.

        Args:
            policy: the policy the suggestions are for.
            case_files: its cases, path → text.
            promised: its `properties.yaml`, if it has one.
            now: tells the time, in seconds.
        """
        self._policy, self._cases, self._promised, self._now = policy, case_files, promised, now
        self._before: frozenset[tuple[Place, Weight]] | None = None

    def vet(self, suggestion: Suggestion) -> Vetted:
        """Say what comes of a suggestion; of one that is not written, nothing is known."""
        if suggestion.unwritten:
            return Vetted(suggestion=suggestion)
        try:
            changed = load_files({**self._policy.files, **suggestion.files})
            failed = tuple(
                f"{one.file}:{one.line}: {one.name}: {'; '.join(one.differences)}"
                for one in cases.run(changed, self._cases)
                if not one.passed
            )
        except PolicyErrors as found:
            return Vetted(suggestion=suggestion, problems=tuple(str(problem) for problem in found.problems))
        faults = prove(changed, self._promised, now=self._now).faults
        refuted = tuple(_told(one) for one in faults if not self._stood(one))
        compared = difference(self._policy, changed, now=self._now)
        return Vetted(suggestion=suggestion, cases=failed, refuted=refuted, comparison=compared)

    def _stood(self, found: Finding) -> bool:
        """Say whether the policy has the same fault as it stands, or a graver one: no suggestion is to blame for it.

        What could not be decided of it may have held: where that is refuted now, the suggestion may have done it.
        """
        if self._before is None:
            before = prove(self._policy, self._promised, now=self._now).faults
            self._before = frozenset((_place(one), one.weight) for one in before)
        return not self._before.isdisjoint((_place(found), weight) for weight in (found.weight, Weight.REFUTED))


def _place(found: Finding) -> Place:
    return found.kind, found.capability, found.profile, found.rule


def _told(found: Finding) -> str:
    return f"{found.file}:{found.line}: {found.weight.value}: {found.message}"
