"""`reins policy propose | activate | rollback | versions | replay`: policy of a running server, and of its record."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import orjson
import typer

from app.agent.answers import Unsendable
from app.agent.answers import document as as_document
from app.agent.conversation import MAX_TOKEN, header_text
from app.cli_data import directory
from app.config import DataDir, find_policies
from app.governance.bundle import PROPERTIES, read_cases, read_files, read_properties
from app.governance.errors import PolicyErrors
from app.terminal import FINDING, MISUSE, err, say, say_error

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.audit.replay import Replay

TOKEN_KEY = "engineer"  # noqa: S105  # a key in tokens.json
PATIENCE_S = 1800.0  # for proofs of a large policy
CREATED = 201
ACCEPTED = 202
SUCCESS = range(200, 300)
EXAMPLES = 3
SHOWN = 19  # of a digest: its kind and twelve characters

Data = Annotated[
    Path,
    typer.Option(help="The server's data directory: its address and tokens.", envvar="REINS_DATA", parser=directory),
]
Server = Annotated[
    str | None, typer.Option(help="The server's address; default: as the data directory says.", envvar="REINS_SERVER")
]
Token = Annotated[
    str | None,
    typer.Option(
        help="An engineer's token; default: the data directory's own.", envvar="REINS_TOKEN", show_default=False
    ),
]
Why = Annotated[str, typer.Option(help="Why; it stays in the record.")]
Digest = Annotated[str, typer.Argument(help="A version's digest, or as much of it as is its own.")]


class Door:
    """The server's door, for one engineer."""

    def __init__(self, data: Path, server: str | None, token: str | None) -> None:
        """Find the address, the token, and whom to trust. Ends the command where there is none."""
        import httpx

        from app.agent.address import blaming_environment

        layout = DataDir(root=data)
        self._url = server or _read(layout.server, "url", "name the server with --server, or a data directory in use")
        known = token or _read(layout.tokens, TOKEN_KEY, "give an engineer's token with --token or REINS_TOKEN")
        try:
            self._token = header_text("token", known, MAX_TOKEN)
            with blaming_environment():
                self._trusted = httpx.create_ssl_context()  # SSL_CERT_FILE and SSL_CERT_DIR, as agents and cells do
        except (Unsendable, ValueError) as error:
            say_error(str(error))
            raise typer.Exit(MISUSE) from error

    def call(self, method: str, path: str, body: object = None, *, holds: str) -> tuple[int, dict[str, Any]]:
        """Ask the server for what `holds` a key; a problem is printed, fault by fault, and ends the command."""
        with err.status("waiting for the server …"):
            status, found = self._ask(method, path, body)
        document = as_document(found)
        if (holds if status in SUCCESS else "code") not in document:
            say_error(f"`{self._url}` answers with a {type(found).__name__}; valid is the address of a server")
            raise typer.Exit(MISUSE)
        if status not in SUCCESS:
            for fault in document.get("errors") or ():
                place = f"{fault['file']}:{fault['line']}: " if "file" in fault else ""
                err.print(f"{place}{fault['field']}: {fault['message']}", markup=False)
            say_error(f"{document['code']}: {document.get('detail')}")
            raise typer.Exit(FINDING)
        return status, document

    def _ask(self, method: str, path: str, body: object) -> tuple[int, object]:
        import httpx

        headers = {"Authorization": f"Bearer {self._token}"}
        content = None if body is None else _content(body)
        if content is not None:
            headers["Content-Type"] = "application/json"
        try:
            answer = httpx.request(
                method,
                f"{self._url}{path}",
                headers=headers,
                content=content,
                timeout=PATIENCE_S,
                trust_env=False,
                verify=self._trusted,
            )
            return answer.status_code, orjson.loads(answer.content)
        except (httpx.HTTPError, httpx.InvalidURL, UnicodeError, orjson.JSONDecodeError) as error:
            say_error(f"`{self._url}` gave no answer: {error}")
            raise typer.Exit(MISUSE) from error

    def versions(self) -> dict[str, Any]:
        """Return the list of versions, whole."""
        known = page = self.call("GET", "/v1/policies?limit=200", holds="items")[1]
        while page["next"] is not None:
            page = self.call("GET", f"/v1/policies?limit=200&cursor={page['next']}", holds="items")[1]
            known["items"] += page["items"]
        return known

    def find(self, digest: str) -> str:
        """Return the whole digest that a beginning stands for. Ends the command where it is not one version's."""
        wanted = digest if digest.startswith("sha256:") else f"sha256:{digest}"
        found = [item["digest"] for item in self.versions()["items"] if item["digest"].startswith(wanted)]
        if len(found) != 1:
            which = f"the digests of {len(found)} versions begin" if found else "no version's digest begins"
            say_error(f"{which} with `{digest}`", hint="`reins policy versions` lists them")
            raise typer.Exit(MISUSE)
        return found[0]

    def activate(self, digest: str, why: str, before: str | None = None) -> None:
        """Ask for a version to be in force, in the place of `before` if that is said, and say what became of it."""
        body = {"why": why, "before": before}
        status, document = self.call("POST", f"/v1/policies/{digest}/activate", body, holds="activations")
        if status == ACCEPTED:
            say(f"{digest} loosens something: it comes into force with another engineer's word")
            return
        say(f"{digest} is in force ({document['activations'][-1]['direction']})")


