"""A table of up to 1024 labels held in vector registers: 64 click words are looked up at once, where the processor can.

Owns the one loop that numba's language cannot say: byte permutations of AVX-512 VBMI, written down for LLVM by hand. It gives what
`decide_kernels.label_checked_words` gives, for words that are good. `AVAILABLE` says whether this processor has the instructions:
only then may it be called.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

ENTRIES = 1024  # labels that fit into 16 registers of 64 bytes
STEP = 64  # words at once
_PERMUTE = "llvm.x86.avx512.vpermi2var.qi.512"  # the 64 bytes of 128 that 7-bit numbers name
_BYTES = ir.VectorType(ir.IntType(8), STEP)


def _available() -> bool:
    try:
        features = llvmlite.binding.get_host_cpu_features()
    except RuntimeError:  # a processor that LLVM does not know
        return False
    return bool(features.get("avx512vbmi") and features.get("avx512bw") and features.get("avx512vl"))


AVAILABLE = _available()


@intrinsic
def _look_up(typingctx: Any, table: Any, words: Any, out: Any, stop: Any) -> Any:
    """out[i] = table[words[i]] for 0 <= i < stop, a multiple of STEP; returns all words or-ed together, as uint64.

    table uint8 (ENTRIES,), words unsigned, out uint8, all contiguous. A word beyond the table reads nothing beyond it.
    """
    signature = types.uint64(table, words, out, types.intp)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        table_at, words_at, out_at = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in range(3))
        stop_at, number = args[3], args[3].type
        word = ir.VectorType(words_at.type.pointee, STEP)
        starts = [ir.Constant(number, STEP * k) for k in range(ENTRIES // STEP)]
        registers = [_load(builder, table_at, start, _BYTES) for start in starts]
        permute = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_BYTES, [_BYTES] * 3), _PERMUTE)
        seen = cgutils.alloca_once_value(builder, _splat(word, 0))
        with cgutils.for_range_slice(builder, starts[0], stop_at, starts[1], inc=True) as (index, _):
            wide = _load(builder, words_at, index, word)
            builder.store(builder.or_(builder.load(seen), wide), seen)
            low = builder.trunc(wide, _BYTES)
            high = builder.trunc(builder.lshr(wide, _splat(word, 7)), _BYTES)
            found = [builder.call(permute, [registers[k], low, registers[k + 1]]) for k in range(0, len(registers), 2)]
            for bit in (1, 2, 4):
                chosen = builder.icmp_unsigned("!=", builder.and_(high, _splat(_BYTES, bit)), _splat(_BYTES, 0))
                found = [builder.select(chosen, found[k + 1], found[k]) for k in range(0, len(found), 2)]
            place = builder.bitcast(builder.gep(out_at, [index]), _BYTES.as_pointer())
            builder.store(found[0], place, align=1)
        name = f"llvm.vector.reduce.or.v{STEP}i{word.element.width}"
        reduce = cgutils.get_or_insert_function(builder.module, ir.FunctionType(word.element, [word]), name)
        result = builder.call(reduce, [builder.load(seen)])
        return result if word.element.width == 64 else builder.zext(result, ir.IntType(64))

    return signature, codegen


def _load(builder: Any, base: Any, index: Any, vector: Any) -> Any:
    return builder.load(builder.bitcast(builder.gep(base, [index]), vector.as_pointer()), align=1)


def _splat(vector: Any, value: int) -> Any:
    return ir.Constant(vector, [value] * vector.count)


@njit(cache=True, nogil=True)
def label_words_in_registers(table, size, words, out):  # type: ignore[no-untyped-def]
    """Write table[words[i]] to out[i]; return -1, or the first i whose word is not below `size` (`out` is then of no use from there on).

    table uint8 (ENTRIES,), of which `size` are in use, a power of two; out uint8 (n,), words uint16, uint32 or uint64 (n,), all contiguous.
    """
    whole = words.size // STEP * STEP
    seen = _look_up(table, words, out, whole)
    for i in range(whole, words.size):
        seen |= np.uint64(words[i])
        out[i] = table[words[i] & np.uint64(ENTRIES - 1)]
    if seen >= np.uint64(size):
        for i in range(words.size):
            if np.uint64(words[i]) >= np.uint64(size):
                return i
    return -1
