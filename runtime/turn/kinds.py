"""The kernels of each kind of walk: what takes a message, and what answers a block. The class of the walk's tuple says which.

Owns the choice, made when a turn is compiled: a run with objects that stand still compiles nothing of a flow's, and the other way round.
A third kind is a tuple of arrays with `state` and `rows`, and a kernel of each sort here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from pans.runtime.core import stream_kernels as core
from pans.runtime.flow.arrays import FlowWalk
from pans.runtime.flow.columns import ASKS
from pans.runtime.wire.inner import inner

from . import rings as ring
from .shows import send_show


@inner
def _take_still(walk, buffer, start, stop):  # type: ignore[no-untyped-def]
    return core.take_message(
        buffer, start, stop, walk.state, walk.marks, walk.windows, walk.tables, walk.rows, walk.counts
    )


@inner
def _answer_still(walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    return not control[ring.DRIVES] or send_show(walk, drive, rings, control, scratch)


@inner
def _answer_flow(walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    """A pulse is sent by the caller, behind the record of its decision: he is to have that at once."""
    if walk.state[ASKS]:
        walk.state[ASKS] = 0
        control[ring.URGENT] = 1
    return np.bool_(True)


def taking(kind: Any) -> Any:
    """Return the kernel that takes a message of a walk of class `kind`."""
    if kind is FlowWalk:
        from pans.runtime.flow.deciding import take_message as take_flow

        return take_flow
    return _take_still


def answering(kind: Any) -> Any:
    """Return the kernel that answers a block of a walk of class `kind`."""
    return _answer_flow if kind is FlowWalk else _answer_still


def _typed(choose: Callable[[Any], Any], context: Any, arguments: tuple[Any, ...]) -> tuple[Any, Any]:
    """Return what the compiler wants of a call of the kernel that `choose` names for the first of `arguments`, a tuple's type."""
    kernel = types.Dispatcher(choose(arguments[0].instance_class))
    found = context.resolve_function_type(kernel, arguments, {})

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        called = context.get_function(kernel, found)
        result = called(builder, values)
        context.add_linking_libs(getattr(called, "libs", ()))
        return result

    return found.return_type(*found.args), code


if numba.config.DISABLE_JIT:

    def take_message(walk: Any, *rest: Any) -> Any:
        """Take a message with the kernel of the walk's kind."""
        return taking(type(walk))(walk, *rest)

    def answer(walk: Any, *rest: Any) -> Any:
        """Answer a block with the kernel of the walk's kind."""
        return answering(type(walk))(walk, *rest)

else:

    @intrinsic
    def take_message(context, walk, buffer, start, stop):  # type: ignore[no-untyped-def]
        """Take the message from `start` to `stop`, uint64, of `buffer`: as core/stream_kernels.py's, by the kernel of the walk's kind."""
        return _typed(taking, context, (walk, buffer, start, stop))

    @intrinsic
    def answer(context, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
        """Answer a block that has been taken; False when that could not be sent whole."""
        return _typed(answering, context, (walk, drive, rings, control, scratch))
