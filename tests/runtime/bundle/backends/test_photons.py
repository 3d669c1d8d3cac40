"""Photon numbers through every back end: as the head in plain numpy, and refused beyond the largest."""

from dataclasses import replace
from importlib.metadata import EntryPoint
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bundles import made_bundle
from heads import onnx_chain, random_layers

from pans import decide
from pans.base.errors import UsageError
from pans.bundle.backends import choose as backends
from pans.bundle.backends import make_decider
from pans.bundle.heads.layers import quantise_head
from pans.bundle.sensor import Bundle
from pans.decide.dark.guard import make_adapter
from pans.report.files.verify import _verify_bundle

LAYERS = random_layers([3, 8, 4], seed=3)
BACKENDS = ("table", "onnx", "sparse", "float64", "count-table")


@pytest.fixture(scope="module")
def counted() -> Bundle:
    return made_bundle(3, 4, head_onnx=onnx_chain(LAYERS), int8_head=quantise_head(LAYERS), outcomes=3)


def scores_of(sums: Any, shots: int) -> np.ndarray:
    """The head by hand: mean numbers over the largest, 2."""
    x = np.asarray(sums, np.float64) / (2 * shots)
    for layer in LAYERS:
        x = x @ layer.weights.astype(np.float64) + layer.bias.astype(np.float64)
        x = np.maximum(x, 0) if layer.relu else x
    return x


def words(shots: int) -> np.ndarray:
    return np.array(list(product(range(2 * shots + 1), repeat=3)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_number_is_decided_as_by_hand(backend: str, counted: Bundle) -> None:
    decider = make_decider(counted, backend=backend)
    assert (decider.name, decider.n_features, decider.n_classes) == (backend, 3, 4)
    sums, wanted = words(1), scores_of(words(1), 1)
    np.testing.assert_allclose(decider.scores_batch(sums, 1), wanted, atol=1e-5)
    assert decider.decide_batch(sums, 1).tolist() == wanted.argmax(axis=1).tolist()
    for row, scores in zip(sums, wanted):
        label, probability = decider.decide(row, 1)
        assert label == scores.argmax()
        assert probability == pytest.approx(1 / np.exp(scores - scores.max()).sum(), abs=1e-5)
    if backend in ("table", "onnx"):
        for wrong in (sums + 1, sums - 1):
            with pytest.raises(ValueError, match="allowed: 0 to 2"):
                decider.decide_batch(wrong, 1)


@pytest.mark.parametrize(
    ("backend", "shots", "error"), [*((one, 3, 1e-5) for one in (*BACKENDS[1:], "auto")), ("int8", 1, 0.1)]
)
def test_sums_of_several_shots_are_means(backend: str, shots: int, error: float, counted: Bundle) -> None:
    decider = make_decider(counted, shots=shots, backend=backend)
    np.testing.assert_allclose(decider.scores_batch(words(shots), shots), scores_of(words(shots), shots), 0, error)


def test_one_shot_is_looked_up_and_its_choice_told(counted: Bundle) -> None:
    decider = make_decider(counted)
    assert (decider.name, decider.choice["why"]) == ("table", "one look-up per decision")
    for wrong in ([0, 0, 3], [-1, 0, 0]):
        with pytest.raises(UsageError, match="numbers of 0 to 2"):
            decider.decide(np.array(wrong), 1)
    with pytest.raises(UsageError, match="answers single shots, not 2"):
        make_decider(counted, shots=2, backend="table")
    table = made_bundle(2, 2, outcomes=3, table=np.arange(18.0).reshape(9, 2))
    with pytest.raises(UsageError, match="only a table of single shots, which cannot answer 2 shots"):
        make_decider(table, shots=2)


def test_another_packages_back_end_gets_sums_over_shots_times_the_largest(
    counted: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[list[int], int]] = []

    class Lab:
        def __init__(self, bundle: Bundle) -> None:
            self.name, self.n_features, self.n_classes = "lab", 3, 4

        def decide(self, counts: np.ndarray, shots: int) -> tuple[int, float]:
            asked.append((counts.tolist(), shots))
            return 1, 1.0

    monkeypatch.setattr(backends, "load_offered", lambda point: Lab)
    monkeypatch.setattr(backends, "offered_backends", lambda: {"lab": EntryPoint("lab", "lab:Lab", backends.GROUP)})
    make_decider(counted, shots=5, backend="lab").decide(np.array([10, 0, 3]), 5)
    assert asked[-1] == ([10, 0, 3], 10)
    assert max(max(counts) for counts, _ in asked) == 10


def test_numbers_in_the_library_and_what_takes_clicks_alone(counted: Bundle) -> None:
    found = decide(counted, [[2, 1, 0], [0, 0, 2]])
    assert found.labels.tolist() == scores_of([[2, 1, 0], [0, 0, 2]], 1).argmax(axis=1).tolist()
    with pytest.raises(UsageError, match="takes photon numbers"):
        decide(counted, [0b11])
    with pytest.raises(UsageError, match="0 to 2"):
        decide(counted, [[3, 0, 0]])
    with pytest.raises(UsageError, match="takes photon numbers"):
        make_adapter(counted, 1)


def test_verify_compares_table_and_head_on_all_numbers(counted: Bundle) -> None:
    wrong = counted.table.copy()
    wrong[17] += 1.0  # a word that is no golden one, perhaps: the comparison goes through all
    for bundle, is_wrong in ((counted, False), (replace(counted, table=wrong), True)):
        _verify_bundle(bundle, found := SimpleNamespace(violations=[], alerts=[]))
        assert bool(found.violations) is is_wrong