def propose(
    directory: Annotated[Path | None, typer.Argument(help="The policy directory; default: ./policies.")] = None,
    *,
    why: Why,
    data: Data = Path("data"),
    server: Server = None,
    token: Token = None,
) -> None:
    """Bring a policy directory to a running server, with cases and promises; it is proved and kept, nothing changes.

    [bold]reins policy propose policies --why "people work closer"[/]
    """
    folder = find_policies(directory)
    try:
        promises = read_properties(folder)
        files = {**read_files(folder), **read_cases(folder), **({} if promises is None else {PROPERTIES: promises})}
    except PolicyErrors as found:
        for problem in found.problems:
            err.print(str(problem), markup=False)
        raise typer.Exit(FINDING) from found
    door = Door(data, server, token)
    status, document = door.call("POST", "/v1/policies", {"files": files, "why": why}, holds="digest")
    known = "" if status == CREATED else f" as it is known since {document['created_at']}"
    say(f"{document['digest']} is {document['status']}: {document['rules']} rules, {document['cases']} cases{known}")
    say(_proofs(document))
    place = f"/v1/policies/{document['digest']}"
    if status != CREATED and door.call("GET", f"{place}/files", holds="promises")[1]["promises"] != promises:
        say(f"`{PROPERTIES}` is not the one it is kept with: what was proved, and counts, is with that one")
    if document["status"] != "active":
        _print_difference(door.call("GET", f"{place}/diff", holds="direction")[1])


def activate(
    digest: Digest, *, why: Why, data: Data = Path("data"), server: Server = None, token: Token = None
) -> None:
    """Put a version in force; one that loosens anything takes the word of two engineers.

    [bold]reins policy activate sha256:9f2b --why "people work closer"[/]
    """
    door = Door(data, server, token)
    door.activate(door.find(digest), why)


def rollback(*, why: Why, data: Data = Path("data"), server: Server = None, token: Token = None) -> None:
    """Put the version in force that was before this one; if that loosens anything, it takes two engineers.

    [bold]reins policy rollback --why "too many refusals"[/]
    """
    door = Door(data, server, token)
    known = door.versions()
    active = next(item for item in known["items"] if item["digest"] == known["active"])
    former = next((one["former"] for one in reversed(active["activations"]) if one["former"]), None)
    if former is None:
        say_error("nothing was in force before: there is nothing to go back to")
        raise typer.Exit(FINDING)
    door.activate(former, why, active["digest"])  # what came into force meanwhile is not what somebody wants undone


def versions(*, data: Data = Path("data"), server: Server = None, token: Token = None) -> None:
    """List every version: what became of it, who brought it and why; the newest first."""
    known = Door(data, server, token).versions()
    for item in known["items"]:
        say(f"{item['digest'][:SHOWN]}  {item['status']:<15} {item['created_at']}  {item['by']}: {item['why']}")
        for one in item["activations"]:
            say(f"{'':<21}in force {one['at']}  {', '.join(one['by'])}: {one['why']}")
        if (first := item["awaiting"]) is not None:
            say(f"{'':<21}awaits another engineer's word; {first['by']}: {first['why']}")
    say(f"in force: {known['active']}; {known['why']}; proofs: {known['verdict']}")


