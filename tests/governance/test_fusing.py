from __future__ import annotations

import sys
import traceback
from types import FunctionType
from typing import NamedTuple

import pytest

from app.governance.fusing import Part, fuse, needed, parts

MOST_N = 9.0


class Reading(NamedTuple):
    force_n: float
    width_m: float


class Sizes(NamedTuple):
    heavy_n: float


def total(force: Reading, load_n: float) -> float:
    """Add up; `held` is its own name, as it is that of the next part."""
    held = force.force_n
    held += load_n
    return held


def heavy(load_n: float, plan: Sizes) -> tuple[bool, float]:
    held = load_n > plan.heavy_n
    for _ in range(2):
        load_n = load_n / 2.0
    return held, load_n


def ratio(load_n: float, force: Reading) -> float:
    return load_n / force.width_m


def capped(load_n: float) -> float:
    return MOST_N if load_n > MOST_N else load_n


def least(load_n: float) -> float:
    """Its own `n` is another name than `least_n`, which it gives."""
    least_n = load_n
    for n in (3.0, 2.0, 5.0):
        least_n = min(least_n, n)
    return least_n


def leaves_early(load_n: float) -> float:
    if load_n > 1.0:
        return 1.0
    return load_n


def loses(load_n: float) -> float:
    load_n += 1.0
    return load_n


def crosses(load_n: float, width_m: float) -> tuple[float, float]:
    return width_m, load_n


def too_few(load_n: float) -> float:
    return load_n


FRAME = """
def whole(force, load_n):
    ...
    return {result}
"""


def build(made: tuple[Part, ...], result: str = "load_n, is_heavy") -> FunctionType:
    frame, unpacked, constant = FRAME.format(result=result), {"force": Reading._fields}, {"plan": Sizes._fields}
    code = fuse(frame, made, unpacked, constant, {"MOST_N": MOST_N}, __file__)
    return FunctionType(code, {"plan_heavy_n": 5.0, "range": range})


def test_parts_run_one_after_the_other_and_keep_their_own_names_apart() -> None:
    whole = build(parts({total: ("load_n",), heavy: ("is_heavy", "load_n")}))
    assert whole(Reading(4.0, 0.1), 2.0) == (1.5, True)
    assert whole(Reading(1.0, 0.1), 2.0) == (0.75, False)
    assert {"total__held", "heavy__held"} <= set(whole.__code__.co_varnames)


def test_what_a_part_gives_is_not_taken_for_one_of_its_own_names() -> None:
    assert build(parts({least: ("least_n",)}), "least_n")(Reading(1.0, 0.1), 9.0) == 2.0


def test_numbers_stand_in_the_code() -> None:
    whole = build(parts({capped: ("load_n",)}), "load_n")
    assert [whole(Reading(4.0, 0.1), load_n) for load_n in (8.0, 10.0)] == [8.0, 9.0]
    assert "MOST_N" not in whole.__code__.co_names


def test_what_breaks_in_a_part_is_found_in_its_own_source() -> None:
    whole = build(parts({ratio: ("load_n",)}), "load_n")
    with pytest.raises(ZeroDivisionError) as caught:
        whole(Reading(1.0, 0.0), 2.0)
    last = traceback.extract_tb(caught.tb)[-1]
    assert (last.filename, last.line) == (__file__, "return load_n / force.width_m")


@pytest.mark.parametrize(
    ("part", "gives", "message"),
    [
        (leaves_early, ("load_n",), "one `return`, at the end"),
        (loses, ("more_n",), "rebinds `load_n`"),
        (crosses, ("load_n", "width_m"), "just overwritten"),
        (too_few, ("load_n", "width_m"), "gives 2 names"),
        (too_few, ("too__few",), "takes or gives `too__few`"),
    ],
)
def test_a_function_that_would_mean_something_else_when_fused_is_refused(
    part: FunctionType, gives: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        build(parts({part: gives}), "load_n")


def test_only_parts_with_a_share_in_the_result_are_needed_state_kept_for_itself_is_none() -> None:
    made = parts({total: ("load_n",), heavy: ("is_heavy", "load_n"), ratio: ("share",)})
    assert [part.name for part in needed(made, ["is_heavy"])] == ["total", "heavy"]
    assert [part.name for part in needed(made, ["share"])] == ["total", "heavy", "ratio"]
    assert needed(made, ["something else"]) == ()
    assert needed(made[:1], ["share"]) == ()


def test_the_source_is_that_of_the_module_as_it_was_imported() -> None:
    assert sys.modules[__name__].total is total
    (part,) = parts({total: ("load_n",)})
    assert part.takes == ("force", "load_n")
    assert part.body[0].lineno == total.__code__.co_firstlineno + 2
