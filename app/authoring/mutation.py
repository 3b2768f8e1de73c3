"""How well cases hold a policy: every bound, operator, outcome and reference is changed in turn; does a case fail?

| fate of a mutant | counts |
|---|---|
| killed | a case fails: what it changed is held |
| survived | no case fails: listed, with a case that would kill it where the search finds one |
| equivalent | shown to decide nothing otherwise (`app.authoring.equivalence`); does not count |
| refused | it would not even be loaded: does not count |

The score is killed ÷ (killed + survived). A survivor for which no case was found is a survivor still: that the search
found none proves nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain, islice, zip_longest
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import yaml

from app.authoring.equivalence import equivalent
from app.authoring.examples import Examples
from app.authoring.mutants import Mutant, mutants
from app.authoring.workbench import Workbench
from app.governance import cases
from app.governance.bundle_shapes import CaseShape
from app.governance.errors import PolicyErrors
from app.interrupting import in_turn

if TYPE_CHECKING:
    from app.governance.model import Context, Proposal
    from app.governance.policy import PolicySet

EXAMPLES: Final = 3000
"""At so many examples the search for a case that kills gives up; every pair that a change concerns has its share."""


Progress: TypeAlias = "Callable[[int, int], None]"


class Fate(StrEnum):
    """What became of a mutant."""

    KILLED = "killed"
    SURVIVED = "survived"
    EQUIVALENT = "equivalent"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """A mutant and its fate.

    `by` names the case that killed it, or says why it was refused. `proposal` is YAML of a case that would kill it,
    empty where none was found.
    """

    mutant: Mutant
    fate: Fate
    by: str = ""
    proposal: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """The fates of all mutants."""

    outcomes: tuple[Outcome, ...]

    def count(self, fate: Fate) -> int:
        """Return how many mutants met this fate."""
        return sum(1 for outcome in self.outcomes if outcome.fate is fate)

    @property
    def survivors(self) -> list[Outcome]:
        """Return what no case notices."""
        return [outcome for outcome in self.outcomes if outcome.fate is Fate.SURVIVED]

    @property
    def share(self) -> float:
        """Return killed ÷ (killed + survived); 1 where there was nothing to kill."""
        killed, survived = self.count(Fate.KILLED), self.count(Fate.SURVIVED)
        return killed / (killed + survived) if killed + survived else 1.0


class _Ready(NamedTuple):
    """A case with what it asks, made once under the policy as it stands."""

    profile: str
    case: CaseShape
    asked: tuple[Proposal, Context] | None


class Trial:
    """Holds one policy's cases against its mutants.

    Raises:
        PolicyErrors: The policy, or a file of cases, has something wrong with it.
    """

    def __init__(self, files: Mapping[str, str], case_files: Mapping[str, str]) -> None:
        """Load policy and cases."""
        self.bench = Workbench(files)
        policy = self.bench.policy
        self.mutants = mutants(self.bench.documents, self.bench.known)
        self._cases = [
            _Ready(found.profile, found.case, cases.asking(policy, found.profile, found.case))
            for found in cases.read(policy, case_files)
        ]

    def hold(self, profile: str, case: CaseShape) -> None:
        """Take one case more, which holds of the policy as it stands."""
        self._cases.insert(0, _Ready(profile, case, cases.asking(self.bench.policy, profile, case)))

    def outcome(self, mutant: Mutant) -> Outcome:
        """Return what becomes of a mutant."""
        try:
            policy = self.bench.changed(mutant)
        except PolicyErrors as found:
            return Outcome(mutant=mutant, fate=Fate.REFUSED, by=found.problems[0].message)
        killer = self._killer(mutant, policy)
        if killer is not None:
            return Outcome(mutant=mutant, fate=Fate.KILLED, by=killer)
        if equivalent(
            self.bench.policy,
            policy,
            self.bench.known.vocabulary,
            lambda name, profile: concerns(mutant, name, profile),
        ):
            return Outcome(mutant=mutant, fate=Fate.EQUIVALENT)
        return Outcome(mutant=mutant, fate=Fate.SURVIVED, proposal=self._proposal(mutant, policy))

    def _killer(self, mutant: Mutant, policy: PolicySet) -> str | None:
        anew = _asks_anew(mutant)
        for place, ready in enumerate(self._cases):
            if not concerns(mutant, ready.case.capability, ready.profile):
                continue
            asked = cases.asking(policy, ready.profile, ready.case) if anew else ready.asked
            found = cases.came_of(policy, asked, session=ready.case.expect.session is not None)
            if cases.compared(ready.case, found):
                self._cases.insert(0, self._cases.pop(place))  # what stands beside is likely noticed by the same case
                return ready.case.name
        return None

    def _proposal(self, mutant: Mutant, policy: PolicySet) -> str:
        """Return a case that passes on the policy and fails on the mutant, or nothing where none is found."""
        both = (self.bench.policy, policy)
        names, profiles = both[0].capabilities, both[0].profiles
        pairs = [(name, profile) for name in names for profile in profiles if concerns(mutant, name, profile)]
        share = EXAMPLES // len(pairs) if pairs else 0
        tried = [islice(Examples(both, self.bench.known.vocabulary, *pair), share) for pair in pairs]
        for example in chain.from_iterable(zip_longest(*tried)):  # every pair's plainest before any pair's varied ones
            found = None if example is None else _telling(example, both, anew=_asks_anew(mutant))
            if example is not None and found is not None:
                return _written(f"holds {mutant.key}", example, found)
        return ""


def _asks_anew(mutant: Mutant) -> bool:
    """Say whether a case may ask something else of a mutant: who asks, or with which parameters."""
    return mutant.file == "organization.yaml" or mutant.path[:1] == ("inputs",)


def _telling(example: Mapping[str, Any], both: tuple[PolicySet, PolicySet], *, anew: bool) -> dict[str, Any] | None:
    """Return what to expect of an example, so that it passes under the first policy and fails under the other."""
    case = CaseShape.model_validate({**example, "name": "x", "expect": {"status": "allowed"}})
    asked = cases.asking(both[0], str(case.profile), case)
    now = cases.came_of(both[0], asked)
    then = cases.came_of(both[1], cases.asking(both[1], str(case.profile), case) if anew else asked)
    if now == then:
        return None
    expect = {"status": now["status"], **_differing(now, then)}
    told = CaseShape.model_validate({**example, "name": "x", "expect": expect})
    return expect if not cases.compared(told, now) and cases.compared(told, then) else None


def concerns(mutant: Mutant, capability: str, profile: str) -> bool:
    """Say whether what a file says can touch a pair at all."""
    folder, _, name = mutant.file.removesuffix(".yaml").rpartition("/")
    return {"capabilities": name == capability, "profiles": name == profile}.get(folder, True)


def _written(name: str, example: Mapping[str, Any], expect: Mapping[str, Any]) -> str:
    """Return a case as YAML on its own, ready to be put into a file of cases."""
    kept = {key: held for key, held in example.items() if held != {}}
    case = {"name": name, **kept, "expect": expect}
    return yaml.safe_dump({"cases": [case]}, sort_keys=False, default_flow_style=None, width=10_000)


def _differing(now: Mapping[str, Any], then: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, held in now.items():
        other = then.get(key)
        if held == other:
            continue
        inner = _differing(held, other) if isinstance(held, dict) and isinstance(other, dict) else {}  # pyright: ignore[reportUnknownArgumentType]
        found[key] = inner or held
    return found


# All of them ---------------------------------------------------------------------------------------------------------

_trial: Trial | None = None


def _open(files: Mapping[str, str], case_files: Mapping[str, str]) -> None:
    global _trial  # noqa: PLW0603  # one per worker process, made before its first task
    _trial = Trial(files, case_files)


def _some(numbers: Sequence[int]) -> list[Outcome]:
    if _trial is None:
        raise RuntimeError("the worker has no trial: `_open` makes it")
    return [_trial.outcome(_trial.mutants[number]) for number in numbers]


def score(
    files: Mapping[str, str],
    case_files: Mapping[str, str],
    *,
    processes: int = 2,
    progress: Progress = lambda _done, _of: None,
) -> Score:
    """Change everything in turn, and see what the cases notice.

    Args:
        files: The policy.
        case_files: Its cases, all of which hold.
        processes: How many work at it.
        progress: Called with how many of how many were changed.

    Raises:
        PolicyErrors: The policy, or a file of cases, has something wrong with it.
    """
    count = len(Trial(files, case_files).mutants)
    return Score(outcomes=tuple(fates(files, case_files, range(count), processes=processes, progress=progress)))


def fates(
    files: Mapping[str, str],
    case_files: Mapping[str, str],
    numbers: Sequence[int],
    *,
    processes: int,
    progress: Progress = lambda _done, _of: None,
) -> list[Outcome]:
    """Return what becomes of these mutants, by their place among all."""
    if processes == 1:
        trial = Trial(files, case_files)
        return [trial.outcome(trial.mutants[number]) for number in numbers]
    with ProcessPoolExecutor(processes, initializer=_open, initargs=(dict(files), dict(case_files))) as pool:
        found: list[Outcome] = []
        for part in in_turn(pool, _some, ((share,) for share in _shares(numbers))):
            found += part
            progress(len(found), len(numbers))
        return found


def _shares(numbers: Sequence[int]) -> Iterator[list[int]]:
    """Cut the work into pieces small enough that nobody waits long for the last."""
    for start in range(0, len(numbers), SHARE):
        yield list(numbers[start : start + SHARE])


SHARE: Final = 50
