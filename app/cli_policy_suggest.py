"""`reins policy suggest`: what the record suggests to change about a policy; prints patches, and applies none."""

from __future__ import annotations

from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Annotated, Final

import orjson
import typer

from app.authoring.suggesting import Least
from app.cli_data import directory
from app.cli_policies import Policies, finding, load_policy
from app.clock import monotonic_s, parse_rfc3339
from app.config import find_policies
from app.governance.bundle import read_cases, read_properties
from app.governance.changes import SAME
from app.governance.errors import PolicyErrors
from app.terminal import MISUSE, err, out, plain, say, say_error

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.authoring.habits import Habits
    from app.authoring.vetting import Vetted
    from app.governance.policy import PolicySet

SHOWN: Final = 5  # of a list; JSON has all of it
WIDEST: Final = 160
_LEAST: Final = Least()

app = typer.Typer()


@app.command()
def suggest(  # its options
    *,
    data: Annotated[
        Path, typer.Option(help="The server's data directory.", envvar="REINS_DATA", parser=directory)
    ] = Path("data"),
    since: Annotated[str | None, typer.Option(help="From when on, RFC 3339; default: all that is recorded.")] = None,
    policies: Policies = None,
    decisions: Annotated[
        int, typer.Option("--least-values", min=1, help="Values that agents named, all beyond one bound.")
    ] = _LEAST.decisions,
    answers: Annotated[
        int, typer.Option("--least-answers", min=1, help="Questions, all answered alike.")
    ] = _LEAST.answers,
    silent: Annotated[
        int, typer.Option("--least-silent", min=1, help="Decisions a rule had a say in, and decided none of.")
    ] = _LEAST.silent,
    overrides: Annotated[
        int, typer.Option("--least-overrides", min=1, help="Approvals with an edit, or takeovers after a refusal.")
    ] = _LEAST.overrides,
    json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Suggest changes from the record: bounds always hit, approvals always or never granted, idle rules, overrides.

    Each comes with its evidence, a patch for [bold]patch -p1[/] in the policy directory, and what the patch would do,
    as [bold]reins policy diff[/] says it. Nothing is applied. Counted is what was decided under this very policy.

    [bold]reins policy suggest --data data --since 2026-03-01T00:00:00Z[/]
    """
    from app.audit.errors import RecordDamaged, RecordUnreadable
    from app.authoring.habits import read_habits

    folder = find_policies(policies)
    policy = load_policy(folder)
    least = Least(decisions=decisions, answers=answers, silent=silent, overrides=overrides)
    try:
        with err.status("reading the record …"):
            habits = read_habits(data, policy, since=None if since is None else parse_rfc3339(since))
    except (RecordDamaged, RecordUnreadable, ValueError) as error:
        say_error(str(error), hint="--data names a data directory, --since a time like 2026-03-01T00:00:00Z")
        raise typer.Exit(MISUSE) from error
    try:
        vetted = _vetted(policy, folder, habits, least)
    except PolicyErrors as found:
        raise finding(found, folder) from found
    if json:
        say(orjson.dumps(_document(policy, habits, least, vetted)).decode())
    else:
        _say(policy, habits, least, vetted)


def _vetted(policy: PolicySet, folder: Path, habits: Habits, least: Least) -> list[Vetted]:
    from app.authoring.suggesting import suggest as suggested
    from app.authoring.vetting import Vetting

    vetting = Vetting(policy, read_cases(folder), read_properties(folder), now=monotonic_s)
    found = suggested(policy, habits, least)
    vetted: list[Vetted] = []
    with err.status("holding suggestions against cases and proofs …") as status:
        for done, one in enumerate(found):
            status.update(f"holding suggestions against cases and proofs: {done + 1} of {len(found)}")
            vetted.append(vetting.vet(one))
    return vetted


def _document(policy: PolicySet, habits: Habits, least: Least, vetted: list[Vetted]) -> dict[str, object]:
    return {
        "policy_version": policy.digest,
        "decisions": habits.decisions.count,
        "left_out": habits.left_out,
        "first": habits.decisions.first,
        "last": habits.decisions.last,
        "least": {
            "values": least.decisions,
            "answers": least.answers,
            "silent": least.silent,
            "overrides": least.overrides,
        },
        "suggestions": [one.document() for one in vetted],
    }


def _say(policy: PolicySet, habits: Habits, least: Least, vetted: list[Vetted]) -> None:
    for one in vetted:
        _say_one(one)
    seen = habits.decisions
    span = f" from {seen.first} to {seen.last}" if seen.count else ""
    say(f"{len(vetted)} suggestions from {seen.count} decisions under {policy.digest}{span}")
    if habits.left_out:
        say(f"{habits.left_out} decisions left out: another version made them, or they have no context")
    say(
        f"suggested is what was seen at least so often: {least.decisions} values beyond a bound, {least.answers} "
        f"answers, {least.silent} decisions without a rule's word, {least.overrides} overrides"
    )


def _say_one(one: Vetted) -> None:
    made = one.suggestion
    out.print(f"{made.kind}: {made.about}", markup=False, style="bold")
    say(f"  {made.words}")
    newest = ", ".join(map(str, made.events[-SHOWN:]))
    say(f"  seen from {made.first} to {made.last}, at last in event {newest}")
    if one.comparison is not None:
        say(f"  {one.comparison.direction}")
        for change in dict.fromkeys(found.change for found in one.comparison.decisions):
            first = next(found for found in one.comparison.decisions if found.change == change)
            say(f"    {first.direction:<9} {first.message}")
        for part in (found for found in one.comparison.differences if found.direction is not SAME):
            say(f"    {part.direction:<9} {part.part}: {part.before or '-'} -> {part.after or '-'}")
    for heading, lines in (
        ("would not be loaded", one.problems),
        ("would be refused, for what is not true any more", one.refuted),
        ("cases expect otherwise", one.cases),
    ):
        if lines:
            say(f"  {len(lines)} {heading}:" if lines is one.cases else f"  {heading}:")
            say(indent(_some([_cut(line) for line in lines]), "    "))
    if made.unwritten:
        say(f"  no patch: {made.unwritten}")
    else:
        typer.echo(plain(made.patch))  # not indented, and tabs as they are, so that it can be piped


def _some(lines: Sequence[str]) -> str:
    """Return the first few, and how many more there are."""
    more = len(lines) - SHOWN
    return "\n".join(lines[:SHOWN]) + (f"\nand {more} more" if more > 0 else "")


def _cut(line: str) -> str:
    return line if len(line) <= WIDEST else f"{line[: WIDEST - 1]}…"
