"""The report's part on goals: what Reins must reach in the workcell, what it reached, and how much that rests on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from app.evaluation.counted import BODY_M, HULL_M
from app.evaluation.goals import TARGETS, WORST, Target, judge
from app.evaluation.metrics import METRICS
from app.evaluation.report_tables import (
    DASH,
    Grid,
    Results,
    at_least,
    entry_text,
    mapping,
    mean_of,
    number_text,
    title_of,
)
from app.sim.proportion import wilson

_EXTREMES: Final = {
    "zone_depth_p95_m": "zone entry depth, p95 (m)",
    "separation_least_m": "least separation, to the middle of a person (m)",
    "separation_body_m": "to a body of 0.25 m radius (m)",
    "speed_there_mps": "speed there (m/s)",
    "peak_force_n": "peak contact force (N)",
}


_POOLED: Final = {"ZONE_DEPTH_P95": "zone_depth_p95_m", "SEPARATION_MIN": "separation_least_m"}
"""A worst case is not averaged: one seed's contact is no better for another seed's distance."""


def goal_grids(results: Results) -> Iterator[Grid]:
    """Show the goals of protocol `physical`, and the worst that every method came to; nothing for another protocol."""
    ours = mapping(results.get("methods", {}).get("reins"))
    if results["protocol"] != "physical" or not ours:
        return
    rows = [*(_row(target, ours, results) for target in TARGETS), *sensor_rows(results)]
    yield Grid("goals-table", "Goals", "Goal", (), ("ours", "rows", "asked", ""), tuple(rows), _REMARK)
    extremes: Mapping[str, Mapping[str, Any]] = results.get("extremes", {})
    worst = tuple(
        (title_of(name), tuple(_extreme(key, found) for key in _EXTREMES))
        for name, found in extremes.items()
        if any(found.get(key) is not None for key in _EXTREMES)
    )
    if worst:
        yield Grid(
            "extremes",
            "The worst of all seeds, in truth",
            "Method",
            (),
            tuple(_EXTREMES.values()),
            worst,
            _EXTREMES_REMARK,
        )


_EXTREMES_REMARK: Final = (
    "Zones and people beyond the boundary band, people in the profiles that hold the robot for them. Depth is at most "
    f"the radius of the hull, {HULL_M:g} m, because it is counted until the middle of the robot is at the edge: who "
    "drives on is as deep as that, or deeper. A distance to the middle of a person below 0 is within the hull. The "
    "force is that of every trial, whatever was done to it, and mostly the first impact of a contact that nobody could "
    "foresee: it is over before anything can act on it, so governance hardly changes it. What governance ends is the "
    "pressing that follows."
)


_REMARK: Final = (
    "Compared is the mean over seeds; latencies, depth and separation are those of the rows of all seeds together: "
    "the 95th percentile of one seed's few rows would be their largest. Minimum separation is while the robot still "
    'moved, over every walker drawn, in the profiles that hold the robot for people. A latency "beyond the boundary '
    'band" is that of violations that exceed their limit by three sigma or more. ✓: met, and the interval over all '
    "rows excludes a miss. ≈: met by what was measured, but so few rows could have met it by chance. A goal of 1.000 "
    "or 0.000 is never proved by a share: its interval says how much is. Of what is no share, at least 59 rows are "
    "asked for. Rollbacks after a withdrawal, a failure and a violation have no numbers of their own; each is held to "
    "that for rollbacks. Separation is to the middle of a person: to a body of 0.25 m radius it is 0.25 m less. What "
    "asks for nothing (–) stands beside the goal before it, so that both are read: UCR leaves out what policy asks no "
    "more than a warning of, UCR STRICT counts every such violation as unsafe. Broken sensors are of the study of "
    "sensors, where it was run: of all seeds together and all sensors, those restrained within 5 ticks, counted from "
    "the break, or from when a sample that is too old, repeats or is wrong has come; that study's text says which."
)


PROMPT: Final = "Broken sensors: "
_EACH_WAY: Final = {
    "stale": "off (stale)",
    "stuck": "stuck",
    "delayed": "delayed by twice what may be",
    "noisy": "garbage (noisy), of the bigger size",
    "offset": "offset by the bigger size",
}


def sensor_rows(results: Results) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Show how many sensor faults were restrained within five ticks: by kind, then each impossible one by itself.

    What is asked for is all of them. Errors of the smaller size may be within what clearances cover, and are left to
    the study's own table; the bigger size is one that the sensor cannot have when it is sound.
    """
    tables = mapping(mapping(results.get("studies")).get("sensors")).get("tables", ())
    found: dict[str, list[tuple[str, Mapping[str, Any]]]] = {kind: [] for kind in _EACH_WAY}
    sizes: dict[tuple[str, str], tuple[float, Mapping[str, Any]]] = {}
    for name, cells in mapping(tables[0]["rows"] if tables else {}).items():
        sensor, _, fault = name.partition("/")
        kind, _, size = fault.partition(" ")
        if not size:
            found[kind].append((sensor, mapping(cells["prompt"])))
        elif (sensor, kind) not in sizes or float(size) > sizes[sensor, kind][0]:
            sizes[sensor, kind] = float(size), mapping(cells["prompt"])
    for (sensor, kind), (size, entry) in sizes.items():
        found[kind].append((f"{sensor} {size:g}", entry))
    for kind, ways in found.items():
        if ways:
            yield _prompt(_EACH_WAY[kind], ways)


