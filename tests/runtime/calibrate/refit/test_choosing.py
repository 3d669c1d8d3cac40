"""The choice between old and new, and whether what it says of itself is true on objects that nobody fitted."""

import numpy as np
import pytest

from pans.calibrate.refit.choosing import OLD, Kind, choose, fitted, judge, kinds_for
from pans.calibrate.refit.evidence import eigentasks, evidence_of, log_softmax

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
    scores, chance = world(0, 0.7)
    evidence = drawn(scores, chance, 400, 0)
    kinds = kinds_for(evidence, rows=True)
    found, judged = choose(evidence, kinds), judge(evidence, kinds)
    assert found.name != OLD
    gain = exact(scores, chance)[1] - exact(found.scores, chance)[1]
    assert gain > 0
    assert abs(judged.figures["log_loss_gain"].value - gain) < 2 * judged.figures["log_loss_gain"].error
    assert judged.sizes == (40, 80, 160, 320)


def test_labels_that_mean_nothing_are_not_learnt() -> None:
    scores, _ = world(1, 0.0)
    rng = np.random.default_rng(2)
    evidence = evidence_of(
        np.zeros_like(scores), np.zeros((ROWS, 0)), rng.integers(0, ROWS, 300), rng.integers(0, 3, 300), np.arange(300)
    )
    judged = judge(evidence, kinds_for(evidence, rows=True))
    assert judged.figures["log_loss_gain"].value < 2 * judged.figures["log_loss_gain"].error + 1e-9
    assert judged.figures["accuracy_gain"].value == pytest.approx(
        0, abs=4 * judged.figures["accuracy_gain"].error + 1e-9
    )


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


def shown(count: int, times: int, shots: int = 1, seed: int = 0):
    """Evidence without a head, of objects shown `times`: of six channels the first three tell the class. Also the chances and labels."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, CLASSES, count)
    chances = np.concatenate([0.15 + 0.7 * np.eye(CLASSES)[labels], np.full((count, 3), 0.5)], axis=1)
    object_id = np.repeat(np.arange(count), times)
    clicks = rng.binomial(shots, chances[object_id]) / shots
    rows = np.arange(len(object_id))
    return evidence_of(np.zeros((len(rows), CLASSES)), clicks, rows, labels[object_id], object_id, shots), chances


@pytest.mark.parametrize(("times", "shots"), [(3, 1), (3, 4), (1, 4)])
def test_eigentasks_put_signal_before_noise(times: int, shots: int) -> None:
    evidence, chances = shown(2000, times, shots)
    tasks = eigentasks(evidence)
    noise = np.diag((chances * (1 - chances)).mean(axis=0)) / shots
    total = noise + np.cov(chances.T)
    share = np.diag(tasks.T @ noise @ tasks) / np.diag(tasks.T @ total @ tasks)
    assert share == pytest.approx(np.sort(np.linalg.eigvals(np.linalg.solve(total, noise)).real), abs=0.05)


def test_objects_shown_once_by_one_shot_have_no_eigentasks() -> None:
    once, again = shown(300, 1)[0], shown(300, 2)[0]
    assert eigentasks(once) is None
    assert not any(kind.tasks for kind in kinds_for(once, rows=False))
    assert {kind.tasks for kind in kinds_for(again, rows=False)} == {0, 2, 4, 6}


def test_eigentasks_are_taken_where_there_is_no_head_and_alone_forget_the_old_scores() -> None:
    evidence, _ = shown(150, 4)
    assert choose(evidence, kinds_for(evidence, rows=False)).name.startswith("2 eigentasks")
    found = fitted(evidence, Kind(("bias", "clicks"), tasks=2, alone=True), np.ones(150, bool)).correction
    old, clicks = np.random.default_rng(3).normal(size=(50, CLASSES)), np.random.default_rng(4).random((50, 6))
    new = found.apply(old - old.mean(axis=1, keepdims=True), clicks)
    assert new == pytest.approx(found.apply(np.zeros_like(old), clicks))
    assert np.linalg.matrix_rank(new - new.mean(axis=0), tol=1e-6) == 2
