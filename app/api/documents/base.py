"""What every document has in common, and the words that several of them use."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

EXAMPLE_REASON = {
    "rule": "human-shared/tcp_speed_mps",
    "code": "limit",
    "message": "at most 0.25 m/s here",
    "remedy": "propose speed_mps ≤ 0.25",
}


class Document(BaseModel):
    """A document of the server; a field that is not described here does not occur."""

    model_config = ConfigDict(extra="forbid")


class Anything(BaseModel):
    """A document described elsewhere."""

    model_config = ConfigDict(extra="allow")


class ReasonDocument(Document):
    """Why a decision fell as it did: the rule, a stable code, words for people, and what would be accepted."""

    rule: str
    code: str
    message: str
    remedy: str
