"""How large a result can become, so that what cannot leave its type's range is computed without a check."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Final

from app.governance.expression_tree import DOUBLE, Constant

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.expression_tree import Typed

INT_MIN: Final = -(2**63)
INT_MAX: Final = 2**63 - 1
DOUBLE_MAX: Final = sys.float_info.max


def _sum_reach(args: tuple[Typed, ...]) -> float:
    return args[0].reach + args[1].reach


def _product_reach(args: tuple[Typed, ...]) -> float:
    return args[0].reach * args[1].reach


def _quotient_reach(args: tuple[Typed, ...]) -> float:
    left, right = args
    if not isinstance(right, Constant) or not right.reach:
        return math.inf
    return left.reach / right.reach if right.type is DOUBLE else left.reach // right.reach


def _remainder_reach(args: tuple[Typed, ...]) -> float:
    left, right = args
    if not isinstance(right, Constant) or not right.reach:
        return math.inf
    return left.reach if right.reach == 1 else right.reach - 1


def _same_reach(args: tuple[Typed, ...]) -> float:
    return args[0].reach


# Largest magnitude a result can have before the check; beyond the type's range means the check is needed. Doubles round
# monotonically, so that computing with the magnitudes bounds every computation with the values.
REACH: Final[Mapping[str, Callable[[tuple[Typed, ...]], float]]] = {
    "add_int": _sum_reach,
    "add_double": _sum_reach,
    "subtract_int": _sum_reach,
    "subtract_double": _sum_reach,
    "multiply_int": _product_reach,
    "multiply_double": _product_reach,
    "divide_int": _quotient_reach,
    "divide_double": _quotient_reach,
    "remainder_int": _remainder_reach,
    "negate_int": _same_reach,
    "negate_double": _same_reach,
    "element": _same_reach,
    "entry": _same_reach,
    "double_double": _same_reach,
    "double_int": lambda args: float(args[0].reach),
    "int_int": _same_reach,
    "int_double": lambda args: math.floor(args[0].reach),
    "size": lambda _: INT_MAX,
}
