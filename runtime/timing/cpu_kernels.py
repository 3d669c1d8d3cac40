"""The compiled spin of cpu.py: a loop that waits, with the processor's hint for such loops, until a number in memory changes.

Owns one instruction; keeps no state and allocates nothing.
"""

from __future__ import annotations

import platform
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

_X86 = platform.machine() in ("x86_64", "AMD64")


@intrinsic
def _pause(typing_context: Any) -> Any:
    """The processor's hint that a loop waits; memory counts as changed, so that the loop looks at it again."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if _X86:
            kind = ir.FunctionType(ir.VoidType(), [])
            builder.call(builder.module.declare_intrinsic("llvm.x86.sse2.pause", (), kind), [])
        else:
            builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


@njit(cache=True, nogil=True)
def spin(ended):  # type: ignore[no-untyped-def]
    """Wait until ended[0], int64, is not 0."""
    while ended[0] == 0:
        _pause()
