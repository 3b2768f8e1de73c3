"""What an operator decides at a console: who gets in, and what becomes of a question."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.conftest import ServerProcess
from tests.console.conftest import People, Person

pytestmark = [pytest.mark.browser, pytest.mark.process]
EITHER_ANSWER = re.compile(r"^(Approve|Deny)")


@pytest.fixture(scope="module")
def server(serve: Callable[..., ServerProcess]) -> ServerProcess:
    """People share the floor: whatever is of medium risk needs a person."""
    return serve("--profile", "human-shared", "--pace", "2")


@pytest.fixture
def asked(server: ServerProcess) -> Any:
    """Propose a grasp, which asks; what still waits or runs afterwards is cancelled."""
    made: list[str] = []

    def ask(**params: Any) -> dict[str, Any]:
        proposed = server.propose("grasp_object", **{"object_id": "mug_1", "force_n": 80, **params})
        assert proposed["status"] == "awaiting_approval", proposed
        made.append(proposed["id"])
        return proposed

    yield ask
    for invocation in made:
        server.post(f"/v1/invocations/{invocation}/cancel")
        server.await_status(invocation, "denied", "completed", "failed")


def settled(server: ServerProcess, invocation: str) -> dict[str, Any]:
    return server.await_status(invocation, "denied", "running", "completed", "failed")


def card(person: Person, title: str = "Grasp mug_1") -> Any:
    return person.page.get_by_role("article", name=title)


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


def test_a_wrong_token_is_refused_in_words(server: ServerProcess, people: People) -> None:
    person = people.open(f"{server.url}/#token=nonsense")
    person.expects("401")
    expect(person.alert("The token is not valid")).to_be_visible()
    person.page.get_by_label("Token").fill(server.tokens["operator"])
    person.press("Enter")
    expect(person.region("Waiting for you")).to_be_visible()


def test_a_question_appears_and_is_approved_by_one_key(server: ServerProcess, people: People, asked: Any) -> None:
    person = people.sit(server)
    proposed = asked()
    expect(card(person)).to_contain_text("Medium risk")
    expect(card(person)).to_contain_text("human-shared / authority")
    expect(person.alert("Waiting for you: Grasp mug_1, medium risk.")).to_be_attached()
    expect(person.button(re.compile("^Deny"))).to_be_focused()
    expect(person.page.get_by_role("row", name=re.compile("^Grip force|^Force"))).to_contain_text("80")
    approve_by_key(person)
    expect(card(person)).to_have_count(0)
    assert settled(server, proposed["id"])["status"] in {"running", "completed"}
    closed = server.get(f"/v1/escalations/{proposed['escalation']['id']}")
    assert [one["by"] for one in closed["approvals"]] == ["operator"]
    expect(person.region("Events")).to_contain_text("operator approved, 1 of 1")


def approve_by_key(person: Person) -> None:
    """Press until it is taken: a question that has just come takes no key yet."""
    for _ in range(50):
        person.press("a")
        if card(person).count() == 0:
            return
        person.page.wait_for_timeout(100)
    pytest.fail("the key approved nothing")
