"""A console whose link goes: it says so within a second, vouches for nothing, and comes back by itself."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Route, expect
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from app.api.console import SUBPROTOCOL
from app.api.parts import EACH_CONSOLES
from tests.conftest import ServerProcess, Servers, until
from tests.console.conftest import THREE_FRAMES, Floor, People, Person
from tests.console.wire import wire_to

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
# The first moment at which what is drawn and measured is grey, and whether the cell was called silent by then.
GREYS = """() => new Promise((resolve, reject) => {
    const began = performance.now();
    const look = () => {
        const grey = ['.session', '.canvas'].every((part) => document.querySelector(`.live ${part}`).closest('.stale'));
        if (grey) resolve(document.body.innerText.includes('workcell-1 is not heard.'));
        else if (performance.now() - began > 10000) reject(new Error('never grey'));
        else requestAnimationFrame(look);
    };
    look();
})"""
NO_STOP_ON_THE_SOCKET = """
    const post = Worker.prototype.postMessage;
    Worker.prototype.postMessage = function (said, ...more) {
        if (said.message?.type !== 'estop') post.call(this, said, ...more);
    };
"""
GREY = """it => {
    const filters = [];
    for (let part = it; part !== null; part = part.parentElement) filters.push(getComputedStyle(part).filter);
    return filters.some((filter) => filter !== 'none');
}"""
# All that a screen reader is made to say of a link that is late; what is hidden from it is not heard.
HEARD = """() => {
    window.heard = new Set();
    const look = () => {
        for (const one of document.querySelectorAll('.banners [role=alert]')) {
            const said = one.cloneNode(true);
            said.querySelectorAll('[aria-hidden=true]').forEach((unsaid) => unsaid.remove());
            if (said.textContent.includes('What comes is late')) window.heard.add(said.textContent);
        }
        requestAnimationFrame(look);
    };
    look();
}"""
BROKEN = r"WebSocket connection|ERR_CONNECTION|ERR_EMPTY_RESPONSE|Failed to load resource"


def test_a_link_that_goes_is_told_and_what_came_meanwhile_is_there_when_it_is_back(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        header = person.page.locator("header dl.facts")
        expect(header).to_contain_text("Idle")
        person.press("t")
        drive, waiting = person.region("Drive by hand"), person.region("Waiting for you")
        for goes in (wire.cut, wire.swallow):  # aborted, or a black hole
            expect(drive).to_contain_text("the controls of the idle cell")
            expect(waiting).to_contain_text("Nothing waits for a person.")
            goes()
            told_after_ms = person.page.evaluate(SAYS_SO)
            assert told_after_ms <= 2_000  # by its own clock within 1 s (web/tests/link.test.ts); drawn when it can be
            expect(header.get_by_text("Nobody")).to_have_count(0)
            expect(person.alert("Link down.")).to_contain_text("STOP is still sent")
            expect(person.alert("Link down.").locator(".num")).to_have_attribute(
                "aria-hidden", "true"
            )  # or it is all said anew
            expect(header).to_contain_text("Not known")
            expect(drive).to_contain_text("Who has the controls of workcell-1 is not known")
            expect(waiting).to_contain_text("What waits is not known.")
            expect(person.page.locator(".live .stale").first).to_be_visible()
            asked = floor.ask()
            wire.mend()
            expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
            expect(person.alert("Link down.")).to_have_count(0)
            expect(person.page.locator(".live .stale")).to_have_count(0)
            person.says_why()
            person.button(re.compile("^Deny")).click()
            assert floor.settled(asked["id"])["status"] == "denied"


def test_a_link_that_stays_late_is_told_once_and_its_time_is_seen_to_go_on(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.page.evaluate(HEARD)
        wire.takes_s = 0.65  # each way: nothing that comes is the present
        times: set[str] = set()
        late = person.alert("What comes is late").get_by_text(re.compile(r"^at \d\d:\d\d:\d\d$"))
        until(lambda: times.add(late.text_content() or "") or len(times) > 3, what="three seconds of it")
        heard = person.page.evaluate("[...window.heard]")
        assert heard
        assert [words for words in heard if re.search(r"\d:\d\d", words)] == []


def test_whoever_looks_at_a_page_of_another_version_than_the_server_is_told_and_loads_it_anew(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        outdated = person.alert("This page is of another version than the server.")
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        expect(outdated).to_have_count(0)
        person.page.route("**/", lambda route: route.fulfill(body='<script type="module" src="/assets/index-new.js">'))
        wire.mend()
        expect(outdated).to_be_visible()
        person.page.unroute("**/")
        person.button("Load the console anew").click()
        expect(outdated).to_have_count(0)
        expect(person.page.locator("header dl.facts")).to_contain_text("Idle")


def test_whoever_signs_in_at_a_page_of_another_version_than_the_server_is_told(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.page.route("**/", lambda route: route.fulfill(body='<script type="module" src="/assets/index-new.js">'))
    person.press("?")
    person.page.get_by_role("button", name="Sign out", exact=True).click()
    person.page.get_by_label("Token").fill(server.tokens["operator_2"])
    person.press("Enter")
    expect(person.alert("This page is of another version than the server.")).to_be_visible()


def test_a_policy_that_could_not_be_read_anew_is_not_shown_as_the_one_in_force(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        person.press("3")
        places = (person.region("Matrix"), person.page.locator("header .policy"))
        for place in places:
            expect(place).to_be_visible()
            assert not place.evaluate(GREY)
        person.page.route("**/policies/active", lambda route: route.abort())
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        wire.mend()
        expect(person.alert("Link down.")).to_have_count(0)
        assert all(place.evaluate(GREY) for place in places)
        person.press("4")
        card = person.region("workcell-1")
        expect(card).to_be_visible()
        expect(card).not_to_contain_text("in force")  # neither as that, nor as another
        person.press("3")
        person.page.unroute("**/policies/active")
        until(lambda: not any(place.evaluate(GREY) for place in places), what="a policy that was read anew")


def test_who_types_an_edit_while_the_link_goes_types_on_and_stops_nothing(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        floor.ask()
        speed = person.page.get_by_role("textbox", name="Speed you approve, m/s")
        expect(person.button(re.compile("^Approve"))).to_be_enabled()
        speed.select_text()
        person.page.keyboard.type("0")
        wire.swallow()
        expect(person.alert("Link down.")).to_be_visible()
        person.page.keyboard.type(".12")
        expect(speed).to_have_value("0.12")
        expect(person.button(re.compile("^(Approve edit|Checking)"))).to_be_disabled()
        wire.mend()
        expect(person.button("Approve edit")).to_be_enabled()
        expect(speed).to_have_value("0.12")
        assert not server.cell()["latched"]


def test_a_pause_is_sent_though_the_link_is_down_and_what_came_of_it_is_told(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        drive, scene = floor.drive_off(), person.region("The cell in 3D")
        pause = scene.get_by_role("button", name="Pause")
        expect(pause).to_have_attribute("aria-disabled", "false")
        wire.cut()
        expect(person.alert("Link down.")).to_contain_text("STOP and Pause are still sent")
        expect(pause).to_have_attribute("aria-disabled", "false")
        expect(scene.get_by_role("button", name="Resume")).to_have_attribute("aria-disabled", "true")
        person.press("p")
        expect(scene.get_by_role("alert")).to_contain_text("it is not known whether this arrived.")
        wire.mend()
        expect(person.alert("Link down.")).to_have_count(0)
        person.press("p")
        expect(scene.get_by_role("button", name="Resume")).to_have_attribute("aria-disabled", "false")
        server.await_status(drive["id"], "paused")


def test_a_pause_right_after_a_resume_is_the_last_word(server: ServerProcess, people: People, floor: Floor) -> None:
    person, drive = people.sit(server), floor.drive_off()
    person.expects(r"status of 409")  # for a resume that comes behind the second pause
    pause, resume = (person.region("The cell in 3D").get_by_role("button", name=name) for name in ("Pause", "Resume"))
    expect(pause).to_have_attribute("aria-disabled", "false")
    person.press("p")
    expect(resume).to_have_attribute("aria-disabled", "false")
    person.press("r")
    person.press("p")  # what the session does is not shown yet
    # Whichever comes first on its own connection: a resume that comes late ends no pause.
    both = (["pause", "resume", "pause"], ["pause", "pause"])
    until(lambda: words(server, drive["id"])[0] in both, what="the last word")
    until(lambda: all_done(*words(server, drive["id"])), what="a cell that has done the last word, too")
    assert server.get(f"/v1/invocations/{drive['id']}")["status"] == "paused"
    until(lambda: "operator" in (server.cell()["session"] or {}).get("paused_by", ()), what="a robot that stands")


def words(server: ServerProcess, invocation: str) -> tuple[list[str], list[str]]:
    """Return what people said of an invocation, and what the cell told to have done of it."""
    trace = server.get(f"/v1/invocations/{invocation}/trace")["items"]
    human = [event["body"] for event in trace if event["kind"] == "human"]
    return [body["op"] for body in human if "role" in body], [body["op"] for body in human if "role" not in body]


def all_done(said: list[str], done: list[str]) -> bool:
    """Say whether each word is done, a pause last; the cell may be told of one pause more than once."""
    each = all(done.count(op) >= said.count(op) for op in ("pause", "resume"))
    return each and done[-1:] == ["pause"]


def test_a_denial_is_sent_though_the_link_is_down_and_an_approval_is_not(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        asked = floor.ask()
        deny, approve = person.button(re.compile("^Deny")), person.button(re.compile("^Approve"))
        expect(approve).to_be_enabled()
        wire.cut()
        expect(person.alert("Link down.")).to_contain_text("STOP and Deny are still sent")
        expect(approve).to_be_disabled()
        expect(deny).to_be_enabled()
        assert not deny.evaluate(GREY)
        assert person.page.locator("article .terms").evaluate(GREY)
        deny.click()  # and without a reason, which may be said where there is time for it
        expect(person.page.get_by_role("article").get_by_role("alert")).to_contain_text("No answer from the server")
        wire.mend()
        expect(person.alert("Link down.")).to_have_count(0)
        person.says_why()
        deny.click()
        assert floor.settled(asked["id"])["status"] == "denied"


def test_a_cell_that_falls_silent_is_not_shown_as_the_present_and_one_press_of_its_stop_on_fleet_is_one_stop(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    robot, card = person.page.locator("header dl.facts > div", has_text="Robot says"), person.region("workcell-1")
    floor.drive_off()
    until(lambda: floor.speed() > 0.05, what="a base that moves")
    pid = server.cell_pid()
    assert pid is not None
    before = len(stops(server))
    os.kill(pid, signal.SIGSTOP)
    try:
        assert person.page.evaluate(GREYS) is False  # its pictures stop before the server calls it silent
        expect(person.alert("workcell-1 is not heard.")).to_contain_text("A stop is kept for it")
        expect(robot).to_contain_text("Not heard")
        expect(person.page.locator(".live .session.stale")).to_be_visible()
        person.press("4")
        expect(card).to_contain_text("Not heard: this is what it last said.")
        press_slowly_and_again(server, person)
        expect(card).to_contain_text("that the robot stands is not confirmed")
        expect(card.get_by_role("button", name="Emergency stop of workcell-1")).to_be_visible()
        expect(person.page.get_by_text("Nothing moves")).to_have_count(0)
        person.press("1")
        expect(robot).to_contain_text("Not heard, stop sent")
        expect(person.alert("workcell-1 is not heard.")).to_contain_text("that the robot stands is not confirmed")
        expect(person.page.get_by_text("Nothing moves")).to_have_count(0)
        expect(person.page.locator("header").get_by_role("button", name="stopped")).to_have_count(0)
        expect(person.page.locator("header dl.facts > div", has_text="In control")).to_contain_text("Not known")
        person.press(".")
        until(lambda: len(stops(server)) == before + 3, what="a stop by key")
    finally:
        os.kill(pid, signal.SIGCONT)
    expect(robot).to_contain_text("Stopped, latched")
    expect(person.alert("workcell-1 is not heard.")).to_have_count(0)
    expect(person.page.get_by_text("Nothing moves")).to_be_visible()
    expect(person.page.locator(".live .stale")).to_have_count(0)


def press_slowly_and_again(server: ServerProcess, person: Person) -> None:
    """Press the stop of the cell on the page of the fleet, let go once it is confirmed, and press it again."""
    card, before = person.region("workcell-1"), len(stops(server))
    button = card.get_by_role("button", name="Emergency stop of workcell-1")
    button.hover()
    person.page.mouse.down()
    expect(card).to_contain_text("A stop that it has not had")
    expect(button).to_have_text("STOP")  # it is confirmed by now
    button.hover()  # a banner may have moved it
    person.page.mouse.up()
    expect(button).to_have_text("STOP")
    assert len(stops(server)) == before + 1
    person.page.wait_for_timeout(300)
    button.click()  # another press is another stop
    until(lambda: len(stops(server)) == before + 2, what="the second stop")


def stops(server: ServerProcess) -> list[dict[str, Any]]:
    events = server.get("/v1/audit/events?kind=human&limit=1000", key="auditor")["items"]
    return [event for event in events if event["body"]["op"] == "estop"]


def test_whoever_loses_the_controls_with_the_cells_link_is_told_so(
    server: ServerProcess, people: People, floor: Floor, free_again: None
) -> None:
    person = people.sit(server)
    person.press("t")
    person.button("Take the controls").click()
    expect(person.button("End session")).to_be_enabled()
    pid = server.cell_pid()
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    try:
        expect(person.alert("workcell-1 is not heard.")).to_be_visible()
    finally:
        os.kill(pid, signal.SIGCONT)
    expect(person.alert("You have lost the controls.")).to_contain_text("The cell had lost the server")
    person.button("Understood").click()
    expect(person.alert("You have lost the controls.")).to_have_count(0)
    expect(person.button("Take the controls")).to_be_enabled()


def test_a_stop_goes_out_with_the_link_as_soon_as_it_is_back_though_what_was_sent_before_hangs(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        no_patience = "AbortSignal.timeout = () => new AbortController().signal"
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}", init=no_patience)
        person.expects(BROKEN)
        person.page.route("**/estop", lambda _: None)  # it hangs, as on a connection that went with the network
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        with person.page.expect_request("**/estop"):
            person.press(".")
        with person.page.expect_request("**/estop"):
            pass  # the second one: no more are under way at once
        person.page.wait_for_timeout(500)
        assert not server.cell()["latched"]
        wire.mend()
        until(lambda: server.cell()["latched"], what="a stop that was pressed while the link was down")
        expect(person.alert("is not confirmed")).to_have_count(0)


def test_a_console_that_lost_its_seat_with_its_link_says_why_it_does_not_come_back_and_a_stop_needs_no_seat(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire, ExitStack() as seats:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        wire.cut()
        down = person.alert("Link down.")
        expect(down).to_be_visible()
        hello = json.dumps({"type": "hello", "token": server.tokens["operator"], "after": None})
        url, ours = f"ws{server.url[4:]}/v1/console", [Subprotocol(SUBPROTOCOL)]
        # They take whatever comes, though nobody looks: one that took no more could not be closed within ten seconds.
        screens = [seats.enter_context(connect(url, subprotocols=ours, max_queue=None)) for _ in range(EACH_CONSOLES)]
        for screen in screens:
            screen.send(hello)
        for screen in screens:
            screen.recv()
        wire.mend()
        expect(down).to_contain_text("As many consoles are open as the server may have.")
        person.page.reload()  # and never had a seat
        expect(person.alert("Connecting to the server.")).to_contain_text("As many consoles are open")
        expect(person.page.locator("header").get_by_role("button", name="stop workcell-1")).to_be_enabled()
        person.press(".")
        until(lambda: server.cell()["latched"], what="the stop")


def test_whoever_signs_in_where_a_stop_is_not_confirmed_is_told(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    with wire_to(int(server.url.rsplit(":", 1)[1])) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        wire.swallow()
        person.press(".")
        said = person.alert("The stop of workcell-1 is not confirmed.")
        expect(said).to_be_visible()
        person.page.evaluate(f"location.hash = 'token={server.tokens['operator']}'")  # nobody else
        expect(said).to_have_count(1)
        person.page.evaluate(f"location.hash = 'token={server.tokens['operator_2']}'")
        expect(said).to_contain_text("Before you signed in here: The stop of workcell-1 is not confirmed.")
        expect(said).to_have_count(1)
        said.get_by_role("button", name="Understood").click()
        expect(said).to_have_count(0)
        wire.mend()
        expect(person.page.get_by_text("operator_2").first).to_be_visible()
        until(lambda: server.cell()["latched"], what="a stop that is heard in the end, whoever knows of it")


def test_whoever_loads_the_page_anew_where_a_stop_is_not_confirmed_is_told(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=NO_STOP_ON_THE_SOCKET)
    person.expects(BROKEN)
    person.page.route("**/estop", lambda route: route.abort())
    person.press(".")
    said = person.alert("The stop of workcell-1 is not confirmed.")
    expect(said).to_contain_text("again and again")
    for _ in range(2):  # until whoever pressed it says that they know
        person.page.reload()
        expect(said).to_contain_text("Before you signed in here")
    assert not server.cell()["latched"]
    said.get_by_role("button", name="Understood").click()
    expect(said).to_have_count(0)
    person.page.reload()
    expect(person.page.locator("header").get_by_role("button", name="stop workcell-1")).to_be_enabled()
    expect(said).to_have_count(0)


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
    expect(person.alert("The stop of workcell-1 is not confirmed.")).to_be_visible(timeout=1_000)
    expect(person.page.locator("header").get_by_role("button", name="stop again")).to_be_visible()
    person.press("4")  # whatever page is open
    expect(person.alert("The stop of workcell-1 is not confirmed.")).to_be_visible()
    person.press("1")
    started = servers.start(killed.data, "--port", str(urlsplit(killed.url).port), "--pace", "1")
    assert started.url == killed.url
    expect(person.alert("Link down.")).to_have_count(0)
    expect(person.page.locator(".live .stale")).to_have_count(0)
    expect(question).to_be_visible()
    expect(person.alert("The stop of workcell-1 is not confirmed.")).to_have_count(0)
    expect(person.region("Events")).to_contain_text("Server started")
    until(lambda: started.cell()["latched"] or person.page.wait_for_timeout(20), what="the stop, sent again")
    assert started.get(f"/v1/invocations/{body['id']}")["status"] == "awaiting_approval"


def test_a_console_whose_link_the_server_did_not_hand_over_asks_for_it_again(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    refused: list[str] = []

    def once(route: Route) -> None:
        if refused:
            route.continue_()
        else:
            refused.append(route.request.url)
            route.abort()

    person = people.open(f"{server.url}/")
    person.expects(BROKEN)
    person.page.route("**/assets/worker-*", once)
    person.page.goto(f"{server.url}/#token={server.tokens['operator']}")
    until(lambda: refused or person.page.wait_for_timeout(20), what="the first attempt")
    expect(person.alert("Connecting to the server.")).to_have_count(0)
    expect(person.page.locator(".live .stale")).to_have_count(0)


def test_a_log_that_was_put_back_is_proved_and_listed_anew_under_a_page_that_stayed_open(
    built: None, servers: Servers, people: People
) -> None:
    server = servers.start(cells=0)
    server.stop()
    shutil.copytree(server.data, copy := server.data.with_name("copy"))
    port = urlsplit(server.url).port
    again = servers.start(server.data, "--port", str(port), cells=0)
    again.propose("navigate_to", target="dock")
    person = people.open(f"{again.url}/#token={again.tokens['auditor']}")
    person.expects(BROKEN)
    person.press("2")
    proof, found = person.region("Integrity of the log"), person.region("Find").get_by_role("listitem")
    expect(proof).to_contain_text("The log holds.")
    expect(found).to_have_text(re.compile("Drive to dock"))
    again.stop()
    shutil.rmtree(server.data)
    copy.rename(server.data)
    servers.start(server.data, "--port", str(port), cells=0)
    expect(proof).to_contain_text("The log does not hold.")
    expect(proof).to_contain_text("This console has seen")
    expect(found).to_have_count(0)


def test_a_page_that_the_server_does_not_hand_over_comes_when_it_is_back_and_a_question_to_policy_outlasts_its_link(
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
        expect(person.button("Emergency stop: stop workcell-1")).to_be_enabled()
        person.page.unroute("**/assets/Fleet-*")
        wire.mend()
        expect(person.page.get_by_role("heading", name="Fleet")).to_be_visible()
        expect(person.page.locator("main section header").first).to_have_css("display", "flex")

        person.press("3")
        form = person.region("What would happen if…")
        form.get_by_label("Object (needed)").select_option("mug_1")
        force = form.get_by_label(re.compile("^Grip force"))
        force.fill("50")
        form.get_by_role("button", name="Ask policy").click()
        expect(form).to_contain_text("Policy version")
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        with person.page.expect_response("**/v1/capabilities"):
            wire.mend()
        person.page.evaluate(THREE_FRAMES)
        expect(force).to_have_value("50")
        expect(form.get_by_label("Object (needed)")).to_have_value("mug_1")
        expect(form).to_contain_text("Policy version")
