"""New bundles out of corrections: table, head or posteriors of the old one are wrong, the new ones nearly the best that there can be."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from automata import random_automaton
from bundles import automaton_bundle, made_bundle
from heads import affine_head

from pans.bundle.automaton import Automaton, walk_nodes
from pans.bundle.backends import make_decider
from pans.bundle.sensor import Bundle
from pans.calibrate.refit.choosing import Kind, choose, fitted, kinds_for
from pans.calibrate.refit.clicks import Labelled
from pans.calibrate.refit.evidence import log_softmax
from pans.calibrate.refit.rebuild import rebuilt, rows_of
from pans_sim.testing import small_automaton_bundle

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


def labelled(chances: np.ndarray, objects: int, shots: int = 1, seed: int = 1) -> Labelled:
    """Clicks of `objects`, whose outcomes have the `chances` (classes, d_f, outcomes), independently."""
    rng = np.random.default_rng(seed)
    truth = np.arange(objects) % len(chances)
    upto = chances[truth].cumsum(axis=2)[:, :, :-1]
    counts = sum((rng.random(upto.shape[:2])[:, :, None] >= upto).sum(axis=2) for _ in range(shots))
    return Labelled(np.asarray(counts), truth, np.arange(objects), shots, (), True, {}, None, None)


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
    old, clicks = wrong_bundle(kind), labelled(CHANCES, SHOWN)
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


def test_rows_are_words_in_base_outcomes_or_means_of_shots() -> None:
    clicks = labelled(CHANCES, SHOWN)
    rows = rows_of(wrong_bundle("table"), clicks)
    assert (rows.number[rows.evidence.row] == clicks.counts @ [1, 4, 16]).all()
    assert np.allclose(rows.evidence.clicks[rows.evidence.row], clicks.counts / 3)
    clicks = labelled(CHANCES, SHOWN, shots=3)
    rows = rows_of(wrong_bundle("head"), clicks)
    assert np.allclose(rows.evidence.clicks[rows.evidence.row], clicks.counts / 9)
    assert rows.evidence.shots == 1  # the binomial variance would be wrong of photon numbers


def exact_posteriors(automaton: Automaton, chances: np.ndarray) -> np.ndarray:
    """The chance of each class in each node, summed over all words; 0 where hardly any object of a thousand comes."""
    mass = np.zeros(automaton.posteriors.shape)
    for word in product(range(automaton.n_outcomes), repeat=automaton.n_slots):
        of_word = np.prod(chances[:, np.arange(automaton.n_slots), word], axis=1)
        node, slot = 0, 0
        mass[0] += of_word
        while node < automaton.n_states:
            node, slot = int(automaton.successors[node, word[slot]]), slot + 1
            mass[node] += of_word
    return np.where(mass.sum(axis=1, keepdims=True) > 0.05, mass / mass.sum(axis=1, keepdims=True), 0)


BINARY = small_automaton_bundle()
COUNTED = automaton_bundle(random_automaton(5, slots=3, width=3, classes=2, outcomes=3))


def drawn(bundle: Bundle, seed: int) -> np.ndarray:
    """Chances of the outcomes of each slot, by class."""
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.ones(bundle.automaton.n_outcomes), (bundle.n_classes, bundle.automaton.n_slots))


@pytest.mark.parametrize(("bundle", "seed"), [(BINARY, 1), (COUNTED, 6)], ids=["clicks", "numbers"])
def test_leaves_and_states_come_near_the_exact_posteriors(bundle: Bundle, seed: int) -> None:
    old, chances = bundle.automaton, drawn(bundle, seed)
    clicks = labelled(chances, 4000)
    rows = rows_of(bundle, clicks)
    reached = walk_nodes(old, clicks.counts)[:, -1]
    assert np.array_equal(rows.number[rows.evidence.row], reached)
    before = log_softmax(rows.evidence.scores)[rows.evidence.row]
    assert before == pytest.approx(np.log(old.posteriors[reached]), abs=1e-5)
    found = choose(rows.evidence, kinds_for(rows.evidence, rows=rows.own_posteriors))
    made = rebuilt(bundle, rows, found, clicks, {"objects": 4000})
    new, exact = made.bundle.automaton, exact_posteriors(old, chances)
    often = exact.any(axis=1)
    assert np.abs(new.posteriors - exact)[often].mean() < 0.04 < np.abs(old.posteriors - exact)[often].mean()
    assert (new.counts, new.n_outcomes) == (old.counts, old.n_outcomes)
    assert np.array_equal(new.successors, old.successors)
    assert made.slots_corrected >= 1
    assert made.bundle.expected is None  # it was the old instrument's
    assert made.bundle.provenance["refit"]["objects"] == 4000


def test_an_automaton_that_is_right_stays_as_it_is() -> None:
    chances = drawn(BINARY, 3)
    assert BINARY.automaton is not None
    exact = exact_posteriors(BINARY.automaton, chances)
    known = np.where(exact.any(axis=1, keepdims=True), exact, 1 / BINARY.n_classes)
    right = automaton_bundle(replace(BINARY.automaton, posteriors=known.astype(np.float32)))
    clicks = labelled(chances, 500)
    rows = rows_of(right, clicks)
    found = choose(rows.evidence, kinds_for(rows.evidence, rows=True))
    assert found.correction is None
    new = rebuilt(right, rows, found, clicks, {}).bundle.automaton
    assert np.array_equal(new.posteriors, right.automaton.posteriors)  # type: ignore[union-attr]
