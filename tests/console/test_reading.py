"""What a console shows of what is over: a question nobody answered, and a finished session moment by moment."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Locator, Route, expect

from tests.conftest import ServerProcess, until
from tests.console.conftest import (
    DESK,
    DESK_SMALL,
    PHONE,
    THREE_FRAMES,
    Floor,
    People,
    Person,
    at_once,
    box,
    on_top,
    resize,
    slide,
    wider_than_the_screen,
)

pytestmark = [pytest.mark.browser, pytest.mark.process]
CELL = "/v1/cells/workcell-1"
# Of a grasp, wherever the robot stands by then: what is within its reach is asked about.
ANSWER = re.compile(
    r"^(Asks a person: .*needs approval in human-shared; 1 approval within 120 s\.$|Deferred\. Not now: )"
)


@pytest.fixture
def hurried(server: ServerProcess) -> Iterator[None]:
    """Whoever is asked has three seconds to answer."""
    with server.client() as client:
        assert client.put(f"{CELL}/profile", json={"profile": "real-restricted"}).is_success
        yield
        client.put(f"{CELL}/profile", json={"profile": "human-shared"})


@pytest.mark.usefixtures("hurried")
def test_a_question_that_nobody_answers_goes_by_itself_and_what_lapsed_is_told_whole_whatever_page_one_was_on(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.page.evaluate("location.hash = '#/audit'")
    both = [floor.ask("mug_1", confidence=0.3), floor.ask("mug_1", confidence=0.3)]
    for asked in both:
        floor.settled(asked["id"])
    person.page.evaluate("location.hash = '#/live'")
    told = person.region("Waiting for you").get_by_role("status").filter(has_text="lapsed")
    lapse = r"Grasp mug_1 \(\d\d:\d\d:\d\d, nobody answered\)"
    expect(told).to_contain_text(re.compile(rf"2 questions lapsed: {lapse}; {lapse}\."))
    third = floor.ask(confidence=0.3)  # before one's eyes it is no other matter
    card = person.page.get_by_role("article", name="Grasp mug_1")
    expect(card).to_contain_text(re.compile("0:0[123]"))
    expect(card).to_contain_text("then denied")
    expect(card).to_have_count(0)
    ended = floor.settled(third["id"])
    assert (ended["status"], ended["outcome"]) == ("denied", "expired")
    expect(person.region("Events")).to_contain_text("The question is expired")
    expect(told).to_contain_text("3 questions lapsed:")
    person.button("Put away what lapsed").click()
    expect(told).to_have_count(0)
    assert person.page.evaluate("document.activeElement.id") == "page"


def hostile(server: ServerProcess, name: str) -> None:
    """Propose what every JavaScript object has under a name, for the agent chooses its words."""
    body = {"capability": name, "params": {name: 1}, "metadata": {"task": name}}
    assert server.post("/v1/invocations", body, key="agent").json()["status"] == "rejected"


@pytest.mark.drawn
def test_what_cannot_be_shown_or_read_says_so_and_everything_else_goes_on(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    hostile(server, "constructor")  # before anybody looks
    person = people.sit(server)
    person.expects("ERR_FAILED|The list could not be shown")
    log = person.region("Events")
    expect(log).to_contain_text("planner: constructor")
    hostile(server, "toString")
    expect(log).to_contain_text("planner: toString")
    asked = floor.ask()
    expect(person.page.get_by_role("article", name="Grasp mug_1").get_by_role("button", name="Deny")).to_be_enabled()
    unlike = {"items": [{"id": "inv_0"}], "next": None}  # anything this console was ever given
    person.page.route("**/v1/invocations?*", lambda route: route.fulfill(json=unlike))
    person.page.evaluate(f"location.hash = '#/audit/{asked['id']}'")
    events, said = person.region("Events of the session"), person.alert("This trace could not be read again")
    expect(events).to_contain_text("Asked a person")
    expect(person.alert("The list could not be shown.")).to_be_visible()
    person.page.unroute("**/v1/invocations?*")
    person.button("Try again").click()
    expect(person.page.get_by_role("link", name=re.compile("Grasp mug_1")).first).to_be_visible()
    expect(person.page.get_by_role("link", name=re.compile("ToString")).first).to_be_visible()
    person.page.route("**/trace", lambda route: route.abort())
    place = f"/v1/escalations/{asked['escalation']['id']}/acknowledge"
    assert server.post(place).is_success
    expect(said).to_contain_text("The server did not answer.")
    expect(person.page.get_by_role("heading", name="Grasp mug_1")).to_be_visible()
    expect(events).to_contain_text("Asked a person")
    person.page.unroute("**/trace")
    person.button("Read it again").click()
    expect(said).to_have_count(0)
    floor.answer(asked, "deny")
    expect(person.region("Replay")).to_contain_text("Nothing ran under this proposal")


def test_the_list_of_keys_tells_of_what_comes_and_hides_nothing_that_has_the_focus(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.press("?")
    keys, first = person.page.get_by_role("dialog", name="Keys"), person.page.get_by_role("button", name="Close")
    answers = keys.get_by_role("heading", name="At an open question")
    expect(answers).to_contain_text("not now")
    proposed = floor.ask()
    expect(answers).not_to_contain_text("not now")
    expect(first).to_be_focused()
    person.press("Shift+Tab")  # into the page below
    expect(keys).to_be_hidden()
    assert person.page.evaluate("document.activeElement.closest('#page') !== null")
    floor.answer(proposed, "deny")
    person.press("?")
    person.press("Escape")
    assert person.page.evaluate("document.activeElement.closest('#page') !== null"), "it goes back where it came from"


def test_the_list_of_keys_shows_arrows_as_arrows(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server)
    person.page.evaluate(f"location.hash = '#/audit/{floor.ask()['id']}'")
    expect(person.page.get_by_role("heading", name="Grasp mug_1")).to_be_visible()
    person.press("?")
    keys = person.page.get_by_role("dialog", name="Keys")
    expect(keys.get_by_text("←", exact=True)).to_be_visible()
    expect(keys.get_by_text("→", exact=True)).to_be_visible()
    expect(keys).to_contain_text("Go to how the controls are handed back")
    for where, says in (
        ("At an open question, on Live", "Deny the question"),
        ("For the session, on Live", "Pause the"),
    ):
        expect(keys.get_by_role("heading", name=where)).to_contain_text("not now")  # and listed all the same
        expect(keys).to_contain_text(says)
    expect(keys.get_by_role("heading", name="In a replay, on Audit")).not_to_contain_text("not now")
    keys.get_by_label("Single keys").uncheck()  # who dictates says letters without meaning any
    person.press("4")
    person.press("?")
    expect(keys).to_be_visible()
    expect(person.page.get_by_role("link", name="Audit")).to_have_attribute("aria-current", "page")
    person.press("Escape")
    person.page.reload()
    expect(person.page.get_by_role("heading", name="Grasp mug_1")).to_be_visible()
    person.press("?")
    expect(keys).to_be_hidden()
    person.button("operator operator keys").click()
    expect(keys).to_contain_text("Signed in as operator, operator")
    keys.get_by_label("Single keys").check()
    person.press("4")
    expect(person.page.get_by_role("link", name="Fleet")).to_have_attribute("aria-current", "page")


SEARCHES = "**/v1/audit/events?*text=*"


def test_what_happened_is_searched_by_words_from_the_newest_on_and_how_far_that_has_come_is_said(
    server: ServerProcess, people: People
) -> None:
    for name in ("polish_lens", "polish_mirror"):
        hostile(server, name)
    person = people.sit(server, size=PHONE)
    person.page.evaluate("location.hash = '#/audit'")
    find, search = person.region("Find"), person.page.get_by_role("searchbox", name="Search the record")
    found, told = find.get_by_role("list", name="Found").get_by_role("link"), find.get_by_role("status")
    expect(found.first).to_contain_text("Polish mirror")
    person.press("/")
    expect(search).to_be_focused()
    person.page.keyboard.type("Polish REJECTED unknown_capability")
    person.press("Enter")
    expect(found).to_have_count(2)
    expect(found.first).to_contain_text("admission.reasons.code: unknown_capability")
    expect(told).to_have_text(re.compile(r"^2 sessions\. All [\d,]+ sessions were searched\.$"))
    search.fill("POLISH_ planner")
    person.page.get_by_role("button", name="Search", exact=True).tap()
    person.button("Events").tap()
    expect(found.first).to_contain_text("Rejected. there is no capability polish_mirror")
    expect(found.first.locator("mark")).to_have_text(["polish_", "planner"])
    expect(found.first).to_contain_text("context.agent: planner")
    assert wider_than_the_screen(person.page) == []
    person.button("Newest first: turn round").tap()
    expect(found.first).to_contain_text("planner: polish lens")
    hostile(server, "polish_dish")
    person.button(re.compile(r"^\d+ newer: look again$")).tap()
    expect(found.last).to_contain_text("there is no capability polish_dish")

    search.fill("Policy_Activated")
    search.press("Enter")
    alone = find.get_by_role("list", name="Found").get_by_role("group")  # of no session: nothing to open but its record
    expect(alone.first.locator("mark")).to_have_text("policy_activated")  # the kind, as it is written in the log
    expect(found).to_have_count(0)
    alone.first.locator("summary").press("Enter")
    expect(alone.first).to_contain_text('"invocation": null')
    assert wider_than_the_screen(person.page) == []

    # A log that is longer than one look at it.
    far = {"events": 50_000, "seq": 9, "at": "2026-03-01T09:30:00.000Z"}
    person.page.route(SEARCHES, lambda route: route.fulfill(json={"items": [], "next": 9, "searched": far}))
    search.fill("nobody wrote this")
    search.press("Enter")
    expect(told).to_contain_text("Nothing found so far. The oldest 200,000 events were searched, up to 1 Mar 2026")
    person.page.unroute(SEARCHES)
    person.button("Search further").tap()
    expect(told).to_have_text(re.compile(r"^Nothing found\. All 200,\d+ events were searched\.$"))
    expect(person.button("Search further")).to_have_count(0)


def test_a_filter_that_is_not_filled_in_properly_holds_no_search_back_without_a_word(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server)
    person.press("2")
    find, search = person.region("Find"), person.page.get_by_role("searchbox", name="Search the record")
    person.button("Events").click()
    since, until_ = (find.get_by_label(name, exact=True) for name in ("From", "Until"))
    find.get_by_text("Filter", exact=True).click()
    since.focus()
    person.page.keyboard.type("11")  # and no more of a date
    find.get_by_text("Filter", exact=True).click()
    expect(since).to_be_hidden()
    search.fill("nobody wrote this")
    search.press("Enter")
    expect(since).to_be_focused()
    since.fill("")
    since.press("Enter")
    expect(find.get_by_role("status")).to_contain_text("Nothing found")

    since.fill("2026-11-28T10:00:00")
    until_.fill("2026-11-28T09:00:00")
    assert until_.evaluate("(field) => field.validity.rangeUnderflow")  # nothing was before it began
    until_.fill("102026-11-28T09:00:00")
    assert until_.evaluate("(field) => field.validity.rangeOverflow")


@pytest.mark.drawn
def test_a_finger_that_scrolls_a_trace_may_start_on_a_plot_and_one_that_goes_along_it_scrubs(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    drive = floor.drive_off()
    server.await_status(drive["id"], "completed", "failed")
    person = people.sit(server, size=PHONE)
    person.page.evaluate(f"location.hash = '#/audit/{drive['id']}'")
    plot, moment = person.page.locator(".plot").last, person.page.get_by_role("slider", name="Moment of the session")
    plot.scroll_into_view_if_needed()
    at, down = box(plot), "document.querySelector('main').scrollTop"
    x, y = at["x"] + at["width"] / 2, at["y"] + at["height"] / 2
    began, before = person.page.evaluate(down), moment.input_value()
    slide(person, (x, y), (x, y - 200))
    until(
        lambda: person.page.evaluate(down) > began + 100 or person.page.wait_for_timeout(20), what="a page that moves"
    )
    assert moment.input_value() == before

    plot.scroll_into_view_if_needed()
    at = box(plot)
    y, began = at["y"] + at["height"] / 2, person.page.evaluate(down)
    slide(person, (at["x"] + 10, y), (at["x"] + 0.8 * at["width"], y + 5))
    longest = float(moment.get_attribute("max") or 0)
    assert float(moment.input_value()) == pytest.approx(0.8 * longest, rel=0.03)
    assert person.page.evaluate(down) == began
    person.page.touchscreen.tap(at["x"] + 0.4 * at["width"], y)
    assert float(moment.input_value()) == pytest.approx(0.4 * longest, rel=0.03)


def checked_anew(person: Person) -> bool:
    """Look away and back, at which the log is checked; say whether nothing came meanwhile."""
    person.press("1")
    expect(person.region("Events")).to_be_visible()
    person.press("2")
    integrity = person.region("Integrity of the log")
    expect(integrity).to_contain_text("The log holds.")
    return "not checked yet" not in integrity.inner_text()


def test_of_what_was_recorded_within_a_moment_each_record_can_be_shown(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    asked = floor.ask()
    floor.answer(asked, "deny")
    floor.settled(asked["id"])
    told = server.get(f"/v1/invocations/{asked['id']}/trace")["items"]
    assert len({one["at"] for one in told}) < len(told)
    wanted = next(one["seq"] for one in told if one["kind"] == "admission")
    person = people.sit(server)
    person.page.evaluate(f"location.hash = '#/audit/{asked['id']}/{wanted}'")
    events = person.region("Events of the session")
    rows = events.get_by_role("listitem").get_by_role("button")
    expect(rows.nth([one["seq"] for one in told].index(wanted))).to_have_attribute("aria-current", "step")
    person.button("Show the record").click()
    for row, one in zip(rows.all(), told, strict=True):
        row.click()
        expect(row).to_have_attribute("aria-current", "step")
        expect(events.get_by_label(f"Event {one['seq']} as it was recorded")).to_contain_text(one["kind"])


def test_the_record_that_was_asked_for_stays_in_sight_when_what_was_measured_comes(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    drive = floor.drive_off()
    floor.settled(drive["id"])
    until(
        lambda: server.get(f"/v1/audit/events?invocation={drive['id']}&kind=telemetry")["items"], what="its telemetry"
    )
    wanted = server.get(f"/v1/invocations/{drive['id']}/trace")["items"][-1]["seq"]
    person = people.sit(server, size=DESK_SMALL)
    row = person.region("Events of the session").locator("[aria-current=step]")
    with at_once("**/v1/audit/telemetry/*", person):
        person.page.evaluate(f"location.hash = '#/audit/{drive['id']}/{wanted}'")
        expect(row).to_be_visible()
        person.page.evaluate(THREE_FRAMES)
    expect(person.page.get_by_role("list", name="What was measured")).to_be_visible()
    person.page.evaluate(THREE_FRAMES)
    assert (
        row.evaluate(
            "(row) => row.closest('section').getBoundingClientRect().bottom - row.getBoundingClientRect().bottom"
        )
        >= 0
    )


@pytest.mark.drawn
def test_a_trace_follows_its_session_shows_what_is_not_read_yet_as_unknown_and_is_scrubbed_with_its_events(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.press("2")
    expect(person.region("Integrity of the log")).to_contain_text("The log holds.")
    asked = floor.ask()
    person.page.locator(f"a[href*='{asked['id']}']").click()  # it is listed though it has not ended
    expect(person.region("Replay")).to_contain_text("waits for an answer")
    floor.answer(asked, "deny")
    expect(person.region("Replay")).to_contain_text("Nothing ran under this proposal")
    x, y = floor.base()
    drive = floor.drive(x_m=x, y_m=y - 0.3, yaw_rad=1.5708)
    ended = server.await_status(drive["id"], "completed", "failed")
    assert ended["outcome"] == "succeeded", ended
    until(
        lambda: server.get(f"/v1/audit/events?invocation={drive['id']}&kind=telemetry")["items"], what="its telemetry"
    )
    integrity = person.region("Integrity of the log")
    expect(integrity).to_contain_text("not checked yet")
    until(lambda: checked_anew(person), what="a log that is checked to its end")
    person.page.get_by_text("Filter").click()
    actor = person.page.get_by_label("Actor")
    actor.fill("x")
    actor.fill("")
    expect(actor).to_be_focused()  # a field that is emptied takes what is typed next
    actor.fill("nobody")
    for when in ("From", "Until"):
        assert box(person.page.get_by_label(when, exact=True))["width"] > 190  # a day and a time to the second
    person.button("Events").click()
    person.button("Sessions").click()  # what was only typed filters nothing
    moment = person.page.get_by_role("slider", name="Moment of the session")
    events = person.region("Events of the session")
    with at_once(f"**/v1/invocations/{drive['id']}/trace", person):
        person.page.get_by_role("link", name=re.compile("Drive to")).first.click()
        expect(person.region("Replay")).to_contain_text("Reading…")
        counted = events.get_by_role("heading", name="Events").locator("..")
        expect(counted).to_have_text(re.compile(r"^Events\s*–\s*Show the record$"))
        expect(person.region("Replay")).not_to_contain_text("+0.0 s")
        expect(moment).to_have_attribute("aria-valuetext", "not known yet")
    expect(counted).to_contain_text(re.compile(r"[1-9]\d* of [1-9]"))
    expect(person.region("Replay")).to_contain_text(re.compile(r"\+\d+\.\d s of \+"))
    expect(events).to_contain_text("Launched, authorization")
    expect(person.page.locator("article.trace canvas").first).to_be_visible()
    moment.evaluate("(range) => { range.value = range.min; range.dispatchEvent(new Event('input', {bubbles: true})); }")
    first = events.locator("[aria-current=step]").inner_text()
    person.page.get_by_role("heading", name=re.compile("Drive to")).click()
    person.press("ArrowRight")
    expect(events.locator("[aria-current=step]")).not_to_have_text(first)
    moment.evaluate("(range) => { range.value = range.max; range.dispatchEvent(new Event('input', {bubbles: true})); }")
    expect(events.locator("[aria-current=step]")).to_contain_text("Done, verified")  # what ran is over
    person.press("ArrowRight")
    expect(events.get_by_text(re.compile(r"(\d+) of \1"))).to_be_visible()
    person.region("The robot at this moment, from the record").get_by_role("application").focus()
    person.press("ArrowLeft")  # turns the camera there, and nothing else
    expect(events.get_by_text(re.compile(r"(\d+) of \1"))).to_be_visible()
    moment.evaluate("(range) => { range.value = range.min; range.dispatchEvent(new Event('input', {bubbles: true})); }")
    began = float(moment.input_value())
    person.page.get_by_role("link", name=re.compile("Drive to")).first.focus()  # as who chose by a click left it
    person.press(" ")
    until(lambda: float(moment.input_value()) > began + 0.3 or person.page.wait_for_timeout(20), what="time that runs")
    person.press(" ")
    person.button("Speed 4").click()
    with person.page.expect_download() as saved:
        person.button(re.compile("JSON")).click()
    assert drive["id"] in saved.value.suggested_filename
    held: list[Route] = []
    person.page.route("**/mcap?*", lambda route: held.append(route))  # noqa: PLW0108  # Playwright marks it
    for _ in range(7):  # a browser has no more than six connections for all of this
        person.button("MCAP").click(force=True)
    person.press(".")
    until(lambda: server.cell()["latched"] or person.page.wait_for_timeout(20), what="the stop")
    assert len(held) == 1
    with person.page.expect_download():
        held[0].continue_()
    expect(person.button("MCAP")).to_be_enabled()


@pytest.mark.parametrize("sizes", [(DESK, DESK_SMALL), (PHONE,)], ids=["desk", "phone"])
def test_on_the_page_of_the_policy_the_matrix_an_answer_and_what_takes_the_focus_can_be_seen(
    server: ServerProcess, people: People, sizes: tuple[dict[str, int], ...]
) -> None:
    person = people.sit(server, "engineer", size=sizes[0])
    for size in sizes:
        resize(person, size)
        sees_where_a_person_confirms(person, size)
    assert wider_than_the_screen(person.page) == []
    for size in sizes:
        resize(person, size)
        asks_policy(person)
    assert wider_than_the_screen(person.page) == []
    goes_to_the_fleet_by_tab(person)


def sees_where_a_person_confirms(person: Person, size: dict[str, int]) -> None:
    person.page.evaluate("location.hash = '#/policy'")
    person.page.evaluate("location.hash = '#/policy/place_object/human-shared'")
    matrix, detail = person.region("Matrix"), person.region("place_object under human-shared")
    squares = matrix.get_by_role("row", name=re.compile("^place_object")).get_by_role("button")
    confirmed = squares.filter(has_text="Confirm before release")
    expect(confirmed).to_have_count(1)
    expect(confirmed).to_have_attribute("aria-pressed", "true")
    expect(matrix.get_by_text("Confirm before")).to_have_count(1)
    rule = (
        "Before release the robot holds and waits for one person, at most 600 s; a denial has it rolled back, silence"
    )
    said = detail.get_by_text(rule)
    if size == PHONE:
        expect(said).to_be_visible()
    else:
        expect(said).to_be_in_viewport(ratio=1)


def asks_policy(person: Person) -> None:
    """Ask twice; each time the answer comes into view by itself, and is said."""
    person.page.evaluate("location.hash = '#/live'")
    expect(person.region("Events")).to_be_attached()
    person.page.evaluate("location.hash = '#/policy/grasp_object/human-shared'")
    form = person.region("What would happen if…")
    form.get_by_label("Object (needed)").select_option("glass_1")
    said = form.get_by_role("status").first
    said.evaluate(
        """(said) => { window.heard = [];
        const note = () => window.heard.push(said.textContent !== '');
        new MutationObserver(note).observe(said, { childList: true, characterData: true, subtree: true }); }"""
    )
    for asked in ("glass_1", "mug_1"):
        form.get_by_label("Object (needed)").select_option(asked)
        form.get_by_role("button", name="Ask policy").click()
        expect(said).to_have_text(ANSWER)
        for part in (form.locator(".verdict"), form.get_by_text("After policy")):
            expect(part).to_be_in_viewport(ratio=1)
            assert on_top(part)
    assert person.page.evaluate("window.heard") == [True, False, True]


def goes_to_the_fleet_by_tab(person: Person) -> None:
    person.page.evaluate("location.hash = '#/policy'")
    link = person.page.get_by_role("link", name="Which cells work under which profile")
    expect(link).to_be_attached()
    assert box(link)["width"] <= 1
    person.page.locator("main").focus()
    for _ in range(40):
        person.press("Tab")
        if link.evaluate("link => link === document.activeElement"):
            break
    expect(link).to_be_focused()
    expect(link).to_be_in_viewport(ratio=1)
    assert box(link)["width"] > 200
    assert on_top(link)
    assert wider_than_the_screen(person.page) == []
    person.press("Enter")
    expect(person.page.get_by_role("heading", name="Fleet")).to_be_visible()


# As many cells of the same as a hall may have, of which the page is told beside the one there is.
FORTY = """(() => { const One = Worker;
    window.Worker = class extends One { set onmessage(take) { super.onmessage = (event) => {
        for (const { message } of event.data) if (message?.cells?.length > 0) {
            const [cell] = message.cells;
            const other = (k) => ({ ...cell, id: `workcell-${k + 1}`, latched: LATCHED });
            message.cells = Array.from({ length: 40 }, (_, k) => other(k));
        }
        take(event);
    }; } };
})()"""


def test_the_matrix_stays_on_the_screen_however_many_cells_a_profile_is_in_force_in(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server, init=FORTY.replace("LATCHED", "false"))
    person.press("3")
    table = person.page.get_by_role("table", name=re.compile("^What policy says"))
    expect(table).to_contain_text("and 37 more")
    assert table.locator("..").evaluate("(around) => around.scrollWidth <= around.clientWidth")


def test_where_many_cells_are_stopped_one_banner_tells_of_them_all(server: ServerProcess, people: People) -> None:
    person = people.sit(server, init=FORTY.replace("LATCHED", "k > 0"))
    told = person.alert("Emergency stop: workcell-2, workcell-3 and 37 more are stopped, other cells than STOP is for.")
    expect(told).to_be_visible()
    expect(person.page.get_by_role("alert").filter(has_text="Emergency stop")).to_have_count(1)
    told.get_by_role("link", name="See them on Fleet").click()
    expect(told).to_have_count(0)  # their cards tell of them there
    names = person.page.get_by_role("heading", level=2).all_inner_texts()
    assert names[:3] == ["workcell-1", "workcell-2", "workcell-3"]
    person.press("1")
    told.get_by_role("button", name="Understood").click()
    expect(told).to_have_count(0)


def test_an_answer_of_policy_is_marked_once_its_question_has_changed_even_if_it_comes_late_and_faults_are_shown(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server)
    person.expects("422")
    person.press("3")
    form = person.region("What would happen if…")
    form.get_by_label("Object (needed)").select_option("mug_1")
    force = form.get_by_label(re.compile("^Grip force"))
    force.fill("50")
    person.press("Enter")
    expect(form).to_contain_text("Policy version")
    form.get_by_role("button", name="Ask policy").press("Enter")
    expect(form.get_by_role("button", name="Ask policy")).to_be_focused()
    expect(form).not_to_contain_text("Ask again")
    force.fill("60")
    expect(form).to_contain_text("Asked before something above changed. Ask again.")
    force.fill("50")
    expect(form).not_to_contain_text("Ask again")
    force.fill("141")
    form.get_by_role("button", name="Ask policy").click()
    faults = form.get_by_role("listitem").filter(has_text="141 is greater than the maximum of 140")
    expect(faults).to_have_count(2)  # the server names it twice
    person.page.evaluate("location.hash = '#/policy/safe_retreat/human-shared'")
    expect(form.get_by_label("Capability")).to_have_value("safe_retreat")
    with at_once("**/v1/check", person):
        form.get_by_role("button", name="Ask policy").click()
        form.get_by_label("Capability").select_option("release_and_retract")
        expect(form.get_by_label("Capability")).to_have_value("release_and_retract")
    expect(form.get_by_role("definition").first).to_have_text("safe_retreat")
    expect(form).to_contain_text("Asked before something above changed. Ask again.")
    with person.page.expect_response("**/v1/check"), at_once("**/v1/check", person):
        form.get_by_role("button", name="Ask policy").click()
        person.page.evaluate("location.hash = '#/live'")  # and who has gone on to another page is let be
        expect(form).to_have_count(0)
    person.page.evaluate(THREE_FRAMES)
    expect(person.region("Waiting for you")).to_be_visible()


def test_while_policy_is_asked_anew_its_answer_to_the_question_before_stays_marked(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server)
    person.press("3")
    form = person.region("What would happen if…")
    form.get_by_label("Object (needed)").select_option("mug_1")
    form.get_by_role("button", name="Ask policy").click()
    expect(form).to_contain_text("Policy version")
    form.get_by_label(re.compile("^Grip force")).fill("50")
    old = form.get_by_text("Asked before something above changed.")
    expect(old).to_be_visible()
    with at_once("**/v1/check", person):
        form.get_by_role("button", name="Ask policy").click()
        expect(form.get_by_role("button", name="Asking…")).to_be_visible()
        person.page.evaluate(THREE_FRAMES)
        expect(old).to_be_visible()
    expect(old).to_have_count(0)


def test_what_is_chosen_can_be_told_where_the_system_chooses_the_colours(server: ServerProcess, people: People) -> None:
    person = people.sit(server)
    page = person.page
    page.emulate_media(forced_colors="active")
    page.evaluate("location.hash = '#/policy/grasp_object/human-shared'")
    marked = {
        "square": page.get_by_role("table").first.get_by_role("button"),
        "tab": page.get_by_role("navigation", name="Policy").get_by_role("link"),
        "page": page.get_by_role("navigation", name="Pages").get_by_role("link"),
    }
    colour = "(one) => getComputedStyle(one).color"
    icons = page.get_by_role("region", name="grasp_object under human-shared").locator("svg")
    expect(icons.nth(1)).to_be_visible()
    for icon in icons.all():
        assert icon.evaluate(colour) == icon.locator("..").evaluate(colour)  # none has a dim one of its own
    edge = "(all) => all.map((one) => [one.matches('[aria-current], [aria-pressed=true]'), "
    edge += "parseFloat(getComputedStyle(one).borderBottomWidth)])"
    for name, all_of in marked.items():
        expect(all_of.first).to_be_visible()
        found = all_of.evaluate_all(edge)
        (chosen,) = [width for current, width in found if current]
        assert chosen > max(width for current, width in found if not current) + 1, name


def test_what_takes_no_press_can_be_told_where_the_system_chooses_the_colours(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.page.emulate_media(forced_colors="active")
    floor.drive_off()
    pause, resume = person.button("Pause"), person.button("Resume")
    expect(pause).to_have_attribute("aria-disabled", "false")
    expect(resume).to_have_attribute("aria-disabled", "true")
    for drawn in ("color", "borderTopColor"):
        read = f"(one) => getComputedStyle(one).{drawn}"
        assert pause.evaluate(read) != resume.evaluate(read)


def asked_about_a_drive(person: Person) -> Locator:
    """Ask policy what would happen if the robot were to drive; return the form, with the answer."""
    person.press("3")
    form = person.region("What would happen if…")
    form.get_by_label("Capability").select_option("navigate_to")
    form.get_by_label("Target").select_option("dock")
    form.get_by_role("button", name="Ask policy").click()
    expect(form).to_contain_text("Policy version")
    return form


def test_an_answer_of_policy_is_marked_once_the_cell_is_stopped(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    form = asked_about_a_drive(people.sit(server))
    expect(form).not_to_contain_text("Ask again")
    assert server.post(f"{CELL}/estop").is_success
    expect(form).to_contain_text("workcell-1 is not as it was when this was asked. Ask again.")
    form.get_by_role("button", name="Ask policy").click()
    expect(form).to_contain_text("“workcell-1” is stopped and latched.")
    expect(form).not_to_contain_text("Ask again")
    until(floor.unlatched, what="a cell that no stop latches")
    expect(form).to_contain_text("workcell-1 is not as it was when this was asked. Ask again.")


def test_an_answer_of_policy_stays_marked_when_a_session_has_left_the_cell_as_idle_as_it_was(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    form = asked_about_a_drive(people.sit(server))
    marked = form.get_by_text("workcell-1 is not as it was when this was asked. Ask again.")
    assert server.post(f"/v1/invocations/{floor.drive_off()['id']}/cancel").is_success
    expect(marked).to_be_visible()
    until(lambda: server.cell()["busy"] is None, what="a cell that is idle again")
    form.get_by_label("Mode").select_option("careful")
    expect(form).to_contain_text("Asked before something above changed.")
    form.get_by_label("Mode").select_option("normal")
    expect(marked).to_be_visible()
    form.get_by_role("button", name="Ask policy").click()
    expect(form).not_to_contain_text("Ask again")


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_a_list_of_changes_says_that_it_goes_on_until_its_end_is_in_sight(
    server: ServerProcess, people: People, size: dict[str, int]
) -> None:
    person = people.sit(server, "engineer", size=size)
    person.page.evaluate("location.hash = '#/fleet'")
    card = person.region("workcell-1")
    card.get_by_label("Profile").select_option("sim-relaxed")
    card.get_by_role("button", name="Change…").click()
    changes, more = card.get_by_role("group", name="What changes"), card.get_by_text("more below")
    expect(more).to_be_visible()
    changes.focus()
    person.press("End")
    expect(more).to_have_count(0)
    expect(changes.get_by_role("row").last).to_be_in_viewport()
    person.press("Home")
    expect(more).to_be_visible()


def test_a_name_of_a_capability_is_broken_where_words_end(server: ServerProcess, people: People) -> None:
    person = people.sit(server, size=PHONE)
    person.page.evaluate("location.hash = '#/policy'")
    name = person.page.get_by_role("rowheader", name="release_and_retract").locator(".name")
    expect(name).to_be_visible()
    lines = name.evaluate(
        """(name) => { const range = document.createRange(), lines = new Map();
        const texts = document.createTreeWalker(name, NodeFilter.SHOW_TEXT);
        while (texts.nextNode()) for (let at = 0; at < texts.currentNode.length; at += 1) {
            range.setStart(texts.currentNode, at);
            range.setEnd(texts.currentNode, at + 1);
            const { top } = range.getBoundingClientRect();
            lines.set(top, (lines.get(top) ?? '') + range.toString());
        }
        return [...lines.values()]; }"""
    )
    assert "".join(lines) == "release_and_retract"
    assert len(lines) > 1
    assert [line[-1] for line in lines[:-1]] == ["_"] * (len(lines) - 1)
