"""Policy changed from the console: brought, mended, compared, asked in the shadow, put in force by two, undone."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Locator, Route, expect

from app.api.auth import issue_token
from app.governance.model import Role
from tests.conftest import ServerProcess, Servers, until
from tests.console.conftest import (
    PHONE,
    PRESS_ONCE_MOVED,
    ROOT,
    THREE_FRAMES,
    TRIES,
    People,
    Person,
    at_once,
    wider_than_the_screen,
)
from tests.console.test_access import AXE, COLOURS, EVERYTHING, faults
from tests.console.test_link import BROKEN
from tests.console.wire import wire_to

pytestmark = [pytest.mark.browser, pytest.mark.process]
FIRMER = "grip_force_n: {max: 70,"
SHIPPED = "grip_force_n: {max: 60,"
PROFILE = "profiles/human-shared.yaml"
GRASP = "capabilities/grasp_object.yaml"
REFUSED = r"status of (403|409|422)"  # the browser's own note of a request that was refused
# Presses what is offered in the very frame in which somebody else has made something else of it.
PRESS_ONCE_OTHER = """(button) => {
    const said = button.textContent;
    const look = () => {
        if (button.textContent === said) return requestAnimationFrame(look);
        const how = { bubbles: true, cancelable: true, pointerId: 1, button: 0 };
        for (const what of ['pointerdown', 'pointerup']) button.dispatchEvent(new PointerEvent(what, how));
        button.click();
        window.pressed = button.textContent.trim();
    };
    requestAnimationFrame(look);
}"""


@pytest.fixture(scope="module")
def changing(built: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server of its own, without a cell: what is in force changes here. A second engineer has a token."""
    made = Servers(tmp_path_factory.mktemp("versions"))
    try:
        server = made.start(None, "--policies", str(ROOT / "policies"), cells=0)
        server.tokens["engineer_2"] = issue_token(server.data, name="engineer_2", role=Role.ENGINEER)
        yield server
    finally:
        made.end()


def candidate(folder: Path, bound: str, *, break_it: bool = False) -> Path:
    """A policy directory as an engineer has it, with everything that lies about in one."""
    shutil.copytree(ROOT / "policies", folder)
    profile = folder / PROFILE
    text = profile.read_text()
    assert SHIPPED in text
    text = text.replace(SHIPPED, bound)
    profile.write_text(text.replace("signal: stall_s", "signal: stall_h") if break_it else text)
    for cases in (folder / "tests").glob("*.yaml"):  # the shipped cases hold the shipped bound in place
        cases.unlink()
    return folder


def seat(people: People, server: ServerProcess, key: str, **how: object) -> Person:
    """Sit down before the versions of policy, signed in as `key`."""
    keep = f"sessionStorage.setItem('reins.token', '{server.tokens[key]}')"
    person = people.open(f"{server.url}/#/policy/Versions", init=keep, **how)
    expect(person.region("Versions").get_by_role("link").first).to_be_visible()
    return person


def versions(person: Person) -> None:
    person.page.evaluate("location.hash = '#/policy/Versions'")
    expect(person.region("Versions").get_by_role("link").first).to_be_visible()


def say_why(region: Locator, why: str) -> None:
    region.get_by_label("Why").fill(why)


def press(button: Locator, told: Locator) -> None:
    """Press as a person does: what the page has just moved takes no finger, and is pressed once more."""
    for _ in range(TRIES):
        button.click()
        try:
            expect(told).to_be_visible(timeout=5_000)
        except AssertionError:
            if not button.is_visible() or button.is_disabled():
                break  # it was taken, and its answer is late
        else:
            return
    expect(told).to_be_visible()


