"""Soak: every skill, many seeds, judged by the simulator's truth and not by the skill's word.

One seed is one world (object poses ±5 cm and ±0.2 rad, pad friction 0.7–1.0, masses ±10 %) and one chain of skills
through it. A skill's success is counted on the state that it found; a chain that breaks ends there and counts against
the skill that broke it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from math import hypot
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from app.interrupting import in_turn
from app.sim.proportion import wilson
from app.sim.robot import HOME_RAD
from app.sim.trial import Ran, run_skill
from app.sim.workcell import Workcell, make_workcell

if TYPE_CHECKING:
    from app.governance.model import Json, Site

PAYLOADS: Mapping[str, float] = {"mug_1": 60.0, "glass_1": 20.0, "driver_1": 60.0}
TCP_MPS, BASE_MPS = 0.25, 0.3
_BACK_M, _SEEN_M, _STAND_M, _PLACED_M = 0.02, 0.02, 0.04, 0.05
_LIFTED_M = 0.08


class Score(NamedTuple):
    """One skill in one world."""

    skill: str
    seed: int
    ok: bool
    why: str
    ran: Ran


class Tally(NamedTuple):
    """One skill over all worlds.

    Successes of runs, Wilson's 95 % interval, the worst truths, and what went wrong where.
    """

    skill: str
    runs: int
    succeeded: int
    low: float
    high: float
    tcp_speed_mps: float
    base_speed_mps: float
    contact_force_n: float
    failures: tuple[str, ...]


class Report(NamedTuple):
    """A soak's result."""

    seeds: int
    tallies: tuple[Tally, ...]

    @property
    def worst(self) -> float:
        """The lowest success rate of any skill."""
        return min(tally.succeeded / tally.runs for tally in self.tallies)

    def lines(self) -> list[str]:
        """Return the report as text, one skill per line."""
        head = f"{'skill':22}{'ok':>5}/{'runs':<6}{'95 % interval':>16}{'tcp m/s':>10}{'base m/s':>10}{'contact N':>11}"
        rows = [
            f"{t.skill:22}{t.succeeded:5}/{t.runs:<6}{100 * t.low:7.1f}–{100 * t.high:5.1f} %"
            f"{t.tcp_speed_mps:10.3f}{t.base_speed_mps:10.3f}{t.contact_force_n:11.1f}"
            for t in self.tallies
        ]
        return [head, *rows, *(f"  {t.skill}: {failure}" for t in self.tallies for failure in t.failures)]


def vary(cell: Workcell, seed: int) -> None:
    """Shift, turn, weigh and oil the world of a seed, and let the robot look again."""
    rng = np.random.default_rng((seed, 7))
    for name, thing in cell.site.objects.items():
        dx, dy, turn, weight = rng.uniform(-1, 1, 4)
        z = cell.site.surfaces[thing.surface].z_m + thing.size_m[2] + 0.0005
        # Side by side things stay apart: along the bench they move half as far.
        cell.plant.place_object(name, thing.x_m + 0.05 * dx, thing.y_m + 0.05 * dy, z, 0.2 * turn)
        cell.plant.scale_mass(name, 1.0 + 0.1 * weight)
    cell.plant.set_pad_friction(float(rng.uniform(0.7, 1.0)))
    for _ in range(30):
        cell.step(cell.hold())


