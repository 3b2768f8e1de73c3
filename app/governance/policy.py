"""The compiled policy set Π and what it answers: parameters, agents, descriptions.

A `PolicySet` is immutable and identified by the digest of the files it was made of; `app.governance.bundle` makes it,
and `app.governance.plans` binds it to one session.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

import orjson
from jsonschema_rs import ValidationErrorKind

from app.governance.model import AgentFacts
from app.governance.policy_model import GOVERNANCE
from app.governance.semver import meets
from app.governance.vocabulary import Names, Vocabulary

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jsonschema_rs import Draft202012Validator, ValidationError

    from app.governance.conditions import Test
    from app.governance.model import Capability, Json, Params, Site
    from app.governance.policy_code import Check, Parts
    from app.governance.policy_model import Agent, Authority, Profile, Rule, WatchRow


class ParamProblem(NamedTuple):
    """One thing wrong with a proposal's parameters: where, a stable code, what, and what would be valid."""

    param: str
    code: str
    message: str
    remedy: str = ""

    @property
    def said(self) -> str:
        """Return what is wrong with which parameter; what is missing names itself."""
        return f"`{self.param}` {self.message}" if self.param else self.message


Known: TypeAlias = "tuple[tuple[str, str, frozenset[str]], ...]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """Everything a decision about one (capability, profile) needs, looked up once.

    `known` lists the parameters that refer to names of the site (parameter, kind, the names there are), `actions` the
    parameters that hold a tool and what to do with it. `source` is the text `check` was compiled from, `parts` what it
    can be bound from again in another process.
    """

    capability: Capability
    profile: Profile
    permissions: frozenset[str]
    site: Site
    tests: tuple[Test, ...]
    known: Known
    actions: tuple[str, str] | None
    check: Check
    source: str
    parts: Parts


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """A capability's compiled input schema."""

    validator: Draft202012Validator
    defaults: Mapping[str, Json]
    numbers: frozenset[str]
    integers: frozenset[str]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PolicySet:
    """Π, ready to decide.

    Attributes:
        digest: `sha256:…` over the files.
        capabilities: Manifests by name, recovery capabilities included.
        profiles: Environment profiles by name.
        site: The site.
        agents: What each known agent may do.
        authority: H, as far as every profile shares it.
        rules: Every rule by its full id.
        gates: The compiled pairs; a pair that is missing is not enabled.
        inputs: Compiled input schemas by capability.
        permissions: Every permission there is.
        files: The files it was made of, path → text.
    """

    digest: str
    capabilities: Mapping[str, Capability]
    profiles: Mapping[str, Profile]
    site: Site
    agents: Mapping[str, Agent]
    authority: Authority
    rules: Mapping[str, Rule]
    gates: Mapping[tuple[str, str], Gate]
    inputs: Mapping[str, Inputs]
    permissions: frozenset[str]
    files: Mapping[str, str]

    def validate_params(
        self, capability: str, params: Mapping[str, Json], version: str | None = None
    ) -> Params | tuple[ParamProblem, ...]:
        """Hold parameters to the capability's input schema; return them with defaults filled in, or what is wrong.

        Numbers come back as floats, and integers as integers of 64 bits: to JSON Schema `3.0` and `1e30` are some too.
        Names that the site does not know are no problem here: admission rejects them. For an unknown capability, and
        where `version` asks for another one than is in force, there is nothing to hold the parameters to, and admission
        rejects the proposal.
        """
        problems = () if _plainly_safe(params) else tuple(_unsafe(params, ()))
        inputs = self.inputs.get(capability)
        if problems or inputs is None:
            return problems or params
        if version is not None and not meets(self.capabilities[capability].version, version):
            return params
        if not inputs.validator.is_valid(params):
            return tuple(_schema_problems(inputs.validator, self.capabilities[capability].inputs, params))
        filled = {**inputs.defaults, **params}
        for name in inputs.numbers & filled.keys():
            filled[name] = float(cast("float", filled[name]))
        for name in inputs.integers & filled.keys():
            filled[name] = whole = int(cast("float", filled[name]))
            if abs(whole) >= 2**63:
                return (_beyond_64_bits(name),)
        return filled

    def agent(self, name: str) -> AgentFacts:
        """Return what policy permits this identity; an unknown one is permitted nothing."""
        found = self.agents.get(name)
        return AgentFacts(name=name, permissions=frozenset() if found is None else found.permissions)

    def governance(self) -> AgentFacts:
        """Return the identity under which recoveries are proposed; nobody can claim it, policy grants it to none."""
        return AgentFacts(name=GOVERNANCE, permissions=self.permissions | {GOVERNANCE})

    def vocabulary(self) -> Vocabulary:
        """Return what types conditions about this policy: they name what it has, and nothing else."""
        names = Names(
            capabilities=frozenset(self.capabilities),
            profiles=frozenset(self.profiles),
            permissions=self.permissions,
            site=self.site,
        )
        return Vocabulary(self.capabilities, names)

    def describe(self) -> dict[str, Any]:
        """Describe the active policy (`GET /v1/policies/active`)."""
        return {
            "version": self.digest,
            "capabilities": sorted(self.capabilities),
            "profiles": {name: _describe_profile(profile) for name, profile in sorted(self.profiles.items())},
            "rules": [_describe_rule(rule) for rule in self.rules.values()],
            "agents": {
                name: {"permissions": sorted(agent.permissions), "supervised": sorted(agent.supervised)}
                for name, agent in sorted(self.agents.items())
            },
            "authority": _describe_authority(self.authority),
            "files": sorted(self.files),
            "site": _describe_site(self.site),
        }

    def watched(self) -> dict[str, Any]:
        """Describe what each profile watches, and how (`GET /v1/policies/active/watch`)."""
        return {
            "version": self.digest,
            "profiles": {
                name: {
                    "watch": [_describe_watch(row) for row in profile.watch],
                    "stale_after_ms": dict(profile.stale_after_ms),
                    "separation": None if profile.separation is None else asdict(profile.separation),
                }
                for name, profile in sorted(self.profiles.items())
            },
        }

    def manifests(self) -> list[dict[str, Any]]:
        """Describe every capability (`GET /v1/capabilities`), in order of name."""
        return [_manifest(self.capabilities[name]) for name in sorted(self.capabilities)]


