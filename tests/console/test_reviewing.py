"""Review afterwards: what policy marks waits for a verdict, in the queue and beside the trace."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Locator, Route, expect

from tests.conftest import ServerProcess, Servers, put_in_profile, until
from tests.console.conftest import PHONE, PRESS_ONCE_MOVED, THREE_FRAMES, Floor, People, Person, box, far
from tests.console.wire import wire_to
from tests.test_join import NAME, Hand, online, token_of

pytestmark = [pytest.mark.browser, pytest.mark.process]
CELL = "/v1/cells/workcell-1"
BROKEN = r"WebSocket connection|ERR_CONNECTION|ERR_EMPTY_RESPONSE|ERR_FAILED|Failed to load resource"


@pytest.fixture
def reviewed(server: ServerProcess) -> Iterator[None]:
    """Policy wants a person to look at what is stopped; nothing waits when the test is over."""
    with server.client() as client:
        assert client.put(f"{CELL}/profile", json={"profile": "sim-relaxed"}).is_success
    yield
    for review in server.get("/v1/reviews?status=waiting")["items"]:
        judge(server, review, "accepted")
    with server.client() as client:
        client.put(f"{CELL}/profile", json={"profile": "human-shared"})


@pytest.fixture
def stopped(server: ServerProcess, floor: Floor, reviewed: None) -> dict[str, Any]:
    """A session that ended as `stopped` where policy wants a person to look at such."""
    return stop_one(server, floor)


def stop_one(server: ServerProcess, floor: Floor) -> dict[str, Any]:
    x, y = floor.base()
    session = floor.drive(x_m=x, y_m=y - 0.4 if y > 4 else y + 0.4, yaw_rad=1.5708)
    until(lambda: floor.speed() > 0.05, what="a base that moves")
    assert server.post(f"{CELL}/estop").is_success
    return server.await_status(session["id"], "failed")


def judge(server: ServerProcess, review: dict[str, Any], verdict: str) -> None:
    path = f"/v1/reviews/{review['id']}/resolve"
    assert server.post(path, {"verdict": verdict}, key="operator_2").is_success


def queue(person: Person) -> Locator:
    return person.region("To review")


def kept(server: ServerProcess, session: dict[str, Any]) -> dict[str, Any]:
    items = server.get("/v1/reviews")["items"]
    return next(one for one in items if one["invocation"] == session["id"])


def test_an_auditor_gives_a_verdict_by_keyboard_and_its_trace_shows_nothing_measured_where_nothing_was(
    server: ServerProcess, people: People, stopped: dict[str, Any]
) -> None:
    person, other = people.sit(server, "auditor"), people.sit(server)
    opened = queue(person).get_by_role("button", name=re.compile("Drive to"))
    expect(opened).to_contain_text("stopped")
    opened.focus()
    person.press("Enter")
    form = queue(person).get_by_role("form")
    expect(form).to_contain_text("What ended as “stopped” is reviewed in sim-relaxed")
    expect(form.get_by_role("button", name="Record the verdict")).to_be_disabled()
    expect(form.get_by_role("button", name="Record the verdict")).to_have_accessible_description(
        "Choose a verdict first."
    )
    until(lambda: told(server, stopped["id"]), what="its telemetry")
    person.page.wait_for_timeout(3000)  # as long as its reviewer takes, and longer than it ran
    form.get_by_role("radio", name=re.compile("Accepted")).focus()
    person.press("ArrowDown")
    expect(form.get_by_role("radio", name=re.compile("Objected"))).to_be_checked()
    person.press("Tab")
    person.page.keyboard.type("The person was seen too late. ad.")
    person.press("Tab")
    person.press("Enter")
    expect(queue(person).get_by_role("status")).to_have_text("Recorded: objected.")
    expect(queue(person).get_by_role("form")).to_have_count(0)
    expect(queue(other)).to_have_count(0)
    given = kept(server, stopped)["verdict"]
    assert (given["by"], given["verdict"]) == ("auditor", "objected")
    assert given["note"] == "The person was seen too late. ad."
    queue(person).get_by_text("Verdicts given").click()
    expect(queue(person)).to_contain_text("objected by auditor, “The person was seen too late. ad.”")
    queue(person).get_by_role("link", name=re.compile("Drive to")).click()
    expect(person.region("Review")).to_contain_text("Reviewed by auditor: objected")
    expect(person.region("Events of the session")).to_contain_text("auditor reviewed: objected")
    looks_where_nothing_was_measured(person, "auditor reviewed: objected")


@pytest.fixture
def reviewed_later(server: ServerProcess, floor: Floor, stopped: dict[str, Any]) -> dict[str, Any]:
    """A session that waits for a verdict, in a cell that asks people again meanwhile."""
    until(floor.unlatched, what="a cell that no stop latches")
    put_in_profile(server, "human-shared")
    return stopped


def test_arrows_choose_among_the_verdicts_beside_a_trace_and_step_through_it_elsewhere(
    server: ServerProcess, people: People, stopped: dict[str, Any]
) -> None:
    person = people.sit(server)
    person.page.evaluate(f"location.hash = '#/audit/{stopped['id']}'")
    person.page.get_by_text("This session waits for a verdict").click()
    form, moment = person.region("Review").get_by_role("form"), person.region("Replay").get_by_role("slider")
    expect(person.page.locator(".plot").first).to_be_visible()  # with telemetry comes where the replay begins
    person.button("On to the next event").click()
    stood = moment.input_value()
    form.get_by_role("radio", name=re.compile("Accepted")).focus()
    person.press("ArrowRight")
    expect(form.get_by_role("radio", name=re.compile("Objected"))).to_be_checked()
    assert moment.input_value() == stood
    moment.focus()
    person.press("ArrowRight")
    expect(moment).not_to_have_value(stood)


def test_who_writes_a_note_when_a_question_comes_up_goes_on_writing_and_answers_nothing(
    server: ServerProcess, people: People, floor: Floor, reviewed_later: dict[str, Any]
) -> None:
    person = people.sit(server)
    queue(person).get_by_role("button", name=re.compile("Drive to")).click()
    note = queue(person).get_by_label("Note for the record")
    note.fill("It was ")
    asked = floor.ask()
    expect(person.button(re.compile("^Approve"))).to_be_enabled()  # by then its answers are taken
    person.page.keyboard.type("a near miss.")
    expect(note).to_have_value("It was a near miss.")
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"
    assert not server.cell()["latched"]


def test_what_one_goes_on_writing_when_another_verdict_came_first_answers_no_question(
    server: ServerProcess, people: People, floor: Floor, reviewed_later: dict[str, Any]
) -> None:
    person = people.sit(server)
    asked = floor.ask()
    queue(person).get_by_role("button", name=re.compile("Drive to")).click()
    note = queue(person).get_by_label("Note for the record")
    expect(person.button(re.compile("^Approve"))).to_be_enabled()
    note.press_sequentially("It was ")
    # Whoever writes hears nothing of it: the next letters follow in the very moment in which the form is gone.
    person.page.evaluate(
        """() => {
            const type = (into, key) =>
                into?.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true, cancelable: true }));
            const field = () => document.querySelector('form textarea');
            const typing = setInterval(() => type(field(), 'x'), 100);
            const seen = new MutationObserver(() => {
                if (field() !== null) return;
                seen.disconnect();
                clearInterval(typing);
                for (const key of 'anear') type(document.activeElement, key);
                window.written = true;
            });
            seen.observe(document.body, { childList: true, subtree: true });
        }"""
    )
    judge(server, kept(server, reviewed_later), "accepted")
    expect(queue(person)).to_contain_text("Your note was not recorded: “It was”")
    assert person.page.evaluate("window.written")
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"


def test_who_corrects_a_note_or_pauses_in_it_as_another_verdict_comes_answers_no_question_with_what_follows(
    server: ServerProcess, people: People, floor: Floor, reviewed_later: dict[str, Any]
) -> None:
    person = people.sit(server)
    asked = floor.ask()
    queue(person).get_by_role("button", name=re.compile("Drive to")).click()
    expect(person.button(re.compile("^Approve"))).to_be_enabled()
    queue(person).get_by_label("Note for the record").press_sequentially("It was x")
    person.press("Backspace")
    person.page.wait_for_timeout(2_500)  # who writes thinks, longer than what is typed goes on
    judge(server, kept(server, reviewed_later), "accepted")
    expect(queue(person)).to_contain_text("Your note was not recorded: “It was”")
    person.page.keyboard.type("anear")
    assert person.page.evaluate("new Promise((done) => setTimeout(done, 100, true))")  # for what the page would send
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "awaiting_approval"


def test_a_note_that_turns_its_line_around_is_marked_wherever_it_is_shown(
    server: ServerProcess, people: People, stopped: dict[str, Any]
) -> None:
    person = people.sit(server)
    queue(person).get_by_role("button", name=re.compile("Drive to")).click()
    queue(person).get_by_role("radio", name=re.compile("Objected")).check()
    queue(person).get_by_label("Note for the record").fill("by mistake \u202edetpecca")
    queue(person).get_by_role("button", name="Record the verdict").click()
    queue(person).get_by_text("Verdicts given").click()
    expect(queue(person)).to_contain_text("objected by operator, “by mistake \ufffddetpecca”")
    queue(person).get_by_role("link", name=re.compile("Drive to")).first.click()
    expect(person.region("Review")).to_contain_text("objected, “by mistake \ufffddetpecca”")


def looks_where_nothing_was_measured(person: Person, verdict: str) -> None:
    """Go through a trace: it gives its room to what ran, and shows nothing measured before and after."""
    events, replay, measured = (
        person.region("Events of the session"),
        person.region("Replay"),
        person.region("Measured and recorded").get_by_role("list", name="What was measured"),
    )
    stamp, moment = replay.locator(".stamp"), person.page.get_by_role("slider", name="Moment of the session")
    expect(stamp).to_have_text("Record, not the present")
    expect(measured).to_contain_text(re.compile(r"Base speed\s*\d\.\d\d m/s"))
    ran_s = float(moment.evaluate("(range) => Number(range.max)"))
    last = events.get_by_role("button", name=verdict)
    last.click()
    expect(moment).to_have_attribute("aria-valuetext", re.compile(r"^\+\d+\.\d s, after the end$"))
    reviewed_s = float(re.findall(r"[\d.]+", str(moment.get_attribute("aria-valuetext")))[0])
    assert reviewed_s > ran_s + 2
    expect(measured).to_contain_text(re.compile(r"Base speed\s*–"))
    expect(measured).not_to_contain_text(re.compile(r"[\d.]+ (m|N|%)|nobody"))
    expect(stamp).to_have_text(re.compile(r"^Last recorded, at \+\d"))
    assert moment.evaluate("(range) => Number(range.value) / Number(range.max)") == pytest.approx(1)
    person.press("ArrowLeft")
    expect(last).not_to_have_attribute("aria-current", "step")
    person.press("ArrowRight")
    expect(last).to_have_attribute("aria-current", "step")
    events.get_by_role("button", name=re.compile("Stopped.*by an emergency stop")).click()
    expect(stamp).to_have_text("Record, not the present")
    expect(measured).to_contain_text(re.compile(r"Base speed\s*\d\.\d\d m/s"))
    events.get_by_role("button", name="Authorization signed").click()  # decided before anything ran
    expect(events.locator("[aria-current=step]")).to_contain_text("Authorization signed")
    expect(moment).to_have_attribute("aria-valuetext", re.compile("before the launch$"))
    expect(stamp).to_have_text(re.compile(r"^First recorded, at \+0\.0 s"))


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[Hand]:
    made = Hand(tmp_path)
    yield made
    made.end()


def test_parts_of_telemetry_are_told_apart_and_one_that_is_not_there_bars_the_way_to_no_other(
    servers: Servers, hand: Hand, people: People
) -> None:
    server = servers.start(cells=0)
    hand.join(server, token_of(server))
    until(lambda: online(server), what="the cell joins")
    session = server.launch("navigate_to", NAME, target="tool_stand")["id"]
    start = server.cell(NAME)["facts"]["base"]
    until(lambda: far(server.cell(NAME)["facts"]["base"], start) > 0.3, what="a robot on its way")
    server.stop()  # what is measured from now on goes to a second file
    server = servers.start(server.data, "--port", server.url.rpartition(":")[2], cells=0)
    asked = server.await_status(session, "escalated")["escalation"]["id"]

    def approved() -> bool:
        # Its digest anew each time: the question may still change while the cell comes back, and none fits both.
        answer = {"decision": "approve", "digest": server.get(f"/v1/escalations/{asked}")["digest"]}
        return server.post(f"/v1/escalations/{asked}/resolve", answer).is_success

    until(approved, what="its answer")
    server.await_status(session, "completed")
    # On a busy machine the link may lapse once more, and leave a part in which nothing was measured.
    found = until(
        lambda: found if len(found := measured_in(server, session)) > 1 else None, what="a second part of its telemetry"
    )
    (one, first), (two, second) = list(found.items())[:2]
    person = people.sit(server)
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    person.page.route(f"**/v1/audit/telemetry/*part={two}", hold)
    person.page.evaluate(f"location.hash = '#/audit/{session}'")
    side = person.region("Measured and recorded")
    measured = side.get_by_role("list", name="What was measured")
    expect(measured).to_be_visible()
    part = person.page.get_by_label("Part")
    expect(part).to_have_value(f"{one}")
    part.select_option(f"{two}")
    expect(side.get_by_text("Reading…")).to_be_visible()
    expect(measured).to_have_count(0)
    until(lambda: held or person.page.wait_for_timeout(20), what="the request for the second part")
    held[0].continue_()
    expect(measured).to_be_visible()
    launched = person.region("Events of the session").get_by_role("button", name=re.compile("Launched"))
    expect(launched).to_contain_text(f"−{second[0] - first[0] + 0.01:.1f} s")
    person.page.unroute(f"**/v1/audit/telemetry/*part={two}")
    gone = server.data / "telemetry" / told(server, session)[one - 1]["body"]["file"]
    gone.rename(server.data / "away")
    person.expects("Failed to load resource")
    part.select_option(f"{one}")
    expect(side).to_contain_text("its file is not where it was kept")
    part.select_option(f"{two}")
    expect(measured).to_be_visible()
    (server.data / "away").rename(gone)


def measured_in(server: ServerProcess, session: str) -> dict[int, list[float]]:
    """Return when it was measured, of each part in which anything was."""
    parts = range(1, len(told(server, session)) + 1)
    columns = {part: server.get(f"/v1/audit/telemetry/{session}?part={part}")["columns"] for part in parts}
    return {part: found["time_s"] for part, found in columns.items() if found}


def told(server: ServerProcess, session: str) -> list[dict[str, Any]]:
    return server.get(f"/v1/audit/events?invocation={session}&kind=telemetry")["items"]


def test_a_note_that_the_record_does_not_take_whole_is_kept_back_and_not_cut_short(
    server: ServerProcess, people: People, stopped: dict[str, Any]
) -> None:
    person = people.sit(server, size=PHONE)
    queue(person).get_by_role("button", name=re.compile("Drive to")).tap()
    form = queue(person).get_by_role("form")
    form.get_by_role("radio", name=re.compile("Objected")).check()
    note, record = form.get_by_role("textbox"), form.get_by_role("button", name="Record the verdict")
    note.tap()
    person.page.keyboard.insert_text(f"{'What came before it. ' * 200}The person was seen too late.")
    expect(note).to_have_value(re.compile("The person was seen too late.$"))
    expect(record).to_be_disabled()
    expect(record).to_have_accessible_description(
        re.compile(r"^The note is \d+ letters longer than the record takes\.$")
    )
    said = f"{'What came before it. ' * 190}The person was seen too late."
    note.fill(said)
    person.page.reload()  # it goes with the page, and not without a word
    person.alert("Your note on Drive to").get_by_role("button", name="Understood").tap()
    queue(person).get_by_role("button", name=re.compile("Drive to")).tap()
    form.get_by_role("radio", name=re.compile("Objected")).check()
    note.fill(said)
    record.tap()
    expect(queue(person).get_by_role("status")).to_have_text("Recorded: objected.")
    assert kept(server, stopped)["verdict"]["note"] == said


def test_of_two_reviewers_one_wins_and_the_other_is_told(
    server: ServerProcess, people: People, stopped: dict[str, Any]
) -> None:
    one, other = people.sit(server, size=PHONE), people.sit(server, "operator_2")
    one.page.evaluate(f"location.hash = '#/audit/{stopped['id']}'")
    one.region("Review").get_by_text("This session waits for a verdict").tap()
    other.page.get_by_role("button", name=re.compile("Drive to")).click()
    form = one.region("Review").get_by_role("form")
    form.get_by_role("radio", name=re.compile("Inconclusive")).tap()
    elsewhere = other.page.get_by_label("Newest first")
    elsewhere.focus()
    one.tap(form.get_by_role("button", name="Record the verdict"))
    expect(queue(other).get_by_role("status")).to_have_text("operator reviewed it: inconclusive.")
    expect(queue(other).get_by_role("form")).to_have_count(0)
    other.page.evaluate(THREE_FRAMES)
    expect(elsewhere).to_be_focused()  # whatever others do
    expect(one.region("Review")).to_contain_text("Reviewed by operator: inconclusive")
    assert kept(server, stopped)["status"] == "inconclusive"


def test_standing_grants_are_revoked_on_a_phone_without_passing_all_that_waits_for_a_verdict(
    server: ServerProcess, people: People, reviewed_later: dict[str, Any]
) -> None:
    grant = {"capability": "grasp_object", "agent": "planner", "cell": "workcell-1", "scope": "object", "minutes": 5}
    given = server.post("/v1/grants", {**grant, "object": "mug_1"})
    assert given.is_success, given.text
    person = people.sit(server, size=PHONE)
    waits = queue(person).get_by_role("button", name=re.compile("Drive to"))
    assert box(person.button(re.compile("^Revoke the grant")))["y"] < box(waits)["y"]
    person.tap(person.button(re.compile("^Revoke the grant")))
    expect(person.page.get_by_text("No standing grants.")).to_be_focused()


def test_a_late_answer_closes_its_own_form_and_what_was_written_is_kept(
    server: ServerProcess, people: People, floor: Floor, stopped: dict[str, Any]
) -> None:
    floor.clear()
    second = stop_one(server, floor)
    person = people.sit(server)
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    person.page.route("**/v1/reviews/*/resolve", hold)
    rows = queue(person).get_by_role("button", name=re.compile("Drive to"))
    expect(rows).to_have_count(2)
    expect(queue(person).get_by_role("heading")).to_have_text("To review 2")
    queue(person).get_by_text("Verdicts given").click()
    rows.first.click()
    form = queue(person).get_by_role("form")
    form.get_by_role("radio", name=re.compile("Accepted")).check()
    form.get_by_role("button", name="Record the verdict").click()
    until(lambda: held or person.page.wait_for_timeout(20), what="a verdict on its way")
    rows.last.click()
    expect(form).to_have_accessible_name(f"Verdict on {second['id']}")
    note = form.get_by_role("textbox")
    note.fill("Half a sentence")
    form.get_by_role("radio", name=re.compile("Objected")).check()
    held[0].continue_()
    expect(queue(person).get_by_role("status")).to_contain_text("Recorded: accepted.")
    expect(queue(person)).to_contain_text("accepted by operator")
    expect(rows).to_have_count(1)
    expect(note).to_have_value("Half a sentence")
    rows.click()
    expect(form).to_have_count(0)
    rows.click()
    expect(note).to_have_value("Half a sentence")
    person.page.evaluate("location.hash = '#/fleet'")
    expect(person.page.get_by_role("heading", name="Fleet")).to_be_visible()
    person.page.evaluate("location.hash = '#/live'")
    expect(note).to_have_value("Half a sentence")
    expect(form.get_by_role("radio", name=re.compile("Objected"))).to_be_checked()
    queue(person).get_by_text("Verdicts given").click()
    expect(queue(person)).to_contain_text("accepted by operator")
    judge(server, kept(server, second), "inconclusive")
    expect(queue(person)).to_contain_text("Your note was not recorded: “Half a sentence”")
    expect(queue(person)).to_contain_text("inconclusive by operator_2")


def test_a_verdict_is_recorded_by_no_finger_that_was_moved_and_of_two_notes_a_double_press_puts_one_away(
    server: ServerProcess, people: People, floor: Floor, stopped: dict[str, Any]
) -> None:
    floor.clear()
    second = stop_one(server, floor)
    person = people.sit(server)
    rows = queue(person).get_by_role("button", name=re.compile("Drive to"))
    expect(rows).to_have_count(2)
    note = queue(person).get_by_label("Note for the record")
    rows.first.click()
    note.fill("Half a sentence")
    rows.last.click()
    note.fill("Another half")
    form = queue(person).get_by_role("form")
    expect(form).to_have_accessible_name(f"Verdict on {second['id']}")
    form.get_by_role("radio", name=re.compile("Objected")).check()
    record = form.get_by_role("button", name="Record the verdict")
    expect(record).to_be_enabled()
    record.evaluate(PRESS_ONCE_MOVED)
    judge(server, kept(server, stopped), "accepted")
    until(lambda: person.page.evaluate("window.pressed"), what="a press")
    expect(record).to_be_enabled()
    assert kept(server, second)["verdict"] is None
    judge(server, kept(server, second), "inconclusive")
    left = queue(person).get_by_text("Your note was not recorded")
    expect(left).to_have_count(2)
    person.twice(queue(person).get_by_role("button", name="Understood").first, after_ms=200)
    expect(left).to_have_count(1)
    expect(left).to_contain_text("“Half a sentence”")


def test_what_became_of_a_review_while_the_link_was_down_is_told_and_the_note_stays(
    server: ServerProcess, people: People, stopped: dict[str, Any]
) -> None:
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        queue(person).get_by_role("button", name=re.compile("Drive to")).click()
        form = queue(person).get_by_role("form")
        form.get_by_role("textbox").fill("It stood too near.")
        form.get_by_role("radio", name=re.compile("Accepted")).check()
        record = form.get_by_role("button", name="Record the verdict")
        person.page.route("**/v1/reviews/*/resolve", lambda route: route.abort())
        record.focus()
        person.enter(record)
        expect(form.get_by_role("alert")).to_contain_text("it is not known whether your verdict was recorded")
        expect(record).to_be_focused()
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        expect(record).to_be_disabled()
        expect(form).to_be_focused()
        judge(server, kept(server, stopped), "objected")
        wire.mend()
        expect(queue(person).get_by_role("status").first).to_have_text("operator_2 reviewed it: objected.")
        expect(form).to_have_count(0)
        expect(queue(person)).to_contain_text("Your note was not recorded: “It stood too near.”")
        expect(queue(person).get_by_role("heading")).to_have_text("To review 0")
        queue(person).get_by_role("button", name="Understood").click()
        expect(queue(person).get_by_text("It stood too near.")).to_have_count(0)
