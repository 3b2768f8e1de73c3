"""Hold to run by gamepad, thumb and key: what is held moves, what is let go stops at once, and the robot is seen."""

from __future__ import annotations

from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import CDPSession, Route, expect

from app.clock import monotonic_s
from app.governance.control import LAPSE_S, LATE_S
from tests.conftest import ServerProcess, put_in_profile, until
from tests.console.conftest import (
    DESK,
    DESK_SMALL,
    LET_GO,
    MAGNIFIED,
    PHONE,
    SIDEWAYS,
    THREE_FRAMES,
    Floor,
    People,
    Person,
    box,
    far,
    insist,
    on_top,
    out_of_reach,
    reload_in_hand,
    resize,
    stop,
    wider_than_the_screen,
)
from tests.console.test_access import overlap
from tests.console.wire import wire_to

pytestmark = [pytest.mark.browser, pytest.mark.process, pytest.mark.usefixtures("free_again")]
# A gamepad that a test plugs in and steers, and an ear for the commands that the page hands to its link.
BENCH = """
    const buttons = Array.from({ length: 16 }, () => ({ value: 0 }));
    window.stick = { id: 'Test pad', index: 1, mapping: '', connected: false, axes: [0, 0, 0, 0], buttons };
    window.jogs = [];
    const post = Worker.prototype.postMessage;
    Worker.prototype.postMessage = function (message, ...rest) {
        if (message?.message?.type === 'jog') window.jogs.push(message.message);
        return post.call(this, message, ...rest);
    };
    navigator.getGamepads = () => [null, window.stick.connected ? window.stick : null];
"""
# A browser whose clock stands as far back as a test says, from the next page on.
SET_BACK = "const now = Date.now, back = Number(sessionStorage.getItem('back')); Date.now = () => now() - back;"
# One that is told to block cookies.
NOTHING_STORED = """
    for (const name of ['sessionStorage', 'localStorage']) {
        Object.defineProperty(window, name, { get() { throw new DOMException('denied', 'SecurityError'); } });
    }
"""
AFTER_THE_LAST_PUSH = "window.jogs.slice(window.jogs.findLastIndex((jog) => jog.base.some(Boolean)) + 1)"
PUSHES = "window.jogs.filter((jog) => jog.base.some(Boolean)).length"
ZEROS = [0, 0, 0]
IDLE, HOLDS = "the controls of the idle cell", "Taking over holds the session"
HELD = "Moving while you hold"
LEAST_PX = 180  # of the cell, that a robot in it can be seen


def let_go(person: Person) -> None:
    """The page says zero by itself, and nothing but zero after it."""
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    last = person.page.evaluate(AFTER_THE_LAST_PUSH)
    assert last, "no zero was said"
    assert all(jog["base"] == jog["tool"] == ZEROS for jog in last)


def take_controls(person: Person, what: str = IDLE) -> None:
    """Take over what the page says that it would take over: it hears of a launch a moment after the cell."""
    person.press("t")
    expect(person.region("Drive by hand")).to_contain_text(what)
    person.button("Take the controls").click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()


def test_over_a_slow_line_nothing_drives_and_why_is_told(server: ServerProcess, people: People, floor: Floor) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        wire.takes_s = LATE_S * 0.6  # each way
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}", init=BENCH)
        take_controls(person)
        driven = server.cell()["control"]["invocation"]
        person.page.keyboard.down("ArrowDown")
        expect(person.page.get_by_text("The line is too slow to drive by")).to_be_visible()
        assert person.page.evaluate(PUSHES) > 0
        person.page.keyboard.up("ArrowDown")
        expect(person.page.get_by_text("The line is too slow to drive by")).to_be_hidden()
        assert floor.speed() < 0.01
        wire.takes_s = 0.65  # and now nothing that comes is the present
        expect(person.region("Drive by hand")).to_contain_text("the link is down or too slow")
        slow_s = monotonic_s()
        until(lambda: monotonic_s() - slow_s > LAPSE_S + 1.0 or not in_hand(floor), what="the lease had lapsed by now")
        assert in_hand(floor)
    trace = server.get(f"/v1/invocations/{driven}/trace")["items"]
    said = {event["body"].get("op") for event in trace}
    assert "takeover" in said
    assert "jog" not in said


