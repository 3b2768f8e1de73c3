"""Everything that is quantified over when a capability is proved: its proposals, and the contexts they may meet.

A proposal is one that `admit` does not reject: it fits its input schema, names what the site has, carries well-formed
metadata in a mode that exists, by an agent that holds the permissions (or holds them under supervision). The context is
any: what the gripper holds, what the sensors say, who is about; but a cell that has said nothing yet is none.

Agents are those that policy declares, and any other that it could declare: a name of its own and any set of the
permissions there are. So what is proved survives a new line in `agents`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, floor, inf
from typing import TYPE_CHECKING, Final, cast

import z3

from app.governance.expression_reach import INT_MAX
from app.governance.model import Mode
from app.governance.places import names
from app.governance.policy_model import GOVERNANCE
from app.governance.vocabulary import always_there, properties, referring
from app.proofs.encoding import Record, Slot
from app.proofs.formulas import Formula, both, every, exactly_one, holds, implies, named, no, rational, some, text
from app.proofs.ground import Coordinates, Ground
from app.proofs.schema import Given, admitted, mentioned
from app.proofs.values import Items, Theory, Value, choice, constant, truth

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from app.governance.model import Capability, Json
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Profile
    from app.proofs.encoding import Scope

FARTHEST_M: Final = 1000.0  # how far off an object may be perceived
NEAREST_M: Final = 1e9  # `within` of `world.people_nearest_m`
KEPT: Final = frozenset({  # the keywords of a parameter that are known here
    "type", "const", "enum", "default", "title", "description", "$comment", "unit", "x-limit", "x-ref", "minLength",
    "maxLength", "minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum",
})  # fmt: skip
FLAGS: Final = ("gripper_empty", "arm_ready", "arm_retracted", "sensors_fresh")
STRANGER: Final = ""  # any agent that policy does not declare: what none can be called


@dataclass(frozen=True, slots=True)
class Options:
    """One of a few: each with the variable that says it is that one."""

    options: tuple[tuple[z3.BoolRef, str | None], ...]

    @staticmethod
    def of(name: str, values: Iterable[str | None]) -> Options:
        """Make the variables: one for each value, however often a schema lists it; two would exclude each other."""
        return Options(tuple((named(f"{name} = {value}"), value) for value in dict.fromkeys(values)))

    @property
    def one(self) -> Formula:
        """Say that it is exactly one of them."""
        return exactly_one([option for option, _ in self.options]) if self.options else False

    def where(self, accept: Iterable[str | None]) -> Formula:
        """Return where it is one of these."""
        wanted = set(accept)
        return some(option for option, value in self.options if value in wanted)

    def read(self, model: z3.ModelRef) -> str | None:
        """Return which one it is in a model."""
        return next((value for option, value in self.options if holds(model, option)), None)


@dataclass(slots=True)
class Space:
    """The variables of one capability, and what is known of them.

    Attributes:
        theory: Facts about terms; they are part of every question asked.
        params: Every parameter, as conditions see it (defaults filled in).
        given: Where the proposal itself gives a parameter.
        facts: What every proposal and context keeps.
        said: Facts about texts, by what reads them; only questions that do pay for them.
        ground: The site.
        beside: The space of another policy that this one is compared with. What has the same name is the same in both,
            and so is what rounding or an edge leaves open.
    """

    policy: PolicySet
    capability: Capability
    theory: Theory = field(default_factory=Theory)
    params: dict[str, Slot] = field(default_factory=dict[str, Slot])
    given: dict[str, Formula] = field(default_factory=dict[str, Formula])
    facts: list[Formula] = field(default_factory=list["Formula"])
    said: dict[str, Formula] = field(default_factory=dict[str, "Formula"])
    loose: bool = False  # whether the schema says more than is known here
    beside: Space | None = None
    ground: Ground = field(init=False)
    agents: Options = field(init=False)
    modes: Options = field(init=False)
    holding: Options = field(init=False)
    _holding: dict[str, Formula] = field(default_factory=dict[str, "Formula"])
    _lasting: dict[str, Value | Record] = field(default_factory=dict[str, "Value | Record"])
    _ready: Formula | None = None
    held: dict[str, z3.BoolRef] = field(default_factory=dict[str, z3.BoolRef])  # permissions of the other agent

    def __post_init__(self) -> None:
        """Make the variables."""
        self.ground = Ground(referring(self.capability), self.policy.site)
        if self.beside is not None:
            self.theory, self.ground.answers = self.beside.theory, self.beside.ground.answers
        self._parameters()
        self._who()
        self.modes = Options.of("mode", [mode.value for mode in Mode])
        self.holding = Options.of("holding", [None, *sorted(self.policy.site.objects)])
        self.facts += [self.modes.one, self.holding.one]
        count, near = self.people
        self.facts += [count >= 0, count <= INT_MAX, near >= 0, near <= rational(NEAREST_M)]
        confidence, priority = z3.Real("metadata.confidence"), z3.Int("metadata.priority")
        self.facts += [confidence >= 0, confidence <= 1, priority <= INT_MAX, priority >= -INT_MAX]
        x, y = self.seen
        far = rational(FARTHEST_M)
        self.facts += [x <= far, x >= -far, y <= far, y >= -far]

    @property
    def approximate(self) -> bool:
        """Whether a solution may be none for the real code."""
        return self.loose or self.theory.approximate or self.ground.approximate

    def plain(self) -> list[Formula]:
        """Return what keeps a solution from every edge, and from rounding: the real code has the same."""
        return [*self.theory.exactly, *(no(edge) for edge in self.ground.edges)]

    @property
    def people(self) -> tuple[z3.ArithRef, z3.ArithRef]:
        """How many people are about, and how near the nearest is."""
        return z3.Int("world.people_count"), z3.Real("world.people_nearest_m")

    @property
    def seen(self) -> tuple[z3.ArithRef, z3.ArithRef]:
        """Where the object a proposal names is perceived."""
        return z3.Real("seen.x"), z3.Real("seen.y")

    # Parameters ------------------------------------------------------------------------------------------------------

    def _parameters(self) -> None:
        there = always_there(self.capability)
        schema = self.capability.inputs
        required = frozenset(cast("list[str]", schema.get("required", [])))
        together = mentioned(schema)
        for name, spec in properties(self.capability).items():
            given: Formula = True if name in required else named(f"given {name}")
            value = self._parameter(name, spec, name in there or given)
            self.params[name] = Slot(True if name in there else given, value)
            if name not in required and name in there and together:
                default = constant(
                    cast("str", spec["default"]) if spec["type"] != "number" else _float(spec["default"])
                )
                equal = (
                    value.truth if default.cases[0][1] is True else no(value.truth)
                ) if spec["type"] == "boolean" else self.theory.apply(
                    "equal", (value, default), checked=False, wide=False
                ).truth  # fmt: skip
                self.facts.append(implies(no(given), equal))
            self.given[name] = given if together or name not in there else True
        values = {name: slot.value for name, slot in self.params.items()}
        kept, known = admitted(schema, Given(self.given, values, self.theory))
        self.facts.append(kept)
        self.loose = not known or self.loose
        self._actions()

    def _parameter(self, name: str, spec: Mapping[str, Json], there: Formula) -> Value:
        self.loose |= not spec.keys() <= KEPT
        match spec["type"]:
            case "boolean":
                said = named(f"params.{name}")
                for listed in (
                    [spec[key]] if key == "const" else spec[key] for key in ("const", "enum") if key in spec
                ):
                    flags = [value for value in cast("list[Json]", listed) if isinstance(value, bool)]
                    self.facts.append(some(said if value else no(said) for value in flags))
                return truth(said)
            case "string":
                options = Options.of(f"params.{name}", self._choices(spec))
                self.facts.append(implies(there, options.one))
                return choice([(option, cast("str", value)) for option, value in options.options])
            case kind:
                return self._number(z3.Real(f"params.{name}") if kind == "number" else z3.Int(f"params.{name}"), spec)

    def _choices(self, spec: Mapping[str, Json]) -> list[str]:
        known = names(self.policy.site)[str(spec["x-ref"])] if "x-ref" in spec else None
        listed = spec.get("enum", [spec["const"]] if "const" in spec else None)
        choices = cast("list[Json]", sorted(known or ()) if listed is None else listed)
        low, high = (cast("float", spec.get(key, end)) for key, end in (("minLength", 0), ("maxLength", inf)))
        texts = [value for value in choices if isinstance(value, str)]  # an earlier release let others stand there
        return [value for value in texts if (known is None or value in known) and low <= len(value) <= high]

    def _number(self, number: z3.ArithRef, spec: Mapping[str, Json]) -> Value:
        real = number.is_real()

        def bound(key: str, fallback: float, whole: Callable[[float], int]) -> z3.ArithRef:
            value = cast("float", spec.get(key, fallback))
            return rational(float(value)) if real else cast("z3.ArithRef", z3.IntVal(whole(value)))

        # Between two integers a bound means the one on its inner side, or where it is exclusive the one beyond it.
        self.facts += [number >= bound("minimum", -INT_MAX, ceil), number <= bound("maximum", INT_MAX, floor)]
        if "exclusiveMinimum" in spec:
            self.facts.append(number > bound("exclusiveMinimum", 0, floor))
        if "exclusiveMaximum" in spec:
            self.facts.append(number < bound("exclusiveMaximum", 0, ceil))
        for key in ("enum", "const"):
            if key in spec:
                given = cast("list[Json]", spec[key] if key == "enum" else [spec[key]])
                listed = [value for value in given if isinstance(value, (int, float)) and not isinstance(value, bool)]
                self.facts.append(some(number == (rational(float(value)) if real else value) for value in listed))
        return constant(number)

    def _actions(self) -> None:
        """A tool is asked only for what it can do; admission rejects the rest."""
        references = referring(self.capability)
        if not {"tool", "action"} <= references.keys():
            return
        actions = self.params[references["action"]].value
        for guard, name in self.params[references["tool"]].value.cases:
            known = self.policy.site.tools[cast("str", name)].actions
            self.facts.append(implies(guard, some(other for other, action in actions.cases if action in known)))

    # Who -------------------------------------------------------------------------------------------------------------

    def _who(self) -> None:
        recovery = self.capability.recovery
        declared = [] if recovery else sorted(self.policy.agents)
        self.agents = Options.of("agent", [*declared, GOVERNANCE if recovery else STRANGER])
        wanted = sorted(self.policy.permissions | ({GOVERNANCE} if recovery else set()))
        self.held = {name: named(f"permission {name}") for name in wanted}
        self.facts.append(self.agents.one)
        if recovery:
            self.facts.append(self.held[GOVERNANCE])
        name = z3.String("agent.name")
        self.said["agent.name"] = every(name != text(agent) for agent in (STRANGER, *declared))
        missing = [no(self.holds(permission)) for permission in sorted(self.capability.permissions)]
        backed = [
            some(o for o, agent in self.agents.options if agent in declared and permission in self._under(agent))
            for permission in sorted(self.capability.permissions)
        ]  # fmt: skip
        self.facts += [implies(lacks, under) for lacks, under in zip(missing, backed, strict=True)]

    def _under(self, agent: str | None) -> frozenset[str]:
        found = self.policy.agents.get(agent or "")
        return frozenset() if found is None else found.supervised

    def holds(self, permission: str) -> Formula:
        """Return where the agent holds a permission by itself."""
        if permission not in self._holding:
            own = [
                option
                for option, name in self.agents.options
                if permission in self.policy.agent(name or "").permissions
            ]
            other = both(self.agents.where([STRANGER, GOVERNANCE]), self.held.get(permission, False))
            self._holding[permission] = some((*own, other))
        return self._holding[permission]

    @property
    def supervised(self) -> Formula:
        """Return where the agent lacks a permission, and holds it under supervision."""
        return some(no(self.holds(permission)) for permission in self.capability.permissions)

    # What conditions see ---------------------------------------------------------------------------------------------

    def scope(self, profile: Profile, params: Record | None = None) -> tuple[Scope, Mapping[str, Formula]]:
        """Return what conditions see under a profile, and where looking up `target`, `place` or `tool` fails.

        Args:
            profile: Under which profile.
            params: Parameters in the place of the proposal's own.
        """
        shown = self.params if params is None else params
        x, y = self.seen
        target, no_target = self.ground.target(shown, [(option, name) for option, name in self.holding.options])
        place, no_place = self.ground.place(shown, Coordinates(((True, x, y),)))
        broken = {"target": no_target, "place": no_place}
        scope: dict[str, Value | Record] = {
            "params": shown,
            "target": target,
            "place": place,
            **self._always(),
            "profile": _known(
                name=profile.name, sensitivity=profile.sensitivity, shared_floor=profile.shared_floor
            ),
            "limits": _known(**{name: limit.maximum for name, limit in profile.limits.items()}),
        }  # fmt: skip
        if "tool" in referring(self.capability):
            scope["tool"], broken["tool"] = self.ground.tool(shown)
        return scope, broken

    def _always(self) -> Mapping[str, Value | Record]:
        """Return what neither profile nor parameters change, made once."""
        if not self._lasting:
            self._lasting = {
                "agent": self._agent(),
                "metadata": self._metadata(),
                "capability": _known(name=self.capability.name, risk=self.capability.risk.value),
                "mode": choice((option, cast("str", name)) for option, name in self.modes.options),
                "world": self._world(),
                "operator_on_duty": truth(named("operator_on_duty")),
            }
        return self._lasting

    def _agent(self) -> Record:
        names_ = [
            (option, z3.String("agent.name") if name == STRANGER else cast("str", name))
            for option, name in self.agents.options
        ]
        held = [(self.holds(name), constant(name)) for name in sorted({*self.policy.permissions, *self.held})]
        return {
            "name": Slot(True, choice(names_)),
            "permissions": Slot(True, constant(Items(tuple(held)))),
        }

    def _metadata(self) -> Record:
        terms: Mapping[str, z3.ExprRef] = {
            "confidence": z3.Real("metadata.confidence"),
            "intent": z3.String("metadata.intent"),
            "priority": z3.Int("metadata.priority"),
        }
        return {name: Slot(named(f"given metadata.{name}"), constant(held)) for name, held in terms.items()}

    def _world(self) -> Record:
        count, near = self.people
        held = [(option, name) for option, name in self.holding.options if name is not None]
        return {
            "people_count": Slot(True, constant(count)),
            "people_nearest_m": Slot(True, constant(near)),
            **{name: Slot(True, truth(named(f"world.{name}"))) for name in FLAGS},
            "holding": Slot(some(option for option, _ in held), choice(held)),
        }

    # What admission asks for -----------------------------------------------------------------------------------------

    def ready(self) -> Formula:
        """Return where an idle cell meets the preconditions, as far as conditions can see them; made once.

        Where the base stands, and what is in sight, no condition sees; a counterexample is given what it needs.
        """
        if self._ready is None:
            self._ready = self._idle()
        return self._ready

    def _idle(self) -> Formula:
        there = {name: named(f"world.{name}") for name in FLAGS}
        empty = both(there["gripper_empty"], self.holding.where([None]))
        carrying = both(z3.Not(there["gripper_empty"]), no(self.holding.where([None])))
        needs: Mapping[str, Formula] = {**there, "gripper_empty": empty, "carrying": carrying}
        return every(needs.get(name, True) for name in self.capability.preconditions)


def _float(value: Json) -> float:
    return float(cast("float", value))


def _known(**values: str | float | bool) -> Record:
    return {
        name: Slot(True, truth(value) if isinstance(value, bool) else constant(value)) for name, value in values.items()
    }
