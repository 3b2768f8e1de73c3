"""What an operator decides at a console: who gets in, and what becomes of a question."""

from __future__ import annotations

import os
import re
import signal
from typing import Any

import pytest
from playwright.sync_api import Locator, Route, expect

from tests.conftest import ServerProcess, until
from tests.console.conftest import (
    ANSWERS,
    DESK,
    PHONE,
    THREE_FRAMES,
    Floor,
    People,
    Person,
    at_once,
    box,
    wider_than_the_screen,
)

pytestmark = [pytest.mark.browser, pytest.mark.process]


def card(person: Person, title: str = "Grasp mug_1") -> Locator:
    return person.page.get_by_role("article", name=title)


# A fifth of the patience, for what is given up in a test.
IMPATIENT = "const timeout = AbortSignal.timeout.bind(AbortSignal); AbortSignal.timeout = (ms) => timeout(ms / 5)"


def test_the_printed_link_signs_in_and_its_token_leaves_the_address(server: ServerProcess, people: People) -> None:
    printed = re.search(r"http://\S+/#token=\S+", server.log.read_text())
    assert printed is not None, server.tail()
    person = people.open(printed[0])
    expect(person.page.get_by_role("heading", name="Live")).to_be_attached()
    expect(person.page).to_have_url(f"{server.url}/#/live")
    expect(person.region("Waiting for you")).to_contain_text("Nothing waits for a person.")
    assert person.page.evaluate("sessionStorage.getItem('reins.token')") == server.tokens["operator"]
    assert person.page.evaluate("Object.values(localStorage).concat(document.cookie).join()") == ""
    person.page.reload()
    expect(person.region("Waiting for you")).to_be_visible()


