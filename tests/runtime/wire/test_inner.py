"""Bytes as numbers in kernels, and kernels that kernels alone call."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numba import njit

from pans.runtime.wire.bare import as_float32, copy_span, load4, load8
from pans.runtime.wire.inner import TRIED, inner

U = np.uint64


@inner
def _tripled(x):  # type: ignore[no-untyped-def]
    return 3 * x


@njit(nogil=True)
def _through(data, source, out):  # type: ignore[no-untyped-def]
    """Numbers of `data` to `out`, and three bytes of `data` moved by one within it, and four of `source` behind them."""
    out[0], out[1] = load8(data, U(1)), load4(data, U(2))
    out[2] = _tripled(out[1])
    copy_span(data, U(3), U(6), data, U(4))
    copy_span(source, U(1), U(5), data, U(7))
    copy_span(source, U(1), U(1), data, U(0))
    return as_float32(U(0x1_3F800000))


@pytest.mark.uncompiled
def test_bytes_are_numbers_and_are_copied() -> None:
    rng = np.random.default_rng(5)
    data, source = rng.integers(0, 256, (2, 11)).astype(np.uint8)
    before, out = bytes(data), np.zeros(3, np.uint64)
    one = _through(data, source, out)
    four = int.from_bytes(before[2:6], "little")
    assert out.tolist() == [int.from_bytes(before[1:9], "little"), four, 3 * four]
    assert bytes(data) == before[:4] + before[3:6] + bytes(source[1:5])
    assert one == 1.0


@pytest.mark.skipif(numba.version_info.short not in TRIED, reason="compiled as all others with this version of numba")
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="without the compiler it is Python's")
def test_an_inner_kernel_is_not_called_from_python() -> None:
    with pytest.raises(TypeError):
        _tripled(2)
