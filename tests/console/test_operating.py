"""A session in an operator's hands: paused and resumed, stopped from anywhere, taken over, driven and handed back."""

from __future__ import annotations

import os
import re
import signal
from datetime import datetime
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Locator, Route, expect

from app.clock import rfc3339, wall_s
from tests.conftest import ServerProcess, until
from tests.console.conftest import DESK, PHONE, Floor, People, Person, at_once, far, insist, resize
from tests.console.wire import wire_to

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = [pytest.mark.browser, pytest.mark.process]


# Presses R over and over from when a pause is shown, for less time than it takes to read whose it is.
PRESS_WHAT_CAME = """() => {
    let sinceMs = null;
    const timer = setInterval(() => {
        if (sinceMs === null && document.body.innerText.includes('Paused, holding')) sinceMs = performance.now();
        if (sinceMs === null) return;
        if (performance.now() - sinceMs > 500) {
            clearInterval(timer);
            window.pressed = true;
            return;
        }
        const how = { key: 'r', code: 'KeyR', bubbles: true, cancelable: true };
        for (const what of ['keydown', 'keyup']) document.body.dispatchEvent(new KeyboardEvent(what, how));
    }, 20);
}"""


def robot(person: Person) -> Locator:
    """What the robot says of itself, in the header."""
    return person.page.locator("header dl.facts")


def hold(person: Person, key: str, so: Callable[[], bool], what: str) -> None:
    """Hold a key until something is so, then let go."""
    keyboard = person.page.keyboard
    insist(person, lambda: keyboard.down(key), lambda: keyboard.up(key), so, what)
    keyboard.up(key)
    expect(person.page.get_by_text("Hold to run; let go to stop")).to_be_visible()


