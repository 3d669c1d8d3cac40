"""What decisions add up to, with both spreads kept apart."""

from dataclasses import replace

import numpy as np
import pytest

from pans.bundle.backends import NO_LABEL
from pans.decide.decision import DECISION_DTYPE, Decision, DecisionFlag
from pans.live.tally import RunTally

NAN = float("nan")


def decision(obj: int, trial: int, label: int, truth: int, clicks: int = 4, flags: int = 0) -> Decision:
    return Decision(0, 0, 0, obj, trial, clicks, label, truth, flags, 0.9, 0)


def add(tally: RunTally, one: Decision, photons: float) -> None:
    tally.add_rows(np.array([one], DECISION_DTYPE), lambda numbers: np.full(len(numbers), photons, np.float32))


def test_spreads_over_trials_and_objects_are_different_things() -> None:
    right = np.array([[1, 1, 0], [1, 0, 0], [1, 1, 1], [0, 0, 0]])  # objects x trials
    tally = RunTally(2, 1)
    for obj, row in enumerate(right):
        for trial, value in enumerate(row):
            add(tally, decision(obj, trial, 1 if value else 0, 1), 6.0)
    summary = tally.figures()
    assert summary.accuracy == pytest.approx(right.mean())
    assert summary.accuracy_std_trials == pytest.approx(right.mean(axis=0).std(ddof=1))
    assert summary.accuracy_stderr_objects == pytest.approx(right.mean(axis=1).std(ddof=1) / 2)
    assert (summary.objects, summary.trials, summary.decisions) == (4, 3, 12)
    assert (summary.clicks_mean, summary.photons_mean) == (4.0, 6.0)
    assert tally.confusion.tolist() == [[0, 0], [6, 6]]


def test_accuracy_and_light_are_of_the_same_decisions() -> None:
    tally, abstained = RunTally(2, 1), int(DecisionFlag.ABSTAINED | DecisionFlag.GAP)
    add(tally, decision(0, 0, 1, 1, clicks=6), 4.0)
    add(tally, decision(0, 1, NO_LABEL, 1, clicks=1, flags=abstained), 100.0)
    add(tally, decision(1, 0, 0, -1, clicks=9), 100.0)  # decided, of no known class
    found = tally.figures()
    assert (found.decisions, found.decided, found.judged, found.abstained) == (3, 2, 1, 1)
    assert (found.accuracy, found.clicks_mean, found.photons_mean, found.photons_known) == (1.0, 6.0, 4.0, 1)
    assert set(found.figures_of.values()) == {"judged"}
    assert tally.confusion.sum() == 1


def test_without_a_known_class_the_light_is_that_of_what_was_decided() -> None:
    tally, abstained = RunTally(2, 1), int(DecisionFlag.ABSTAINED)
    add(tally, decision(0, 0, NO_LABEL, -1, clicks=1, flags=abstained), NAN)
    assert (tally.figures().clicks_mean, tally.figures().figures_of["clicks_mean"]) == (1.0, "decisions")
    add(tally, decision(1, 0, 1, -1, clicks=7), NAN)
    found = tally.figures()
    assert (found.accuracy, found.clicks_mean, found.photons_mean) == (None, 7.0, None)
    assert found.figures_of["clicks_mean"] == "decided"


def test_without_truth_there_is_no_accuracy() -> None:
    tally = RunTally(2, 2)
    add(tally, decision(0, 0, 1, -1), 3.0)
    summary = tally.figures()
    assert summary.accuracy is None
    assert summary.accuracy_std_trials is None
    assert summary.photons_mean == 6.0  # two shots of three photons each


def test_any_number_of_objects_fits_and_changes_no_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    right = rng.random((500, 4)) < rng.random((500, 1))
    summaries = []
    for most in (1 << 14, 7):
        monkeypatch.setattr("pans.live.tally.MAX_OBJECTS", most)
        tally = RunTally(2, 1)
        for obj, row in enumerate(right):
            for trial, value in enumerate(row):
                add(tally, decision(obj, trial, 1 if value else 0, 1), 6.0)
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
        add(tally, decision(number, 0, int(value), 1), 1.0)
    summary = tally.figures()
    assert (summary.objects, summary.decisions) == (10, 40)
    assert summary.accuracy_stderr_objects == pytest.approx(right.mean(axis=0).std(ddof=1) / np.sqrt(10))


def test_many_rows_count_as_one_by_one() -> None:
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
    photons = np.where(rng.random(90) < 0.2, np.nan, rng.random(90)).astype(np.float32)  # of each object
    one, many = RunTally(4, shots, distinct=50), RunTally(4, shots, distinct=50)
    for row in rows:
        one.add_rows(row[None], photons.__getitem__)
    for part in np.split(rows, [700, 701, 2000]):
        many.add_rows(part, photons.__getitem__)
    known = photons[rows["object"]]
    some = (rows["label"] != NO_LABEL) & (rows["flags"] == 0) & (rows["truth"] >= 0) & (rows["truth"] < 4)
    assert many.figures().photons_mean == pytest.approx(shots * np.nanmean(known[some].astype(np.float64)), rel=1e-12)
    assert (many.judged, many.of["decided"].n) == (some.sum(), 3000 - many.abstained)
    assert many.figures().clicks_mean == rows["clicks"][some].mean()
    assert many.of["decisions"].clicks == rows["clicks"].sum()
    assert many.figures() == replace(one.figures(), photons_mean=pytest.approx(one.figures().photons_mean, rel=1e-12))
    assert many.confusion.tolist() == one.confusion.tolist()
    assert (many.unsure, many.exposures, many.right) == (one.unsure, one.exposures, one.right)


def test_an_ambiguous_decision_counts_as_abstained_and_as_unsure() -> None:
    tally = RunTally(2, 1)
    add(tally, decision(0, 0, NO_LABEL, 1, flags=int(DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED)), 1.0)
    add(tally, decision(0, 1, NO_LABEL, 1, flags=int(DecisionFlag.GAP | DecisionFlag.ABSTAINED)), 1.0)
    assert (tally.figures().abstained, tally.unsure, tally.figures().accuracy) == (2, 1, None)
