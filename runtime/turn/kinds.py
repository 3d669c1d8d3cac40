"""The kernels of each kind of walk: what takes a message, and what answers a block. The class of the walk's tuple says which.

Owns the choice, made when a turn is compiled: a run of one kind compiles nothing of the others: exposures of one detector, frames of
parallel channels, flow. A further kind is a tuple of arrays with `state` and `rows`, and a kernel of each sort here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from pans.runtime.core import stream_kernels as core
from pans.runtime.core.stream_arrays import FrameWalkArrays, IdleArrays, WalkArrays
from pans.runtime.flow.kernels import FlowWalk
from pans.runtime.wire.inner import inner

from .shows import send_show


@inner
def _answer_nothing(walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    return np.bool_(True)


def taking(kind: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the kernel that takes a message of a walk of class `kind`, and which fields of the walk it wants behind the message.

    Without names it wants the whole walk before the message.
    """
    if kind is FlowWalk:
        from pans.runtime.flow.kernels import take_message as take_flow

        return take_flow, ()
    if kind is IdleArrays:
        return core.take_nothing, ()
    if kind is FrameWalkArrays:
        return core.take_frames, WalkArrays._fields[:-1]  # who calls it notes what was heard
    return core.take_clicks, WalkArrays._fields[:-1]


def answering(kind: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the kernel that answers a block of a walk of class `kind`, and no names: it wants the whole walk."""
    return (send_show if kind is WalkArrays else _answer_nothing), ()


def _typed(choose: Callable[[Any], Any], context: Any, walk: Any, rest: tuple[Any, ...]) -> tuple[Any, Any]:
    """Return what the compiler wants of a call of the kernel that `choose` names for a walk of this type.

    The fields are taken out here: one more kernel in between takes the compiler half a second.
    """
    kernel, names = choose(walk.instance_class)
    places = [walk.fields.index(name) for name in names]
    arguments = (*rest, *(walk.types[place] for place in places)) if names else (walk, *rest)
    called = types.Dispatcher(kernel)
    found = context.resolve_function_type(called, arguments, {})

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        function = context.get_function(called, found)
        parts = [builder.extract_value(values[0], place) for place in places]
        result = function(builder, [*values[1:], *parts] if names else values)
        context.add_linking_libs(getattr(function, "libs", ()))
        return result

    return found.return_type(walk, *rest), code


if numba.config.DISABLE_JIT:

    def take_message(walk: Any, *rest: Any) -> Any:
        """Take a message with the kernel of the walk's kind."""
        kernel, names = taking(type(walk))
        return kernel(*rest, *(getattr(walk, name) for name in names)) if names else kernel(walk, *rest)

    def answer(walk: Any, *rest: Any) -> Any:
        """Answer a block with the kernel of the walk's kind."""
        return answering(type(walk))[0](walk, *rest)

else:

    @intrinsic
    def take_message(context, walk, buffer, start, stop):  # type: ignore[no-untyped-def]
        """Take the message from `start` to `stop`, uint64, of `buffer`: as core/stream_kernels.py's, by the kernel of the walk's kind."""
        return _typed(taking, context, walk, (buffer, start, stop))

    @intrinsic
    def answer(context, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
        """Answer a block that has been taken; False when that could not be sent whole."""
        return _typed(answering, context, walk, (drive, rings, control, scratch))
