"""Reading a condition: from source to the syntax tree, within bounds.

The language is a subset of CEL (docs/design/expressions.md). `parse` bounds what it takes: `MAX_SOURCE` characters,
`MAX_DEPTH` levels of nesting. Chains of `&&` and `||` count as one level, however long.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from lark import Lark, Token, Transformer
from lark.exceptions import UnexpectedInput

from app.governance.errors import ExpressionError
from app.governance.expression_tree import RESERVED

MAX_SOURCE: Final = 4096
MAX_DEPTH: Final = 32


@dataclass(frozen=True, slots=True)
class Syntax:
    r"""An untyped node: what it is, its word or value, its parts.

    | kind | value | parts |
    |---|---|---|
    | `literal` | the value | – |
    | `name` | identifier | – |
    | `select` | field | operand |
    | `call` | function or operator; `[` indexes, `!_` and `-_` are prefixes | arguments |
    | `method` | function | receiver, then arguments |
    | `logic` | `&&` or `\|\|` | two or more operands |
    | `conditional` | `?` | condition, then, otherwise |
    | `list` | `[` | elements |
    """

    kind: str
    value: bool | int | float | str
    parts: tuple[Syntax, ...]
    column: int
    depth: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Tree:
    """A parsed condition and the source it came from."""

    source: str
    root: Syntax


_GRAMMAR: Final = r"""
?start: choice
?choice: any | any QUESTION any ":" choice -> conditional
?any: all | all (OR all)+ -> logic
?all: relation | relation (AND relation)+ -> logic
?relation: sum | relation RELATION sum -> call | relation IN sum -> call
?sum: product | sum (PLUS | MINUS) product -> call
?product: unary | product TIMES unary -> call
?unary: member | (NOT | MINUS) unary -> prefix
?member: primary
    | member "." NAME -> select
    | member "." NAME OPEN [choice ("," choice)*] ")" -> method
    | member SQUARE choice "]" -> call
?primary: "(" choice ")"
    | NAME -> name
    | NAME OPEN [choice ("," choice)*] ")" -> call
    | SQUARE [choice ("," choice)*] "]" -> sequence
    | (TRUE | FALSE) -> truth
    | INT -> integer
    | DOUBLE -> double
    | STRING -> string
