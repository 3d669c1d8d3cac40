"""Sliding windows against sums over all their frames, for any cuts of the stream; gaps, interleaved objects, fixed point."""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import mpmath
import numpy as np
import pytest
from heads import head_bundle, random_layers
from naive_window import sliding_counts

from pans.runtime.core import sliding
from pans.runtime.core.decision import NO_LABEL
from pans.runtime.core.sliding import (
    SlidingCounts,
    SlidingObjects,
    SlidingScores,
    SlidingTable,
    fixed_point,
    log_evidence,
)
from pans.runtime.decide.table import CountTableDecider, TableDecider
from pans.runtime.errors import UsageError


@cache
def table_of(n_features: int, shots: int) -> CountTableDecider | TableDecider:
    bundle = head_bundle(random_layers([n_features, 8, 4], seed=n_features))
    return TableDecider(bundle) if shots == 1 else CountTableDecider(bundle, shots)


def bits_of(words: np.ndarray, n_features: int) -> list[list[int]]:
    return ((words[:, None].astype(int) >> np.arange(n_features)) & 1).tolist()


def pieces(n: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    at = sorted(rng.integers(0, n + 1, 4).tolist())
    return list(zip([0, *at], [*at, n]))


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sliding, "PIECE_FRAMES", 13)


@pytest.mark.uncompiled("3-4")
@pytest.mark.parametrize(("n_features", "shots"), [(3, 1), (10, 1), (3, 4), (9, 2)])
def test_labels_are_those_of_the_counts(n_features: int, shots: int) -> None:
    decider, rng = table_of(n_features, shots), np.random.default_rng(shots)
    words = rng.integers(0, 1 << n_features, 100).astype(np.uint16)
    windows = SlidingTable(decider, shots)
    found = np.concatenate([windows.push(words[a:b]) for a, b in pieces(100, rng)])
    for label, counts in zip(found, sliding_counts(bits_of(words, n_features), shots)):
        assert label == (NO_LABEL if counts is None else decider.decide_batch([counts], shots)[0])


def test_no_window_overlaps_a_gap() -> None:
    decider = table_of(3, 4)
    words = np.random.default_rng(0).integers(0, 8, 40).astype(np.uint16)
    windows = SlidingTable(decider, 4)
    before = windows.push(words[:20])
    windows.restart()
    after = windows.push(words[20:])
    assert (after[:3] == NO_LABEL).all()
    assert (
        np.concatenate([before, after])
        == np.concatenate([SlidingTable(decider, 4).push(w) for w in (words[:20], words[20:])])
    ).all()


@pytest.mark.uncompiled("5")
@pytest.mark.parametrize("shots", [1, 5, 40])
def test_score_sums_are_exact_in_steps(shots: int) -> None:
    rng = np.random.default_rng(shots)
    scores = log_evidence(rng.normal(size=(1024, 10)) * 3)
    words = rng.integers(0, 1024, 150).astype(np.uint16)
    windows = SlidingScores(scores, shots)
    found = np.concatenate([windows.push(words[a:b]) for a, b in pieces(150, rng)])
    whole = windows.table[:, :10].astype(np.int64)
    for end, label in enumerate(found, 1):
        if end < shots:
            assert label == NO_LABEL
        else:
            assert label == whole[words[end - shots : end]].sum(axis=0).argmax()
    assert np.abs(whole * windows.step - scores).max() <= windows.step / 2


def test_a_drop_of_error_never_grows() -> None:
    """After a million frames the sums are still those of the last K frames, to the bit."""
    sliding.PIECE_FRAMES = 1 << 15
    rng = np.random.default_rng(2)
    words = rng.integers(0, 1024, 1_000_000).astype(np.uint16)
    windows = SlidingScores(log_evidence(rng.normal(size=(1024, 10))), 32)
    windows.push(words)
    assert (windows._sums == windows.table[words[-32:]].sum(axis=0)).all()


