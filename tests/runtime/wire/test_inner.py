"""Bytes as numbers in kernels, and kernels that kernels alone call."""

from __future__ import annotations

import importlib.util
import os
import re
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import njit
from tree import ROOT

from pans.runtime.wire import inner as wire_inner
from pans.runtime.wire.bare import as_float32, copy_span, load4, load8
from pans.runtime.wire.inner import SOURCES, TRIED, digest_of, inner

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


KERNEL = """
from pans.runtime.wire.inner import outer

@outer
def doubled(x):
    return 2 * x
"""


@pytest.mark.skipif(numba.version_info.short not in TRIED, reason="cached as all others with this version of numba")
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is cached")
def test_a_cached_kernel_is_for_the_files_that_kernels_are_made_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "made.py").write_text(KERNEL)
    found = []
    for digest in ("as it is", "as it is", "changed", "as it is"):
        monkeypatch.setattr(wire_inner, "digest_of", lambda runtime, digest=digest: digest)
        spec = importlib.util.spec_from_file_location("made", tmp_path / "made.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        assert module.doubled(4) == 8
        found.append(sum(module.doubled.stats.cache_hits.values()))
    assert found == [0, 1, 0, 0]


def test_the_digest_is_of_every_file_of_the_packages(tmp_path: Path) -> None:
    for package in SOURCES:
        (tmp_path / package).mkdir()
        (tmp_path / package / "kernels.py").write_text("x = 1")
    first, last = (tmp_path / package for package in (SOURCES[0], SOURCES[-1]))
    changes: list[Callable[[], object]] = [
        lambda: (last / "kernels.py").write_text("x = 12"),
        lambda: os.utime(first / "kernels.py", ns=(1, 1)),
        lambda: (first / "more.py").touch(),
        lambda: (first / "notes.txt").touch(),
    ]
    digests = [digest_of.__wrapped__(tmp_path)]
    for change in changes:
        change()
        digests.append(digest_of.__wrapped__(tmp_path))
    assert (len(set(digests)), digests[-1]) == (4, digests[-2])


def test_with_another_numba_kernels_are_ordinary_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire_inner, "TRIED", ())
    kernels = [decorate(lambda x: 3 * x) for decorate in (wire_inner.inner, wire_inner.outer)]
    assert [kernel(2) for kernel in kernels] == [6, 6]


def test_the_numba_that_is_installed_with_the_package_was_tried() -> None:
    (pinned,) = re.findall(r"^numba==(\d+)\.(\d+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert tuple(map(int, pinned)) in TRIED
    (least,) = re.findall(r'"numba>=(\d+)\.(\d+)"', (ROOT / "pyproject.toml").read_text())
    assert tuple(map(int, least)) <= min(TRIED)
