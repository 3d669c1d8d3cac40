"""Numbered decisions in plain words: whole rows, one after the other, and numbered decisions made at random."""

from __future__ import annotations

from typing import Any

import numpy as np

from pans.runtime.core.decision import DECISION_DTYPE, RUN_DTYPE, VERDICT_DTYPE, VERDICT_FIELDS, NumberedDecisions


def all_rows(verdicts: np.ndarray, numbers: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """The rows that numbered decisions stand for."""
    rows: list[tuple[Any, ...]] = []
    while len(rows) < len(numbers):
        run = runs[len(rows)]
        for k in range(int(run["count"])):
            verdict = verdicts[numbers[len(rows)]]
            places = [int(run[name]) + k * int(run[step]) for name, step in STEPS]
            clicks, label, flags, probability, checksum = (verdict[name].item() for name in VERDICT_FIELDS)
            index, tick, exposure, shot = int(run["index"]) + k, *places
            head = (index % 2**64, tick % 2**64, exposure % 2**64, int(run["object"]), shot % 2**32, clicks, label)
            rows.append((*head, int(run["truth"]), flags, probability, checksum, 0))
    return np.array(rows, DECISION_DTYPE)


STEPS = (("tick", "tick_step"), ("exposure_index", "exposure_step"), ("shot", "shot_step"))


def made(verdicts: np.ndarray, numbers: np.ndarray, runs: list[tuple[Any, ...]]) -> NumberedDecisions:
    """Numbered decisions of `runs`, the tuples of RUN_DTYPE; what stands between two runs is no run at all."""
    table = np.full(len(numbers), 0xAB, RUN_DTYPE)
    at = 0
    for run in runs:
        table[at] = run
        at += run[5]
    assert at == len(numbers)
    rows = all_rows(verdicts, numbers, table)
    return NumberedDecisions(verdicts, numbers, table, lambda first, stop: rows[first:stop])


def some_verdicts(rng: np.random.Generator, n: int, labels: int) -> np.ndarray:
    """Verdicts of which some are the same as others, and some abstain."""
    verdicts: np.ndarray = np.zeros(n, VERDICT_DTYPE)
    kind = rng.integers(0, max(1, 3 * n // 4), n)
    verdicts["clicks"], verdicts["label"] = kind % 11, np.where(kind % 7 == 3, 0xFFFF, kind % labels)
    verdicts["flags"] = np.where(kind % 7 == 3, np.where(kind % 2 == 1, 8 | 256, 8 | 64), 0)
    verdicts["probability"], verdicts["counts_crc"] = 1 / (1 + kind), kind * 2654435761 % 2**32
    return verdicts
