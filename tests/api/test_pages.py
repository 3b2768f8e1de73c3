"""The console's pages over a real socket, from a build that is written here."""

from __future__ import annotations

import asyncio
import gzip
from collections.abc import AsyncIterator
from pathlib import Path

import httpx
import pytest

from app.api import pages
from tests.api.conftest import House, open_house

pytestmark = pytest.mark.anyio
SCRIPT = b"export const answer = 42;\n" * 40
GZIPPED = gzip.compress(SCRIPT, mtime=0)
PACKED = b"packed by the build, and not looked into"


@pytest.fixture(scope="module")
async def built(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[House]:
    folder = tmp_path_factory.mktemp("console")
    (folder / "assets").mkdir()
    (folder / "index.html").write_text("<!doctype html><title>Reins</title>")
    (folder / "icon.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    (folder / "assets" / "index-a1B2_c3-.js").write_bytes(SCRIPT)
    (folder / "assets" / "index-a1B2_c3-.js.br").write_bytes(PACKED)
    (folder / "assets" / "index-a1B2_c3-.js.gz").write_bytes(GZIPPED)
    (folder / "assets" / "worker-c3D4_e5-.js").write_bytes(SCRIPT)
    (folder / "assets" / "plain.css").write_text("html {}")
    (folder / ".stamp").write_text("secret")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pages, "FOLDER", folder)
        async with open_house(tmp_path_factory.mktemp("house"), "sim-relaxed") as house:
            yield house


async def ask(house: House, path: str, accept: str = "identity") -> httpx.Response:
    async with httpx.AsyncClient(trust_env=False) as client:
        return await client.get(house.url + path, headers={"Accept-Encoding": accept})


@pytest.mark.parametrize("path", ["/", "/live", "/audit", "/policy", "/fleet", "/live?cell=workcell-1"])
async def test_every_view_is_the_one_page_and_asks_for_no_token(built: House, path: str) -> None:
    answer = await ask(built, path)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert "<title>Reins</title>" in answer.text
    assert answer.headers["cache-control"] == "no-cache"


async def test_every_page_runs_nothing_but_its_own(built: House) -> None:
    headers = (await ask(built, "/")).headers
    policy = dict(rule.partition(" ")[::2] for rule in headers["content-security-policy"].split("; "))
    assert len(headers.get_list("content-security-policy")) == 1  # two would both be enforced
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    assert policy["script-src"] == policy["connect-src"] == policy["worker-src"] == "'self'"
    assert policy["require-trusted-types-for"] == "'script'"
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cross-origin-opener-policy"] == headers["cross-origin-resource-policy"] == "same-origin"


@pytest.mark.parametrize("path", ["/assets/plain.css", "/assets/index-a1B2_c3-.js"])
async def test_what_a_page_is_made_of_is_for_its_own_server_alone_and_nothing_but_what_it_says(
    built: House, path: str
) -> None:
    headers = (await ask(built, path)).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "content-security-policy" not in headers


@pytest.mark.parametrize(
    ("path", "policy"),
    [
        ("/assets/worker-c3D4_e5-.js", "default-src 'none'; connect-src 'self'"),
        ("/icon.svg", "default-src 'none'; frame-ancestors 'none'"),
    ],
)
async def test_a_worker_speaks_to_its_server_alone_and_a_picture_to_nobody(
    built: House, path: str, policy: str
) -> None:
    headers = (await ask(built, path)).headers
    assert headers.get_list("content-security-policy") == [policy]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"


async def test_the_api_keeps_its_own_headers(built: House) -> None:
    answer = await ask(built, "/healthz")
    assert answer.headers["content-security-policy"] == "default-src 'none'; frame-ancestors 'none'"
    assert answer.headers["cache-control"] == "no-store"


@pytest.mark.parametrize(
    ("accept", "encoding"),
    [
        ("gzip, deflate, br, zstd", "br"),
        ("gzip", "gzip"),
        ("br;q=0, gzip;q=0.5", "gzip"),
        ("br;q=0.0, gzip; q=0", None),
        ("identity", None),
        ("", None),
    ],
)
async def test_what_was_compressed_is_sent_so_to_whoever_takes_it(
    built: House, accept: str, encoding: str | None
) -> None:
    async with (
        httpx.AsyncClient(trust_env=False) as client,
        client.stream("GET", f"{built.url}/assets/index-a1B2_c3-.js", headers={"Accept-Encoding": accept}) as answer,
    ):
        raw = b"".join([chunk async for chunk in answer.aiter_raw()])
    assert answer.headers.get("content-encoding") == encoding
    assert answer.headers["vary"] == "Accept-Encoding"
    assert answer.headers["content-type"].startswith("text/javascript")
    assert {"br": PACKED, "gzip": GZIPPED, None: SCRIPT}[encoding] == raw
    assert len(raw) == int(answer.headers["content-length"])


async def test_only_what_bears_a_hash_is_kept_for_good(built: House) -> None:
    assert "immutable" in (await ask(built, "/assets/index-a1B2_c3-.js")).headers["cache-control"]
    assert (await ask(built, "/assets/plain.css")).headers["cache-control"] == "no-cache"
    assert (await ask(built, "/icon.svg")).headers["cache-control"] == "no-cache"


@pytest.mark.parametrize(
    "path",
    [
        "/assets/nothing.js",
        "/assets/index-a1B2_c3-.js.br",
        "/assets/../index.html",
        "/assets/..%2findex.html",
        "/assets/%2e%2e%2f%2e%2e%2fapi%2fpages.py",
        "/assets/..%5c..%5capi%5cpages.py",
        "/assets//etc/passwd",
        "/assets/%2fetc%2fpasswd",
        "/assets/index-a1B2_c3-.js%00.css",
        "/.stamp",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/index.html/..",
        "/live/",
        "/nowhere",
    ],
)
async def test_nothing_but_what_was_built_can_be_reached(built: House, path: str) -> None:
    host, port = built.url.removeprefix("http://").split(":")
    reader, writer = await asyncio.open_connection(host, int(port))  # a client of HTTP would tidy the path up first
    writer.write(f"GET {path} HTTP/1.1\r\nHost: reins\r\nConnection: close\r\n\r\n".encode())
    answer = await reader.read()
    writer.close()
    await writer.wait_closed()
    assert answer.startswith(b"HTTP/1.1 404 ")
    assert b"content-type: application/problem+json" in answer
    assert b"secret" not in answer


async def test_without_a_build_the_page_says_how_to_make_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "FOLDER", tmp_path / "console")
    async with open_house(tmp_path / "data", "sim-relaxed") as house:
        answer = await ask(house, "/")
        assert answer.status_code == 503
        assert "make console" in answer.text
        assert "script-src 'self'" in answer.headers["content-security-policy"]
        assert (await ask(house, "/healthz")).status_code == 200
