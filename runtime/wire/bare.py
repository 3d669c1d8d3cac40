"""What kernels need and numba has not: arrays without a count of references, a float32 from its bits.

Owns two intrinsics. A kernel that takes an array out of a tuple counts a reference, and again when it lets go: two locked additions each
time, which for a block of one exposure added up to most of its time. A bare array owns nothing and counts nothing; its memory must
outlive the call, as the arguments of a call do.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

if numba.config.DISABLE_JIT:

    def bare(value: Any) -> Any:
        """Return `value`."""
        return value

    def as_float32(bits: Any) -> Any:
        """Return the float32 whose bits are the low 32 of `bits`."""
        return np.uint32(bits).view(np.float32)

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
