"""Arrays and tuples of arrays inside a kernel without a count of references.

Owns one intrinsic. A kernel that takes an array out of a tuple counts a reference, and again when it lets go: two locked additions each
time, which for a block of one exposure added up to most of its time. A bare array owns nothing and counts nothing; its memory must
outlive the call, as the arguments of a call do.
"""

from __future__ import annotations

from typing import Any

import numba
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

if numba.config.DISABLE_JIT:

    def bare(value: Any) -> Any:
        """Return `value`."""
        return value

else:

    @intrinsic
    def bare(typing_context, value):  # type: ignore[no-untyped-def]
        """`value`, an array or a tuple of arrays and of such tuples, whose arrays count no references."""

        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            return _stripped(context, builder, signature.args[0], arguments[0])

        return value(value), code


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
