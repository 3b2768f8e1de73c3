"""The cell in 3D: really drawn, and drawn again when the graphics card drops the picture."""

from __future__ import annotations

import base64

import pytest

from tests.conftest import ServerProcess, until
from tests.console.conftest import PHONE, Floor, People, Person

pytestmark = [pytest.mark.browser, pytest.mark.process]
# The share of the picture that is not its commonest colour, the empty background; names and buttons make little of it.
DRAWN = """async (encoded) => {
    const bytes = Uint8Array.from(atob(encoded), (letter) => letter.charCodeAt(0));
    const picture = await createImageBitmap(new Blob([bytes], { type: 'image/png' }));
    const pen = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
    pen.drawImage(picture, 0, 0);
    const pixels = new Uint32Array(pen.getImageData(0, 0, picture.width, picture.height).data.buffer);
    const counts = new Map();
    for (const pixel of pixels) counts.set(pixel, (counts.get(pixel) ?? 0) + 1);
    return 1 - Math.max(...counts.values()) / pixels.length;
}"""
LOSE = "(canvas) => canvas.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
MUCH = 0.2


def drawn(person: Person) -> float:
    picture = person.region("The cell in 3D").screenshot()
    return person.page.evaluate(DRAWN, base64.b64encode(picture).decode())


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_the_cell_is_drawn_and_drawn_again_after_the_graphics_were_lost(
    server: ServerProcess, people: People, floor: Floor, theme: str
) -> None:
    person = people.sit(server, theme=theme)
    person.expects("CONTEXT_LOST_WEBGL")
    until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
    scene = person.region("The cell in 3D")
    scene.locator("canvas").evaluate(LOSE)
    scene.get_by_text("The graphics card dropped the picture").wait_for()
    scene.locator("canvas").wait_for(state="visible")
    until(lambda: drawn(person) > MUCH, what="a cell that is drawn again")
    assert scene.locator("canvas").count() == 1


def test_on_a_phone_the_cell_is_drawn_too(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, size=PHONE)
    until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