class Chain:
    """The skills of one world, one after the other."""

    def __init__(self, site: Site, seed: int) -> None:
        """Build the world of a seed."""
        self.seed, self.name = seed, sorted(PAYLOADS)[seed % len(PAYLOADS)]
        self.cell = make_workcell(site, cell_id="soak", seed=seed)
        vary(self.cell, seed)
        self.scores: list[Score] = []

    def run(self) -> list[Score]:
        """Run the chain until it breaks or ends."""
        tool = ("lever", "pull_down") if self.seed % 2 else ("press", "press")
        grasp: dict[str, Json] = {
            "object_id": self.name,
            "force_n": PAYLOADS[self.name],
            "speed_mps": TCP_MPS if self.name != "glass_1" else 0.15,
        }
        drive: dict[str, Json] = {"speed_mps": BASE_MPS, "clearance_m": 0.3}
        home = self.cell.truth().objects[self.name]
        steps: Sequence[tuple[str, dict[str, Json], Callable[[], str]]] = (
            ("inspect_area", {"area": "bench_a_top", "dwell_s": 1.0}, self._localised),
            ("grasp_object", grasp, self._lifted),
            ("release_and_retract", {}, lambda: self._back(home)),
            ("grasp_object", grasp, self._lifted),
            ("retrace", {}, lambda: self._back(home)),
            ("grasp_object", grasp, self._lifted),
            ("regrasp", grasp, self._lifted),
            (
                "transport_object",
                {**drive, "target": "bench_b_stand", "corridor": "aisle"},
                lambda: self._stands("bench_b_stand") or self._lifted(),
            ),
            ("place_object", {"surface": "bench_b", "speed_mps": TCP_MPS}, lambda: self._placed("bench_b")),
            ("safe_retreat", {"distance_m": 0.3}, self._retreated),
            ("reposition_base", {}, lambda: self._stands("bench_b_stand")),
            ("navigate_to", {**drive, "speed_mps": 0.6, "target": "tool_stand"}, lambda: self._stands("tool_stand")),
            (
                "operate_tool",
                {"tool": tool[0], "action": tool[1], "force_n": 40.0, "speed_mps": TCP_MPS},
                lambda: self._operated(tool[0]),
            ),
        )
        for skill, params, judge in steps:
            ran = run_skill(self.cell, skill, params)
            why = judge() if ran.done else f"{ran.failure}: {ran.detail}"
            self.scores.append(Score(skill, self.seed, not why, why, ran))
            if why:
                break
        return self.scores

    def _localised(self) -> str:
        truth = self.cell.truth().objects
        for name in PAYLOADS:
            seen = self.cell.perception.memory.get(name)
            off = 9.9 if seen is None else hypot(seen.x_m - truth[name][0], seen.y_m - truth[name][1])
            if off > _SEEN_M:
                return f"`{name}` is remembered {off:.3f} m off"
        return ""

    def _lifted(self) -> str:
        truth = self.cell.truth()
        top = self.cell.site.objects[self.name].size_m[2] + self.cell.site.surfaces["bench_a"].z_m
        high = truth.objects[self.name][2] > top + _LIFTED_M
        return "" if truth.held == self.name and high else f"held `{truth.held}` at {truth.objects[self.name][2]:.3f} m"

    def _back(self, home: tuple[float, float, float]) -> str:
        truth = self.cell.truth()
        at = truth.objects[self.name]
        off = hypot(at[0] - home[0], at[1] - home[1], at[2] - home[2])
        drawn_in = float(np.abs(np.array(self.cell.observe().joint_rad) - HOME_RAD).max()) < 0.1  # radians
        return (
            ""
            if off < _BACK_M and truth.upright[self.name] and drawn_in and truth.held is None
            else f"{off:.3f} m from where it stood"
        )

    def _placed(self, name: str) -> str:
        truth, surface = self.cell.truth(), self.cell.site.surfaces[name]
        x, y, z = truth.objects[self.name]
        on = abs(z - surface.z_m - self.cell.site.objects[self.name].size_m[2]) < 0.005  # metres
        within = abs(x - surface.x_m) < surface.half_x_m and abs(y - surface.y_m) < surface.half_y_m
        return (
            ""
            if on and within and truth.upright[self.name] and truth.held is None
            else f"it is at ({x:.2f}, {y:.2f}, {z:.3f})"
        )

    def _stands(self, target: str) -> str:
        x, y, _ = self.cell.truth().base
        goal = self.cell.site.targets[target]
        off = hypot(x - goal.x_m, y - goal.y_m)
        return "" if off < _STAND_M else f"{off:.3f} m from `{target}`"

    def _retreated(self) -> str:
        back = self.cell.site.targets["bench_b_stand"].y_m - self.cell.truth().base[1]
        return "" if abs(back - 0.3) < _STAND_M else f"{back:.3f} m back"

    def _operated(self, tool: str) -> str:
        position = self.cell.truth().tools[tool]
        done = position < -0.3 if tool == "lever" else self.cell.tool_state(tool) == "pressed"  # radians
        return "" if done else f"`{tool}` is at {position:.3f}"


def trial(site: Site, seed: int) -> list[Score]:
    """Run one world; a plain function of its seed."""
    return Chain(site, seed).run()


def soak(
    site: Site, *, seeds: int, jobs: int = 1, first: int = 0, progress: Callable[[int, int], None] | None = None
) -> Report:
    """Run many worlds and count.

    Args:
        site: names and geometry.
        seeds: how many worlds.
        jobs: how many processes.
        first: the first seed.
        progress: told how many of how many worlds are done.
    """
    scores: list[Score] = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        results = in_turn(pool, trial, ((site, seed) for seed in range(first, first + seeds)))
        for done, result in enumerate(results, start=1):
            scores += result
            if progress:
                progress(done, seeds)
    return count(scores, seeds)


def count(scores: Sequence[Score], seeds: int) -> Report:
    """Tally scores by skill."""
    tallies: list[Tally] = []
    for skill in dict.fromkeys(score.skill for score in scores):
        mine = [score for score in scores if score.skill == skill]
        good = sum(score.ok for score in mine)
        tallies.append(
            Tally(
                skill,
                len(mine),
                good,
                *wilson(good, len(mine)),
                max(s.ran.tcp_speed_mps for s in mine),
                max(s.ran.base_speed_mps for s in mine),
                max(s.ran.contact_force_n for s in mine),
                tuple(f"seed {s.seed}: {s.why}" for s in mine if not s.ok),
            )
        )
    return Report(seeds, tuple(tallies))


def main(arguments: Sequence[str]) -> int:
    """Run `python -m app.sim.soak [--seeds N] [--jobs N] [--policies DIR]`; 0 if every skill reaches 99 %."""
    import argparse  # only here

    from app.governance.bundle import load  # only here: the soak itself takes a site

    parser = argparse.ArgumentParser(prog="app.sim.soak")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--policies", type=Path, default=Path("policies"))
    chosen = parser.parse_args(arguments)

    def progress(done: int, total: int) -> None:
        sys.stderr.write(f"\r{done}/{total}")

    report = soak(
        load(chosen.policies).site, seeds=chosen.seeds, jobs=chosen.jobs, first=chosen.first, progress=progress
    )
    sys.stdout.write("\n".join(["", *report.lines(), ""]))
    return 0 if report.worst >= 0.99 else 1  # the bar for nominal success


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
