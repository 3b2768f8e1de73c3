"""One examination of a policy, in a process of its own: `python -m app.assay`, a request in, what was found out.

A server starts it (`app.assayer`), so that loading, proving and comparing never hold up a request. It is given low
priority there. The request is JSON on standard input; the answer is a line of JSON, with the sizes of the parcels
behind it, which hold the compiled policy.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final, cast

import orjson

from app.clock import cpu_s
from app.governance import bundle, cases
from app.governance.errors import PolicyError, PolicyErrors, Undecided
from app.governance.parcel import parcels
from app.proofs.difference import difference
from app.proofs.findings import Weight
from app.proofs.promised import with_promises
from app.proofs.prove import prove

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.policy import PolicySet
    from app.proofs.findings import Finding

PROOFS_S: Final = 240.0  # of processor time: at the lowest priority the clock on the wall says little
COMPARISON_S: Final = 120.0


def main() -> None:
    """Answer the one request."""
    request = cast("dict[str, Any]", orjson.loads(sys.stdin.buffer.read()))
    answer, compiled = examined(request)
    sizes = [len(parcel) for parcel in compiled]
    sys.stdout.buffer.write(orjson.dumps({**answer, "parcels": sizes}) + b"\n")
    for parcel in compiled:
        sys.stdout.buffer.write(parcel)
    sys.stdout.buffer.flush()


def examined(request: Mapping[str, Any]) -> tuple[dict[str, Any], list[bytes]]:
    """Return the answer, and the compiled policy in parcels; none where something is wrong with it.

    Args:
        request: `{candidate, against}`, each with the fields of `runtime.examining.Candidate`; `against` may be null.
    """
    candidate, against = request["candidate"], request["against"]
    try:
        policy = bundle.load_files(candidate["files"])
        passed = _cases(policy, candidate["cases"]) if candidate["prove"] else 0
        proved = _proved(policy, candidate["promises"]) if candidate["prove"] else ""
    except PolicyErrors as found:
        said = [_document(problem) for problem in found.problems]
        return {"problems": said, "undecided": isinstance(found, Undecided)}, []
    found = None
    if against is not None:
        other = bundle.load_files(against["files"])  # what is in force loads, or nothing decides
        compared = difference(other, policy, now=cpu_s, all_s=COMPARISON_S)
        found = with_promises(compared, against["promises"], candidate["promises"]).document()
    return {"problems": [], "cases": passed, "proved": proved, "comparison": found}, list(parcels(policy))


def _cases(policy: PolicySet, files: Mapping[str, str]) -> int:
    results = cases.run(policy, files)
    failed = [
        PolicyError(file=one.file, line=one.line, key=one.name, message="; ".join(one.differences))
        for one in results
        if not one.passed
    ]
    if failed:
        raise PolicyErrors(failed)
    return len(results)


def _proved(policy: PolicySet, promises: str | None) -> str:
    report = prove(policy, promises, now=cpu_s, all_s=PROOFS_S)
    if report.faults:
        refuted = any(finding.weight is Weight.REFUTED for finding in report.faults)
        raise (PolicyErrors if refuted else Undecided)([_problem(finding) for finding in report.faults])
    return report.summary()


def _problem(finding: Finding) -> PolicyError:
    shown = f"\n{finding.example.rstrip()}" if finding.example else ""
    message = f"{finding.weight.value}: {finding.message}{shown}"
    return PolicyError(file=finding.file, line=finding.line, key=finding.kind.value, message=message)


def _document(problem: PolicyError) -> dict[str, Any]:
    return {
        "file": problem.file,
        "line": problem.line,
        "key": problem.key,
        "message": problem.message,
        "valid": list(problem.valid),
    }


if __name__ == "__main__":
    main()
