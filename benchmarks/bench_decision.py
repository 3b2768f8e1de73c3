"""Time of one decision (`admit` + `check` with reasons) at 10, 1,000 and 10,000 rules, of which about 8 apply.

Beside it, on equivalent rules: cedarpy (the policy set parsed once) and cel-python (programs compiled once). Run it as
`python benchmarks/bench_decision.py [--quick]`. Prints p50 and p99 in microseconds, and whether the target is met.
"""

from __future__ import annotations

import argparse
import gc
import json
from dataclasses import dataclass
from statistics import median
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any

import cedarpy
import celpy
from celpy.adapter import json_to_cel

from app.governance.admission import admit
from app.governance.bundle import load_files
from app.governance.guard import check
from app.governance.model import CellFacts, Context, ObjectFact, PolicyOutcome, Proposal, WorldFacts
from app.governance.policy_model import SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.policy import PolicySet

PROFILE = "floor"
APPLYING = 8
SIZES = (10, 1_000, 10_000)
TARGET_P50_US, TARGET_P99_US, TARGET_RATIO = 5.0, 15.0, 1.1

# The rules that apply to each skill; `cel` is what ours and cel-python evaluate, `cedar` the same as a Cedar `when`.
RULES = (
    ("hazardous", "deny", 'target.hazardous && !("hazmat" in agent.permissions)',
     'context.hazardous && !context.permissions.contains("hazmat")'),
    ("heavy", "deny", "target.mass_kg > limits.payload_kg", "context.mass_g > 3000"),
    ("nearly-heavy", "escalate", "target.mass_kg > 0.8 * limits.payload_kg && target.mass_kg <= limits.payload_kg",
     "context.mass_g > 2400 && context.mass_g <= 3000"),
    ("forbidden", "deny", "place.forbidden", "context.forbidden"),
    ("unsure", "escalate", "has(metadata.confidence) && metadata.confidence < 0.5",
     "context has confidence && context.confidence < 50"),
    ("fast-and-firm", "deny", "params.speed_mps > 1.0 && params.force_n > 100.0",
     "context.speed_mmps > 1000 && context.force_mn > 100000"),
    ("fragile", "modify", "target.fragile", "context.fragile"),
    ("crowd", "modify", "world.people_count > 2", "context.people > 2"),
)  # fmt: skip


def _skill(name: str) -> dict[str, Any]:
    return {
        "name": name, "version": "1.0.0", "summary": "One skill of many.",
        "inputs": {
            "type": "object", "additionalProperties": False, "required": ["object_id"],
            "properties": {
                "object_id": {"type": "string", "x-ref": "object"},
                "force_n": {"type": "number", "unit": "N", "minimum": 2, "maximum": 140, "default": 40},
                "speed_mps": {"type": "number", "unit": "m/s", "minimum": 0.02, "maximum": 2, "default": 0.3},
            },
        },
        "preconditions": ["sensors_fresh", "object_visible", "object_reachable", "gripper_empty", "arm_ready"],
        "postconditions": ["object_secured"], "permissions": ["manipulation"], "risk": "medium", "rollback": None,
        "env_profile": {PROFILE: "guarded"}, "timeout_s": 20,
    }  # fmt: skip


def _rule(skill: str, index: int) -> dict[str, Any]:
    name, then, when, _ = RULES[index % APPLYING]
    bounds = {"set": {"force_n": {"max": 20}, "speed_mps": {"max": 0.15}}} if then == "modify" else {}
    slug = f"{name}-{skill.replace('_', '-')}-{index}"
    return {"id": slug, "applies_to": [skill], "when": when, "then": then, "because": name, **bounds}