def test_a_candidate_is_mended_compared_tried_put_in_force_by_two_and_undone(
    changing: ServerProcess, people: People, tmp_path: Path
) -> None:
    first = seat(people, changing, "engineer")
    first.expects(REFUSED)

    # brought, with a fault: told at its line, and mended there
    first.page.get_by_role("link", name="Bring a candidate").click()
    bring = first.region("Bring a candidate")
    bring.get_by_label("Choose a folder").set_input_files(candidate(tmp_path / "policies", FIRMER, break_it=True))
    say_why(bring, "mugs slip at 60 N")
    bring.get_by_role("button", name="Check and keep").click()
    expect(bring.get_by_role("alert")).to_contain_text("1 fault: it is not kept.")
    expect(bring.get_by_role("button", name="Check again")).to_be_focused()  # while it was sent, it could not be
    told = bring.get_by_role("list", name=f"Faults in {PROFILE}")
    expect(told).to_contain_text("there is no signal “stall_h”")
    told.get_by_role("button", name=re.compile(r"Line \d+")).click()
    editor = bring.get_by_role("textbox", name=PROFILE)
    expect(editor).to_be_focused()
    first.press("End")
    first.press("Backspace")
    first.page.keyboard.type("s")
    bring.get_by_role("button", name="Check again").click()

    # kept: what it would change, and what it would have decided
    view = first.page.get_by_role("region", name=re.compile("^Version "))
    expect(view.get_by_role("region", name="What it would change")).to_contain_text("Loosens")
    expect(view).to_contain_text("profiles/human-shared/limits/grip_force_n/maximum")
    otherwise = view.get_by_role("list", name="Decisions that come out otherwise").get_by_role("listitem")
    grasp = otherwise.filter(has_text="grasp_object under human-shared")
    expect(grasp.get_by_role("row", name="Outcome")).to_have_text(re.compile("asks one person *asks one person"))
    expect(grasp.get_by_role("row", name="Grip force")).to_have_text(re.compile(r"60 N *\S+ N"))
    expect(view).to_contain_text("yours is the first word")
    expect(view.get_by_role("button", name="Give the first word")).to_have_accessible_description(
        "Say why first: it stays in the record."
    )
    say_why(view, "is anything else decided otherwise?")
    press(view.get_by_role("button", name="Ask it in the shadow"), view.get_by_role("button", name="End the shadow"))
    expect(view.get_by_role("group", name="About this version")).to_be_focused()
    changing.propose("grasp_object", object_id="mug_1", force_n=80.0)
    shadow = view.get_by_role("region", name="In the shadow")
    expect(shadow).to_contain_text(re.compile("[1-9][0-9]* decisions, [1-9]"))
    expect(shadow.get_by_role("link", name=re.compile("^inv_")).first).to_be_visible()

    # two engineers put it in force
    say_why(view, "mugs slip at 60 N")
    first.press("Enter")  # which ends what is written, and is no word
    first.page.evaluate("location.hash = '#/live'")
    expect(first.region("Waiting for")).to_be_visible()
    first.page.go_back()
    expect(view.get_by_label("Why")).to_have_value("mugs slip at 60 N")  # whatever else one looked at meanwhile
    press(view.get_by_role("button", name="Give the first word"), view.get_by_text("Waits for another engineer").first)
    expect(view.get_by_label("Why")).to_have_value("")
    expect(view.get_by_role("button", name="Give the second word")).to_be_disabled()
    digest = changing.get("/v1/policies", key="engineer")["items"][0]["digest"]
    second = seat(people, changing, "engineer_2")
    second.region("Versions").get_by_role("link", name=re.compile("Waits for another engineer")).click()
    other = second.page.get_by_role("region", name=re.compile("^Version "))
    say_why(other, "agreed, after the measurement")
    press(other.get_by_role("button", name="Give the second word"), other.get_by_text("engineer and engineer_2").first)
    assert changing.get("/v1/policies/active")["version"] == digest
    expect(first.region("Versions").get_by_role("link", name=re.compile(f"In force {digest[7:19]}"))).to_be_visible()

    # and one of them takes it back: a tightening
    versions(first)
    first.region("Versions").get_by_role("link", name=re.compile("Was in force")).click()
    former = first.page.get_by_role("region", name=re.compile("^Version "))
    expect(former).to_contain_text("It loosens nothing: one engineer is enough.")
    say_why(former, "too many near misses")
    in_force = former.get_by_role("region", name="When it was in force")
    press(former.get_by_role("button", name="Roll back to this"), in_force.get_by_text("too many near misses"))
    expect(former.get_by_role("group", name="About this version")).to_be_focused()
    until(lambda: changing.get("/v1/policies/active")["version"] != digest, what="the former version in force")


