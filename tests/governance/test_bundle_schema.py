"""The schemas of policy files, held against loading: what loads fits them, and what they refuse does not load."""

from __future__ import annotations

import fnmatch
from functools import cache

import jsonschema_rs
import orjson
import pytest

from app.governance import bundle
from app.governance.bundle_fit import fit
from app.governance.bundle_schema import KINDS, SUFFIX, schema
from app.governance.bundle_yaml import parse
from tests.governance.policy_world import POLICIES, files
from tests.governance.test_bundle import BROKEN

SHIPPED = sorted(path.relative_to(POLICIES).as_posix() for path in POLICIES.rglob("*.yaml"))
# Faults that pydantic's shapes let pass, and that a schema sees all the same: words, and keys that ask for each other.
SEEN_BESIDES = {
    "unit mismatch", "limit of another unit", "bad schema", "open schema", "nobody's capability",
    "parameter of no type", "parameter of a deep type", "parameter that is anything", "no such unit", "no upper end",
    "neither name nor list", "parameters by pattern", "a quantity below zero", "an integer with a unit",
    "a flag with a limit", "a name with a limit", "unknown reference", "unknown condition", "empty bound",
    "modify without set", "a bound and a value", "set without modify", "approvers without escalate",
    "resuming what went on", "approval nobody asks for", "approval required, and nobody asks", "unknown signal",
    "unknown failure", "unknown threshold", "threshold of another unit", "two thresholds", "else without persist_ms",
    "recovery without capability", "uncovered failures", "no approval", "unknown sensor", "a review without its mode",
    "a review of nothing", "a reference to a file", "a reference to an address", "a reference that is long",
    "a dialect to be fetched", "an origin of references", "a quantity whose name says no unit",
    "threshold of another unit, where a limit has it",
}  # fmt: skip


@cache
def validator(kind: str) -> jsonschema_rs.Draft202012Validator:
    return jsonschema_rs.Draft202012Validator(dict(schema(kind)))


def kind_of(name: str) -> str:
    return next(kind.name for kind in KINDS.values() if fnmatch.fnmatch(name, kind.files))


@pytest.mark.parametrize("kind", KINDS)
def test_a_schema_is_one(kind):
    jsonschema_rs.meta.validate(dict(schema(kind)))


def test_every_kind_of_file_that_loading_knows_has_a_schema_of_its_own_shape():
    for kind in KINDS.values():
        read = bundle.shape_of(kind.files.replace("*", "any"))
        assert read is None or read is kind.shape
    assert {kind_of(name) for name in SHIPPED} == set(KINDS)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_file_fits_its_schema_and_names_it_in_its_first_line(name):
    text = (POLICIES / name).read_text()
    document, problems = parse(name, text)
    assert not problems
    assert [error.message for error in validator(kind_of(name)).iter_errors(document.value)] == []
    assert text.splitlines()[0] == KINDS[kind_of(name)].modeline()
    said = text.splitlines()[0].partition("$schema=")[2]
    assert ((POLICIES / name).parent / said).resolve() == (POLICIES.parent / "schemas" / f"{kind_of(name)}{SUFFIX}")


@pytest.mark.parametrize("kind", KINDS)
def test_the_schemas_beside_the_shipped_policy_are_those_of_the_shapes(kind):
    kept = (POLICIES.parent / "schemas" / f"{kind}{SUFFIX}").read_bytes()
    assert orjson.loads(kept) == schema(kind), "`reins policy schemas schemas` writes them anew"


@pytest.mark.parametrize(("file", "old", "new"), [row[1:4] for row in BROKEN], ids=[row[0] for row in BROKEN])
def test_what_does_not_fit_its_shape_does_not_fit_its_schema(file, old, new, request):
    document, unreadable = parse(file, files()[file].replace(old, new))
    if unreadable:
        return
    kind = kind_of(file)
    misfits = fit(KINDS[kind].shape, document)[1]
    refused = not validator(kind).is_valid(document.value)
    assert refused == (bool(misfits) or request.node.callspec.id in SEEN_BESIDES)


ODD = [
    ("profiles/p.yaml", "watch: [{id: a, signal: stall_s, above: null, below: 3, response: {enter: stop}}]", True),
    ("profiles/p.yaml", "watch: [{id: a, signal: stall_s, above: timeout_s, response: {enter: stop}}]", False),
    ("profiles/p.yaml", "watch: [{id: a, signal: elapsed_s, above: timeout_s, response: {enter: stop}}]", True),
    ("profiles/p.yaml", "rules: [{id: a, then: deny, set: {}, because: So.}]", True),
    ("profiles/p.yaml", "rules: [{id: a, then: modify, set: {x_m: {to: place.name, min: null}}, because: So.}]", True),
    ("profiles/p.yaml", "rules: [{id: a, then: modify, set: {X: {min: 1}}, because: So.}]", False),
    ("profiles/p.yaml", "profile: admission", False),
    ("properties.yaml", "properties: [{id: a, says: So., never: []}]", False),
    ("properties.yaml", "properties: [{id: a, says: So., approvers: 2}]", True),
    ("organization.yaml", "agents: {Planner: {}}", False),
    ("tests/a.yaml", "cases: [{name: a, capability: b, expect: {status: denied, session: {watch: {a: null}}}}]", True),
    ("tests/a.yaml", "cases: [{name: a, capability: b, expect: {status: permitted}}]", False),
]  # fmt: skip


@pytest.mark.parametrize(("file", "part", "good"), ODD)
def test_a_part_of_a_file_is_taken_as_loading_takes_it(file, part, good):
    key = part.partition(":")[0]
    document, _ = parse(file, part)
    found = [
        error for error in validator(kind_of(file)).iter_errors(document.value) if key in list(error.instance_path)
    ]
    assert (found == []) is good


def test_there_is_no_schema_of_what_is_no_policy_file():
    with pytest.raises(KeyError):
        schema("secrets")
