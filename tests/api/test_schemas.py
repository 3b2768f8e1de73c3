"""The JSON Schemas of policy files over HTTP."""

from __future__ import annotations

import jsonschema_rs
import pytest

from app.governance.bundle_schema import KINDS, schema
from tests.api.conftest import House

pytestmark = pytest.mark.anyio


async def test_every_kind_of_policy_file_is_listed_with_where_its_schema_is(house: House) -> None:
    async with house.client("agent") as client:
        listed = (await client.get("/v1/schemas")).json()
        assert [item["name"] for item in listed["items"]] == list(KINDS)
        for item in listed["items"]:
            found = await client.get(item["href"])
            assert found.headers["content-type"] == "application/schema+json"
            assert found.json() == schema(item["name"])
            jsonschema_rs.meta.validate(found.json())


async def test_a_kind_there_is_not_is_answered_with_those_there_are(house: House) -> None:
    async with house.client("auditor") as client:
        refused = await client.get("/v1/schemas/secrets")
    assert (refused.status_code, refused.json()["code"]) == (404, "schema_unknown")
    assert "profile" in refused.json()["detail"]
