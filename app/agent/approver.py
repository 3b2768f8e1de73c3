"""A scripted, simulated approver: a client of the same API that answers escalations as a person of given habits would.

For demos, tests and the evaluation of human-supervised runs: who it is, how long it takes to read, what it approves,
and how often it errs are data. It is never a substitute for a person in front of a robot, and every answer it gives
is recorded under its own name.

    approver: operator
    reads_s: {min: 0.5, max: 1.5}
    error_rate: 0.0          # share of answers that come out the other way
    seed: 7
    rules:                   # the first that matches decides; none matches: deny
      - match: {capability: [grasp_object], risk: [medium]}
        decision: approve
        edit: {force_n: 40}  # approved with this instead; nothing less is approved
      - match: {kind: [session]}
        decision: approve

An edit that the capability does not take, or that policy refuses, is no reason to approve without it: that question is
left to somebody else, `on_skip` is told why, and the others are answered as ever.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias, cast

import yaml

from app.agent.client import AsyncReinsClient, Document, Problem, ReinsError, Unsendable

_POLL_S = 0.1
_ANSWERED = frozenset({"already_resolved", "already_approved"})
_NOT_MINE = frozenset({"edit_refused", "own_proposal"})  # with all 422: the server takes other answers, not this one
_MATCHABLE = frozenset({"capability", "risk", "kind", "agent"})
_MATCHED = {"risk": ("low", "medium", "high", "critical"), "kind": ("approval", "session")}  # whatever policy says
_DECISIONS = ("approve", "deny", "ignore")
_LARGEST = 10**15
_READS = frozenset({"min", "max"})
_RULE = frozenset({"match", "decision", "edit"})
_KEYS = frozenset({"approver", "reads_s", "error_rate", "seed", "rules"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """What to answer to escalations whose fields are among the given values; `edit` overrides parameters."""

    match: Mapping[str, frozenset[str]]
    decision: str
    edit: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Habits:
    """A simulated approver: name, reading time (s, uniform), share of wrong answers, rules."""

    name: str
    reads_min_s: float
    reads_max_s: float
    error_rate: float
    seed: int
    rules: tuple[Rule, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What the approver decided about one escalation, whether it erred, and the `status` the question has since.

    After an approval the question may still be `pending`: policy constrained the edit, or it takes another person.
    """

    escalation: str
    decision: str
    erred: bool
    edit: Mapping[str, Any]
    status: str = ""


OnAnswer: TypeAlias = Callable[[Document, Answer], None]
OnSkip: TypeAlias = Callable[[Document, ReinsError], None]


def load_habits(path: Path) -> Habits:
    """Read a habits file. Raises `ValueError` naming file, key or line, and what would be valid."""
    try:
        raw: object = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f":{error.problem_mark.line + 1}"
        raise ValueError(f"{path}{line}: not readable as YAML: {error.problem}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{path}: not readable as YAML: {error}; valid is UTF-8 without control characters") from error
    except RecursionError as error:
        raise ValueError(f"{path}: not readable as YAML: it is nested too deep; valid is a list of rules") from error
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise ValueError(f"`{path}` cannot be read: {why}; valid is a YAML file of habits") from error
    return parse_habits(raw, str(path))


def parse_habits(raw: object, source: str = "habits") -> Habits:
    """Return habits from plain data. Raises `ValueError` naming the key and what would be valid."""
    data = _mapping(raw, source, _KEYS)
    reads = _mapping(data.get("reads_s", {"min": 0.5, "max": 1.5}), f"{source}: `reads_s`", _READS)
    low, high = (_number(reads.get(key), f"{source}: `reads_s.{key}`") for key in ("min", "max"))
    rate = _number(data.get("error_rate", 0.0), f"{source}: `error_rate`")
    if not 0 <= low <= high < math.inf:
        raise ValueError(f"{source}: `reads_s` is {low}…{high}; valid: 0 ≤ min ≤ max")
    if not 0 <= rate <= 1:
        raise ValueError(f"{source}: `error_rate` is {rate}; valid: 0…1")
    name, seed, rules = data.get("approver", "operator"), data.get("seed", 0), data.get("rules", [])
    if not isinstance(name, str):
        raise ValueError(f"{source}: `approver` is `{name}`; valid: the name of one approver")
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise ValueError(f"{source}: `seed` is `{seed}`; valid: a whole number")
    if not isinstance(rules, list):
        raise ValueError(f"{source}: `rules` is `{rules}`; valid: a list of rules")
    return Habits(
        name=name,
        reads_min_s=low,
        reads_max_s=high,
        error_rate=rate,
        seed=seed,
        rules=tuple(
            _rule(item, f"{source}: `rules[{place}]`") for place, item in enumerate(cast("list[object]", rules))
        ),
    )


