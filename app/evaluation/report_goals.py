"""The report's part on goals: what Reins must reach in the workcell, what it reached, and how much that rests on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from app.evaluation.counted import BODY_M, HULL_M
from app.evaluation.goals import TARGETS, WORST, Target, judge
from app.evaluation.metrics import METRICS
from app.evaluation.report_names import decimals_of, row_name, title_of
from app.evaluation.report_tables import DASH, Grid, Results, at_least, entry_text, mapping, mean_of, number_text
from app.evaluation.study_sensors import WITHIN
from app.sim.proportion import wilson

_EXTREMES: Final = {
    "zone_depth_p95_m": "zone entry depth, p95 (m)",
    "separation_least_m": "least separation, to the middle of a person (m)",
    "separation_body_m": "to a body of 0.25 m radius (m)",
    "speed_there_mps": "speed there (m/s)",
    "peak_force_n": "peak contact force (N)",
}


_EXTREME_UNITS: Final = {key: key.rpartition("_")[2].replace("mps", "m/s").replace("n", "N") for key in _EXTREMES}
_POOLED: Final = {"ZONE_DEPTH_P95": "zone_depth_p95_m", "SEPARATION_MIN": "separation_least_m"}
"""A worst case is not averaged: one seed's contact is no better for another seed's distance."""


def goal_grids(results: Results) -> Iterator[Grid]:
    """Show the goals of protocol `physical`, and the worst that every method came to; nothing for another protocol.

    A campaign of studies alone has the goals of sensors, if it has any.
    """
    ours = mapping(results.get("methods", {}).get("reins"))
    rows = [*(_row(target, ours, results) for target in TARGETS if ours), *sensor_rows(results)]
    if results["protocol"] != "physical" or not rows:
        return
    yield Grid("goals-table", "Goals", "Goal", (), ("ours", "rows", "asked", "judged"), tuple(rows), _REMARK)
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


ABOUT: Final = (
    "✓ met, and the interval over all rows excludes a miss. ≈ met by what was measured, but so few rows could have met "
    "it by chance; of what is no share, at least 59 rows are asked for. ✗ missed. A dash: not measured here, or "
    "nothing is asked for. Few rows prove little, whatever they say."
)
_REMARK: Final = (
    "Ours: shares and times are means over seeds ± their standard deviation, with the interval over all rows below; "
    "latencies, depth and separation are pooled, those of the rows of all seeds together, as the 95th percentile of "
    "one seed's few rows would be their largest. A goal of 1.000 or 0.000 is never proved by a share: its interval "
    "says how much is. Beyond the boundary band are violations that exceed their limit by three sigma or more; those "
    "within it have a row of their own, and are in RVDR neither of all types nor of the worst. Minimum separation "
    "is while the robot still moved, over every walker drawn, in the profiles that hold the robot for people, and to "
    "the middle of a person: 0.25 m are asked for to a body of 0.25 m radius. Where policy asks for no more than a "
    "warning, going on is what it wants: UCR and CEF leave such violations out, and the strict count, for which "
    "nothing is asked, takes each of them for unsafe. Rollback-capable is what by the exact state could still be "
    "undone; all rollbacks that were tried, and all failures that were not recovered, have rows of their own. "
    "Rollbacks after a withdrawal, a failure and a violation have no numbers of their own; each is held to that for "
    "rollbacks. Broken sensors are of the study of sensors, where it was run: of all seeds together and all sensors, "
    "those restrained within 5 ticks, counted from the break, or from when a sample that is too old, repeats or is "
    "wrong has come; that study's text says which. Garbage is judged at two sizes: of the biggest hardly a sample is "
    "one that a sound sensor could give, of the size below the first one may be, and then the next one tells."
)


PROMPT: Final = "Broken sensors: "
_EACH_WAY: Final = {
    "stale": "off (stale)",
    "stuck": "stuck",
    "delayed": "delayed by twice what may be",
    "noisy": "garbage (noisy), of the biggest size",
    "offset": "offset by the biggest size",
}
_BELOW: Final = "garbage (noisy), of the size below that"


def sensor_rows(results: Results) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Show how many sensor faults were restrained within five ticks: by kind, then each impossible one by itself.

    What is asked for is all of them, of all sizes but the smallest: that may be within what clearances cover, and is
    left to the study's own table.
    """
    found: dict[str, list[tuple[str, Mapping[str, Any]]]] = {name: [] for name in (*_EACH_WAY.values(), _BELOW)}
    for (sensor, kind), sizes in prompt_shares(results).items():
        for name, (size, entry) in zip((_EACH_WAY[kind], _BELOW), reversed(sizes[1:] or sizes), strict=False):
            found[name].append((f"{sensor} {size:g}" if size else sensor, entry))
    for name, ways in found.items():
        if ways:
            yield _prompt(name, ways)


