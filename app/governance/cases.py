"""Cases for policy: a proposal in a context, and what must come of it (`reins policy test`).

A case says what differs from the ordinary: an idle cell at bench A whose sensors see every object within reach. What
`expect` does not name is not compared; `changes` names the parameters that must be changed, and to what. `session` is
what a session of it would be held to (`case_session`), as far as it is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from app.governance.bundle_fit import fit
from app.governance.bundle_shapes import CasesShape, ContextShape
from app.governance.bundle_yaml import Reader, parse
from app.governance.case_session import terms
from app.governance.decision import decide
from app.governance.errors import PolicyError, PolicyErrors
from app.governance.model import CellFacts, Context, Mode, ObjectFact, Proposal, WorldFacts
from app.governance.places import names
from app.governance.policy_model import GOVERNANCE
from app.governance.vocabulary import referring

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from app.governance.bundle_shapes import CaseShape, ExpectShape
    from app.governance.bundle_yaml import Path
    from app.governance.decision import Decision
    from app.governance.policy import PolicySet


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseResult:
    """How one case came out; `differences` is empty where everything expected was found."""

    file: str
    line: int
    name: str
    differences: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Return whether everything expected was found."""
        return not self.differences


class Found(NamedTuple):
    """A case where it stands, and the profile it is decided in."""

    file: str
    line: int
    profile: str
    case: CaseShape


def read(policy: PolicySet, files: Mapping[str, str]) -> list[Found]:
    """Read the cases of these files (`bundle.read_cases`), in order of file and place, without deciding them.

    Raises:
        PolicyErrors: A file of cases is not readable, or names what does not exist where that is not what it is about.
    """
    cases: list[Found] = []
    problems: list[PolicyError] = []
    there = names(policy.site)
    for file in sorted(files):
        document, found = parse(file, files[file])
        shape, misfits = fit(CasesShape, document) if not found else (None, [])
        problems += [*found, *misfits]
        if shape is None:
            continue
        reader = Reader(document=document)
        for index, case in enumerate(shape.cases):
            path, profile = ("cases", index), case.profile or shape.profile
            problems += reader.unknown((*path, "profile"), "profile", profile, policy.profiles)
            problems += _named(reader, path, case, policy, there)
            cases.append(Found(file, document.line(path), str(profile), case))
    if problems:
        raise PolicyErrors(problems)
    return cases


def _named(
    reader: Reader, path: Path, case: CaseShape, policy: PolicySet, there: Mapping[str, frozenset[str]]
) -> Iterator[PolicyError]:
    """Check that a case names what there is; what it proposes may not be there, if it expects to be told so."""
    context = case.context or ContextShape()
    stand = context.stand or policy.site.start
    yield from reader.unknown((*path, "context", "stand"), "target", stand, there["target"])
    steps: list[tuple[Path, str]] = [] if context.holding is None else [(("holding",), context.holding)]
    steps += [(("unseen", at), name) for at, name in enumerate(context.unseen)]
    steps += [(("unreachable", at), name) for at, name in enumerate(context.unreachable)]
    for step, name in (*steps, *((("at", name), name) for name in context.at)):
        yield from reader.unknown((*path, "context", *step), "object", name, there["object"])
    if _about_strangers(case.expect):
        return
    yield from reader.unknown((*path, "capability"), "capability", case.capability, policy.capabilities)
    found = policy.capabilities.get(case.capability)
    given: Mapping[str, str] = {} if found is None else referring(found)
    for kind, param in given.items():
        value = case.params.get(param)
        if isinstance(value, str):
            yield from reader.unknown((*path, "params", param), kind, value, there[kind])


def _about_strangers(expect: ExpectShape) -> bool:
    """Say whether a case expects the answer to a proposal that names what does not exist, or what nothing could be."""
    told = expect.codes is None or any(code.startswith(UNKNOWN) for code in expect.codes)
    return expect.status == "invalid" or (expect.status == "rejected" and told)


UNKNOWN: Final = "unknown_"  # how admission's codes for such names begin


def run(policy: PolicySet, files: Mapping[str, str]) -> list[CaseResult]:
    """Run the cases of these files, in order of file and place.

    Raises:
        PolicyErrors: As `read`.
    """
    return [
        CaseResult(
            file=file,
            line=line,
            name=case.name,
            differences=tuple(differences(policy, profile, case)),
        )
        for file, line, profile, case in read(policy, files)
    ]


def differences(policy: PolicySet, profile: str, case: CaseShape) -> list[str]:
    """Decide a case, and say wherein what came of it differs from what it expects."""
    return compared(case, came_of(policy, asking(policy, profile, case), session=case.expect.session is not None))


def compared(case: CaseShape, found: Mapping[str, Any]) -> list[str]:
    """Say wherein what came of a case differs from what it expects."""
    return [
        words
        for key, value in case.expect
        if value is not None and not _matches(key, value, found.get(key))
        for words in _apart(key, value, found.get(key))
    ]


