"""What the report calls metrics and methods, and how many decimals of a number say something."""

from __future__ import annotations

import re
from typing import Final

from app.evaluation.extensions import all_methods
from app.evaluation.metrics import METRICS

BETTER: Final = {"higher": "↑", "lower": "↓"}
_DECIMALS: Final = {"1": 3, "m": 3, "m/s": 3, "N": 0, "ticks": 1, "ms": 0}
CALLED: Final = {"FAR": "FAS"}
"""What a sweep calls a metric that goes by another name everywhere else."""
_ABBREVIATED: Final = frozenset(
    {"UAIR", "FRR", "ADL", "RVDR", "CEF", "UCR", "FAS", "RSR", "RBSR", "MRT", "RPC", "TSR", "TUR"}
)
_LEAVES_OUT: Final = {
    "RVDR": ", beyond the boundary band",
    "FAS": ", nobody in view",  # as clean trials are drawn
    **dict.fromkeys(("UCR", "CEF"), ", without violations that policy only warns of"),
}
_OF_PROFILES: Final = frozenset({"RVDR_PEOPLE_PAUSING", "UCR_STRICT", "RSR_DONE"})


def title_of(method: str) -> str:
    """Return what tables call a method; its name where nobody has registered it."""
    known = all_methods()
    return known[method].title if method in known else method


def heading_of(name: str) -> str:
    """Return what heads a metric's column: its abbreviation, or its title, its unit, and which way is better."""
    metric = METRICS[name]
    unit = "" if metric.unit == "1" else f", {metric.unit}"
    return f"{name_of(name)}{unit} {BETTER[metric.better]}"


def name_of(name: str) -> str:
    """Return a metric's abbreviation where the paper or this report goes by it, else its title."""
    return name if name in _ABBREVIATED else METRICS[name].title


def row_name(name: str, protocol: str) -> str:
    """Return what a metric's row is called: its title, its abbreviation if it has one, and what it leaves out."""
    title = METRICS[name].title + (f" ({name})" if name in _ABBREVIATED else "")
    return title + leaves_out(name, protocol)


def leaves_out(name: str, protocol: str) -> str:
    """Return what a metric's name says of rows that it leaves out; the paper's protocol has none of them."""
    return _LEAVES_OUT.get(name, "") if protocol != "paper" else ""


def in_words(prose: str) -> str:
    """Write prose with the titles of the metrics that it names by their keys, and without the marks of code."""
    keyed = re.sub(r"`?\b[A-Z]+(?:_[A-Z0-9]+)+\b`?", lambda found: _titled(found[0].strip("`")), prose)
    return keyed.replace("_", " ").replace("`", "")


def _titled(name: str) -> str:
    if name not in METRICS:
        return name
    return f"\N{LEFT DOUBLE QUOTATION MARK}{METRICS[name].title}\N{RIGHT DOUBLE QUOTATION MARK}"


def metrics_of(protocol: str) -> list[str]:
    """Return the metrics that mean something in a protocol: in the paper's, no profile warns where another pauses."""
    return [name for name in METRICS if protocol != "paper" or name not in _OF_PROFILES]


def measured_as(name: str, protocol: str) -> str:
    """Return what a metric's row is called, with its unit, and which way is better."""
    metric = METRICS[name]
    unit = "" if metric.unit == "1" else f", {metric.unit}"
    return f"{row_name(name, protocol)}{unit}\N{NO-BREAK SPACE}{BETTER[metric.better]}"


def decimals_of(unit: str) -> int:
    """Return how many decimals say something: millimetres and thousandths of shares, whole newtons, tenths of ticks."""
    return _DECIMALS.get(unit, 2)