def _describe_site(site: Site) -> Json:
    """Describe everything in the site that has a name, for whoever has to name it: agents and displays."""
    return cast("Json", orjson.loads(orjson.dumps(site, default=dict)))


# Parameters ----------------------------------------------------------------------------------------------------------

_MAX_DEPTH = 16


def _plainly_safe(params: Mapping[str, Json]) -> bool:
    """Say at a glance that there is nothing to find: short ASCII keys over ASCII texts, booleans, ordinary numbers."""
    for name, value in params.items():
        kind = type(value)
        if not name.isascii():
            return False
        if kind is str:
            if not cast("str", value).isascii():
                return False
        elif kind is float or kind is int:
            if not -_ORDINARY < cast("float", value) < _ORDINARY:  # false for NaN
                return False
        elif kind is not bool:
            return False
    return True


_ORDINARY: Final = 1e15


def _unsafe(value: object, path: tuple[str, ...]) -> list[ParamProblem]:
    """Find what no schema needs to see: NaN, infinities, half surrogates, bottomless nesting, what is not JSON."""
    where = ".".join(path)
    if len(path) > _MAX_DEPTH:
        return [ParamProblem(where, "too_deep", f"nested deeper than {_MAX_DEPTH} levels")]
    match value:
        case float() if not math.isfinite(value):
            return [ParamProblem(where, "not_finite", f"`{value}` is not a finite number", "a finite number")]
        case int() if abs(value) >= 2**63:
            return [_beyond_64_bits(where)]
        case str():
            return [] if _encodable(value) else [ParamProblem(where, "bad_text", "half of a surrogate pair")]
        case None | bool() | int() | float():
            return []
        case list():
            items = cast("list[object]", value)
            return [found for index, item in enumerate(items) for found in _unsafe(item, (*path, str(index)))]
        case _ if hasattr(value, "items"):
            entries = cast("Mapping[str, object]", value)
            keys = [problem for key in entries for problem in _unsafe(key, path)]
            return keys + [found for key, item in entries.items() for found in _unsafe(item, (*path, key))]
        case _:
            return [ParamProblem(where, "not_json", f"a `{type(value).__name__}` is not JSON")]


def _beyond_64_bits(where: str) -> ParamProblem:
    return ParamProblem(where, "out_of_range", "an integer beyond 64 bits", "a smaller number")


def _encodable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _schema_problems(
    validator: Draft202012Validator, schema: Mapping[str, Json], params: Mapping[str, Json]
) -> list[ParamProblem]:
    return [problem for error in validator.iter_errors(params) for problem in _problems_of(error, schema)]


def _problems_of(error: ValidationError, schema: Mapping[str, Json]) -> list[ParamProblem]:
    """Say what a schema found, each unknown parameter by its name, and what would be valid."""
    where = [str(step) for step in error.instance_path]
    match error.kind:
        case ValidationErrorKind.AdditionalProperties(unexpected=names):
            remedy = ", ".join(_taken(schema, error.schema_path[:-1]))
            return [ParamProblem(_at(where, name), "schema", "is unknown", remedy) for name in names]
        case ValidationErrorKind.Required(property=name):
            return [ParamProblem(_at(where, name), "schema", "is missing")]
        case _:
            choice = _choice(schema) if list(error.schema_path) == ["oneOf"] else []
            message = "name " + ", or ".join(choice) if choice else error.message
            message = message if len(message) <= 300 else message[:297] + "…"
            return [ParamProblem(".".join(where), "schema", message[:1].lower() + message[1:])]


