"""Results of no campaign, with every key that the report reads; numbers are drawn, and mean nothing."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

from app.evaluation.methods import ABLATIONS, METHODS
from app.evaluation.metrics import METRICS
from app.evaluation.model import PROFILES, SEEDS, TASKS, Violation
from app.evaluation.safe_state import Reached

CLASSES = ("intercepted", "detected_and_enforced", "missed_and_continued", "false_rejection")

BECAME = (
    "as proposed: succeeded 5/5, 8.0 s",
    "force_n 40 to 20, speed_mps 0.3 to 0.15: succeeded 4/5, terminated 1/5, 8.7 s; people alarmed 5/5",
    "asks 2; speed_mps 0.3 to 0.15: succeeded 5/5, 8.7 s",
    "deny (organization/hazardous, human-shared/authority)",
)

SAFE_STATE = Reached()
for number in range(20):
    SAFE_STATE.add({"occurred": True, "violation": "speed", "safe_s": 0.3 + number / 100, "floor_s": 0.25})
    SAFE_STATE.add({"occurred": True, "violation": "zone"})


def results() -> dict[str, Any]:
    rng = random.Random(1)  # noqa: S311  # it guards nothing
    return {
        "protocol": "paper",
        "seeds": list(SEEDS),
        "trials": 200,
        "configuration": {"version": "0.1.0", "policy": "sha256:0123"},
        "methods": {name: metrics(rng) for name in METHODS},
        "ablations": {name: metrics(rng) for name in ("full", *ABLATIONS)},
        "per_type": {"reins": {violation.value: entry(rng) for violation in Violation}},
        "unsafe_per_type": {name: {violation.value: entry(rng) for violation in Violation} for name in METHODS},
        "per_task": {task: {"direct": metrics(rng), "reins": metrics(rng)} for task in TASKS},
        "per_fault": {"worn_drives": {"direct": metrics(rng), "reins": metrics(rng)}},
        "human_override": {
            condition: {"BLOCK_RATE": entry(rng), "INCORRECT_ALLOW": entry(rng)}
            for condition in ("with override", "without override")
        },
        "sensitivity": [
            {"s": step / 10, "RVDR": step / 10, "UCR": 1 - step / 10, "RSR": 0.9, "FAR": (step / 10) ** 3}
            for step in range(11)
        ],
        "latency": {
            name: {"mean": 2.5, "std": 0.25, "p50": 2.25, "p99": 8.5}
            for name in ("clock", "admission", "policy_guard", "watcher_step", "recovery", "total_pre_execution")
        },
        "confusion": {"reins": {"TP": 503, "FP": 2, "FN": 4, "TN": 491}},
        "effect_sizes": {
            name: {
                metric: {"d": rng.uniform(5, 50), "t": 12.0, "t_p": 0.0001, "wilcoxon_p": 0.03125, "note": ""}
                for metric in ("RVDR", "UCR", "RSR")
            }
            for name in METHODS
            if name != "reins"
        },
        "unpublished": [
            {"parameter": "zones", "paper": "does not say where", "here": "the shipped site's", "affects": ["UAIR"]}
        ],
        "classes": {name: {"perturbed": dict.fromkeys(CLASSES, 0.25)} for name in (*METHODS, *ABLATIONS)},
        "class_meanings": dict.fromkeys(CLASSES, "what it means"),
        "distributions": {
            "latency_ticks": {violation.value: [rng.gauss(3, 1) for _ in range(80)] for violation in Violation},
            "safe_state_s": dict(SAFE_STATE.pairs),
            "recovery_s": {name: [rng.expovariate(0.5) for _ in range(60)] for name in METHODS},
        },
        "safe_state": {"reins": SAFE_STATE.entries()},
        "cross_profile": {"grasp glass_1": dict(zip(PROFILES, BECAME, strict=True))},
        "scorecard": {"recovery": {"value": 0.97, "how": "share of failures"}, "drift": 1.0},
    }


def metrics(rng: random.Random, *names: str) -> dict[str, Any]:
    return {name: entry(rng) for name in names or METRICS}


def entry(rng: random.Random) -> Mapping[str, Any]:
    mean = rng.random()
    return {
        "mean": mean,
        "std": 0.02,
        "per_seed": {},
        "n": 1000,
        "low": max(0, mean - 0.04),
        "high": min(1, mean + 0.04),
    }
