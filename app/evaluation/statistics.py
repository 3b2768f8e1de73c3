"""Whether two methods differ, and by how much: paired t-test, Wilcoxon's signed-rank test, Cohen's d (paper, Results).

Pairs are seeds: both methods ran the same trials of a seed. With few seeds a test has little to say (five seeds that
all agree give Wilcoxon 1/32 at best), and where every seed gives the same number there is no spread to divide by.
Then t and d do not exist; they are None, and `note` says so in words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import sqrt
from statistics import fmean, variance
from typing import Any, Final, NamedTuple, cast

import numpy as np

_NO_SPREAD: Final = 1e-12


class Comparison(NamedTuple):
    """How far `a` lies above `b`.

    Attributes:
        difference: Mean of a − b.
        t: Paired t statistic; None without spread in the differences.
        t_p: Its two-sided p-value.
        wilcoxon_p: One-sided p-value of the signed-rank test (a > b), by exact enumeration of signs up to 13 pairs.
        d: Cohen's d, difference over the pooled standard deviation of the two samples (the paper's); None without any.
        note: What is missing and why; empty where nothing is.
    """

    difference: float
    t: float | None
    t_p: float | None
    wilcoxon_p: float | None
    d: float | None
    note: str


def compare(a: Sequence[float], b: Sequence[float]) -> Comparison:
    """Compare two samples of equal length, paired by position.

    Raises:
        ValueError: The samples differ in length, or hold fewer than two pairs.
    """
    if len(a) != len(b) or len(a) < 2:
        raise ValueError(f"samples of `{len(a)}` and `{len(b)}`; valid: two samples of equal length, at least 2")
    differences = [one - other for one, other in zip(a, b, strict=True)]
    mean = fmean(differences)
    pooled = sqrt((variance(a) + variance(b)) / 2)
    notes: list[str] = []
    t, t_p = _paired_t(differences)
    if t is None:
        notes.append("every seed differs by the same amount: no t")
    d = mean / pooled if pooled > _NO_SPREAD else None
    if d is None:
        same = abs(mean) <= _NO_SPREAD
        notes.append("neither method varies and both agree: no d" if same else "neither method varies: d is infinite")
    return Comparison(mean, t, t_p, _wilcoxon(differences), d, "; ".join(notes))


def _paired_t(differences: Sequence[float]) -> tuple[float | None, float | None]:
    if sqrt(variance(differences)) <= _NO_SPREAD:
        return None, None
    found = _tests().ttest_1samp(differences, 0.0)
    return float(found.statistic), float(found.pvalue)


def _wilcoxon(differences: Sequence[float]) -> float | None:
    """Return the one-sided p-value; None where no pair differs, since the test is about those that do."""
    if all(abs(one) <= _NO_SPREAD for one in differences):
        return None
    tests = _tests()
    rounded = np.round(differences, 12)  # equal differences are ties, whatever their last bit
    ways = tests.PermutationMethod(rng=np.random.default_rng(0))  # exact while there are no more ways than that
    return float(tests.wilcoxon(rounded, alternative="greater", method=ways).pvalue)


def _tests() -> Any:  # noqa: ANN401  # scipy has no types
    """Import what takes half a second when it is needed: whoever only makes rows compares nothing."""
    from scipy import stats  # pyright: ignore[reportMissingTypeStubs]

    return cast("Any", stats)


COMPARED: Final[Mapping[str, float]] = {"RVDR": 1.0, "UCR": -1.0, "RSR": 1.0, "RPC": 1.0}
"""The metrics that the paper tests, each with the sign that makes more of it better; it has no effect size of RPC."""


def effect_sizes(
    methods: Mapping[str, Mapping[str, Any]], reference: str = "reins"
) -> dict[str, dict[str, dict[str, Any]]]:
    """Compare a method with every other one: baseline → metric → comparison.

    Differences are signed so that positive means that the reference is better. Seeds that only one of the two has are
    left out; with fewer than two in common there is no comparison, and the baseline has no such metric.

    Args:
        methods: Method → metric → entry (`metrics.measure`).
        reference: The method that is compared; without it nothing is.
    """
    if reference not in methods:
        return {}
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for name, baseline in methods.items():
        if name != reference:
            found[name] = _compared(methods[reference], baseline)
    return found


def _compared(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for metric, sign in COMPARED.items():
        ours, others = mine[metric]["per_seed"], theirs[metric]["per_seed"]
        seeds = [seed for seed in ours if seed in others]
        if len(seeds) > 1:
            a, b = ([sign * values[seed] for seed in seeds] for values in (ours, others))
            found[metric] = compare(a, b)._asdict()
    return found
