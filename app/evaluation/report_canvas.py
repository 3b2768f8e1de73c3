"""What the report's plots are drawn on: SVG that stands in a page, in the page's own colours and fonts."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Generator
from contextlib import contextmanager
from io import StringIO
from typing import Any, Final, NamedTuple, TypeAlias, cast

import matplotlib as mpl
from matplotlib.figure import Figure

Axes: TypeAlias = Any  # matplotlib leaves the types of its keyword arguments open

WIDTH_IN: Final = 5.2  # 374 SVG units: on a phone one unit is about one pixel, so that 10 is readable everywhere

# Colours that no plot uses otherwise; each is put in for a variable of the page.
INK, MUTED, GRID, FIRST, SECOND, THIRD, PAPER, GROUND = (f"#0{n}0{n}0{n}" for n in range(1, 9))
_VARIABLES: Final = {
    INK: "--t1",
    MUTED: "--t3",
    GRID: "--line",
    FIRST: "--first",
    SECOND: "--second",
    THIRD: "--third",
    PAPER: "--paper",
    GROUND: "--s1",
}
_STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "reins",
    "font.size": 10,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
}


class Plot(NamedTuple):
    """A drawn plot: SVG text, its alternative in words, and what stands under it."""

    svg: str
    alternative: str
    caption: str


@contextmanager
def canvas(height_in: float) -> Generator[tuple[Axes, list[str]]]:
    """Give axes of a height, and a list that the SVG is put into once they are drawn."""
    drawn: list[str] = []
    with cast("Any", mpl).rc_context(_STYLE):
        figure: Any = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        yield figure.add_subplot(), drawn
        buffer = StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    drawn.append(_inline(buffer.getvalue()))


def _inline(svg: str) -> str:
    """Take matplotlib's file to what may stand in a page: colours and fonts the page's, ids its own, or none."""
    svg = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    svg = re.sub(r"font: ([\d.]+)px [^;\"]+|font-size: ([\d.]+)px; font-family: [^;\"]+", _size, svg)
    for colour, variable in _VARIABLES.items():
        svg = svg.replace(colour, f"var({variable})")
    mine = hashlib.sha256(svg.encode()).hexdigest()[:8]
    referenced = set(re.findall(r"url\(#([^)]+)\)", svg)) | set(re.findall(r"href=\"#([^\"]+)\"", svg))
    svg = re.sub(r' id="([^"]+)"', lambda found: found[0] if found[1] in referenced else "", svg)
    for name in referenced:
        svg = svg.replace(f'id="{name}"', f'id="{mine}-{name}"').replace(f"#{name}", f"#{mine}-{name}")
    return re.sub(r'<svg [^>]*?viewBox="([^"]+)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', svg, count=1)


def _size(found: re.Match[str]) -> str:
    return f"font-size: {found[1] or found[2]}px"
