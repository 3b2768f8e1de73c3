"""A console whose link goes: it says so within a second, vouches for nothing, and comes back by itself."""

from __future__ import annotations

import re
from collections.abc import Callable
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Route, expect

from tests.conftest import ServerProcess, Servers, until
from tests.console.conftest import Floor, People
from tests.console.wire import Wire, wire_to

pytestmark = [pytest.mark.browser, pytest.mark.process]

# Counted in the page: the moment the wire went is the last one in which frames were drawn.
SAYS_SO = """() => new Promise((resolve, reject) => {
    const began = performance.now();
    const look = () => {
        if (document.body.innerText.includes('Link down.')) resolve(performance.now() - began);
        else if (performance.now() - began > 10000) reject(new Error('never said'));
        else requestAnimationFrame(look);
    };
    look();
})"""
BROKEN = r"WebSocket connection|ERR_CONNECTION|ERR_EMPTY_RESPONSE|Failed to load resource"


@pytest.mark.parametrize("how", [Wire.cut, Wire.swallow], ids=["aborted", "black hole"])
def test_a_link_that_goes_is_told_and_what_came_meanwhile_is_there_when_it_is_back(
    server: ServerProcess, people: People, floor: Floor, how: Callable[[Wire], None]
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        header = person.page.locator("header dl.facts")
        expect(header).to_contain_text("Idle")
        how(wire)
        told_after_ms = person.page.evaluate(SAYS_SO)
        assert told_after_ms <= 1_000
        expect(header.get_by_text("Nobody")).to_have_count(0)
        expect(person.alert("Link down.")).to_contain_text("STOP is still sent")
        expect(header).to_contain_text("Not known")
        expect(person.page.locator(".live .stale").first).to_be_visible()
        asked = floor.ask()
        wire.mend()
        expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
        expect(person.alert("Link down.")).to_have_count(0)
        expect(person.page.locator(".live .stale")).to_have_count(0)
        person.button(re.compile("^Deny")).click()
        assert floor.settled(asked["id"])["status"] == "denied"


def test_a_server_that_is_killed_and_started_again_finds_the_console_waiting(
    built: None, servers: Servers, people: People
) -> None:
    killed = servers.start(None, "--pace", "1")
    asked = {"capability": "grasp_object", "params": {"object_id": "mug_1"}}
    body = killed.post("/v1/invocations", asked, key="agent").json()
    person = people.sit(killed)
    person.expects(BROKEN)
    question = person.page.get_by_role("article", name="Grasp mug_1")
    expect(question).to_be_visible()
    killed.kill()
    assert person.page.evaluate(SAYS_SO) <= 1_000
    person.press(".")
    expect(person.page.locator("header").get_by_role("button", name="stopping")).to_be_visible()
    started = servers.start(killed.data, "--port", str(urlsplit(killed.url).port), "--pace", "1")
    assert started.url == killed.url
    expect(person.alert("Link down.")).to_have_count(0)
    expect(person.page.locator(".live .stale")).to_have_count(0)
    expect(question).to_be_visible()
    expect(person.region("Events")).to_contain_text("Server started")
    until(lambda: started.cell()["latched"] or person.page.wait_for_timeout(20), what="the stop, sent again")
    assert started.get(f"/v1/invocations/{body['id']}")["status"] == "awaiting_approval"


def test_a_page_that_the_server_does_not_hand_over_says_so_and_comes_when_it_is_back(
    server: ServerProcess, people: People
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        held: list[Route] = []

        def hold(route: Route) -> None:
            if held:  # pages are fetched ahead as well, some seconds after the first screen
                route.abort()
            else:
                held.append(route)

        person.page.route("**/assets/Fleet-*", hold)
        person.press("4")
        expect(person.page.get_by_text("Loading…")).to_be_visible()
        wire.cut()
        until(lambda: held or person.page.wait_for_timeout(20), what="a request for the page")
        held[0].abort()
        expect(person.alert("This page could not be loaded.")).to_be_visible()
        expect(person.button(re.compile("^Emergency stop of workcell-1: "))).to_be_enabled()
        person.page.unroute("**/assets/Fleet-*")
        wire.mend()
        expect(person.page.get_by_role("heading", name="Fleet")).to_be_visible()
        expect(person.page.locator("main section header").first).to_have_css("display", "flex")
