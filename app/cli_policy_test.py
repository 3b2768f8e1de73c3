"""`reins policy test`: do the cases hold, do they reach every rule, and would they notice a change?"""

from __future__ import annotations

from textwrap import indent
from typing import TYPE_CHECKING, Annotated, Final

import typer

from app.cli_policies import Directory, finding, load_policy
from app.config import find_policies
from app.governance.bundle import read_cases
from app.governance.cases import run as run_cases
from app.governance.errors import PolicyErrors
from app.terminal import FINDING, counting, err, say, say_error

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.authoring.mutation import Score
    from app.governance.cases import CaseResult
    from app.governance.policy import PolicySet

SHOWN: Final = 20

app = typer.Typer()


@app.command("test")
def run_tests(
    directory: Directory = None,
    *,
    mutation: Annotated[
        bool, typer.Option(help="Change every bound, operator, outcome and reference in turn: does a case fail?")
    ] = False,
    least_coverage: Annotated[
        float, typer.Option(min=0, max=100, help="Percent of the rules that the cases have to reach.")
    ] = 0.0,
    least_score: Annotated[
        float, typer.Option(min=0, max=100, help="Percent of the changes that a case has to notice.")
    ] = 0.0,
    processes: Annotated[int, typer.Option(min=1, max=16, help="How many processes change things.")] = 2,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="List every survivor.")] = False,
) -> None:
    """Run the cases in the directory's `tests`: proposal and context in, decision out; print every difference.

    Beside them it says which rule never determined a case's outcome. With [bold]--mutation[/], what no case notices is
    listed, each with a case that would.

    [bold]reins policy test policies --mutation[/]
    """
    folder = find_policies(directory)
    policy = load_policy(folder)
    try:
        files = read_cases(folder)
        results = run_cases(policy, files)
    except PolicyErrors as found:
        raise finding(found, folder) from found
    held = _say_cases(results)
    reached = _say_coverage(policy, files, least_coverage)
    noticed = True
    if mutation and held:
        noticed = _say_score(policy, files, least_score, processes, None if verbose else SHOWN)
    elif mutation:
        say_error("nothing is changed before the cases hold")
    if not (held and reached and noticed):
        raise typer.Exit(FINDING)


def _say_cases(results: list[CaseResult]) -> bool:
    failed = [result for result in results if not result.passed]
    for result in failed:
        err.print(f"{result.file}:{result.line}: {result.name}", markup=False)
        for difference in result.differences:
            err.print(f"    {difference}", markup=False)
    say(f"{len(results) - len(failed)} of {len(results)} cases passed")
    return bool(results) and not failed


def _say_coverage(policy: PolicySet, files: Mapping[str, str], least: float) -> bool:
    from app.authoring.rule_coverage import rule_coverage

    found = rule_coverage(policy, files)
    for rule in found.never:
        err.print(f"no case is determined by `{rule}`", markup=False)
    reached = len(found.determined) - len(found.never)
    say(f"{reached} of {len(found.determined)} rules and limits determined a case ({100 * found.share:.1f} %)")
    return 100 * found.share >= least


def _say_score(policy: PolicySet, files: Mapping[str, str], least: float, processes: int, shown: int | None) -> bool:
    from app.authoring.mutation import Fate, score

    with counting("changing one thing after the other") as progress:
        found = score(policy.files, files, processes=processes, progress=progress)
    _say_survivors(found, shown)
    counts = {fate: found.count(fate) for fate in Fate}
    say(
        f"{counts[Fate.KILLED]} of {counts[Fate.KILLED] + counts[Fate.SURVIVED]} changes noticed "
        f"({100 * found.share:.1f} %); beside them {counts[Fate.EQUIVALENT]} that are shown to change no decision, "
        f"and {counts[Fate.REFUSED]} that would not be loaded"
    )
    return 100 * found.share >= least


def _say_survivors(found: Score, shown: int | None) -> None:
    survivors = found.survivors
    for outcome in survivors[:shown]:
        err.print(f"{outcome.mutant}: no case fails", markup=False)
        told = outcome.proposal or "no case was found that would: it may change nothing, which is not shown\n"
        err.print(indent(told.rstrip(), "    "), markup=False)
    if shown is not None and len(survivors) > shown:
        err.print(f"and {len(survivors) - shown} more: --verbose lists them", markup=False)
