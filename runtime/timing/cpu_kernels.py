"""The compiled spin of cpu.py: a loop that waits, with the processor's hint for such loops, until a number in memory changes.

Owns one instruction; keeps no state and allocates nothing.
"""

from __future__ import annotations

import platform
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pans.runtime.wire.inner import outer

ENDED, SPINS = 0, 1  # places in the state of a spin
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


@outer
def spin(state):  # type: ignore[no-untyped-def]
    """Wait until state[ENDED], int64, is not 0; state[SPINS] is 1 from the beginning on."""
    state[SPINS] = 1
    while state[ENDED] == 0:
        _pause()