def replay(
    *,
    policy: Annotated[
        Path | None, typer.Option(help="What decides now; default: for each decision the version that decided then.")
    ] = None,
    since: Annotated[str | None, typer.Option(help="From when on, RFC 3339; default: all that is recorded.")] = None,
    data: Data = Path("data"),
    json: Annotated[bool, typer.Option("--json", help="Print every changed decision, as JSON.")] = False,
) -> None:
    """Make recorded decisions again, with the context of then, and print those that come out otherwise, grouped.

    [bold]reins policy replay --since 2026-03-01T00:00:00Z --policy candidate[/]
    """
    from app.audit.errors import RecordDamaged, RecordUnreadable
    from app.audit.replaying import replay_in_processes
    from app.clock import parse_rfc3339

    try:
        files = None if policy is None else read_files(find_policies(policy))
        with err.status("deciding again what was recorded …"):
            found = replay_in_processes(data, files, since=None if since is None else parse_rfc3339(since))
    except PolicyErrors as faults:
        for problem in faults.problems:
            err.print(str(problem), markup=False)
        raise typer.Exit(FINDING) from faults
    except (RecordDamaged, RecordUnreadable, ValueError) as error:
        say_error(str(error), hint="--data names a data directory, --since a time like 2026-03-01T00:00:00Z")
        raise typer.Exit(MISUSE) from error
    if json:
        say(orjson.dumps(found.document()).decode())
    else:
        _print_replay(found)
    if found.changed:
        raise typer.Exit(FINDING)


def register(app: typer.Typer) -> None:
    """Add the commands to `reins policy`."""
    for command in (propose, activate, rollback, versions, replay):
        app.command()(command)


def _proofs(version: Mapping[str, Any]) -> str:
    """Say what is known of a version's proofs."""
    if version["proved"]:
        return str(version["proved"])
    return {
        "refuted": "refuted: the start that brought it had it proved, and it did not pass; the record says where",
        "undecided": "undecided: the start that brought it had it proved, and not everything could be decided",
    }.get(version["verdict"], "not proved: a start brought it")


def _print_difference(found: Mapping[str, Any]) -> None:
    say(f"against what is in force: {found['direction']}")
    for change in dict.fromkeys(one["change"] for one in found["decisions"]):
        first, *more = [one for one in found["decisions"] if one["change"] == change]
        say(f"  {first['direction']:<9} {first['message']}" + (f"; and {len(more)} more" if more else ""))
    for one in found["differences"]:
        say(f"  {one['direction']:<9} {one['part']}: {one['before'] or '-'} -> {one['after'] or '-'}")


def _print_replay(found: Replay) -> None:
    for (capability, profile, before, after, what), members in found.groups():
        say(f"{len(members):>7}  {capability} in {profile}: {before} -> {after}   {what}")
        shown = ", ".join(f"{one.invocation} (event {one.seq})" for one in members[:EXAMPLES])
        say(f"         for instance {shown}")
    say(f"{found.decisions} decisions made again, {len(found.changed)} changed")
    if found.without_context:
        say(f"{found.without_context} left out: an earlier release recorded them without their context")
    if found.without_policy:
        say(f"{found.without_policy} left out: the version that decided then is not kept here")


def _content(body: object) -> bytes:
    """Return what is to be sent. Ends the command where that is no text."""
    try:
        return orjson.dumps(body)
    except orjson.JSONEncodeError as error:
        say_error(f"nothing was sent: {error}", hint="valid is text in UTF-8")
        raise typer.Exit(MISUSE) from error


def _read(path: Path, key: str, hint: str) -> str:
    try:
        return str(orjson.loads(path.read_bytes())[key])
    except (OSError, orjson.JSONDecodeError, KeyError, TypeError) as error:
        say_error(f"`{path}` does not say: {error!r}", hint=hint)
        raise typer.Exit(MISUSE) from error