def asking(policy: PolicySet, profile: str, case: CaseShape) -> tuple[Proposal, Context] | None:
    """Return what a case asks: its proposal and Γ_t; None where its parameters do not fit their schema."""
    params: Any = policy.validate_params(case.capability, case.params, case.capability_version)  # pyright: ignore[reportArgumentType]
    if isinstance(params, tuple):
        return None
    proposal = Proposal(
        capability=case.capability,
        params=params,
        metadata=case.metadata,  # pyright: ignore[reportArgumentType]  # pydantic's JsonValue is our Json
        mode=Mode(case.mode),
        preconditions=tuple(case.preconditions),
        version=case.capability_version,
    )
    return proposal, context(policy, profile, case.context or ContextShape())


def came_of(policy: PolicySet, asked: tuple[Proposal, Context] | None, *, session: bool = True) -> dict[str, Any]:
    """Decide what a case asks, and return what came of it, under the keys of `expect`."""
    if asked is None:
        return {"status": "invalid"}
    decision = decide(policy, *asked)
    found = {"status": str(decision.status), **_found(decision)}
    return {**found, "session": terms(policy, *asked, decision)} if session else found


def context(policy: PolicySet, profile: str, shape: ContextShape) -> Context:
    """Make Γ_t: the ordinary, but for what the shape says."""
    stand = policy.site.targets[shape.stand or policy.site.start]
    objects = {
        name: ObjectFact(
            visible=name not in shape.unseen,
            reachable=name not in shape.unreachable,
            x_m=shape.at.get(name, (found.x_m, found.y_m))[0],
            y_m=shape.at.get(name, (found.x_m, found.y_m))[1],
            z_m=policy.site.surfaces[found.surface].z_m + found.size_m[2],
            stamp_s=0.0,
        )
        for name, found in policy.site.objects.items()
    }
    facts = WorldFacts(
        stamp_s=0.0,
        arm_ready=shape.arm_ready,
        arm_retracted=shape.arm_retracted,
        gripper_empty=shape.holding is None if shape.gripper_empty is None else shape.gripper_empty,
        holding=shape.holding,
        base=(stand.x_m, stand.y_m, stand.yaw_rad),
        objects=objects,
        people_count=shape.people_count,
        people_nearest_m=shape.people_nearest_m,
        sensors_fresh=shape.sensors_fresh,
    )
    agent = policy.governance() if shape.agent == GOVERNANCE else policy.agent(shape.agent)
    return Context(
        time_s=0.0,
        profile=profile,
        agent=agent if shape.permissions is None else replace(agent, permissions=frozenset(shape.permissions)),
        cell=CellFacts(id="case", online=shape.online, latched=shape.latched, busy=shape.busy, facts=facts),
        operator_on_duty=shape.operator_on_duty,
    )


def _matches(key: str, wanted: object, found: object) -> bool:
    match key:
        case "codes" | "rules" if isinstance(found, list):
            return set(cast("list[str]", wanted)) <= set(cast("list[str]", found))
        case "determined_by" if isinstance(found, list):
            return sorted(set(cast("list[str]", wanted))) == found
        case "session":
            return _within(wanted, found)
        case _:
            return wanted == found


def _within(wanted: object, found: object) -> bool:
    """Say whether everything that is wanted is found, as deep as it goes; null wants that there be nothing."""
    if not (isinstance(wanted, dict) and isinstance(found, dict)):
        return wanted == found
    held = cast("dict[str, object]", found)
    return all(_within(value, held.get(key)) for key, value in cast("dict[str, object]", wanted).items())


def _apart(key: str, wanted: object, found: object) -> list[str]:
    """Say value by value wherein they differ, so that what agrees does not drown the difference."""
    whole = [f"{key}: expected `{_shown(wanted)}`, found `{_shown(found)}`"]
    if not isinstance(wanted, dict) or not isinstance(found, dict):
        return whole
    mine, others = cast("dict[str, object]", wanted), cast("dict[str, object]", found)
    more = others if key == "changes" else {}  # what a session holds besides is no difference
    names = [name for name in {**mine, **more} if not _within(mine.get(name), others.get(name))]
    return [words for name in names for words in _apart(f"{key}.{name}", mine.get(name), others.get(name))] or whole


def _shown(value: object) -> str:
    """Write a value as a case file has it."""
    match value:
        case None:
            return "nothing"
        case bool():
            return "true" if value else "false"
        case list():
            return f"[{', '.join(map(_shown, cast('list[object]', value)))}]"
        case dict():
            held = cast("dict[str, object]", value)
            return f"{{{', '.join(f'{name}: {_shown(one)}' for name, one in held.items())}}}"
        case _:
            return str(value)


def _found(decision: Decision) -> dict[str, object]:
    verdict = decision.verdict
    reasons = [*decision.admission.reasons, *(() if verdict is None else verdict.reasons)]
    return {
        "admission": decision.admission.outcome.value,
        "policy": None if verdict is None else verdict.outcome.value,
        "codes": [reason.code for reason in reasons],
        "rules": [reason.rule for reason in reasons],
        "determined_by": sorted({reason.rule for reason in reasons}),
        "changes": {} if verdict is None else {change.param: change.effective for change in verdict.changes},
        "approvers": 0 if decision.need is None else decision.need.approvers,
    }
