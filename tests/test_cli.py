"""The command line in this process: words, settings, exit codes."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from starlette.datastructures import Headers
from typer.testing import CliRunner

from app import __version__
from app import main as app_main
from app.api.auth import open_principals, withdraw_tokens
from app.api.problems import Problem
from app.audit.errors import RowUnreadable
from app.audit.places import Places
from app.audit.store import AuditStore
from app.cli import app, main
from app.config import CELL_TOKEN_VARIABLE, CellSettings, ConfigError, Settings, cell_token, find_policies
from app.main import listen, operator_token, read_cell_token
from app.runtime.errors import ExaminationFailed
from app.terminal import INTERRUPTED, MISUSE, plain
from tests.agent.scripted_server import Turn, serve
from tests.audit.conftest import draft, fill, hide_from_index
from tests.governance.policy_world import POLICIES

COMMANDS = [
    "serve",
    "cell",
    "demo",
    "approver",
    "policy check",
    "audit verify",
    "audit tail",
    "sim soak",
    "sim fuzz",
    "token issue",
    "token list",
    "token withdraw",
]


def run(*words: str) -> tuple[int, str]:
    found = CliRunner().invoke(app, list(words), env={"COLUMNS": "200", "TERM": "dumb"})
    return found.exit_code, found.output


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    code, said = run(*command.split(), "--help")
    assert code == 0
    assert "Usage" in said


def test_says_its_version() -> None:
    assert __version__ in run("version")[1]
    assert run("--version") == run("version")


@pytest.mark.process
@pytest.mark.parametrize("command", [["version"], ["policy", "check", "--no-proofs"]])
def test_an_output_that_is_full_is_said_in_one_line(command: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        found = subprocess.run(
            [sys.executable, "-m", "app.cli", *command], stdout=full, stderr=subprocess.PIPE, text=True, timeout=90
        )
    assert (found.returncode, found.stderr) == (2, "error: [Errno 28] No space left on device\n")


def test_issues_a_token_that_is_kept_as_a_digest_only(tmp_path: Path) -> None:
    open_principals(tmp_path)
    code, said = run("token", "issue", "planner_2", "--role", "agent", "--data", str(tmp_path))
    assert code == 0
    assert re.fullmatch(r"reins_agent_\S+", said.strip())
    assert said.strip() not in (tmp_path / "principals.json").read_text()


def test_a_token_that_is_withdrawn_is_listed_no_more_and_lets_nobody_in(tmp_path: Path) -> None:
    open_principals(tmp_path)
    words = ["token", "issue", "night", "--role", "operator", "--hours", "8", "--station", "workcell-1"]
    given = [run(*words, "--data", str(tmp_path))[1].strip() for _ in range(2)]
    bearer = Headers({"authorization": f"Bearer {given[0]}"})
    assert open_principals(tmp_path).authenticate(bearer).name == "night"
    said = run("token", "list", "--data", str(tmp_path))[1]
    assert re.search(r"^planner +agent +for good$", said, re.MULTILINE)
    assert len(re.findall(r"^night +operator +until 20\S+Z, stands at workcell-1$", said, re.MULTILINE)) == 2
    assert run("token", "withdraw", "night", "--data", str(tmp_path)) == (0, "withdrew 2 tokens of `night`\n")
    assert "night" not in run("token", "list", "--data", str(tmp_path))[1]
    with pytest.raises(Problem, match="token"):
        open_principals(tmp_path).authenticate(bearer)
    code, said = run("token", "withdraw", "night", "--data", str(tmp_path))
    assert (code, "`night` has no token: valid are `planner`" in said) == (2, True)


def test_a_token_of_one_cell_is_listed_with_the_name_it_lets_in(tmp_path: Path) -> None:
    open_principals(tmp_path)
    run("token", "issue", "far-away", "--role", "cell", "--station", "workcell-2", "--data", str(tmp_path))
    said = run("token", "list", "--data", str(tmp_path))[1]
    assert re.search(r"^far-away +cell +for good, dials in as workcell-2$", said, re.MULTILINE)


HINT = "must be a data directory that `reins serve` has made"


@pytest.mark.parametrize("folder", ["none", "."])
def test_a_token_needs_a_data_directory_and_leaves_nothing_in_another(tmp_path: Path, folder: str) -> None:
    code, said = run("token", "issue", "x", "--role", "agent", "--data", str(tmp_path / folder))
    assert code == 2
    assert HINT in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "why"), [("operator", "has the role"), (" x", "no principal name")])
def test_a_name_that_cannot_be_is_no_fault_of_the_data_directory(tmp_path: Path, name: str, why: str) -> None:
    open_principals(tmp_path)
    code, said = run("token", "issue", name, "--role", "agent", "--data", str(tmp_path))
    assert code == 2
    assert why in said
    assert HINT not in said


@pytest.mark.parametrize(
    "words",
    [
        ["policy", "check"],
        ["policy", "diff", "policies"],
        ["token", "list", "--data"],
        ["audit", "show", "inv_1", "--data"],
    ],
)
def test_a_path_that_no_file_system_takes_is_misuse(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["reins", *words, "x" * 5000])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "File name too long: 'xxx" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["check"], ["diff", "policies", "policies"]])
@pytest.mark.parametrize("limit", ["inf", "nan", "1e400", "86401"])
def test_a_time_limit_that_the_solver_cannot_count_is_misuse(words: list[str], limit: str) -> None:
    code, said = run("policy", *words, "--time-limit", limit)
    assert code == 2
    assert "--time-limit" in said


@pytest.mark.parametrize("hours", ["inf", "nan", "1e12", "0", "-1"])
def test_hours_that_no_token_holds_are_named_as_they_were_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], hours: str
) -> None:
    open_principals(tmp_path)
    words = ["token", "issue", "x", "--role", "agent", "--data", str(tmp_path), "--hours", hours]
    monkeypatch.setattr(sys, "argv", ["reins", *words])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert f"`hours` is `{float(hours):g}`; valid: 0.01 to 876000, or none" in capsys.readouterr().err


def test_no_token_is_issued_beside_a_record_that_cannot_be_read(tmp_path: Path) -> None:
    open_principals(tmp_path)
    Places(tmp_path).database.write_bytes(b"no database" * 500)
    code, said = run("token", "issue", "late", "--role", "agent", "--data", str(tmp_path))
    assert code == 2
    assert "no token issued" in said


def write(folder: Path, record: Callable[[AuditStore], Awaitable[object]]) -> None:
    """Leave a log behind."""

    async def recorded() -> None:
        store = AuditStore.open(folder)
        await record(store)
        await store.close()

    asyncio.run(recorded())


def alter(folder: Path, seq: int, body: bytes) -> None:
    """Write something else over an event, as nothing of ours would."""
    with closing(sqlite3.connect(Places(folder).database)) as database:
        database.execute("DROP TRIGGER events_refuse_update")
        database.execute("UPDATE events SET body = ? WHERE seq = ?", (body, seq))
        database.commit()


@pytest.mark.parametrize(("seq", "relied_on"), [(5, "events 1 to 3 are good"), (2, "nothing before it is good")])
def test_says_how_far_an_altered_log_is_good(tmp_path: Path, seq: int, relied_on: str) -> None:
    """Batches of three: what precedes the bad event in its own batch has no checkpoint that holds."""
    write(tmp_path, fill)
    alter(tmp_path, seq, b"{}")
    code, said = run("audit", "verify", "--data", str(tmp_path))
    assert code == 1
    assert f"event {seq}: " in said
    assert relied_on in said


ODD = "force :100: :x: [red]ok[/] mug\u200b_1 \U000e0041\xad \u009b2J \u202eyako\u202c \x1b[2J \x7f \u2028 é 手 \t|"


@pytest.mark.parametrize("words", [("show", "inv_1"), ("tail",)])
def test_prints_what_was_recorded_as_it_stands(tmp_path: Path, words: tuple[str, ...]) -> None:
    """Nothing of it is taken for a picture or a style, and nothing steers the terminal."""
    write(tmp_path, lambda store: store.append([draft(intent=ODD)]))
    code, said = run("audit", *words, "--data", str(tmp_path))
    assert code == 0
    assert json.loads(said[said.index("{") :]) == {"intent": ODD}
    assert not [character for character in said if not character.isprintable() and character != "\n"]


@pytest.mark.parametrize(
    ("words", "seqs"),
    [
        ("tail", [1, 2, 3, 4]),
        ("tail --newest -n 2", [4, 3]),
        ("tail --text MUG_1", [1, 3]),
        ("tail --text mug_1 --newest -n 1", [3]),
        ("show inv_1 --text mug_1", [1, 3]),
        ("show inv_1 --newest", [3, 2, 1]),
    ],
)
def test_prints_what_holds_words_in_either_order(tmp_path: Path, words: str, seqs: list[int]) -> None:
    objects = ["mug_1", "glass_1", "mug_1"]
    write(tmp_path, lambda store: store.append([*(draft(object_id=one) for one in objects), draft(invocation=None)]))
    code, said = run("audit", *words.split(), "--data", str(tmp_path))
    assert (code, [int(line.split()[0]) for line in said.splitlines()]) == (0, seqs)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["tail", "--text", "mug_9 denied"], 1, "nothing is recorded that holds `mug_9` and `denied`"),
        (["show", "inv_1", "--text", "Mug_9"], 1, "nothing is recorded under `inv_1` that holds `mug_9`"),
        (["tail", "--text", " "], 2, "valid are words that an event holds"),
        (["tail", "--newest", "--follow"], 2, "valid is one of `--newest` and `--follow`"),
    ],
)
def test_says_that_nothing_holds_the_words_and_what_would_be_valid(
    tmp_path: Path, words: list[str], code: int, said: str
) -> None:
    write(tmp_path, fill)
    assert (code, True) == ((found := run("audit", *words, "--data", str(tmp_path)))[0], said in found[1]), found


@pytest.mark.parametrize("words", [("show", "inv_1"), ("tail",), ("tail", "--text", "n")])
@pytest.mark.parametrize("body", [b'{"cut":', b"[]"])
def test_what_cannot_be_read_of_a_damaged_log_is_named_and_the_rest_printed(
    tmp_path: Path, words: tuple[str, ...], body: bytes
) -> None:
    write(tmp_path, lambda store: store.append([draft(n=n) for n in (1, 2, 3)]))
    alter(tmp_path, 2, body)
    code, said = run("audit", *words, "--data", str(tmp_path))
    assert code == 1
    assert "event `2` cannot be read" in said
    assert '{"n":1}' in said
    assert '{"n":3}' in said
    assert "Traceback" not in said


@pytest.mark.parametrize("hidden", [True, False])
def test_verification_finds_an_index_that_hides_an_event(tmp_path: Path, hidden: bool) -> None:
    write(tmp_path, fill)
    if hidden:
        hide_from_index(Places(tmp_path).database, "inv_1")
    code, said = run("audit", "verify", "--data", str(tmp_path))
    assert code == (1 if hidden else 0)
    assert ("missing from index events_by_invocation" in said) is hidden
    assert ("leave events out" in said) is hidden
    assert "not compared: what else is kept beside them" in said


@pytest.mark.parametrize(
    ("cases", "said"), [("cases: [", "not readable as YAML"), ("cases:\n  - {nam: x}\n", "unknown key `nam`")]
)
def test_checks_the_cases_of_a_policy_too(tmp_path: Path, cases: str, said: str) -> None:
    shutil.copytree(POLICIES, tmp_path / "policies")
    (tmp_path / "policies" / "tests" / "site.yaml").write_text(cases)
    code, found = run("policy", "check", str(tmp_path / "policies"))
    assert code == 1
    assert "tests/site.yaml:" in found
    assert said in found


def test_there_is_nothing_to_verify_where_no_log_is(tmp_path: Path) -> None:
    assert run("audit", "verify", "--data", str(tmp_path))[0] == 2
    (other := tmp_path / "other").write_text("no key")
    code, said = run("audit", "verify", "--data", str(tmp_path), "--key", str(other))
    assert (code, "valid is what `log.pub` holds" in said) == (2, True)


def test_what_was_kept_of_a_log_is_compared_with_it_and_an_end_that_was_cut_off_is_a_finding(tmp_path: Path) -> None:
    longer, data = tmp_path / "longer", tmp_path / "data"

    async def write() -> None:
        store = AuditStore.open(data)
        await fill(store, batches=2)
        await store.close()
        shutil.copytree(data, longer)
        store = AuditStore.open(longer)
        await store.append([draft()])
        await store.close()

    asyncio.run(write())
    kept = longer / "checkpoints.log"
    code, said = run("audit", "verify", "--data", str(longer), "--checkpoint", str(kept))
    assert (code, "vouches for this very log" in said) == (0, True)
    assert run("audit", "verify", "--data", str(data))[0] == 0
    code, said = run("audit", "verify", "--data", str(data), "--checkpoint", str(kept))
    assert code == 1
    assert "event 7: a checkpoint kept elsewhere vouches for `7` events, here are `6`: the end was cut off" in said
    code, said = run("audit", "verify", "--data", str(data), "--checkpoint", str(data / "log.pub"))
    assert (code, "valid is a copy of `checkpoints.log`" in said) == (2, True)
    assert run("audit", "verify", "--data", str(data), "--checkpoint", str(tmp_path / "nowhere"))[0] == 2


def test_the_shipped_policies_check() -> None:
    assert run("policy", "check")[0] == 0


@pytest.mark.parametrize("pace", [-1.0, float("nan"), float("inf"), 0.001, 1e9])
def test_refuses_a_pace_that_is_none(pace: float) -> None:
    with pytest.raises(ConfigError, match="pace"):
        Settings(pace=pace)


@pytest.mark.parametrize(
    "words",
    [
        ["serve", "--port", "0", "--data", "{}", "--seed", "-1"],
        ["cell", "--server", "http://127.0.0.1:9", "--data", "{}", "--seed", "-1"],
        ["serve", "--port", "0", "--data", "{}"],
    ],
)
def test_refuses_a_seed_that_no_world_grows_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    monkeypatch.setenv(CELL_TOKEN_VARIABLE, "t")
    if "--seed" not in words:
        monkeypatch.setenv("REINS_SEED", "-1")
    monkeypatch.setattr(sys, "argv", ["reins", *(word.format(tmp_path / "data") for word in words)])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "`seed` is `-1`; valid: 0 or more" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("name", ["", "UPPER", "../up", "a" * 41])
def test_refuses_a_cell_name_that_is_no_file_name(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="id"):
        CellSettings(id=name, token="t", data=tmp_path, server="http://127.0.0.1:8000")


def test_refuses_a_cell_without_token_or_server(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="token"):
        CellSettings(id="c", token="", data=tmp_path, server="http://127.0.0.1:8000")
    with pytest.raises(ConfigError, match="server"):
        CellSettings(id="c", token="t", data=tmp_path)


@pytest.mark.parametrize("token", ["reins_cell_ab\nX-More: 1", "reins_cell_é"])
def test_a_cells_token_that_fits_no_header_is_refused_and_not_repeated(token: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"`token` is `…`; valid: printable ASCII characters in the variable"):
        CellSettings(id="c", token=token, data=tmp_path, server="http://127.0.0.1:8000")


def test_a_cells_token_is_taken_as_a_file_ends_it() -> None:
    assert cell_token({CELL_TOKEN_VARIABLE: "reins_cell_ab\n"}) == "reins_cell_ab"


@pytest.mark.parametrize(
    "address",
    [
        "", "foo", "127.0.0.1:8000", "ws://127.0.0.1:8000", "http://", "http://:8000", "http://127.0.0.1:99999",
        "http://127.0.0.1:0", "http://127.0.0.1:http", "http://[::1", "http://a b:8000", "http://é..x", "http://x/?y=1",
        "http://u:p@127.0.0.1:8000",
        "HTTP://127.0.0.1:8000", "\x7fhttp://127.0.0.1:8000",
    ],
)  # fmt: skip
def test_refuses_an_address_where_no_server_can_be(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(CELL_TOKEN_VARIABLE, "t")
    monkeypatch.setattr(sys, "argv", ["reins", "cell", "--server", address, "--data", str(tmp_path / "cell")])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert f"`server` is `{plain(address)}`; valid: http:// or https://, a host and a port" in capsys.readouterr().err
    assert not (tmp_path / "cell").exists()


@pytest.mark.parametrize("address", ["http://127.0.0.1:8000", "https://robots.example/floor/", "http://[::1]:8000"])
def test_takes_an_address_where_a_server_can_be(address: str, tmp_path: Path) -> None:
    assert CellSettings(id="c", token="t", data=tmp_path, server=address).server == address


@pytest.mark.parametrize("key", ["!!", "", "b3RoZXI=", "A" * 43, " " + "A" * 43 + "="])
def test_refuses_a_server_key_that_no_server_has(key: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"server key.*32 bytes in base64"):
        CellSettings(id="c", token="t", data=tmp_path, server="http://127.0.0.1:8000", server_key=key)
    CellSettings(id="c", token="t", data=tmp_path, server="http://127.0.0.1:8000", server_key="A" * 43 + "=")


@pytest.mark.parametrize("host", ["a" * 300, "é..x"])
def test_refuses_a_host_that_no_name_server_can_be_asked_for(host: str) -> None:
    with pytest.raises(ConfigError, match="a free address of this machine"):
        listen(host, 0)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"", "schlüssel".encode()])
def test_a_cells_token_that_is_none_is_named_with_what_makes_one(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "cell.token").write_bytes(content)
    with pytest.raises(ConfigError, match=r"cell\.token.*reins token issue"):
        read_cell_token(tmp_path / "cell.token")


def test_a_cells_token_that_is_gone_is_named_with_what_makes_one(tmp_path: Path) -> None:
    open_principals(tmp_path)
    (tmp_path / "cell.token").unlink()
    with pytest.raises(ConfigError, match=r"cell\.token. is .missing.*reins token issue cell --role cell --data"):
        read_cell_token(tmp_path / "cell.token")


@pytest.mark.parametrize("content", [b"{", b"[]", b"{}", b'{"operator": 3}', b"\xff"])
def test_a_note_of_tokens_that_cannot_be_read_keeps_no_server_from_starting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes
) -> None:
    principals, note = open_principals(tmp_path), tmp_path / "tokens.json"
    first = note.read_bytes()
    note.write_bytes(content)
    assert operator_token(note, principals) == ""
    assert "tokens.json" in capsys.readouterr().out
    note.write_bytes(first)
    assert operator_token(note, principals) == json.loads(first)["operator"]
    withdraw_tokens(tmp_path, "operator")
    assert operator_token(note, open_principals(tmp_path)) == ""
    assert "holds no more" in capsys.readouterr().out


@pytest.mark.parametrize(
    "why", [ExaminationFailed("it ended with `1`: TypeError"), RowUnreadable("policy_files", "sha256:a", TypeError())]
)
def test_a_start_on_a_policy_that_cannot_be_had_any_more_says_so_and_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], why: Exception
) -> None:
    async def broken(*_: object) -> int:
        raise why

    monkeypatch.setattr("app.main._serve", broken)
    settings = Settings(data=tmp_path / "data", policies=POLICIES, port=0)
    assert app_main.serve(settings) == 2
    said = capsys.readouterr().err
    assert str(why) in said
    assert "--take-policies" in said


@pytest.mark.parametrize("option", ["--seeds", "--jobs"])
def test_a_soak_of_more_than_anybody_waits_for_is_misuse(option: str) -> None:
    code, said = run("sim", "soak", option, "9" * 23)
    assert code == 2
    assert option in said


@pytest.mark.parametrize("words", [["serve", "--port", "0"], ["token", "list"], ["audit", "verify"]])
def test_a_data_directory_whose_name_is_no_text_is_misuse(tmp_path: Path, words: list[str]) -> None:
    code, said = run(*words, "--data", f"{tmp_path}/\udcff")
    assert code == 2
    assert "is no text in UTF-8" in said


def test_a_soak_says_what_is_wrong_with_the_policies(tmp_path: Path) -> None:
    (tmp_path / "site.yaml").write_text("targets: 3")
    code, said = run("sim", "soak", "--policies", str(tmp_path))
    assert code == 1
    assert "site.yaml" in said


def test_a_token_that_fits_no_header_is_misuse(tmp_path: Path) -> None:
    code, said = run("policy", "versions", "--server", "http://127.0.0.1:9", "--token", "é", "--data", str(tmp_path))
    assert code == 2
    assert "token: valid are" in said
    assert "é" not in said


@pytest.mark.parametrize(("status", "answer"), [(200, []), (404, []), (200, {"hello": "world"}), (404, {})])
def test_an_answer_of_another_kind_of_server_is_misuse(tmp_path: Path, status: int, answer: object) -> None:
    with serve(lambda _turn: (status, answer)) as server:
        code, said = run("policy", "versions", "--server", server.url, "--token", "t", "--data", str(tmp_path))
    assert code == 2
    assert f"answers with a {type(answer).__name__}; valid is the address of a server" in said


def test_versions_are_asked_for_with_the_certificates_that_the_environment_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "none.pem"))
    code, said = run("policy", "versions", "--server", "https://127.0.0.1:9", "--token", "t", "--data", str(tmp_path))
    assert code == 2
    assert "`SSL_CERT_FILE`" in said


def test_goes_back_only_from_the_version_that_it_found_in_force(tmp_path: Path) -> None:
    digests = [f"sha256:{number * 64}" for number in "ab"]
    items = [{"digest": digests[1], "activations": [{"former": digests[0], "direction": "loosens"}]}]
    listed = {"items": items, "next": None, "active": digests[1]}

    def answer(turn: Turn) -> tuple[int, object]:
        newer = {"code": "policy_changed", "detail": "another one is in force"}  # one that came behind the list
        return (200, listed) if turn.method == "GET" else (409, newer)

    with serve(answer) as server:
        code, said = run(
            "policy", "rollback", "--why", "w", "--server", server.url, "--token", "t", "--data", str(tmp_path)
        )
    assert (code, server.turns[-1].body) == (1, {"why": "w", "before": digests[1]}), said
    assert server.turns[-1].path == f"/v1/policies/{digests[0]}/activate"


def test_a_token_stays_out_of_what_is_printed(tmp_path: Path) -> None:
    assert "secret" not in repr(CellSettings(id="c", token="secret", data=tmp_path, server="http://x"))


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("policy versions --server NAME --token t", 2),
        (f"policy propose {POLICIES} --why NAME --server http://127.0.0.1:1 --token t", 2),
        ("policy schemas NAME", 0),
    ],
)
def test_no_command_breaks_by_an_argument_that_is_no_utf_8(
    words: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, [word.replace("NAME", os.fsdecode(b"caf\xe9")) for word in words.split()])
    assert found.exit_code == code, found.output


def test_refuses_a_policy_directory_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="policies"):
        find_policies(tmp_path / "none")


@pytest.mark.parametrize(("flag", "cells"), [("--scenario", "1"), ("--robot", "0")])
@pytest.mark.parametrize("value", ["nope", "/nope.xml", "/nope.yaml"])
def test_what_no_cell_can_be_started_with_starts_no_server(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flag: str,
    cells: str,
    value: str,
) -> None:
    words = ["serve", "--port", "0", "--data", str(tmp_path / "data"), "--cells", cells, flag, value]
    monkeypatch.setattr(sys, "argv", ["reins", *words])
    with pytest.raises(SystemExit, match="2"):
        main()
    said = capsys.readouterr()
    assert f"`{value}`" in said.err
    assert "valid" in said.err
    assert "serves" not in said.out
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("flag", ["--scenario", "--robot"])
def test_a_cell_that_cannot_start_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flag: str
) -> None:
    monkeypatch.setenv("REINS_CELL_TOKEN", "t")
    words = ["cell", "--server", "http://127.0.0.1:1", "--data", str(tmp_path / "cells" / "one"), flag, "nope"]
    monkeypatch.setattr(sys, "argv", ["reins", *words])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "`nope`" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


GIVEN_EMPTY = [
    "serve",
    "cell",
    "approver --policy habits.yaml",
    "token issue late --role agent",
    "audit verify",
    "audit show inv_1",
    "audit export log.jsonl",
    "audit tail",
    "policy suggest",
    "policy propose --why so",
    "policy replay",
    "policy activate sha256:0 --why so",
    "policy rollback --why so",
    "policy versions",
]


@pytest.mark.parametrize("command", GIVEN_EMPTY)
def test_no_data_directory_is_the_working_directory_by_an_empty_name(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, said = run(*command.split(), "--data", "")
    assert code == 2, said
    assert "it is empty" in said
    assert list(tmp_path.iterdir()) == []


def test_no_demo_keeps_its_keys_in_the_working_directory_by_an_empty_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, said = run("demo", "--folder", "", "--port", "65536")
    assert code == 2, said
    assert "it is empty" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("token", "missing"), [("", "tokens.json"), ("--token t", "server.json")])
def test_an_approver_without_a_server_says_what_would_be_valid(token: str, missing: str, tmp_path: Path) -> None:
    (tmp_path / "habits.yaml").write_text("approver: operator\n")
    words = ["approver", "--policy", str(tmp_path / "habits.yaml"), "--data", str(tmp_path / "nowhere")]
    code, said = run(*words, *token.split())
    assert code == 2
    assert f"there is no `{tmp_path / 'nowhere' / missing}`; valid: the data directory of a server that runs" in said


@pytest.mark.parametrize("command", ["serve", "audit verify"])
def test_a_data_directory_that_is_a_file_is_named(command: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, said = run(*command.split(), "--data", str(tmp_path / "file"))
    assert code == 2
    assert "is a file" in said


def test_says_that_it_does_not_compare_when_a_row_last_changed(tmp_path: Path) -> None:
    write(tmp_path, fill)
    assert "`updated_at`" in run("audit", "verify", "--data", str(tmp_path))[1]


# The command as it is, with a log that takes long to open; each line says what to do next, and how that ended is told.
AT_WORK = """
import sys
from time import sleep
from app.audit.reader import Reader
from app.cli import main

