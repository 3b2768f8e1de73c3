"""What a log suggests to change about a policy: each with its evidence and a patch, none applied by itself.

| kind | what was seen | the patch |
|---|---|---|
| always-bound | every value that agents named was beyond one limit or bound | the bound lets half of them through |
| always-granted | people granted everything that was asked, unchanged | nobody is asked about it |
| never-granted | people denied everything that was asked | it is denied at once |
| never-held | a rule that denies or asks decided nothing | none: that nothing met it is how a guard looks that works |
| never-held | a rule that modifies decided nothing | the rule goes |
| always-granted | likewise a permission that an agent holds under supervision | the agent holds it by itself |
| never-granted | likewise | the agent does not hold it |
| lowered-on-approval | people granted it, but with less of one parameter | a rule that bounds it |
| raised-on-approval | likewise with more | a rule that bounds it |
| renamed-on-approval | likewise with another name, always the same in the place of the same | a rule that sets it |
| taken-over | a rule denied it, and a person then took the idle cell by hand | the rule asks instead |

Never suggested away: approvals at critical risk, and what takes more than one person. What would loosen policy says so
in its own words, whether it could be compared or not. Under the least counts nothing is suggested.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median_high, median_low
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from app.authoring.answers import Answers, answered, supervised
from app.authoring.edits import LOWERED, edited
from app.authoring.habits import Tally
from app.authoring.patches import Patching
from app.governance.authority import MARKED, answers
from app.governance.errors import PolicyErrors
from app.governance.model import AuthorityMode, Risk
from app.governance.policy_model import Effect

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from app.authoring.edits import Habit
    from app.authoring.habits import Bound, Habits
    from app.governance.policy import Gate, PolicySet
    from app.governance.policy_model import Approval, Rule


LOOSENS: Final = ". That loosens policy."
STAYS: Final = "a rule that denies or asks is for what has not happened yet; none is suggested away for its silence"


@dataclass(frozen=True, slots=True, kw_only=True)
class Least:
    """How often something has to be seen before anything is suggested.

    Attributes:
        decisions: values that agents named, all beyond one bound.
        answers: questions, all answered alike.
        silent: decisions that a rule had a say in, and said nothing.
        overrides: approvals with an edit, or takeovers after a refusal.
    """

    decisions: int = 50
    answers: int = 20
    silent: int = 500
    overrides: int = 5


class Suggestion(NamedTuple):
    """One change that a log suggests.

    Attributes:
        kind: what was seen, of the table above.
        about: the rule or limit; else the capability or risk, and the profile.
        words: the same as sentences.
        counts: how often, by name.
        events: the newest events that show it, by their places in the log.
        first: the time of the first of all that were counted, RFC 3339.
        last: that of the last.
        files: the changed files, path → text.
        patch: the same as a unified diff.
        unwritten: why there is no patch; empty where there is one.
    """

    kind: str
    about: str
    words: str
    counts: Mapping[str, float]
    events: tuple[int, ...]
    first: str
    last: str
    files: Mapping[str, str]
    patch: str
    unwritten: str = ""

    def document(self) -> dict[str, Any]:
        """Return it as JSON; the changed files stand in the patch."""
        return {key: value for key, value in self._asdict().items() if key != "files"}


def suggest(policy: PolicySet, habits: Habits, least: Least) -> list[Suggestion]:
    """Return everything that a log suggests; a change that cannot be written says why. Pure."""
    return list(_Suggesting(policy, habits, least).all())


class _Suggesting:
    def __init__(self, policy: PolicySet, habits: Habits, least: Least) -> None:
        self._policy, self._habits, self._least = policy, habits, least
        self._by_rule, self._by_pair = answered(policy, habits)

    def all(self) -> Iterator[Suggestion]:
        """Yield kind by kind."""
        yield from self._always_bound()
        yield from self._asked_by_rules()
        yield from self._asked_by_authority()
        yield from self._supervised()
        yield from self._never_held()
        yield from self._edited()
        yield from self._taken_over()

    def _made(
        self, kind: str, about: str, words: str, counts: Mapping[str, float], seen: Tally,
        edit: Callable[[Patching], None],
    ) -> Iterator[Suggestion]:  # fmt: skip
        patching = Patching(self._policy)
        try:
            edit(patching)
        except PolicyErrors as found:  # written in a way that cannot be changed in place: whoever reads it does that
            unwritten, changed, patch = str(found.problems[0]), dict[str, str](), ""
        else:
            unwritten, changed, patch = "", patching.changed, patching.patch()
        yield Suggestion(
            kind, about, words, counts, tuple(seen.events), seen.first, seen.last, changed, patch, unwritten
        )

    # -- bounds ------------------------------------------------------------------------------------------------------

    def _always_bound(self) -> Iterator[Suggestion]:
        for (name, param, above), found in sorted(self._habits.bounds.items()):
            count = found.named.count
            if count >= self._least.decisions and len(found.beyond) == count:
                yield from self._bounded(name, param, found, above=above)

    def _bounded(self, name: str, param: str, found: Bound, *, above: bool) -> Iterator[Suggestion]:
        middle = median_low(found.beyond) if above else median_high(found.beyond)
        where = ", ".join(f"`{capability}` in {profile}" for capability, profile in sorted(found.pairs))
        words = (
            f"each of {found.named.count} values that agents named for {where} was {'above' if above else 'below'} "
            f"{found.limit:g} (from {min(found.beyond):g} to {max(found.beyond):g}): {middle:g} would let half of them "
            "through as they are, and loosens policy. Where the bound is right, tell the agents instead."
        )
        counts = {"named": found.named.count, "bound": found.limit, "proposed": middle}

        def edit(patching: Patching) -> None:
            if not param:
                file, limit = patching.file_of(name)
                source = self._policy.profiles[name.partition("/")[0]].limits[limit].source
                patching.set(file, ("limits", limit, "max"), _exact(middle))
                said = f"to be justified: was {found.limit:g} ({source})".replace("\\", "/").replace('"', "'")
                patching.set(file, ("limits", limit, "source"), f'"{said}"')
                return
            file, path = patching.place(name)
            patching.set(file, (*path, "set", param, "max" if above else "min"), _exact(middle))

        about = f"{name} ({param})" if param else name
        yield from self._made("always-bound", about, words, counts, found.named, edit)

    # -- approvals ---------------------------------------------------------------------------------------------------

    def _asked_by_rules(self) -> Iterator[Suggestion]:
        for name, found in sorted(self._by_rule.items()):
            rule = self._policy.rules[name]
            if rule.approvers > 1:
                continue
            if found.always(self._least.answers) and not self._grave(rule):
                words = f"all of {found.granted} proposals that `{name}` had people asked about were granted as shown"
                words += f": nobody would be asked{LOOSENS}"
                yield from self._made("always-granted", name, words, found.counts(), found.all, _without(name))
            if found.never(self._least.answers):
                words = f"all of {found.denied} proposals that `{name}` had people asked about were denied"
                yield from self._made("never-granted", name, words, found.counts(), found.all, _outcome(name, "deny"))

    def _grave(self, rule: Rule) -> bool:
        """Say whether a rule has a say in anything of critical risk, or that takes more than one person."""
        return rule.approvers > 1 or any(
            gate.capability.risk is Risk.CRITICAL or _several(gate)
            for (name, profile), gate in self._policy.gates.items()
            if (rule.applies_to is None or name in rule.applies_to)
            and (rule.profiles is None or profile in rule.profiles)
        )

    def _asked_by_authority(self) -> Iterator[Suggestion]:
        for name, profile in sorted(self._policy.profiles.items()):
            gates = [gate for gate in self._policy.gates.values() if gate.profile.name == name and answers(gate)]
            for risk in Risk:
                if profile.approval is not None and risk is not Risk.CRITICAL:
                    asked = [gate for gate in gates if gate.capability.risk is risk and _required(gate)]
                    yield from self._relieved(name, risk, profile.approval, asked)
            for gate in gates:
                yield from self._forbidden(gate)

    def _relieved(self, profile: str, risk: Risk, approval: Approval, asked: list[Gate]) -> Iterator[Suggestion]:
        """Suggest to ask nobody any more: of a risk only where everything of it was always granted."""
        if not asked or approval.approvers.get(risk, approval.default_approvers) > 1:
            return
        granted = [gate for gate in asked if self._answered(gate).always(self._least.answers)]
        if not _by_risk(asked[0]):
            for gate in granted:
                yield from self._relief(profile, gate.capability.name, [gate], None)
        elif len(granted) == len(asked):
            yield from self._relief(profile, f"{risk.value} risk", asked, risk)

    def _relief(self, profile: str, what: str, asked: list[Gate], risk: Risk | None) -> Iterator[Suggestion]:
        found = [self._answered(gate) for gate in asked]
        counts = {
            gate.capability.name: float(one.granted + one.in_advance) for gate, one in zip(asked, found, strict=True)
        }
        listed = ", ".join(f"{count:g} of `{name}`" for name, count in counts.items())
        in_advance = sum(one.in_advance for one in found)
        words = f"everything that {profile} had people asked about was granted as shown: {listed}" + (
            f"; {in_advance} of them in advance, by standing grants" if in_advance else ""
        )
        words += f". Nobody would be asked any more{LOOSENS}"

        def edit(patching: Patching) -> None:
            if risk is not None:
                left = [one.value for one in Risk if one is not risk and one in _approval(asked[0]).risks]
                patching.hold(patching.profile(profile), ("authority", "approval", "risk"), left)
            for gate in asked:
                if gate.capability.env_profile[profile] == MARKED:
                    file = patching.capability(gate.capability.name)
                    patching.set(file, ("env_profile", profile), "guarded")

        seen = found[0].all
        for one in found[1:]:
            seen = seen.with_(one.all)
        counts["in_advance"] = in_advance
        yield from self._made("always-granted", f"{what} in {profile}", words, counts, seen, edit)

    def _forbidden(self, gate: Gate) -> Iterator[Suggestion]:
        name, profile = gate.capability.name, gate.profile.name
        found = self._answered(gate)
        if found.never(self._least.answers):
            words = f"all of {found.denied} proposals of `{name}` that people were asked about in {profile} were denied"

            def edit(patching: Patching) -> None:
                patching.set(patching.capability(name), ("env_profile", profile), "forbidden")

            yield from self._made("never-granted", f"{name} in {profile}", words, found.counts(), found.all, edit)

    def _answered(self, gate: Gate) -> Answers:
        return self._by_pair.get((gate.capability.name, gate.profile.name), Answers())

    # -- permissions -------------------------------------------------------------------------------------------------

    def _supervised(self) -> Iterator[Suggestion]:
        seen = supervised(self._policy, self._habits)
        for name, agent in sorted(self._policy.agents.items()):
            for permission in sorted(agent.supervised):
                found = {pair: one for (*whose, pair), one in seen.alone.items() if whose == [name, permission]}
                total = Answers()
                for one in found.values():
                    total.add(one)
                if found and all(pair in found for pair in self._opened(permission)) and all(
                    one.always(self._least.answers) for one in found.values()
                ) and self._mild(permission):  # fmt: skip
                    yield from self._granted(name, permission, total, ("permissions", "supervised"))
                if total.never(self._least.answers) and (name, permission) not in seen.approved_beside:
                    yield from self._granted(name, permission, total, ("supervised",))

    def _opened(self, permission: str) -> Iterator[tuple[str, str]]:
        """Return what the permission alone has people asked about: where authority asks too, it goes on asking."""
        for pair, gate in self._policy.gates.items():
            if permission in gate.permissions and answers(gate) and not _required(gate):
                yield pair

    def _mild(self, permission: str) -> bool:
        """Say whether nothing that needs a permission is of critical risk, or takes more than one person."""
        return not any(
            gate.capability.risk is Risk.CRITICAL or _several(gate)
            for gate in self._policy.gates.values()
            if permission in gate.permissions
        )

    def _granted(self, agent: str, permission: str, found: Answers, lists: tuple[str, ...]) -> Iterator[Suggestion]:
        said = "granted as shown" if "permissions" in lists else "denied"
        count = found.granted if "permissions" in lists else found.denied
        words = (
            f"all of {count} proposals of `{agent}` that people were asked about because it holds `{permission}` under "
            f"supervision only were {said}"
        )
        if "permissions" in lists:
            words += f": it would hold it by itself{LOOSENS}"
        known = self._policy.agents[agent]
        left = {"permissions": known.permissions | {permission}, "supervised": known.supervised - {permission}}

        def edit(patching: Patching) -> None:
            for key in lists:
                patching.hold("organization.yaml", ("agents", agent, key), sorted(left[key]))

        kind = "always-granted" if "permissions" in lists else "never-granted"
        yield from self._made(kind, f"{permission} of {agent}", words, found.counts(), found.all, edit)

    # -- rules -------------------------------------------------------------------------------------------------------

    def _never_held(self) -> Iterator[Suggestion]:
        for name, applied in sorted(self._habits.applied.items()):
            rule = self._policy.rules[name]
            asks_for_more = rule.then is Effect.ESCALATE and self._grave(rule)
            if applied.count < self._least.silent or name in self._habits.told or asks_for_more:
                continue
            held = self._habits.held.get(name, 0)
            words = (
                f"`{name}` had a say in {applied.count} decisions and decided none"
                + (f"; its condition held in {held}, which kept to it" if held else "")
                + ". That nothing met it does not say that nothing will."
            )
            counts = {"applied": applied.count, "held": held}
            if rule.then is Effect.MODIFY:
                words += f" Without it nothing would hold what it holds{LOOSENS}"
                yield from self._made("never-held", name, words, counts, applied, _without(name))
            else:
                seen = (tuple(applied.events), applied.first, applied.last)
                yield Suggestion("never-held", name, words, counts, *seen, files={}, patch="", unwritten=STAYS)

    # -- overrides ---------------------------------------------------------------------------------------------------

    def _edited(self) -> Iterator[Suggestion]:
        for one in edited(self._habits, self._least.overrides):
            if (one.capability, one.profile) in self._policy.gates:
                yield from self._as_approved(one)

    def _as_approved(self, one: Habit) -> Iterator[Suggestion]:
        counts: dict[str, float] = {one.how: one.seen.count, "approved": one.of}
        if isinstance(one.value, str):
            was = "without one" if one.shown is None else f"shown with `{one.shown}`"
            done = f"{was} made `{one.param}` `{one.value}`"
        else:
            counts["proposed"] = one.value
            done = f"{one.how} `{one.param}`, to at {'most' if one.how == LOWERED else 'least'} {one.value:g}"
        words = (
            f"{one.seen.count} of {one.of} approvals of `{one.capability}` in {one.profile} {done}, and none changed "
            "it otherwise: policy may ask for that itself"
        )
        yield from self._made(
            f"{one.how}-on-approval", f"{one.capability} in {one.profile} ({one.param})", words, counts, one.seen,
            lambda patching: patching.add_rule(patching.profile(one.profile), one.rule()),
        )  # fmt: skip

    def _taken_over(self) -> Iterator[Suggestion]:
        for name, seen in sorted(self._habits.overridden.items()):
            if seen.count >= self._least.overrides:
                refused = self._habits.told[name].count
                words = (
                    f"after {seen.count} of {refused} refusals by `{name}` a person took the same cell by hand within "
                    f"ten minutes: it may be a question rather than a refusal{LOOSENS}"
                )
                counts = {"taken_over": seen.count, "refused": refused}
                yield from self._made("taken-over", name, words, counts, seen, _outcome(name, "escalate"))


def _without(rule: str) -> Callable[[Patching], None]:
    return lambda patching: patching.drop_rule(rule)


def _outcome(rule: str, then: str) -> Callable[[Patching], None]:
    def edit(patching: Patching) -> None:
        file, path = patching.place(rule)
        patching.set(file, (*path, "then"), then)

    return edit


def _approval(gate: Gate) -> Approval:
    approval = gate.profile.approval
    if approval is None:
        raise AssertionError("only what somebody answers is asked about")
    return approval


def _several(gate: Gate) -> bool:
    """Say whether it takes more than one person wherever people are asked about it."""
    if not answers(gate):
        return False
    approval = _approval(gate)
    return approval.approvers.get(gate.capability.risk, approval.default_approvers) > 1


def _by_risk(gate: Gate) -> bool:
    return AuthorityMode.APPROVAL_REQUIRED in gate.profile.authority and gate.capability.risk in _approval(gate).risks


def _required(gate: Gate) -> bool:
    """Say whether authority itself has a human asked."""
    return _by_risk(gate) or gate.capability.env_profile[gate.profile.name] == MARKED


def _exact(value: float) -> str:
    """Write a number so that it is read back as the very same: rounded, it would bound the value it was taken from."""
    return str(int(value)) if value.is_integer() else repr(value)


__all__ = ["Least", "Suggestion", "suggest"]
