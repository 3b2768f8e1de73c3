"""Formulas of Z3, with `True` and `False` folded away before the solver sees them."""

from __future__ import annotations

from ctypes import c_uint
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import z3

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from fractions import Fraction

Formula: TypeAlias = "bool | z3.BoolRef"
LAST_CHARACTER: Final = 0x2FFFF  # of Z3, as of SMT-LIB

# Z3's Python asserts the sort of every argument of every term, a quarter of the time that proofs take. What is encoded
# here was typed when it was loaded, and Z3 itself refuses terms whose sorts do not fit.
z3.z3.Z3_DEBUG = False


def _unasked(function: Callable[..., int]) -> Callable[..., int]:
    """Return a function of Z3 itself: Z3's Python asks after every call whether it failed, at the price of another."""
    return cast("tuple[Any]", function.__defaults__)[0].f


# Terms are made by the million, and counting references to them cannot fail; nor can asking what they are.
z3.z3.Z3_inc_ref, z3.z3.Z3_dec_ref = _unasked(z3.Z3_inc_ref), _unasked(z3.Z3_dec_ref)
_kind, _applied, _operation = map(_unasked, (z3.Z3_get_ast_kind, z3.Z3_get_app_decl, z3.Z3_get_decl_kind))
_truth = _unasked(z3.Z3_get_bool_value)


def both(*parts: Formula) -> Formula:
    """Return the conjunction."""
    return every(parts)


def every(parts: Iterable[Formula]) -> Formula:
    """Return the conjunction of all; of none it is true."""
    return _joined(parts, z3.Z3_mk_and, decisive=False)


def either(*parts: Formula) -> Formula:
    """Return the disjunction."""
    return some(parts)


def some(parts: Iterable[Formula]) -> Formula:
    """Return the disjunction of all; of none it is false."""
    return _joined(parts, z3.Z3_mk_or, decisive=True)


def _joined(parts: Iterable[Formula], join: Callable[..., z3.Ast], *, decisive: bool) -> Formula:
    """Join parts, each once; the `decisive` truth value settles the matter, the other one adds nothing.

    Millions are joined in a proof, so this asks Z3 itself: its `And` and `Or` look at every argument several times.
    """
    kept: dict[int, z3.BoolRef] = {}
    for part in parts:
        if part is decisive:
            return decisive
        if not isinstance(part, bool):
            # Equal terms are one term to Z3, at one address as long as it lives.
            kept[part.ast.value] = part  # pyright: ignore[reportOptionalMemberAccess]
    if len(kept) < 2:
        return next(iter(kept.values()), not decisive)
    context = next(iter(kept.values())).ctx
    terms = (z3.Ast * len(kept))(*[part.ast for part in kept.values()])
    return z3.BoolRef(join(context.ref(), len(kept), terms), context)


def no(part: Formula) -> Formula:
    """Return the negation."""
    if isinstance(part, bool):
        return not part
    context, whole = part.ctx.ref(), part.as_ast()
    return part.arg(0) if _negates(context, whole) else z3.BoolRef(z3.Z3_mk_not(context, whole), part.ctx)


def _negates(context: z3.ContextObj, whole: z3.Ast) -> bool:
    """Say whether a formula is a negation: as `z3.is_not` does, without a Python object for what it applies."""
    return _kind(context, whole) == z3.Z3_APP_AST and _operation(context, _applied(context, whole)) == z3.Z3_OP_NOT


def implies(premise: Formula, conclusion: Formula) -> Formula:
    """Return the implication."""
    return either(no(premise), conclusion)


def same(one: Formula, other: Formula) -> Formula:
    """Return the equivalence."""
    if isinstance(one, bool):
        return other if one else no(other)
    if isinstance(other, bool):
        return one if other else no(one)
    return True if one.eq(other) else one == other


def choose(condition: Formula, then: Formula, otherwise: Formula) -> Formula:
    """Return `then` where the condition holds, else `otherwise`."""
    return either(both(condition, then), both(no(condition), otherwise))


def term(formula: Formula) -> z3.BoolRef:
    """Return a formula as a term of Z3."""
    return z3.BoolVal(formula) if isinstance(formula, bool) else formula


@lru_cache(maxsize=4096)
def named(name: str) -> z3.BoolRef:
    """Return the variable of a name, true or false; there is one, however often it is asked for."""
    return z3.Bool(name)


def holds(model: z3.ModelRef, formula: Formula) -> bool | None:
    """Return what a formula is in a model; None where the model leaves it open."""
    if isinstance(formula, bool):
        return formula
    context, found = formula.ctx.ref(), (z3.Ast * 1)()
    z3.Z3_model_eval(context, model.model, formula.as_ast(), False, found)
    return _TRUTH.get(_truth(context, found[0]))


_TRUTH: Final = {z3.Z3_L_TRUE: True, z3.Z3_L_FALSE: False}


def exactly_one(options: list[z3.BoolRef]) -> Formula:
    """Say that one of these holds, and no other."""
    if len(options) == 1:
        return options[0]
    return both(z3.Or(*options), z3.AtMost(*options, 1))


def text(value: str) -> z3.SeqRef:
    """Return a text, of characters up to `LAST_CHARACTER`, as a term; Z3 would read its backslashes as escapes."""
    return z3.StringVal(value.replace("\\", r"\u{5c}"))


def spelled(value: z3.SeqRef) -> str:
    """Return what a term that is a text says, by its characters: as a string Z3 hands it out with escapes in it."""
    length = z3.Z3_get_string_length(value.ctx_ref(), value.as_ast())
    characters = (c_uint * length)()
    z3.Z3_get_string_contents(value.ctx_ref(), value.as_ast(), length, characters)
    return "".join(map(chr, characters))


@lru_cache(maxsize=4096)
def rational(value: Fraction | float) -> z3.RatNumRef:
    """Return the exact value of a number; every finite double is a fraction."""
    numerator, denominator = value.as_integer_ratio()
    return z3.Q(numerator, denominator)
