"""Plots for the report: inline SVG in the page's own colours and fonts, so that they follow light and dark.

Each plot carries its text alternative: a sentence with the numbers that matter. Series differ in marker and dash as
well as in colour, and are named where they are drawn.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from app.evaluation.report_canvas import FIRST, GRID, GROUND, INK, MUTED, PAPER, SECOND, THIRD, Axes, Plot, canvas

ROW_IN: Final = 0.42
LABELS: Final = 42  # as many characters of the usual size stand side by side under the axes of a plot with row names
CROWDED: Final = 0.1  # so near to the axis the paper's label would lie on ours


class Bar(NamedTuple):
    """A measured proportion with its interval, next to the paper's; None where there is none."""

    name: str
    value: float
    low: float | None
    high: float | None
    paper: float | None


class Point(NamedTuple):
    """A point of a sensitivity sweep; `violations` and `clean` are over how many of each, None where nobody says."""

    sensitivity: float
    rvdr: float
    ucr: float
    rsr: float | None
    far: float | None
    violations: int | None = None
    clean: int | None = None


class Mark(NamedTuple):
    """A kind of result in a matrix: its sign, and its name."""

    sign: str
    name: str


def per_type(bars: Sequence[Bar], of: str = "") -> Plot:
    """Draw detection by type of violation, next to the paper's.

    Args:
        bars: The types.
        of: Which of the violations are counted, for the caption.
    """
    with canvas(0.9 + 1.25 * ROW_IN * len(bars)) as (axes, drawn):
        places = range(len(bars))
        axes.barh([place - 0.18 for place in places], [bar.value for bar in bars], 0.34, color=FIRST, label="Reins")
        published = [(place, bar.paper) for place, bar in enumerate(bars) if bar.paper is not None]
        axes.barh([place + 0.2 for place, _ in published], [value for _, value in published], 0.3, facecolor="none",
                  edgecolor=PAPER, hatch="////", linewidth=1.0, label="paper")  # fmt: skip
        for place, bar in enumerate(bars):
            if bar.low is not None and bar.high is not None:
                axes.plot([bar.low, bar.high], [place - 0.18] * 2, color=INK, linewidth=1.4, marker="|", markersize=6)
        axes.set_yticks(list(places), [bar.name for bar in bars])
        axes.invert_yaxis()
        axes.set_xlim(0, 1.02)
        axes.set_xlabel("detected share (RVDR); line: 95 % interval")
        axes.grid(visible=False, axis="y")
        axes.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=2)
    told = "; ".join(f"{bar.name} {bar.value:.3f}" + (f" ({bar.paper:.3f})" if bar.paper is not None else "")
                     for bar in bars)  # fmt: skip
    return Plot(
        drawn[0],
        f"Detected share by type, the paper's in brackets: {told}.",
        f"Detection by type of violation{of}; in brackets how many violations.",
    )


