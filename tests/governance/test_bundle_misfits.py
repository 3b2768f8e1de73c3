"""Each broken policy beside a file that does not fit, against each by itself: a comparison that covers nothing new."""

from __future__ import annotations

import pytest

from tests.governance.policy_world import files
from tests.governance.test_bundle import BROKEN, SITE, H, told, told_as, wrong_with

UNFIT = {
    "a profile": ("profiles/test-audit.yaml", "sensitivity: 0.5", "sensitivity: lots"),
    "a manifest": ("capabilities/inspect_area.yaml", "risk: low", "risk: enormous"),
    "a recovery's manifest": ("capabilities/safe_retreat.yaml", "risk: low", "risk: enormous"),
    "an input": ("capabilities/inspect_area.yaml", "type: string", "type: numbr"),
    "authority": (H, "confirm_before:", "confirm: {}\nconfirm_before:"),
    "site": (SITE, "fragile: true", "fragile: maybe"),
}
NEEDS_ALL = {"a limit above what may be proposed", "a shared floor watched for some", "a constant that names nothing",
             "a constant of one branch", "an undoing there is not"}  # fmt: skip


@pytest.mark.parametrize("unfit", UNFIT)
def test_a_file_that_does_not_fit_hides_nothing_of_the_others_and_is_blamed_on_none(unfit):
    other, right, wrong = UNFIT[unfit]
    one = {**files(), other: files()[other].replace(right, wrong)}
    assert {file for file, *_ in told(one)} == {other}
    beside = told(one)
    for name, file, old, new, _ in BROKEN[list(UNFIT).index(unfit) :: len(UNFIT)]:
        if file == other or name in NEEDS_ALL:
            continue
        alone = {told_as(problem) for problem in wrong_with(file, old, new) if problem.file != other}
        assert alone == told({**one, file: one[file].replace(old, new)}) - beside, name
