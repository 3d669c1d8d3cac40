"""Numbers that a call which goes on shares with another thread: loads and stores in order, and a lock.

Owns the intrinsics and what the other thread asks for with them. A load cannot be moved out of a loop, what was written before a store
is seen by whoever loads what was stored. Without the compiler they are Python's.
"""

from __future__ import annotations

from typing import Any

import numba
from numba import types
from numba.extending import intrinsic

from pans.runtime.wire.inner import outer

from . import rings as ring

READY, TAKEN, HOLD, LEAVE = range(4)  # what the other thread asks for, see `ask`

if numba.config.DISABLE_JIT:

    def load(array: Any, place: int) -> int:
        """Return array[place]."""
        return int(array[place])

    def store(array: Any, place: int, value: int) -> None:
        """Set array[place]."""
        array[place] = value

    def take(array: Any, place: int) -> bool:
        """Set array[place] to 1 and return True, or return False where it is not 0."""
        free = not array[place]
        array[place] = 1
        return free

else:

    @intrinsic
    def load(typing_context, array, place):  # type: ignore[no-untyped-def]
        """array[place] of an int64 array; no later load or store goes before it."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            return builder.load_atomic(_address(context, builder, signature, arguments), "acquire", 8)

        return types.int64(array, types.intp), code

    @intrinsic
    def store(typing_context, array, place, value):  # type: ignore[no-untyped-def]
        """Set array[place] of an int64 array; no earlier load or store goes behind it."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            builder.store_atomic(arguments[2], _address(context, builder, signature, arguments), "release", 8)
            return context.get_dummy_value()

        return types.void(array, types.intp, types.int64), code

    @intrinsic
    def take(typing_context, array, place):  # type: ignore[no-untyped-def]
        """Set array[place] of an int64 array from 0 to 1; whether it was 0."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            word = context.get_value_type(types.int64)
            address = _address(context, builder, signature, arguments)
            found = builder.cmpxchg(address, word(0), word(1), "seq_cst", "seq_cst")
            return builder.extract_value(found, 1)

        return types.boolean(array, types.intp), code


def _address(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return where array[place] stands."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    return builder.gep(array.data, [arguments[1]])


@outer
def ask(control, what):  # type: ignore[no-untyped-def]
    """READY: how many banks are published. TAKEN: one more has been taken. HOLD: whether we may write now; LEAVE: we have."""
    if what == READY:
        return load(control, ring.HEAD)
    if what == TAKEN:
        store(control, ring.TAIL, control[ring.TAIL] + 1)
    elif what == HOLD:
        return 1 if take(control, ring.WRITES) else 0
    elif what == LEAVE:
        store(control, ring.WRITES, 0)
    return 0
