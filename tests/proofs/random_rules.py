"""Random rule sets over the shipped site, and random proposals in random contexts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

from app.governance import bundle
from app.governance.errors import ExpressionError
from app.governance.expression_tree import BOOL, STRING
from app.governance.policy_code import Generator
from app.governance.policy_model import Effect, Rule, Setting
from app.governance.vocabulary import Vocabulary, always_there, properties
from tests.governance.policy_world import PROFILES, files

if TYPE_CHECKING:
    from random import Random

    from app.governance.policy import PolicySet

# A capability with every kind of parameter there is.
PROBE = """
name: probe_it
version: 1.0.0
summary: Everything a parameter can be.
inputs:
  type: object
  additionalProperties: false
  required: [object_id, count]
  properties:
    object_id: {type: string, x-ref: object}
    count: {type: integer, minimum: -3, maximum: 9}
    step: {type: integer}
    flag: {type: boolean, default: false}
    wet: {type: boolean}
    style: {type: string, enum: [soft, hard, odd], default: soft}
    corridor: {type: string, x-ref: corridor}
    amount_kg: {type: number, unit: kg, minimum: 0, maximum: 8, default: 1}
    speed_mps: {type: number, unit: m/s, minimum: 0.05, maximum: 2.0, default: 0.3, x-limit: base_speed_mps}
    force_n: {type: number, unit: N, minimum: 2, maximum: 140, default: 40, x-limit: grip_force_n}
    turn_rad: {type: number, unit: rad, minimum: -3.5, maximum: 3.5}
  dependentRequired: {wet: [turn_rad], corridor: [wet]}
  if: {properties: {style: {const: odd}}, required: [style]}
  then: {properties: {force_n: {minimum: 15}, object_id: {enum: [mug_1, box_1]}}}
