"""Tests and effect sizes, with and without any spread."""

from __future__ import annotations

import warnings
from math import sqrt

import pytest
from scipy import stats

from app.evaluation.metrics import entry
from app.evaluation.statistics import COMPARED, compare, effect_sizes

OURS = [0.61, 0.63, 0.60, 0.64, 0.59]
THEIRS = [0.35, 0.34, 0.36, 0.37, 0.33]


def test_agrees_with_the_textbook() -> None:
    found = compare(OURS, THEIRS)
    theirs = stats.ttest_rel(OURS, THEIRS)
    assert (found.t, found.t_p) == pytest.approx((theirs.statistic, theirs.pvalue))
    assert found.difference == pytest.approx(0.264)
    assert found.d == pytest.approx(0.264 / sqrt((0.00043 + 0.00025) / 2))
    assert found.note == ""


def test_five_seeds_that_agree_cannot_say_more_than_one_in_32() -> None:
    assert compare(OURS, THEIRS).wilcoxon_p == pytest.approx(1 / 32)
    assert compare(THEIRS, OURS).wilcoxon_p == 1.0


def test_a_difference_without_spread_has_no_t_and_says_so() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = compare([1.0] * 5, [0.0] * 5)
    assert (found.t, found.t_p, found.d) == (None, None, None)
    assert found.wilcoxon_p == pytest.approx(1 / 32)  # five ties
    assert found.note == "every seed differs by the same amount: no t; neither method varies: d is infinite"


def test_methods_that_agree_have_nothing_to_compare() -> None:
    found = compare([0.5, 0.5, 0.5], [0.5, 0.5, 0.5])
    assert (found.difference, found.t, found.wilcoxon_p, found.d) == (0.0, None, None, None)
    assert "both agree" in found.note


def test_a_constant_shift_has_an_effect_size_but_no_t() -> None:
    found = compare([1.1, 1.2, 1.3], [0.1, 0.2, 0.3])
    assert found.t is None
    assert found.d == pytest.approx(10.0)


@pytest.mark.parametrize(("a", "b"), [([1.0, 2.0], [1.0]), ([1.0], [2.0]), ([], [])])
def test_refuses_what_is_no_pair_of_samples(a: list[float], b: list[float]) -> None:
    with pytest.raises(ValueError, match="equal length"):
        compare(a, b)


def method(ucr: float, seeds: str = "12345") -> dict[str, object]:
    values = {seed: ucr + int(seed) / 100 for seed in seeds}
    return dict.fromkeys(COMPARED, entry(values, 5))  # type: ignore[arg-type]


def test_more_is_better_in_every_effect_size() -> None:
    found = effect_sizes({"reins": method(0.2), "direct": method(0.9)})["direct"]
    assert found["UCR"]["difference"] == pytest.approx(0.7)
    assert found["RVDR"]["difference"] == pytest.approx(-0.7)


def test_compares_over_common_seeds_alone() -> None:
    assert effect_sizes({"reins": method(0.2), "direct": method(0.9, "1")})["direct"] == {}
    assert effect_sizes({"direct": method(0.2)}) == {}
