"""What decisions add up to, with both spreads kept apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numbered_rows import made, some_verdicts

from pans.runtime.core.decision import DECISION_DTYPE, NO_LABEL, Decision, DecisionFlag, RowDecisions
from pans.runtime.core.stream_arrays import MarkArrays
from pans.runtime.core.stream_kernels import MARK_SLOTS
from pans.runtime.live.tally import RunTally

NAN = float("nan")


def decision(obj: int, trial: int, label: int, truth: int, clicks: int = 4, flags: int = 0) -> Decision:
    return Decision(0, 0, 0, obj, trial, clicks, label, truth, flags, 0.9, 0)


def test_spreads_over_trials_and_objects_are_different_things() -> None:
    right = np.array([[1, 1, 0], [1, 0, 0], [1, 1, 1], [0, 0, 0]])  # objects x trials
    tally = RunTally(2, 1)
    for obj, row in enumerate(right):
        for trial, value in enumerate(row):
            tally.add(decision(obj, trial, 1 if value else 0, 1), 6.0)
    summary = tally.figures()
    assert summary.accuracy == pytest.approx(right.mean())
    assert summary.accuracy_std_trials == pytest.approx(right.mean(axis=0).std(ddof=1))
    assert summary.accuracy_stderr_objects == pytest.approx(right.mean(axis=1).std(ddof=1) / 2)
    assert (summary.objects, summary.trials, summary.decisions) == (4, 3, 12)
    assert (summary.clicks_mean, summary.photons_mean) == (4.0, 6.0)
    assert tally.confusion.tolist() == [[0, 0], [6, 6]]


def test_an_abstention_is_not_right_and_stands_in_no_column() -> None:
    tally = RunTally(2, 1)
    tally.add(decision(0, 0, 1, 1), NAN)
    tally.add(decision(0, 1, NO_LABEL, 1, flags=int(DecisionFlag.ABSTAINED | DecisionFlag.GAP)), NAN)
    assert tally.accuracy == 0.5
    assert tally.abstained == 1
    assert tally.confusion.sum() == 1
    assert tally.figures().photons_mean is None


def test_without_truth_there_is_no_accuracy() -> None:
    tally = RunTally(2, 2)
    tally.add(decision(0, 0, 1, -1), 3.0)
    summary = tally.figures()
    assert summary.accuracy is None
    assert summary.accuracy_std_trials is None
    assert summary.photons_mean == 6.0  # two shots of three photons each


def test_any_number_of_objects_fits_and_changes_no_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    right = rng.random((500, 4)) < rng.random((500, 1))
    summaries = []
    for most in (1 << 14, 7):
        monkeypatch.setattr("pans.runtime.live.tally.MAX_OBJECTS", most)
        tally = RunTally(2, 1)
        for obj, row in enumerate(right):
            for trial, value in enumerate(row):
                tally.add(decision(obj, trial, 1 if value else 0, 1), 6.0)
        assert len(tally._objects) <= most
        summaries.append(tally.figures())
    whole, summed = summaries
    assert summed.objects == 500
    assert summed.accuracy_stderr_objects == pytest.approx(whole.accuracy_stderr_objects, rel=1e-12)
    assert replace(summed, accuracy_stderr_objects=whole.accuracy_stderr_objects) == whole


def test_an_object_that_is_shown_again_is_the_same_object() -> None:
    rng = np.random.default_rng(2)
    right = rng.random((4, 10)) < 0.7  # four showings of each of ten objects
    tally = RunTally(2, 1, distinct=10)
    for number, value in enumerate(right.ravel()):
        tally.add(decision(number, 0, int(value), 1), 1.0)
    summary = tally.figures()
    assert (summary.objects, summary.decisions) == (10, 40)
    assert summary.accuracy_stderr_objects == pytest.approx(right.mean(axis=0).std(ddof=1) / np.sqrt(10))


def test_decisions_in_rows_count_as_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "pans.runtime.live.tally.RUNS_AT_ONCE", 16
    )  # more objects than that, and more trials than there is room for
    rng = np.random.default_rng(3)
    n, shots = 3000, 3
    rows = np.zeros(n, DECISION_DTYPE)
    rows["object"] = np.sort(rng.integers(0, 90, n))
    rows["shot"] = rng.integers(0, 400, n) * shots
    rows["clicks"], rows["exposures"] = rng.integers(0, 30, n), rng.integers(0, 5, n)
    rows["label"] = np.where(rng.random(n) < 0.1, NO_LABEL, rng.integers(0, 4, n))
    rows["truth"] = rows["object"].astype(np.int16) % 6 - 1  # -1: unknown; 4: no class of these
    rows["flags"] = rng.choice(
        [0, int(DecisionFlag.ABSTAINED), int(DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED)], n
    )
    photons = rng.random(MARK_SLOTS).astype(np.float32)
    photons[::7] = np.nan
    objects = np.where(np.arange(MARK_SLOTS) % 5 > 0, np.arange(MARK_SLOTS), -1)
    one, many = RunTally(4, shots, distinct=50), RunTally(4, shots, distinct=50)
    many.warm_up(MarkArrays(objects, np.zeros(MARK_SLOTS, np.int16), photons), 2)
    for row in rows.tolist():
        known = objects[row[3]] == row[3]
        one.add(Decision(*row), float(photons[row[3]]) if known else NAN)
    for part in np.split(rows, [700, 701, 2000]):
        many.add_many(RowDecisions(part), MarkArrays(objects, np.zeros(MARK_SLOTS, np.int16), photons))
    assert many.figures() == one.figures()
    assert many.confusion.tolist() == one.confusion.tolist()
    assert (many.unsure, many.exposures, many.known, many.right) == (one.unsure, one.exposures, one.known, one.right)


def test_numbered_decisions_count_as_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pans.runtime.live.tally.RUNS_AT_ONCE", 16)
    rng, shots = np.random.default_rng(4), 2
    verdicts = some_verdicts(rng, 40, 4)
    photons = rng.random(MARK_SLOTS).astype(np.float32)
    photons[::7] = np.nan
    marks = MarkArrays(
        np.where(np.arange(MARK_SLOTS) % 5 > 0, np.arange(MARK_SLOTS), -1), np.zeros(0, np.int16), photons
    )
    one, many = RunTally(4, shots, distinct=50), RunTally(4, shots, distinct=50)
    index = 0
    for _ in range(3):
        runs = []
        for number in np.sort(rng.integers(0, 90, 60)).tolist():
            count, shot = int(rng.integers(1, 300)), int(rng.integers(0, 50)) * shots
            runs.append((index, 0, 0, number, shot, count, 1, 1, shots, number % 6 - 1, 0))
            index += count
        n = sum(run[5] for run in runs)
        decided = made(verdicts, rng.integers(0, 40, n).astype(np.uint32), runs)
        if not many.decisions:
            many.warm_up(marks, 2, decided)
            many = RunTally(4, shots, distinct=50)
        many.add_many(decided, marks)
        for row in decided.rows.tolist():
            one.add(Decision(*row), float(photons[row[3]]) if marks.objects[row[3]] == row[3] else NAN)
    assert many.figures() == one.figures()
    assert many.confusion.tolist() == one.confusion.tolist()
    assert 0 < many.unsure < many.abstained
    assert (many.unsure, many.exposures, many.known, many.right) == (one.unsure, one.exposures, one.known, one.right)