@pytest.mark.uncompiled("70-4-4", "10-5-2")
@pytest.mark.parametrize(
    ("n_channels", "shots", "stride"), [(1, 3, 1), (10, 5, 2), (64, 255, 7), (70, 4, 4), (130, 9, 13)]
)
def test_counts_of_any_width(n_channels: int, shots: int, stride: int) -> None:
    rng = np.random.default_rng(n_channels)
    frames = rng.integers(0, 2, (300, n_channels), np.uint8)
    words = np.packbits(frames, axis=1, bitorder="little")
    windows = SlidingCounts(n_channels, shots, stride)
    found = [windows.push(words[a:b]) for a, b in pieces(300, rng)]
    counts, whole = (np.concatenate(column) for column in zip(*found))
    wanted = sliding_counts(frames.tolist(), shots)[stride - 1 :: stride]
    assert len(counts) == len(wanted) == 300 // stride
    for row, complete, want in zip(counts.tolist(), whole, wanted):
        assert complete == (want is not None)
        assert want is None or row == want
    windows.restart()
    assert not windows.push(words[: shots - 1])[1].any()


@pytest.mark.uncompiled
def test_interleaved_objects_have_their_own_windows() -> None:
    decider, rng = table_of(3, 4), np.random.default_rng(7)
    words, objects = rng.integers(0, 8, 400).astype(np.uint16), rng.integers(0, 5, 400).astype(np.int32)
    together = SlidingObjects(decider, 4, 5)
    found = np.concatenate([together.push(words[a:b], objects[a:b]) for a, b in pieces(400, rng)])
    for which in range(5):
        assert (found[objects == which] == SlidingTable(decider, 4).push(words[objects == which])).all()
    together.restart(2)
    again = together.push(words[:50], np.full(50, 2, np.int32))
    assert (again == SlidingTable(decider, 4).push(words[:50])).all()
    with pytest.raises(UsageError, match=r"beyond 0\.\.4"):
        together.push(words[:1], np.array([5], np.int32))


def test_log_evidence_against_mpmath() -> None:
    """Worst error over scores up to 700 apart: 2 units in the last place of the largest logarithm."""
    rng = np.random.default_rng(1)
    scores = np.concatenate([rng.normal(size=(50, 10)) * scale for scale in (1e-8, 1.0, 30.0, 300.0)])
    found = log_evidence(scores, floor=1e-300)
    worst = 0.0
    with mpmath.workdps(60):
        for row, logs in zip(scores, found):
            total = mpmath.log(sum(mpmath.exp(mpmath.mpf(float(s))) for s in row))
            for score, log in zip(row, logs):
                exact = max(mpmath.mpf(float(score)) - total, mpmath.log(mpmath.mpf(10) ** -300))
                worst = max(worst, float(abs(exact - mpmath.mpf(float(log))) / max(1, abs(exact))))
    assert worst <= 4.5e-16


def test_fixed_point_sums_stay_within_their_bound_exactly() -> None:
    rng = np.random.default_rng(3)
    scores = log_evidence(rng.normal(size=(64, 5)) * 4)
    for shots in (1, 7, 1000):
        table, step = fixed_point(scores, shots)
        assert np.abs(table.astype(np.int64)).max() * shots < 2**31
        rows = rng.integers(0, 64, shots)
        for k in range(5):
            exact = sum((Fraction(float(scores[r, k])) for r in rows), Fraction(0))
            found = Fraction(int(table[rows, k].astype(np.int64).sum())) * Fraction(step)
            assert abs(found - exact) <= shots * Fraction(step) / 2


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        fixed_point(np.array([[np.inf, 0.0]]), 1)
    with pytest.raises(UsageError, match="rows does not answer"):
        SlidingTable(table_of(3, 4), 3)
    with pytest.raises(UsageError, match="1 to 255"):
        SlidingCounts(4, 256)
    with pytest.raises(UsageError, match="uint16"):
        SlidingTable(table_of(3, 1), 1).push(np.zeros(3, np.int64))  # type: ignore[arg-type]
