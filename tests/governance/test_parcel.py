"""A policy that was compiled elsewhere is the policy that it was."""

from __future__ import annotations

from dataclasses import fields

from app.governance import bundle
from app.governance.decision import decide
from app.governance.parcel import RULES, parcels, unpacked
from tests.governance.policy_world import context, files, proposal, shipped


def test_a_policy_taken_out_of_its_parcels_says_and_decides_the_same() -> None:
    *steps, found = unpacked(parcels(shipped()))
    assert found is not None
    assert set(steps) == {None}
    for field in fields(shipped()):
        if field.name not in ("gates", "inputs"):
            assert getattr(found, field.name) == getattr(shipped(), field.name), field.name
    assert found.gates.keys() == shipped().gates.keys()
    for name in ("mug_1", "glass_1", "solvent_1", "box_1"):
        asked = proposal("grasp_object", object_id=name, force_n=80.0, speed_mps=0.3)
        for profile in shipped().profiles:
            assert decide(found, asked, context(profile)) == decide(shipped(), asked, context(profile))
    assert found.validate_params("grasp_object", {"object_id": "mug_1"}) == shipped().validate_params(
        "grasp_object", {"object_id": "mug_1"}
    )


def test_many_rules_come_in_several_parcels() -> None:
    more = "".join(
        f"\n  - {{id: r{number}, applies_to: [navigate_to], when: params.speed_mps > {number}.5, then: deny, "
        f"because: So.}}"
        for number in range(RULES + 1)
    )
    text = files()["organization.yaml"].replace("\nrules:\n", f"\nrules:{more}\n", 1)
    grown = bundle.load_files({**files(), "organization.yaml": text})
    taken = list(parcels(grown))
    assert len(taken) == 1 + 2 + len(grown.gates)
    *_, found = unpacked(taken)
    assert found is not None
    assert list(found.rules) == list(grown.rules)