QUESTION: "?"
OR: "||"
AND: "&&"
RELATION: "==" | "!=" | "<=" | ">=" | "<" | ">"
PLUS: "+"
MINUS: "-"
TIMES: "*" | "/" | "%"
NOT: "!"
OPEN: "("
SQUARE: "["
IN: /in(?![a-zA-Z0-9_])/
TRUE: /true(?![a-zA-Z0-9_])/
FALSE: /false(?![a-zA-Z0-9_])/
NAME: /(?!(RESERVED)(?![a-zA-Z0-9_]))[a-zA-Z][a-zA-Z0-9_]*/
DOUBLE.2: /([0-9]+\.[0-9]+|\.[0-9]+)([eE][+-]?[0-9]+)?(?![a-zA-Z0-9_])|[0-9]+[eE][+-]?[0-9]+(?![a-zA-Z0-9_])/
INT: /[0-9]+(?![a-zA-Z0-9_])/
STRING: /"([^"\\\n]|\\.)*"|'([^'\\\n]|\\.)*'/
%ignore /[ \t\r\n]+/
"""

_MEANT: Final = {"=": "==", "&": "&&", "and": "&&", "|": "||", "or": "||"}  # what other languages write instead
_ESCAPES: Final = {"\\": "\\", '"': '"', "'": "'", "n": "\n", "r": "\r", "t": "\t"}
_WORD: Final = re.compile(r"\w{1,40}|.", re.DOTALL)
_SURROGATE: Final = re.compile(r"[\ud800-\udfff]")
_ESCAPE: Final = re.compile(r"\\(u[0-9a-fA-F]{4}|.)", re.DOTALL)


class _Rejected(Exception):  # never leaves this module
    def __init__(self, column: int, message: str, valid: tuple[str, ...] = ()) -> None:
        self.column, self.valid = column, valid
        super().__init__(message)


def _node(kind: str, value: bool | int | float | str, parts: tuple[Syntax, ...], column: int) -> Syntax:
    depth = 1 + max((part.depth for part in parts), default=0)
    if depth > MAX_DEPTH:
        raise _Rejected(column, f"nested deeper than {MAX_DEPTH} levels")
    return Syntax(kind, value, parts, column, depth)


def _column(token: Token) -> int:
    return (token.start_pos or 0) + 1


def _unescape(token: Token) -> str:
    def replace(match: re.Match[str]) -> str:
        escape = match[1]
        if escape in _ESCAPES:
            return _ESCAPES[escape]
        character = chr(int(escape[1:], 16)) if len(escape) > 1 else ""
        if not character or "\ud800" <= character <= "\udfff":
            column = _column(token) + 1 + match.start()
            raise _Rejected(column, f"unknown escape `\\{escape}`", (*(f"\\{word}" for word in _ESCAPES), "\\uXXXX"))
        return character

    return _ESCAPE.sub(replace, token[1:-1])


class _Builder(Transformer[Token, Syntax]):
    """Builds `Syntax` while the parser reduces, so that nothing recurses over what the source nests."""

    def name(self, parts: list[Token]) -> Syntax:
        return _node("name", str(parts[0]), (), _column(parts[0]))

    def truth(self, parts: list[Token]) -> Syntax:
        return _node("literal", parts[0] == "true", (), _column(parts[0]))

    def integer(self, parts: list[Token]) -> Syntax:
        return _node("literal", int(parts[0]), (), _column(parts[0]))

    def double(self, parts: list[Token]) -> Syntax:
        return _node("literal", float(parts[0]), (), _column(parts[0]))

    def string(self, parts: list[Token]) -> Syntax:
        return _node("literal", _unescape(parts[0]), (), _column(parts[0]))

    def sequence(self, parts: list[Token | Syntax]) -> Syntax:
        return _operation("list", parts)

    def select(self, parts: list[Token | Syntax]) -> Syntax:
        return _operation("select", parts)

    def call(self, parts: list[Token | Syntax]) -> Syntax:
        return _operation("call", parts)

    def method(self, parts: list[Token | Syntax]) -> Syntax:
        return _operation("method", parts)

    def prefix(self, parts: list[Token | Syntax]) -> Syntax:
        return _operation("call", parts, suffix="_")

    def conditional(self, parts: list[Token | Syntax]) -> Syntax:
        return _operation("conditional", parts)

    def logic(self, parts: list[Token | Syntax]) -> Syntax:
        # (a && b) && c means a && (b && c): one level, so that long chains stay shallow and compile flat
        word, operands = _split(parts)
        flat = (inner for part in operands for inner in (part.parts if _same_logic(part, word) else (part,)))
        return _node("logic", str(word), tuple(flat), _column(word))


def _same_logic(part: Syntax, word: str) -> bool:
    return part.kind == "logic" and part.value == word


def _split(parts: list[Token | Syntax]) -> tuple[Token, tuple[Syntax, ...]]:
    word = next(part for part in parts if isinstance(part, Token))
    return word, tuple(part for part in parts if isinstance(part, Syntax))


def _operation(kind: str, parts: list[Token | Syntax], *, suffix: str = "") -> Syntax:
    word, operands = _split(parts)
    return _node(kind, f"{word}{suffix}", operands, _column(word))


@cache
def _parser() -> Callable[[str], Syntax]:
    grammar = _GRAMMAR.replace("RESERVED", "|".join(sorted(RESERVED)))
    lark: Any = Lark(grammar, parser="lalr", maybe_placeholders=False, transformer=_Builder())
    return lark.parse


def parse(source: str) -> Tree:
    """Parse a condition; the tree is not typed yet.

    Raises:
        ExpressionError: It is longer than `MAX_SOURCE`, nested deeper than `MAX_DEPTH`, or not in the grammar.
    """
    surrogate, valid = _SURROGATE.search(source), tuple[str, ...]()
    if len(source) > MAX_SOURCE:
        column, message = MAX_SOURCE + 1, f"`{len(source)}` characters are too many; at most {MAX_SOURCE}"
    elif surrogate:
        column, message = surrogate.start() + 1, "half of a surrogate pair is not a character"
    else:
        try:
            return Tree(source=source, root=_parser()(source))
        except _Rejected as fault:
            raise ExpressionError(source=source, column=fault.column, message=str(fault), valid=fault.valid) from None
        except UnexpectedInput as fault:
            column, message, valid = _explain(source, fault)
    raise ExpressionError(source=source, column=column, message=message, valid=valid)


def _explain(source: str, fault: UnexpectedInput) -> tuple[int, str, tuple[str, ...]]:
    token: Any = getattr(fault, "token", None)
    if token is None:  # the lexer found no token at all
        position = fault.pos_in_stream or 0
        column, word = position + 1, str(_WORD.findall(source, position)[0])
    elif token.type == "$END":
        return len(source) + 1, "unexpected end", ()
    else:
        column, word = _column(token), str(token[:40])
    return column, f"unexpected `{word}`", (_MEANT[word],) if word in _MEANT else ()
