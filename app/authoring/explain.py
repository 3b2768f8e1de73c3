"""`reins policy explain`: the rules in force for one (capability, profile), in plain sentences with bounds and reasons.

Everything is read from the compiled model and the typed trees, so that what is explained is what decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast

from app.authoring.equivalence import fold
from app.authoring.sentences import joined, quantity, sentence, value_of
from app.governance.authority import MARKED, allows
from app.governance.case_session import recovery_terms, watch_terms
from app.governance.expression_tree import BOOL, STRING, Constant
from app.governance.model import AuthorityMode
from app.governance.plans import recovery_plan, watch_plan
from app.governance.policy_code import limit_for
from app.governance.policy_model import SIGNAL_UNITS, Effect
from app.governance.vocabulary import properties

if TYPE_CHECKING:
    from app.governance.model import Json
    from app.governance.policy import Gate, PolicySet
    from app.governance.policy_model import Approval, Rule, Setting
    from app.governance.vocabulary import Vocabulary

ENABLED: Final[Mapping[str, str]] = {
    "allowed": "enabled",
    "guarded": "enabled, guarded",
    "approval-required": "enabled, and a human approves each",
}
_EFFECTS: Final[Mapping[Effect, str]] = {Effect.DENY: "it is denied", Effect.ESCALATE: "a human decides"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A heading and its sentences."""

    heading: str
    sentences: tuple[str, ...]


class NotEnabled(Exception):
    """There is nothing to explain: capability or profile is unknown, or the one is not enabled in the other."""

    def __init__(self, message: str, valid: tuple[str, ...]) -> None:
        """Keep what would be valid, and write the message."""
        self.valid = valid
        super().__init__(f"{message}; valid: {', '.join(f'`{name}`' for name in valid)}")


def explain(policy: PolicySet, capability: str, profile: str) -> list[Section]:
    """Say what holds for a capability in a profile.

    Raises:
        NotEnabled: It is not enabled there, or one of them does not exist.
    """
    if capability not in policy.capabilities:
        raise NotEnabled(f"there is no capability `{capability}`", tuple(sorted(policy.capabilities)))
    if profile not in policy.profiles:
        raise NotEnabled(f"there is no profile `{profile}`", tuple(sorted(policy.profiles)))
    gate = policy.gates.get((capability, profile))
    if gate is None:
        enabled = tuple(sorted(name for held, name in policy.gates if held == capability))
        raise NotEnabled(f"`{capability}` is not enabled in `{profile}`", enabled)
    sections = (
        Section(heading=f"{capability} in {profile}", sentences=tuple(_about(gate))),
        Section(heading="Who may propose it", sentences=tuple(_who(policy, gate))),
        Section(heading="Parameters and limits", sentences=tuple(_parameters(gate))),
        Section(heading="Rules", sentences=tuple(_rules(policy, gate))),
        Section(heading="Humans", sentences=tuple(_humans(policy, gate))),
        Section(heading="While it runs", sentences=tuple(_watched(policy, gate))),
        Section(heading="When it fails", sentences=tuple(_recovered(policy, gate))),
    )
    return [section for section in sections if section.sentences]


def _about(gate: Gate) -> Iterator[str]:
    package = gate.capability
    yield package.summary
    enabled = ENABLED[package.env_profile[gate.profile.name]]
    yield f"Its risk is {package.risk.value}; here it is {enabled}. It has {package.timeout_s:g} s."
    if package.preconditions:
        yield f"It waits until these hold: {joined([f'`{name}`' for name in package.preconditions], 'and')}."
    if package.postconditions:
        yield f"It has succeeded when these hold: {joined([f'`{name}`' for name in package.postconditions], 'and')}."


def _who(policy: PolicySet, gate: Gate) -> Iterator[str]:
    package = gate.capability
    if package.recovery:
        yield "No agent: governance alone starts it, as a recovery."
        return
    needed = joined([f"`{name}`" for name in sorted(package.permissions)], "and")
    free = [name for name, agent in sorted(policy.agents.items()) if package.permissions <= agent.permissions]
    asked = [
        name
        for name, agent in sorted(policy.agents.items())
        if name not in free and package.permissions <= agent.permissions | agent.supervised
    ]
    yield f"An agent that holds {needed}: {joined([f'`{name}`' for name in free], 'and') or 'none does'}."
    if asked:
        yield f"Under supervision, so that a human decides each time: {joined([f'`{name}`' for name in asked], 'and')}."


