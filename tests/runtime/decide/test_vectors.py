"""The look-up in vector registers gives what the plain one gives, for every word, width and length."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pans.runtime.decide import vectors as decide_vectors
from pans.runtime.decide.table import words_kernel


@pytest.mark.parametrize("dtype", [np.uint16, np.uint32, np.uint64])
@pytest.mark.parametrize("available", [True, False])
def test_every_word_and_every_length(dtype: Any, available: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decide_vectors, "AVAILABLE", available and decide_vectors.AVAILABLE)
    rng = np.random.default_rng(1)
    for d_f in (1, 7, 8, 10, 11):
        labels = rng.integers(0, 256, 1 << d_f).astype(np.uint8)
        label = words_kernel(labels)
        for n in (0, 1, 63, 64, 65, 200, 3000):
            words = rng.permutation(np.arange(n) % len(labels)).astype(dtype)
            out = np.full(n + 2, 255, np.uint8)
            assert label(words, out[1:-1]) == -1
            assert out[1 : n + 1].tolist() == labels[words].tolist()
            assert out[0] == out[-1] == 255  # nothing before or behind
        words = np.zeros(500, dtype)
        for bad in (len(labels), np.iinfo(dtype).max):
            for place in (0, 70, 499):
                spoilt = words.copy()
                spoilt[place:] = bad
                assert label(spoilt, np.zeros(500, np.uint8)) == place
        wide = np.repeat(rng.integers(0, len(labels), 100), 2).astype(dtype)
        out = np.zeros(100, np.uint8)
        assert label(wide[::2], out) == -1  # with gaps between them
        assert out.tolist() == labels[wide[::2]].tolist()