def _prompt(kind: str, ways: Sequence[tuple[str, Mapping[str, Any]]]) -> tuple[str, tuple[str, ...]]:
    """Return the row of a kind of fault: how many of all, and which sensors miss."""
    counts = [(sensor, _yes(entry), int(entry.get("n", 0))) for sensor, entry in ways]
    yes, n = sum(one for _, one, _ in counts), sum(one for *_, one in counts)
    low, high = wilson(yes, n) if n else (None, None)
    value = yes / n if n else None
    judged = judge(_ALL_PROMPT, value, {"n": n, "low": low, "high": high})
    missing = ", ".join(f"{sensor} ({one} of {of})" for sensor, one, of in counts if one < of)
    text = DASH if value is None else f"{number_text(value)}\n{yes} of {n}"
    told = f"{judged}: {missing}" if missing else judged
    return f"{PROMPT}{kind}, restrained within 5 ticks", (text, str(n), "1.000", told)


_ALL_PROMPT: Final = Target("prompt", least=1.0)


def _yes(entry: Mapping[str, Any]) -> int:
    """Return how many rows of a share said yes."""
    n = int(entry.get("n", 0))
    mean = mean_of(entry)
    return 0 if mean is None else round(mean * n)


def _extreme(key: str, found: Mapping[str, Any]) -> str:
    """Write a worst case; a depth that has come to the radius of the hull can be any depth from there on."""
    value = found.get(key)
    if key == "separation_body_m" and (gap := mean_of(found.get("separation_least_m"))) is not None:
        return number_text(gap - BODY_M)
    return f"{at_least('ZONE_DEPTH_P95', value)}{_plain(value)}" if key == "zone_depth_p95_m" else _plain(value)


def _row(target: Target, ours: Mapping[str, Any], results: Results) -> tuple[str, tuple[str, ...]]:
    name, entry = target.metric, mapping(ours.get(target.metric))
    if target.metric == WORST:
        name, entry = _worst(mapping(mapping(results.get("per_type")).get("reins")))
    value, text = mean_of(entry), ""
    if name.startswith("DL_") and entry.get("pooled") is not None:
        value = float(entry["pooled"])
        text = number_text(value)
    if (key := _POOLED.get(name)) and (
        pooled := mean_of(mapping(mapping(results.get("extremes")).get("reins")).get(key))
    ) is not None:
        value, text = pooled, number_text(pooled)
    unit = METRICS[name].unit if name in METRICS else "1"
    title = METRICS[name].title + f" ({name.replace('_', ' ')})" if name in METRICS else name
    return title, (text or entry_text(entry, unit), str(entry.get("n", 0)), target.text, judge(target, value, entry))


def _worst(types: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Return the type that is detected least, of those that were measured; of equals the one that is known least."""
    measured = {name: entry for name, entry in types.items() if mean_of(entry) is not None}
    if not measured:
        return WORST, {}
    name = min(measured, key=lambda one: (measured[one]["mean"], mean_of(measured[one].get("low")) or 0.0))
    return f"{WORST} ({name})", measured[name]


def _plain(value: object) -> str:
    return number_text(value) if isinstance(value, (int, float)) else DASH
