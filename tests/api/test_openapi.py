"""The OpenAPI document as one piece: what refers to something finds it, and every schema is one."""

from __future__ import annotations

import re

import jsonschema_rs
import orjson
import pytest

from tests.api.conftest import House

pytestmark = pytest.mark.anyio
REFERENCE = re.compile(rb'"\$ref":"#/components/schemas/([^"]+)"')


async def test_no_reference_leads_nowhere(house: House) -> None:
    async with house.client(None) as client:
        document = (await client.get("/openapi.json")).json()
    schemas = document["components"]["schemas"]
    named = {name.decode() for name in REFERENCE.findall(orjson.dumps(document))}
    assert named == set(schemas), "each is there, and each is used"
    for schema in schemas.values():
        jsonschema_rs.meta.validate(schema)