def take_long(_):
    print("at work", flush=True)
    sleep(30)

extent = Reader.extent
for line in sys.stdin:
    sys.argv = ["reins", "audit", *line.split(), "--data", "data"]
    Reader.extent = extent if "--follow" in line else take_long
    try:
        main()
    except SystemExit as ended:
        print("ended with", ended.code, flush=True)
        print("ended", file=sys.stderr, flush=True)
"""


@pytest.mark.process
def test_what_ctrl_c_ends_before_its_time_does_not_end_well(tmp_path: Path) -> None:
    write(tmp_path / "data", fill)
    with subprocess.Popen(
        [sys.executable, "-c", AT_WORK],
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        for words, code, said in (
            ("verify", 130, "not all was compared"),
            ("show inv_1", 130, "interrupted"),
            ("export log.jsonl", 130, "nothing was exported"),
            ("tail", 130, "interrupted"),
            ("tail --follow", 0, ""),
        ):
            process.stdin.write(f"{words}\n")
            process.stdin.flush()
            assert process.stdout.readline(), "it is at work"
            process.send_signal(signal.SIGINT)
            *_, ended = until_it_ended(process.stdout)
            found = "".join(until_it_ended(process.stderr))
            assert ended == f"ended with {code}\n", found
            assert said in found
            assert "Traceback" not in found
            assert not list(tmp_path.glob("log.jsonl*"))
        process.stdin.close()
        assert process.wait(30) == 0


def until_it_ended(lines: Iterable[str]) -> Iterator[str]:
    """Give what is said of one command, up to the words that it ended."""
    for line in lines:
        yield line
        if line.startswith("ended"):
            return


@pytest.mark.process
def test_ctrl_c_before_the_command_began_ends_it_without_a_word(tmp_path: Path) -> None:
    early = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    (tmp_path / "typer.py").write_text(early, encoding="utf-8")  # what the command imports first
    command = [sys.executable, "-m", "app", "version"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=90)
    assert (ended.returncode, ended.stdout, ended.stderr) == (INTERRUPTED, "", "")


def test_a_cell_starts_without_what_only_a_server_needs_and_with_one_thread_for_linear_algebra() -> None:
    text = """
