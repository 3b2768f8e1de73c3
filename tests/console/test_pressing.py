"""Pressed twice, or with something still held: what comes under the same finger is not pressed with it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import product

import pytest
from playwright.sync_api import Locator, Route, expect

from tests.conftest import ServerProcess, until
from tests.console.conftest import (
    DESK,
    LET_GO,
    PHONE,
    Floor,
    People,
    Person,
    at_once,
    box,
    reload_in_hand,
    stop,
)

pytestmark = [pytest.mark.browser, pytest.mark.process, pytest.mark.usefixtures("free_again")]
# An ear for the commands that the page hands to its link.
LISTENING = """
    window.jogs = [];
    const post = Worker.prototype.postMessage;
    Worker.prototype.postMessage = function (message, ...rest) {
        if (message?.message?.type === 'jog') window.jogs.push(message.message);
        return post.call(this, message, ...rest);
    };
"""
PUSHES = "window.jogs.filter((jog) => jog.grip !== null || [...jog.base, ...jog.tool].some(Boolean)).length"
STANDS_MPS, DRIVES_MPS = 0.01, 0.05
SOON_MS = (150, 300)
SIZES = pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])


def listed(person: Person, kind: str) -> list[str]:
    """Keep a list of what the page asks the server for by POST from now on."""
    said: list[str] = []
    person.hears("request", lambda one: said.append(one.url) if one.method == "POST" and kind in one.url else None)
    return said


def offered(person: Person, size: dict[str, int]) -> Locator:
    """Have the controls offered; returns the button that takes them."""
    person.button("Drive").tap() if size == PHONE else person.press("t")
    return person.button("Take the controls")


def test_no_letter_decides_a_question_while_its_reader_drives(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=LISTENING)
    asked = floor.ask()
    card, deny = person.page.get_by_role("article", name="Grasp mug_1"), person.button(re.compile("^Deny"))
    expect(card).to_be_visible()
    offered(person, DESK).click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    expect(card).to_contain_text("While you drive, A, D and S answer nothing")
    expect(deny).to_be_enabled()
    for key in "asd":
        person.press(key)
    person.page.keyboard.down("ArrowDown")
    for key in "asd":
        person.press(key)
    person.page.keyboard.up("ArrowDown")
    expect(card).not_to_contain_text("Seen by")
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"

    # and a denial that asks why has the focus go to its list, with the key that drives still down
    until(lambda: floor.speed() < STANDS_MPS, what="a base at rest")
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    person.page.keyboard.down("ArrowDown")
    until(lambda: floor.speed() > DRIVES_MPS, what="a base that drives")
    deny.click()
    expect(person.page.get_by_label("Reason if denied")).to_be_focused()
    person.page.keyboard.up("ArrowDown")
    until(lambda: floor.speed() < STANDS_MPS, what="a base that was let go of")
    pushed = person.page.evaluate(PUSHES)
    person.press("ArrowDown")  # it is the list's here
    person.press("Escape")
    assert person.page.evaluate(PUSHES) == pushed
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"
    person.says_why()
    deny.click()
    assert floor.settled(asked["id"])["status"] == "denied"


def test_who_goes_on_choosing_in_a_list_that_is_gone_drives_nothing_by_it(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=LISTENING)
    asked = floor.ask()
    expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    offered(person, DESK).click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    person.button(re.compile("^Deny")).click()
    expect(person.page.get_by_label("Reason if denied")).to_be_focused()
    person.press("ArrowDown")
    floor.answer(asked, "deny")  # as somebody else may
    expect(person.page.get_by_role("article")).to_have_count(0)
    person.page.keyboard.down("ArrowDown")
    person.page.wait_for_timeout(200)  # for what the page would say to the robot
    person.page.keyboard.up("ArrowDown")
    assert person.page.evaluate(PUSHES) == 0
    expect(person.page.get_by_role("status").filter(has_text="Key ↓ not heard: you were typing.")).to_be_visible()
    person.press("Escape")
    person.page.keyboard.down("ArrowDown")  # whoever means the robot is heard
    until(lambda: person.page.evaluate(PUSHES) > 0, what="a key that drives")
    person.page.keyboard.up("ArrowDown")


def test_whoever_presses_a_shortcut_too_soon_upon_what_they_typed_is_told_that_it_was_not_heard(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    paused = listed(person, "/pause")
    asked = floor.ask()
    missed = person.page.get_by_role("status").filter(has_text="Key P not heard: you were typing.")
    person.page.get_by_label(re.compile("^Speed you approve")).press_sequentially("0")
    running = floor.drive_off()
    expect(person.button("Pause")).to_be_enabled()
    floor.answer(asked, "deny")  # as somebody else may
    expect(person.page.get_by_role("article")).to_have_count(0)
    person.press("p")
    expect(missed).to_be_visible()
    assert paused == []
    person.page.wait_for_timeout(2_000)
    person.press("p")
    until(lambda: paused or person.page.wait_for_timeout(20), what="a pause")
    expect(missed).to_have_count(0)
    assert server.await_status(running["id"], "paused")["status"] == "paused"


def test_the_key_that_drove_answers_nothing_where_the_controls_are_lost_while_it_is_held(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=LISTENING)
    asked = floor.ask()
    expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    offered(person, DESK).click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    cdp = person.page.context.new_cdp_session(person.page)

    def key(what: str, **more: object) -> None:  # as on a French keyboard, where the key that turns says “a”
        cdp.send("Input.dispatchKeyEvent", {"type": what, "key": "a", "code": "KeyQ", **more})

    key("rawKeyDown")
    until(lambda: person.page.evaluate(PUSHES) > 0, what="a key that drives")
    assert server.post(f"/v1/invocations/{server.cell()['control']['invocation']}/cancel").is_success
    expect(person.page.get_by_role("group", name="Hold to run")).to_have_count(0)
    for _ in range(15):  # whoever turns sees that it turns no more
        key("rawKeyDown", autoRepeat=True)
        person.page.wait_for_timeout(100)
    key("keyUp")
    key("rawKeyDown")
    key("keyUp")
    person.page.wait_for_timeout(100)  # for what the page would send
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"


def test_what_is_held_is_let_go_where_a_menu_or_a_list_opens_that_has_the_next_keys(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=LISTENING)
    offered(person, DESK).click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    keyboard, pad = person.page.keyboard, person.button("Base back, hold to run")
    moving = "window.jogs.at(-1).base.some(Boolean)"
    opens: list[Callable[[], object]] = [
        lambda: person.region("Drive by hand").get_by_role("heading", name="Drive by hand").click(button="right"),
        lambda: person.page.get_by_label("Cell", exact=True).click(),
    ]
    for open_it in opens:
        keyboard.down("ArrowDown")
        until(lambda: person.page.evaluate(moving), what="a key that drives")
        open_it()
        until(lambda: not person.page.evaluate(moving), what="a key that was let go of")
        keyboard.down("ArrowDown")  # it is held still
        person.page.wait_for_timeout(200)
        assert not person.page.evaluate(moving)
        keyboard.up("ArrowDown")
        person.press("Escape")
        person.region("Drive by hand").get_by_role("heading", name="Drive by hand").click()
    # A finger that stays on the pad opens none.
    pad.hover()
    person.page.mouse.down()
    until(lambda: person.page.evaluate(moving), what="a pad that drives")
    pad.dispatch_event("contextmenu")
    person.page.wait_for_timeout(200)
    assert person.page.evaluate(moving)
    person.page.mouse.up()
    until(lambda: not person.page.evaluate(moving), what="a pad that was let go of")


@pytest.mark.parametrize("held", [False, True], ids=["pressed again and again", "held"])
def test_who_scrolls_by_space_as_a_question_comes_denies_nothing_by_it(
    server: ServerProcess, people: People, floor: Floor, held: bool
) -> None:
    person = people.sit(server)
    person.page.locator("#page").focus()
    asked, deny = floor.ask(), person.button(re.compile("^Deny"))
    expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    for _ in range(8):
        person.page.keyboard.down(" ")
        if not held:
            person.page.keyboard.up(" ")
        person.page.wait_for_timeout(200)
    expect(deny).to_be_focused()
    person.page.keyboard.up(" ")
    expect(person.alert("Why? Choose a reason")).to_have_count(0)
    person.page.wait_for_timeout(1_000)  # by then it is no scrolling any more
    person.press(" ")
    expect(person.alert("Why? Choose a reason")).to_be_visible()
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"


@pytest.mark.parametrize("after_ms", SOON_MS)
def test_an_approval_pressed_twice_on_a_phone_rolls_nothing_back(
    server: ServerProcess, people: People, floor: Floor, after_ms: int
) -> None:
    person = people.sit(server, size=PHONE)
    rolled_back = listed(person, "/rollback")
    asked = floor.ask()
    person.button("Read it first").tap()
    person.twice(person.button(re.compile("^Approve")), after_ms)
    expect(person.button(re.compile("^Approve"))).to_have_count(0)
    expect(person.button("Pause")).to_be_enabled()
    assert server.post(f"/v1/invocations/{asked['id']}/pause").is_success  # it is not to end meanwhile
    expect(person.button("Roll back")).to_be_enabled()
    assert rolled_back == []
    person.button("Roll back").tap()
    until(lambda: rolled_back or person.page.wait_for_timeout(20), what="a rollback that was asked for")
    assert server.await_status(asked["id"], "failed", "completed")["outcome"] == "rolled_back"
    person.page.wait_for_timeout(20)  # for what else the browser has to tell
    assert len(rolled_back) == 1


@pytest.mark.parametrize("wheres", [("desk", "fleet"), ("phone",)], ids=["desk", "phone"])
def test_a_reset_pressed_twice_goes_no_further_than_its_first_step(
    server: ServerProcess, people: People, floor: Floor, wheres: tuple[str, ...]
) -> None:
    person = people.sit(server, size=PHONE if wheres == ("phone",) else DESK)
    for where, after_ms in product(wheres, SOON_MS):
        person.page.evaluate(f"location.hash = '#/{'fleet' if where == 'fleet' else 'live'}'")
        stop(person).click()
        here = person.region("workcell-1") if where == "fleet" else person.page
        at = person.twice(here.get_by_role("button", name="Reset…"), after_ms)
        keep, yes = (
            here.get_by_role("button", name="Keep stopped"),
            here.get_by_role("button", name="Yes, reset the stop"),
        )
        expect(keep).to_be_focused()
        expect(yes).to_be_enabled()  # by now it would count
        assert server.cell()["latched"] is True
        safe = box(keep)
        assert safe["x"] <= at["x"] <= safe["x"] + safe["width"]
        yes.click()
        until(lambda: not server.cell()["latched"], what="a stop that is reset")
        expect(yes).to_have_count(0)
        expect(here.get_by_role("button", name="Reset…")).to_have_count(0)  # or the next one would be taken for it


def test_escape_keeps_a_cell_stopped_before_it_closes_the_panel_for_driving(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    panel, keep = person.region("Drive by hand"), person.button("Keep stopped")
    person.press("t")
    expect(panel).to_be_visible()
    person.press(".")
    person.button("Reset…").click()
    expect(keep).to_be_focused()
    person.press("Escape")
    expect(keep).to_have_count(0)
    expect(panel).to_be_visible()
    expect(person.button("Reset…")).to_be_focused()
    person.press("Escape")
    expect(panel).to_have_count(0)
    assert server.cell()["latched"] is True


def test_a_cell_that_is_kept_stopped_stays_so_though_its_reset_was_on_its_way(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.expects("409")
    said = listed(person, "/estop")
    stop(person).click()
    person.button("Reset…").click()
    with at_once("**/reset", person):
        person.button("Yes, reset the stop").click()
        before = len(said)
        person.button("Keep stopped").click()
        expect(person.button("Reset…")).to_be_visible()
        until(lambda: len(said) > before or person.page.wait_for_timeout(20), what="a stop that was said again")
    expect(person.alert("The stop was pressed again")).to_be_visible()
    assert server.cell()["latched"] is True


def test_the_safe_choice_has_the_focus_however_often_its_first_step_was_pressed_meanwhile(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    stop(person).click()
    for where in ("live", "fleet"):
        person.page.evaluate(f"location.hash = '#/{where}'")
        here = person.region("workcell-1") if where == "fleet" else person.page
        with at_once("**/reset", person):
            person.twice(here.get_by_role("button", name="Reset…"), 150)
        expect(here.get_by_role("button", name="Keep stopped")).to_be_focused()
        person.enter(here.get_by_role("button", name="Keep stopped"))
        expect(here.get_by_role("button", name="Reset…")).to_be_visible()


def test_whoever_goes_on_from_the_list_of_keys_to_a_banner_behind_it_sees_the_banner(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    assert server.post("/v1/cells/workcell-1/estop").is_success
    reset, listed = person.button("Reset…"), person.page.get_by_role("dialog", name="Keys")
    expect(reset).to_be_visible()
    person.press("?")
    expect(listed).to_be_visible()
    stop(person).focus()
    expect(listed).to_be_visible()  # it stands beside it
    person.press("Tab")
    expect(reset).to_be_focused()
    expect(listed).to_have_count(0)


@SIZES
def test_the_controls_taken_by_a_double_press_move_nothing_and_end_nothing(
    server: ServerProcess, people: People, floor: Floor, size: dict[str, int]
) -> None:
    person = people.sit(server, size=size, init=LISTENING)
    released = listed(person, "/release")
    take = offered(person, size)
    for after_ms in SOON_MS:
        person.twice(take, after_ms)
        expect(person.page.get_by_role("group", name="Hold to run")).to_be_visible()
        expect(person.page.get_by_text(LET_GO)).to_be_visible()
        expect(person.button("End session")).to_be_enabled()
        assert person.page.evaluate(PUSHES) == 0
        assert released == []
        person.button("End session").click()
        expect(take).to_be_enabled()
        released.clear()


def test_keys_and_fingers_held_while_the_controls_are_taken_move_nothing_until_they_are_let_go(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=LISTENING)
    take, keyboard = offered(person, DESK), person.page.keyboard
    expect(take).to_be_enabled()
    keyboard.down("ArrowDown")
    take.click()
    held = person.page.get_by_text("Nothing drives yet: let go of everything")
    expect(held).to_be_visible()
    keyboard.down("BracketLeft")
    keyboard.up("BracketLeft")
    person.page.wait_for_timeout(1_000)  # longer than a control that came waits
    expect(held).to_be_visible()
    expect(person.button("open the gripper, hold to run")).to_be_disabled()
    keyboard.up("ArrowDown")
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    assert person.page.evaluate(PUSHES) == 0
    keyboard.down("ArrowDown")
    until(lambda: person.page.evaluate(PUSHES) > 0, what="a key that drives now")
    keyboard.up("ArrowDown")


def test_the_controls_are_neither_taken_by_a_double_press_on_what_offers_them_nor_on_what_ends_them(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.expects("409")  # the session may be ended twice before the page hears that it has
    taken = listed(person, "/takeover")
    for after_ms in SOON_MS:
        person.twice(person.button("Take over"), after_ms)
        take = person.button("Take the controls")
        expect(take).to_be_enabled()
        assert taken == []
        take.click()
        person.twice(person.button("End session"), after_ms)
        expect(take).to_be_enabled()
        assert len(taken) == 1
        until(lambda: server.cell()["control"] is None, what="controls that are free")
        taken.clear()
        person.button("Close").click()
        expect(take).to_have_count(0)


@pytest.fixture
def granted(server: ServerProcess) -> Iterator[str]:
    """A standing grant for whatever is grasped, of which nothing is left behind."""
    body = {"capability": "grasp_object", "agent": "planner", "cell": "workcell-1", "scope": "time", "minutes": 5}
    given = server.post("/v1/grants", body, key="operator_2").json()["id"]
    yield given
    server.post(f"/v1/grants/{given}/revoke", key="operator_2")


@pytest.mark.parametrize("after_ms", SOON_MS)
def test_handing_back_approves_nothing_before_there_was_time_to_read_what(
    server: ServerProcess, people: People, floor: Floor, granted: str, after_ms: int
) -> None:
    session = floor.grasp_slowly()
    person = people.sit(server)
    person.expects("409.*/release")
    offered(person, DESK).click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    assert server.post(f"/v1/grants/{granted}/revoke", key="operator_2").is_success
    back, released = person.button("Agent goes on"), listed(person, "/release")
    person.twice(back, after_ms)
    expect(person.alert("Medium risk needs approval in human-shared.")).to_be_visible()
    expect(back).to_be_enabled()
    assert len(released) == 1
    assert server.cell()["control"]["invocation"] == session["id"]
    back.click()
    until(lambda: server.cell()["control"] is None, what="a session that was handed back")


@pytest.mark.parametrize("word", ["reload", "roll back"])
def test_handing_back_approves_nothing_that_is_not_on_the_screen_any_more(
    server: ServerProcess, people: People, floor: Floor, granted: str, word: str
) -> None:
    session = floor.grasp_slowly()
    person = people.sit(server)
    person.expects("409.*/release|ERR_FAILED")
    offered(person, DESK).click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    assert server.post(f"/v1/grants/{granted}/revoke", key="operator_2").is_success
    back, asks = person.button("Agent goes on"), person.alert("Medium risk needs approval in human-shared.")
    back.click()
    expect(asks).to_be_visible()
    if word == "reload":
        reload_in_hand(person, floor)
    else:
        person.page.route("**/release", lambda route: route.abort())
        person.button("Roll back").click()
        expect(person.alert("it is not known whether this arrived")).to_be_visible()
        person.page.unroute("**/release")
    expect(asks).to_have_count(0)
    back.click()
    expect(asks).to_be_visible()
    assert server.cell()["control"]["invocation"] == session["id"]
    back.click()
    until(lambda: server.cell()["control"] is None, what="a session that was handed back")
    (word_back,) = [
        event["body"]
        for event in server.get(f"/v1/invocations/{session['id']}/trace")["items"]
        if event["body"].get("then") == "resume"
    ]
    assert word_back["approves"]


@pytest.mark.parametrize("anew", [False, True], ids=["stays", "loads anew"])
def test_handing_back_approves_nothing_where_the_refusal_that_told_what_was_lost(
    server: ServerProcess, people: People, floor: Floor, granted: str, anew: bool
) -> None:
    session = floor.grasp_slowly()
    person = people.sit(server)
    person.expects("409.*/release|ERR_FAILED")
    offered(person, DESK).click()
    expect(person.page.get_by_text(LET_GO)).to_be_visible()
    assert server.post(f"/v1/grants/{granted}/revoke", key="operator_2").is_success
    back = person.button("Agent goes on")
    answers: list[int] = []

    def lose(route: Route) -> None:
        answers.append(route.fetch().status)
        route.abort()

    person.page.route("**/release", lose)
    back.click()
    expect(person.alert("it is not known whether this arrived")).to_be_visible()
    assert answers == [409]
    person.page.unroute("**/release")
    if anew:
        reload_in_hand(person, floor)
    expect(person.region("Events")).to_contain_text("operator cannot hand back yet")  # the page has come as far as that
    back.click()
    expect(person.alert("Medium risk needs approval in human-shared.")).to_be_visible()
    assert server.cell()["control"]["invocation"] == session["id"]
    back.click()
    until(lambda: server.cell()["control"] is None, what="a session that was handed back")


def test_a_pause_counts_at_once(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, size=PHONE)
    floor.drive_off()
    person.button("Pause").wait_for()
    assert person.page.evaluate(
        """() => new Promise((tell) => {
            const name = (button) => button.textContent.trim();
            const pause = [...document.querySelectorAll('footer button')].find((one) => name(one).startsWith('Pause'));
            tell(pause.getAttribute('aria-disabled') === 'false' && pause.closest('[data-arming]') === null);
        })"""
    )
    assert person.page.locator("[data-arming]").get_by_text(re.compile("Emergency stop|Pause")).count() == 0


def test_a_grant_revoked_by_a_double_press_or_a_key_that_is_held_takes_no_other_one_with_it(
    server: ServerProcess, people: People
) -> None:
    body = {"capability": "grasp_object", "agent": "planner", "cell": "workcell-1", "scope": "object", "minutes": 1}
    for thing in ("mug_1", "glass_1", "driver_1", "box_1"):
        assert server.post("/v1/grants", {**body, "object": thing}).is_success
    person = people.sit(server)
    person.expects("409.*/revoke")  # pressed again before its answer is here, it is the same grant's once more
    revoked = listed(person, "/revoke")
    buttons = person.page.get_by_role("list", name="Standing grants").get_by_role("button")
    expect(buttons).to_have_count(4)
    for left, after_ms in zip((3, 2), SOON_MS, strict=True):
        person.twice(buttons.last, after_ms)  # the one above comes down to where it stood
        expect(buttons).to_have_count(left)
        assert len(set(revoked)) == 4 - left
    buttons.first.focus()
    expect(buttons.first).to_be_enabled()
    for _ in range(30):  # as a key repeats that is held
        person.page.keyboard.down("Enter")
        person.page.wait_for_timeout(33)
    expect(buttons).to_have_count(1)
    person.page.keyboard.up("Enter")
    assert len(set(revoked)) == 3
    expect(buttons).to_be_focused()
    person.enter(buttons)
    expect(buttons).to_have_count(0)
    assert len(set(revoked)) == 4
