"""What people answered, sorted by what alone had them asked: one rule, or authority for a capability in a profile."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from app.authoring.habits import Tally
from app.governance.admission import RULE
from app.governance.authority import REQUIRED
from app.governance.policy_model import Effect

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from app.authoring.habits import Habits, Question
    from app.governance.policy import PolicySet

SUPERVISED = "permission_supervised"


@dataclass(slots=True)
class Answers:
    """What people answered to questions of one kind.

    Attributes:
        all: every answer, launches by standing grants among them.
        granted: approved as shown.
        edited: approved otherwise than shown.
        denied: by a person.
        expired: by nobody.
        in_advance: launched by a standing grant.
        beside: approved where something else had people asked as well; not among `all`.
    """

    all: Tally = field(default_factory=Tally)
    granted: int = 0
    edited: int = 0
    denied: int = 0
    expired: int = 0
    in_advance: int = 0
    beside: int = 0

    def note(self, question: Question) -> None:
        """Count one answer."""
        self.all.note(question.seq, question.at)
        match question.document["status"], bool(question.document["edits"]):
            case "approved", False:
                self.granted += 1
            case "approved", True:
                self.edited += 1
            case "denied", _:
                self.denied += 1
            case _:
                self.expired += 1

    def add(self, other: Answers) -> None:
        """Count all of others as well."""
        self.all = self.all.with_(other.all)
        for key in ("granted", "edited", "denied", "expired", "in_advance", "beside"):
            setattr(self, key, getattr(self, key) + getattr(other, key))

    def always(self, least: int) -> bool:
        """Say whether everything was granted as shown, so often at least."""
        return not (self.edited or self.denied or self.expired) and self.granted + self.in_advance >= least

    def never(self, least: int) -> bool:
        """Say whether everything was denied by people, so often at least."""
        others = self.granted or self.edited or self.expired or self.in_advance or self.beside
        return self.denied >= least and not others

    def counts(self) -> dict[str, float]:
        """Return how often, by name."""
        return {"granted": self.granted, "in_advance": self.in_advance, "denied": self.denied}


def answered(policy: PolicySet, habits: Habits) -> tuple[dict[str, Answers], dict[tuple[str, str], Answers]]:
    """Return the answers by rule, and by capability and profile.

    Where two had asked nobody can say which of them a denial meant; an approval says that neither is always denied.
    """
    by_rule: dict[str, Answers] = {}
    by_pair: dict[tuple[str, str], Answers] = {}
    for question in habits.questions.values():
        said = question.document
        asked = _asking(policy, said["reasons"])
        found = [by_rule.setdefault(rule, Answers()) for rule in asked & policy.rules.keys()]
        if REQUIRED in asked:
            found.append(by_pair.setdefault((said["capability"], said["profile"]), Answers()))
        for one in found:
            if len(asked) == 1:
                one.note(question)
            else:
                one.beside += said["status"] == "approved"
    for pair, used in habits.in_advance.items():
        found = by_pair.setdefault(pair, Answers())
        found.in_advance = used.count
        found.all = found.all.with_(used)
    return by_rule, by_pair


class Supervised(NamedTuple):
    """What people answered about permissions that agents hold under supervision.

    Attributes:
        alone: by agent, permission, and capability with profile: the questions that nothing else had asked.
        approved_beside: agents and permissions of which a question was approved that something else had asked, too.
    """

    alone: Mapping[tuple[str, str, tuple[str, str]], Answers]
    approved_beside: frozenset[tuple[str, str]]


def supervised(policy: PolicySet, habits: Habits) -> Supervised:
    """Return the answers about permissions; which one it was, the agent's own under this policy say."""
    alone: dict[tuple[str, str, tuple[str, str]], Answers] = {}
    beside: set[tuple[str, str]] = set()
    for question in habits.questions.values():
        said = question.document
        pair = (str(said["capability"]), str(said["profile"]))
        agent, gate = policy.agents.get(said["agent"]), policy.gates.get(pair)
        if agent is None or gate is None or all(one["code"] != SUPERVISED for one in said["reasons"]):
            continue
        missing = sorted((gate.permissions - agent.permissions) & agent.supervised)
        if len(missing) == 1 and _asking(policy, said["reasons"]) == {RULE}:
            alone.setdefault((said["agent"], missing[0], pair), Answers()).note(question)
        elif said["status"] == "approved":
            beside |= {(said["agent"], permission) for permission in missing}
    return Supervised(alone, frozenset(beside))


def _asking(policy: PolicySet, reasons: Iterable[Mapping[str, str]]) -> set[str]:
    """Return what had people asked: rules that escalate, authority by its code, anything else by its rule.

    What was merely bounded stands among the reasons as well, and asks nobody.
    """
    found: set[str] = set()
    for one in reasons:
        rule = policy.rules.get(one["rule"])
        if one["code"] == REQUIRED:
            found.add(REQUIRED)
        elif (rule is None and one["code"] != "limit") or (rule is not None and rule.then is Effect.ESCALATE):
            found.add(one["rule"])
    return found
