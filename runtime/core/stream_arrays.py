"""What the compiled kernel of the core works on, as tuples of arrays: tables that decide, marks, a block, all of a walk through a stream.

Owns the shapes alone; stream_kernels.py fills and reads them, bulk_steps.py allocates them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .window_kernels import WindowArrays


class DecisionTables(NamedTuple):
    """From clicks per pattern to label, probability and checksum; without `labels` (size 0) the counts go to `counts_out`.

    A label NO_LABEL abstains: its probability is below what was asked for, or 0 where the scores were not finite. `radix` int64 (d_f,):
    the row of a table is the sum of counts * radix; of an automaton it is the leaf. `crc` uint32 (bytes of a count, d_f, 256) and
    `crc_zero` uint32 (1,): CRC-32 is affine, so that the checksum of all counts is that of zeros, exclusive-or one entry per byte. For
    K = 1 with a table, `word_rows` int64 and `word_crc` uint32 (1 to 3 bytes of a word, 256) say the same of a byte of the click word;
    else they are empty.
    """

    labels: npt.NDArray[np.uint16]
    probabilities: npt.NDArray[np.float32]
    radix: npt.NDArray[np.int64]
    crc: npt.NDArray[np.uint32]
    crc_zero: npt.NDArray[np.uint32]
    word_rows: npt.NDArray[np.int64]
    word_crc: npt.NDArray[np.uint32]


class MarkArrays(NamedTuple):
    """The latest object numbers, truths and photons by object modulo MARK_SLOTS; int64, int16, float32 (MARK_SLOTS,)."""

    objects: npt.NDArray[np.int64]
    truths: npt.NDArray[np.int16]
    photons: npt.NDArray[np.float32]


class Block(NamedTuple):
    """An accepted block: its frames (of CLICKS: exposures) from `at` on in the buffer, from exposure `first`, `relative` in the visit, on.

    `end_tick` is that of the first exposure's end. `truth` is that of `object`, -1 where it is not known. `top_mask` are the bits of the
    last byte of a word that are channels.
    """

    frames: np.integer[Any]
    word_bytes: np.integer[Any]
    at: np.integer[Any]
    first: np.integer[Any]
    relative: np.integer[Any]
    end_tick: np.integer[Any]
    period_ticks: np.integer[Any]
    object: np.integer[Any]
    truth: np.integer[Any]
    top_mask: np.integer[Any]


class WalkArrays(NamedTuple):
    """What `take_clicks` continues: state int64 (N_STATE,), marks, windows, tables, rows DECISION_DTYPE (m,), counts int64 (m, d_f).

    `heard` is StreamTracker's: whoever calls the kernel fills it.
    """

    state: npt.NDArray[np.int64]
    marks: MarkArrays
    windows: WindowArrays
    tables: DecisionTables
    rows: npt.NDArray[np.void]
    counts: npt.NDArray[np.int64]
    heard: npt.NDArray[np.int64]


class FrameWalkArrays(WalkArrays):
    """The same of a stream of frames, for `take_frames`: the kernel is compiled for one of the two."""


class IdleArrays(NamedTuple):
    """What the kernel has of a core that takes every message itself: state int64 (N_STATE,), rows DECISION_DTYPE (1,), `heard`."""

    state: npt.NDArray[np.int64]
    rows: npt.NDArray[np.void]
    heard: npt.NDArray[np.int64]