preconditions: []
postconditions: []
permissions: [perception]
risk: medium
rollback: retrace
env_profile: {sim-relaxed: allowed, test-audit: allowed, real-restricted: guarded, human-shared: guarded}
timeout_s: 20
"""
CAPABILITIES = ("probe_it", "grasp_object", "navigate_to", "place_object", "operate_tool", "transport_object")
NUMBERS = ("0.0", "0.1", "0.15", "0.25", "0.3", "0.5", "1.0", "2.5", "3.0", "20.0", "40.0", "60.0", "1e3", "1e308")
INTEGERS = ("0", "1", "2", "3", "-1", "7", "100", "4611686018427387904")
WORDS = ('"mug_1"', '"glass"', '"dock"', '"aisle"', '"point"', '"planner"', '"soft"', '"a"', '""', '"by hand"', '"é"')


@cache
def base() -> PolicySet:
    text = files()
    return bundle.load_files({
        **text, "capabilities/probe_it.yaml": PROBE,
        "site.yaml": text["site.yaml"].replace("zones:\n", "zones:\n  wedge: {kind: forbidden, polygon: [[1.0, 1.0], [2.5, 1.2], [1.7, 2.4]]}\n")
        .replace("half_y_m: 0.6, yaw_rad: 0.0", "half_y_m: 0.6, yaw_rad: 0.4"),
    })  # fmt: skip


@cache
def vocabulary() -> Vocabulary:
    return base().vocabulary()


class Drawing:
    """Draws conditions about one capability that type-check."""

    def __init__(self, random: Random, capability: str) -> None:
        self.random, self.capability = random, base().capabilities[capability]
        declared = properties(self.capability)
        there = always_there(self.capability)
        of = {
            kind: [f"params.{name}" for name, spec in declared.items() if spec["type"] == kind]
            for kind in ("number", "integer", "boolean", "string")
        }
        optional = [name for name in declared if name not in there]
        tool = ["tool.name", "tool.kind"] if "tool" in declared else []
        self.bools = [
            "target.fragile", "target.hazardous", "place.forbidden", "place.outside", "world.gripper_empty", "world.arm_ready",
            "operator_on_duty", "profile.shared_floor", "has(metadata.confidence)", "has(place.corridor)", "has(world.holding)",
            "has(metadata.intent)", '"hazmat" in agent.permissions', '"manipulation" in agent.permissions', "true",
            'capability.risk in ["medium", "high"]', 'mode == "careful"', *of["boolean"], *(f"has(params.{name})" for name in optional),
            *(["tool.press"] if tool else []),
        ]  # fmt: skip
        self.doubles = ["target.mass_kg", "limits.payload_kg", "metadata.confidence", "world.people_nearest_m",
                        "profile.sensitivity", "limits.tcp_speed_mps", *of["number"], *of["number"]]  # fmt: skip
        self.ints = [
            "world.people_count",
            "metadata.priority",
            "size(agent.permissions)",
            "size(target.name)",
            *of["integer"],
            *of["integer"],
        ]
        self.strings = ["target.name", "target.kind", "place.kind", "place.name", "place.corridor", "world.holding",
                        "agent.name", "metadata.intent", "mode", *of["string"], *tool]  # fmt: skip

    def one(self, options):
        return options[self.random.randrange(len(options))]

    def double(self, depth: int) -> str:
        match self.random.randrange(9 if depth > 0 else 5):
            case 0 | 1 | 2:
                return self.one(self.doubles)
            case 3 | 4:
                return self.one(NUMBERS)
            case 5:
                return f"double({self.int(depth - 1)})"
            case 6:
                return f"({self.bool(depth - 1)} ? {self.double(depth - 1)} : {self.double(depth - 1)})"
            case _:
                return f"({self.double(depth - 1)} {self.one('+-**/')} {self.double(depth - 1)})"

    def int(self, depth: int) -> str:
        match self.random.randrange(9 if depth > 0 else 5):
            case 0 | 1 | 2:
                return self.one(self.ints)
            case 3 | 4:
                return self.one(INTEGERS)
            case 5:
                return f"int({self.double(depth - 1)})"
            case 6:
                return f"[{self.int(0)}, {self.int(0)}][{self.int(depth - 1)}]"
            case _:
                return f"({self.int(depth - 1)} {self.one('+-*/%')} {self.int(depth - 1)})"

    def string(self) -> str:
        return self.one(self.strings) if self.random.random() < 0.8 else self.one(WORDS)

    def bool(self, depth: int) -> str:  # noqa: C901  # the grammar, one case a line
        if depth <= 0:
            return self.one(self.bools)
        below = depth - 1
        match self.random.randrange(14):
            case 0 | 1:
                return f"({self.bool(below)} {self.one(['&&', '||'])} {self.bool(below)})"
            case 2:
                return f"!{self.bool(below)}"
            case 3 | 4 | 5:
                return f"({self.double(below)} {self.one(['<', '<=', '>', '>=', '==', '!='])} {self.double(below)})"
            case 6 | 7:
                return f"({self.int(below)} {self.one(['<', '<=', '>', '>=', '==', '!='])} {self.int(below)})"
            case 8:
                return f"({self.string()} {self.one(['==', '!=', '<', '>='])} {self.string()})"
            case 9:
                return f"{self.string()}.{self.one(['startsWith', 'endsWith', 'contains'])}({self.one(WORDS)})"
            case 10:
                return f"({self.string()} in [{self.one(WORDS)}, {self.string()}])"
            case 11:
                quantified = self.one(["agent.permissions", f"[{self.string()}, {self.one(WORDS)}]"])
                return f"{quantified}.{self.one(['exists', 'all'])}(p, p == {self.one(WORDS)} || {self.bool(0)})"
            case 12:
                return f"({self.bool(below)} ? {self.bool(below)} : {self.bool(below)})"
            case _:
                return self.one(self.bools)

    def fitting(self, draw, kind) -> str:
        """Draw until one type-checks: units and texts that can never be are refused."""
        while True:
            source = draw()
            try:
                vocabulary().typed(source, self.capability.name, kind)
            except ExpressionError:
                continue
            return source

    def rule(self, number: int) -> Rule:
        effect = self.one([Effect.DENY, Effect.ESCALATE, Effect.MODIFY, Effect.MODIFY])
        when = (
            None if self.random.random() < 0.05 else self.fitting(lambda: self.bool(self.random.randrange(1, 4)), BOOL)
        )
        return Rule(
            id=f"{self.one(['organization', 'authority'])}/r{number}", applies_to=None, profiles=None, when=when, then=effect,
            settings=tuple(self.settings()) if effect is Effect.MODIFY else (),
            approvers=self.random.randrange(3) if effect is Effect.ESCALATE else 0, because="So.", remedy="",
        )  # fmt: skip

    def settings(self):
        declared = properties(self.capability)
        there = always_there(self.capability)
        bounded = [name for name, spec in declared.items() if spec["type"] == "number" and name in there]
        for name in self.random.sample(bounded, k=min(len(bounded), self.random.randrange(1, 3))):
            spec = declared[name]
            low, high = float(spec["minimum"]), float(spec["maximum"])
            bounds = sorted(
                round(low + (high - low) * self.random.choice([0.0, 0.1, 0.3, 0.5, 0.8, 1.0]), 3) for _ in range(2)
            )
            which = self.random.randrange(4)
            yield Setting(
                param=name, minimum=bounds[0] if which in (0, 3) else None, maximum=bounds[1] if which != 0 else None
            )
        named = [name for name, spec in declared.items() if spec["type"] == "string"]
        if named and self.random.random() < 0.3:
            name = self.one(named)
            spec = declared[name]
            known = spec.get("enum") or sorted(
                {"object": base().site.objects, "corridor": base().site.corridors, "target": base().site.targets,
                 "surface": base().site.surfaces, "tool": base().site.tools, "action": {"press": 0}}[spec["x-ref"]])  # fmt: skip
            word = f'"{self.one(known)}"'
            choices = [
                word,
                "place.corridor",
                f"({self.fitting(lambda: self.bool(1), BOOL)} ? {word} : place.name)",
                "metadata.intent",
            ]
            yield Setting(param=name, to=self.fitting(lambda: self.one(choices), STRING))


def compiled(capability: str, profile: str, rules: list[Rule]) -> PolicySet:
    """Return the base with nothing but these rules about one pair."""
    policy = base()
    gate = policy.gates[capability, profile]
    made = Generator(gate.capability, gate.profile, gate.site, vocabulary()).compile(rules)
    gates = {(capability, profile): replace(gate, check=made.check, source=made.source)}
    return replace(policy, gates=gates, rules={rule.id: rule for rule in rules})


def drawn(random: Random) -> tuple[str, str, list[Rule]]:
    """Draw a capability, a profile and a rule set."""
    capability, profile = CAPABILITIES[random.randrange(len(CAPABILITIES))], PROFILES[random.randrange(4)]
    drawing = Drawing(random, capability)
    return capability, profile, [drawing.rule(number) for number in range(random.randrange(1, 7))]


def proposed(random: Random, capability: str, profile: str) -> dict[str, object]:
    """Draw a case whose parameters fit their schema, by an agent that admission does not reject."""
    policy = base()
    while True:
        params = {name: found for name, spec in properties(policy.capabilities[capability]).items()
                  if random.random() < 0.75 and (found := _value(random, spec)) is not None}  # fmt: skip
        if not isinstance(policy.validate_params(capability, params), tuple) and _possible(params):
            return {"profile": profile, "capability": capability, "params": params, "metadata": _metadata(random),
                    "mode": random.choice(["normal", "careful"]), "context": _context(random, params, capability)}  # fmt: skip


def _possible(params) -> bool:
    return "tool" not in params or params["action"] in base().site.tools[params["tool"]].actions


def _value(random: Random, spec):
    match spec["type"]:
        case "boolean":
            return random.random() < 0.5
        case "integer":
            return random.choice([-3, -1, 0, 1, 2, 7, 9, *([] if "minimum" in spec else [2**62, -(2**63) + 1, 40])])
        case "number":
            low, high = float(spec["minimum"]), float(spec["maximum"])
            if high == 100:  # a coordinate
                low, high = -0.5, 8.5
            picked = [low, high, 0.1, 0.15, 0.25, 0.3, 0.5, 1.0, 2.5, 20.0, 40.0, 60.0, random.uniform(low, high)]
            return random.choice([value for value in picked if low <= value <= high])
    known = {"object": base().site.objects, "corridor": base().site.corridors, "target": base().site.targets, "area": base().site.areas,
             "surface": base().site.surfaces, "tool": base().site.tools, "action": ("press", "pull_down", "push_up")}  # fmt: skip
    return random.choice(sorted(spec["enum"] if "enum" in spec else known[spec["x-ref"]]))


def _metadata(random: Random) -> dict[str, object]:
    drawn_: dict[str, object] = {
        "confidence": random.choice([0.0, 0.1, 0.25, 0.5, 1.0, random.random()]),
        "intent": random.choice(["", "a", "by hand", "aisle", "dock", "mug_1", "soft", "é z"]),
        "priority": random.choice([0, 1, -1, 3, 100, 2**62, -(2**62) - 5]),
    }
    return {name: value for name, value in drawn_.items() if random.random() < 0.5}


def _context(random: Random, params, capability: str) -> dict[str, object]:
    context: dict[str, object] = {name: random.random() < 0.7 for name in
                                  ("arm_ready", "arm_retracted", "gripper_empty", "sensors_fresh", "operator_on_duty")}  # fmt: skip
    if random.random() < 0.5:
        context["holding"] = random.choice(sorted(base().site.objects))
    context["people_count"] = random.choice([0, 1, 2, 7])
    context["people_nearest_m"] = random.choice([0.0, 0.3, 0.5, 2.5, 99.0])
    if "object_id" in params and random.random() < 0.7:
        context["at"] = {params["object_id"]: [random.uniform(-0.5, 8.5), random.uniform(-0.5, 6.5)]}
    if random.random() < 0.4:
        needed = base().capabilities[capability].permissions
        context["agent"] = random.choice(["visitor", "dock", "a"])
        context["permissions"] = sorted({*needed, *random.sample(sorted(base().permissions), 2)})
    elif not base().capabilities[capability].permissions <= base().agents["planner"].permissions:
        raise AssertionError(capability)
    return context