def test_the_focus_stays_with_a_question_while_its_answer_is_sent_and_a_denial_that_did_not_arrive_is_told_anywhere(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person, held = people.sit(server), list[Route]()
    person.expects("ERR_FAILED")

    def hold(route: Route) -> None:
        held.append(route)

    asked = floor.ask()
    person.page.route("**/resolve", hold)
    deny = person.button(re.compile("^Deny"))
    expect(deny).to_be_focused()
    person.says_why()
    deny.click()
    until(lambda: held or person.page.wait_for_timeout(20), what="an answer on its way")
    person.page.evaluate(THREE_FRAMES)
    expect(card(person)).to_be_focused()
    held.pop().continue_()
    expect(card(person)).to_have_count(0)
    expect(person.page.locator("main")).to_be_focused()
    assert floor.settled(asked["id"])["status"] == "denied"
    floor.ask()
    link = person.page.get_by_role("link", name="Fleet")
    expect(deny).to_be_enabled()
    person.says_why()
    link.focus()
    expect(link).to_be_focused()  # whoever is at something else is left there
    person.press("d")
    until(lambda: held or person.page.wait_for_timeout(20), what="another answer on its way")
    person.page.evaluate(THREE_FRAMES)
    expect(link).to_be_focused()
    held.pop().continue_()
    expect(card(person)).to_have_count(0)
    expect(link).to_be_focused()
    floor.ask("glass_1")
    expect(card(person, "Grasp glass_1")).to_be_visible()
    floor.ask("mug_1")
    person.says_why()
    deny.click()
    until(lambda: held or person.page.wait_for_timeout(20), what="a denial that is held")
    person.press("x")
    expect(card(person)).to_be_visible()
    held.pop().abort()
    told = person.alert("Grasp glass_1: No answer from the server")
    expect(told).to_contain_text("The question still waits.")
    for page in "21":
        person.press(page)
    expect(person.alert("No answer from the server: it is not known whether this arrived.")).to_be_visible()


def test_a_wrong_token_is_refused_in_words(server: ServerProcess, people: People) -> None:
    person = people.open(f"{server.url}/#token=nonsense")
    person.expects("401")
    expect(person.alert("This token is not valid here, or not any more.")).to_be_visible()
    person.page.get_by_label("Token").fill(server.tokens["operator"])
    person.press("Enter")
    expect(person.region("Waiting for you")).to_be_visible()


def test_a_question_appears_and_is_answered_by_one_key_and_a_denial_gives_the_agent_a_code_and_nobodys_words(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    proposed = floor.ask()
    expect(card(person)).to_contain_text("Medium risk")
    expect(card(person)).to_contain_text("human-shared / authority")
    expect(person.alert("Waiting for you: Grasp mug_1, medium risk.")).to_be_attached()
    expect(person.button(re.compile("^Deny"))).to_be_focused()
    expect(person.page.get_by_role("row", name=re.compile("^Grip force|^Force"))).to_contain_text("80")
    seen = person.button("I have seen it")
    seen.focus()
    person.enter(seen)
    expect(seen).to_have_count(0)
    expect(card(person)).to_be_focused()  # what goes leaves whoever was at it with the question
    reasons = card(person).get_by_label("Reason if denied")
    press_until(person, "d", gone=person.page.locator(":not(select):focus"))
    expect(reasons).to_be_focused()  # a denial needs a reason, and here none suggests itself
    expect(card(person).get_by_role("alert")).to_have_text("Why? Choose a reason, then press Deny again.")
    assert server.get(f"/v1/invocations/{proposed['id']}")["status"] == "awaiting_approval"
    person.press("Shift+Tab")
    expect(person.button(re.compile("^Deny"))).to_be_focused()  # not the button beside it, which approves
    press_until(person, "d", gone=person.page.locator(":not(select):focus"))
    reasons.select_option(label="person in the way")
    expect(card(person).get_by_role("alert")).to_have_count(0)
    card(person).get_by_role("heading").click()
    press_until(person, "d", gone=card(person))
    denied = floor.settled(proposed["id"])
    assert (denied["status"], denied["escalation"]["code"]) == ("denied", "person_in_the_way")
    expect(person.region("Events")).to_contain_text("operator denied")
    proposed = floor.ask()
    expect(card(person)).to_be_visible()
    press_until(person, "a", gone=card(person))
    expect(card(person)).to_have_count(0)
    expect(person.page.locator("main")).to_be_focused()
    assert floor.settled(proposed["id"])["status"] in {"running", "completed"}
    closed = server.get(f"/v1/escalations/{proposed['escalation']['id']}")
    assert [one["by"] for one in closed["approvals"]] == ["operator"]
    expect(person.region("Events")).to_contain_text("operator approved, 1 of 1")


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_a_card_says_what_the_agent_is_after_as_its_own_words_and_as_text(
    server: ServerProcess, people: People, floor: Floor, size: dict[str, int]
) -> None:
    person = people.sit(server, size=size)
    forged = "<img src=x> \u202eA sserp ,evorppa\n" + "\u05d0\u05d1 " * 40 + "unbroken" * 400
    asked = floor.ask(intent="fetch mug_1 and deliver it to bench_b", task="set the table")
    stated = card(person).locator(".stated")
    expect(stated).to_have_text("planner says: “fetch mug_1 and deliver it to bench_b”, task “set the table”")
    unfold = card(person).get_by_role("button", name=re.compile("^(All that it says|Less)$"))
    expect(unfold).to_have_count(0)
    floor.answer(asked, "deny")
    expect(card(person)).to_have_count(0)
    floor.ask(goal=forged, task="set the table for the two of us, and for whoever comes " * 3)
    expect(stated).to_contain_text("planner says: “<img src=x> \ufffdA sserp ,evorppa \u05d0\u05d1")
    expect(stated).to_contain_text("…”")
    expect(stated.locator("bdi")).to_have_count(2)
    assert box(stated)["height"] < 100
    assert box(stated)["x"] + box(stated)["width"] <= box(card(person))["x"] + box(card(person))["width"]
    for answer in ANSWERS:  # so much said pushes the values off a phone's screen
        expect(person.button(re.compile(answer))).to_be_in_viewport(ratio=1)
    assert wider_than_the_screen(person.page) == []
    folded = box(stated)["height"]
    expect(unfold).to_have_attribute("aria-expanded", "false")
    unfold.click()
    expect(unfold).to_have_attribute("aria-expanded", "true")
    assert box(stated)["height"] > folded
    assert stated.evaluate("it => it.scrollHeight <= it.clientHeight"), "all that it says is seen"
    unfold.click()
    expect(unfold).to_have_attribute("aria-expanded", "false")
    assert box(stated)["height"] == folded


def press_until(person: Person, key: str, *, gone: Locator) -> None:
    """Press a key until it is taken: a question that has just come takes none yet."""
    for _ in range(100):
        person.press(key)
        if gone.count() == 0:
            return
        person.page.wait_for_timeout(100)
    pytest.fail(f"`{key}` was never taken")


def test_an_edit_is_checked_again_under_what_the_agent_said_and_all_three_versions_are_kept(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    asked = floor.ask(intent="polish it")
    assert asked["effective"]["speed_mps"] == 0.1
    card(person).get_by_role("textbox", name="Speed you approve, m/s").fill("0.2")
    expect(card(person)).to_contain_text("Policy changes your edit to 0.10 m/s; you will be asked once more.")
    floor.answer(asked, "deny")
    expect(card(person)).to_have_count(0)
    proposed = floor.ask()
    force = card(person).get_by_role("textbox", name="Grip force you approve, N")
    expect(force).to_have_value("60")
    expect(person.button(re.compile("^Approve"))).to_be_enabled()
    force.fill("200")
    expect(card(person)).to_contain_text("Grip force: ")
    expect(person.button(re.compile("^Approve"))).to_be_disabled()
    # In the moment of the edit nothing is known of it yet: a key says so, and is not kept for later.
    force.evaluate(
        """(one) => { one.value = '45'; one.dispatchEvent(new Event('input', { bubbles: true }));
            dispatchEvent(new PointerEvent('pointerdown')); // or it would be typed
            dispatchEvent(new KeyboardEvent('keydown', { key: 'a' })); }"""
    )
    told = card(person).get_by_role("status").filter(has_text="Nothing was approved")
    expect(told).to_have_text(re.compile("your edit was still being checked. Press again once it is allowed."))
    expect(card(person)).to_contain_text("Your edit was checked again: allowed.")
    assert server.get(f"/v1/invocations/{proposed['id']}")["status"] == "awaiting_approval"
    person.button("Approve edit").click()
    expect(card(person)).to_have_count(0)
    decided = floor.settled(proposed["id"])
    assert decided["requested"]["force_n"] == 80
    assert decided["effective"]["force_n"] == 45
    kept = server.get(f"/v1/escalations/{proposed['escalation']['id']}")
    assert [kept[one]["force_n"] for one in ("requested", "constrained", "approved")] == [80, 60, 45], kept


def test_of_two_who_answer_one_wins_or_the_first_may_still_deny_and_is_told_what_was_for_nothing(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    one, other = people.sit(server), people.sit(server, "operator_2")
    proposed = floor.ask("driver_1")
    mine, theirs = one.page.get_by_role("article"), other.page.get_by_role("article")
    expect(one.button(re.compile("^Approve"))).to_be_enabled()
    one.button(re.compile("^Approve")).click()
    expect(mine).to_contain_text("1 of 2 approved: operator")
    expect(mine).to_contain_text("You approved this. It takes another person; you may still deny it.")
    expect(one.button(re.compile("^Approve"))).to_be_disabled()
    expect(theirs).to_contain_text("1 of 2 approved: operator")
    expect(stages(one)).to_contain_text("needs 1 more")
    expect(stages(other)).to_contain_text("waits for you")
    expect(one.region("Waiting for you").locator(".count")).to_have_text("0")
    expect(one.button(re.compile("^Deny"))).to_be_focused()
    theirs.get_by_role("textbox", name="Grip force you approve, N").fill("33")
    other.button("Approve edit").click()
    expect(mine).to_contain_text("operator_2 changed what is asked: grip force 60 → 33 N.")
    expect(mine).to_contain_text("Your approval was of what was asked before and does not count any more.")
    expect(stages(one)).to_contain_text("waits for you")
    one.says_why()
    press_until(one, "d", gone=mine)
    expect(theirs).to_have_count(0)
    assert floor.settled(proposed["id"])["status"] == "denied"

    # what the first approved, the second denies while the first is at another question
    first = floor.ask("driver_1")["escalation"]
    expect(card(one, "Grasp driver_1")).to_be_visible()
    proposed = floor.ask()
    expect(one.button(re.compile("^Approve"))).to_be_enabled()
    one.button(re.compile("^Approve")).click()
    expect(card(one, "Grasp driver_1")).to_have_count(0)
    denied_by(server, first, "operator_2")
    told = one.page.get_by_role("status").filter(has_text="Grasp driver_1 is not open any more: operator_2 denied.")
    expect(told).to_contain_text("This is another question.")

    # and both answer the other one at once
    for person in (one, other):
        person.expects("409")
        expect(card(person)).to_be_visible()
        expect(person.button(re.compile("^Approve"))).to_be_enabled()
    with at_once("**/resolve", one, other):
        one.button(re.compile("^Approve")).click()
        other.says_why()
        other.button(re.compile("^Deny")).click()
    words = [person.page.get_by_text("Somebody has answered this already.") for person in (one, other)]
    until(lambda: any(said.is_visible() for said in words), what="words for the one who came second")
    second = next(said for said in words if said.is_visible())
    expect(second).to_have_text(re.compile(r"(operator_2 denied|operator approved it(: it was launched)?)\.$"))
    assert floor.settled(proposed["id"])["status"] in {"running", "denied", "completed"}


def test_whoever_approved_two_questions_is_told_of_each_that_it_was_for_nothing_until_that_is_put_away(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    questions = [floor.ask("driver_1")["escalation"] for _ in range(2)]
    for question in questions:
        expect(person.button(re.compile("^Approve"))).to_be_enabled()
        with person.page.expect_response("**/resolve"):
            person.press("a")
        until(lambda path=f"/v1/escalations/{question['id']}": server.get(path)["approvals"], what="its approval")
    other = floor.ask()
    person.region("Waiting for you").locator("button.row").filter(has_text="Grasp mug_1").click()
    expect(card(person, "Grasp mug_1")).to_be_visible()
    for question in questions:
        denied_by(server, question, "operator_2")
    told = person.page.get_by_role("status").filter(has_text="is not open any more: operator_2 denied.")
    expect(told).to_have_count(2)
    floor.answer(other, "deny")
    expect(person.page.get_by_role("article")).to_have_count(0)
    expect(told).to_have_count(2)
    put = told.first.get_by_role("button", name="Put this away")
    expect(put).to_be_enabled()
    put.click()
    expect(told).to_have_count(1)


def denied_by(server: ServerProcess, question: dict[str, Any], key: str) -> None:
    path = f"/v1/escalations/{question['id']}"
    answer = {"decision": "deny", "digest": server.get(path)["digest"]}
    assert server.post(f"{path}/resolve", answer, key=key).is_success


def test_an_edit_outlasts_a_look_at_another_page_and_is_told_to_be_gone_where_another_has_answered_here_or_meanwhile(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    gone = person.alert("it is not open any more, and your edit was not sent")
    for elsewhere in (False, True):
        asked = floor.ask()["escalation"]
        card(person).get_by_role("textbox", name="Grip force you approve, N").fill("22")
        expect(card(person)).to_contain_text("Your edit was checked again: allowed.")
        if elsewhere:
            person.page.get_by_role("link", name="Audit").click()
        denied_by(server, asked, "operator_2")
        if elsewhere:
            person.page.get_by_role("link", name="Live").click()
        expect(gone).to_contain_text("operator_2 denied")
        person.button("Understood").click()
        expect(gone).to_have_count(0)
    kept = floor.ask()
    force = person.page.get_by_role("textbox", name="Grip force you approve, N")
    force.fill("22")
    expect(card(person)).to_contain_text("Your edit was checked again: allowed.")
    person.page.get_by_role("link", name="Audit").click()
    expect(force).to_have_count(0)
    person.page.get_by_role("link", name="Live").click()
    expect(force).to_have_value("22")  # an edit in the making outlasts a look at another page
    expect(card(person)).to_contain_text("Your edit was checked again: allowed.")
    person.button("Approve edit").click()
    assert floor.settled(kept["id"])["effective"]["force_n"] == 22


def test_whoever_loads_the_page_anew_over_an_edit_is_told_that_it_was_not_sent(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    floor.ask()
    force = card(person).get_by_role("textbox", name="Grip force you approve, N")
    said = person.alert("Your edit of Grasp mug_1 was not sent, and is gone.")
    for typed, told in (("22", 1), ("60", 0)):  # what is asked anyway is no edit
        force.fill(typed)
        person.page.reload()
        expect(force).to_have_value("60")
        expect(said).to_have_count(told)
        if told:
            said.get_by_role("button", name="Understood").click()
            expect(said).to_have_count(0)


def test_a_question_that_another_answers_or_another_profile_withdraws_says_so_and_what_became_of_it(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    first = floor.ask()["escalation"]
    expect(card(person)).to_be_visible()
    expect(card(person)).to_contain_text("0.30 default")  # which nobody asked for
    second = floor.ask()["escalation"]
    row = person.region("Waiting for you").locator("button.row")
    expect(row).to_contain_text("60 N, 0.25 m/s")  # by which one tells it from the other
    denied_by(server, first, "operator_2")
    told = person.page.get_by_role("status").filter(has_text="is not open any more")
    expect(told).to_contain_text("is not open any more: operator_2 denied.")
    expect(told).to_contain_text("This is another question.")  # for it looks the same
    expect(card(person)).to_have_count(1)
    person.button("Put this away").click()
    expect(told).to_have_count(0)
    assert server.get(f"/v1/escalations/{second['id']}")["status"] == "pending"
    with server.client("operator_2") as other:
        assert other.put("/v1/cells/workcell-1/profile", json={"profile": "sim-relaxed"}).is_success
        try:
            expect(told).to_contain_text(
                "It was withdrawn: operator_2 put the cell under another profile. "
                "It did not begin, and may be proposed again."
            )
        finally:
            other.put("/v1/cells/workcell-1/profile", json={"profile": "human-shared"})


def test_what_would_be_approved_in_vain_is_kept_back_and_what_was_or_a_rollback_withdraws_says_why(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    asked = floor.ask()
    expect(person.button(re.compile("^Approve"))).to_be_enabled()
    floor.drive_off()
    expect(card(person)).to_contain_text("workcell-1 is busy with another session and would defer it")
    expect(person.button(re.compile("^Approve"))).to_be_disabled()
    expect(person.button(re.compile("^Deny"))).to_be_enabled()
    person.press("a")
    assert server.get(f"/v1/escalations/{asked['escalation']['id']}")["status"] == "pending"
    floor.answer(asked, "approve")  # from where the console's word does not reach
    told = person.page.get_by_role("status").filter(has_text="is not open any more")
    expect(told).to_contain_text(re.compile("You approved it, but it was deferred: .*"))
    assert server.get(f"/v1/invocations/{asked['id']}")["status"] == "deferred"
    floor.made.remove(asked["id"])
    person.button("Put this away").click()
    floor.clear()
    session = floor.drive_off()["id"]
    assert server.post(f"/v1/invocations/{session}/takeover", {}, key="operator_2").is_success
    server.await_status(session, "escalated")  # nobody holds on to the controls
    expect(person.region("Waiting for you").get_by_role("article")).to_be_visible()
    assert server.post(f"/v1/invocations/{session}/rollback", {}, key="operator_2").is_success
    expect(told).to_contain_text("It was withdrawn: operator_2 ordered a rollback.")


def covered(server: ServerProcess, person: Person, proposed: dict[str, Any]) -> None:
    """Press the keys of answers where something lies over the question, and then where nothing does any more."""
    for key in "adp":
        person.press(key)
    assert server.get(f"/v1/invocations/{proposed['id']}")["status"] == "awaiting_approval"
    person.press("Escape")
    person.says_why()
    press_until(person, "d", gone=card(person))
    assert server.await_status(proposed["id"], "denied")


def test_an_edit_that_policy_refused_of_a_stopped_cell_is_checked_again_once_that_is_reset(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    asked = floor.ask()
    person = people.sit(server)
    approve = person.button("Approve edit")
    person.page.get_by_role("textbox", name="Speed you approve, m/s").fill("0.12")
    expect(approve).to_be_enabled()
    assert server.post("/v1/cells/workcell-1/estop").is_success
    refused = person.page.get_by_text("Policy refuses your edit: “workcell-1” is stopped and latched.")
    expect(refused).to_be_visible()
    until(floor.unlatched, what="a cell that no stop latches")
    expect(refused).to_have_count(0)
    approve.click()
    assert floor.settled(asked["id"])["status"] == "running"


def test_no_key_answers_behind_the_list_of_keys_or_from_the_panel_and_a_stopped_cell_keeps_only_an_approval_back(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    proposed = floor.ask()
    approve, deny = (person.button(re.compile(f"^{word}")) for word in ("Approve", "Deny"))
    expect(deny).to_be_focused()
    person.press("t")  # a panel takes the focus from the answers
    expect(person.region("Drive by hand")).to_be_focused()
    person.press("Enter")
    assert server.get(f"/v1/escalations/{proposed['escalation']['id']}")["status"] == "pending"
    person.press("t")
    person.press("?")
    expect(person.page.get_by_role("dialog", name="Keys")).to_be_visible()
    covered(server, person, proposed)
    proposed = floor.ask()
    expect(approve).to_be_enabled()
    person.press(".")
    expect(card(person)).to_contain_text("is stopped and would refuse it")
    expect(approve).to_be_disabled()
    person.press("t")
    expect(person.button("Take the controls")).to_be_disabled()
    person.says_why()
    deny.click()
    assert floor.settled(proposed["id"])["status"] == "denied"


def test_who_types_into_a_question_that_has_just_come_up_goes_on_typing_there(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    floor.ask()
    speed = person.page.get_by_role("textbox", name="Speed you approve, m/s")
    deny = person.button(re.compile("^Deny"))
    # At once, while no answer is taken yet, as by a click.
    person.page.evaluate(
        """() => { const seen = new MutationObserver(() => {
            const field = document.querySelector('article[aria-label="Grasp glass_1"] input[aria-label^=Speed]');
            field?.select();
            if (field != null) seen.disconnect();
        }); seen.observe(document.body, { childList: true, subtree: true }); }"""
    )
    floor.ask("glass_1")
    person.button(re.compile("^Grasp glass_1")).click()
    expect(deny).to_be_enabled()
    expect(speed).to_be_focused()
    person.page.keyboard.type("0.1")
    expect(speed).to_have_value("0.1")
    assert not server.cell()["latched"]


def test_no_key_answers_what_lies_behind_the_menu_of_a_phone(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    proposed = floor.ask()
    expect(person.button(re.compile("^Deny"))).to_be_focused()
    person.button("Menu").click()
    covered(server, person, proposed)


def stages(person: Person) -> Locator:
    return person.page.get_by_role("list", name="The seven stages of the session")


def test_what_somebody_edits_is_read_again_before_a_key_approves_it_and_an_edit_that_it_overtakes_is_said_to_be_gone(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    asked = floor.ask("driver_1")
    force, told = (
        person.page.get_by_role("textbox", name="Grip force you approve, N"),
        card(person, "Grasp driver_1").get_by_role("alert"),
    )
    expect(force).to_be_enabled()
    force.fill("3")
    expect(force).to_be_focused()
    edited_by(server, asked, "operator_2")
    expect(force).to_have_value("33")
    person.page.keyboard.type("5")  # no key falls into the other value
    expect(person.page.locator("input:focus")).to_have_count(0)  # a slow line gives the safe choice the focus
    expect(force).to_have_value("33")
    expect(told.last).to_have_text("Your edit was of what was asked before: it was not sent, and is gone.")
    expect(told.first).to_contain_text("Read it again.")
    floor.answer(asked, "deny")
    expect(card(person, "Grasp driver_1")).to_have_count(0)

    asked = floor.ask("driver_1")
    yes = person.button(re.compile("^Approve"))
    expect(yes).to_be_enabled()
    # A key that is on its way when the edit comes: pressed in the very moment the page shows the other value.
    person.page.evaluate(
        """() => { const seen = new MutationObserver(() => {
            if (!document.querySelector('article')?.textContent.includes('1 of 2 approved')) return;
            seen.disconnect();
            dispatchEvent(new KeyboardEvent('keydown', { key: 'a' }));
            window.pressed = true;
        }); seen.observe(document.body, { childList: true, subtree: true, characterData: true }); }"""
    )
    edited_by(server, asked, "operator_2")
    expect(told).to_have_text("operator_2 changed what is asked: grip force 60 → 33 N. Read it again.")
    expect(card(person, "Grasp driver_1").get_by_role("row", name=re.compile("Grip force"))).to_contain_text("changed")
    assert person.page.evaluate("window.pressed")
    expect(yes).to_be_enabled()  # once there was time to read
    approvals = server.get(f"/v1/escalations/{asked['escalation']['id']}")["approvals"]
    assert [one["by"] for one in approvals] == ["operator_2"]
    expect(force).to_have_value("33")
    press_until(person, "a", gone=card(person, "Grasp driver_1"))
    assert floor.settled(asked["id"])["effective"]["force_n"] == 33


def edited_by(server: ServerProcess, asked: dict[str, Any], key: str) -> None:
    path = f"/v1/escalations/{asked['escalation']['id']}"
    edit = {"decision": "approve", "digest": server.get(path)["digest"], "params": {"force_n": 33}}
    assert server.post(f"{path}/resolve", edit, key=key).json()["status"] == "pending"


def test_a_grant_says_whole_what_it_covers_and_is_for_a_task_only_where_the_proposal_names_one(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    offers = person.page.get_by_label("If approved").locator("option")
    asked = floor.ask()
    bound = "by planner in workcell-1, 15 min"
    mug, every = f"allow “grasp object” of mug_1 {bound}", f"allow every “grasp object” {bound}"
    expect(offers).to_have_text([re.compile("again"), mug, every])
    choice = person.page.get_by_label("If approved")
    expect(person.button(re.compile("^Approve"))).to_be_enabled()
    choice.focus()
    person.press("a")
    expect(choice).to_have_value("")  # no letter picks a grant, and none approves from there
    choice.select_option("object")
    expect(person.button("Approve and allow for 15 min")).to_be_enabled()
    for scope, covered in (("object", mug), ("time", every)):
        choice.select_option(scope)
        said = covered.removeprefix("allow ").removesuffix(", 15 min")
        expect(choice).to_have_accessible_description(re.compile(f"^For 15 min nobody is asked about {said}, within"))
    assert wider_than_the_screen(person.page) == []
    choice.select_option("")
    expect(choice).to_have_accessible_description("")
    expect(person.button("and allow")).to_have_count(0)
    person.says_why()
    press_until(person, "d", gone=card(person))
    assert floor.settled(asked["id"])["status"] == "denied"
    expect(offers).to_have_count(0)
    asked = floor.ask(task="tidy up")
    task = re.compile(f"^allow “grasp object” for its task “.tidy up.” {bound}$")  # set apart by what is not seen
    expect(offers).to_have_text([re.compile("again"), mug, task, every])
    choice.select_option("time")
    person.button("Approve and allow for 15 min").click()
    grants = person.page.get_by_role("list", name="Standing grants")
    given = "every “grasp object” by planner in workcell-1, 1[45] min left given by operator, used 0×"
    expect(grants).to_contain_text(re.compile(given))
    assert wider_than_the_screen(person.page) == []
    grants.get_by_role("button", name="Revoke the grant for every “grasp object” by planner in workcell-1").click()
    expect(grants).to_have_count(0)


def test_standing_grants_are_revoked_by_keyboard_or_run_out_and_only_who_gave_one_is_told_once_that_it_ended(
    server: ServerProcess, people: People
) -> None:
    give(server, "glass_1", 1)
    give(server, "mug_1", 1)
    giver, other = people.sit(server), people.sit(server, "operator_2")
    grants = giver.page.get_by_role("list", name="Standing grants")
    expect(grants).to_contain_text("glass_1")
    calm = box(giver.page.get_by_text("Nothing waits for a person."))
    assert box(grants)["y"] >= calm["y"] + calm["height"]
    first = grants.get_by_role("button", name="Revoke the grant for “grasp object” of glass_1")
    first.focus()
    giver.enter(first)
    left = grants.get_by_role("button")
    expect(left).to_have_count(1)
    expect(left).to_have_accessible_name("Revoke the grant for “grasp object” of mug_1 by planner in workcell-1")
    giver.enter(left)
    expect(grants).to_have_count(0)
    expect(giver.page.get_by_text("No standing grants.")).to_be_focused()
    expect(giver.region("Events")).to_contain_text("operator revoked a standing grant: grasp object glass_1")
    told = giver.page.get_by_text("A standing grant of yours ended: “grasp object” of glass_1 by planner in workcell-1")
    expect(told).to_have_count(0)  # one's own doing

    give(server, "glass_1", 1)
    giver.press("2")
    other.page.get_by_role("button", name="Revoke the grant for “grasp object” of glass_1").click()
    expect(other.region("Events")).to_contain_text("operator_2 revoked a standing grant: grasp object glass_1")
    giver.press("1")
    expect(told).to_contain_text("revoked by operator_2")
    giver.button("Put away which grants ended").click()
    expect(told).to_have_count(0)

    give(server, "glass_1", 0.05)
    expect(grants).to_contain_text(re.compile("glass_1 by planner in workcell-1, [1-3] s left"))
    grants.get_by_role("button").focus()
    expect(grants).to_have_count(0)
    expect(giver.page.get_by_text("No standing grants.")).to_be_focused()
    expect(giver.region("Events")).to_contain_text("Standing grant ran out: grasp object glass_1")
    expect(told).to_contain_text("ran out")
    expect(other.page.get_by_text("of yours ended")).to_have_count(0)


def give(server: ServerProcess, thing: str, minutes: float) -> None:
    body = {"capability": "grasp_object", "agent": "planner", "cell": "workcell-1", "scope": "object"}
    made = server.post("/v1/grants", {**body, "object": thing, "minutes": minutes})
    assert made.is_success, made.text


def test_a_denial_counts_after_an_approval_that_the_console_gave_up(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=IMPATIENT)
    person.expects("")
    asked = floor.ask()
    expect(person.button(re.compile("^Approve"))).to_be_enabled()
    os.kill(server.process.pid, signal.SIGSTOP)
    try:
        person.button(re.compile("^Approve")).click()
        expect(person.page.get_by_text("not known whether").first).to_be_visible()
        person.says_why()
        person.button(re.compile("^Deny")).click()
    finally:
        os.kill(server.process.pid, signal.SIGCONT)
    assert floor.settled(asked["id"])["outcome"] == "denied"