def prompt_shares(results: Results) -> dict[tuple[str, str], list[tuple[float, Mapping[str, Any]]]]:
    """Return of every sensor and kind of fault its sizes, ascending, each with the share restrained in time.

    The size is 0 where a fault has none.
    """
    tables = mapping(mapping(results.get("studies")).get("sensors")).get("tables", ())
    found: dict[tuple[str, str], list[tuple[float, Mapping[str, Any]]]] = {}
    for name, cells in mapping(tables[0]["rows"] if tables else {}).items():
        sensor, _, fault = name.partition("/")
        kind, _, text = fault.partition(" ")
        found.setdefault((sensor, kind), []).append((float(text) if text else 0.0, mapping(cells[WITHIN])))
    return {way: sorted(sizes, key=lambda one: one[0]) for way, sizes in found.items()}


def _prompt(kind: str, ways: Sequence[tuple[str, Mapping[str, Any]]]) -> tuple[str, tuple[str, ...]]:
    """Return the row of a kind of fault: how many of all, and which sensors miss."""
    counts = [(sensor, yes_of(entry), int(entry.get("n", 0))) for sensor, entry in ways]
    yes, n = sum(one for _, one, _ in counts), sum(one for *_, one in counts)
    low, high = wilson(yes, n) if n else (None, None)
    value = yes / n if n else None
    judged = judge(_ALL_PROMPT, value, {"n": n, "low": low, "high": high})
    missing = ", ".join(f"{sensor} ({one} of {of})" for sensor, one, of in counts if one < of)
    text = DASH if value is None else f"{number_text(value)}\n{yes} of {n}"
    told = f"{judged}: {missing}" if missing else judged
    return f"{PROMPT}{kind}, restrained within 5 ticks", (text, str(n), "1.000", told)


_ALL_PROMPT: Final = Target("prompt", least=1.0)


def yes_of(entry: Mapping[str, Any]) -> int:
    """Return how many rows of a share said yes."""
    n = int(entry.get("n", 0))
    mean = mean_of(entry)
    return 0 if mean is None else round(mean * n)


def _extreme(key: str, found: Mapping[str, Any]) -> str:
    """Write a worst case; a depth that has come to the radius of the hull can be any depth from there on."""
    value = mean_of(found.get(key))
    if key == "separation_body_m" and (gap := mean_of(found.get("separation_least_m"))) is not None:
        value = gap - BODY_M
    if value is None:
        return DASH
    text = number_text(value, decimals_of(_EXTREME_UNITS[key]))
    return f"{at_least('ZONE_DEPTH_P95', value)}{text}" if key == "zone_depth_p95_m" else text


def _row(target: Target, ours: Mapping[str, Any], results: Results) -> tuple[str, tuple[str, ...]]:
    name, entry = target.metric, mapping(ours.get(target.metric))
    if target.metric == WORST:
        name, entry = _worst(mapping(mapping(results.get("per_type")).get("reins")))
    metric = METRICS.get(name)
    unit = metric.unit if metric else "1"
    value, text = mean_of(entry), entry_text(entry, unit)
    if (pooled := _pooled(name, entry, results)) is not None:
        value, text = pooled, number_text(pooled, decimals_of(unit))
    text += "" if unit == "1" or value is None else f" {unit}"
    if strict := _strict(name, ours):
        text += f"\n{strict}"
    asked = target.text + ("" if unit == "1" or not target.asks else f" {unit}")
    title = row_name(name, "physical") if metric else name
    return title, (text, str(entry.get("n", 0)), asked, judge(target, value, entry))


def _pooled(name: str, entry: Mapping[str, Any], results: Results) -> float | None:
    """Return the figure over the rows of all seeds together, of latencies and of worst cases alone."""
    if name.startswith("DL_") and entry.get("pooled") is not None:
        return float(entry["pooled"])
    key = _POOLED.get(name)
    return None if key is None else mean_of(mapping(mapping(results.get("extremes")).get("reins")).get(key))


def _strict(name: str, ours: Mapping[str, Any]) -> str:
    """Say what UCR would be with the violations that it leaves out."""
    strict = mapping(ours.get("UCR_STRICT"))
    if name != "UCR" or strict.get("mean") is None:
        return ""
    return f"with them as unsafe: {number_text(strict['mean'])}"


def _worst(types: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Return the type that is detected least, of those that were measured; of equals the one that is known least."""
    measured = {name: entry for name, entry in types.items() if mean_of(entry) is not None}
    if not measured:
        return WORST, {}
    name = min(measured, key=lambda one: (measured[one]["mean"], mean_of(measured[one].get("low")) or 0.0))
    return f"{WORST} ({name})", measured[name]
