"""The OpenAPI document as one piece: what refers to something finds it, and every schema is one."""

from __future__ import annotations

import re

import jsonschema_rs
import orjson
import pytest

from app.api.problems import CODES, MEDIA_TYPE
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


async def test_the_headers_that_a_program_reads_are_described(house: House) -> None:
    async with house.client(None) as client:
        document = (await client.get("/openapi.json")).json()
        stranger = await client.get("/v1/cells")
    async with house.client("agent") as agent:
        body = {"capability": "fly", "params": {}}
        made = [await agent.post("/v1/invocations", json=body, headers={"Idempotency-Key": "k"}) for _ in range(2)][1]
        packed = await agent.post("/v1/check", json=body, headers={"Content-Encoding": "gzip"})
    answers = ((stranger, "/v1/cells", "get"), (made, "/v1/invocations", "post"), (packed, "/v1/check", "post"))
    for answer, path, method in answers:
        said = document["paths"][path][method]["responses"][str(answer.status_code)]["headers"]
        assert {name.lower() for name in said} == {
            name
            for name in answer.headers
            if name in ("location", "idempotency-replayed", "www-authenticate", "accept-encoding")
        }
    parameters = document["paths"]["/v1/events"]["get"]["parameters"]
    assert ("Last-Event-ID", "header") in {(parameter["name"], parameter["in"]) for parameter in parameters}


async def test_every_code_that_an_answer_may_bear_stands_in_the_document(house: House) -> None:
    async with house.client(None) as client:
        document = (await client.get("/openapi.json")).json()
    operations = [operation for path in document["paths"].values() for operation in path.values()]
    everywhere = {code for code in CODES if f"`{code}`" in document["info"]["description"]}
    codes = [
        {
            code
            for answer in operation["responses"].values()
            for code in answer.get("content", {}).get(MEDIA_TYPE, {}).get("examples", ())
        }
        for operation in operations
    ]
    assert set.union(everywhere, *codes) == set(CODES)
    for operation, described in zip(operations, codes, strict=True):
        assert described >= {"http_malformed", "head_too_large"}, "of what no route has looked at yet"
        assert ("body_late" in described) == ("requestBody" in operation)
