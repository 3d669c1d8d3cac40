"""The comparison of the back end that will decide with the leaves of a written automaton."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton

from pans.base.errors import PansError
from pans.bundle.automaton import Automaton
from pans.bundle.backends import make_decider
from pans_trainer.export import automaton as export


def nearly_even(automaton: Automaton) -> Automaton:
    """With the second class ahead of the first by one float32 step, too little for their logarithms."""
    first = np.linspace(0.34, 0.36, 100, dtype=np.float32)
    second = np.nextafter(first, np.float32(1))
    row = int((np.log(first) == np.log(second)).argmax())
    posteriors = np.zeros_like(automaton.posteriors)
    posteriors[:] = first[row], second[row], 1 - first[row] - second[row]
    return replace(automaton, posteriors=posteriors)


def test_classes_one_step_apart_are_told_apart() -> None:
    bundle = automaton_bundle(nearly_even(random_automaton(3, slots=6)))
    decider: Any = make_decider(bundle, backend="automaton")
    words = np.zeros((1, 6), np.int64)
    assert decider.scores_batch(words, 1).argmax() == 0  # the logarithms are equal
    assert decider.decide_batch(words, 1)[0] == 1
    export.compare_decider(bundle, seed=0)


def test_another_back_end_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = automaton_bundle(random_automaton(3, slots=6))
    other = make_decider(automaton_bundle(random_automaton(4, slots=6)), backend="automaton")
    monkeypatch.setattr(export, "make_decider", lambda *_, **__: other)
    with pytest.raises(PansError, match="decides otherwise than its leaves"):
        export.compare_decider(bundle, seed=0)
