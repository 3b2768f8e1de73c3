"""`reins policy explain | schemas`: what helps a safety engineer to read and write policy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import orjson
import typer

from app.authoring.explain import NotEnabled
from app.authoring.explain import explain as sections_of
from app.cli_policies import Policies, load_policy
from app.config import DEFAULT_PROFILE, find_policies
from app.terminal import MISUSE, out, say, say_error

app = typer.Typer()


@app.command()
def explain(
    capability: Annotated[str, typer.Argument(help="A capability, for instance grasp_object.")],
    *,
    profile: Annotated[str, typer.Option(help="The environment profile.")] = DEFAULT_PROFILE,
    policies: Policies = None,
) -> None:
    """Say in plain sentences what holds for a capability in a profile: rules, bounds, reasons, people, watching.

    [bold]reins policy explain grasp_object --profile human-shared[/]
    """
    policy = load_policy(find_policies(policies))
    try:
        sections = sections_of(policy, capability, profile)
    except NotEnabled as error:
        say_error(str(error))
        raise typer.Exit(MISUSE) from error
    for section in sections:
        out.print(f"[bold]{section.heading}[/]")
        for sentence in section.sentences:
            say(f"  {sentence}")


@app.command()
def schemas(
    directory: Annotated[Path, typer.Argument(help="Where to; the policy directory is expected beside it.")] = Path(
        "schemas"
    ),
) -> None:
    """Write the JSON Schema of every kind of policy file, for editors; the files name theirs in their first line.

    [bold]reins policy schemas schemas[/]
    """
    from app.governance.bundle_schema import KINDS, SUFFIX, schema

    try:
        directory.mkdir(parents=True, exist_ok=True)
        for kind in KINDS.values():
            path = directory / f"{kind.name}{SUFFIX}"
            path.write_bytes(orjson.dumps(schema(kind.name), option=orjson.OPT_INDENT_2) + b"\n")
            say(f"{path}  {kind.files}")
    except OSError as error:
        say_error(f"`{directory}` cannot be written: {error}")
        raise typer.Exit(MISUSE) from error
