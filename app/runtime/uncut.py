"""Running to the end: what has been recorded must also be done, even if whoever asked for it has gone."""

from __future__ import annotations

import asyncio
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, Final, ParamSpec, TypeVar

from app.audit.errors import AuditError
from app.protocol import ProtocolError
from app.runtime.errors import RuntimeRefusal

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

S = TypeVar("S")
P = ParamSpec("P")
T = TypeVar("T")

REFUSALS: Final = (AuditError, ProtocolError, RuntimeRefusal)


def uncut(
    method: Callable[Concatenate[S, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[S, P], Coroutine[Any, Any, T]]:
    """Let a method run to its end even if its caller is cancelled (a client that hangs up)."""

    @wraps(method)
    async def run(self: S, *args: P.args, **kwargs: P.kwargs) -> T:
        task = asyncio.ensure_future(method(self, *args, **kwargs))
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            task.add_done_callback(_left_behind)
            raise

    return run


def _left_behind(task: asyncio.Task[Any]) -> None:
    """Hear how it ended, in the place of whoever has gone: a refusal was for them alone, a bug is told of."""
    error = None if task.cancelled() else task.exception()
    if error is not None and not isinstance(error, REFUSALS):
        context = {"message": "what nobody waited for any more failed", "exception": error}
        task.get_loop().call_exception_handler(context)
