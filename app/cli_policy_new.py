"""`reins policy new`: a policy directory made from a template, its answers asked for or given by flags."""

from __future__ import annotations

import itertools
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.markup import escape

from app.cli_policies import Policies, finding, load_policy
from app.clock import monotonic_s
from app.config import DEFAULT_PROFILE, find_policies
from app.governance.bundle import TESTS_FOLDER, load_files, read_cases, read_properties
from app.governance.cases import run as run_cases
from app.governance.errors import PolicyErrors
from app.terminal import FINDING, MISUSE, err, out, say, say_error

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from app.authoring.questions import Answer, Question
    from app.authoring.templates import Template
    from app.governance.policy import PolicySet

app = typer.Typer()
PROPERTIES: Final = "properties.yaml"


@app.command()
def new(  # its options
    directory: Annotated[
        Path | None, typer.Argument(help="Where the new policy goes; there must be nothing there.")
    ] = None,
    *,
    template: Annotated[str | None, typer.Option(help="Which template; --list explains each.")] = None,
    listing: Annotated[bool, typer.Option("--list", help="Explain the templates and what they ask.")] = False,
    given: Annotated[
        list[str] | None, typer.Option("--set", help="An answer, `question=value`; once for each.", metavar="KEY=VALUE")
    ] = None,
    ask: Annotated[
        bool | None, typer.Option(help="Ask for what is not given; default: if somebody is at the terminal.")
    ] = None,
    policies: Policies = None,
) -> None:
    """Make a policy directory from a template: the one in use and a profile more, proved and with its cases.

    [bold]reins policy new --list[/]

    [bold]reins policy new candidate --template reduced-speed --set base_speed_mps=0.2 --set assessment="RA 7, 3.2"[/]

    What the template does not ask about is taken over from an existing profile. Nothing that exists is written over.
    """
    from app.authoring.templates import TEMPLATES, common

    if listing:
        _explain()
        return
    chosen = TEMPLATES.get(template or "")
    if chosen is None or directory is None:
        unknown = template is not None and chosen is None
        say_error(
            f"there is no template `{template}`"
            if unknown
            else "name a directory that does not exist yet, and a template",
            hint=f"--template {' | '.join(TEMPLATES)}; `reins policy new --list` explains them",
        )
        raise typer.Exit(MISUSE)
    if directory.exists():
        say_error(f"`{directory}` exists, and nothing is written over", hint="name another directory")
        raise typer.Exit(MISUSE)
    folder = find_policies(policies)
    policy = load_policy(folder)
    profiles = tuple(sorted(policy.profiles))
    like = DEFAULT_PROFILE if DEFAULT_PROFILE in profiles else profiles[0]
    questions = (*common(profiles, like, chosen.name), *chosen.questions)
    answers = _answers(questions, given or [], ask=sys.stdin.isatty() if ask is None else ask)
    files = _made(policy, folder, chosen, answers)
    _write(directory, files)
    _say_next(directory, folder, str(answers["profile"]), chosen, answers)


def _explain() -> None:
    from app.authoring.templates import TEMPLATES

    for template in TEMPLATES.values():
        out.print(f"[bold]{template.name}[/]  {escape(template.summary)}")
        say(f"  from {template.source}")
        for note in template.notes:
            say(f"  - {note}")
        for question in template.questions:
            default = "asked: no standard fixes it" if question.default is None else f"default {question.default}"
            say(f"    {question.key}  {question.asks} ({question.valid}; {default})")
        say("")
    say(
        "All of them ask for profile, like, strictest and assessment as well. A policy made from a template conforms to"
    )
    say(
        "nothing by itself: safety functions with a performance level are the robot's own, Reins is a layer above them."
    )


# Answers -------------------------------------------------------------------------------------------------------------


def _answers(questions: Sequence[Question], given: Sequence[str], *, ask: bool) -> dict[str, Answer]:
    """Return an answer to every question: given, asked for, or the default. Ends the command where one is missing."""
    from app.authoring.questions import AnswerError

    said = _said(given)
    known = {question.key for question in questions}
    unknown = sorted(said.keys() - known)
    missing = [question for question in questions if question.key not in said and question.default is None]
    if unknown:
        say_error(f"nothing is asked called `{unknown[0]}`", hint=f"valid: {', '.join(sorted(known))}")
        raise typer.Exit(MISUSE)
    if missing and not ask:
        say_error("these questions have no default, because no standard answers them for you:")
        for question in missing:
            err.print(
                f"  --set {question.key}=…  {question.asks} ({question.valid})\n      {question.why}", markup=False
            )
        raise typer.Exit(MISUSE)
    try:
        return {
            question.key: question.read(said[question.key]) if question.key in said else _asked(question, ask=ask)
            for question in questions
        }
    except AnswerError as error:
        say_error(str(error))
        raise typer.Exit(MISUSE) from error


