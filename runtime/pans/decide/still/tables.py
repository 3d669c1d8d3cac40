"""The tables by which kernels decide: label, probability and checksum of click counts; and the tables that leave it to the back end."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.bundle.backends import NO_LABEL, Decider
from pans.decide.plan.plan import Plan

from .kernels import DecisionTables

WORD_FEATURES = 24  # of tables by word: what kernels.py looks up at once


def decision_tables(decider: Decider, shots: int, plan: Plan) -> DecisionTables:
    """Return what decides without asking `decider`: its table, or the leaves of the plan's automaton (empty arrays for any other), and the
    tables of the counts' checksum for K = `shots`.
    """
    n_features = decider.n_features
    labels, probabilities = np.zeros(0, np.uint16), np.zeros(0, np.float32)
    radix = np.zeros(n_features, np.int64)
    found = decider.look_up if decider.automaton is plan.automaton else None
    if found is not None:
        labels, probabilities = finite_labels(found.labels, found.probabilities)
        radix = np.array(found.radix, np.int64)  # writable, always: one type to the compiler
    table, zero = count_crc_tables(n_features, shots * plan.largest)
    by_word = shots == 1 and plan.mode == "parallel" and found is not None and n_features <= WORD_FEATURES
    n_bytes = -(-n_features // 8) if by_word else 0
    word_rows, word_crc = np.zeros((n_bytes, 256), np.int64), np.zeros((n_bytes, 256), np.uint32)
    for feature in range(n_features if n_bytes else 0):
        byte, bit = feature >> 3, feature & 7
        clicked = np.flatnonzero(np.arange(256) >> bit & 1)
        word_rows[byte, clicked] += radix[feature]
        word_crc[byte, clicked] ^= table[0, feature, 1]
    return DecisionTables(labels, probabilities, radix, table, zero, word_rows, word_crc)


def no_tables(n_features: int, most: int) -> DecisionTables:
    """Return tables that know the checksum of counts up to `most` alone."""
    crc = count_crc_tables(n_features, most)
    no_words = np.zeros((0, 256), np.int64), np.zeros((0, 256), np.uint32)
    return DecisionTables(
        np.zeros(0, np.uint16), np.zeros(0, np.float32), np.zeros(n_features, np.int64), *crc, *no_words
    )


def undecided(tables: DecisionTables) -> DecisionTables:
    """Return the same tables, which leave the label to the back end."""
    names = ("labels", "probabilities", "word_rows", "word_crc")
    return tables._replace(**{name: getattr(tables, name)[:0].copy() for name in names})


def finite_labels(
    labels: npt.NDArray[Any], probabilities: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.float32]]:
    """Labels, NO_LABEL where the probability is not above 0, and probabilities, 0.0 there."""
    finite = probabilities > 0
    return np.where(finite, labels, NO_LABEL).astype(np.uint16), np.where(finite, probabilities, np.float32(0.0))


def count_crc_tables(n_features: int, most: int) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32]]:
    """Return what each byte of each count adds (by exclusive or) to the CRC-32 of all counts, int64 up to `most`, and that of zeros."""
    n_bytes = max(1, (most.bit_length() + 7) // 8)
    zeros = bytes(8 * n_features)
    base = zlib.crc32(zeros)
    table = np.zeros((n_bytes, n_features, 256), np.uint32)
    for bit in range(8):  # CRC-32 is linear in the bits: eight of them make all 256 values
        for byte, feature in np.ndindex(n_bytes, n_features):
            data = bytearray(zeros)
            data[8 * feature + byte] = 1 << bit
            table[byte, feature, 1 << bit] = zlib.crc32(data) ^ base
        table[:, :, (1 << bit) + 1 : 2 << bit] = table[:, :, 1 : 1 << bit] ^ table[:, :, 1 << bit, None]
    return table, np.array([base], np.uint32)
