"""The smaller tables of protocol `paper`: human override, sensitivity sweep, confusion matrix, latencies."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import fmean
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from app.clock import precise_ns
from app.evaluation.methods import ABLATIONS, REINS
from app.evaluation.metrics import Entry, Tally, entry, measure, percentile
from app.evaluation.model import Kind, Row
from app.evaluation.paper_generator import ALL, OVERRIDE_FIRST, RECOVERY_FIRST, SHARED, Trial, draw, recoverable
from app.evaluation.paper_rows import row
from app.evaluation.paper_runtime import Course
from app.governance.admission import admit
from app.governance.authority import need
from app.governance.guard import check
from app.governance.model import Command, Fix, Observation, Params, SensorStamps, SkillReport, Vec6
from app.governance.plans import watch_plan
from app.governance.watcher import compile_watch

if TYPE_CHECKING:
    from app.governance.policy import PolicySet

SWEPT: Final = ("RVDR", "RVDR_PEOPLE", "UCR", "RSR", "SRR")
STEPS: Final = tuple(step / 10 for step in range(11))
WITH, WITHOUT = "with override", "without override"

Timed: TypeAlias = Callable[[], object]


def sensitivity(policy: PolicySet, seeds: Sequence[int], trials: int) -> list[dict[str, Any]]:
    """Sweep s from 0 to 1 in every profile alike; one point per step, each with its metrics over the pooled task."""
    tallies = {s: Tally(SWEPT) for s in STEPS}
    numbers = (*range(trials), *range(RECOVERY_FIRST, RECOVERY_FIRST + recoverable(trials)))
    for seed in seeds:
        for s, tally in tallies.items():  # the points share the trials of a seed
            for number in numbers:
                tally.add(row(REINS, policy, seed, ALL, number, sensitivity=s))
    return [{"s": s, **tally.entries()} for s, tally in tallies.items()]


def human_override(policy: PolicySet, seeds: Sequence[int], trials: int) -> dict[str, dict[str, Entry]]:
    """Measure requests that need a human's approval, with and without the override interface.

    `BLOCK_RATE` is the share of unapproved requests that were not executed, `INCORRECT_ALLOW` the share that was, and
    `FALSE_BLOCK` the share of approved requests that were not executed.
    """
    found: dict[str, dict[str, Entry]] = {}
    for name, method in ((WITH, REINS), (WITHOUT, ABLATIONS["-human"])):
        numbers = range(OVERRIDE_FIRST, OVERRIDE_FIRST + trials)
        measured = measure([row(method, policy, seed, ALL, number) for seed in seeds for number in numbers])
        blocked = measured["UAIR"]
        found[name] = {"BLOCK_RATE": blocked, "INCORRECT_ALLOW": _rest(blocked), "FALSE_BLOCK": measured["FRR"]}
    return found


def _rest(rate: Entry) -> Entry:
    """Return the entry of what a proportion leaves."""
    per_seed = {seed: 1.0 - value for seed, value in rate["per_seed"].items()}
    interval = None if rate["low"] is None else (1.0 - rate["high"], 1.0 - rate["low"])
    return entry(per_seed, rate["n"], interval)


class Confusion:
    """Counts decisions: blocked and unauthorized is a true positive, blocked and authorized a false one."""

    def __init__(self) -> None:
        """Begin with no rows."""
        self._cells: Counter[str] = Counter()
        self._rejected: dict[str, Counter[str]] = defaultdict(Counter)

    def add(self, one: Row) -> None:
        """Count a row."""
        unauthorized, launched = one["kind"] == Kind.UNAUTHORIZED, bool(one["launched"])
        self._cells[_CELLS[unauthorized, launched]] += 1
        if not unauthorized and not launched:
            self._rejected[str(one["capability"])][str(one["profile"])] += 1

    def table(self) -> dict[str, Any]:
        """Return the four counts, and `false_rejections`: capability → profile → count, as the paper recommends."""
        rejected = {name: dict(profiles) for name, profiles in self._rejected.items()}
        return {**{cell: self._cells[cell] for cell in _CELLS.values()}, "false_rejections": rejected}


_CELLS: Final = {(True, False): "TP", (False, False): "FP", (True, True): "FN", (False, True): "TN"}


# Latency -------------------------------------------------------------------------------------------------------------


def latency(policy: PolicySet, seeds: Sequence[int], trials: int) -> dict[str, dict[str, Any]]:
    """Measure what each part of governance takes, µs: component → mean, std over seeds, p50, p99, n.

    Each call is timed on its own, the clock's own time (`clock`) not taken off. `total_pre_execution` times admission,
    guard and authority as one, `recovery` the choice of the first step.
    """
    samples: dict[str, dict[int, list[float]]] = {}
    for seed in seeds:
        for name, calls in _calls(policy, seed, trials):
            samples.setdefault(name, {})[seed] = [_us(call) for call in calls]
    return {name: _spread(by_seed) for name, by_seed in samples.items()}


def _spread(by_seed: dict[int, list[float]]) -> dict[str, Any]:
    together = [value for values in by_seed.values() for value in values]
    found = entry({str(seed): fmean(values) for seed, values in by_seed.items()}, len(together))
    return {**found, "p50": percentile(together, 0.5), "p99": percentile(together, 0.99)}


def _calls(policy: PolicySet, seed: int, trials: int) -> Iterator[tuple[str, list[Timed]]]:
    drawn = _drawn(policy, seed, trials)
    yield "clock", [partial(bool)] * trials
    yield "admission", [partial(admit, policy, trial.proposal, trial.context) for trial in drawn]
    yield "policy_guard", [partial(check, policy, trial.proposal, trial.context) for trial in drawn]
    yield "watcher_step", _watching(policy, trials)
    failing = [draw(policy, seed, ALL, RECOVERY_FIRST + place) for place in range(trials)]
    yield "recovery", [Course(policy, trial).next for trial in failing]
    yield "total_pre_execution", [partial(_decided, policy, trial) for trial in drawn]


def _decided(policy: PolicySet, trial: Trial) -> object:
    admission = admit(policy, trial.proposal, trial.context)
    verdict = check(policy, trial.proposal, trial.context)
    return need(policy, trial.proposal, admission, verdict, trial.context)


def _drawn(policy: PolicySet, seed: int, trials: int) -> list[Trial]:
    return [draw(policy, seed, ALL, number) for number in range(trials)]


def _us(call: Timed) -> float:
    began = precise_ns()
    call()
    return (precise_ns() - began) / 1000.0


def _watching(policy: PolicySet, ticks: int) -> list[Timed]:
    """Watch a drive in the strictest profile, quiet ticks one after the other."""
    params: Params = {"target": policy.site.start, "speed_mps": 0.2, "clearance_m": 0.3}
    watcher = compile_watch(watch_plan(policy, "navigate_to", SHARED, params))
    state = watcher.begin()
    report = SkillReport("drive", 0.5)
    command = Command(_six(0.0), _six(0.0), (0.2, 0.0, 0.0), 0.0)

    def step(observation: Observation) -> None:
        nonlocal state
        state, _ = watcher.watch(state, observation, report, command)

    return [partial(step, _quiet(policy, tick)) for tick in range(ticks)]


def _quiet(policy: PolicySet, tick: int) -> Observation:
    """Return an unremarkable tick of a robot that stands; the readings differ, as no two readings are the same."""
    now_s, noise = tick * 0.01, 1e-6 * (tick % 97)
    start = policy.site.targets[policy.site.start]
    base = (start.x_m, start.y_m, start.yaw_rad)
    return Observation(
        tick=tick,
        time_s=now_s,
        joint_rad=(noise, -1.0, 1.2, -0.3, 1.0, noise),
        joint_speed_radps=_six(noise),
        joint_torque_nm=_six(10.0 + noise),
        residual_nm=_six(0.5 + noise),
        tcp_m=(0.4, 0.0, 0.9),
        tcp_speed_mps=noise,
        jacobian=(0.1,) * 18,
        contact_force_n=2.0 + noise,
        peak_force_n=3.0,
        grip_width_m=0.05,
        grip_force_n=0.0,
        slip_m=0.0,
        pads_loaded=False,
        odometry=base,
        base_velocity=(noise, 0.0, 0.0),
        fix=Fix(now_s, *base),
        people=(),
        stamps_s=SensorStamps(*(now_s,) * 7),
    )


def _six(value: float) -> Vec6:
    return value, value, value, value, value, value
