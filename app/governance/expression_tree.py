"""The words of a condition: types, the typed tree that `check` yields, functions and operators.

```
source ──expression_syntax.parse──▶ Syntax ──expression.check──▶ Typed ──expression_code.to_python──▶ Python text
                                    (one shape, untyped)         (nine shapes, every node typed; anything else that
                                                                  reads conditions, a prover for instance, starts here)
```
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from app.governance.errors import DeclarationError

if TYPE_CHECKING:
    from collections.abc import Mapping

# fmt: off
RESERVED: Final = frozenset({
    "as", "break", "const", "continue", "else", "false", "for", "function", "if", "import", "in", "let", "loop",
    "namespace", "null", "package", "return", "true", "var", "void", "while",
})
# fmt: on
_IDENTIFIER: Final = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*", re.ASCII)


# Types ---------------------------------------------------------------------------------------------------------------


class Scalar(Enum):
    """The four scalar types: `int` is 64 bits, `double` is finite."""

    BOOL = "bool"
    INT = "int"
    DOUBLE = "double"
    STRING = "string"


BOOL, INT, DOUBLE, STRING = Scalar.BOOL, Scalar.INT, Scalar.DOUBLE, Scalar.STRING


@dataclass(frozen=True, slots=True)
class ListType:
    """A list of equal elements."""

    element: Type


@dataclass(frozen=True, slots=True)
class SetType:
    """Equal elements in no order: what is in it can be asked, and how many; not which is first, nor what it equals."""

    element: Type


@dataclass(frozen=True, slots=True)
class MapType:
    """A map from strings to equal values."""

    value: Type


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordType:
    """Named fields. Values are mappings, or objects with attributes; a field that is missing or `None` is absent.

    Raises:
        DeclarationError: A field's name is not an identifier of the language.
    """

    name: str
    fields: Mapping[str, Field] = field(hash=False)
    attributes: bool = False

    def __post_init__(self) -> None:
        """Names end up in generated code: let nothing but plain identifiers through."""
        for name in self.fields:
            require_identifier(name)


Type: TypeAlias = Scalar | ListType | SetType | MapType | RecordType


@dataclass(frozen=True, slots=True)
class Field:
    """What is known of a variable or of a record's field.

    Attributes:
        type: Its type.
        required: Whether it is always there; variables are.
        unit: Unit of the number, or of the numbers in the list, set or map; `None` matches every unit.
        within: Largest magnitude these numbers have. Arithmetic that cannot leave the range then needs no check.
        among: Every value this text, or a text in this list or set, can have; None where it may be any.
    """

    type: Type
    required: bool = True
    unit: str | None = None
    within: float | None = None
    among: frozenset[str] | None = field(default=None, repr=False)  # a site may have thousands of names


def require_identifier(name: str) -> None:
    """Refuse a name the grammar cannot spell.

    Raises:
        DeclarationError: It is not an identifier, begins with an underscore, or is reserved.
    """
    if not _IDENTIFIER.fullmatch(name) or name in RESERVED:
        raise DeclarationError(name=name, message="is not a usable name: letters, digits, `_`, not a reserved word")


def show(type_: Type) -> str:
    """Spell a type as the messages do, `list<double>` for instance."""
    match type_:
        case Scalar():
            return type_.value
        case ListType(element):
            return f"list<{show(element)}>"
        case SetType(element):
            return f"set<{show(element)}>"
        case MapType(value):
            return f"map<string, {show(value)}>"
        case _:
            return type_.name


# The typed tree ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Node:
    """What every typed node knows.

    Two nodes are equal when they mean the same: where they stand and what was proved about them does not count.

    Attributes:
        type: Type of the value.
        unit: Unit of the value (of what a list, set or map holds) where it is known; `None` matches every unit.
        reach: Largest magnitude the value (what a list, set or map holds) can have; 0 where it is no number.
        can_fail: Whether an evaluation may raise `EvaluationError`, given values of the declared types.
        column: Where it stands in the source, from 1.
    """

    type: Type
    unit: str | None = None
    reach: float = field(default=0, compare=False)
    can_fail: bool = field(default=False, compare=False)
    column: int = field(default=1, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Constant(Node):
    """A literal, already of the type its neighbours need (`1` beside a double is `1.0`)."""

    value: bool | int | float | str


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable(Node):
    """A declared variable, or, where `bound`, the variable of an enclosing quantifier."""

    name: str
    bound: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Select(Node):
    """`record.name`; `checked` where the field may be absent at this place."""

    record: Typed
    name: str
    checked: bool = field(default=False, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Present(Node):
    """`has(record.name)`."""

    select: Select


@dataclass(frozen=True, slots=True, kw_only=True)
class Apply(Node):
    """A strict function or operator: a row of `OVERLOADS`; `checked` where that row itself may fail."""

    overload: str
    args: tuple[Typed, ...]
    checked: bool = field(default=False, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Logic(Node):
    """`&&` (`conjunction`) or `||` over two or more operands; an error yields to an operand that decides."""

    conjunction: bool
    operands: tuple[Typed, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditional(Node):
    """`condition ? then : otherwise`."""

    condition: Typed
    then: Typed
    otherwise: Typed


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantifier(Node):
    """`domain.all(variable, predicate)` (`universal`) or `.exists`; the domain of a map is its keys."""

    universal: bool
    variable: str
    domain: Typed
    predicate: Typed


@dataclass(frozen=True, slots=True, kw_only=True)
class ListOf(Node):
    """`[a, b, …]`, never empty."""

    elements: tuple[Typed, ...]


Typed: TypeAlias = Constant | Variable | Select | Present | Apply | Logic | Conditional | Quantifier | ListOf


# Functions and operators ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Overload:
    """One meaning of a function or operator.

    Attributes:
        name: Stable name, unique but for `equal`, `less` and their like, which mean the same on every type.
        params: Argument types; `ANY` stands for one type, the same throughout.
        result: Result type.
        bare: Python text where the operation is proved not to fail.
        checked: Python text where it may; empty if it never does.
    """

    name: str
    params: tuple[Type, ...]
    result: Type
    bare: str
    checked: str = ""


ANY: Final = RecordType(name="any", fields={})
_SCALARS: Final = (BOOL, INT, DOUBLE, STRING)
_ORDERED: Final = (INT, DOUBLE, STRING)


def _compare(name: str, operator: str) -> tuple[Overload, ...]:
    text = f"({{0}} {operator} {{1}})"
    return tuple(Overload(name=name, params=(t, t), result=BOOL, bare=text) for t in _ORDERED)


def _equal(name: str, operator: str) -> tuple[Overload, ...]:
    text = f"({{0}} {operator} {{1}})"
    lists = f"(tuple({{0}}) {operator} tuple({{1}}))"
    scalars = (Overload(name=name, params=(t, t), result=BOOL, bare=text) for t in _SCALARS)
    return (
        *scalars,
        *(Overload(name=f"{name}_lists", params=(ListType(t),) * 2, result=BOOL, bare=lists) for t in _SCALARS),
    )


def _arithmetic(name: str, operator: str) -> tuple[Overload, ...]:
    text = f"({{0}} {operator} {{1}})"
    return (
        Overload(name=f"{name}_int", params=(INT, INT), result=INT, bare=text, checked=f"_cel_int({text})"),
        Overload(
            name=f"{name}_double", params=(DOUBLE, DOUBLE), result=DOUBLE, bare=text, checked=f"_cel_finite({text})"
        ),
    )


def _text(name: str, text: str) -> tuple[Overload, ...]:
    return (Overload(name=name, params=(STRING, STRING), result=BOOL, bare=text),)


_SIZE: Final = tuple(
    Overload(name="size", params=(t,), result=INT, bare="len({0})")
    for t in (STRING, ListType(ANY), SetType(ANY), MapType(ANY))
)
_QUOTIENT: Final = "_cel_quotient({0}, {1})"
_DIVIDE: Final = "_cel_divide({0}, {1})"
_ENTRY: Final = "_cel_entry({0}, {1})"
_REMAINDER: Final = "_cel_remainder({0}, {1})"

OVERLOADS: Final[Mapping[str, tuple[Overload, ...]]] = {
    "==": _equal("equal", "=="),
    "!=": _equal("unequal", "!="),
    "<": _compare("less", "<"),
    "<=": _compare("at_most", "<="),
    ">": _compare("greater", ">"),
    ">=": _compare("at_least", ">="),
    "+": _arithmetic("add", "+"),
    "-": _arithmetic("subtract", "-"),
    "*": _arithmetic("multiply", "*"),
    "/": (
        Overload(name="divide_int", params=(INT, INT), result=INT, bare=_QUOTIENT, checked=_QUOTIENT),
        Overload(name="divide_double", params=(DOUBLE, DOUBLE), result=DOUBLE, bare="({0} / {1})", checked=_DIVIDE),
    ),
    "%": (Overload(name="remainder_int", params=(INT, INT), result=INT, bare=_REMAINDER, checked=_REMAINDER),),
    "!_": (Overload(name="not", params=(BOOL,), result=BOOL, bare="(not {0})"),),
    "-_": (
        Overload(name="negate_int", params=(INT,), result=INT, bare="(-{0})", checked="_cel_int(-{0})"),
        Overload(name="negate_double", params=(DOUBLE,), result=DOUBLE, bare="(-{0})"),
    ),
    "in": (
        *(
            Overload(name="in_list", params=(t, held(t)), result=BOOL, bare="({0} in {1})")
            for held in (ListType, SetType)
            for t in _SCALARS
        ),
        Overload(name="in_map", params=(STRING, MapType(ANY)), result=BOOL, bare="({0} in {1})"),
    ),
    "[": (
        Overload(name="element", params=(ListType(ANY), INT), result=ANY, bare="", checked="_cel_element({0}, {1})"),
        Overload(name="entry", params=(MapType(ANY), STRING), result=ANY, bare="{0}[{1}]", checked=_ENTRY),
    ),
    "size": _SIZE,
    ".size": _SIZE,
    "double": (
        Overload(name="double_int", params=(INT,), result=DOUBLE, bare="float({0})"),
        Overload(name="double_double", params=(DOUBLE,), result=DOUBLE, bare="{0}"),
    ),
    "int": (
        Overload(name="int_double", params=(DOUBLE,), result=INT, bare="int({0})", checked="_cel_truncate({0})"),
        Overload(name="int_int", params=(INT,), result=INT, bare="{0}"),
    ),
    ".startsWith": _text("starts_with", "{0}.startswith({1})"),
    ".endsWith": _text("ends_with", "{0}.endswith({1})"),
    ".contains": _text("contains", "({1} in {0})"),
}  # fmt: skip


# Reading a typed tree ------------------------------------------------------------------------------------------------


def children(typed: Typed) -> tuple[Typed, ...]:
    """The nodes directly below, in source order."""
    match typed:
        case Constant() | Variable():
            return ()
        case Select(record=only) | Present(select=only):
            return (only,)
        case Apply(args=parts) | Logic(operands=parts) | ListOf(elements=parts):
            return parts
        case Conditional():
            return (typed.condition, typed.then, typed.otherwise)
        case Quantifier():
            return (typed.domain, typed.predicate)
        case _:
            assert_never(typed)


def references(typed: Typed) -> Mapping[str, Typed]:
    """What the expression reads, by dotted path as far as records go: `target.fragile`, not `target`."""
    path = dotted(typed)
    if path is not None:
        return {path: typed}
    found: dict[str, Typed] = {}
    for child in children(typed):
        found.update(references(child))
    return found


def dotted(node: Typed) -> str | None:
    """Return the path of a field that is read from a variable (`target.fragile`), or None for anything else."""
    match node:
        case Variable(name=name, bound=False):
            return name
        case Select(record=record, name=name):
            above = dotted(record)
            return None if above is None else f"{above}.{name}"
        case _:
            return None