def test_a_stop_is_heard_while_typing_pressed_from_anywhere_and_left_in_two_steps(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    floor.ask()
    force = person.page.get_by_role("textbox", name="Grip force you approve, N")
    force.fill("4")
    person.press(".")
    expect(force).to_have_value("4.")
    assert server.cell()["latched"] is False
    person.press("Control+.")
    expect(robot(person)).to_contain_text("Stopped, latched")
    until(lambda: server.cell()["latched"], what="a server that has heard of the latch")
    floor.clear()
    expect(robot(person)).to_contain_text("Idle")
    drive = floor.drive_off()
    until(lambda: floor.speed() > 0.05, what="a base that moves")
    person.press("2")
    expect(person.page).to_have_url(f"{server.url}/#/audit")
    person.press(".")
    expect(robot(person)).to_contain_text("Stopped, latched")
    assert server.await_status(drive["id"], "failed")["outcome"] == "stopped"
    stood = floor.base()
    person.button("Reset…").click()
    person.enter(person.button("Keep stopped"))
    expect(person.button("Reset…")).to_be_focused()
    assert server.cell()["latched"] is True
    person.enter(person.button("Reset…"))
    expect(person.button("Keep stopped")).to_be_focused()
    person.press("Escape")
    person.enter(person.button("Reset…"))
    expect(person.button("Keep stopped")).to_be_focused()
    person.press("Tab")
    person.enter(person.button("Yes, reset the stop"))
    expect(robot(person)).to_contain_text("Idle")
    assert server.cell()["latched"] is False
    expect(person.page.locator("main")).to_be_focused()
    assert floor.base() == pytest.approx(stood, abs=0.1)  # a drive would have gone on by metres


def test_a_stop_is_heard_while_a_list_is_open_and_the_letters_there_approve_nothing(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    asked = floor.ask()
    reason = person.page.get_by_label("Reason if denied")
    expect(person.button("Deny")).to_be_enabled()
    for choice in (reason, person.page.get_by_label("Cell", exact=True)):
        choice.click()
        until(lambda choice=choice: choice.evaluate("(list) => list.matches(':open')"), what="a list that is open")
        person.press("a")
        person.press(".")
        expect(robot(person)).to_contain_text("Stopped, latched")
        person.press("Escape")
        expect(choice).to_be_focused()
        until(floor.unlatched, what="a cell that no stop latches")
        expect(robot(person)).not_to_contain_text("latched")
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"


def test_a_pause_is_heard_where_a_cell_was_chosen_and_another_letter_there_chooses_none_and_is_said_not_to_count(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    asked, drive = floor.ask(), floor.drive_off()
    expect(person.button("Deny")).to_be_enabled()
    expect(person.button("Pause")).to_be_enabled()
    cells = person.page.get_by_label("Cell", exact=True)
    cells.focus()
    cells.evaluate("(list) => list.add(new Option('a-line'))")  # as another cell may be called
    person.press("a")
    missed = person.page.get_by_role("status").filter(has_text="Key A not heard: a list has the focus.")
    expect(missed).to_be_visible()
    said = missed.evaluate("(missed) => missed.textContent")
    person.press("a")  # once more, and said once more: words that stay the same are not read out
    until(lambda: missed.evaluate("(missed) => missed.textContent") != said, what="other words")
    expect(missed).to_be_visible()
    expect(cells).to_have_value("workcell-1")
    person.press("p")
    server.await_status(drive["id"], "paused")
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["wide", "narrow"])
def test_the_sign_beside_the_name_of_the_cell_lies_over_no_letter_of_it(
    server: ServerProcess, people: People, size: dict[str, int]
) -> None:
    person = people.sit(server)  # with a mouse, however narrow the window is
    resize(person, size)
    sign, room = person.page.get_by_label("Cell", exact=True).evaluate(
        """(list) => {
            const { width, paddingLeft, paddingRight } = getComputedStyle(list, '::picker-icon');
            const sign = [width, paddingLeft, paddingRight].map(parseFloat).reduce((all, one) => all + one);
            return [sign, parseFloat(getComputedStyle(list).paddingRight)];
        }"""
    )
    assert 0 < sign <= room


def test_fleet_counts_a_session_from_its_launch_and_not_from_when_it_was_proposed(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    asked = floor.ask()
    person.press("4")
    person.page.wait_for_timeout(3_000)  # as long as somebody takes to answer, and longer than it takes to look
    floor.answer(asked, "approve")
    counted = re.compile(r"(\d+):(\d\d) running")
    expect(person.region("workcell-1")).to_contain_text(counted)
    told = counted.search(person.region("workcell-1").inner_text())
    now_s = wall_s()
    trace = server.get(f"/v1/invocations/{asked['id']}/trace")["items"]
    launched = next(datetime.fromisoformat(event["at"]) for event in trace if event["kind"] == "launch")
    assert told is not None
    assert 60 * int(told[1]) + int(told[2]) <= now_s - launched.timestamp() + 1.0


def test_a_session_is_paused_by_one_key_however_often_resumed_by_another_and_a_refused_pause_is_told_on_any_page(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    drive = floor.drive_off()
    expect(robot(person)).to_contain_text("Running")
    expect(robot(person)).to_contain_text("Agent “planner”")
    until(lambda: floor.speed() > 0.05, what="a base that moves")
    person.press("p")
    expect(robot(person)).to_contain_text("Paused, holding")
    expect(person.button("Pause")).to_be_disabled()  # the record says it a moment after the robot does
    person.press("p")
    person.button("Pause").click(force=True)
    server.await_status(drive["id"], "paused")
    until(lambda: floor.speed() < 0.01, what="a base at rest")
    expect(person.region("Events")).to_contain_text("operator paused the session")
    server.post(f"/v1/invocations/{drive['id']}/resume")
    expect(robot(person)).to_contain_text("Running")
    asked: list[str] = []
    person.hears("request", lambda request: asked.append(request.url) if request.url.endswith("/resume") else None)
    person.page.evaluate(PRESS_WHAT_CAME)
    server.post(f"/v1/invocations/{drive['id']}/pause", key="operator_2")
    until(lambda: person.page.evaluate("window.pressed") or person.page.wait_for_timeout(20), what="keys pressed")
    assert asked == []  # nobody has seen yet that another one paused it
    expect(person.button("Resume")).to_be_enabled()
    person.press("r")
    expect(robot(person)).to_contain_text("Running")
    until(lambda: floor.speed() > 0.05, what="a base that moves again")
    trace = server.get(f"/v1/invocations/{drive['id']}/trace")["items"]
    said = [event["body"]["op"] for event in trace if event["kind"] == "human"]
    assert said == ["pause", "pause", "resume", "resume"] * 2  # the server says it, and the cell that it has done it

    person.button("Pause").focus()
    floor.clear()
    expect(robot(person)).to_contain_text("Idle")
    expect(person.page.locator("main")).to_be_focused()  # the button went with the session
    person.expects("status of 409")
    floor.drive_off()
    expect(robot(person)).to_contain_text("Running")
    expect(person.button("Pause")).to_be_enabled()
    held: list[Route] = []
    person.page.route("**/pause", lambda route: held.append(route))  # noqa: PLW0108 (Playwright takes no built-in)
    person.press("p")
    until(lambda: held or person.page.wait_for_timeout(20), what="a pause that is held")
    person.press("2")
    expect(person.region("Find")).to_be_visible()
    problem = {"title": "Conflict", "status": 409, "code": "ending", "detail": "it is coming to its end"}
    held[0].fulfill(status=409, json=problem)
    expect(person.alert("Pause in workcell-1: It is coming to its end.")).to_be_visible()
    person.press("1")
    expect(person.alert("It is coming to its end.")).to_have_count(1)
    person.button("Understood").click()
    expect(person.alert("It is coming to its end.")).to_have_count(0)


def test_one_of_two_gets_the_controls_drives_by_keyboard_and_ends_it(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    one, other = people.sit(server), people.sit(server, "operator_2")
    for person in (one, other):
        person.expects("409")
        person.press("t")
    with at_once("**/takeover", one, other):
        for person in (one, other):
            person.button("Take the controls").click()
    until(lambda: server.cell()["control"], what="somebody with the controls")
    won = server.cell()["control"]["holder"]
    driver, watcher = (one, other) if won == "operator" else (other, one)
    expect(watcher.region("Drive by hand")).to_contain_text(f"{won} (remote) has the controls of workcell-1.")
    expect(watcher.region("Drive by hand").get_by_role("alert")).to_contain_text("workcell-1")
    told = watcher.page.get_by_role("status").filter(has_text=f"{won} drives workcell-1 by hand")
    expect(told).to_be_visible()
    expect(told.locator("[aria-hidden=true] .num")).to_have_text(
        re.compile(r"^\d:\d\d$")
    )  # or it is all said every second
    expect(robot(driver)).to_contain_text("You (remote)")
    began = floor.base()
    hold(driver, "ArrowDown", lambda: far(floor.base(), began) > 0.1, what="a base driven back")
    until(lambda: floor.speed() < 0.01, what="a base at rest")
    driver.button("End session").click()
    expect(robot(watcher)).to_contain_text("Nobody")
    assert server.cell()["control"] is None
    until(lambda: server.get("/v1/audit/events?kind=telemetry")["items"], what="its telemetry")
    driven = server.get("/v1/audit/events?kind=telemetry")["items"][-1]["invocation"]
    watcher.page.evaluate(f"location.hash = '#/audit/{driven}'")
    measured = watcher.page.get_by_role("list", name="What was measured")
    expect(measured.get_by_role("listitem").filter(has_text="Base, by hand")).to_be_visible()


@pytest.mark.drawn
def test_a_session_taken_over_goes_on_when_it_is_handed_back(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    drive = floor.drive_off()
    until(lambda: floor.speed() > 0.05, what="a base that moves")
    expect(robot(person)).to_contain_text("Running")
    person.press("t")
    person.button("Take the controls").click()
    expect(robot(person)).to_contain_text("Driven by hand")
    began = floor.base()
    hold(person, "ArrowLeft", lambda: far(floor.base(), began) > 0.05, what="a base driven aside")
    until(lambda: floor.speed() < 0.01, what="a base at rest")
    person.button("Agent goes on").click()
    expect(robot(person)).to_contain_text("Running")
    until(lambda: floor.speed() > 0.05, what="a base that goes on")
    told = [event["body"].get("op") for event in server.get(f"/v1/invocations/{drive['id']}/trace")["items"]]
    assert {"takeover", "jog", "release"} <= set(told)


def test_a_reset_that_the_cell_did_not_hear_is_told_and_its_second_step_goes_when_it_is_dead_and_says_why(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    again, reset, yes = person.alert("is latched"), person.button("Reset…"), person.button("Yes, reset the stop")
    person.press(".")
    expect(again).to_contain_text(re.compile(r"Pressed by operator at \d\d:\d\d:\d\d\."))
    reset.click()
    expect(yes).to_be_enabled()  # it is no press from before it was read
    cell = server.cell_pid()
    assert cell is not None
    os.kill(cell, signal.SIGSTOP)
    try:
        yes.click()
        expect(person.region("Events")).to_contain_text("Reset not confirmed: workcell-1 has not said that it heard it")
    finally:
        os.kill(cell, signal.SIGCONT)
    expect(again).to_contain_text("workcell-1 has not said that it heard the reset by operator, and stays stopped.")
    expect(again).to_contain_text("Pressed by operator at")
    until(lambda: server.cell()["online"], what="a cell that is heard again")
    assert server.cell()["latched"] is True

    reset.click()
    expect(person.page.get_by_text(re.compile("^([1-9]|10) s left to confirm"))).to_be_visible()
    assert server.post("/v1/cells/workcell-1/estop", key="operator_2").is_success
    expect(again).to_contain_text("operator_2 has pressed the stop again since.")
    expect(yes).to_have_count(0)
    for step, why in (
        ({"step": "arm"}, "operator_2 has begun to reset it since"),
        ({"step": "confirm", "code": "12345678"}, "What you began is void"),
    ):
        person.enter(reset)
        expect(yes).to_be_visible()
        server.post("/v1/cells/workcell-1/reset", step, key="operator_2")
        expect(again).to_contain_text(why)
        expect(yes).to_have_count(0)
    person.page.route("**/reset", sooner)
    person.enter(reset)
    expect(yes).to_be_visible()
    expect(again).to_contain_text("The time to confirm is over.")
    expect(yes).to_have_count(0)
    assert server.cell()["latched"] is True


def sooner(route: Route) -> None:
    """Hand an offered second step on as one that ends in two seconds: the page goes by what the server says of it."""
    answer = route.fetch()
    offered = answer.json()
    route.fulfill(
        response=answer, json={**offered, "arming": {**offered["arming"], "expires_at": rfc3339(wall_s() + 2.0)}}
    )


def test_what_closes_or_was_sent_gives_the_focus_back_to_where_one_goes_on(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    main, panel = person.page.locator("main"), person.region("Drive by hand")
    for close in ("t", "Escape", "Enter"):
        person.press("t")
        expect(panel).to_be_focused()
        if close == "Enter":
            person.press("Tab")
            expect(person.button("Close")).to_be_focused()
        person.press(close)
        expect(panel).to_have_count(0)
        expect(main).to_be_focused()
    assert main.evaluate("(main) => getComputedStyle(main).boxShadow") == "none"
    person.press("2")
    check = person.button("Check again")
    expect(check).to_be_enabled()
    check.focus()
    person.press("Enter")
    expect(check).to_be_focused()


def test_whoever_signs_in_or_goes_to_another_page_by_keyboard_goes_on_in_the_page(
    server: ServerProcess, people: People
) -> None:
    person = people.open(server.url)
    token, page = person.page.get_by_label("Token"), person.page.locator("#page")
    expect(token).to_be_focused()
    person.page.keyboard.type(server.tokens["operator"])
    person.press("Enter")
    expect(page).to_be_focused()
    for key, name in (("2", "Audit"), ("3", "Policy"), ("4", "Fleet")):
        person.press("Tab")
        expect(page).not_to_be_focused()
        person.press(key)
        expect(person.page.get_by_role("heading", name=name, level=1)).to_be_attached()
        expect(page).to_be_focused()


def test_a_profile_is_chosen_by_arrow_keys_compared_anew_when_another_changes_it_and_not_called_kept_on_its_way(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    before = server.cell()["profile"]
    person.press("4")
    card = person.region("workcell-1")
    choice, change = card.get_by_label("Profile", exact=True), card.get_by_role("button", name="Change…")
    choice.focus()
    names = choice.locator("option").all_inner_texts()
    for place, name in enumerate(names):
        for key in ("ArrowDown", "Home", *["ArrowDown"] * place, "Enter"):  # the first one opens the list
            person.press(key)
        expect(choice).to_have_value(name)
    expect(choice).to_be_focused()
    choice.select_option("sim-relaxed")
    change.click()
    told = card.get_by_role("group", name="What changes").get_by_role("row")
    expect(told.filter(has_text="A person too near")).to_contain_text("below 0.50 m, only warns, looser")
    expect(told.filter(has_text="Taking the controls")).to_contain_text("nobody may, different")
    card.get_by_role("button", name=f"Keep {before}").click()
    wanted, theirs = [name for name in names if name != before][:2]
    choice.select_option(wanted)
    change.click()
    expect(card.get_by_role("button", name=f"Keep {before}")).to_be_focused()
    yes, keep = (card.get_by_role("button", name=name) for name in ("Yes, change it", f"Keep {theirs}"))
    try:
        put_under(server, theirs, "operator_2")
        told = card.get_by_role("alert")
        expect(told).to_contain_text(f"operator_2 has put workcell-1 under {theirs} meanwhile.")
        expect(told).to_contain_text(f"You compared {wanted} with {before}.")
        expect(yes).to_have_count(0)
        card.get_by_role("button", name=f"Compare with {theirs}").click()
        expect(keep).to_be_focused()
        with at_once("**/profile", person):
            yes.click()
            expect(yes).to_be_disabled()
            expect(keep).to_be_disabled(timeout=5_000)  # nothing takes it back, and nothing says that it did
        until(lambda: server.cell()["profile"] == wanted, what="the profile that was confirmed anew")
        expect(choice).to_be_focused()
    finally:
        put_under(server, before)


def test_a_cell_says_that_its_profile_is_gone_with_the_policy_that_had_it(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person, before = people.sit(server), server.cell()["profile"]
    policy = server.get("/v1/policies/active")
    del policy["profiles"][before]
    person.page.route("**/v1/policies/active", lambda route: route.fulfill(json=policy))
    person.page.reload()
    person.page.evaluate("location.hash = '#/fleet'")
    card = person.region("workcell-1")
    choice = card.get_by_label("Profile", exact=True)
    expect(choice.locator("option:checked")).to_have_text(f"{before} (gone)")
    expect(choice).to_have_accessible_description(re.compile(f"The policy in force has no {before}"))
    choice.select_option("real-restricted")
    card.get_by_role("button", name="Change…").click()
    expect(card.get_by_text(f"no {before} to compare it with")).to_be_visible()
    card.get_by_role("button", name=f"Keep {before}").click()
    expect(choice).to_have_value(before)


def test_what_was_compared_by_a_policy_that_is_not_in_force_any_more_is_compared_anew(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    before = server.cell()["profile"]
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects("WebSocket connection|ERR_|Failed to load resource")
        person.press("4")
        card = person.region("workcell-1")
        yes = card.get_by_role("button", name="Yes, change it")
        card.get_by_label("Profile", exact=True).select_option("test-audit")
        card.get_by_role("button", name="Change…").click()
        expect(yes).to_be_enabled()

        def newer(route: Route) -> None:
            answer = route.fetch()
            route.fulfill(response=answer, json={**answer.json(), "version": "sha256:" + "7" * 64})

        person.page.route("**/policies/active", newer)
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        wire.mend()
        expect(card.get_by_role("alert")).to_contain_text("Another policy came into force meanwhile.")
        expect(yes).to_have_count(0)
        card.get_by_role("button", name=f"Compare with {before}").click()
        expect(yes).to_be_enabled()
        assert server.cell()["profile"] == before


def put_under(server: ServerProcess, profile: str, key: str = "operator") -> None:
    with server.client(key) as client:
        assert client.put("/v1/cells/workcell-1/profile", json={"profile": profile}).is_success