def in_hand(floor: Floor) -> bool:
    return floor.server.cell()["control"] is not None


def at_rest(floor: Floor) -> tuple[float, float]:
    until(lambda: floor.speed() < 0.01, what="a base at rest")
    return floor.base()


def touch(thumb: CDPSession, person: Person, name: str) -> None:
    at = box(person.button(name))
    point = {"x": at["x"] + at["width"] / 2, "y": at["y"] + at["height"] / 2}
    thumb.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})


def lift(thumb: CDPSession) -> None:
    thumb.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def test_a_gamepad_drives_while_its_stick_is_held_and_says_zero_when_it_is_let_go(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=BENCH)
    take_controls(person)
    began = floor.base()
    person.page.evaluate("window.stick.connected = true; window.stick.axes[1] = 0.8")  # whatever axis that may be
    expect(person.page.get_by_text("not used, its layout is not known")).to_be_visible()
    person.page.evaluate("window.stick.mapping = 'standard'; window.stick.axes[1] = 0.1")  # within the dead zone
    expect(person.page.get_by_text("not used, its layout is not known")).to_be_hidden()
    expect(person.page.get_by_text("Test pad")).to_be_visible()
    assert person.page.evaluate("window.jogs.every((jog) => jog.base.every((value) => value === 0))")
    insist(
        person,
        lambda: person.page.evaluate("window.stick.axes[1] = 0.8"),  # pulled back
        lambda: person.page.evaluate("window.stick.axes[1] = 0"),
        lambda: far(floor.base(), began) > 0.1,
        "a base driven back",
    )
    expect(person.page.get_by_text(HELD)).to_be_visible()
    person.page.evaluate("window.stick.axes[1] = 0")
    let_go(person)
    stood = at_rest(floor)
    person.page.evaluate("window.stick.axes[1] = -0.8")
    until(lambda: far(floor.base(), stood) > 0.05, what="a base that goes on")
    person.page.evaluate("window.stick.connected = false")  # unplugged with the stick held
    let_go(person)
    at_rest(floor)
    held = person.page.get_by_text("let go of its sticks first")
    person.page.evaluate("window.stick.connected = true")  # and plugged in again, with the stick still held
    expect(held).to_be_visible()
    let_go(person)
    person.page.evaluate("window.stick.axes[1] = 0")
    expect(held).to_be_hidden()
    person.page.evaluate(
        "window.stick.axes[1] = 0.8; window.stick.id = 'Another pad'"
    )  # held, in the place of the first
    expect(held).to_be_visible()
    let_go(person)
    person.page.evaluate("window.stick.axes[1] = 0")
    expect(held).to_be_hidden()
    stood = floor.base()
    person.page.evaluate("window.stick.axes[1] = 0.8")
    until(lambda: far(floor.base(), stood) > 0.05, what="a base that drives again")
    person.page.evaluate("dispatchEvent(new Event('blur'))")
    expect(held).to_be_visible()
    let_go(person)
    at_rest(floor)


TABLET = {"width": 768, "height": 1024}
# What any banner does to the page, and whether the pad says that no finger counts on it where that moved it.
BANNER = """() => new Promise((done) => {
    const pads = document.querySelector('.pads');
    const stood = pads.getBoundingClientRect().top;
    const banner = document.createElement('div');
    banner.style.height = '60px';
    document.querySelector('.banners').append(banner);
    const look = () => {
        const guarded = pads.hasAttribute('data-arming');
        const moved = Math.abs(pads.getBoundingClientRect().top - stood) > 8;
        if (guarded || !moved) return done({ moved, guarded });
        requestAnimationFrame(look);
    };
    setTimeout(look, 100);
})"""


