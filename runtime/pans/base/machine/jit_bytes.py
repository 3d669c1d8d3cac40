"""What kernels need and numba has not: arrays without a count of references, bytes as numbers, a pause of a loop that waits.

A kernel that takes an array out of a tuple counts a reference, and again when it lets go: two locked
additions each time, which for a block of one exposure added up to most of its time. A bare array owns nothing and counts nothing; its
memory must outlive the call, as the arguments of a call do.

Loops over bytes could do the same, but would be inlined and optimised anew in every kernel that calls them; an intrinsic is one
instruction from the beginning.
"""

from __future__ import annotations

import platform
import sys
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

from .jit import outer

if numba.config.DISABLE_JIT:

    def bare(value: Any) -> Any:
        """Return `value`."""
        return value

    def as_float32(bits: Any) -> Any:
        """Return the float32 whose bits are the low 32 of `bits`."""
        return np.uint32(bits).view(np.float32)

    def load8(data: Any, i: Any) -> Any:
        """Return eight bytes of uint8 `data` from place `i` on, little-endian, as a uint64."""
        return np.uint64(int.from_bytes(data[int(i) : int(i) + 8], "little"))

    def load4(data: Any, i: Any) -> Any:
        """Return four bytes of uint8 `data` from place `i` on, little-endian, as a uint64."""
        return np.uint64(int.from_bytes(data[int(i) : int(i) + 4], "little"))

    def load2(data: Any, i: Any) -> Any:
        """Return two bytes of uint8 `data` from place `i` on, little-endian, as a uint64."""
        return np.uint64(int.from_bytes(data[int(i) : int(i) + 2], "little"))

    def copy_span(source: Any, start: Any, stop: Any, target: Any, at: Any) -> None:
        """Copy source[start:stop] to target[at:], uint8, which may be the same array."""
        target[int(at) : int(at) + int(stop) - int(start)] = source[int(start) : int(stop)].copy()

    def pause() -> None:
        """Do nothing."""

    def fence() -> None:
        """Do nothing: the interpreter's threads see each other's writes in order."""

else:

    @intrinsic
    def bare(typing_context, value):  # type: ignore[no-untyped-def]
        """`value`, an array or a tuple of arrays and of such tuples, whose arrays count no references."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            return _stripped(context, builder, signature.args[0], arguments[0])

        return value(value), code

    @intrinsic
    def as_float32(typing_context, bits):  # type: ignore[no-untyped-def]
        """The float32 whose bits are the low 32 of `bits`, uint64; a view of an array takes numba seconds to compile."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            low = builder.trunc(arguments[0], context.get_value_type(types.uint32))
            return builder.bitcast(low, context.get_value_type(types.float32))

        return types.float32(types.uint64), code

    @intrinsic
    def load8(typing_context, data, i):  # type: ignore[no-untyped-def]
        """Eight bytes of `data`, contiguous uint8, from place `i` (uint64) on, little-endian, as a uint64."""
        return types.uint64(_bytes_of(data), types.uint64), _loads(64)

    @intrinsic
    def load4(typing_context, data, i):  # type: ignore[no-untyped-def]
        """Four bytes of `data`, contiguous uint8, from place `i` (uint64) on, little-endian, as a uint64."""
        return types.uint64(_bytes_of(data), types.uint64), _loads(32)

    @intrinsic
    def load2(typing_context, data, i):  # type: ignore[no-untyped-def]
        """Two bytes of `data`, contiguous uint8, from place `i` (uint64) on, little-endian, as a uint64."""
        return types.uint64(_bytes_of(data), types.uint64), _loads(16)

    @intrinsic
    def copy_span(typing_context, source, start, stop, target, at):  # type: ignore[no-untyped-def]
        """Copy source[start:stop] to target[at:], contiguous uint8, which may be the same array; places are uint64."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            source, start, stop, target, at = arguments
            begin = _place(context, builder, signature.args[0], source, start)
            to = _place(context, builder, signature.args[3], target, at)
            cgutils.raw_memmove(builder, to, begin, builder.sub(stop, start), 1)
            return context.get_dummy_value()

        places = (types.uint64, types.uint64, _bytes_of(target), types.uint64)
        return types.void(_bytes_of(source), *places), code

    @intrinsic
    def pause(typing_context):  # type: ignore[no-untyped-def]
        """The processor's hint that a loop waits; memory counts as changed, so that the loop looks at it again."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            if platform.machine() in ("x86_64", "AMD64"):
                kind = ir.FunctionType(ir.VoidType(), [])
                builder.call(builder.module.declare_intrinsic("llvm.x86.sse2.pause", (), kind), [])
            else:
                builder.fence("seq_cst")
            return context.get_dummy_value()

        return types.void(), code

    @intrinsic
    def fence(typing_context):  # type: ignore[no-untyped-def]
        """Other threads see what was written before this before what is written after it, and reads keep to their side too."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            builder.fence("seq_cst")
            return context.get_dummy_value()

        return types.void(), code


@outer
def spin(state):  # type: ignore[no-untyped-def]
    """Wait until state[0], int64, is not 0; state[1] is 1 from the beginning on."""
    state[1] = 1
    while state[0] == 0:
        pause()


def _bytes_of(kind: Any) -> Any:
    """Return `kind`, which must be that of contiguous bytes."""
    if isinstance(kind, types.Array) and kind.ndim == 1 and kind.dtype == types.uint8 and kind.layout == "C":
        return kind
    raise TypingError(f"contiguous uint8 (n,) is wanted, not {kind}")


def _place(context: Any, builder: Any, kind: Any, array: Any, i: Any) -> Any:
    """Return the address of byte `i` of `array`."""
    data = cgutils.create_struct_proxy(kind)(context, builder, value=array).data
    return builder.gep(data, [i])


def _loads(bits: int) -> Any:
    """Return the code of a load of `bits` bits, at any address, as a uint64."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        at = _place(context, builder, signature.args[0], *arguments)
        value = builder.load(builder.bitcast(at, ir.IntType(bits).as_pointer()))
        value.align = 1
        if sys.byteorder == "big":
            value = builder.bswap(value)
        return builder.zext(value, context.get_value_type(types.uint64)) if bits < 64 else value

    return code


def _stripped(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return `value` of type `kind` without owners."""
    if isinstance(kind, types.Array):
        array = cgutils.create_struct_proxy(kind)(context, builder, value=value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()
    for place, part in enumerate(kind):
        inner = _stripped(context, builder, part, builder.extract_value(value, place))
        value = builder.insert_value(value, inner, place)
    return value