# Parameters ----------------------------------------------------------------------------------------------------------


def _parameters(gate: Gate) -> Iterator[str]:
    for name, spec in properties(gate.capability).items():
        limit = limit_for(spec, gate.profile.limits)
        yield _range(name, spec)
        if limit is not None:
            shown = quantity(limit.maximum, limit.unit)
            yield f"`{name}` is lowered to at most {shown}, the limit `{limit.name}` here ({limit.source})."


def _range(name: str, spec: Mapping[str, Any]) -> str:
    unit = cast("str | None", spec.get("unit"))
    default = f"; {quantity(spec['default'], unit)} where it is left out" if "default" in spec else ""
    if "minimum" in spec and "maximum" in spec:
        return f"`{name}` is between {quantity(spec['minimum'], unit)} and {quantity(spec['maximum'], unit)}{default}."
    if "x-ref" in spec:
        return f"`{name}` names one of the site's {_PLURALS.get(str(spec['x-ref']), str(spec['x-ref']))}{default}."
    if "enum" in spec:
        return f"`{name}` is {joined([quantity(value, None) for value in spec['enum']], 'or')}{default}."
    return f"`{name}` is a {spec.get('type')}{default}."


_PLURALS: Final[Mapping[str, str]] = {
    "object": "objects", "target": "targets", "surface": "surfaces", "area": "areas", "corridor": "corridors",
    "tool": "tools", "action": "tool's actions",
}  # fmt: skip


# Rules ---------------------------------------------------------------------------------------------------------------


def _rules(policy: PolicySet, gate: Gate) -> Iterator[str]:
    vocabulary = policy.vocabulary()
    found = 0
    for rule in policy.rules.values():
        if (rule.applies_to is None or gate.capability.name in rule.applies_to) and (
            rule.profiles is None or gate.profile.name in rule.profiles
        ):
            text = _rule(rule, gate, vocabulary)
            if text:
                found += 1
                yield text
    if not found:
        yield "No rule applies: only the limits do."


def _rule(rule: Rule, gate: Gate, vocabulary: Vocabulary) -> str:
    """Say a rule; nothing where it can do nothing here."""
    settings = [setting for setting in rule.settings if setting.param in properties(gate.capability)]
    if rule.settings and not settings:
        return ""
    when = _condition(rule, gate, vocabulary)
    if when is None:
        return ""
    effect = _effect(rule, settings, gate, vocabulary)
    head = f"{when}, {effect}" if when else effect
    remedy = f" What helps: {rule.remedy}." if rule.remedy else ""
    return f"{head[:1].upper()}{head[1:]}. {rule.because}{remedy} ({rule.id})"


def _condition(rule: Rule, gate: Gate, vocabulary: Vocabulary) -> str | None:
    """Say when a rule holds; empty where it always does, None where it never does in this pair."""
    if rule.when is None:
        return ""
    typed = vocabulary.typed(rule.when, gate.capability.name, BOOL)
    folded = fold(typed, _fixed(gate))
    if isinstance(folded, Constant):
        return "" if folded.value else None
    return f"if {sentence(folded, _limits(gate))}"


def _fixed(gate: Gate) -> dict[str, Any]:
    profile, package = gate.profile, gate.capability
    return {
        "capability.name": package.name,
        "capability.risk": package.risk.value,
        "profile.name": profile.name,
        "profile.shared_floor": profile.shared_floor,
        "profile.sensitivity": profile.sensitivity,
    }


def _limits(gate: Gate) -> dict[str, Any]:
    return {f"limits.{name}": limit.maximum for name, limit in gate.profile.limits.items()}


def _effect(rule: Rule, settings: list[Setting], gate: Gate, vocabulary: Vocabulary) -> str:
    if rule.then is not Effect.MODIFY:
        more = f", and {rule.approvers} people have to agree" if rule.approvers > 1 else ""
        return _EFFECTS[rule.then] + more
    return joined([part for setting in settings for part in _setting(setting, gate, vocabulary)], "and")


def _setting(setting: Setting, gate: Gate, vocabulary: Vocabulary) -> Iterator[str]:
    unit = cast("str | None", properties(gate.capability)[setting.param].get("unit"))
    if setting.maximum is not None:
        yield f"`{setting.param}` is lowered to at most {quantity(setting.maximum, unit)}"
    if setting.minimum is not None:
        yield f"`{setting.param}` is raised to at least {quantity(setting.minimum, unit)}"
    if setting.to is not None:
        typed = vocabulary.typed(setting.to, gate.capability.name, STRING)
        yield f"`{setting.param}` is set to {value_of(typed, _limits(gate))}"


