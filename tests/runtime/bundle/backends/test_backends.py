"""Decisions: table and head answer alike, as the slow oracles do, and refuse what they cannot answer."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import naive_decide as naive
import numpy as np
import pytest
from bundles import made_bundle
from heads import affine_head

from pans.base.errors import DamagedFileError, UsageError
from pans.bundle.backends.choose import make_decider
from pans.bundle.backends.verdict import softmax_winner
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import word_means


def affine_bundle(d_f: int, classes: int, batch: Any = "n") -> tuple[Bundle, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    weights = rng.normal(size=(d_f, classes)).astype(np.float32)
    bias = rng.normal(size=classes).astype(np.float32)
    return made_bundle(d_f, classes, head_onnx=affine_head(weights, bias, batch)), weights, bias


def all_clicks(d_f: int) -> np.ndarray:
    return word_means(np.arange(1 << d_f), d_f).astype(np.int64)


@pytest.mark.parametrize("backend", ["table", "onnx"])
def test_every_word_as_the_oracle(backend: str) -> None:
    made, weights, bias = affine_bundle(6, 4)
    decider = make_decider(made, backend=backend)
    assert (decider.name, decider.n_features, decider.n_classes) == (backend, 6, 4)
    clicks = all_clicks(6)
    labels = decider.decide_batch(clicks, 1)
    assert labels.dtype == np.int64
    for row in clicks:
        scores = naive.affine_scores(row.tolist(), 1, weights.tolist(), bias.tolist())
        label, probability = naive.winner(scores)
        verdict = decider.decide(row, 1)
        assert verdict.label == label == labels[naive.word_of(row.tolist())]
        assert verdict.probability == pytest.approx(probability, abs=1e-5)
        np.testing.assert_allclose(decider.scores_batch(row[None], 1)[0], scores, atol=1e-5)


@pytest.mark.parametrize("batch", ["n", 1, None])
def test_the_head_answers_means_of_several_shots(batch: Any) -> None:
    made, weights, bias = affine_bundle(5, 3, batch)
    decider = make_decider(made, shots=7, backend="onnx")
    counts = np.random.default_rng(3).integers(0, 8, size=(40, 5))
    scores = decider.scores_batch(counts, 7)
    assert scores.dtype == np.float32
    for row, found in zip(counts, scores):
        wanted = naive.affine_scores(row.tolist(), 7, weights.tolist(), bias.tolist())
        np.testing.assert_allclose(found, wanted, atol=1e-5)
        assert decider.decide(row, 7).label == naive.winner(wanted)[0]
    # fewer shots than planned are still means, and the bound buffers carry nothing over from one object to the next
    wanted = naive.winner(naive.affine_scores([1, 0, 2, 0, 1], 2, weights.tolist(), bias.tolist()))
    for _ in range(2):
        assert decider.decide(np.array([1, 0, 2, 0, 1]), 2) == (wanted[0], pytest.approx(wanted[1], abs=1e-5))
        decider.decide(counts[1], 7)


def test_ties_go_to_the_lowest_label() -> None:
    table = np.array([[1, 1, 0], [0, 2, 2], [3, 3, 3], [0, 0, 1]], dtype=np.float32)
    made = made_bundle(2, 3, table=table)
    assert make_decider(made).decide_batch(all_clicks(2), 1).tolist() == [0, 1, 0, 2]


@pytest.mark.parametrize("scores", [[1e4, 0, -1e4], [0, 0, 0], [-3e38, 3e38, 0], [88.8, 88.7, -100], [1e-30, 0, 0]])
def test_the_winning_probability_is_stable(scores: list[float]) -> None:
    label, probability = naive.winner([float(np.float32(score)) for score in scores])
    assert softmax_winner(np.array(scores, dtype=np.float32)) == (label, pytest.approx(probability, rel=1e-12))
    decider = make_decider(made_bundle(1, 3, table=np.tile(np.array(scores, dtype=np.float32), (2, 1))))
    assert decider.decide(np.array([1]), 1).probability == pytest.approx(probability)


@pytest.mark.parametrize("score", [np.nan, np.inf])
def test_scores_that_are_not_finite_have_no_probability(score: float) -> None:
    assert softmax_winner(np.array([0.0, score], dtype=np.float32)).probability == 0.0


def test_the_table_refuses_what_it_cannot_answer() -> None:
    decider = make_decider(made_bundle(3, 2, table=np.zeros((8, 2))))
    for wrong in ([0, 1, 2], [0, -1, 1]):
        with pytest.raises(UsageError, match="numbers of 0 to 1"):
            decider.decide(np.array(wrong), 1)
    with pytest.raises(UsageError, match="single shots"):
        decider.decide(np.array([0, 1, 1]), 2)
    with pytest.raises(ValueError, match="counts run from 0 to 2, allowed: 0 to 1"):
        decider.decide_batch([[0, 1, 2]], 1)
    with pytest.raises(ValueError, match=r"integers \(n, 3\)"):
        decider.decide_batch([[0, 1]], 1)
    with pytest.raises(ValueError, match="integers"):
        decider.scores_batch([[0.0, 1.0, 0.0]], 1)


def test_the_choice_of_the_back_end() -> None:
    both, _, _ = affine_bundle(3, 2)
    assert make_decider(both).name == "table"
    measured = make_decider(both, shots=2)
    assert measured.name in ("count-table", "sparse", "onnx")
    assert measured.choice["chosen"] == measured.name
    assert set(measured.choice["p50_us"]) == {"count-table", "sparse", "onnx"}
    assert make_decider(both, backend="onnx").name == "onnx"
    only_table = made_bundle(3, 2, table=np.zeros((8, 2)))
    for wrong in ({"backend": "onnx"}, {"shots": 2}, {"backend": "gpu"}, {"shots": 0}):
        with pytest.raises(UsageError):
            make_decider(only_table, **wrong)
    only_head = replace(both, table=None)
    assert make_decider(only_head, backend="onnx").name == "onnx"
    with pytest.raises(UsageError, match="no table"):
        make_decider(only_head, backend="table")
    with pytest.raises(UsageError, match="single shots, not 3"):
        make_decider(both, backend="table", shots=3)


@pytest.mark.parametrize("backend", ["table", "onnx", "sparse", "float64"])
def test_golden_vectors_are_held_against_the_back_end(backend: str) -> None:
    made, _, _ = affine_bundle(4, 3)
    scores = made.golden_scores.copy()
    scores[5, 1] += 1e-3
    with pytest.raises(DamagedFileError, match="golden vectors of the bundle: the scores of vector 5"):
        make_decider(replace(made, golden_scores=scores), backend=backend)


def test_the_table_path_needs_neither_numba_nor_onnxruntime(tmp_path: Path) -> None:
    from pans.bundle.sensor.bundle import write_bundle

    write_bundle(made_bundle(3, 2, table=np.arange(16).reshape(8, 2)), tmp_path / "t.pans")
    code = (
        "import sys, numpy as np; from pans.bundle.sensor import load_bundle; from pans.bundle.backends import make_decider;"
        "print(make_decider(load_bundle(sys.argv[1])[0]).decide(np.array([0, 1, 1]), 1).label,"
        "sorted({'numba', 'onnxruntime', 'onnx', 'torch'} & set(sys.modules)))"
    )
    path = str(tmp_path / "t.pans")
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1 []"