def test_the_pad_on_the_screen_drives_while_a_thumb_is_on_it_and_no_banner_moves_it_or_it_takes_no_finger(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE, init=BENCH)
    take_controls(person)
    began = floor.base()
    thumb = person.page.context.new_cdp_session(person.page)
    insist(
        person,
        lambda: touch(thumb, person, "Base back, hold to run"),
        lambda: lift(thumb),
        lambda: far(floor.base(), began) > 0.1,
        "a base driven back",
    )
    expect(person.page.get_by_text(HELD)).to_be_visible()
    lift(thumb)
    let_go(person)
    stood = at_rest(floor)
    touch(thumb, person, "Base forward, hold to run")
    until(lambda: far(floor.base(), stood) > 0.05, what="a base that goes on")
    thumb.send("Input.dispatchTouchEvent", {"type": "touchCancel", "touchPoints": []})  # a call comes in
    let_go(person)
    stood = at_rest(floor)
    touch(thumb, person, "Base back, hold to run")
    until(lambda: far(floor.base(), stood) > 0.05, what="a base that goes back")
    person.page.set_viewport_size(SIDEWAYS)  # the phone is turned, with the thumb still down
    let_go(person)
    at_rest(floor)
    lift(thumb)
    let_go(person)

    for size in (PHONE, TABLET, SIDEWAYS):
        resize(person, size)
        expect(person.page.get_by_text(LET_GO)).to_be_visible()
        expect(person.page.locator(".pads:not([data-arming])")).to_be_visible()  # nor is it still from the turn
        moved = size == SIDEWAYS  # where height is short, the pad begins at the top
        assert person.page.evaluate(BANNER) == {"moved": moved, "guarded": moved}, size
        person.page.evaluate("document.querySelector('.banners').lastElementChild.remove()")


def test_a_key_that_is_held_is_let_go_out_of_focus_or_sight_or_when_a_modifier_comes_and_its_repeats_start_nothing(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=BENCH)
    take_controls(person)
    person.button("medium").click()  # and the arrows still drive: choosing a speed does not keep them
    keyboard = person.page.keyboard
    for gone in ("window.dispatchEvent(new Event('blur'))", "document.dispatchEvent(new Event('visibilitychange'))"):
        began = floor.base()
        insist(
            person,
            lambda: keyboard.down("ArrowDown"),
            lambda: keyboard.up("ArrowDown"),
            lambda began=began: far(floor.base(), began) > 0.1,
            "a base driven back",
        )
        person.page.evaluate(gone)
        let_go(person)
        at_rest(floor)
        let_go(person)  # with the key still down
        keyboard.up("ArrowDown")
        keyboard.down("ArrowUp")
        until(lambda: floor.speed() > 0.03, what="a base that drives again")
        keyboard.up("ArrowUp")
        at_rest(floor)

    began = floor.base()
    insist(
        person,
        lambda: keyboard.down("ArrowDown"),
        lambda: keyboard.up("ArrowDown"),
        lambda: far(floor.base(), began) > 0.05,
        "a base driven back",
    )
    keyboard.down("Meta")
    let_go(person)
    keyboard.up("Meta")
    keyboard.down("ArrowDown")  # it was never up, so this is a repeat of it
    at_rest(floor)
    let_go(person)
    keyboard.up("ArrowDown")
    keyboard.down("ArrowUp")
    until(lambda: floor.speed() > 0.03, what="a base that drives again")
    person.press("?")  # what lies over the page lets go of it, too
    covered = person.page.get_by_text("Nothing drives until the list over the page is closed")
    expect(covered).to_be_visible()
    at_rest(floor)
    keyboard.up("ArrowUp")
    pushes = person.page.evaluate(PUSHES)
    keyboard.down("ArrowUp")
    keyboard.up("ArrowUp")
    person.press("Escape")
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    # Verdicts are chosen among by arrow keys, beside the pad.
    person.page.locator("main").evaluate(
        "(main) => Object.assign(main.appendChild(document.createElement('input')), { type: 'radio' })"
    )
    person.page.locator("main input[type=radio]").last.focus()
    keyboard.down("ArrowUp")
    keyboard.up("ArrowUp")
    assert person.page.evaluate(PUSHES) == pushes


