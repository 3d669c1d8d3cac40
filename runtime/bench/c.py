"""The same loops in C, compiled when a benchmark runs: what our kernels are measured against.

Owns the source and the call of the compiler; never part of a run. `c_loops` returns a `CLoops`, or a word that says why there is none.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")
# The freedom to reorder sums, which our kernel takes too. Its parts are named one by one: linked as a whole, -ffast-math makes the
# library switch subnormal numbers off for the whole process that loads it.
FREE_FLAGS = (
    *FLAGS,
    "-fassociative-math",
    "-fno-signed-zeros",
    "-fno-trapping-math",
    "-ffinite-math-only",
    "-fno-math-errno",
    "-freciprocal-math",
)
SOURCE = r"""
#include <stdint.h>
#include <math.h>

static void dots(const float *restrict w, const float *restrict x, int64_t n_in, int64_t n_out, float *restrict out) {
    for (int64_t k = 0; k < n_out; k += 2) {
        const float *p = w + k * n_in, *q = p + n_in;
        float a = 0, b = 0;
        for (int64_t j = 0; j < n_in; j++) { a += x[j] * p[j]; b += x[j] * q[j]; }
        out[k] += a; out[k + 1] += b;
    }
}

static void win(const float *scores, int64_t classes, uint16_t *label, float *probability) {
    int64_t best = 0;
    double total = 0;
    for (int64_t k = 1; k < classes; k++) if (scores[k] > scores[best]) best = k;
    for (int64_t k = 0; k < classes; k++) total += exp((double)scores[k] - (double)scores[best]);
    *label = (uint16_t)best;
    *probability = (float)(1 / total);
}

/* Single shots as the kernel has them: a row for each group of patterns, two groups at a time; `bits` patterns a group, at `tables`. */
static int64_t group_row(const int64_t *counts, int64_t d_f, int64_t bits, int64_t *feature, int64_t *at, int64_t width) {
    int64_t word = 0, size = d_f - *feature < bits ? d_f - *feature : bits, here;
    for (int64_t k = 0; k < size; k++) word |= counts[*feature + k] << k;
    here = *at + word * width;
    *feature += size; *at += width << size;
    return here;
}

void sparse_groups(const int64_t *counts, int64_t n, int64_t d_f, int64_t h, int64_t c, int64_t classes, int64_t bits,
                   int64_t tables, const float *numbers, float *restrict hidden, float *scores,
                   uint16_t *labels, float *probabilities) {
    const float *w2 = numbers + d_f * h, *b2 = w2 + h * c + h;
    for (int64_t i = 0; i < n; i++) {
        int64_t feature = 0, at = tables, first = 1;
        while (feature < d_f) {
            const float *p = numbers + group_row(counts + i * d_f, d_f, bits, &feature, &at, h);
            const float *q = numbers + group_row(counts + i * d_f, d_f, bits, &feature, &at, h);
            if (first) for (int64_t j = 0; j < h; j++) hidden[j] = p[j] + q[j];
            else for (int64_t j = 0; j < h; j++) hidden[j] += p[j] + q[j];
            first = 0;
        }
        for (int64_t j = 0; j < h; j++) hidden[j] = hidden[j] < 0 ? 0 : hidden[j];
        for (int64_t j = 0; j < c; j++) scores[j] = b2[j];
        dots(w2, hidden, h, c, scores);
        win(scores, classes, labels + i, probabilities + i);
    }
}

/* The loop as one would write it down: a column at a time, then a row at a time. */
void sparse_plain(const int64_t *counts, int64_t n, int64_t d_f, int64_t h, int64_t c, int64_t classes,
                  const float *numbers, float *restrict hidden, float *restrict scores,
                  uint16_t *labels, float *probabilities) {
    const float *w1 = numbers, *w2 = numbers + d_f * h, *b1 = w2 + h * c, *b2 = b1 + h;
    for (int64_t i = 0; i < n; i++) {
        for (int64_t j = 0; j < h; j++) hidden[j] = b1[j];
        for (int64_t k = 0; k < d_f; k++) {
            float f = (float)counts[i * d_f + k];
            if (f != 0) for (int64_t j = 0; j < h; j++) hidden[j] += f * w1[k * h + j];
        }
        for (int64_t j = 0; j < c; j++) scores[j] = b2[j];
        for (int64_t j = 0; j < h; j++) {
            float x = hidden[j] < 0 ? 0 : hidden[j];
            for (int64_t k = 0; k < c; k++) scores[k] += x * w2[k * h + j];
        }
        win(scores, classes, labels + i, probabilities + i);
    }
}
"""


@dataclass(frozen=True, slots=True)
class CLoops:
    """The compiled loops; `compiler` says with what."""

    library: ctypes.CDLL
    compiler: str

    def sparse(self, loop: str, counts: NDArray[np.int64], meta: NDArray[np.int64], numbers: NDArray[np.float32],
               n_classes: int) -> NDArray[np.uint16]:  # fmt: skip
        """Decide single shots (n, d_f) with a head of two layers, padded as decide_mlp pads it; `loop` is one of the sparse_ functions."""
        n_features, hidden, columns = meta[1:4].tolist()
        labels, probabilities = np.empty(len(counts), np.uint16), np.empty(len(counts), np.float32)
        work = np.zeros((2, hidden + columns), np.float32)
        sizes = [ctypes.c_int64(n) for n in (len(counts), n_features, hidden, columns, n_classes)]
        sizes += [ctypes.c_int64(n) for n in meta[-2:].tolist()] if loop == "sparse_groups" else []
        arrays = [_at(a) for a in (numbers, work[0], work[1], labels, probabilities)]
        getattr(self.library, loop)(_at(counts), *sizes, *arrays)
        return labels


def c_loops(flags: tuple[str, ...] = FLAGS) -> CLoops | str:
    """Compile the loops with the system's C compiler; a word of explanation where that is not possible."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return "no C compiler (gcc or cc) on this machine: rows in C are left out"
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "loops.c", Path(folder) / "loops.so"
        source.write_text(SOURCE)
        done = subprocess.run(
            [compiler, *flags, "-o", str(library), str(source), "-lm"], capture_output=True, text=True
        )
        if done.returncode:
            return f"{compiler} failed: {done.stderr.strip().splitlines()[-1:]}: rows in C are left out"
        version = subprocess.run([compiler, "--version"], capture_output=True, text=True).stdout.splitlines()[0]
        try:
            return CLoops(
                ctypes.CDLL(str(library)),
                f"{version}, {' '.join(flag for flag in flags if flag not in ('-shared', '-fPIC'))}",
            )
        except OSError as error:
            return f"the compiled loops cannot be loaded ({error}): rows in C are left out"


def _at(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
