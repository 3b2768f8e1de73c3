"""Every number of the paper's tables (Experiments, Results), as data, beside where ours stands in `results.json`.

Nothing is computed from these numbers but the difference to ours. Where the paper contradicts itself the table carries
a remark, and the number stays as it is printed.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from app.evaluation.methods import ABLATIONS, METHODS


class Figure(NamedTuple):
    """A published number; `std` is the standard deviation across seeds, None where the paper prints none."""

    mean: float
    std: float | None = None


class Column(NamedTuple):
    """A column of a table: key in `results.json`, heading, which way is better (`↑`, `↓` or empty), decimals.

    One that is not `alike` is of other rows than the paper's: there is no difference to take.
    """

    key: str
    heading: str
    better: str = ""
    decimals: int = 3
    alike: bool = True


class PublishedTable(NamedTuple):
    """One table of the paper.

    Attributes:
        label: Its LaTeX label.
        title: What it shows, in our words.
        stub: Heading of the row names.
        columns: Its columns.
        rows: Row key → (row name, one figure for each column; None where the paper prints a dash).
        places: Where our number stands in `results.json`, the first that is there; `{row}` and `{column}` are put in.
        remark: What a reader should know before comparing.
        called: What `results.json` calls a row or a column, where that is not its key.
    """

    label: str
    title: str
    stub: str
    columns: tuple[Column, ...]
    rows: Mapping[str, tuple[str, tuple[Figure | None, ...]]]
    places: tuple[tuple[str, ...], ...]
    remark: str = ""
    called: Mapping[str, str] = MappingProxyType({})


def _pairs(*numbers: float) -> tuple[Figure, ...]:
    """Read mean, std, mean, std, and so on."""
    return tuple(Figure(mean, std) for mean, std in zip(numbers[::2], numbers[1::2], strict=True))


def _means(*numbers: float) -> tuple[Figure, ...]:
    return tuple(Figure(number) for number in numbers)


def _method(name: str) -> str:
    return METHODS[name].title


_BASELINES: Final = ("direct", "static-rule", "capability-internal", "autort-style", "roboguard-style")
_NOTHING_SEEN: Final = (Figure(0.0, 0.0), None, Figure(1.0, 0.0))
_UAIR: Final = Column("UAIR", "UAIR", "↑")
_RVDR: Final = Column("RVDR", "RVDR", "↑")
_UCR: Final = Column("UCR", "UCR", "↓")
_RSR: Final = Column("RSR", "RSR", "↑")
_RPC: Final = Column("RPC", "RPC", "↑")

INTERCEPTION: Final = PublishedTable(
    label="tab:interception",
    title="Interception of unauthorized actions",
    stub="Method",
    columns=(_UAIR, Column("FRR", "FRR", "↓")),
    rows={
        "direct": (_method("direct"), _pairs(0.000, 0.000, 0.000, 0.000)),
        "static-rule": (_method("static-rule"), _pairs(0.595, 0.065, 0.000, 0.000)),
        "capability-internal": (_method("capability-internal"), _pairs(0.595, 0.065, 0.000, 0.000)),
        "autort-style": (_method("autort-style"), _pairs(0.962, 0.027, 0.000, 0.000)),
        "roboguard-style": (_method("roboguard-style"), _pairs(0.962, 0.027, 0.000, 0.000)),
        "reins": (_method("reins"), _pairs(0.962, 0.027, 0.000, 0.000)),
    },
    places=(("methods", "{row}", "{column}"),),
)

VIOLATION: Final = PublishedTable(
    label="tab:violation",
    title="Monitoring of runtime violations",
    stub="Method",
    columns=(_RVDR, Column("CEF", "CEF", "↑"), _UCR),
    rows={
        "direct": (_method("direct"), _NOTHING_SEEN),
        "static-rule": (_method("static-rule"), _NOTHING_SEEN),
        "capability-internal": (_method("capability-internal"), _pairs(0.351, 0.011, 0.600, 0.000, 0.649, 0.011)),
        "autort-style": (_method("autort-style"), _NOTHING_SEEN),
        "roboguard-style": (_method("roboguard-style"), _NOTHING_SEEN),
        "reins": (_method("reins"), _pairs(0.613, 0.020, 1.000, 0.000, 0.222, 0.031)),
    },
    places=(("methods", "{row}", "{column}"),),
    remark="Of its framework's violations the paper detects .613 and lets .222 go on; what became of the "
    "remaining .165 it does not say. Here every trial falls into one class.",
)

RECOVERY: Final = PublishedTable(
    label="tab:recovery",
    title="Recovery and rollback",
    stub="Method",
    columns=(_RSR, Column("RBSR", "RBSR", "↑", alike=False), Column("MRT", "MRT (s)", "↓"), _RPC),
    rows={
        "direct": (_method("direct"), _pairs(0.334, 0.038, 0.000, 0.000, 1.28, 0.030, 0.000, 0.000)),
        "static-rule": (_method("static-rule"), _pairs(0.460, 0.029, 0.000, 0.000, 0.897, 0.033, 0.000, 0.000)),
        "capability-internal": (
            _method("capability-internal"),
            _pairs(0.580, 0.034, 0.411, 0.028, 0.597, 0.009, 0.538, 0.014),
        ),
        "autort-style": (_method("autort-style"), _pairs(0.320, 0.037, 0.000, 0.000, 1.11, 0.023, 0.000, 0.000)),
        "roboguard-style": (_method("roboguard-style"), _pairs(0.383, 0.040, 0.000, 0.000, 0.991, 0.022, 0.000, 0.000)),
        "reins": (_method("reins"), _pairs(0.907, 0.030, 0.533, 0.032, 0.169, 0.003, 1.00, 0.000)),
    },
    places=(("methods", "{row}", "{column}"),),
    remark="The paper's RBSR counts capabilities without a rollback as failures, and its recovery times are constants "
    "of its simulation. Our RBSR is over rollback-capable trials, so that there is no difference to show, and who "
    "never tried a rollback has none: a dash, where the paper has 0.",
)

PER_TYPE: Final = PublishedTable(
    label="tab:pertype",
    title="Detection by type of violation, the proposed framework",
    stub="Violation",
    columns=(_RVDR,),
    rows={
        "force": ("Force exceeded", _pairs(0.688, 0.045)),
        "speed": ("Speed exceeded", _pairs(0.735, 0.047)),
        "retry": ("Retries exceeded", _pairs(0.697, 0.052)),
        "postcondition": ("Postcondition failed", _pairs(0.758, 0.061)),
        "zone": ("Zone entered", _pairs(0.503, 0.041)),
        "people": ("People too close", _pairs(0.248, 0.040)),
    },
    places=(("per_type", "reins", "{row}"),),
)

EFFECT_SIZE: Final = PublishedTable(
    label="tab:effectsize",
    title="Effect sizes (Cohen's d), the proposed framework against each baseline",
    stub="Baseline",
    columns=tuple(Column(key, f"d ({key})", "", 1) for key in ("RVDR", "UCR", "RSR")),
    rows={
        "direct": (_method("direct"), _means(43.3, 33.6, 26.1)),
        "autort-style": (_method("autort-style"), _means(43.3, 33.6, 24.8)),
        "roboguard-style": (_method("roboguard-style"), _means(43.3, 33.6, 23.9)),
        "capability-internal": (_method("capability-internal"), _means(16.4, 29.1, 19.1)),
        "static-rule": (_method("static-rule"), _means(43.3, 33.6, 16.0)),
    },
    places=(("effect_sizes", "{row}", "{column}", "d"),),
    remark="d: the difference of means over the pooled standard deviation of both. The paper prints magnitudes; from "
    "the means and deviations of its other tables its d (RVDR) follows, but not the others: d (RSR) against direct "
    "execution would be 16.7. With five seeds the standard deviation is badly known, and d with it; where neither side "
    "varies there is nothing to divide by: a dash.",
)

CONFUSION_TRIALS: Final = 1000
CONFUSION: Final = PublishedTable(
    label="tab:confusion_summary",
    title="Confusion matrix of governance decisions, the proposed framework",
    stub="Decision",
    columns=(Column("unauthorized", "unauthorized", "", 0), Column("authorized", "authorized", "", 0)),
    rows={
        "blocked": ("Blocked", _means(490, 0)),
        "allowed": ("Allowed", _means(17, 493)),
    },
    places=(("confusion", "reins", "{row} {column}"),),
    called={
        "blocked unauthorized": "TP",
        "blocked authorized": "FP",
        "allowed unauthorized": "FN",
        "allowed authorized": "TN",
    },
    remark="Counts per 1,000 trials; ours hold the recoverable failures as well, which are authorized. 490 of 507 "
    "would be a UAIR of .966; the paper's table says .962.",
)

ABLATION: Final = PublishedTable(
    label="tab:ablation",
    title="Ablation: the proposed framework with one component left out",
    stub="Variant",
    columns=(_UAIR, _RVDR, _UCR, _RSR, _RPC),
    rows={
        "reins": ("Full", _pairs(0.972, 0.027, 0.585, 0.035, 0.241, 0.040, 0.930, 0.014, 1.00, 0.000)),
        "-admission": (
            ABLATIONS["-admission"].title,
            _pairs(0.509, 0.029, 0.584, 0.010, 0.242, 0.016, 0.912, 0.020, 1.00, 0.000),
        ),
        "-policy": (
            ABLATIONS["-policy"].title,
            _pairs(0.567, 0.046, 0.611, 0.030, 0.215, 0.037, 0.922, 0.014, 1.00, 0.000),
        ),
        "-watcher": (
            ABLATIONS["-watcher"].title,
            _pairs(0.972, 0.027, 0.000, 0.000, 1.00, 0.000, 0.899, 0.022, 1.00, 0.000),
        ),
        "-recovery": (
            ABLATIONS["-recovery"].title,
            _pairs(0.972, 0.027, 0.578, 0.021, 0.248, 0.039, 0.311, 0.025, 0.000, 0.000),
        ),
        "-human": (
            ABLATIONS["-human"].title,
            _pairs(0.793, 0.034, 0.605, 0.033, 0.221, 0.029, 0.916, 0.007, 1.00, 0.000),
        ),
    },
    places=(("ablations", "{row}", "{column}"), ("methods", "{row}", "{column}")),
    called={"reins": "full"},
    remark="The paper's full framework scores differently here than in its other tables, with the same seeds.",
)

HUMAN_OVERRIDE: Final = PublishedTable(
    label="tab:human_override",
    title="The human override interface: requests without their approval",
    stub="Condition",
    columns=(Column("block_rate", "Blocked", "↑"), Column("incorrect_allow", "Wrongly allowed", "↓")),
    rows={
        "with": ("With override", _pairs(1.000, 0.000, 0.000, 0.000)),
        "without": ("Without override", _pairs(0.000, 0.000, 1.00, 0.000)),
    },
    places=(("human_override", "{row}", "{column}"),),
    called={
        "with": "with override",
        "without": "without override",
        "block_rate": "BLOCK_RATE",
        "incorrect_allow": "INCORRECT_ALLOW",
    },
)

LATENCY: Final = PublishedTable(
    label="tab:latency",
    title="Latency of governance for each action (µs)",
    stub="Component",
    columns=(
        Column("mean", "mean", "↓", 2),
        Column("std", "std", "", 2),
        Column("p50", "p50", "↓", 2),
        Column("p99", "p99", "↓", 2),
    ),
    rows={
        "admission": ("Admission", _means(0.23, 0.01, 0.24, 0.35)),
        "guard": ("Policy guard", _means(0.29, 0.01, 0.28, 0.45)),
        "watcher": ("Watcher, each step", _means(0.26, 0.00, 0.26, 0.39)),
        "recovery": ("Recovery", _means(0.19, 0.00, 0.19, 0.33)),
        "total": ("Before execution, total", _means(0.47, 0.01, 0.51, 0.72)),
    },
    places=(("latency", "{row}", "{column}"),),
    called={"guard": "policy_guard", "watcher": "watcher_step", "total": "total_pre_execution"},
    remark="The paper times comparisons of a few fields; here real policy is evaluated, with reasons, and the watcher "
    "reads sensors. The machines differ as well.",
)

SENSITIVITY: Final = PublishedTable(
    label="tab:sensitivity",
    title="Sensitivity of the watcher: detection against unsafe continuation",
    stub="Sensitivity",
    columns=(_RVDR, _UCR, Column("RSR", "RSR")),
    rows={
        f"{s:.1f}": (f"{s:.1f}", _means(*figures))
        for s, figures in {
            0.0: (0.000, 0.796, 0.905),
            0.2: (0.165, 0.631, 0.905),
            0.4: (0.318, 0.478, 0.905),
            0.5: (0.396, 0.400, 0.905),
            0.6: (0.469, 0.327, 0.905),
            0.8: (0.778, 0.186, 0.920),
            1.0: (0.964, 0.000, 0.920),
        }.items()
    },
    places=(("sensitivity", "{row}", "{column}"),),
    remark="At sensitivity 0 nothing is detected, and yet the paper lets only .796 go on; it does not say what stopped "
    "the others.",
)

TABLES: Final = (
    INTERCEPTION,
    VIOLATION,
    RECOVERY,
    PER_TYPE,
    ABLATION,
    CONFUSION,
    EFFECT_SIZE,
    HUMAN_OVERRIDE,
    LATENCY,
    SENSITIVITY,
)

T_TESTS: Final[Mapping[str, float]] = {"RVDR": 32.75, "UCR": -27.48, "RSR": 12.96, "RPC": 76.47}
"""Paired t over five seeds, the proposed framework against RoboGuard-style; the paper says p < 0.001 for each."""

T_REMARK: Final = (
    "The t of RVDR and UCR do not follow from the means and deviations of its tables, in which RoboGuard-style does "
    "not vary: they would be 68.5 and −56.1; and where neither side varies, as with RPC, there is no t. Its "
    "Wilcoxon test is one-sided, like ours: 1/32 = .031 is the least that five seeds can give, as it says; two-sided "
    "it would be 1/16 = .063."
)
"""What a reader should know of the paper's tests."""

WILCOXON_P: Final = 0.031
"""The paper's Wilcoxon p for every baseline and metric: the least that five seeds can give, one-sided."""


def places_of(table: PublishedTable, row: str, column: str) -> list[tuple[str, ...]]:
    """Return where our number for a cell may stand in `results.json`, as keys from the outside in."""
    plain = [tuple(part.format(row=row, column=column) for part in place) for place in table.places]
    return [tuple(table.called.get(key, key) for key in place) for place in plain] + plain