def test_a_session_is_taken_over_and_ended_by_keyboard_alone(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    session = floor.drive_off()
    person.press("t")
    panel = person.region("Drive by hand")
    expect(panel).to_be_focused()
    expect(panel).to_contain_text(HOLDS)  # not the idle cell, which it was a moment ago
    for button in ("Close", "Take the controls"):
        person.press("Tab")
        expect(person.button(button)).to_be_focused()
    expect(person.button("Take the controls")).to_be_enabled()
    person.press("Enter")
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    expect(panel).to_be_focused()
    person.press("h")
    for button in ("Agent goes on", "Roll back", "End session"):
        person.press("Tab")
        expect(person.button(button)).to_be_focused()
    expect(person.button("End session")).to_be_enabled()
    person.press("Enter")
    assert server.await_status(session["id"], "failed", "completed")["outcome"] == "taken_over"
    expect(person.button("Take the controls")).to_be_visible()
    expect(panel).to_be_focused()


def test_whoever_signs_in_where_another_drove_has_lost_no_controls(
    server: ServerProcess, people: People, floor: Floor, free_again: None
) -> None:
    person = people.sit(server)
    take_controls(person)
    person.page.goto("about:blank")
    until(lambda: server.cell()["control"] is None, what="the lapse of the lease")
    person.page.goto(f"{server.url}/#token={server.tokens['operator_2']}")
    expect(person.region("Events")).to_contain_text("holder fell silent")
    expect(person.alert("You have lost the controls.")).to_have_count(0)


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_whoever_drives_is_told_that_the_session_is_paused_and_resumes_it(
    server: ServerProcess, people: People, floor: Floor, size: dict[str, int]
) -> None:
    person = people.sit(server, size=size)
    person.expects("status of 409")
    floor.drive_off()
    take_controls(person, HOLDS)
    panel, header = person.region("Drive by hand"), person.page.locator("header").first
    expect(header).to_contain_text("Driven by hand")
    if size == PHONE:
        assert on_top(person.button("Pause"))
        person.button("Pause").tap()
    else:
        person.press("p")
    expect(header).to_contain_text("Driven by hand, paused")
    expect(panel).to_contain_text("Paused, nothing moves: operator paused the session.")
    expect(person.button("Agent goes on")).to_be_disabled()
    expect(person.button("Agent goes on")).to_have_accessible_description("Resume it before the agent goes on.")
    expect(panel.get_by_role("button", name="Resume")).to_be_in_viewport(ratio=1)
    for name in ("Base back, hold to run", "End session"):
        expect(person.button(name)).to_be_in_viewport(ratio=1)
    beside = person.region("The cell in 3D").get_by_role("button", name="Resume")
    expect(beside).to_have_count(0 if size == PHONE else 1)
    if size == PHONE:
        assert wider_than_the_screen(person.page) == []
    panel.get_by_role("button", name="Resume").click()
    expect(header).not_to_contain_text("paused")
    expect(person.button("Agent goes on")).to_be_enabled()
    expect(panel).not_to_contain_text("nothing moves")
    problem = {"title": "Conflict", "status": 409, "code": "ending", "detail": "it is coming to its end"}
    person.page.route("**/pause", lambda route: route.fulfill(status=409, json=problem))
    person.press("p")
    expect(person.alert("It is coming to its end.")).to_be_visible()
    person.button("Understood").click()
    expect(person.alert("It is coming to its end.")).to_have_count(0)


# All at once: to ask for them one by one takes a second of the processor for each width.
BOXES = """(all) => all.map((one) => {
    const { x, y, width, height } = one.getBoundingClientRect();
    return [one.getAttribute('aria-label') ?? one.innerText, { x, y, width, height }];
})"""


def test_a_finger_that_slides_off_its_button_lets_go_and_no_button_lies_over_another_however_wide_the_window_is(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server, init=BENCH)
    take_controls(person)
    place, mouse = box(person.button("Turn left, hold to run")), person.page.mouse
    across = place["x"] + place["width"] / 2
    mouse.move(across, place["y"] + place["height"] / 2)
    mouse.down()
    expect(person.page.get_by_text(HELD)).to_be_visible()
    mouse.move(across, place["y"] - 20)  # it rolls
    said = person.page.evaluate("window.jogs.length")
    until(lambda: person.page.evaluate("window.jogs.length") > said + 5, what="a button that is held still")
    expect(person.page.get_by_text(HELD)).to_be_visible()
    mouse.move(across, place["y"] - 60)
    let_go(person)
    mouse.move(across, place["y"] + place["height"] / 2)  # what was let go of starts nothing
    let_go(person)
    mouse.up()

    pads = person.region("Drive by hand").get_by_role("button")
    expect(person.button("End session")).to_be_visible()
    for width in (320, 390, 560, 761, 800, 860, 912, 1024, 1101, 1241, 1280, 1440, 1920):
        person.page.set_viewport_size({"width": width, "height": 1000})
        person.page.evaluate(THREE_FRAMES)
        boxes = pads.evaluate_all(BOXES)
        assert len(boxes) > 12
        over = [(one, other) for k, (one, at) in enumerate(boxes) for other, to in boxes[:k] if overlap(at, to)]
        assert over == [], f"at {width} px"


def test_who_drives_sees_the_robot_beside_pad_and_gauges_in_a_low_window(server: ServerProcess, people: People) -> None:
    person = people.sit(server)
    take_controls(person)
    expect(person.button("End session")).to_be_visible()
    for width in (1024, 1101, 1180, 1181, 1240, 1241, 1280, 1366):
        person.page.set_viewport_size({"width": width, "height": 720})
        person.page.evaluate(THREE_FRAMES)
        assert box(person.region("The cell in 3D"))["height"] >= 200, f"at {width} px"


def test_whoever_lets_go_of_the_first_button_of_a_mouse_stops_and_another_button_drives_nothing(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=BENCH)
    take_controls(person)
    mouse, began = person.page.mouse, floor.base()
    person.button("Base back, hold to run").hover()
    insist(person, mouse.down, mouse.up, lambda: far(floor.base(), began) > 0.05, "a base driven back")
    mouse.down(button="right")
    expect(person.page.get_by_text(HELD)).to_be_visible()
    mouse.up()
    let_go(person)
    mouse.up(button="right")
    pushes = person.page.evaluate(PUSHES)
    mouse.down(button="right")
    mouse.up(button="right")
    assert person.page.evaluate(PUSHES) == pushes


def test_the_end_of_a_session_waits_for_no_other_word(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server)
    person.expects("409")
    drive = floor.drive_off()
    take_controls(person, HOLDS)
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route) if "resume" in (route.request.post_data or "") else route.continue_()

    person.page.route("**/release", hold)
    person.button("Agent goes on").click()
    until(lambda: held or person.page.wait_for_timeout(20), what="a word that is held")
    expect(person.button("Handing back…")).to_be_disabled()
    person.button("End session").click(timeout=5_000)  # sooner than the page gives the other one up
    assert server.await_status(drive["id"], "failed", "completed")["outcome"] == "taken_over"
    expect(person.button("Take the controls")).to_be_visible()
    held[0].continue_()
    expect(person.region("Drive by hand").get_by_role("alert")).to_have_count(0)
    expect(person.alert("You have lost the controls")).to_have_count(0)