def _at(where: Sequence[str], name: str) -> str:
    """Return the path to what has this name; no name at all is shown as one."""
    return ".".join([*where, name[:64] or '""'])


def _taken(schema: Mapping[str, Json], path: Sequence[str | int]) -> list[str]:
    """Return what the object schema at a path names; what its patterns take stands behind."""
    place: Any = schema
    for step in path:
        place = place[step]
    return [f"`{name}`" for name in (*place.get("properties", ()), *place.get("patternProperties", ()))]


def _choice(schema: Mapping[str, Json]) -> list[str]:
    """Return the sets of parameters a schema leaves the choice between; empty where its branches are more than that."""
    branches = cast("list[Mapping[str, Json] | bool]", schema["oneOf"])
    required = [cast("list[str]", branch.get("required", [])) if branch and branch is not True else []
                for branch in branches]  # fmt: skip
    return [_listed([f"`{name}`" for name in names]) for names in required] if all(required) else []


def _listed(names: Sequence[str]) -> str:
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


# Descriptions --------------------------------------------------------------------------------------------------------


def _manifest(capability: Capability) -> dict[str, Any]:
    return {
        "name": capability.name,
        "version": capability.version,
        "summary": capability.summary,
        "inputs": cast("Json", dict(capability.inputs)),
        "phases": list(capability.phases),
        "preconditions": list(capability.preconditions),
        "postconditions": list(capability.postconditions),
        "permissions": sorted(capability.permissions),
        "risk": capability.risk.value,
        "rollback": capability.rollback,
        "env_profile": dict(capability.env_profile),
        "timeout_s": capability.timeout_s,
        "recovery": capability.recovery,
        "changes": dict(capability.changes),
    }


def _describe_profile(profile: Profile) -> dict[str, Any]:
    approval, review = profile.approval, profile.review
    return {
        "sensitivity": profile.sensitivity,
        "modes": sorted(mode.value for mode in profile.admits),
        "limits": {
            name: {"max": limit.maximum, "unit": limit.unit, "source": limit.source}
            for name, limit in profile.limits.items()
        },
        "retry_budget": profile.retry_budget,
        "rollback": profile.rollback,
        "shared_floor": profile.shared_floor,
        "watch": [row.id for row in profile.watch],
        "authority": {
            "modes": sorted(mode.value for mode in profile.authority),
            "approval": None
            if approval is None
            else {
                "risk": sorted(risk.value for risk in approval.risks),
                "within_s": approval.within_s,
                "on_timeout": approval.on_timeout,
                "approvers": {
                    "default": approval.default_approvers,
                    **{risk.value: count for risk, count in approval.approvers.items()},
                },
            },
            "review": None
            if review is None
            else {
                "risk": sorted(risk.value for risk in review.risks),
                "outcomes": sorted(outcome.value for outcome in review.outcomes),
            },
        },
    }


def _describe_watch(row: WatchRow) -> dict[str, Any]:
    number_or_name = row.number if row.named is None else row.named
    response = row.response
    return {
        "id": row.id,
        "applies_to": None if row.applies_to is None else sorted(row.applies_to),
        "signal": row.signal,
        "above": row.above,
        "threshold": number_or_name if row.limit is None else {"limit": row.limit, "times": row.times},
        "for_ms": row.for_ms,
        "response": {
            "enter": response.enter.value,
            "clear_after_ms": response.clear_after_ms,
            "clear_beyond": response.clear_beyond,
            "then": response.then,
            "persist_ms": response.persist_ms,
            "else": response.otherwise.value,
        },
    }


def _describe_authority(authority: Authority) -> dict[str, Any]:
    grants = authority.grants
    return {
        "mid_execution": {"within_s": authority.within_s, "on_timeout": authority.on_timeout},
        "confirm_before": [
            {
                "capability": entry.capability,
                "profile": entry.profile,
                "phases": list(entry.phases),
                "within_s": authority.within_s if entry.within_s is None else entry.within_s,
                "on_deny": entry.on_deny,
                "on_timeout": entry.on_timeout,
            }
            for entry in authority.confirm_before
        ],
        "grants": None
        if grants is None
        else {"up_to_s": grants.up_to_s, "risk": sorted(risk.value for risk in grants.risks)},
        "denials": [
            {"code": denial.code, "says": denial.says, "remedy": denial.remedy} for denial in authority.denials
        ],
    }


def _describe_rule(rule: Rule) -> dict[str, Any]:
    return {
        "id": rule.id,
        "applies_to": None if rule.applies_to is None else sorted(rule.applies_to),
        "profiles": None if rule.profiles is None else sorted(rule.profiles),
        "when": rule.when,
        "then": rule.then.value,
        "set": {
            setting.param: {
                key: value
                for key, value in (("min", setting.minimum), ("max", setting.maximum), ("to", setting.to))
                if value is not None
            }
            for setting in rule.settings
        },
        "approvers": rule.approvers or None,  # None leaves it to the profile
        "because": rule.because,
        "remedy": rule.remedy,
    }
