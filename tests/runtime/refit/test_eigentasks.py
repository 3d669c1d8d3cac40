"""Eigentasks: noise told from signal, the order of the tasks, and heads on them as corrections of scores or clicks alone."""

import numpy as np
import pytest

from pans.runtime.bundle.layers import Layer, reference_scores
from pans.runtime.refit.choosing import Kind, choose, fitted, kinds_for
from pans.runtime.refit.eigentasks import eigentasks
from pans.runtime.refit.evidence import evidence_of
from pans.runtime.refit.onnx_chain import corrected_layers

D_F, CLASSES = 6, 3


def shown(chances, times: int, seed: int = 0, shots: int = 1, labels=None):
    """Evidence of objects with these click chances (objects, d_f), each shown `times`; every decision is a row of its own."""
    rng = np.random.default_rng(seed)
    object_id = np.repeat(np.arange(len(chances)), times)
    clicks = rng.binomial(shots, chances[object_id]) / shots
    truth = np.zeros(len(object_id), np.int64) if labels is None else labels[object_id]
    return evidence_of(np.zeros((len(object_id), CLASSES)), clicks, np.arange(len(object_id)), truth, object_id, shots)


def objects(count: int, seed: int = 1):
    """Chances of many objects of three classes: the first channels tell the class, the last ones are alike for all."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, CLASSES, count)
    centre = np.full((CLASSES, D_F), 0.5)
    centre[:, :3] = 0.15 + 0.7 * np.eye(CLASSES)
    return np.clip(centre[labels] + rng.normal(0, 0.05, (count, D_F)), 0.01, 0.99), labels


def test_noise_and_signal_are_told_apart_where_one_channel_has_only_either() -> None:
    sure = np.random.default_rng(0).integers(0, 2, 400).astype(float)  # of an object: always or never
    chances = np.stack([np.full(400, 0.5), sure], axis=1)
    found = eigentasks(shown(chances, 3))
    assert found is not None
    assert found.noise_share == pytest.approx([0, 1], abs=0.05)
    first = np.abs(found.readout[:, 0])
    assert first[1] > 20 * first[0]


def test_shares_are_those_of_the_true_noise_and_signal() -> None:
    chances, _ = objects(4000)
    found = eigentasks(shown(chances, 4))
    assert found is not None
    noise = np.diag((chances * (1 - chances)).mean(axis=0))  # from the chances, not from clicks
    total = noise + np.cov(chances.T)
    # shares are the eigenvalues of T^-1 N, here of a general solver
    wanted = np.sort(np.linalg.eigvals(np.linalg.solve(total, noise)).real)
    assert found.noise_share == pytest.approx(wanted, abs=0.03)
    for k in (0, 1):  # the two that tell three classes; the others have a share near 1
        ratio = found.readout[:, k] @ noise @ found.readout[:, k] / (found.readout[:, k] @ total @ found.readout[:, k])
        assert ratio == pytest.approx(wanted[k], abs=0.03)
    assert found.noise_share[2] > 0.9 > 0.6 > found.noise_share[1]


def test_shots_of_a_decision_tell_noise_as_repeated_decisions_do() -> None:
    chances, _ = objects(3000)
    once, again = eigentasks(shown(chances, 1, shots=4)), eigentasks(shown(chances, 3, shots=4, seed=5))
    assert once is not None
    assert again is not None
    assert once.noise_share == pytest.approx(again.noise_share, abs=0.05)


def test_objects_shown_once_by_one_shot_have_none() -> None:
    chances, labels = objects(300)
    evidence = shown(chances, 1, labels=labels)
    assert eigentasks(evidence) is None
    assert not any(kind.tasks for kind in kinds_for(evidence, rows=False))
    assert any(kind.tasks for kind in kinds_for(shown(chances, 2, labels=labels), rows=False))
    nodes = evidence_of(np.zeros((5, CLASSES)), np.zeros((5, 0)), labels % 5, labels, np.arange(300) // 2 * 2)
    assert eigentasks(nodes) is None  # of an automaton there are no clicks


def test_a_dead_channel_takes_no_part() -> None:
    chances, _ = objects(500)
    chances[:, 4] = 0.0
    found = eigentasks(shown(chances, 3))
    assert found is not None
    assert np.isfinite(found.readout).all()
    assert np.isfinite(found.noise_share).all()


def test_a_head_alone_forgets_the_old_scores_and_is_the_same_in_layers() -> None:
    chances, labels = objects(200)
    evidence = shown(chances, 3, labels=labels)
    found = fitted(evidence, Kind(("bias", "clicks"), tasks=2, alone=True), np.ones(200, bool))
    assert found.name == "2 eigentasks alone"
    assert found.correction is not None
    rng = np.random.default_rng(3)
    clicks, old = rng.random((50, D_F)), rng.normal(size=(50, CLASSES))
    old -= old.mean(axis=1, keepdims=True)
    new = found.correction.apply(old, clicks)
    assert new == pytest.approx(found.correction.apply(np.zeros_like(old), clicks))
    assert np.linalg.matrix_rank(new - new.mean(axis=0), tol=1e-6) == 2  # two tasks, whatever the clicks
    layers = (
        Layer(rng.normal(size=(D_F, 8)).astype(np.float32), rng.normal(size=8).astype(np.float32), True),
        Layer(rng.normal(size=(8, CLASSES)).astype(np.float32), rng.normal(size=CLASSES).astype(np.float32), False),
    )
    changed = corrected_layers(layers, found.correction)
    assert changed is not None
    scores = reference_scores(changed, clicks)
    assert scores - scores.mean(axis=1, keepdims=True) == pytest.approx(new - new.mean(axis=1, keepdims=True), abs=1e-4)


def test_a_head_on_eigentasks_is_taken_where_there_was_none() -> None:
    chances, labels = objects(150)
    evidence = shown(chances, 4, labels=labels)
    kinds = tuple(kind for kind in kinds_for(evidence, rows=False) if kind.tasks == 2)
    found = choose(evidence, kinds)
    assert found.name.startswith("2 eigentasks")
    fresh, wanted = objects(2000, seed=9)
    assert found.correction is not None
    clicks = np.random.default_rng(2).random(fresh.shape) < fresh
    right = found.correction.apply(np.zeros((2000, CLASSES)), clicks.astype(float)).argmax(axis=1) == wanted
    by_hand = clicks[:, :3].argmax(axis=1) == wanted  # each of the first channels is for a class
    assert right.mean() > by_hand.mean() - 0.02 > 0.6
