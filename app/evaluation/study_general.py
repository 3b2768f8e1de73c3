"""What no threshold was set on: other sensor noise, other ways of walking, and faults of other kinds.

Thresholds were looked for with sensors as measured and with the faults of `draws`. Here the same trials meet sensors
that are better and worse; people come by ways that no trial uses; and the arm fades, a load shifts, or an object slips
in a phase in which nothing slipped before. Those faults provoke no violation of their own name, so what counts is
whether the ungoverned twin came to harm (a violation of any kind for more than 250 ms, or a task that was not done),
and whether governance then noticed, and kept from harm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from app.evaluation.circumstances import AS_REPORTED, NOMINAL, Circumstances, other_way
from app.evaluation.draws import MOVING, Drawn, of_type
from app.evaluation.methods import REINS
from app.evaluation.metrics import measure
from app.evaluation.model import PROFILES, Kind, Row, Violation
from app.evaluation.physical_rows import row
from app.evaluation.physical_trial import prepare, taken, twinned
from app.evaluation.physical_trial import run as run_trial
from app.evaluation.stage import Start
from app.evaluation.study_trials import (
    Part,
    Table,
    bench_of,
    executed,
    first_alert,
    govern,
    grouped,
    share,
    spread,
    study_row,
    table,
)
from app.sim.faults import Fault, Scenario
from app.sim.occasions import Trigger
from app.sim.sensors import AS_MEASURED, Quality

if TYPE_CHECKING:
    from numpy.random import Generator

    from app.evaluation.episode import Execution
    from app.evaluation.physical_trial import Bench, Trial
    from app.governance.model import Json
    from app.governance.policy import PolicySet

NAME: Final = "generalisation"
TITLE: Final = "What no threshold was set on"
ABOUT: Final = (
    "The trials of the comparison with other sensors (noise multiplies every error of every sensor; dropout is how "
    "often the tracker misses a person in a frame; faults half as big go half as far beyond their limit), people who "
    "come by other ways, and faults of other kinds."
)
CLEAN: Final = 30
PERTURBED: Final = 45
WALKS: Final = 30
FAULTS: Final = 25
QUALITIES: Final[Mapping[str, Quality]] = {
    "noise as measured": AS_MEASURED,
    "noise x 0.5": Quality(noise=0.5),
    "noise x 1.5": Quality(noise=1.5),
    "noise x 2": Quality(noise=2.0),
    "noise x 2, faults half as big": Quality(noise=2.0),
    "tracker dropout 20 %": Quality(dropout=0.2),
}
UNDER: Final[Mapping[str, Circumstances]] = {
    "noise x 2, faults half as big": Circumstances(noise=2.0, fault_size=0.5),
}
"""The conditions that change more than the sensors."""

ON_FOOT: Final = "other ways of walking"
SHOWN: Final = ("RVDR", "RVDR_BOUNDARY", "UCR", "FAS", "RBSR", "ZONE_DEPTH_P95")
HOLDS: Final = frozenset({"real-restricted", "human-shared"})


def parts(seeds: Sequence[int]) -> list[Part]:
    """Return the parts condition by condition, so that a process seldom changes its sensors."""
    found: list[Part] = []
    for name in QUALITIES:
        found += [Part(name, seed, 0, spread(CLEAN + PERTURBED, seeds)) for seed in seeds]
    found += [Part(ON_FOOT, seed, 0, spread(WALKS, seeds)) for seed in seeds]
    return found + [Part(name, seed, 0, spread(FAULTS, seeds)) for name in KINDS for seed in seeds]


def run(part: Part, policy: PolicySet) -> Iterator[Row]:
    """Run a part."""
    bench = bench_under(policy, part.condition)
    for number in range(part.first, part.first + part.count):
        if part.condition in QUALITIES:
            kind = Kind.CLEAN if number % 5 < 2 else Kind.PERTURBED
            yield _compared(bench, part, prepare(bench, part.seed, number, wanted=kind, whole=False))
        elif part.condition == ON_FOOT:
            yield _compared(bench, part, _walked(bench, part.seed, number))
        else:
            yield _harmed(bench, part, number)


def bench_under(policy: PolicySet, condition: str) -> Bench:
    """Return this process's bench for a condition; those of the same sensors share its worlds."""
    bench = bench_of(policy, QUALITIES.get(condition, AS_MEASURED))
    return replace(bench, under=UNDER.get(condition, AS_REPORTED))


def _compared(bench: Bench, part: Part, trial: Trial) -> Row:
    """Run a trial under Reins, as the comparison does."""
    ran = run_trial(bench, trial, [REINS])[REINS.name]
    made = {**study_row(NAME, part, trial.drawn.number, trial.drawn.profile), **row(bench.policy, trial, REINS, ran)}
    if ran.execution is not None:
        made["missing"] = executed(ran.execution)["missing"]
    return made


# -- people ------------------------------------------------------------------------------------------------------------


def _walked(bench: Bench, seed: int, number: int) -> Trial:
    """Draw a trial in which somebody comes by another way, until it leads too near."""
    return taken(bench, lambda turn: _other_way(bench.policy, seed, number, turn), whole=False)


def _other_way(policy: PolicySet, seed: int, number: int, turn: int) -> Drawn:
    """Draw somebody who crosses behind the robot, comes round in a curve, or comes, stops short and then goes on."""
    drawn = of_type(policy, seed, number, Violation.PEOPLE, turn=turn)
    rng = np.random.default_rng((seed, number, turn, 31))
    walk, pace = other_way(policy, drawn, rng)
    return replace(drawn, scenario=Scenario(people=(walk,)), size=pace, walk_mps=pace)


# -- other faults ------------------------------------------------------------------------------------------------------


