"""Fuses small functions into one, so that a loop pays for their work and not for calling them.

A *part* is a plain function: typed, linted and tested where it stands. Its parameters are names that the whole knows
(inputs, state, constants, or what an earlier part gives); its last statement returns what it `gives`. Fused, the bodies
stand one after the other in one function:

```
def drift(x, bias):                                       x = x + bias
    return x + bias                 gives x        ▶      far_off = abs(x) > limit
def far(x, limit):
    return abs(x) > limit           gives far_off
```

What a part calls its own gets its name in front, so that parts cannot meet by accident. The fields of named tuples need
not be looked up: `record.field` becomes `record_field`, a local that was unpacked before the parts begin, or a constant
of the namespace. Lines keep their numbers: a traceback (and coverage) points into the part's own source.
"""

from __future__ import annotations

import ast
import inspect
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from types import CodeType

Records: TypeAlias = "Mapping[str, Sequence[str]]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A function that can be fused, and the names of what it returns."""

    do: Callable[..., object]
    gives: tuple[str, ...]
    body: tuple[ast.stmt, ...]

    @property
    def name(self) -> str:
        """Return the function's name."""
        return self.do.__code__.co_name

    @property
    def takes(self) -> tuple[str, ...]:
        """Return the names the function needs."""
        code = self.do.__code__
        return code.co_varnames[: code.co_argcount]


def parts(table: Mapping[Callable[..., object], tuple[str, ...]]) -> tuple[Part, ...]:
    """Take functions of one module as parts, in the order given: function → names of what it returns.

    Call it while that module is imported: the source read then is the one that runs.

    Raises:
        ValueError: A function returns elsewhere than at its end, rebinds a parameter that it does not give back, or
            uses two underscores in a row in a name that others share.
        OSError: The module's source is not there.
    """
    modules = {function.__module__ for function in table}
    sources = {
        node.name: node
        for module in modules
        for node in ast.parse(inspect.getsource(sys.modules[module])).body
        if isinstance(node, ast.FunctionDef)
    }
    return tuple(_part(function, gives, sources[function.__code__.co_name]) for function, gives in table.items())


