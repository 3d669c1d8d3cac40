"""The choice between old and new, and whether what it says of itself is true on objects that nobody fitted."""

import numpy as np
import pytest

from pans.runtime.refit.choosing import OLD, choose, judge, kinds_for
from pans.runtime.refit.evidence import evidence_of, log_softmax

ROWS, CLASSES = 30, 3


def world(seed: int, changed: float):
    """Old scores of 30 rows, and the exact chance of each row and class on an instrument that differs by `changed`."""
    rng = np.random.default_rng(seed)
    scores = rng.normal(size=(ROWS, CLASSES)) * 1.5
    mixed = scores + changed * rng.normal(size=(1, CLASSES)) + changed * scores @ rng.normal(size=(CLASSES, CLASSES))
    return scores, np.exp(log_softmax(mixed)) / ROWS


def drawn(scores, chance, objects: int, seed: int, each: int = 1):
    rng = np.random.default_rng(seed)
    truth = rng.choice(CLASSES, objects, p=chance.sum(axis=0))
    object_ids = np.repeat(np.arange(objects), each)
    rows = np.array([rng.choice(ROWS, p=chance[:, c] / chance[:, c].sum()) for c in truth[object_ids]])
    return evidence_of(scores, np.zeros((ROWS, 0)), rows, truth[object_ids], object_ids)


def exact(scores, chance) -> tuple[float, float]:
    logs = log_softmax(scores)
    return float(chance[np.arange(ROWS), logs.argmax(axis=1)].sum()), float(-(chance * logs).sum())


def test_the_old_scores_stay_where_the_instrument_is_the_old_one() -> None:
    stayed = 0
    for seed in range(12):
        scores, chance = world(seed, 0.0)
        evidence = drawn(scores, chance, 300, seed)
        found = choose(evidence, kinds_for(evidence, rows=True))
        stayed += found.name == OLD
        assert exact(found.scores, chance)[1] < exact(scores, chance)[1] + 0.01
    assert stayed >= 11  # three standard errors: one in several hundred for each kind


def test_a_changed_instrument_is_followed_and_the_estimate_is_right() -> None:
    offs = []
    for seed in range(1):
        scores, chance = world(seed, 0.7)
        evidence = drawn(scores, chance, 400, seed)
        kinds = kinds_for(evidence, rows=True)
        found, judged = choose(evidence, kinds), judge(evidence, kinds)
        assert found.name != OLD
        gain = exact(scores, chance)[1] - exact(found.scores, chance)[1]
        assert gain > 0
        offs.append((judged.log_loss_gain.value - gain) / judged.log_loss_gain.error)
        assert judged.sizes == (40, 80, 160, 320)
    assert max(map(abs, offs)) < 4
    assert abs(np.mean(offs)) < 2


def test_labels_that_mean_nothing_are_not_learnt() -> None:
    scores, _ = world(1, 0.0)
    rng = np.random.default_rng(2)
    evidence = evidence_of(
        np.zeros_like(scores), np.zeros((ROWS, 0)), rng.integers(0, ROWS, 300), rng.integers(0, 3, 300), np.arange(300)
    )
    judged = judge(evidence, kinds_for(evidence, rows=True))
    assert judged.log_loss_gain.value < 2 * judged.log_loss_gain.error + 1e-9
    assert judged.accuracy_gain.value == pytest.approx(0, abs=4 * judged.accuracy_gain.error + 1e-9)


def test_an_object_counts_once_however_often_it_was_shown_and_is_never_in_two_folds() -> None:
    scores, chance = world(3, 0.5)
    evidence = drawn(scores, chance, 60, 4, each=5)
    everything = np.ones(60, bool)
    assert evidence.counts(everything).sum() == pytest.approx(60)
    fold = evidence.folds(5, everything, np.random.default_rng(0))
    seen = np.stack([np.bincount(evidence.classes[fold == k], minlength=CLASSES) for k in range(5)])
    assert np.ptp(seen, axis=0).max() <= 1
    part = fold == 0
    assert evidence.counts(part).sum() == pytest.approx(part.sum())
    loss, right = evidence.losses(evidence.scores)
    mine = np.flatnonzero(evidence.object_id == 7)
    logs = log_softmax(evidence.scores)[evidence.row[mine]]
    assert loss[7] == pytest.approx(-logs[np.arange(5), evidence.truth[mine]].mean())
    assert right[7] == pytest.approx(np.mean(logs.argmax(axis=1) == evidence.truth[mine]))
