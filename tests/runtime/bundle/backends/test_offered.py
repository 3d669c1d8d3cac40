"""Back ends of other packages: found by entry point, checked, and given the calls that they need not have."""

from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import pans
from pans.base.errors import UsageError
from pans.bundle.backends import Decider, make_decider
from pans.bundle.backends import choose as backends
from pans.bundle.backends.verdict import softmax_winner

BUNDLE = pans.load_bundle("fashion10")
LAB = """
class Lab:
    def __init__(self, bundle):
        self.name, self.n_features, self.n_classes = "lab", bundle.n_features, len(bundle.classes)

    def decide(self, counts, shots):
        return BODY
"""
Offer = Callable[[str], None]


@pytest.fixture
def offer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Offer:
    """Call it with what the lab's back end answers, or with the whole module."""

    def write(body: str) -> None:
        module = f"lab{abs(hash(body))}"
        (tmp_path / f"{module}.py").write_text(body if "\n" in body else LAB.replace("BODY", body))
        points = [EntryPoint(name, f"{module}:Lab", backends.GROUP) for name in ("lab", "table")]
        monkeypatch.setattr(backends, "entry_points", lambda group: points)

    monkeypatch.syspath_prepend(str(tmp_path))
    return write


def lab() -> Decider:
    return make_decider(BUNDLE, backend="lab")


def test_it_is_found_by_its_entry_point_and_need_not_know_of_many_objects(offer: Offer) -> None:
    offer("(9, 0.75) if counts.sum() == 0 else (int(counts[0]), 0.5)")
    assert lab().decide(np.zeros(10, np.int64), 1) == (9, 0.75)
    assert make_decider(BUNDLE, backend="table").name == "table"  # ours cannot be replaced
    with pytest.raises(UsageError, match=r"'none', allowed: auto, .*, lab"):
        make_decider(BUNDLE, backend="none")
    counts = np.array([[0] * 10, [1] + [0] * 9])
    assert lab().decide_batch(counts, 1).tolist() == [9, 1]
    found = lab().verdicts(counts, 1)
    assert (found.labels.tolist(), found.probabilities.tolist()) == ([9, 1], [0.75, 0.5])
    for scores, (label, probability) in zip(lab().scores_batch(counts, 1), [(9, 0.75), (1, 0.5)]):
        assert softmax_winner(scores) == (label, pytest.approx(probability, abs=1e-6))
    assert pans.decide(BUNDLE, counts, backend="lab").labels.tolist() == [9, 1]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("(99, 1.0)", r"lab.*answers \(99, 1.0\) to the clicks"),
        ("(__import__('numpy').int64(99), 1.0)", r"lab.*answers \(99, 1.0\) to the clicks"),
        ("(1, float('nan'))", "answers"),
        ("1 // 0", "fails on the clicks .* ZeroDivisionError"),
        ("None", "fails on the clicks .* TypeError"),
        ("class Lab:\n    def __init__(self, bundle): pass\n", "its name is None, must be 'lab'"),
        ("class Lab:\n    pass\n", "cannot be made: TypeError"),
        ("import nowhere\n\n", "cannot be loaded: .*No module named 'nowhere'"),
        ("No = 1\n\n", "cannot be loaded: .*has no attribute 'Lab'"),
    ],
)
def test_what_is_no_back_end_is_refused_with_its_package(offer: Offer, body: str, words: str) -> None:
    offer(body)
    with pytest.raises(UsageError, match=words):
        lab()


def test_an_error_in_the_middle_of_a_run_names_the_clicks(offer: Offer) -> None:
    offer("(0, 1.0) if shots == 1 and counts[0] < 2 else 1 // 0")
    decider = lab()
    with pytest.raises(UsageError, match=r"\[2, 0, 0, 0, 0, 0, 0, 0, 0, 0\]"):
        decider.decide(np.array([2] + [0] * 9), 1)
