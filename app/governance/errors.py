"""What governance raises. Refusals are values (`Reject`, `Deny`, …); these are bugs, misuse or a broken policy.

```
GovernanceError
├── PolicyError        a policy file does not say something that can be enforced (file, line, key)
│   └── PolicyErrors   all that is wrong with a policy directory, together
├── ExpressionError    a condition does not parse or does not type-check (source, column)
├── DeclarationError   a variable or record is declared in a way no expression could use (name)
└── EvaluationError    a condition that type-checks met values it has no answer for (code, detail)
```

The exceptions take facts and write the message themselves; whoever catches one reads the facts, never the message.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Iterable

EvaluationCode = Literal[
    "absent",
    "division_by_zero",
    "index_out_of_range",
    "not_finite",
    "out_of_range",
    "overflow",
    "unknown_name",
    "unknown_variable",
    "wrong_type",
]

_SHOWN_ALTERNATIVES: Final = 12


def _or_else(message: str, valid: tuple[str, ...]) -> str:
    if not valid:
        return message
    shown = ", ".join(f"`{name}`" for name in valid[:_SHOWN_ALTERNATIVES])
    more = ", …" if len(valid) > _SHOWN_ALTERNATIVES else ""
    return f"{message}; valid: {shown}{more}"


class GovernanceError(Exception):
    """Anything governance raises."""


class PolicyError(GovernanceError):
    """A policy file says something that cannot be enforced; nothing of the bundle is used.

    Attributes:
        file: Path of the file, relative to the policy directory.
        line: Line in it, from 1; 0 where the file as a whole is meant.
        key: Dotted path of the key at fault; empty where there is none.
        message: What is wrong, lower case, value in backticks.
        valid: What would be valid.
    """

    def __init__(self, *, file: str, line: int, key: str, message: str, valid: Iterable[str] = ()) -> None:
        """Keep the facts and write the message."""
        self.file, self.line, self.key, self.message, self.valid = file, line, key, message, tuple(valid)
        place = f"{file}:{line}" if line else file
        super().__init__(f"{place}: {f'{key}: ' if key else ''}{_or_else(message, self.valid)}")


class ExpressionError(GovernanceError):
    """A condition does not parse or does not type-check.

    Attributes:
        source: The whole source text.
        column: Where in it the fault begins, from 1 (a line break counts as one character).
        message: What is wrong, lower case, value in backticks.
        valid: What would be valid there, nearest first.
    """

    def __init__(self, *, source: str, column: int, message: str, valid: Iterable[str] = ()) -> None:
        """Keep the facts and write the message."""
        self.source, self.column, self.message, self.valid = source, column, message, tuple(valid)
        super().__init__(f"column {column}: {_or_else(message, self.valid)}")


class DeclarationError(GovernanceError):
    """A variable, record or accessor is declared in a way no expression could use.

    Attributes:
        name: The name at fault.
        message: What is wrong with it.
    """

    def __init__(self, *, name: str, message: str) -> None:
        """Keep the facts and write the message."""
        self.name, self.message = name, message
        super().__init__(f"`{name}` {message}")


class EvaluationError(GovernanceError):
    """A condition met values it has no answer for; the guard denies with reason code `rule_error`.

    Attributes:
        code: Which kind of failure, stable.
        detail: What it was about.
    """

    def __init__(self, code: EvaluationCode, detail: str) -> None:
        """Keep the facts and write the message."""
        self.code: EvaluationCode = code
        self.detail = detail
        super().__init__(f"{code}: {detail}")


class PolicyErrors(PolicyError):
    """Everything that is wrong with a policy directory; its own facts are those of the first problem.

    Attributes:
        problems: One `PolicyError` per fault, in order of file and line, never empty.
    """

    def __init__(self, problems: Iterable[PolicyError]) -> None:
        """Keep the problems, sorted; the message lists them, one per line."""
        self.problems = tuple(sorted(problems, key=lambda problem: (problem.file, problem.line, problem.key)))
        first = self.problems[0]
        super().__init__(file=first.file, line=first.line, key=first.key, message=first.message, valid=first.valid)
        self.args = ("\n".join(map(str, self.problems)),)


class Undecided(PolicyErrors):
    """Nothing is known to be wrong with a policy, and something that should be proved is not decided."""
