"""An automaton refitted: its leaves and the states before them, on walks of an instrument whose clicks are known exactly."""

import numpy as np
import pytest

from pans.firmware_sim.testing import small_automaton_bundle
from pans.runtime.bundle.automaton import walk_nodes
from pans.runtime.refit.choosing import choose, kinds_for
from pans.runtime.refit.clicks import Labelled
from pans.runtime.refit.evidence import log_softmax
from pans.runtime.refit.rebuild import rebuilt, rows_of


def walks(bundle, rates, objects: int, seed: int) -> Labelled:
    """Words of `objects` whose class clicks in slot t with rates[class, t], independently."""
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, bundle.n_classes, objects)
    words = (rng.random((objects, bundle.n_features)) < rates[truth]).astype(np.int64)
    return Labelled(words, truth, np.arange(objects), 1, (), True, {}, 1.0, 1.0)


def exact_posteriors(automaton, rates):
    """The chance of each class in each node, summed over all words."""
    n_bits = automaton.n_bits
    words = np.arange(1 << n_bits)[:, None] >> np.arange(n_bits) & 1
    chance = np.prod(np.where(words[:, None, :], rates, 1 - rates), axis=2)
    found = np.zeros(automaton.posteriors.shape)
    for slot in range(automaton.n_slots + 1):
        nodes = walk_nodes(automaton, words)[:, slot]
        first = np.zeros(len(found), bool)
        first[nodes] = True
        mass = np.zeros_like(found)
        np.add.at(mass, nodes, chance)
        found[first] = mass[first]
    return found / found.sum(axis=1, keepdims=True)


def test_leaves_and_states_come_near_the_exact_posteriors() -> None:
    bundle = small_automaton_bundle()
    assert bundle.automaton is not None
    rates = np.random.default_rng(1).uniform(0.1, 0.9, (bundle.n_classes, bundle.n_features))
    clicks = walks(bundle, rates, 4000, 2)
    rows = rows_of(bundle, clicks)
    found = choose(rows.evidence, kinds_for(rows.evidence, rows=rows.own_posteriors))
    new = rebuilt(bundle, rows, found, clicks, {"objects": 4000})
    assert new.bundle.automaton is not None
    exact = exact_posteriors(bundle.automaton, rates)
    before = np.abs(bundle.automaton.posteriors - exact).mean()
    after = np.abs(new.bundle.automaton.posteriors - exact).mean()
    assert after < 0.03 < before
    assert np.array_equal(new.bundle.automaton.successors, bundle.automaton.successors)
    assert new.slots_corrected >= 1
    assert new.bundle.expected is None  # it was the old instrument's
    assert new.bundle.provenance["refit"]["objects"] == 4000
    assert new.bundle.golden_walks is not None


def test_an_automaton_that_is_right_stays_as_it_is() -> None:
    from dataclasses import replace

    from pans.runtime.bundle import make_bundle
    from pans.runtime.bundle.model import Shown

    bundle = small_automaton_bundle()
    assert bundle.automaton is not None
    rates = np.random.default_rng(3).uniform(0.1, 0.9, (bundle.n_classes, bundle.n_features))
    right = replace(bundle.automaton, posteriors=exact_posteriors(bundle.automaton, rates))
    shown = Shown(bundle.levels, bundle.pattern_levels, bundle.photons_per_level)
    made = make_bundle(
        name="right", task="t", classes=bundle.classes, image_shape=bundle.image_shape, optics=shown,
        provenance={}, automaton=right,
    )  # fmt: skip
    clicks = walks(made, rates, 500, 4)
    rows = rows_of(made, clicks)
    found = choose(rows.evidence, kinds_for(rows.evidence, rows=True))
    assert found.correction is None
    new = rebuilt(made, rows, found, clicks, {})
    assert np.array_equal(new.bundle.automaton.posteriors, right.posteriors)


def test_the_rows_of_an_automaton_are_its_leaves() -> None:
    bundle = small_automaton_bundle()
    assert bundle.automaton is not None
    rates = np.full((bundle.n_classes, bundle.n_features), 0.5)
    clicks = walks(bundle, rates, 100, 5)
    rows = rows_of(bundle, clicks)
    reached = walk_nodes(bundle.automaton, clicks.counts)[:, -1]
    assert np.array_equal(rows.number[rows.evidence.row], reached)
    wanted = np.log(bundle.automaton.posteriors[reached])
    assert log_softmax(rows.evidence.scores)[rows.evidence.row] == pytest.approx(wanted, abs=1e-5)
