"""Refits over photon numbers: table, head or posteriors of the old bundle are wrong, the new ones nearly the best that there can be."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from automata import random_automaton
from bundles import automaton_bundle, made_bundle
from heads import affine_head

from pans.runtime.bundle.model import Bundle
from pans.runtime.decide import make_decider
from pans.runtime.refit.choosing import Kind, fitted
from pans.runtime.refit.clicks import Labelled
from pans.runtime.refit.rebuild import rebuilt, rows_of

OUTCOMES, D_F, SHOWN = 4, 3, 3000
MEANS = np.array([[1.6, 0.4, 1.0], [0.5, 1.5, 0.9]])  # photoelectrons of the patterns, by class


def poisson(mean: float) -> list[float]:
    """P(0), P(1), P(2), P(3 or more)."""
    first = [math.exp(-mean) * mean**k / math.factorial(k) for k in range(OUTCOMES - 1)]
    return [*first, 1 - sum(first)]


CHANCES = np.array([[poisson(mean) for mean in row] for row in MEANS])  # (classes, d_f, outcomes)
WORDS = np.array(list(product(range(OUTCOMES), repeat=D_F)))
OF_WORD = np.prod([CHANCES[:, i, WORDS[:, i]] for i in range(D_F)], axis=0)  # (classes, words)
BEST = OF_WORD.max(axis=0).sum() / 2


def drawn(shots: int = 1, seed: int = 1) -> Labelled:
    rng = np.random.default_rng(seed)
    truth = np.arange(SHOWN) % 2
    upto = CHANCES[truth].cumsum(axis=2)
    counts = sum((rng.random((SHOWN, D_F))[:, :, None] >= upto[:, :, :-1]).sum(axis=2) for _ in range(shots))
    return Labelled(np.asarray(counts), truth, np.arange(SHOWN), shots, (), True, {}, math.nan, math.nan)


def accuracy(bundle: Bundle) -> float:
    decided = make_decider(bundle).decide_batch(WORDS, 1)
    return float(OF_WORD[decided, np.arange(len(WORDS))].sum() / 2)


def wrong_bundle(kind: str) -> Bundle:
    """A table that knows nothing, or a head that takes the classes for one another."""
    if kind == "table":
        return made_bundle(D_F, 2, outcomes=OUTCOMES, table=np.random.default_rng(3).normal(size=(64, 2)) / 3)
    head = affine_head(np.array([[0, 1], [1, 0], [0, 0]], np.float32), np.zeros(2, np.float32))
    return made_bundle(D_F, 2, outcomes=OUTCOMES, head_onnx=head)


@pytest.mark.parametrize(
    ("kind", "how"), [("table", Kind(("bias", "clicks"), rows=True)), ("head", Kind(("bias", "clicks")))]
)
def test_a_new_back_end_is_nearly_the_best(kind: str, how: Kind) -> None:
    old, clicks = wrong_bundle(kind), drawn()
    rows = rows_of(old, clicks)
    assert rows.own_posteriors == (kind == "table")
    found = fitted(rows.evidence, how, np.ones(SHOWN, bool))
    new = rebuilt(old, rows, found, clicks, {})
    assert (new.bundle.outcomes, new.bundle.largest) == (OUTCOMES, OUTCOMES - 1)
    assert accuracy(old) < BEST - 0.1
    assert accuracy(new.bundle) > BEST - 0.01
    scores = make_decider(new.bundle).scores_batch(clicks.counts, 1).astype(np.float64)
    seen = found.scores[rows.evidence.row]
    assert np.allclose(scores - scores.mean(axis=1, keepdims=True), seen - seen.mean(axis=1, keepdims=True), atol=1e-4)


def test_a_row_of_the_table_is_the_word_in_base_outcomes() -> None:
    clicks = drawn()
    rows = rows_of(wrong_bundle("table"), clicks)
    seen = rows.number[rows.evidence.row]
    assert (seen == clicks.counts @ [1, 4, 16]).all()
    assert np.allclose(rows.evidence.clicks[rows.evidence.row], clicks.counts / 3)


def test_several_shots_are_refitted_through_the_head_and_claim_no_noise() -> None:
    clicks = drawn(shots=3)
    rows = rows_of(wrong_bundle("head"), clicks)
    assert np.allclose(rows.evidence.clicks[rows.evidence.row], clicks.counts / 9)
    assert rows.evidence.shots == 1  # the binomial variance would be wrong of photon numbers


def test_an_automaton_over_numbers_comes_near_the_exact_posteriors() -> None:
    bundle = automaton_bundle(random_automaton(5, slots=3, width=3, classes=2, outcomes=3))
    automaton = bundle.automaton
    assert automaton is not None
    rng = np.random.default_rng(6)
    rates = rng.dirichlet([1.0, 1.0, 1.0], (2, automaton.n_slots))  # P(number) of a slot, by class
    truth = np.arange(4000) % 2
    upto = rates[truth].cumsum(axis=2)[:, :, :-1]
    counts = (rng.random((4000, automaton.n_slots))[:, :, None] >= upto).sum(axis=2)
    clicks = Labelled(counts, truth, np.arange(4000), 1, (), True, {}, math.nan, math.nan)
    rows = rows_of(bundle, clicks)
    found = fitted(rows.evidence, Kind(("bias",), rows=True), np.ones(4000, bool))
    new = rebuilt(bundle, rows, found, clicks, {}).bundle.automaton
    assert new is not None
    assert (new.counts, new.n_outcomes) == (True, 3)
    mass = np.zeros(automaton.posteriors.shape)  # by hand: every word of numbers, walked to its leaf
    for word in product(range(3), repeat=automaton.n_slots):
        node, step = 0, 0
        while node < automaton.n_states:
            node, step = int(automaton.successors[node, word[step]]), step + 1
        mass[node] += np.prod(rates[:, np.arange(automaton.n_slots), word], axis=1)
    often = mass.sum(axis=1) > 0.05  # of leaves that a hundred objects or more came to
    exact = mass[often] / mass[often].sum(axis=1, keepdims=True)
    before = np.abs(automaton.posteriors[often] - exact).mean()
    assert np.abs(new.posteriors[often] - exact).mean() < 0.05 < before