def test_a_rollback_that_a_link_held_back_ends_no_pause_that_came_meanwhile(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.expects("409")
    drive = floor.drive_off()
    take_controls(person, HOLDS)
    held: list[Route] = []
    person.page.route("**/release", lambda route: held.append(route))  # noqa: PLW0108 (Playwright takes no built-in)
    person.button("Roll back").click()
    until(lambda: held or person.page.wait_for_timeout(20), what="a word that is held")
    assert server.post(f"/v1/invocations/{drive['id']}/pause", key="operator_2").is_success
    held[0].continue_()
    expect(person.region("Drive by hand").get_by_role("alert")).to_contain_text("“operator_2” said “pause”")
    assert (server.cell()["status"], server.cell()["control"]["phase"]) == ("paused", "held")


def test_a_takeover_that_a_link_held_back_ends_no_pause_that_came_meanwhile(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.expects("409")
    drive = floor.drive_off()
    person.press("t")
    panel = person.region("Drive by hand")
    expect(panel).to_contain_text(HOLDS)
    held: list[Route] = []
    person.page.route("**/takeover", lambda route: held.append(route))  # noqa: PLW0108 (Playwright takes no built-in)
    person.button("Take the controls").click()
    until(lambda: held or person.page.wait_for_timeout(20), what="a word that is held")
    assert server.post(f"/v1/invocations/{drive['id']}/pause", key="operator_2").is_success
    held[0].continue_()
    expect(panel.get_by_role("alert")).to_contain_text("“operator_2” said “pause”")
    assert (server.cell()["status"], server.cell()["control"]) == ("paused", None)
    person.page.unroute("**/takeover")
    person.button("Take the controls and end the pause").click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()


def test_the_controls_of_an_idle_cell_that_come_when_it_was_left_are_given_back(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.press("t")
    held: list[Route] = []
    person.page.route("**/takeover", lambda route: held.append(route))  # noqa: PLW0108 (Playwright takes no built-in)
    person.button("Take the controls").click()
    until(lambda: held or person.page.wait_for_timeout(20), what="a request that is held")
    person.press("4")
    expect(person.page.get_by_role("heading", name="Fleet")).to_be_visible()
    held[0].continue_()
    expect(person.alert("You do not have the controls of workcell-1. They came when you had left it")).to_be_visible()
    until(lambda: server.cell()["control"] is None, what="controls that were given back", within_s=2.5)
    person.button("Understood").click()
    expect(person.alert("You do not have")).to_have_count(0)
    expect(person.alert("You have lost")).to_have_count(0)


def two_who_may(server: ServerProcess, people: People) -> tuple[Person, Person]:
    """Sit two people down before the same free controls; the first is refused them."""
    one, other = people.sit(server), people.sit(server, "operator_2")
    one.expects("409")
    for person in (one, other):
        person.press("t")
    for person in (one, other):
        expect(person.button("Take the controls")).to_be_enabled()
    return one, other


def test_why_the_controls_were_not_given_is_said_as_long_as_it_is_so_and_stays_if_heard_before_who_has_them(
    server: ServerProcess, people: People, floor: Floor, free_again: None
) -> None:
    one, other = two_who_may(server, people)
    panel = one.region("Drive by hand")
    held: list[Route] = []
    one.page.route("**/takeover", lambda route: held.append(route))  # noqa: PLW0108 (Playwright takes no built-in)
    one.button("Take the controls").click()
    until(lambda: held or one.page.wait_for_timeout(20), what="a request that is held")
    other.button("Take the controls").click()
    expect(panel).to_contain_text("operator_2 (remote) has the controls")
    held[0].continue_()
    expect(panel.get_by_role("alert")).to_contain_text("operator_2")
    other.button("End session").click()
    expect(one.button("Take the controls")).to_be_visible()
    expect(panel.get_by_role("alert")).to_have_count(0)
    one.page.unroute("**/takeover")
    expect(other.button("Take the controls")).to_be_enabled()
    problem = {"title": "Conflict", "status": 409, "code": "control_held", "detail": "`operator_2` has the controls"}
    one.page.route("**/takeover", lambda route: route.fulfill(status=409, json=problem))
    one.button("Take the controls").click()
    expect(panel.get_by_role("alert")).to_contain_text("operator_2")
    other.button("Take the controls").click()
    expect(panel).to_contain_text("operator_2 (remote) has the controls")
    one.page.evaluate(THREE_FRAMES)
    expect(panel.get_by_role("alert")).to_contain_text("operator_2")
    other.button("End session").click()
    expect(panel.get_by_role("alert")).to_have_count(0)


def test_why_controls_were_refused_goes_when_the_session_they_were_asked_of_is_over_and_not_before_it_was_read(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    session = floor.drive_off()
    person = people.sit(server)
    person.press("t")
    panel = person.region("Drive by hand")
    problem = {"title": "Conflict", "status": 409, "code": "control_held", "detail": "`operator_2` has the controls"}
    person.expects("409")
    person.page.route("**/takeover", lambda route: route.fulfill(status=409, json=problem))
    person.button("Take the controls").click()
    refused = panel.get_by_role("alert").filter(has_text="operator_2")
    expect(refused).to_be_visible()
    assert server.post(f"/v1/invocations/{session['id']}/cancel").is_success
    until(lambda: server.cell()["busy"] is None, what="a session that is over")
    expect(panel).to_contain_text("You get the controls of the idle cell.")
    person.page.wait_for_timeout(2_000)
    expect(refused).to_be_visible()
    expect(refused).to_have_count(0)


def test_whoever_signs_out_with_the_controls_is_told_what_becomes_of_them_and_who_loads_the_page_anew_keeps_them(
    server: ServerProcess, people: People, floor: Floor, free_again: None
) -> None:
    session = floor.drive_off()
    person = people.sit(server)
    person.press("t")
    person.button("Take the controls").click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    reload_in_hand(person, floor)
    told = person.page.get_by_text("You had the controls of workcell-1")
    expect(told).to_have_count(0)
    person.press("?")
    person.page.get_by_role("button", name="Sign out", exact=True).click()
    expect(told).to_contain_text("the robot comes to rest, and a session that you took over waits for a person.")
    until(lambda: server.cell()["control"] is None, what="controls that nobody has")
    server.await_status(session["id"], "escalated")


@pytest.fixture
def shared_again(server: ServerProcess) -> Iterator[None]:
    yield
    put_in_profile(server, "human-shared")


def test_what_runs_is_taken_over_by_the_profile_it_was_launched_under_and_says_which_that_is(
    server: ServerProcess, people: People, floor: Floor, shared_again: None
) -> None:
    person = people.sit(server)
    floor.drive_off()
    person.press("t")
    panel, session = person.region("Drive by hand"), person.region("Session")
    put_in_profile(server, "sim-relaxed")  # nobody takes the controls of what is launched there
    expect(session).to_contain_text(
        "Launched under human-shared, it keeps that: sim-relaxed holds for what comes next."
    )
    expect(panel).to_contain_text(HOLDS)
    person.button("Take the controls").click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    person.button("End session").click()
    expect(panel).to_contain_text("Nobody takes the controls under “sim-relaxed”: put workcell-1")
    expect(session).not_to_contain_text("Launched under")
    floor.drive_off()
    put_in_profile(server, "human-shared")
    expect(panel).to_contain_text("Nobody takes the controls of what was launched under “sim-relaxed”")
    expect(person.button("Take the controls")).to_be_disabled()


def test_a_pause_that_is_refused_stands_where_it_was_pressed(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.expects("409")
    floor.drive_off()
    pause = person.button("Pause")
    expect(pause).to_be_in_viewport(ratio=1)
    at = box(pause)
    problem = {"title": "Conflict", "status": 409, "code": "ending", "detail": "it is coming to its end"}
    person.page.route("**/pause", lambda route: route.fulfill(status=409, json=problem))
    pause.click()
    expect(person.alert("It is coming to its end.")).to_be_in_viewport(ratio=1)
    assert box(pause) == at


def test_a_session_is_paused_by_a_button_while_the_controls_are_offered_or_somebody_elses(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    one, other = people.sit(server), people.sit(server, "operator_2")
    floor.drive_off()
    for person in (one, other):
        person.press("t")
        expect(person.region("Drive by hand")).to_contain_text(HOLDS)
        expect(person.button("Pause")).to_be_in_viewport(ratio=1)
    other.button("Pause").click()
    expect(one.region("Drive by hand")).to_contain_text("operator_2 has paused this session.")
    expect(other.region("Drive by hand")).to_contain_text("You have paused this session.")
    one.button("Take the controls and end the pause").click()
    expect(one.region("Drive by hand")).to_contain_text("The pause by operator_2 ended when you took the controls")
    expect(other.region("Drive by hand")).to_contain_text("One person drives at a time")
    expect(other.page.get_by_role("status").filter(has_text="Your pause ended")).to_contain_text("The agent waits.")
    other.button("Pause").click()
    expect(one.region("Drive by hand")).to_contain_text("operator_2 paused the session")
    expect(one.button("Agent goes on")).to_be_disabled()


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.drawn
def test_whoever_drives_sees_the_robot_above_the_pad(
    server: ServerProcess, people: People, floor: Floor, size: dict[str, int]
) -> None:
    person = people.sit(server, size=size)
    take_controls(person)
    for speed in ("Base speed", "Tool speed"):
        expect(person.page.get_by_role("group", name=speed)).to_be_attached()
    scene, pad = box(person.region("The cell in 3D")), box(person.region("Drive by hand"))
    assert scene["y"] + scene["height"] <= pad["y"]
    assert scene["height"] >= LEAST_PX
    expect(person.region("The cell in 3D")).to_be_in_viewport(ratio=1)
    for name in ("Base forward, hold to run", "Tool down, hold to run", "End session"):
        expect(person.button(name)).to_be_in_viewport(ratio=1)
    if size == PHONE:
        assert out_of_reach(stop(person)) == []
        # What it was held for may be asked for a moment longer.
        person.page.evaluate("document.querySelector('.live').classList.add('asking', 'held')")
        assert box(person.region("The cell in 3D")) == scene
    else:
        resize(person, DESK_SMALL)
        the_way_back_is_named_and_the_legend_keeps_out_of_the_picture(person)


def the_way_back_is_named_and_the_legend_keeps_out_of_the_picture(person: Person) -> None:
    back = person.region("Drive by hand").get_by_role("group", name="Hand back")
    expect(back.get_by_role("heading", name="Hand back")).to_be_in_viewport(ratio=1)
    expect(back.locator("kbd")).to_be_visible()
    scene = person.region("The cell in 3D")
    legend, pause = scene.locator(".legend"), scene.get_by_role("button", name="Pause")
    expect(legend).to_contain_text("protective distance")
    assert abs(box(legend)["y"] + box(legend)["height"] - box(pause)["y"] - box(pause)["height"]) < 2  # beside it
    assert not overlap(box(legend), box(pause))
    expect(scene.locator(".labels span", has_text="robot")).to_be_visible()
    assert not overlap(box(legend), box(scene.locator(".labels span", has_text="robot")))


def test_the_controls_outlive_a_reload_and_go_to_another_window_only_when_asked(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    one, other = people.sit(server, init=BENCH), people.sit(server, init=BENCH)
    take_controls(one)
    reload_in_hand(one, floor)
    began, keyboard = floor.base(), one.page.keyboard
    insist(
        one,
        lambda: keyboard.down("ArrowDown"),
        lambda: keyboard.up("ArrowDown"),
        lambda: far(floor.base(), began) > 0.1,
        "a base driven after a reload",
    )
    other.press("t")
    expect(other.region("Drive by hand")).to_contain_text("in another window")
    assert other.page.evaluate("window.jogs") == []
    other.button("Drive from here").click()
    expect(one.region("Drive by hand")).to_contain_text("in another window")
    expect(other.page.get_by_text(LET_GO)).to_be_visible()
    at_rest(floor)
    assert server.cell()["control"]["holder"] == "operator"


def test_whoever_has_a_browser_that_may_store_nothing_signs_in_and_gets_the_controls(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=NOTHING_STORED)
    take_controls(person)
    person.button("End session").click()
    expect(person.region("Drive by hand")).to_contain_text(IDLE)


def test_whoever_drives_goes_on_when_the_clock_is_set_back(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, init=BENCH + SET_BACK)
    take_controls(person)
    keyboard = person.page.keyboard

    def drives() -> None:
        expect(person.page.get_by_text(LET_GO)).to_be_visible()
        began = floor.base()
        insist(
            person,
            lambda: keyboard.down("ArrowDown"),
            lambda: keyboard.up("ArrowDown"),
            lambda: far(floor.base(), began) > 0.1,
            "a base that is driven",
        )
        keyboard.up("ArrowDown")

    person.page.evaluate("sessionStorage.setItem('back', 3600e3)")
    reload_in_hand(person, floor)
    drives()
    for page in ("Audit", "Live"):
        person.page.get_by_role("link", name=page, exact=True).first.click()
    drives()


def test_whoever_leaves_the_pad_is_told_that_the_controls_have_gone(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    take_controls(person)
    person.press("4")
    expect(person.alert("You have lost the controls.")).to_be_visible()
    assert server.cell()["control"] is None
    person.button("Understood").click()
    expect(person.alert("You have lost the controls.")).to_have_count(0)


def test_on_a_phone_nothing_is_wider_than_the_screen_while_the_cell_is_latched(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    stop(person).tap()
    person.button("Reset…").tap()
    expect(person.button("Keep stopped")).to_be_in_viewport(ratio=1)
    assert wider_than_the_screen(person.page) == []
    assert out_of_reach(stop(person)) == []
    person.page.set_viewport_size(MAGNIFIED)
    person.page.evaluate(THREE_FRAMES)
    expect(stop(person)).to_be_in_viewport(ratio=1)
    person.button("Keep stopped").scroll_into_view_if_needed()
    expect(person.button("Keep stopped")).to_be_in_viewport(ratio=1)  # the bar covers nothing that is scrolled to