def _grasp() -> tuple[str, dict[str, Json], Start]:
    return "grasp_object", {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.2}, Start()


def _carry() -> tuple[str, dict[str, Json], Start]:
    return "transport_object", {"target": "dock", "speed_mps": 0.25}, Start(holding="mug_1")


def _place() -> tuple[str, dict[str, Json], Start]:
    return "place_object", {"surface": "bench_a", "speed_mps": 0.2}, Start(holding="mug_1")


def _payload(rng: Generator) -> tuple[tuple[str, dict[str, Json], Start], str, dict[str, Json]]:
    work = (_carry, _place)[int(rng.integers(2))]()
    factor, offset = float(rng.uniform(8.0, 40.0)), float(rng.uniform(0.0, 0.03))
    return work, "payload_shift", {"object": "mug_1", "factor": factor, "offset_m": offset}


def _fade(rng: Generator) -> tuple[tuple[str, dict[str, Json], Start], str, dict[str, Json]]:
    work = (_grasp, _place, _carry)[int(rng.integers(3))]()
    return work, "fade", {"strength": float(rng.uniform(0.05, 0.4))}


def _slippery(rng: Generator) -> tuple[tuple[str, dict[str, Json], Start], str, dict[str, Json]]:
    work = (_grasp, _place)[int(rng.integers(2))]()
    return work, "slippery", {"object": "mug_1", "friction": float(rng.uniform(0.005, 0.1))}


KINDS: Final[Mapping[str, Callable[[Generator], tuple[tuple[str, dict[str, Json], Start], str, dict[str, Json]]]]] = {
    "a load shifts": _payload,
    "the arm fades": _fade,
    "slippery in another phase": _slippery,
}
_OTHER_PHASE: Final = {"grasp_object": "close", "place_object": "descend"}


def _harmed(bench: Bench, part: Part, number: int) -> Row:
    """Run one fault of another kind, ungoverned and governed."""
    rng = np.random.default_rng((part.seed, number, list(KINDS).index(part.condition), 37))
    (capability, params, start), kind, sizes = KINDS[part.condition](rng)
    profile = PROFILES[int(rng.integers(len(PROFILES)))]
    phase = _OTHER_PHASE.get(capability, MOVING[capability]) if kind == "slippery" else MOVING[capability]
    at = Trigger(capability=capability, phase=phase, after_s=float(rng.uniform(0.0, 1.0)))
    scenario = Scenario(faults=(Fault(kind=kind, at=at, sizes=sizes),))
    drawn = Drawn(seed=part.seed, number=number, kind=Kind.PERTURBED, capability=capability, profile=profile,
                  params=params, start=start, scenario=scenario)  # fmt: skip
    trial = twinned(bench, drawn)
    done = govern(bench, trial)
    alert = first_alert(done)
    if trial.twin is None:
        raise AssertionError("an allowed trial has a twin")
    return study_row(
        NAME, part, number, profile, capability=capability, kind=Kind.PERTURBED.value,
        size=float(str(next(value for value in sizes.values() if isinstance(value, float)))),
        occurred=_hurt(trial.twin, profile) or not trial.twin.achieved,
        detected=alert is not None or bool(done.failures) or _ended(done),
        told=None if alert is None else str(alert.body["rule"]),
        unsafe=_hurt(done, profile), **executed(done),
    )  # fmt: skip


def _ended(done: Execution) -> bool:
    """Say whether the session ended otherwise than well: then somebody was told."""
    return done.outcome is not None and done.outcome.value not in ("succeeded", "recovered")


def _hurt(done: Execution, profile: str) -> bool:
    counted = [one for one in Violation if one is not Violation.PEOPLE or profile in HOLDS]
    return any(done.truth.tracks[one].unsafe for one in counted)


def tables(rows: Sequence[Row], policy: PolicySet) -> list[Table]:
    """Return what changes with the sensors and the ways of people, and what other faults come to."""
    by = grouped(rows, "condition")
    compared = {name: mine for name, mine in by.items() if name not in KINDS}
    return [
        table(
            "Other sensors, other ways of walking",
            "Condition",
            {name: {**measure(mine, SHOWN), **_latency(mine)} for name, mine in compared.items()},
            f"RVDR and UCR as defined below; FAS: clean sessions with an alarm. {NOMINAL}.",
        ),
        table(
            "Faults of other kinds",
            "Fault",
            {name: _others(mine) for name, mine in by.items() if name in KINDS},
            "Harm: in the ungoverned twin, a violation for more than 250 ms or a task that was not done. Told of it: "
            "an alarm, or a session that ended otherwise than well. Harmless, and violated for over 250 ms: governed "
            "it came to what it would not have come to ungoverned.",
        ),
    ]


def _latency(rows: Sequence[Row]) -> dict[str, Any]:
    return {f"{name.lower()} ticks": measure(rows, [f"DL_TICKS_{name}"])[f"DL_TICKS_{name}"]["mean"]
            for name in ("MEDIAN", "P95")}  # fmt: skip


def _others(rows: Sequence[Row]) -> dict[str, Any]:
    harmful = [row for row in rows if row["occurred"]]
    harmless = [row for row in rows if not row["occurred"]]
    rules = dict.fromkeys(str(row["told"]) for row in rows if row["told"])
    return {
        "harm in the twin": share(row["occurred"] for row in rows),
        "of harm: told of it": share(row["detected"] for row in harmful),
        "of harm: done all the same": share(row["achieved"] for row in harmful),
        "of harm: violated for over 250 ms": share(row["unsafe"] for row in harmful),
        "harmless: told of it": share(row["detected"] for row in harmless),
        "harmless: violated for over 250 ms": share(row["unsafe"] for row in harmless),
        "told by": ", ".join(rules) or None,
    }
