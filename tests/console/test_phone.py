"""A session in one hand: everything an operator does to it is reached by touch, and the stop stays where it was."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import CDPSession, Locator, Playwright, expect

from app.api.auth import issue_token
from app.governance.model import Role
from tests.conftest import ServerProcess, until
from tests.console.conftest import (
    ANSWERS,
    FLAGS,
    MAGNIFIED,
    NARROWEST,
    PHONE,
    PLACES,
    PRESS_ONCE_MOVED,
    SIDEWAYS,
    SIDEWAYS_SMALL,
    THREE_FRAMES,
    Floor,
    People,
    Person,
    Windows,
    box,
    far,
    on_top,
    out_of_reach,
    resize,
    slide,
    stop,
)

pytestmark = [pytest.mark.browser, pytest.mark.process]
PRESS_ALL = "(found) => found.forEach((one) => one.click())"
# What a finger does to a page on a phone, and in Chromium elsewhere only if asked for.
DRAWS = ("--headless=new", "--pull-to-refresh=1", "--overscroll-history-navigation=1")
DRAWN_STEPS = 24
RING_PX = 4  # around what has the focus


def says(person: Person) -> Locator:
    """What the robot says of itself, in the phone's header."""
    return person.page.locator("header .says")


def test_the_stop_stands_above_the_keyboard_of_the_phone(server: ServerProcess, people: People) -> None:
    person = people.sit(server, size=PHONE)
    # Here no keyboard comes: a browser that heeds this gives the page what the keyboard leaves of the screen.
    asked = person.page.locator("meta[name=viewport]").get_attribute("content")
    assert asked is not None
    assert "interactive-widget=resizes-content" in asked
    person.page.evaluate("location.hash = '#/audit'")
    search = person.page.get_by_role("searchbox", name="Search the record")
    search.tap()
    for left in ({"width": 390, "height": 520}, {"width": 390, "height": 400}):
        resize(person, left)
        expect(search).to_be_focused()
        assert out_of_reach(stop(person)) == [], left