def _files(rules: int) -> dict[str, str]:
    """A policy directory with this many rules, eight to a skill; YAML is a superset of the JSON written here."""
    skills = [f"skill_{number}" for number in range(-(-rules // APPLYING))]
    limit = {"source": "benchmark"}
    profile = {
        "profile": PROFILE, "sensitivity": 0.9, "modes": ["normal"], "rollback": "optional", "retry_budget": 1,
        "limits": {
            "tcp_speed_mps": {"max": 0.25, **limit}, "base_speed_mps": {"max": 0.3, **limit},
            "grip_force_n": {"max": 60, **limit}, "contact_force_n": {"max": 100, **limit},
            "payload_kg": {"max": 3, **limit},
        },
        "rules": [_rule(skills[index // APPLYING], index) for index in range(rules)],
        "stale_after_ms": dict.fromkeys(SENSORS, 50),
        "watch": [{"id": "speed", "signal": "tcp_speed_mps", "above": 0.3, "response": {"enter": "stop"}}],
        "recovery": [{"on": "any", "do": ["terminate"]}],
        "authority": {"modes": ["review-only"]},
    }  # fmt: skip
    site = {
        "site": "bench", "bounds_m": [0, 0, 8, 6], "start": "home",
        "targets": {"home": {"x_m": 1, "y_m": 1, "yaw_rad": 0}},
        "surfaces": {"bench": {"x_m": 1, "y_m": 2, "z_m": 0.75, "half_x_m": 1, "half_y_m": 1, "yaw_rad": 0,
                               "target": "home"}},
        "areas": {}, "corridors": {}, "tools": {},
        "zones": {"press": {"kind": "forbidden", "polygon": [[4, 0], [6, 0], [6, 2], [4, 2]]}},
        "objects": {"mug_1": {"kind": "mug", "shape": "box", "size_m": [0.1, 0.1, 0.1], "mass_kg": 0.3,
                              "fragile": False, "hazardous": False, "surface": "bench", "x_m": 1, "y_m": 2}},
    }  # fmt: skip
    organization = {
        "organization": "bench", "agents": {"planner": {"permissions": ["manipulation"]}},
        "permissions": ["manipulation", "hazmat"], "rules": [],
    }  # fmt: skip
    authority = {"authority": "bench", "mid_execution": {"within_s": 60, "on_timeout": "terminate"}}
    documents = {
        "organization.yaml": organization, "authority.yaml": authority, "site.yaml": site,
        f"profiles/{PROFILE}.yaml": profile,
        **{f"capabilities/{skill}.yaml": _skill(skill) for skill in skills},
    }  # fmt: skip
    return {name: json.dumps(document) for name, document in documents.items()}


def _context(policy: PolicySet) -> Context:
    seen = ObjectFact(visible=True, reachable=True, x_m=1.0, y_m=2.0, z_m=0.8, stamp_s=0.0)
    facts = WorldFacts(
        stamp_s=0.0, arm_ready=True, arm_retracted=True, gripper_empty=True, holding=None, base=(1.0, 1.0, 0.0),
        objects={"mug_1": seen},
    )  # fmt: skip
    cell = CellFacts(id="bench", online=True, facts=facts)
    return Context(time_s=0.0, profile=PROFILE, agent=policy.agent("planner"), cell=cell)


@dataclass(frozen=True, slots=True)
class Timing:
    """Microseconds: the median over the repeats' own p50, and over their p99."""

    p50_us: float
    p99_us: float


class _Series:
    """Repeated timings of one piece of work."""

    def __init__(self, work: Callable[[], object]) -> None:
        self._work = work
        self._p50: list[float] = []
        self._p99: list[float] = []
        for _ in range(20):
            work()

    def repeat(self, calls: int) -> None:
        work, samples = self._work, []
        for _ in range(calls):
            start = perf_counter_ns()
            work()
            samples.append(perf_counter_ns() - start)
        samples.sort()
        self._p50.append(samples[calls // 2] / 1000)
        self._p99.append(samples[calls * 99 // 100] / 1000)

    def timing(self) -> Timing:
        return Timing(median(self._p50), median(self._p99))


def _ours(rules: int) -> tuple[dict[str, Callable[[], object]], float]:
    start = perf_counter_ns()
    policy = load_files(_files(rules))
    loaded_s = (perf_counter_ns() - start) / 1e9
    context = _context(policy)
    proposals = [
        Proposal(capability="skill_0", params=params)
        for params in (
            {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.2},
            {"object_id": "mug_1", "force_n": 80.0, "speed_mps": 0.5},
        )
    ]
    outcomes = [check(policy, proposal, context).outcome for proposal in proposals]
    assert outcomes == [PolicyOutcome.ALLOW, PolicyOutcome.MODIFY], outcomes

    def decide(proposal: Proposal) -> Callable[[], object]:
        return lambda: (admit(policy, proposal, context), check(policy, proposal, context))

    return {"reins, allow": decide(proposals[0]), "reins, modify": decide(proposals[1])}, loaded_s


def _cedar(rules: int) -> Callable[[], object]:
    """The same rules as `forbid`s on the same actions; Cedar has neither doubles nor modify, so grams and forbid."""
    texts = ["permit(principal, action, resource);"]
    for index in range(rules):
        texts.append(
            f'forbid(principal, action == Action::"skill_{index // APPLYING}", resource) '
            f"when {{ {RULES[index % APPLYING][3]} }};"
        )
    policies = cedarpy.PolicySet.from_str("\n".join(texts))
    request = {
        "principal": 'Agent::"planner"', "action": 'Action::"skill_0"', "resource": 'Object::"mug_1"',
        "context": {"hazardous": False, "fragile": False, "forbidden": False, "mass_g": 300, "people": 0,
                    "speed_mmps": 200, "force_mn": 40_000, "permissions": ["manipulation"]},
    }  # fmt: skip
    answer = cedarpy.is_authorized(request, policies, [])
    assert answer.allowed, answer.diagnostics.errors
    return lambda: cedarpy.is_authorized(request, policies, [])


def _cel(rules: int) -> Callable[[], object]:
    """cel-python has no index: the eight rules of the skill are looked up for it, or it would walk all of them."""
    environment = celpy.Environment()
    programs = [environment.program(environment.compile(rule[2])) for rule in RULES[: min(rules, APPLYING)]]
    facts: Mapping[str, Any] = {
        "target": {"hazardous": False, "fragile": False, "mass_kg": 0.3}, "agent": {"permissions": ["manipulation"]},
        "limits": {"payload_kg": 3.0}, "place": {"forbidden": False}, "metadata": {}, "world": {"people_count": 0},
        "params": {"speed_mps": 0.2, "force_n": 40.0},
    }  # fmt: skip
    activation = {name: json_to_cel(value) for name, value in facts.items()}
    return lambda: [program.evaluate(activation) for program in programs]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer calls and repeats")
    quick = parser.parse_args().quick
    calls, repeats = (5_000, 3) if quick else (20_000, 7)
    print(f"decision: admit + check with reasons, {APPLYING} rules apply; µs, medians of {repeats} repeats")
    print(
        f"{'rules':>7}  {'what':<22} {'p50':>10} {'p99':>10}   target p50 ≤ {TARGET_P50_US:g}, p99 ≤ {TARGET_P99_US:g}"
    )
    loaded = {rules: _ours(rules) for rules in SIZES}
    gc.collect()
    gc.freeze()
    ours = {(rules, name): _Series(work) for rules, (works, _) in loaded.items() for name, work in works.items()}
    for _ in range(repeats):  # the sizes take turns, so that a noisy second disturbs all of them alike
        for series in ours.values():
            series.repeat(calls)
    others = {
        (rules, name): _Series(make(rules))
        for rules in SIZES
        for name, make in (("cedarpy", _cedar), ("cel-python", _cel))
    }
    for series in others.values():
        for _ in range(3):
            series.repeat(50)
    for (rules, name), series in sorted({**ours, **others}.items()):
        timing = series.timing()
        met = timing.p50_us <= TARGET_P50_US and timing.p99_us <= TARGET_P99_US
        mark = "" if (rules, name) in others else "met" if met else "MISSED"
        print(f"{rules:>7}  {name:<22} {timing.p50_us:>10.2f} {timing.p99_us:>10.2f}   {mark}")
    for rules, (_, loaded_s) in loaded.items():
        print(f"{rules:>7}  check and compile all  {loaded_s:>10.2f} s")
    for name in loaded[SIZES[0]][0]:
        ratio = ours[SIZES[-1], name].timing().p50_us / ours[SIZES[0], name].timing().p50_us
        mark = "met" if ratio <= TARGET_RATIO else "MISSED"
        print(f"{name}: {SIZES[-1]:,} rules / {SIZES[0]} rules = {ratio:.2f}   target ≤ {TARGET_RATIO:g}: {mark}")


if __name__ == "__main__":
    main()
