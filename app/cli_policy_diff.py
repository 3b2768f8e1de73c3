"""`reins policy diff`: what really changes between two policy directories, proved, each change with an example."""

from __future__ import annotations

from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Annotated, Final

import orjson
import typer
from rich.progress import BarColumn, Progress, TextColumn

from app.cli_policies import TimeLimit, load_policy
from app.clock import monotonic_s
from app.config import find_policies
from app.governance.changes import SAME, Direction
from app.terminal import err, say

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.changes import Comparison, Transition
    from app.governance.policy import PolicySet

SLOW_S: Final = 1.0  # from here on a bar shows how far it is
UNDECIDED: Final = 13
CODES: Final[Mapping[Direction, int]] = {
    Direction.SAME: 0,
    Direction.TIGHTENS: 10,
    Direction.LOOSENS: 11,
    Direction.BOTH: 12,
}
"""1 stays for a policy that is at fault, 2 for a command that is."""
_SAID: Final[Mapping[Direction, str]] = {
    Direction.SAME: "no effect",
    Direction.TIGHTENS: "tightens",
    Direction.LOOSENS: "loosens",
    Direction.BOTH: "tightens and loosens",
}

app = typer.Typer()


@app.command()
def diff(
    old: Annotated[Path, typer.Argument(help="The policy directory that is in force.")],
    new: Annotated[Path, typer.Argument(help="The one that may take its place.")],
    *,
    json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
    effort: Annotated[int, typer.Option(min=1, help="Steps of the solver for one question.")] = 20_000_000,
    all_s: TimeLimit = 120.0,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print an example of every pair.")] = False,
) -> None:
    """Say what really changes: which decisions, from what to what, with the smallest example; and everything else.

    The exit code says which way it goes: 0 no effect, 10 it tightens, 11 it loosens, 12 both, 13 something could not be
    decided and counts as a loosening; 1 where a policy is at fault.

    [bold]reins policy diff policies candidate[/]
    """
    policies = [load_policy(find_policies(folder, called)) for called, folder in (("OLD", old), ("NEW", new))]
    found = _compared(policies[0], policies[1], effort, all_s)
    undecided = [one for one in found.decisions if not one.decided]
    if json:
        say(orjson.dumps({**found.document(), "undecided": len(undecided)}).decode())
    else:
        _say(found, undecided, policies, verbose=verbose)
    raise typer.Exit(UNDECIDED if undecided else CODES[found.direction])


def _compared(old: PolicySet, new: PolicySet, effort: int, all_s: float) -> Comparison:
    from app.proofs.difference import difference  # only here: nothing else of the command has a use for the solver

    with Progress(
        TextColumn("{task.description}"), BarColumn(), console=err, transient=True, disable=not err.is_terminal
    ) as bar:
        task = bar.add_task("comparing", visible=False)
        began_s = monotonic_s()

        def show(done: int, of: int, what: str) -> None:
            bar.update(task, completed=done, total=of, description=what, visible=monotonic_s() - began_s > SLOW_S)

        return difference(old, new, now=monotonic_s, effort=effort, all_s=all_s, progress=show)


def _say(found: Comparison, undecided: list[Transition], policies: list[PolicySet], *, verbose: bool) -> None:
    for change, members in _grouped(found).items():
        say(f"{members[0].direction:<9} {change}: {_where(members)}")
        for one in members if verbose else members[:1]:
            say(f"    {one.message}")
            if one.example:
                say(indent(one.example.rstrip(), "        "))
    _say_parts(found, verbose=verbose)
    if policies[0].digest != policies[1].digest and not found.differences and not found.decisions:
        say("the text is another, and nothing else: comments, order, spelling")
    if undecided:
        say(f"{len(undecided)} changes could not be decided, and count as loosenings")
    say(_SAID[found.direction])


def _say_parts(found: Comparison, *, verbose: bool) -> None:
    idle = [one for one in found.differences if one.direction is SAME]
    for one in found.differences:
        if one.direction is not SAME or verbose:
            say(f"{one.direction:<9} {one.part}: {one.before or '-'} -> {one.after or '-'}")
    if idle and not verbose:
        say(f"written otherwise, with no effect but the above: {', '.join(one.part for one in idle)}")


def _grouped(found: Comparison) -> dict[str, list[Transition]]:
    """Return decisions by what changes, what loosens first."""
    groups: dict[str, list[Transition]] = {}
    for one in sorted(found.decisions, key=lambda one: (one.direction, one.decided)):
        groups.setdefault(one.change if one.decided else f"{one.change} (not decided)", []).append(one)
    return groups


def _where(members: list[Transition]) -> str:
    places: dict[str, list[str]] = {}
    for one in members:
        places.setdefault(one.capability, []).append(one.profile)
    if "" in places:
        return "the floor"
    return "; ".join(f"{name} in {', '.join(dict.fromkeys(profiles))}" for name, profiles in places.items())
