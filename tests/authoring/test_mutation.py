"""Mutants are what a full load makes of the changed files, and what is called equivalent never decides otherwise."""

from __future__ import annotations

import multiprocessing
import os
import signal
from functools import cache

import pytest
import yaml

from app.authoring import mutation
from app.authoring.equivalence import equivalent
from app.authoring.mutants import mutants
from app.authoring.mutation import Fate, Trial
from app.authoring.workbench import Workbench
from app.governance import bundle, cases
from app.governance.bundle_shapes import CaseShape
from app.governance.errors import PolicyErrors
from tests.governance.policy_world import POLICIES, files

EVERY = 397  # one mutant in so many: a full load takes a while
ORGANIZATION = "organization.yaml"
CASE = "cases:\n  - {name: %s, profile: %s, capability: %s, params: %s, context: %s, expect: %s}\n"


@cache
def bench() -> Workbench:
    return Workbench(files())


def came_of(policy, case_files):
    return {
        (found.file, found.line): cases.came_of(policy, cases.asking(policy, found.profile, found.case))
        for found in cases.read(policy, case_files)
    }


def test_a_changed_policy_is_what_a_full_load_makes_of_the_changed_files():
    case_files = bundle.read_cases(POLICIES)
    sample = mutants(bench().documents, bench().known)[::EVERY]
    refused = 0
    sample += [
        mutant for mutant in mutants(bench().documents, bench().known) if "`deny` instead of `esc" in mutant.what
    ]
    assert {mutant.file.partition("/")[0] for mutant in sample} >= {ORGANIZATION, "profiles", "capabilities"}
    for mutant in sample:
        text = yaml.safe_dump(mutant.applied(bench().documents[mutant.file].value), sort_keys=False)
        try:
            whole = bundle.load_files({**files(), mutant.file: text})
        except PolicyErrors:
            refused += 1
            with pytest.raises(PolicyErrors):
                bench().changed(mutant)
            continue
        quick = bench().changed(mutant)
        assert came_of(quick, case_files) == came_of(whole, case_files), str(mutant)
    assert 1 <= refused < len(sample)  # a denial that names approvers, at least


def test_what_is_shown_to_be_equivalent_treats_every_example_alike():
    policy, vocabulary = bench().policy, bench().known.vocabulary
    checked = 0
    for mutant in mutants(bench().documents, bench().known)[::31]:
        try:
            changed = bench().changed(mutant)
        except PolicyErrors:
            continue
        if not equivalent(policy, changed, vocabulary):
            continue
        checked += 1
        pairs = [pair for pair in policy.gates if mutation.concerns(mutant, *pair)]
        for name, profile in pairs[::5]:
            for number, example in enumerate(mutation.Examples((policy, changed), vocabulary, name, profile)):
                if number == 12:
                    break
                case = CaseShape.model_validate({**example, "name": "x", "expect": {"status": "allowed"}})
                asked = cases.asking(policy, profile, case)
                assert cases.came_of(policy, asked) == cases.came_of(changed, asked), f"{mutant} {example}"
    assert checked >= 2


def fate(change, case_files):
    trial = Trial(files(), case_files)
    (mutant,) = [mutant for mutant in trial.mutants if str(mutant).endswith(change)]
    return trial.outcome(mutant)


HAZARD = "organization.yaml:12: rules[0].when: without `target.hazardous`"


def test_a_mutant_that_a_case_notices_is_killed_by_it():
    case = CASE % ("a mug may be had", "sim-relaxed", "grasp_object", "{object_id: mug_1}", "{}", "{status: allowed}")
    found = fate(HAZARD, {"tests/x.yaml": case})
    assert (found.fate, found.by) == (Fate.KILLED, "a mug may be had")


def test_a_survivor_comes_with_a_case_that_kills_it():
    case = CASE % ("drives", "sim-relaxed", "navigate_to", "{target: dock}", "{}", "{status: allowed}")
    trial = Trial(files(), {"tests/x.yaml": case})
    keys = ("rules[0].when", "rules[1].then", "rules[3].set.force_n.max")
    chosen = [mutant for mutant in trial.mutants if mutant.file == ORGANIZATION and mutant.key in keys][::3]
    proposed = 0
    for mutant in chosen:
        found = trial.outcome(mutant)
        if found.proposal:
            proposed += 1
            assert cases.run(bench().policy, {"tests/new.yaml": found.proposal})[0].passed, found.proposal
            assert not cases.run(bench().changed(mutant), {"tests/new.yaml": found.proposal})[0].passed, found.proposal
    assert proposed >= 2


def test_a_change_that_no_object_of_the_site_shows_is_equivalent_and_one_that_an_object_shows_is_not():
    none = {"tests/x.yaml": CASE % ("d", "sim-relaxed", "navigate_to", "{target: dock}", "{}", "{status: allowed}")}
    assert fate("rules[4].when: `>=` instead of `>`", none).fate is Fate.EQUIVALENT  # nothing weighs exactly a limit
    assert fate("rules[4].when: `<` instead of `>`", none).fate is Fate.SURVIVED


def test_a_change_that_could_not_be_loaded_is_refused_and_says_why():
    found = fate("organization.yaml:51: rules[7].then: `deny` instead of `escalate`", bundle.read_cases(POLICIES))
    assert found.fate is Fate.REFUSED
    assert "`approvers` belongs" in found.by


def test_two_processes_find_what_one_finds_and_leave_an_interrupt_to_whoever_waits(monkeypatch):
    monkeypatch.setattr(mutation, "SHARE", 4)
    case_files = {"tests/organization.yaml": bundle.read_cases(POLICIES)["tests/organization.yaml"]}
    trial = Trial(files(), case_files)
    numbers = [number for number, mutant in enumerate(trial.mutants) if mutant.file == ORGANIZATION][1:40:4]
    alone = [trial.outcome(trial.mutants[number]).fate for number in numbers]
    told = []

    def interrupt_workers(*done):
        told.append(done)
        for worker in multiprocessing.active_children():
            os.kill(worker.pid, signal.SIGINT)

    found = mutation.fates(files(), case_files, numbers, processes=2, progress=interrupt_workers)
    assert [outcome.fate for outcome in found] == alone
    assert told == [(min(done, len(numbers)), len(numbers)) for done in range(4, len(numbers) + 4, 4)]


def test_the_score_is_of_what_could_be_noticed():
    trial = Trial(
        files(),
        {"tests/x.yaml": CASE % ("d", "sim-relaxed", "navigate_to", "{target: dock}", "{}", "{status: allowed}")},
    )
    first = trial.mutants[0]
    made = [
        mutation.Outcome(mutant=first, fate=fate)
        for fate in (Fate.KILLED,) * 3 + (Fate.SURVIVED, Fate.EQUIVALENT, Fate.REFUSED)
    ]
    score = mutation.Score(outcomes=tuple(made))
    assert (score.share, score.count(Fate.KILLED), len(score.survivors)) == (0.75, 3, 1)