def _said(given: Sequence[str]) -> dict[str, str]:
    """Return answers by question. Ends the command where one has two: of two numbers nobody can say which is meant."""
    said: dict[str, str] = {}
    for key, value in map(_split, given):
        if key in said:
            say_error(f"`{key}` is answered twice, `{said[key]}` and `{value}`", hint="--set, once for each question")
            raise typer.Exit(MISUSE)
        said[key] = value
    return said


def _split(one: str) -> tuple[str, str]:
    key, equals, value = one.partition("=")
    if not equals:
        say_error(f"`{one}` is no answer", hint="--set question=value")
        raise typer.Exit(MISUSE)
    return key.strip(), value


def _asked(question: Question, *, ask: bool) -> Answer:
    """Ask until the answer can be taken; without anybody to ask, the default holds."""
    from rich.prompt import Prompt

    from app.authoring.questions import AnswerError

    if not ask:
        return question.read(str(question.default))
    err.print(f"\n[bold]{escape(question.asks)}[/]")
    err.print(f"  {question.why}" + (f" [{question.source}]" if question.source else ""), markup=False)
    while True:
        typed = Prompt.ask(f"  {question.key} ({escape(question.valid)})", console=err, default=question.default)
        try:
            return question.read(typed or "")
        except AnswerError as error:
            err.print(f"  {error}", markup=False)


# What comes of them --------------------------------------------------------------------------------------------------


def _made(policy: PolicySet, folder: Path, template: Template, answers: Mapping[str, Answer]) -> dict[str, str]:
    """Return the whole new policy, checked and proved. Ends the command where anything is wrong with it."""
    from app.authoring.drafting import drafted
    from app.authoring.holding import hold
    from app.proofs.prove import prove

    try:
        changed = drafted(policy, read_properties(folder), template, answers)
        tests = read_cases(folder)
        files = {**policy.files, **{name: text for name, text in changed.items() if name != PROPERTIES}}
        made = load_files(files)
        results = run_cases(made, tests)
        with err.status("proving what came of it …"):
            report = prove(made, changed[PROPERTIES], now=monotonic_s)
    except PolicyErrors as found:
        raise finding(found, folder) from found
    failed = [f"{one.file}:{one.line}: {one.name}: {'; '.join(one.differences)}" for one in results if not one.passed]
    failed += [f"{one.file}:{one.line}: {one.message}\n{one.example}" for one in report.faults]
    if failed:
        for line in failed:
            err.print(line, markup=False)
        say_error(
            "nothing is written: with these answers the policy is not sound",
            hint="answer otherwise, or change in a copy what stands against it",
        )
        raise typer.Exit(FINDING)
    say(report.summary())
    with err.status("finding cases that hold it …"):
        held = hold(files, str(answers["profile"]))
    say(f"{held.count} cases hold the profile: of {held.noticed + len(held.missed)} changes they notice {held.noticed}")
    for mutant in held.missed:
        say(f"  none notices {mutant}")
    return {**files, PROPERTIES: changed[PROPERTIES], **tests, _free(tests, str(answers["profile"])): held.text}


def _free(tests: Mapping[str, str], profile: str) -> str:
    """Return a file for the profile's cases that is not taken by cases of something else."""
    file, taken = f"{TESTS_FOLDER}/{profile}.yaml", itertools.count(2)
    while file in tests:
        file = f"{TESTS_FOLDER}/{profile}-{next(taken)}.yaml"
    return file


def _write(directory: Path, files: Mapping[str, str]) -> None:
    """Write all files or none: beside the place, and moved there when they are whole."""
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".new-", dir=directory.parent) as place:
            whole = Path(place) / "policy"
            for name, text in files.items():
                path = whole / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
            whole.rename(directory)
    except OSError as error:
        say_error(f"`{directory}` cannot be written: {error}")
        raise typer.Exit(MISUSE) from error


def _say_next(directory: Path, folder: Path, profile: str, template: Template, answers: Mapping[str, Answer]) -> None:
    say(f"{directory} is written: the policy of {folder.name}, and the profile {profile} ({template.source})")
    if warning := template.warn(answers):
        say(f"note: {warning}")
    say("next:")
    say(f"  read {directory / 'profiles' / f'{profile}.yaml'}, and replace what your risk assessment says otherwise")
    say(f"  reins policy explain grasp_object --profile {profile} --policies {directory}")
    say(f"  read the profile's cases in {directory / TESTS_FOLDER}: they say what comes of it, not what should")
    say(f"  reins policy test {directory} --mutation      says whether they still hold its numbers in place")
    say(f'  reins policy propose {directory} --why "…"    brings it to a running server; two engineers activate it')