def frontier(ours: Sequence[Point], paper: Sequence[Point], shipped: Point | None = None, of: str = "") -> Plot:
    """Draw what is detected against what goes on, a point for each sensitivity.

    Args:
        ours: The sweep.
        paper: The paper's.
        shipped: What the shipped policy comes to, where the sweep is of another one.
        of: What the sweep is of, for the caption.
    """
    with canvas(3.4) as (axes, drawn):
        for points, colour, marker, dash, name in (
            (ours, FIRST, "o", "-", _swept(shipped)),
            (paper, PAPER, "s", "--", "paper"),
        ):
            mine = colour == FIRST
            axes.plot([p.ucr for p in points], [p.rvdr for p in points], dash, color=colour, marker=marker,
                      markersize=5 if mine else 8, markerfacecolor=colour if mine else "none", label=name)  # fmt: skip
            for point in (points[0], points[len(points) // 2], points[-1]) if points else ():
                if not mine and point.ucr < CROWDED:
                    continue
                beside = _beside(points, point) if mine else (-34, -3 if point is points[0] else -13)
                axes.annotate(f"s={point.sensitivity:g}", (point.ucr, point.rvdr), xytext=beside,
                              textcoords="offset points", fontsize=8.5, color=colour)  # fmt: skip
        _mark(axes, None if shipped is None else (shipped.ucr, shipped.rvdr))
        _unit(axes, "share that goes on unsafely (UCR)", "detected share (RVDR)")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    told = "; ".join(f"s {p.sensitivity:g}: detected {p.rvdr:.3f}, goes on {p.ucr:.3f}" for p in ours)
    if shipped is not None:
        told += f"; the shipped policy: detected {shipped.rvdr:.3f}, goes on {shipped.ucr:.3f}"
    return Plot(
        drawn[0],
        f"Detection against unsafe continuation. {told}.",
        f"Detection–continuation frontier: up and to the left is better.{_over(ours, shipped)}{of}",
    )


def sweep(ours: Sequence[Point], of: str = "") -> Plot:
    """Draw detection, continuation and, where it was measured, recovery over sensitivity."""
    recovers = all(p.rsr is not None for p in ours)
    with canvas(3.4) as (axes, drawn):
        at = [p.sensitivity for p in ours]
        for values, colour, marker, dash, name in (
            ([p.rvdr for p in ours], FIRST, "o", "-", "RVDR"),
            ([p.ucr for p in ours], SECOND, "s", "--", "UCR"),
            ([p.rsr for p in ours], THIRD, "^", ":", "RSR"),
        ):
            if None not in values:
                axes.plot(at, values, dash, color=colour, marker=marker, markersize=5, label=name)
        _unit(axes, "sensitivity s (no unit)", "share")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    first, last = ours[0], ours[-1]
    told = (f"From s {first.sensitivity:g} to {last.sensitivity:g}, RVDR goes from {first.rvdr:.3f} to {last.rvdr:.3f} "
            f"and UCR from {first.ucr:.3f} to {last.ucr:.3f}.")  # fmt: skip
    named = "Detection, unsafe continuation and recovery" if recovers else "Detection and unsafe continuation"
    return Plot(drawn[0], told, f"{named} over sensitivity.{_over(ours, None)}{of}")


def roc(points: Sequence[Point], shipped: Point | None = None, of: str = "") -> Plot:
    """Draw what is detected against false alarms, a point for each sensitivity."""
    shown = sorted((p.far, p.rvdr, p.sensitivity) for p in points if p.far is not None)
    with canvas(3.4) as (axes, drawn):
        axes.plot([0, 1], [0, 1], ":", color=MUTED, linewidth=1.0)
        axes.annotate("chance", (0.72, 0.66), color=MUTED, fontsize=8.5)
        axes.plot([far for far, _, _ in shown], [seen for _, seen, _ in shown], "-", color=FIRST, marker="o",
                  markersize=5, label=_swept(shipped))  # fmt: skip
        for far, seen, sensitivity in (shown[0], shown[-1]):
            axes.annotate(f"s={sensitivity:g}", (far, seen), xytext=(8, -11), textcoords="offset points", fontsize=8.5)
        if shipped is not None and shipped.far is not None:
            _mark(axes, (shipped.far, shipped.rvdr))
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
        _unit(axes, "share of clean sessions with an alarm (FAS)", "detected share (RVDR)")
    told = "; ".join(f"s {s:g}: detected {seen:.3f}, false alarms {far:.3f}" for far, seen, s in shown)
    if shipped is not None and shipped.far is not None:
        told += f"; the shipped policy: detected {shipped.rvdr:.3f}, false alarms {shipped.far:.3f}"
    return Plot(
        drawn[0],
        f"Detection against false alarms. {told}.",
        f"ROC: detection against false alarms.{_over(points, shipped)}{of}",
    )


def spread(groups: Mapping[str, Sequence[float]], unit: str, caption: str, of: str) -> Plot:
    """Draw how values are spread in each group: median, quartiles, 5th to 95th percentile, and the ends.

    Args:
        groups: Name → values.
        unit: What they are in.
        caption: What they are.
        of: What each of them is of, for the numbers in brackets.
    """
    names = [name for name, values in groups.items() if values]
    with canvas(0.75 + ROW_IN * len(names)) as (axes, drawn):
        for place, name in enumerate(names):
            low, first, middle, third, high = (_percentile(groups[name], share) for share in (5, 25, 50, 75, 95))
            axes.plot([low, high], [place, place], color=MUTED, linewidth=1.2)
            axes.barh(place, third - first, 0.5, left=first, color=FIRST, alpha=0.45, linewidth=0)
            axes.plot([middle, middle], [place - 0.3, place + 0.3], color=INK, linewidth=2.0)
            ends = [min(groups[name]), max(groups[name])]
            axes.plot(ends, [place, place], ".", color=MUTED, markersize=4)
        axes.set_yticks(range(len(names)), [f"{name} ({len(groups[name])})" for name in names])
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlabel(unit)
        axes.grid(visible=False, axis="y")
    told = "; ".join(
        f"{name} median {_percentile(groups[name], 50):.3g}, 95th percentile {_percentile(groups[name], 95):.3g}"
        for name in names
    )
    return Plot(
        drawn[0],
        f"{caption} In {unit}: {told}.",
        f"{caption} In brackets how many {of}. Bar: quartiles; upright: median; line: 5 to 95 %; dots: ends.",
    )


def against_floor(groups: Mapping[str, Sequence[tuple[float, float]]]) -> Plot:
    """Draw times to safe state and their floors in each group: medians, and 5th to 95th percentile."""
    names = list(groups)
    told: list[str] = []
    with canvas(1.0 + 1.25 * ROW_IN * len(names)) as (axes, drawn):
        for place, name in enumerate(names):
            for which, (colour, marker, at, label) in enumerate(
                ((FIRST, "o", place - 0.15, "time to safe state"), (PAPER, "|", place + 0.2, "floor"))
            ):
                values = [pair[which] for pair in groups[name]]
                low, middle, high = (_percentile(values, share) for share in (5, 50, 95))
                axes.plot([low, high], [at, at], "--" if which else "-", color=colour, linewidth=1.6)
                axes.plot([middle], [at], marker=marker, color=colour, markersize=9 if which else 6, linestyle="",
                          markeredgewidth=1.8, label=label if place == 0 else None)  # fmt: skip
                told.append(f"{name} {label} median {middle:.2f}, 95th percentile {high:.2f}")
        axes.set_yticks(range(len(names)), [f"{name} ({len(groups[name])})" for name in names])
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(left=0)
        axes.set_xlabel("s from onset; mark: median, line: 5 to 95 %")
        axes.grid(visible=False, axis="y")
        axes.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=2)
    return Plot(
        drawn[0],
        f"Time to safe state and floor, in s: {'; '.join(told)}.",
        "Time to safe state against the floor that physics leaves; in brackets how many violations.",
    )


def shares(cells: Mapping[str, Mapping[str, float]], caption: str) -> Plot:
    """Draw shares in rows and columns: a square is as full as its share, and says it; a gap is what nobody measured."""
    columns = list(dict.fromkeys(name for row in cells.values() for name in row))
    with canvas(1.0 + ROW_IN * len(cells)) as (axes, drawn):
        for place, row in enumerate(cells.values()):
            for name, share in row.items():
                at = columns.index(name)
                axes.barh(place, 0.9, 0.8, left=at - 0.45, color=GRID, linewidth=0)
                axes.barh(place, 0.9 * share, 0.8, left=at - 0.45, color=FIRST, alpha=0.45, linewidth=0)
                axes.text(at, place, f"{share:.2f}", ha="center", va="center", fontsize=8.5)
        axes.set_xticks(range(len(columns)), [_broken(name, LABELS // len(columns)) for name in columns])
        axes.set_yticks(range(len(cells)), list(cells))
        axes.set_xlim(-0.6, len(columns) - 0.4)
        axes.set_ylim(len(cells) - 0.5, -0.5)
        axes.grid(visible=False)
        axes.tick_params(length=0)
    told = "; ".join(f"{row}: " + ", ".join(f"{' '.join(name.split())} {share:.2f}" for name, share in found.items())
                     for row, found in cells.items())  # fmt: skip
    return Plot(drawn[0], f"{caption} {told}.", caption)


_FILLS: Final = ((GRID, 0.6, INK), (FIRST, 0.4, INK), (THIRD, 0.45, INK), (SECOND, 0.5, INK), (INK, 0.85, GROUND))
"""Colour, opacity and the colour of the sign, from the mildest kind to the most severe."""


def marks(cells: Mapping[str, Mapping[str, Sequence[Mark]]], kinds: Sequence[Mark], caption: str) -> Plot:
    """Draw kinds of results in rows and columns: every sign that applies, in the colour of the most severe.

    Args:
        cells: Row → column → its kinds, the mildest first.
        kinds: All, from the mildest to the most severe; at most as many as there are fills.
        caption: What they are.
    """
    columns = list(dict.fromkeys(name for row in cells.values() for name in row))
    with canvas(1.4 + ROW_IN * len(cells)) as (axes, drawn):
        for kind, (colour, alpha, _) in zip(kinds, _FILLS, strict=False):
            axes.barh([0], [0], color=colour, alpha=alpha, label=f"{kind.sign} {kind.name}", linewidth=0)
        for place, row in enumerate(cells.values()):
            for name, found in row.items():
                at, (colour, alpha, ink) = columns.index(name), _FILLS[kinds.index(found[-1])]
                axes.barh(place, 0.92, 0.84, left=at - 0.46, color=colour, alpha=alpha, linewidth=0)
                axes.text(at, place, " ".join(mark.sign for mark in found), ha="center", va="center", color=ink)
        axes.set_xticks(range(len(columns)), [name.replace("-", "-\n") for name in columns], fontsize=9)
        axes.set_yticks(range(len(cells)), [_broken(name, LABELS // 2) for name in cells], fontsize=9.5)
        axes.set_xlim(-0.5, len(columns) - 0.5)
        axes.set_ylim(len(cells) - 0.5, -0.5)
        axes.grid(visible=False)
        axes.tick_params(length=0)
        axes.legend(loc="lower center", bbox_to_anchor=(0.3, 1.0), ncols=3)
    told = "; ".join(f"{row}: " + ", ".join(f"{name} {' and '.join(mark.name for mark in found)}"
                                            for name, found in its.items()) for row, its in cells.items())  # fmt: skip
    return Plot(drawn[0], f"What became of each proposal. {told}.", caption)


def _broken(name: str, width: int) -> str:
    """Break a name between words into lines of a width, where it can be; breaks that it has already stay."""
    lines = (textwrap.wrap(line, width, break_long_words=False, break_on_hyphens=False) for line in name.split("\n"))
    return "\n".join(part for line in lines for part in line)


def _beside(points: Sequence[Point], point: Point) -> tuple[int, int]:
    """Return where a point's label stands, so that it meets neither the star, nor the paper's line, nor the edge."""
    if point is points[-1]:
        return 16, 3
    if point.ucr > 1 - CROWDED:
        return -6, 9
    return (8, -5) if point is points[0] else (8, 3)


def _over(points: Sequence[Point], shipped: Point | None) -> str:
    """Say over how many trials each point is; empty where nobody counted."""
    told = [_trials(point) for point in points]
    if not told or None in told:
        return ""
    each = str(told[0]) if len(set(told)) == 1 else f"{told[0]} (s={points[0].sensitivity:g}) and others"
    beside = "" if shipped is None or _trials(shipped) is None else f"; the shipped policy: {_trials(shipped)}"
    return f" Each point is over {each}{beside}."


def _trials(point: Point) -> str | None:
    if point.violations is None:
        return None
    return f"{point.violations} violations" + ("" if point.clean is None else f" and {point.clean} clean sessions")


def _swept(shipped: Point | None) -> str:
    return "Reins" if shipped is None else "Reins, study's policy"


def _mark(axes: Axes, at: tuple[float, float] | None) -> None:
    """Mark what the shipped policy comes to."""
    if at is not None:
        axes.plot(
            [at[0]],
            [at[1]],
            linestyle="",
            marker="*",
            markersize=16,
            markerfacecolor="none",
            markeredgecolor=SECOND,
            markeredgewidth=1.6,
            label="shipped policy",
            zorder=5,
            clip_on=False,
        )


def _unit(axes: Axes, across: str, up: str) -> None:
    axes.set_xlim(-0.03, 1.05)
    axes.set_ylim(-0.07, 1.07)
    axes.set_xlabel(across)
    axes.set_ylabel(up)


def _percentile(values: Sequence[float], percent: float) -> float:
    ordered = sorted(values)
    place = percent / 100 * (len(ordered) - 1)
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])
