"""`reins policy`: checks a policy directory as the server would at its start, and proves it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.progress import BarColumn, Progress, TextColumn

from app import cli_authoring, cli_policy_diff, cli_policy_new, cli_policy_suggest, cli_policy_test
from app.cli_policies import Directory, TimeLimit, finding
from app.clock import monotonic_s
from app.config import find_policies
from app.governance.bundle import load, read_cases, read_properties
from app.governance.cases import read as read_tests
from app.governance.errors import PolicyError, PolicyErrors
from app.governance.evolution import outgrown
from app.governance.stated import read as read_promises
from app.terminal import FINDING, err, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.governance.policy import PolicySet
    from app.proofs.findings import Finding
    from app.proofs.prove import Report

SLOW_S: Final = 1.0  # from here on a bar shows how far it is

app = typer.Typer(help="Check, test, explain and write policy.", no_args_is_help=True)

app.add_typer(cli_policy_test.app)
app.add_typer(cli_authoring.app)
app.add_typer(cli_policy_new.app)
app.add_typer(cli_policy_diff.app)
app.add_typer(cli_policy_suggest.app)


class Form(StrEnum):
    """How findings are written."""

    TEXT = "text"
    SARIF = "sarif"


@app.command()
def check(  # its options
    directory: Directory = None,
    form: Annotated[Form, typer.Option("--format", help="How to write what is found.")] = Form.TEXT,
    effort: Annotated[int, typer.Option(min=1, help="Steps of the solver for one question.")] = 20_000_000,
    all_s: TimeLimit = 120.0,
    proofs: Annotated[bool, typer.Option(help="Whether to prove, or only to load.")] = True,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print notes as well.")] = False,
    against: Annotated[
        Path | None, typer.Option(help="The policy agents know: every capability's version has to say what changed.")
    ] = None,
) -> None:
    """Load and type-check everything, cases included, and prove it: no contradiction, no gap, no dead rule, no error.

    Every problem comes with its file and line, and every refuted proof with the smallest proposal that shows it, as a
    case for [bold]reins policy test[/]. What cannot be decided in time is a finding as well.

    [bold]reins policy check policies --format sarif[/]
    """
    folder = find_policies(directory)
    try:
        policy = load(folder)
        cases = read_tests(policy, read_cases(folder))
        if against is not None and (problems := outgrown(_known(find_policies(against)), policy)):
            raise PolicyErrors(problems)  # noqa: TRY301  # they are written like all others
        promised = read_properties(folder)
        read_promises(policy, promised)  # what cannot be read is refused, whether it is to be proved or not
        report = _prove(policy, promised, effort, all_s) if proofs else None
    except PolicyErrors as found:
        if form is Form.SARIF:
            _say_sarif([], found.problems)
            raise typer.Exit(FINDING) from found
        raise finding(found, folder) from found
    faults = [] if report is None else report.faults
    if form is Form.SARIF:
        _say_sarif([] if report is None else report.findings, [])
    else:
        _say_findings(report.findings if report is not None and verbose else faults)
        found = f"{len(faults)} not proved" if faults else "no problem"
        say(
            f"{len(policy.files)} files, {len(policy.rules)} rules, {len(policy.gates)} enabled pairs of capability "
            f"and profile, {len(cases)} cases: {found}"
        )
        if report is not None and not faults:
            say(report.summary())
        say(policy.digest)
    if faults:
        raise typer.Exit(FINDING)


def _known(folder: Path) -> PolicySet:
    """Load the policy that agents know.

    Raises:
        PolicyErrors: something is wrong with it; its files are named by their whole paths, as they are not those that
            are checked.
    """
    try:
        return load(folder)
    except PolicyErrors as found:
        raise PolicyErrors([
            PolicyError(file=str(folder / one.file), line=one.line, key=one.key, message=one.message, valid=one.valid)
            for one in found.problems
        ]) from found  # fmt: skip


def _prove(policy: PolicySet, properties: str | None, effort: int, all_s: float) -> Report:
    from app.proofs.prove import prove  # only here: nothing else of the command has a use for the solver

    with Progress(
        TextColumn("{task.description}"), BarColumn(), console=err, transient=True, disable=not err.is_terminal
    ) as bar:
        task = bar.add_task("proving", visible=False)
        began_s = monotonic_s()

        def show(done: int, of: int, what: str) -> None:
            bar.update(task, completed=done, total=of, description=what, visible=monotonic_s() - began_s > SLOW_S)

        return prove(policy, properties, now=monotonic_s, effort=effort, all_s=all_s, progress=show)


def _say_findings(findings: list[Finding]) -> None:
    for found in findings:
        err.print(f"{found.file}:{found.line}: {found.weight.value}: {found.message}", markup=False)
        if found.example:
            err.print(indent(found.example.rstrip(), "    "), markup=False)


def _say_sarif(findings: list[Finding], problems: Sequence[PolicyError]) -> None:
    from app.proofs.sarif import sarif

    typer.echo(sarif(findings, problems))