def test_an_archive_of_one_file_stands_for_a_change_and_an_auditor_only_looks(
    changing: ServerProcess, people: People, tmp_path: Path
) -> None:
    text = (ROOT / PROFILE.replace("profiles/", "policies/profiles/")).read_text()
    with zipfile.ZipFile(tmp_path / "change.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("human-shared.yaml", text.replace(SHIPPED, "grip_force_n: {max: 40,"))
    engineer = seat(people, changing, "engineer")
    engineer.page.evaluate("location.hash = '#/policy/Versions/new'")
    bring = engineer.region("Bring a candidate")
    bring.get_by_label("Choose files or a ZIP").set_input_files(tmp_path / "change.zip")
    expect(bring).to_contain_text("One file differs from what is in force; everything else is taken from it")
    say_why(bring, "weaker, for a visit")
    bring.get_by_role("button", name="Check and keep").click()
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    expect(view).to_contain_text("It loosens nothing: one engineer is enough.")
    auditor = seat(people, changing, "auditor")
    expect(auditor.page.get_by_role("link", name="Bring a candidate")).to_have_count(0)
    auditor.region("Versions").get_by_role("link", name=re.compile("weaker, for a visit")).click()
    looked = auditor.page.get_by_role("region", name=re.compile("^Version "))
    expect(looked).to_contain_text("Engineers put versions in force; you may look.")
    expect(looked.get_by_role("button", name="Put in force")).to_have_count(0)


def begin(engineer: Person, line: str, why: str) -> tuple[Locator, Locator]:
    """Begin a candidate with what is in force and one line more; returns its region, and its editor."""
    engineer.page.evaluate("location.hash = '#/policy/Versions/new'")
    bring = engineer.region("Bring a candidate")
    with at_once("**/v1/policies?limit=1", engineer):
        bring.get_by_role("button", name="Edit what is in force").click()
        expect(bring.get_by_role("status")).to_have_text("What is in force is being read…")
    editor = bring.get_by_role("textbox", name=re.compile("yaml$"))
    editor.press("Control+Home")
    engineer.page.keyboard.type(line)
    say_why(bring, why)
    return bring, editor


def test_who_goes_on_while_a_candidate_is_checked_loses_nothing_and_is_not_fetched_back(
    changing: ServerProcess, people: People
) -> None:
    engineer = seat(people, changing, "engineer")
    kept = engineer.page.get_by_role("status").filter(has_text="What you brought was kept as version")

    def checked() -> AbstractContextManager[object]:
        return engineer.page.expect_response(lambda answer: answer.request.method == "POST" and answer.status == 201)

    bring, _ = begin(engineer, "# left\n", "left while it is checked")
    with checked(), at_once("**/v1/policies", engineer):
        bring.get_by_role("button", name="Check and keep").click()
        engineer.page.evaluate("location.hash = '#/fleet'")
        expect(engineer.page.get_by_role("heading", name="Fleet")).to_be_visible()
    engineer.page.evaluate(THREE_FRAMES)
    assert engineer.page.evaluate("location.hash") == "#/fleet"
    versions(engineer)
    kept.get_by_role("link").click()
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    expect(view).to_contain_text("left while it is checked")
    expect(kept).to_have_count(0)

    bring, editor = begin(engineer, "# first\n", "changed while it is checked")
    with checked(), at_once("**/v1/policies", engineer):
        bring.get_by_role("button", name="Check and keep").click()
        expect(bring.get_by_text("What you change meanwhile is not in it")).to_be_in_viewport()
        expect(bring.get_by_role("button", name="Discard")).to_be_disabled()
        editor.press("Control+Home")
        engineer.page.keyboard.type("# second\n")
    expect(kept).to_contain_text("What was changed since is not in it.")
    expect(kept).to_be_in_viewport()
    expect(editor).to_have_value(re.compile("^# second\n# first\n"))
    expect(editor).to_be_focused()
    bring.get_by_role("button", name="Check and keep").click()
    expect(view).to_contain_text("changed while it is checked")
    expect(kept).to_have_count(0)


def test_who_brings_what_was_brought_before_is_told_that_their_reason_is_not_kept(
    changing: ServerProcess, people: People
) -> None:
    engineer = seat(people, changing, "engineer")
    told = engineer.page.get_by_role("status").filter(has_text="the record keeps the reason that was given then")
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    for why, times in (("the first reason", 0), ("another reason", 1)):
        bring, _ = begin(engineer, "# brought twice\n", why)
        bring.get_by_role("button", name="Check and keep").click()
        expect(view).to_contain_text("the first reason")
        expect(told).to_have_count(times)
    expect(told).to_be_in_viewport()
    versions(engineer)
    expect(told).to_have_count(0)


def pick(engineer: Person, files: dict[str, str]) -> Locator:
    """Pick files by their names; returns the region of the candidate that they make."""
    engineer.page.evaluate("location.hash = '#/policy/Versions/new'")
    bring = engineer.region("Bring a candidate")
    bring.get_by_label("Choose files or a ZIP").set_input_files(
        [{"name": name, "mimeType": "", "buffer": text.encode()} for name, text in files.items()]
    )
    expect(bring.get_by_text(re.compile("differs? from what is in force"))).to_be_visible()
    say_why(bring, "for a visit")
    return bring


def test_a_fault_is_shown_on_its_line_whatever_ends_the_lines(changing: ServerProcess, people: People) -> None:
    engineer = seat(people, changing, "engineer")
    engineer.expects(REFUSED)
    text = (ROOT / "policies" / PROFILE).read_text().replace("signal: stall_s", "signal: stall_h")
    bring = pick(engineer, {"human-shared.yaml": text.replace("\n", "\r\n")})
    bring.get_by_role("button", name="Check and keep").click()
    bring.get_by_role("button", name=re.compile(r"Line \d+")).click()
    expect(bring.get_by_role("textbox", name=PROFILE)).to_be_focused()
    chosen = "(({value, selectionStart, selectionEnd}) => value.slice(selectionStart, selectionEnd))"
    assert engineer.page.evaluate(f"{chosen}(document.activeElement)").strip() == "signal: stall_h"


def test_a_file_whose_name_turns_its_line_around_is_marked_wherever_it_is_named(
    changing: ServerProcess, people: People
) -> None:
    engineer = seat(people, changing, "engineer")
    text = (ROOT / "policies/capabilities/inspect_area.yaml").read_text()
    bring = pick(engineer, {"see_\u202elmay.yaml": text, "notes_\u202ecod.txt": "none"})
    expect(bring.get_by_role("list", name="Files that differ")).to_contain_text("see_\ufffdlmay.yaml")
    expect(bring.get_by_role("textbox", name="see_\ufffdlmay.yaml")).to_be_visible()
    expect(bring).to_contain_text("notes_\ufffdcod.txt")
    assert "\u202e" not in bring.inner_text()


def test_of_many_files_the_fault_in_one_is_seen_from_where_it_was_sent(changing: ServerProcess, people: People) -> None:
    engineer = seat(people, changing, "engineer")
    engineer.expects(REFUSED)
    text = (ROOT / "policies/capabilities/inspect_area.yaml").read_text().replace("risk: low", "risk: lowly")
    names = [f"inspect_{k}" for k in range(60)]
    bring = pick(engineer, {f"{name}.yaml": text.replace("inspect_area", name) for name in names})
    bring.get_by_role("button", name="Check and keep").click()
    expect(bring.get_by_role("button", name="Check again")).to_be_in_viewport()
    expect(bring.get_by_role("alert")).to_contain_text("it is not kept.")
    expect(bring.get_by_role("alert")).to_be_in_viewport()


def test_why_a_candidate_is_not_kept_is_in_sight_on_a_phone(changing: ServerProcess, people: People) -> None:
    engineer = seat(people, changing, "engineer", size=PHONE)
    engineer.expects(f"{REFUSED}|ERR_FAILED")
    text = (ROOT / "policies" / PROFILE).read_text().replace("signal: stall_s", "signal: stall_h")
    bring = pick(engineer, {"human-shared.yaml": text})
    bring.get_by_role("button", name="Check and keep").tap()
    told = bring.get_by_role("alert")
    expect(told).to_contain_text("1 fault: it is not kept.")
    expect(told).to_be_in_viewport(ratio=0.9)
    engineer.page.route("**/v1/policies", lambda route: route.abort())
    bring.get_by_role("button", name="Check again").tap()
    unsure = told.filter(has_text="it is not known whether this arrived")
    expect(unsure).to_be_in_viewport(ratio=0.9)


def test_a_file_of_a_million_lines_is_brought_and_holds_no_stop_up(changing: ServerProcess, people: People) -> None:
    engineer = seat(people, changing, "engineer")
    text = (ROOT / "policies" / PROFILE).read_text().replace(SHIPPED, "grip_force_n: {max: 52,")
    bring = pick(engineer, {"human-shared.yaml": text + "\n" * 1_000_000})
    expect(bring).to_contain_text("too long to be shown here")
    expect(bring.get_by_role("textbox", name=PROFILE)).to_have_count(0)
    bring.get_by_role("button", name="Check and keep").click()
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    expect(view).to_contain_text("It loosens nothing: one engineer is enough.")


def test_whoever_loads_the_page_anew_over_a_candidate_is_told_that_it_was_not_sent(
    changing: ServerProcess, people: People
) -> None:
    person = people.sit(changing, "engineer")
    told = person.alert("The policy that you were about to bring was not sent, and is gone.")
    person.page.evaluate("location.hash = '#/policy/Versions/new'")
    person.button("Edit what is in force").click()
    expect(person.button("Discard")).to_be_visible()
    person.page.reload()
    expect(person.button("Edit what is in force")).to_be_enabled()
    expect(told).to_have_count(0)  # nothing was written
    person.button("Edit what is in force").click()
    person.page.get_by_label("Why").fill("for a visit")
    person.page.evaluate("location.hash = '#/live'")
    person.page.reload()
    expect(told).to_be_visible()


def test_no_finger_that_was_moved_discards_a_candidate(changing: ServerProcess, people: People) -> None:
    with wire_to(urlsplit(changing.url).port or 0) as wire:
        person = people.sit(changing, "engineer", at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        person.page.evaluate("location.hash = '#/policy/Versions/new'")
        person.button("Edit what is in force").click()
        discard = person.button("Discard")
        expect(discard).to_be_enabled()
        person.page.get_by_label("Why").fill("for a visit")
        discard.evaluate(PRESS_ONCE_MOVED)
        wire.cut()
        assert until(lambda: person.page.evaluate("window.pressed"), what="a press") == "Discard"
        expect(person.page.get_by_label("Why")).to_have_value("for a visit")
        wire.mend()
        discard.click()
        expect(discard).to_have_count(0)


def test_parameters_of_one_name_in_words_are_compared_each_in_a_row_of_its_own(
    changing: ServerProcess, people: People
) -> None:
    more = (
        "    speed: {type: string, enum: [slow, quick], default: slow}\n    outcome: {type: boolean, default: true}\n"
    )
    wanted = kept(changing, "grip_force_n: {max: 70,", "a grasp takes more", more)
    engineer = seat(people, changing, "engineer")
    engineer.page.evaluate(f"location.hash = '#/policy/Versions/{wanted}'")
    decisions = engineer.page.get_by_role("list", name="Decisions that come out otherwise").get_by_role("listitem")
    grasp = decisions.filter(has_text="grasp_object under human-shared").first
    expect(grasp.get_by_role("row", name="Grip force")).to_be_visible()
    for name in ("Speed", "Outcome"):
        expect(grasp.get_by_role("row", name=re.compile(f"^{name} "))).to_have_count(2)


def test_a_word_is_given_for_the_change_that_was_read_and_for_no_other(changing: ServerProcess, people: People) -> None:
    # Another one comes into force while the list that says so is still on its way to this page.
    wanted, theirs = (kept(changing, f"grip_force_n: {{max: {force},", f"at most {force} N") for force in (45, 35))
    active = changing.get("/v1/policies/active")["version"]
    engineer = seat(people, changing, "engineer")
    engineer.expects(REFUSED)
    engineer.page.evaluate(f"location.hash = '#/policy/Versions/{wanted}'")
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    expect(view).to_contain_text("It loosens nothing: one engineer is enough.")
    say_why(view, "weaker, for a visit")
    try:
        engineer.page.route("**/v1/policies?limit=*", lambda _: None)  # never answered
        put_in_force(changing, theirs)
        expect(engineer.page.get_by_title(theirs)).to_be_visible()  # what is in force is told in the header
        with engineer.page.expect_response("**/activate") as answered:
            view.get_by_role("button", name="Put in force").click()
        assert answered.value.json()["code"] == "policy_changed"
        assert changing.get(f"/v1/policies/{wanted}", key="engineer")["awaiting"] is None
    finally:
        put_in_force(changing, active)


def test_words_that_turn_their_line_around_are_marked_where_another_gives_the_second_word(
    changing: ServerProcess, people: People
) -> None:
    turned = "from \u202eN 06 ot 041"  # drawn as `from 140 to 60 N`, unless it is marked
    wanted = kept(changing, "grip_force_n: {max: 75,", turned)
    first = {"why": turned}
    assert changing.post(f"/v1/policies/{wanted}/activate", first, key="engineer").json()["awaiting"] is not None
    other = seat(people, changing, "engineer_2")
    marked = "from \ufffdN 06 ot 041"
    expect(other.region("Versions").get_by_role("link").filter(has_text=wanted[7:19])).to_contain_text(marked)
    other.page.evaluate(f"location.hash = '#/policy/Versions/{wanted}'")
    view = other.page.get_by_role("region", name=re.compile("^Version "))
    expect(view).to_contain_text(f"{marked} brought by engineer")
    expect(view).to_contain_text(f"engineer wants it in force: {marked}")
    expect(view.get_by_role("list", name="Parts that are others")).to_be_visible()
    expect(view).not_to_contain_text("\u202e")


def test_a_shadow_that_another_engineer_begins_and_ends_is_shown_by_itself(
    changing: ServerProcess, people: People
) -> None:
    path = f"/v1/policies/{kept(changing, 'grip_force_n: {max: 77,', 'for the shadow')}"
    engineer = seat(people, changing, "engineer")
    engineer.page.evaluate(f"location.hash = '#/policy/Versions/{path.rpartition('/')[2]}'")
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    expect(view).to_contain_text("Not in the shadow")
    for on, offered in ((True, "End the shadow"), (False, "Ask it in the shadow")):
        said = {"on": on, "why": "a look"}
        assert changing.post(f"{path}/shadow", said, key="engineer_2").is_success
        expect(view.get_by_role("button", name=offered)).to_be_visible()


def test_a_press_that_was_meant_to_begin_a_shadow_does_not_end_the_one_that_another_has_just_begun(
    changing: ServerProcess, people: People
) -> None:
    path = f"/v1/policies/{kept(changing, 'grip_force_n: {max: 78,', 'for the shadow, too')}"
    engineer = seat(people, changing, "engineer")
    engineer.page.evaluate(f"location.hash = '#/policy/Versions/{path.rpartition('/')[2]}'")
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    say_why(view, "a look")
    sent: list[str] = []
    engineer.hears("request", lambda request: sent.append(request.url) if request.method == "POST" else None)
    view.get_by_role("button", name="Ask it in the shadow").click(trial=True)  # when it takes a press
    view.get_by_role("button", name="Ask it in the shadow").evaluate(PRESS_ONCE_OTHER)
    assert changing.post(f"{path}/shadow", {"on": True, "why": "a look"}, key="engineer_2").is_success
    until(
        lambda: engineer.page.evaluate("window.pressed") == "End the shadow", what="a press of what is another button"
    )
    engineer.page.evaluate(THREE_FRAMES)
    assert sent == []
    view.get_by_role("button", name="End the shadow").click()
    expect(view.get_by_role("button", name="Ask it in the shadow")).to_be_visible()
    assert changing.get(f"{path}/shadow", key="engineer")["on"] is False


def test_who_writes_a_candidate_is_told_that_another_version_came_into_force(
    changing: ServerProcess, people: People
) -> None:
    theirs, active = kept(changing, "grip_force_n: {max: 33,", "theirs"), changing.get("/v1/policies/active")["version"]
    engineer = seat(people, changing, "engineer")
    bring, editor = begin(engineer, "# mine\n", "begun before")
    told = bring.get_by_role("alert").filter(has_text="Another version came into force meanwhile.")
    expect(told).to_have_count(0)
    try:
        put_in_force(changing, theirs)
        expect(told).to_be_visible()
        expect(editor).to_have_value(re.compile("^# mine\n"))
        anew = bring.get_by_role("button", name="Edit what is in force")
        expect(anew).to_be_disabled()
        expect(bring.get_by_label("Choose files or a ZIP")).to_be_disabled()
        expect(bring).to_contain_text("To begin anew, discard what you wrote.")
        bring.get_by_role("button", name="Discard").click()
        anew.click()
        expect(editor).not_to_have_value(re.compile("^# mine\n"))
        expect(told).to_have_count(0)
    finally:
        put_in_force(changing, active)


def kept(server: ServerProcess, bound: str, why: str, more: str = "") -> str:
    """Bring what is in force with another bound, and with more that a grasp takes; returns its digest."""
    active = server.get("/v1/policies/active")["version"]
    found = server.get(f"/v1/policies/{active}/files")
    files = {**found["files"], "properties.yaml": found["promises"]}
    files[PROFILE] = re.sub(r"grip_force_n: \{max: \d+,", bound, files[PROFILE])
    if more:
        wider = files[GRASP].replace("  properties:\n", f"  properties:\n{more}")
        files[GRASP] = wider.replace("version: 1.0.0", "version: 1.1.0")
    with server.client("engineer") as client:
        answer = client.post("/v1/policies", json={"files": files, "why": why})
    assert answer.is_success, answer.text
    return answer.json()["digest"]


def put_in_force(server: ServerProcess, digest: str) -> None:
    """Put a version in force, by as many engineers as that takes."""
    for key in ("engineer_2", "engineer"):
        if server.get("/v1/policies/active")["version"] != digest:
            assert server.post(f"/v1/policies/{digest}/activate", {"why": "for a test"}, key=key).is_success


def test_a_version_that_the_list_does_not_reach_to_is_read_by_its_digest(
    changing: ServerProcess, people: People
) -> None:
    engineer = seat(people, changing, "engineer")
    engineer.expects(r"status of (404|422)")
    active = changing.get("/v1/policies", key="engineer")["active"]
    files = changing.get(f"/v1/policies/{active}/files", key="engineer")["files"]
    body = {"files": {**files, PROFILE: f"# beyond the list\n{files[PROFILE]}"}, "why": "beyond the list"}
    brought = changing.post("/v1/policies", body, key="engineer").json()

    def cut(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, json={**answer.json(), "items": [], "next": "50"})

    engineer.page.route("**/v1/policies?limit=50", cut)
    engineer.page.goto(f"{changing.url}/#/policy/Versions")
    engineer.page.reload()
    said = engineer.page.get_by_role("status").filter(has_text=re.compile("^(Reading…|There is no such version.)$"))
    view = engineer.page.get_by_role("region", name=re.compile("^Version "))
    expect(view).to_contain_text("In force")
    for digest, found in ((brought["digest"], brought["why"]), ("sha256:" + "0" * 64, None), ("nonsense", None)):
        with at_once(f"**/v1/policies/{digest.replace(':', '*')}", engineer):
            engineer.page.evaluate(f"location.hash = '#/policy/Versions/{digest}'")
            expect(said).to_have_text("Reading…")
        if found is None:
            expect(said).to_have_text("There is no such version.")
        else:
            expect(view).to_contain_text(found)


def test_versions_are_asked_for_anew_when_the_link_is_back(changing: ServerProcess, people: People) -> None:
    with wire_to(urlsplit(changing.url).port or 0) as wire:
        keep = f"sessionStorage.setItem('reins.token', '{changing.tokens['engineer']}')"
        person = people.open(f"http://127.0.0.1:{wire.port}/#/policy/Versions", init=keep)
        person.expects(BROKEN)
        expect(person.region("Versions").get_by_role("link").first).to_be_visible()
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        # as of another log whose events have the numbers that those of the one before had
        others = {"items": [], "next": None, "active": None, "why": "another directory"}
        person.page.route("**/v1/policies?*", lambda route: route.fulfill(json=others))
        wire.mend()
        expect(person.region("Versions").get_by_role("link")).to_have_count(1)  # that to bring a candidate


@pytest.mark.parametrize("size", [None, PHONE], ids=["desk", "phone"])
def test_versions_can_be_used_by_everybody_at_any_width(
    changing: ServerProcess, people: People, size: dict[str, int] | None
) -> None:
    axe = AXE.read_text()
    found: dict[str, list[str]] = {}
    person = seat(people, changing, "engineer", size=size)
    links = person.region("Versions").get_by_role("link").filter(has_text=re.compile("sha|[0-9a-f]{12}"))
    for name, there in (("list", None), ("version", links.last), ("new", None)):
        if there is not None:
            there.click()
            expect(person.page.get_by_role("region", name=re.compile("^Version "))).to_be_visible()
        if name == "new":
            person.page.evaluate("location.hash = '#/policy/Versions/new'")
            person.button("Edit what is in force").click()
            expect(person.page.get_by_role("textbox", name=re.compile("yaml$"))).to_be_visible()
        for theme, rules in (("light", COLOURS), ("dark", EVERYTHING)):
            person.press("n")
            found[f"{name}, {theme}"] = faults(person.page, axe, rules)
        if size == PHONE:
            found[f"{name}, width"] = wider_than_the_screen(person.page)
    assert {name: what for name, what in found.items() if what} == {}
