import itertools
import os
import re

import pytest

from app.agent.client import AsyncReinsClient, ReinsClient


@pytest.mark.parametrize("client", [ReinsClient, AsyncReinsClient])
@pytest.mark.parametrize(
    "url",
    [
        "nourl",
        "",
        "http://",
        "localhost:8000",
        "ftp://robot",
        "http://robot:port",
        "http://robot:99999",
        "http://robot:0",
    ],
)
def test_an_address_that_names_no_server_is_refused_at_once(client, url):
    with pytest.raises(ValueError, match=re.escape(f"url `{url}`: ") + ".*valid is .*`http://127.0.0.1:8000`"):
        client(url, "t")


@pytest.mark.parametrize("client", [ReinsClient, AsyncReinsClient])
@pytest.mark.parametrize(
    "url",
    [None, 5, b"http://robot", 10**5000, "\ud800", f"http://{'x' * 70_000}", f"http://robot/{'語' * 7900}"],
    ids=itertools.count(),
)
def test_what_is_no_text_of_an_address_is_refused_in_words(client, url):
    with pytest.raises(ValueError, match=r"^url `.*valid is .*, for instance `http://127\.0\.0\.1:8000`$") as caught:
        client(url, "t")
    assert len(str(caught.value)) < 400
    assert str(caught.value).encode()  # it can be printed


@pytest.mark.parametrize("client", [ReinsClient, AsyncReinsClient])
@pytest.mark.parametrize(
    "url",
    [
        "http://u:geheim@robot",
        "http://geheim@robot",
        "http://u:geheim@robot:99999",
        "http://u:geheim@robot:port",
        "http://u:geheim/x@robot",
        "ftp://u:geheim@robot",
        "u:geheim@robot",
    ],
)
def test_an_address_with_a_password_is_refused_without_repeating_it(client, url):
    with pytest.raises(ValueError, match=r"^url `…@robot.*`: valid is ") as caught:
        client(url, "t")
    assert "geheim" not in str(caught.value)


def test_an_address_with_a_user_is_told_that_the_token_says_who_asks():
    with pytest.raises(ValueError, match="valid is one without a user name or password: the token says who asks"):
        ReinsClient("http://u:geheim@robot", "t")


@pytest.mark.parametrize("client", [ReinsClient, AsyncReinsClient])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("HTTP_PROXY", "nonsense://x"),
        ("https_proxy", "http://robot:port"),
        ("NO_PROXY", "[::1"),
        ("SSL_CERT_FILE", "/nowhere/at/all.pem"),
    ],
)
def test_an_environment_that_names_no_proxy_is_to_blame(client, name, value, monkeypatch: pytest.MonkeyPatch):
    for known in [known for known in os.environ if known.upper().endswith("_PROXY") or known.startswith("SSL_CERT")]:
        monkeypatch.delenv(known)
    monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=rf"^the environment \(`{name}`\): .*; valid are proxies like `http://127"):
        client("http://127.0.0.1:1", "t")