@pytest.mark.parametrize("screen", [PHONE, SIDEWAYS], ids=["upright", "sideways"])
def test_a_page_that_fingers_magnify_leaves_the_stop_where_and_as_large_as_it_was(
    server: ServerProcess, people: People, floor: Floor, screen: dict[str, int]
) -> None:
    person = people.sit(server, size=screen)
    before, fingers = box(stop(person)), person.page.context.new_cdp_session(person.page)
    for apart in range(40, 200, 20):
        points = [{"x": 60, "y": 100}, {"x": 60 + apart, "y": 100}]
        kind = "touchStart" if apart == 40 else "touchMove"  # where the fingers come down
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        person.page.evaluate(THREE_FRAMES)
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    scale = person.page.evaluate("visualViewport.scale")
    assert scale > 1.5
    try:
        stands = {name: scale * value for name, value in box(stop(person)).items()}  # of what is seen now
        assert stands == pytest.approx(before, abs=3)
        assert on_top(stop(person))
        floor.ask()  # whose answers stand in the same bar
        expect(person.button("Deny")).to_be_visible()
        stands = {name: scale * value for name, value in box(stop(person)).items()}
        assert stands == pytest.approx(before, abs=3)
        at = box(stop(person))
        person.page.touchscreen.tap(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
        until(lambda: server.cell()["latched"], what="the stop")
    finally:
        fingers.send("Emulation.setPageScaleFactor", {"pageScaleFactor": 1})
        fingers.detach()
    until(lambda: box(stop(person)) == before or person.page.wait_for_timeout(20), what="a bar that stands as before")


@pytest.fixture
def drawing(playwright: Playwright) -> Iterator[People]:
    """People whose browser heeds a finger that draws at a page: Chromium whole, for its shell has none of that."""
    whole = next(place for name in PLACES if (place := shutil.which(name)) is not None)
    flags = [*FLAGS, "--disable-3d-apis", *DRAWS]
    with playwright.chromium.launch(executable_path=whole, headless=False, args=flags) as browser:
        made = People(Windows(browser))
        yield made
        assert made.leave() == []


def test_a_finger_that_draws_at_the_page_neither_loads_it_anew_nor_leaves_it(
    server: ServerProcess, drawing: People, floor: Floor
) -> None:
    person = drawing.sit(server, size=PHONE)
    person.page.evaluate("window.stays = true; location.hash = '#/fleet'")
    expect(person.page.get_by_role("heading", name="workcell-1")).to_be_visible()
    for start, end in (((200, 120), (200, 760)), ((200, 30), (200, 760)), ((40, 400), (380, 400))):
        slide(person, start, end, DRAWN_STEPS)
        person.page.wait_for_timeout(1_000)  # it would be gone by then
        assert person.page.evaluate("[window.stays, location.hash]") == [True, "#/fleet"]


def test_a_pause_counts_though_the_thumb_slides_off_it(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, size=PHONE)
    drive = floor.drive_off()
    until(lambda: floor.speed() > 0.05, what="a base that moves")
    at = box(person.button("Pause"))
    x, y = at["x"] + at["width"] / 2, at["y"] + at["height"] / 2
    slide(person, (x, y), (x, y - 150))
    server.await_status(drive["id"], "paused")
    words = server.get(f"/v1/audit/events?invocation={drive['id']}&kind=human")["items"]
    assert [event["body"]["op"] for event in words if event["actor"] == "operator"] == ["pause"]


@pytest.mark.drawn
def test_a_session_is_paused_resumed_and_rolled_back_by_touch(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    began = floor.base()
    drive = floor.drive_off()
    until(lambda: far(floor.base(), began) > 0.2, what="a base on its way")
    person.button("Pause").tap()
    expect(says(person)).to_contain_text("Paused, holding")
    assert out_of_reach(stop(person)) == []
    person.button("Resume").tap()
    expect(says(person)).to_contain_text("Running")
    expect(person.button("Pause")).to_be_in_viewport(ratio=1)
    person.button("Roll back").tap()
    ended = server.await_status(drive["id"], "failed", "completed")
    assert ended["outcome"] == "rolled_back"
    assert far(floor.base(), began) < 0.1
    expect(person.button(re.compile("Pause|Resume|Roll back"))).to_have_count(0)


def test_a_stop_is_left_in_two_steps_on_the_fleet_page(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, size=PHONE)
    person.page.evaluate("location.hash = '#/fleet'")
    card = person.region("workcell-1")
    card.get_by_label("Profile").select_option("real-restricted")
    card.get_by_role("button", name="Change…").tap()
    person.enter(card.get_by_role("button", name="Keep human-shared"))
    expect(card.get_by_label("Profile")).to_be_focused()  # what goes gives the focus back
    card.get_by_role("button", name="Emergency stop of workcell-1").tap()
    expect(card.get_by_text("workcell-1 is latched")).to_be_visible()
    assert person.sends("**/v1/cells/workcell-1/reset", card.get_by_role("button", name="Reset…")) == {"step": "arm"}
    assert server.cell()["latched"] is True
    expect(card.get_by_role("button", name="Keep stopped")).to_be_focused()
    second = person.sends("**/v1/cells/workcell-1/reset", card.get_by_role("button", name="Yes, reset the stop"))
    assert second["step"] == "confirm"
    expect(card.get_by_role("button", name="Emergency stop of workcell-1")).to_be_visible()
    assert server.cell()["latched"] is False


def read_all(person: Person) -> None:
    """Press "Read it first" for as long as it stands there; no value may be out of sight when it does not."""
    read, rows = person.button("Read it first"), person.page.get_by_role("article").locator("tbody tr, .body li")
    seen = set()
    person.page.evaluate(THREE_FRAMES)
    while True:
        seen |= {k for k in range(rows.count()) if readable(rows.nth(k))}
        if read.count() == 0:
            break
        read.evaluate_all(PRESS_ALL)  # it goes once the last line was read
        person.page.evaluate(THREE_FRAMES)
    assert len(seen) == rows.count() > 3


def bottom(part: Locator) -> float:
    at = box(part)
    return at["y"] + at["height"]


def readable(row: Locator) -> bool:
    """Say whether both ends of a line are where a finger would hit it, and nothing that lies over it."""
    return row.evaluate(
        """(row) => { const {x, y, width, bottom} = row.getBoundingClientRect();
        return [y + 3, bottom - 3].every((at) => row.contains(document.elementFromPoint(x + width / 2, at))); }"""
    )


# As one of 400 letters is where they are large and spaced out: lower than the screen, of which a bar takes a part. From
# the first moment on: a line that stood there otherwise for a while would have been read.
LARGE_REASONS = """const large = new CSSStyleSheet();
large.replaceSync('article li p { padding-top: 660px; }');
document.adoptedStyleSheets = [...document.adoptedStyleSheets, large];"""


def test_a_reason_that_is_higher_than_the_room_above_the_stop_is_read_to_its_end(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    asked = floor.ask()
    person = people.sit(server, size=PHONE, init=LARGE_REASONS)
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    reasons = person.page.get_by_role("article").locator("li")
    room = person.page.locator("#page").evaluate("(page) => page.clientHeight")
    assert room < box(reasons.first)["height"] < PHONE["height"]
    expect(read).to_be_visible()
    ended = set()

    def readies() -> bool:
        read.evaluate_all(PRESS_ALL)
        person.page.wait_for_timeout(400)
        page = box(person.page.locator("#page"))
        ended.update(
            k for k in range(reasons.count()) if page["y"] < bottom(reasons.nth(k)) <= page["y"] + page["height"]
        )
        return approve.count() == 1

    until(readies, what="an answer that can be given")
    assert len(ended) == reasons.count()
    expect(approve).to_be_enabled()
    approve.tap()
    assert floor.settled(asked["id"])["status"] == "running"


LONG_REASONS = """const long = new CSSStyleSheet();
long.replaceSync('article li p i:last-of-type { display: block; margin-top: 1000px; }');
document.adoptedStyleSheets = [...document.adoptedStyleSheets, long];"""


def test_a_reason_that_is_higher_than_the_room_is_not_read_by_its_end_alone(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    floor.ask()
    person = people.sit(server, size=PHONE, init=LONG_REASONS)
    approve, lines = person.button(re.compile("^Approve")), person.page.locator("article .body li, article tbody tr")
    skipped = lines.nth(1)

    def look(line: Locator, block: str) -> None:
        line.evaluate("(line, block) => line.scrollIntoView({ block })", block)
        person.page.wait_for_timeout(500)  # longer than what is read has to be there

    for line in lines.all():
        for block in ("start", "end"):
            if block == "end" or line.inner_text() != skipped.inner_text():
                look(line, block)
    expect(person.button("Read it first")).to_be_visible()
    look(skipped, "start")
    expect(approve).to_be_enabled()


def test_a_value_that_just_fits_above_the_stop_can_be_read(server: ServerProcess, people: People, floor: Floor) -> None:
    floor.ask()
    person = people.sit(server, size=PHONE)
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    # As where letters are large and spaced out on a small screen: all of it fits, with no room around it.
    person.page.evaluate(
        """() => { const large = new CSSStyleSheet(), high = document.querySelector('#page').clientHeight - 3;
        large.replaceSync(`article tbody tr { height: ${high}px }`);
        document.adoptedStyleSheets = [...document.adoptedStyleSheets, large]; }"""
    )

    def readies() -> bool:
        read.evaluate_all(PRESS_ALL)
        person.page.wait_for_timeout(400)
        return approve.count() == 1

    until(readies, within_s=60, what="an answer that can be given")


ACROSS = """() => { const seen = visualViewport, bar = document.querySelector('footer').getBoundingClientRect();
    return [...document.querySelectorAll('article tbody tr, article .body li')].map((line) => {
        const {left, right, top, bottom} = line.getBoundingClientRect();
        const over = Math.min(seen.offsetTop + seen.height, bar.top);
        if (top < seen.offsetTop - 1 || bottom > over + 1) return [0, 0];
        const until = Math.min(right, seen.offsetLeft + seen.width);
        return [Math.max(left, seen.offsetLeft) - left, until - left].map((px) => px / (right - left)); }); }"""


def test_of_a_page_that_fingers_magnify_all_was_on_the_screen_before_a_finger_approves(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    fingers = person.page.context.new_cdp_session(person.page)
    fingers.send("Emulation.setPageScaleFactor", {"pageScaleFactor": 2.5})
    person.page.evaluate(THREE_FRAMES)
    try:
        floor.ask()
        approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
        expect(person.button(re.compile("^Deny"))).to_be_enabled()
        ends: dict[int, float] = {}

        def readies() -> bool:
            read.evaluate_all(PRESS_ALL)
            person.page.wait_for_timeout(450)
            for line, (begin, end) in enumerate(person.page.evaluate(ACROSS)):
                if begin <= ends.setdefault(line, 0) + 0.01:
                    ends[line] = max(ends[line], end)
            return approve.count() == 1

        until(readies, what="an answer that can be given")
        assert len(ends) > 3
        assert {line: end for line, end in ends.items() if end < 0.98} == {}
    finally:
        fingers.send("Emulation.setPageScaleFactor", {"pageScaleFactor": 1})
        fingers.detach()


def _magnified(person: Person, scale: float) -> CDPSession:
    fingers = person.page.context.new_cdp_session(person.page)
    fingers.send("Emulation.setPageScaleFactor", {"pageScaleFactor": scale})
    person.page.evaluate(THREE_FRAMES)
    return fingers


def led_to_answer(person: Person) -> None:
    """Press *Read it first* until all was read and an approval can be given."""
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()

    def readies() -> bool:
        read.evaluate_all(PRESS_ALL)
        person.page.wait_for_timeout(450)
        return approve.count() == 1

    until(readies, what="an answer that can be given")


def test_of_a_page_that_fingers_magnify_a_little_what_scrolls_in_it_is_read(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    fingers = _magnified(person, 1.1)
    try:
        floor.ask("glass_1", confidence=0.3)
        led_to_answer(person)
        scrolled, pans = person.page.evaluate("[document.querySelector('#page').scrollTop, visualViewport.offsetTop]")
        assert scrolled > 100 > 10 > pans  # the page moved under the screen, and not the screen over the page
        person.page.evaluate("document.querySelector('#page').scrollTop = document.querySelector('#page').scrollHeight")
        expect(person.button("Read it first")).to_be_visible()  # nothing of it is in sight
    finally:
        fingers.send("Emulation.setPageScaleFactor", {"pageScaleFactor": 1})
        fingers.detach()


@pytest.mark.parametrize("scale", [1.1, 1.2])
def test_whoever_magnifies_a_phone_that_is_held_sideways_is_led_to_what_the_bar_lies_over(
    server: ServerProcess, people: People, floor: Floor, scale: float
) -> None:
    person = people.sit(server, size=SIDEWAYS)
    fingers = _magnified(person, scale)
    try:
        floor.ask("glass_1", confidence=0.3)
        led_to_answer(person)
    finally:
        fingers.send("Emulation.setPageScaleFactor", {"pageScaleFactor": 1})
        fingers.detach()


@pytest.mark.parametrize("opened", ["Menu", "Keys"])
def test_no_finger_approves_what_lies_behind_the_menu_or_the_list_of_keys(
    server: ServerProcess, people: People, floor: Floor, opened: str
) -> None:
    asked = floor.ask()
    person = people.sit(server, size=PHONE)
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    read_all(person)
    expect(approve).to_be_enabled()
    over = person.page.get_by_role("navigation", name="Pages and settings")
    person.button("Menu").tap()
    if opened == "Keys":
        over.get_by_role("button", name="Keys").tap()
        over = person.page.get_by_role("dialog", name="Keys")
    expect(over).to_be_visible()
    expect(approve).to_have_count(0)
    read.tap()  # leads to what is behind it
    expect(over).to_have_count(0)
    approve.tap()
    assert floor.settled(asked["id"])["status"] == "running"


@pytest.mark.parametrize(
    "screen", [PHONE, NARROWEST, MAGNIFIED, SIDEWAYS, SIDEWAYS_SMALL], ids=lambda screen: str(screen["width"])
)
def test_the_menu_and_the_list_of_keys_stand_clear_of_the_bar_from_their_first_line_to_their_last(
    server: ServerProcess, people: People, floor: Floor, screen: dict[str, int]
) -> None:
    floor.ask()
    person = people.sit(server, size=PHONE)
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    resize(person, screen)
    menu, listed = person.page.get_by_role("navigation", name="Pages and settings"), person.page.get_by_role("dialog")
    person.button("Menu").tap()
    for line in (menu.get_by_role("link", name="Live"), menu.get_by_role("button", name="Sign out")):
        line.scroll_into_view_if_needed()
        assert on_top(line)
    person.press("?")
    for line in (listed.get_by_role("button", name="Close"), listed.get_by_role("definition").last):
        line.scroll_into_view_if_needed()
        assert on_top(line)


def test_no_finger_signs_out_by_a_menu_that_a_question_has_moved(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    person.button("Menu").tap()
    out = person.page.get_by_role("navigation", name="Pages and settings").get_by_role("button", name="Sign out")
    expect(out).to_be_enabled()
    out.evaluate(PRESS_ONCE_MOVED)
    floor.ask()
    assert until(lambda: person.page.evaluate("window.pressed"), what="a press") == "Sign out"
    expect(stop(person)).to_be_visible()
    out.tap()
    expect(person.page.get_by_label("Token")).to_be_visible()


def test_what_somebody_changes_again_is_read_again_before_a_finger_approves_it(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    server.tokens["operator_3"] = issue_token(server.data, name="operator_3", role=Role.OPERATOR, station=None)
    asked = floor.ask("driver_1")
    path = f"/v1/escalations/{asked['escalation']['id']}"

    def changed(key: str, **params: float) -> int:
        answer = {"decision": "approve", "digest": server.get(path)["digest"], "params": params}
        return server.post(f"{path}/resolve", answer, key=key).status_code

    until(lambda: changed("operator_3", speed_mps=0.05) == 200, what="a third operator")  # whose token has come
    person = people.sit(server, size=PHONE)
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    read_all(person)
    # Of all that is asked, the last line alone is on the screen.
    last = person.page.get_by_role("article").locator("tbody tr").last
    last.evaluate(
        """(row) => { const page = document.getElementById('page');
        page.scrollTop += row.getBoundingClientRect().top - page.getBoundingClientRect().top - 8; }"""
    )
    expect(approve).to_be_enabled()
    assert changed("operator_2", speed_mps=0.25) == 200
    expect(read).to_be_visible()
    expect(approve).to_have_count(0)
    person.press("a")
    read_all(person)
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"
    expect(approve).to_be_enabled()
    approve.tap()
    floor.settled(asked["id"])
    assert server.get(f"/v1/invocations/{asked['id']}")["effective"]["speed_mps"] == 0.25


HIDE = """(so) => { Object.defineProperty(document, 'visibilityState', {get: () => so, configurable: true});
    document.dispatchEvent(new Event('visibilitychange')); }"""


def test_what_is_changed_while_the_phone_is_in_a_pocket_is_read_again(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    server.tokens["operator_3"] = issue_token(server.data, name="operator_3", role=Role.OPERATOR, station=None)
    asked = floor.ask("driver_1")
    path = f"/v1/escalations/{asked['escalation']['id']}"

    def changed(speed_mps: float) -> int:
        answer = {"decision": "approve", "digest": server.get(path)["digest"], "params": {"speed_mps": speed_mps}}
        return server.post(f"{path}/resolve", answer, key="operator_3").status_code

    until(lambda: changed(0.05) == 200, what="a third operator")  # whose token has come
    person = people.sit(server, size={"width": 390, "height": 1200})  # all of it is on the screen
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    expect(approve).to_be_enabled()
    person.page.evaluate(HIDE, "hidden")
    answer = {"decision": "approve", "digest": server.get(path)["digest"], "params": {"speed_mps": 0.25}}
    assert server.post(f"{path}/resolve", answer, key="operator_2").is_success
    expect(person.page.get_by_role("article").get_by_role("alert")).to_contain_text("Read it again")
    person.page.wait_for_timeout(1_000)
    expect(read).to_be_visible()
    expect(approve).to_have_count(0)
    person.page.evaluate(HIDE, "visible")
    expect(approve).to_be_enabled()


def test_what_a_profile_changes_is_read_from_its_top_with_the_answers_in_sight(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server, size=PHONE)
    person.page.evaluate("location.hash = '#/fleet'")
    card = person.region("workcell-1")
    card.get_by_label("Profile", exact=True).select_option("sim-relaxed")
    card.get_by_role("button", name="Change…").tap()
    keep, yes = (card.get_by_role("button", name=name) for name in ("Keep human-shared", "Yes, change it"))
    expect(keep).to_be_focused()
    expect(card.get_by_text("Put workcell-1 under sim-relaxed?")).to_be_in_viewport(ratio=1)
    rows = card.get_by_role("group", name="What changes").get_by_role("row")
    first, last = rows.nth(1), rows.last
    expect(first).to_be_in_viewport(ratio=1)
    assert on_top(first)
    assert not on_top(last)  # there is more than the page shows
    for answer in (keep, yes):
        expect(answer).to_be_in_viewport(ratio=1)
        assert on_top(answer)
    last.scroll_into_view_if_needed()
    assert on_top(last)
    expect(yes).to_be_in_viewport(ratio=1)
    keep.tap()
    expect(keep).to_have_count(0)


@pytest.mark.parametrize("size", [PHONE, SIDEWAYS], ids=["upright", "sideways"])
def test_approve_is_offered_once_every_line_was_in_sight(
    server: ServerProcess, people: People, floor: Floor, size: dict[str, int]
) -> None:
    person = people.sit(server, size=size)
    floor.ask("glass_1")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    expect(person.page.get_by_role("banner")).to_contain_text(re.compile(r"In control\W*nobody"))
    deny, read = box(person.button(re.compile("^Deny"))), box(person.button("Read it first"))
    assert read["x"] - deny["x"] - deny["width"] >= RING_PX + 2
    read_all(person)
    expect(person.button(re.compile("^Approve"))).to_be_enabled()


def test_why_nothing_can_be_approved_now_is_a_line_to_read(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, size=PHONE)
    floor.ask("glass_1", confidence=0.3, goal="clear bench A and put away what stands there", task="set the table")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    read_all(person)
    expect(person.button(re.compile("^Approve"))).to_be_enabled()
    person.page.evaluate("document.querySelector('#page').scrollTop = 100")
    assert server.post("/v1/cells/workcell-1/estop").is_success
    why, read = person.page.get_by_text("would refuse it"), person.button("Read it first")
    expect(read).to_be_visible()
    expect(why).not_to_be_in_viewport(ratio=1)
    person.tap(read)
    expect(why).to_be_in_viewport(ratio=0.9)
    expect(person.button(re.compile("^Approve"))).to_be_disabled()


def test_drive_opens_its_panel_from_another_page_whether_it_was_left_open_or_not(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    panel = person.region("Drive by hand")
    for _ in range(2):
        person.button("Drive").tap()
        expect(panel).to_be_visible()
        person.press("4")
        expect(person.page.get_by_role("heading", name="Fleet")).to_be_visible()


def test_no_finger_approves_a_question_that_is_out_of_sight(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    asked = floor.ask()
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    read_all(person)
    expect(approve).to_be_enabled()
    person.button("Drive").tap()
    expect(person.button("Take the controls")).to_be_in_viewport()
    expect(read).to_be_in_viewport(ratio=1)
    expect(approve).to_have_count(0)
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    person.press("a")
    read.tap()
    expect(approve).to_be_disabled()  # until there was a moment to read
    for part in ("heading", "textbox"):
        expect(person.page.get_by_role("article").get_by_role(part).first).to_be_in_viewport(ratio=1)
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"
    expect(approve).to_be_enabled()
    approve.tap()
    assert floor.settled(asked["id"])["status"] in {"running", "completed"}


def test_of_a_page_that_is_magnified_what_is_asked_is_read_and_approved_by_keyboard_alone(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=MAGNIFIED)
    asked = floor.ask()
    approve, read = person.button(re.compile("^Approve")), person.button("Read it first")
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    read.focus()
    for _ in range(20):
        person.enter(read)
        person.page.wait_for_timeout(500)  # longer than a line takes to be read
        if read.count() == 0:
            break
    expect(approve).to_be_enabled()
    for _ in range(2):  # past Deny, and through nothing that would scroll it away
        person.press("Tab")
    person.enter(approve)
    assert floor.settled(asked["id"])["status"] in {"running", "completed"}


def test_on_a_phone_held_sideways_what_is_done_to_a_session_is_within_reach(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=SIDEWAYS)
    asked = floor.ask()
    floor.drive_off()
    acts = ("^Pause", "^Resume", "^Roll back")
    for words in ((*ANSWERS, *acts), acts):
        for size in (SIDEWAYS, SIDEWAYS_SMALL):
            person.page.set_viewport_size(size)
            person.page.evaluate(THREE_FRAMES)
            for word in words:
                button = person.button(re.compile(word))
                expect(button).to_be_in_viewport(ratio=1)
                assert on_top(button), f"{word} on {size}"
            assert out_of_reach(stop(person)) == []
        if words != acts:
            floor.answer(asked, "deny")
            expect(person.button(re.compile("^Deny"))).to_have_count(0)