# Humans --------------------------------------------------------------------------------------------------------------


def _humans(policy: PolicySet, gate: Gate) -> Iterator[str]:
    name, package = gate.profile.name, gate.capability
    approval = gate.profile.approval
    if package.recovery:
        yield "Nobody is asked before a recovery."
    elif approval is None or not gate.profile.asks:
        yield "Nobody is asked before it is launched: what only a human could decide is denied."
    else:
        yield from _approval(gate, approval)
    may = [what for mode, what in _MAY.items() if allows(policy, name, mode)]
    yield f"Anybody may stop it at any time{'; an operator may ' + joined(may, 'and') if may else ''}."


_MAY: Final[Mapping[AuthorityMode, str]] = {
    AuthorityMode.INTERRUPT_ENABLED: "pause it and roll it back",
    AuthorityMode.TAKEOVER_ENABLED: "take the controls",
}


def _approval(gate: Gate, approval: Approval) -> Iterator[str]:
    package, profile = gate.capability, gate.profile
    by_risk = AuthorityMode.APPROVAL_REQUIRED in profile.authority and package.risk in approval.risks
    count = approval.approvers.get(package.risk, approval.default_approvers)
    people = "one person approves" if count == 1 else f"{count} different people approve"
    if by_risk or package.env_profile[profile.name] == MARKED:
        why = f"its risk is {package.risk.value}" if by_risk else "its manifest asks for that here"
        yield f"Before it is launched {people}, because {why}."
    else:
        yield f"Nobody is asked before it is launched, unless a rule escalates it; then {people}."
    yield f"Without an answer within {approval.within_s:g} s it is denied."


# While it runs -------------------------------------------------------------------------------------------------------


def _watched(policy: PolicySet, gate: Gate) -> Iterator[str]:
    defaults = {name: spec["default"] for name, spec in properties(gate.capability).items() if "default" in spec}
    effective = {name: _held(name, value, gate) for name, value in defaults.items()}
    plan = watch_plan(policy, gate.capability.name, gate.profile.name, effective)
    if effective:
        yield "What a session asks for lowers these thresholds; here it asks for nothing but the defaults."
    for name, row in watch_terms(plan).items():
        yield _watch(name, row)


def _held(name: str, value: Json, gate: Gate) -> Json:
    limit = limit_for(properties(gate.capability)[name], gate.profile.limits)
    return value if limit is None else min(float(cast("float", value)), limit.maximum)


def _watch(name: str, row: Mapping[str, Any]) -> str:
    side = "above" if "above" in row else "below"
    unit = SIGNAL_UNITS[row["signal"]]
    computed = "what is computed for every tick"
    threshold = computed if row[side] == "computed" else quantity(row[side], unit)
    lasting = f" for {row['for_ms']} ms" if row["for_ms"] else ""
    by = f" by {quantity(row['clear_beyond'], unit)}" if "clear_beyond" in row else ""
    then = f"; when it has been clear{by} for {row.get('clear_after_ms', 0)} ms it resumes" if "then" in row else ""
    last = f"; after {row['persist_ms']} ms: {row['else']}" if "persist_ms" in row else ""
    did = "it is recorded" if row["enter"] == "continue" else f"the answer is {row['enter']}"
    return f"If `{row['signal']}` is {side} {threshold}{lasting}, {did}{then}{last}. ({name})"


def _recovered(policy: PolicySet, gate: Gate) -> Iterator[str]:
    plan = recovery_plan(policy, gate.capability.name, gate.profile.name)
    alike: dict[tuple[str, ...], list[str]] = {}
    for failure, steps in recovery_terms(plan).items():
        alike.setdefault(tuple(steps), []).append(f"`{failure}`")
    for steps, failures in alike.items():
        yield f"After {joined(failures, 'or')}: {', then '.join(step.replace('_', ' ') for step in steps)}."
    back = "" if plan.rollback_capability is None else f" by `{plan.rollback_capability}`"
    budget = plan.retry_budget
    most = {0: "No new attempt is made", 1: "A new attempt is made once at most"}
    again = most.get(budget, f"A new attempt is made at most {budget} times in all")
    yield f"{again}; rollback{back} is {plan.rollback}."