import sys
import app.cli, app.workcell
with open("/proc/self/status") as status:
    threads = next(line.split()[1] for line in status if line.startswith("Threads:"))
print(threads, *sorted({"sqlalchemy", "httpx"} & set(sys.modules)))
"""
    given = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", text], env=given, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1"]


def test_no_file_of_policy_steers_the_terminal_of_whoever_checks_it(tmp_path: Path) -> None:
    folder = shutil.copytree(POLICIES, tmp_path / "policies")
    profile = folder / "profiles" / "human-shared.yaml"
    text = profile.read_text()
    profile.write_text(text.replace("sensitivity:", '"sen\\u001b]0;yours\\u0007\\u200bsitivity":', 1))
    assert profile.read_text() != text
    code, said = run("policy", "check", str(folder))
    assert code == 1
    assert "u001b]0;yours" in said
    assert not [character for character in said if not character.isprintable() and character != "\n"]


@pytest.mark.parametrize(
    ("words", "value", "valid"),
    [
        ("serve --port many", "many", "integer"),
        ("serve --pace slow", "slow", "number"),
        ("audit tail -n 0", "0", "1"),
        ("audit tail -n 501", "501", "500"),
        ("token issue gus --role king", "king", "operator"),
        ("demo --approver bob", "bob", "scripted"),
    ],
)
def test_names_the_value_of_an_option_that_it_cannot_read(words: str, value: str, valid: str) -> None:
    code, said = run(*words.split())
    assert code == MISUSE
    told = said[said.index("Invalid value") :]
    assert f"`{value}`" in told
    assert valid in told
