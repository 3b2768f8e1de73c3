"""Findings as SARIF 2.1.0, the form in which editors and code hosting show what a check has to say."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import orjson

from app.proofs.findings import Kind, Weight

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from app.governance.errors import PolicyError
    from app.proofs.findings import Finding

SCHEMA: Final = "https://json.schemastore.org/sarif-2.1.0.json"
LOAD: Final = "load"
_SAYS: Final[Mapping[str, str]] = {
    LOAD: "The policy cannot be loaded as it is.",
    Kind.CONTRADICTION: "Two rules force a proposal apart: no value satisfies both.",
    Kind.COVERAGE: "A proposal that nothing decides about, or a capability that nothing gets through.",
    Kind.DEAD: "A rule that never holds.",
    Kind.SHADOWED: "A rule that holds, and never determines an outcome.",
    Kind.ERROR: "A condition that some well-typed proposal makes fail.",
    Kind.IDEMPOTENCE: "What policy makes of a proposal does not re-check to allow.",
    Kind.ORDER: "A profile that is declared the stricter lets more through.",
    Kind.PROPERTY: "A stated property does not hold.",
}
_LEVELS: Final[Mapping[Weight, str]] = {
    Weight.REFUTED: "error",
    Weight.UNDECIDED: "warning",
    Weight.BUG: "error",
    Weight.NOTE: "note",
}


def sarif(findings: Iterable[Finding], problems: Iterable[PolicyError] = ()) -> str:
    """Return findings, and what kept the policy from being loaded, as the text of one SARIF log."""
    results = [_result(LOAD, "error", str(problem), problem.file, problem.line, {}) for problem in problems]
    for found in findings:
        about = {
            "weight": found.weight.value,
            "capability": found.capability,
            "profile": found.profile,
            "rule": found.rule,
            "case": found.example,
            "check": dict(found.body),
        }
        shown = {key: value for key, value in about.items() if value}
        results.append(_result(found.kind.value, _LEVELS[found.weight], found.message, found.file, found.line, shown))
    rules = [{"id": name, "shortDescription": {"text": text}} for name, text in _SAYS.items()]
    tool = {"driver": {"name": "reins policy check", "rules": rules}}
    log = {"$schema": SCHEMA, "version": "2.1.0", "runs": [{"tool": tool, "results": results}]}
    return orjson.dumps(log, option=orjson.OPT_INDENT_2).decode()


def _result(rule: str, level: str, message: str, file: str, line: int, properties: Mapping[str, Any]) -> dict[str, Any]:
    place = {"artifactLocation": {"uri": file}, "region": {"startLine": max(line, 1)}}
    return {
        "ruleId": rule,
        "level": level,
        "message": {"text": message},
        "locations": [{"physicalLocation": place}],
        "properties": dict(properties),
    }
