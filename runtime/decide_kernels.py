"""The compiled kernel of the table back end: click words in, labels out.

Owns the loop over words; never allocates and never judges. Imported only where many words are decided at once: a single
decision is one look-up and must not pay for numba.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def label_words(labels: NDArray[Any], words: NDArray[Any], out: NDArray[Any]) -> int:
    """Write labels[words[i]] to out[i]; return -1, or the first i whose word is beyond the table (the rest is untouched).

    labels (2**d_f,) and out (n,) share uint8 or uint16; words (n,) is uint32 or uint64.
    """
    size = np.uint64(labels.size)
    for i in range(words.size):
        word = np.uint64(words[i])
        if word >= size:
            return i
        out[i] = labels[word]
    return -1


def warm_up(label_dtype: Any = np.uint8, word_dtype: Any = np.uint64) -> None:
    """Compile (or load from the cache) the kernel for these dtypes, so that no deadline pays for it."""
    label_words(np.zeros(2, dtype=label_dtype), np.zeros(1, dtype=word_dtype), np.zeros(1, dtype=label_dtype))