def _part(function: Callable[..., object], gives: tuple[str, ...], source: ast.FunctionDef) -> Part:
    made = Part(do=function, gives=gives, body=tuple(source.body[1:] if ast.get_docstring(source) else source.body))
    inside = [node for statement in made.body for node in ast.walk(statement)]
    if sum(isinstance(node, ast.Return) for node in inside) != 1 or not isinstance(made.body[-1], ast.Return):
        raise ValueError(f"`{made.name}` cannot be fused; valid: one `return`, at the end")
    bound = {node.id for node in inside if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    if odd := sorted(name for name in {*made.takes, *gives} if "__" in name):
        raise ValueError(f"`{made.name}` takes or gives `{odd[0]}`; valid: names without two underscores in a row")
    if lost := sorted((bound & set(made.takes)) - set(gives)):
        raise ValueError(f"`{made.name}` rebinds `{lost[0]}`; valid: give it back, or use another name")
    return made


def needed(of: Sequence[Part], wanted: Iterable[str]) -> tuple[Part, ...]:
    """Return the parts that have a share in what is wanted, in order.

    State that a part keeps for itself alone is no reason for it.
    """
    kept: set[str] = set()
    known = set(wanted)
    while more := [part for part in of if part.name not in kept and known.intersection(part.gives)]:
        for part in more:
            kept.add(part.name)
            known.update(part.takes)
    return tuple(part for part in of if part.name in kept)


def fuse(
    frame: str,
    body: Sequence[Part],
    unpacked: Records,
    constant: Records,
    numbers: Mapping[str, float],
    filename: str,
) -> CodeType:
    """Return the code of one function.

    Args:
        frame: The function's source; the parts take the place of its statement `...`.
        body: The parts, in order.
        unpacked: Named tuples by name, with their fields: locals of the frame, unpacked where the parts begin.
        constant: The same of those whose fields the namespace holds as `record_field`.
        numbers: What never changes, by name; it stands in the code and need not be looked up.
        filename: The source of the parts.
    """
    whole = ast.parse(frame)
    function = next(node for node in whole.body if isinstance(node, ast.FunctionDef))
    for node in ast.walk(function):
        if hasattr(node, "lineno"):
            node.lineno, node.end_lineno, node.col_offset, node.end_col_offset = 1, 1, 0, 0  # type: ignore[attr-defined]
    first = [_unpack(name, fields) for name, fields in unpacked.items()]
    inlined = [statement for part in body for statement in _inlined(part, {**unpacked, **constant}, numbers)]
    place = next(at for at, node in enumerate(function.body) if _is_ellipsis(node))
    function.body[place : place + 1] = [*first, *inlined]
    compiled = compile(ast.fix_missing_locations(whole), filename, "exec")
    return next(const for const in compiled.co_consts if inspect.iscode(const))


def _unpack(record: str, fields: Sequence[str]) -> ast.stmt:
    return ast.parse(f"({', '.join(f'{record}_{field}' for field in fields)},) = {record}").body[0]


def _is_ellipsis(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and node.value.value is ...


def _inlined(part: Part, records: Records, numbers: Mapping[str, float]) -> list[ast.stmt]:
    code = part.do.__code__
    own = set(code.co_varnames + code.co_cellvars) - set(part.takes) - set(part.gives)
    rename = _Rename(part.name, own, records, {name: numbers[name] for name in numbers if name not in part.takes})
    body = [rename.visit(_copied(statement)) for statement in part.body]
    return [*body[:-1], *_given(part, body[-1])]


def _copied(node: ast.stmt) -> ast.stmt:
    """Return a syntax tree of its own; `copy.deepcopy` takes three times as long, and a launch waits for it."""
    return cast("ast.stmt", _copy(node))


def _copy(value: object) -> object:
    if isinstance(value, list):
        return [_copy(one) for one in cast("list[object]", value)]
    if not isinstance(value, ast.AST):
        return value
    made = type(value)()
    vars(made).update({name: _copy(found) for name, found in vars(value).items()})
    return made


def _given(part: Part, last: ast.Return) -> list[ast.stmt]:
    """Turn the return into assignments: one for each name, none for what has its name already."""
    value = last.value or ast.Constant(None)
    values = [value] if len(part.gives) == 1 else value.elts if isinstance(value, ast.Tuple) else []
    if len(values) != len(part.gives):
        raise ValueError(f"`{part.name}` gives {len(part.gives)} names; valid: return as many, side by side")
    pairs = [(name, one) for name, one in zip(part.gives, values, strict=True) if not _is_name(one, name)]
    for at, (_, one) in enumerate(pairs):
        if any(_is_name(node, name) for name, _ in pairs[:at] for node in ast.walk(one)):
            raise ValueError(f"`{part.name}` returns what it has just overwritten; valid: return plain names")
    return [ast.copy_location(ast.Assign([ast.Name(name, ast.Store())], one), last) for name, one in pairs]


def _is_name(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name


class _Rename(ast.NodeTransformer):
    """Gives a part's own names its name in front, writes numbers out, and turns `record.field` into its local."""

    def __init__(self, prefix: str, own: set[str], records: Records, numbers: Mapping[str, float]) -> None:
        self.prefix, self.own, self.records, self.numbers = prefix, own, records, numbers

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id in self.own:
            # Two underscores, which no name that is given or unpacked has: `ahead_m` of `separation` is not what it
            # gives as `separation_ahead_m`.
            node.id = f"{self.prefix}__{node.id}"
        elif node.id in self.numbers and isinstance(node.ctx, ast.Load):
            return ast.copy_location(ast.Constant(self.numbers[node.id]), node)
        return node

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        record = node.value
        if isinstance(record, ast.Name) and node.attr in self.records.get(record.id, ()):
            return ast.copy_location(ast.Name(f"{record.id}_{node.attr}", node.ctx), node)
        return ast.NodeTransformer.generic_visit(self, node)  # type: ignore[return-value]
