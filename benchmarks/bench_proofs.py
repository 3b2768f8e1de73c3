"""Time of the proofs of `reins policy check`: the shipped policy, and 1,000 generated rules, spread out and on one pair.

Run it as `python benchmarks/bench_proofs.py [--rules N] [--fuzz N]`; prints seconds, what was found, and whether the
target is met. With `--fuzz N`, N random decisions are compared with the real code first.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from random import Random
from time import perf_counter, process_time

from app.governance import bundle
from app.proofs.findings import Weight
from app.proofs.prove import prove

POLICIES = Path(__file__).parents[1] / "policies"
SHIPPED_S, SPREAD_S, ONE_PAIR_S = 5.0, 20.0, 60.0
PROFILES = ("sim-relaxed", "test-audit", "real-restricted", "human-shared")
SEED = 77

# Conditions by capability; a number is drawn for each `{}`, so that rules differ and most of them matter somewhere.
CONDITIONS = {
    "grasp_object": ("params.force_n > {:.3f}", "target.mass_kg > {:.4f} && params.speed_mps > {:.3f}",
                     "target.fragile && params.force_n > {:.3f}", "has(metadata.confidence) && metadata.confidence < {:.4f}"),
    "navigate_to": ("params.speed_mps > {:.4f} && params.clearance_m < {:.4f}", "has(params.x_m) && params.x_m > {:.4f}",
                    "world.people_nearest_m < {:.4f} && params.speed_mps > {:.4f}", 'mode == "careful" && params.speed_mps > {:.4f}'),
    "inspect_area": ("params.dwell_s > {:.4f}", "world.people_nearest_m < {:.4f}", "params.dwell_s < {:.4f} && world.people_count > 2"),
    "operate_tool": ("params.force_n > {:.3f} && tool.press", "params.speed_mps > {:.4f}", "params.force_n * params.speed_mps > {:.3f}"),
    "transport_object": ("params.speed_mps > {:.4f} && target.mass_kg > {:.4f}", "params.clearance_m < {:.4f}",
                         "has(params.corridor) && params.speed_mps > {:.4f}"),
    "place_object": ("params.speed_mps > {:.4f}", "target.fragile && params.speed_mps > {:.4f}", "has(params.y_m) && params.y_m > {:.4f}"),
}  # fmt: skip
RANGES = {"force_n": (5.0, 130.0), "speed_mps": (0.06, 1.9), "clearance_m": (0.12, 0.9), "dwell_s": (0.3, 9.0), "mass_kg": (0.3, 3.4),
          "confidence": (0.01, 0.99), "x_m": (0.5, 7.5), "y_m": (0.5, 5.5), "people_nearest_m": (0.1, 5.0)}  # fmt: skip


def _rule(random: Random, number: int, capability: str, profile: str) -> str:
    source = random.choice(CONDITIONS[capability])
    for name in sorted((name for name in RANGES if name in source), key=source.find):
        at = source.find("{", source.find(name))
        if at >= 0:
            end = source.index("}", at) + 1
            source = source[:at] + source[at:end].format(random.uniform(*RANGES[name])) + source[end:]
    speed = capability != "inspect_area"
    then = random.choice(["deny", "escalate", "modify"] if speed else ["deny", "escalate"])
    bound = f", set: {{speed_mps: {{max: {random.uniform(0.1, 1.4):.3f}}}}}" if then == "modify" else ""
    return (
        f"  - {{id: made-{number}, applies_to: [{capability}], profiles: [{profile}], when: '{source}', "
        f"then: {then}{bound}, because: Made.}}\n"
    )


def generated(rules: int, *, one_pair: bool) -> dict[str, str]:
    """Return the shipped files with so many further rules of the organization."""
    random = Random(SEED)
    files = bundle.read_files(POLICIES)
    capabilities = sorted(CONDITIONS)
    made = "".join(
        _rule(random, number, "grasp_object" if one_pair else random.choice(capabilities),
              "human-shared" if one_pair else random.choice(PROFILES))
        for number in range(rules)
    )  # fmt: skip
    return {**files, "organization.yaml": files["organization.yaml"] + made}


def measure(name: str, files: dict[str, str], target_s: float) -> bool:
    policy = bundle.load_files(files)
    properties = bundle.read_properties(POLICIES)
    began, spent = perf_counter(), process_time()
    report = prove(policy, properties, now=process_time, all_s=10 * target_s)
    took, spent = perf_counter() - began, process_time() - spent
    weights = {weight: sum(found.weight is weight for found in report.findings) for weight in Weight}
    met = took <= target_s and not weights[Weight.BUG]
    print(
        f"{name:28} {len(policy.rules):6} rules {report.pairs:4} pairs {report.asked:6} questions {took:7.2f} s, {spent:6.2f} s of a core "
        f"(target {target_s:g} s: {'met' if met else 'MISSED'})   "
        + ", ".join(f"{count} {weight.value}" for weight, count in weights.items()),
        flush=True,
    )
    return met


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--rules", type=int, default=1000)
    options.add_argument("--fuzz", type=int, default=0)
    chosen = options.parse_args()
    if chosen.fuzz:
        from tests.proofs.differential import compare

        began = perf_counter()
        found = [compare(seed, 40, 25) for seed in range(9000, 9000 + -(-chosen.fuzz // 1000))]
        print(f"{sum(one for one, _ in found)} decisions as the real code's, {sum(two for _, two in found)} of them "
              f"without anything left open, in {perf_counter() - began:.0f} s", flush=True)  # fmt: skip
    met = [
        measure("shipped", bundle.read_files(POLICIES), SHIPPED_S),
        measure("spread", generated(chosen.rules, one_pair=False), SPREAD_S),
        measure("one pair", generated(chosen.rules, one_pair=True), ONE_PAIR_S),
    ]
    raise SystemExit(0 if all(met) else 1)


if __name__ == "__main__":
    main()
