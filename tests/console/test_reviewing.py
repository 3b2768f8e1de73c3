"""Review afterwards: what policy marks waits for a verdict, in the queue and beside the trace."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Locator, expect

from tests.conftest import ServerProcess, until
from tests.console.conftest import PHONE, THREE_FRAMES, Floor, People, Person

pytestmark = [pytest.mark.browser, pytest.mark.process]
CELL = "/v1/cells/workcell-1"


@pytest.fixture
def stopped(server: ServerProcess, floor: Floor) -> Iterator[dict[str, Any]]:
    """A session that ended as `stopped` where policy wants a person to look at such."""
    with server.client() as client:
        assert client.put(f"{CELL}/profile", json={"profile": "sim-relaxed"}).is_success
    x, y = floor.base()
    session = floor.drive(x_m=x, y_m=y - 0.4 if y > 4 else y + 0.4, yaw_rad=1.5708)
    until(lambda: floor.speed() > 0.05, what="a base that moves")
    assert server.post(f"{CELL}/estop").is_success
    yield server.await_status(session["id"], "failed")
    with server.client() as client:
        client.put(f"{CELL}/profile", json={"profile": "human-shared"})


def queue(person: Person) -> Locator:
    return person.region("To review")


def kept(server: ServerProcess, session: dict[str, Any]) -> dict[str, Any]:
    items = server.get("/v1/reviews")["items"]
    return next(one for one in items if one["invocation"] == session["id"])


def test_an_auditor_gives_a_verdict_and_a_note_by_keyboard(
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
    form.get_by_role("button", name="Record the verdict").tap()
    expect(queue(other).get_by_role("status")).to_have_text("operator reviewed it: inconclusive.")
    expect(queue(other).get_by_role("form")).to_have_count(0)
    other.page.evaluate(THREE_FRAMES)
    expect(elsewhere).to_be_focused()  # whatever others do
    expect(one.region("Review")).to_contain_text("Reviewed by operator: inconclusive")
    assert kept(server, stopped)["status"] == "inconclusive"
