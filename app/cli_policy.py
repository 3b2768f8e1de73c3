"""`reins policy`: checks a policy directory as the server would at its start."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.config import find_policies
from app.governance.bundle import load, read_cases
from app.governance.cases import read as read_tests
from app.governance.cases import run as run_cases
from app.governance.errors import PolicyErrors
from app.terminal import FINDING, err, say, say_error

if TYPE_CHECKING:
    from app.governance.policy import PolicySet

app = typer.Typer(help="Check and test policy directories.", no_args_is_help=True)

Directory = Annotated[
    Path | None, typer.Argument(help="The policy directory; default: ./policies, else the shipped one.")
]


@app.command()
def check(directory: Directory = None) -> None:
    """Load and type-check everything, its cases included; print every problem with its file and line.

    [bold]reins policy check policies[/]
    """
    folder = find_policies(directory)
    policy = _load(folder)
    try:
        cases = read_tests(policy, read_cases(folder))
    except PolicyErrors as found:
        raise _finding(found, folder) from found
    pairs, rules = len(policy.gates), len(policy.rules)
    say(
        f"{len(policy.files)} files, {rules} rules, {pairs} enabled pairs of capability and profile, "
        f"{len(cases)} cases: no problem"
    )
    say(policy.digest)


@app.command("test")
def run_tests(directory: Directory = None) -> None:
    """Run the cases in the directory's `tests`: proposal and context in, decision out; print every difference.

    [bold]reins policy test policies[/]
    """
    folder = find_policies(directory)
    policy = _load(folder)
    try:
        results = run_cases(policy, read_cases(folder))
    except PolicyErrors as found:
        raise _finding(found, folder) from found
    failed = [result for result in results if not result.passed]
    for result in failed:
        err.print(f"{result.file}:{result.line}: {result.name}", markup=False)
        for difference in result.differences:
            err.print(f"    {difference}", markup=False)
    say(f"{len(results) - len(failed)} of {len(results)} cases passed")
    if failed or not results:
        raise typer.Exit(FINDING)


def _finding(found: PolicyErrors, folder: Path) -> typer.Exit:
    for problem in found.problems:
        err.print(str(problem), markup=False)
    say_error(f"{len(found.problems)} in `{folder}`")
    return typer.Exit(FINDING)


def _load(folder: Path) -> PolicySet:
    try:
        return load(folder)
    except PolicyErrors as found:
        raise _finding(found, folder) from found
