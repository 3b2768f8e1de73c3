"""What a protocol is, and which there are.

A protocol is a module (or any object) with three functions. A campaign asks it for jobs, runs them in processes in any
order, and hands all rows back to it in the order of the jobs:

```
jobs(methods, tasks, seeds, trials, long) ─▶ [Job, …] ─run(job, policy)─▶ rows ─results(rows, policy)─▶ results.json
```
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final, Protocol, cast, runtime_checkable

from app.evaluation.extensions import ALL, FAULT, REGISTRY, UnknownName, all_tasks, find_fault, find_task

if TYPE_CHECKING:
    from app.evaluation.jobs import Job
    from app.evaluation.model import Row
    from app.governance.model import Json
    from app.governance.policy import PolicySet


@runtime_checkable
class EvaluationProtocol(Protocol):
    """How methods are put to the test. Everything it does follows from its arguments alone: no clock, no state.

    A module may declare `COLUMNS`, if its rows have more than those of `app.evaluation.rows`; and it may have studies,
    extra jobs beside those that compare methods: `STUDIES` (name → anything), `STUDY_COLUMNS`, and `study_jobs(names,
    seeds)`. Their rows come to `results` like any other. One that can run the faults of plugins says `FAULTS = True`;
    then `tasks` may hold `fault-NAME` as well. One that can be run in other circumstances says `CIRCUMSTANCES = True`
    and reads them in `Job.under`. One that has a long run says `LONG`, with anything true. `TRIALS` and
    `TASK_TRIALS` are how many trials it runs if nobody says.
    """

    def jobs(
        self, *, methods: Sequence[str], tasks: Sequence[str], seeds: Sequence[int], trials: int, long: bool
    ) -> Sequence[Job]:
        """Cut the campaign into jobs, in the canonical order; `tasks` is empty where all are meant."""
        ...

    def run(self, job: Job, policy: PolicySet) -> Iterable[Row]:
        """Run one job. A generator keeps memory flat; called in a process of its own, on one thread."""
        ...

    def results(self, rows: Iterable[Row], policy: PolicySet) -> dict[str, Json]:
        """Sum up all rows, in the order of the jobs; `rows` can be gone through several times.

        Returns:
            What `results.json` holds, without `protocol`, `seeds`, `trials` and `configuration`. The report reads these
            keys, and says in a sentence which are not there. An entry is what `metrics.Tally` gives.

            | key | holds |
            |---|---|
            | `methods`, `ablations` | name → metric → entry |
            | `per_type` | method → violation → entry of RVDR |
            | `unsafe_per_type` | method → violation → entry of UCR |
            | `per_task`, `per_fault` | task, or a plugin's fault → method → metric → entry |
            | `classes` | method → kind of trial → class → share |
            | `class_meanings` | class → what it means |
            | `confusion` | method → TP, FP, FN, TN |
            | `effect_sizes` | baseline → metric → `statistics.Comparison` as a dict |
            | `human_override` | `with override`, `without override` → BLOCK_RATE, INCORRECT_ALLOW → entry |
            | `latency` | component → mean, std, p50, p99, in µs |
            | `latencies` | method → decisions (µs) and detections (ticks) in percentiles |
            | `escalations` | method → what went wrong → humans asked midway: how often, how long, what came of it |
            | `rollbacks` | method → what went wrong → rollbacks tried, capable, verified |
            | `redraws` | what was to go wrong → trials, those drawn again, redraws in all, those that never took |
            | `common_recoveries` | method → trials that it and Reins both recovered, and the mean time of each |
            | `unended` | method → sessions that had not ended when the evaluation let go of them |
            | `sensitivity` | list of `{s, RVDR, UCR, RSR, FAR?}`, entries or numbers |
            | `sensitivity_shipped` | RVDR, UCR, FAR of the shipped policy, where the sweep is of another one |
            | `safe_state` | method → violation, or `all` → counts and percentiles, as `floor.Reached` has them |
            | `distributions` | `latency_ticks`: violation → numbers; `recovery_s`: method → numbers; |
            | | `safe_state_s`: violation → (time, floor) pairs |
            | `cross_profile` | proposal → profile → what became of it |
            | `scorecard` | dimension → `{value, unit?, better?, how}` |
            | `studies` | study → `{title, about, tables: [{caption, stub, rows: row → column → value or entry}], …}` |
            | `unpublished` | list of `{parameter, paper, here, affects}` |
        """
        ...


class HasStudies(Protocol):
    """A protocol with studies."""

    STUDIES: Mapping[str, object]

    def study_jobs(self, names: Sequence[str], seeds: Sequence[int]) -> Sequence[Job]:
        """Cut some studies into jobs, in the canonical order; their names tell them from the comparison's."""
        ...


PROTOCOLS: Final[Mapping[str, str]] = {
    "paper": "app.evaluation.paper_protocol",
    "physical": "app.evaluation.physical_protocol",
}
"""Name → module. Imported when asked for: the physical one brings the simulator along."""


def protocol_names() -> tuple[str, ...]:
    """Return the names of all protocols, those of plugins included."""
    return (*(name for name in PROTOCOLS if find_spec(PROTOCOLS[name])), *sorted(REGISTRY.protocols))


def find_protocol(name: str) -> EvaluationProtocol:
    """Return a protocol.

    Raises:
        UnknownName: there is none of that name.
    """
    if name in REGISTRY.protocols:
        return cast("EvaluationProtocol", REGISTRY.protocols[name])
    if name not in protocol_names():
        raise UnknownName("protocol", name, protocol_names())
    return cast("EvaluationProtocol", import_module(PROTOCOLS[name]))


def find_tasks(protocol: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of tasks, each once; `all` stands for every task type.

    Raises:
        UnknownName: there is no such task or fault, or the protocol runs no faults.
    """
    found: list[str] = []
    for name in names:
        if name == ALL:
            found += all_tasks()
        elif name.startswith(FAULT) and getattr(find_protocol(protocol), "FAULTS", False):
            find_fault(name)
            found.append(name)
        else:
            found.append(find_task(name).name)
    return tuple(dict.fromkeys(found))


def find_study(protocol: str, name: str) -> str:
    """Return the name of a study that a protocol has.

    Raises:
        UnknownName: it has none of that name.
    """
    names = study_names(protocol)
    if name not in names:
        raise UnknownName("study", name, names or ("none, with this protocol",))
    return name


def study_names(protocol: str) -> tuple[str, ...]:
    """Return the names of a protocol's studies; most have none."""
    return tuple(getattr(find_protocol(protocol), "STUDIES", ()))