def _mapping(value: object, what: str, valid: frozenset[str] | None = None) -> dict[str, Any]:
    if not isinstance(value, dict):
        keys = "parameters and values" if valid is None else ", ".join(sorted(valid))
        raise ValueError(f"{what} is `{value}`; valid: a mapping with {keys}")
    found = cast("dict[str, Any]", value)
    unknown = sorted(str(key) for key in found if valid is not None and key not in valid)
    if unknown and valid is not None:
        raise ValueError(f"{what}: unknown key `{unknown[0]}`; valid: {', '.join(sorted(valid))}")
    return found


def _number(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{what} is `{value}`; valid: a number")
    if isinstance(value, int) and abs(value) > _LARGEST:
        raise ValueError(f"{what} is out of all range; valid: a number of at most {_LARGEST}")
    return float(value)


def _rule(raw: object, source: str) -> Rule:
    item = _mapping(raw, source, _RULE)
    match = _mapping(item.get("match", {}), f"{source}: `match`")
    for field in match:
        if field not in _MATCHABLE:
            raise ValueError(f"{source}: cannot match on `{field}`; valid: {', '.join(sorted(_MATCHABLE))}")
    decision = item.get("decision", "deny")
    if decision not in _DECISIONS:
        raise ValueError(f"{source}: decision `{decision}`; valid: {', '.join(_DECISIONS)}")
    values = {field: _names(value, f"{source}: `match.{field}`") for field, value in match.items()}
    for field, valid in _MATCHED.items():
        if unknown := sorted(values.get(field, frozenset[str]()).difference(valid)):
            raise ValueError(f"{source}: `match.{field}` names `{unknown[0]}`; valid: {', '.join(valid)}")
    return Rule(match=values, decision=decision, edit=_mapping(item.get("edit", {}), f"{source}: `edit`"))


def _names(value: object, what: str) -> frozenset[str]:
    names = cast("list[object]", value if isinstance(value, list) else [value])
    if not all(isinstance(name, str) for name in names):
        raise ValueError(f"{what} is `{value}`; valid: a name or a list of names")
    return frozenset(str(name) for name in names)


def decide(habits: Habits, escalation: Document, draw: float) -> Answer:
    """Return the answer to one escalation; `draw` in 0…1 is compared with the error rate."""
    chosen = next(
        (rule for rule in habits.rules if all(escalation.get(key) in allowed for key, allowed in rule.match.items())),
        Rule(match={}, decision="deny", edit={}),
    )
    erred = draw < habits.error_rate
    decision = {"approve": "deny", "deny": "approve", "ignore": "ignore"}[chosen.decision] if erred else chosen.decision
    fixed = erred or escalation.get("kind") == "session"  # a session under way cannot be edited
    return Answer(escalation=escalation["id"], decision=decision, erred=erred, edit={} if fixed else chosen.edit)


class ScriptedApprover:
    """Polls for pending escalations and answers each once, after its reading time; again where the cell was away."""

    def __init__(
        self,
        client: AsyncReinsClient,
        habits: Habits,
        *,
        on_answer: OnAnswer = lambda _e, _a: None,
        on_skip: OnSkip = lambda _e, _r: None,
    ) -> None:
        """Answer through `client`, whose token names the operator.

        `on_answer` is told of every answer given, `on_skip` of every question whose answer was not taken, and why.
        """
        self._client = client
        self._habits = habits
        self._random = random.Random(habits.seed)  # noqa: S311 - simulates a person, guards nothing
        self._on_answer = on_answer
        self._on_skip = on_skip
        self._seen: set[tuple[str, str]] = set()
        self._edited: set[tuple[str, str]] = set()  # what the server has made of an edit of ours

    async def run(self) -> None:
        """Answer until cancelled.

        Raises:
            ReinsError: the server refused, for instance an unknown token, or did not answer.
        """
        try:
            async with asyncio.TaskGroup() as answers:
                while True:
                    await self._look(answers)
                    await asyncio.sleep(_POLL_S)
        except ExceptionGroup as failed:
            refused, bugs = failed.split(ReinsError)
            if refused is None or bugs is not None:
                raise
            raise refused.exceptions[0] from failed  # whatever failed beside it, failed at the same server

    async def _look(self, answers: asyncio.TaskGroup) -> None:
        query = {"status": "pending"}
        while True:  # every page: what was ignored stays pending, and must not hide what is older
            page = await self._client.call("GET", "/v1/escalations", query=query)
            for escalation in page["items"]:
                if _bound_to(escalation) not in self._seen:
                    self._seen.add(_bound_to(escalation))
                    answers.create_task(self._answer(escalation))
            if page["next"] is None:
                return
            query = {**query, "cursor": page["next"]}

    async def _answer(self, escalation: Document) -> None:
        reading_s = self._random.uniform(self._habits.reads_min_s, self._habits.reads_max_s)
        answer = decide(self._habits, escalation, self._random.random())
        if _bound_to(escalation) in self._edited:  # policy constrained it: asking again would change nothing
            answer = replace(answer, edit={})
        await asyncio.sleep(reading_s)
        if answer.decision == "ignore":
            return
        body: Document = {"decision": answer.decision, "digest": escalation["digest"]}
        if answer.decision == "approve" and answer.edit:
            body["params"] = {**escalation["effective"], **answer.edit}
        if answer.decision == "deny":
            body["comment"] = "denied by rule of the scripted approver"
        resolved = await self._resolve(escalation, answer, body)
        if resolved is None:
            return
        if "params" in body:
            self._note_edit(answer, resolved)
        self._on_answer(escalation, replace(answer, status=resolved["status"]))

    def _note_edit(self, answer: Answer, resolved: Document) -> None:
        """Remember what an edit came to; where that is what was shown before, read it once more, to approve it."""
        self._edited.add(_bound_to(resolved))
        if resolved["status"] == "pending" and not self._gave(answer, resolved):
            self._seen.discard(_bound_to(resolved))

    async def _resolve(self, escalation: Document, answer: Answer, body: Document) -> Document | None:
        """Return the question as this answer left it; None where the answer does not count."""
        path = f"/v1/escalations/{escalation['id']}"
        try:
            return await self._client.call("POST", f"{path}/resolve", json=body)
        except Unsendable as unfit:  # an edit that is no JSON
            return self._skip(escalation, unfit)
        except Problem as refused:
            if refused.status == 422 or refused.code in _NOT_MINE:
                return self._skip(escalation, refused)
            if refused.status != 409:  # somebody else was faster, or it expired while being read
                raise
            if refused.code in ("cell_offline", "control_held"):  # for now: the question waits on, so it is read again
                self._seen.discard(_bound_to(escalation))
            if refused.code not in _ANSWERED:
                return None
        resolved: Document = await self._client.call("GET", path)
        return resolved if self._gave(answer, resolved) else None

    def _skip(self, escalation: Document, why: ReinsError) -> None:
        """Leave a question to somebody else; put anew, it is edited anew."""
        self._on_skip(escalation, why)

    def _gave(self, answer: Answer, resolved: Document) -> bool:
        """Say whether an answer stands that was asked for again because the reply to it was lost."""
        denial = resolved.get("denial")
        said = resolved.get("approvals") if answer.decision == "approve" else [denial] if denial else []
        return any(word.get("by") == self._habits.name for word in said or ())


def _bound_to(escalation: Document) -> tuple[str, str]:
    return escalation["id"], escalation["digest"]
