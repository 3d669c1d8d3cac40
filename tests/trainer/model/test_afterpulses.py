"""Afterpulses that training and evaluation go through: against sums over all click words, one by one."""

# ruff: noqa: E402  (what follows needs torch)
from __future__ import annotations

from dataclasses import replace
from itertools import product

import naive_automaton as naive
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from automata import early_leaf, random_automaton
from bundles import made_bundle
from trainings import random_machine

from pans.runtime.bundle import Automaton
from pans.runtime.decide.expectation import expected_walk
from pans.runtime.detector import Afterpulses
from pans.runtime.instrument.click_law import ClickLaw
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.machine import Sight, forward
from pans.trainer.evaluate.accuracy import evaluate_exactly, evaluate_sampled, light_of
from pans.trainer.evaluate.readings import Chain
from pans.trainer.model.detection import trained_through, with_mean_memory

LAW = Afterpulses(0.15, 2.0, 0.1)


def chances_of_words(first: list[float], law: Afterpulses, begins: np.ndarray) -> dict[tuple[int, ...], float]:
    """The chance of every word, one at a time: the memory follows from its clicks."""
    found = {}
    for word in product((0, 1), repeat=len(first)):
        chance, memory = 1.0, begins
        for p, clicked in zip(first, word):
            click = float(law.chance(p, memory))
            chance *= click if clicked else 1 - click
            memory = law.after(-np.log1p(-p), memory, clicked)
        found[word] = chance
    return found


@pytest.mark.parametrize("law", [LAW, Afterpulses(0.2), Afterpulses(0.05, 1.0, 0.3, True)])
def test_words_and_their_draws_are_those_of_the_chain(law: Afterpulses) -> None:
    first = np.random.default_rng(0).random((3, 5)) * 0.8
    chain = Chain.of(first, law)
    assert chain.begins[0] > 0
    words = chain.word_chances(slice(None))
    for i, row in enumerate(first.tolist()):
        for word, chance in chances_of_words(row, law, chain.begins).items():
            assert words[i, sum(bit << k for k, bit in enumerate(word))] == pytest.approx(chance, rel=1e-9)
    bits = (np.arange(32)[:, None] >> np.arange(5)) & 1
    assert chain.mean_chances() == pytest.approx(words @ bits, abs=2e-3)
    many = Chain.of(np.repeat(first, 20_000, axis=0), law)
    drawn = many.counts(1, np.random.default_rng(1), slice(None)).reshape(3, 20_000, 5).mean(axis=1)
    assert drawn == pytest.approx(words @ bits, abs=4.5 * 0.5 / np.sqrt(20_000))
    assert (words @ bits > first).all()


def test_training_has_the_mean_chances_of_the_evaluation_and_their_gradient() -> None:
    first = np.random.default_rng(2).random((4, 6)) * 0.7 + 0.05
    found, law = with_mean_memory(torch.tensor(first), LAW), Afterpulses(0.05, 2.0, 0.1)
    assert found.numpy() == pytest.approx(Chain.of(first, LAW).mean_chances(), abs=4e-3)
    assert with_mean_memory(torch.tensor(first), law).numpy() == pytest.approx(
        Chain.of(first, law).mean_chances(), abs=5e-4
    )
    few = torch.tensor(first[:1], requires_grad=True)
    one = torch.tensor(first[:1], requires_grad=True)
    with_mean_memory(few, LAW)[0, 5].backward()
    assert few.grad is not None
    assert (few.grad[0, :5] > 0).all()  # more light before means more clicks behind
    step = 1e-6
    for i in (1, 4):  # the memory of the begin stands still in the gradient, and is the same to first order
        up, down = one.detach().clone(), one.detach().clone()
        up[0, i] += step
        down[0, i] -= step
        slope = float(with_mean_memory(up, LAW)[0, 5] - with_mean_memory(down, LAW)[0, 5]) / (2 * step)
        assert float(few.grad[0, i]) == pytest.approx(slope, rel=0.1)
    assert with_mean_memory(few, None) is few


def test_what_is_trained_through_is_what_has_a_time_constant() -> None:
    profile = load_profile("dmd-spad")
    assert trained_through(profile, 100.0) is None
    timed = replace(profile, detector=replace(profile.detector, afterpulse_time_us=50.0))
    assert trained_through(timed, 100.0) == Afterpulses(0.005, 0.5, 0.03, dead=0.024 / 100)


def test_exact_and_sampled_figures_of_fixed_patterns_agree() -> None:
    profile = load_profile("dmd-spad")
    detector = replace(profile.detector, afterpulse_probability=0.3, afterpulse_time_us=100.0)
    table = np.array([[0.9, 0.1], [0.4, 0.6], [0.4, 0.6], [0.1, 0.9]])
    bundle = made_bundle(photons_per_level=0.7, table=table)
    images = np.random.default_rng(3).integers(0, 256, (20, *bundle.image_shape), dtype=np.uint8)
    labels = np.arange(20) % bundle.n_classes
    light = light_of(bundle, replace(profile, detector=detector), images)
    exact = evaluate_exactly(bundle, light, labels)
    sampled = evaluate_sampled(bundle, light, labels, trials=2000)
    assert abs(exact.accuracy_mean - sampled.accuracy_mean) < 4.5 * sampled.accuracy_std / np.sqrt(2000)
    assert exact.clicks_mean == pytest.approx(sampled.clicks_mean, rel=0.02)
    quiet = light_of(bundle, replace(profile, detector=replace(detector, afterpulse_probability=0.0)), images)
    assert exact.clicks_mean > 1.05 * evaluate_exactly(bundle, quiet, labels).clicks_mean


def tree(slots: int) -> Automaton:
    """Every walk has states of its own: the mean memory of a state is then that of the one walk that leads there."""
    n = (1 << slots) - 1
    posteriors = np.full((2 * n + 1, 2), 0.5)
    return Automaton(np.arange(n) % 3, np.full(n, 4), 4, [[2 * s + 1, 2 * s + 2] for s in range(n)], posteriors)


@pytest.mark.parametrize("law", [LAW, Afterpulses(0.05, 1.0, 0.3, True)])
def test_expected_walks_are_sums_over_words_where_each_walk_has_its_states(law: Afterpulses) -> None:
    automaton, rng = tree(4), np.random.default_rng(1)
    patterns, seen = rng.random((3, 5)) * 0.5, rng.random((2, 5))
    found = expected_walk(automaton, patterns, seen, ClickLaw(0.01), afterpulses=law, begins=(0.07, 0.02))
    for i in range(2):
        first = -np.expm1(-(patterns[automaton.pattern] @ seen[i] + 0.01))
        for word in product((0, 1), repeat=4):
            passed, chance, memory = naive.walk(automaton, word), 1.0, np.array([0.07, 0.02])
            for state, clicked in zip(passed.states, word):
                click = float(law.chance(first[state], memory))
                chance *= click if clicked else 1 - click
                memory = law.after(-np.log1p(-first[state]), memory, clicked)
            assert found.leaves[i, passed.leaf] == pytest.approx(chance, rel=1e-9)


def test_where_walks_meet_their_mean_memory_is_near_what_is_drawn() -> None:
    automaton, rng = random_automaton(5, slots=8), np.random.default_rng(1)
    patterns, seen = rng.random((int(automaton.pattern.max()) + 1, 5)) * 0.5, rng.random((1, 5))
    law = Afterpulses(0.1, 2.0)
    found = expected_walk(automaton, patterns, seen, ClickLaw(), afterpulses=law)
    light = (patterns[automaton.pattern] @ seen[0]) * automaton.dwell / automaton.dwell_steps
    clicks, leaves, n = 0.0, np.zeros(automaton.n_leaves), 0
    for word, passed in {
        w[: len(naive.walk(automaton, w).states)]: naive.walk(automaton, w) for w in product((0, 1), repeat=8)
    }.items():
        chance, memory = 1.0, np.zeros(2)
        for state, clicked in zip(passed.states, word):
            click = float(law.chance(-np.expm1(-light[state]), memory))
            chance *= click if clicked else 1 - click
            memory = law.after(light[state], memory, clicked)
        clicks, n = clicks + chance * sum(word), n + 1
        leaves[passed.leaf] += chance
    assert found.leaves[0] == pytest.approx(leaves, abs=1e-3)
    assert found.clicks[0] == pytest.approx(clicks, abs=2e-3)
    without = expected_walk(automaton, patterns, seen, ClickLaw())
    assert np.abs(found.leaves[0] - without.leaves[0]).max() > 5e-3
    assert expected_walk(early_leaf(), rng.random((4, 5)), seen, ClickLaw(), afterpulses=law).ends is not None


def test_a_machine_in_training_clicks_as_its_expectation() -> None:
    machine, grey = random_machine(1), torch.tensor([[0, 10, 255, 30, 7]], dtype=torch.float64)
    sight = Sight(ClickLaw(0.05), 1 / 255, 0.0, torch.float64, afterpulses=LAW)
    passed, plain = forward(machine, sight, grey), forward(machine, sight.exact(), grey)
    assert torch.cat(passed.leaves).sum().item() == pytest.approx(1.0, abs=1e-12)
    first, second = passed.steps[0], passed.steps[1]
    assert torch.equal(first.dark, plain.steps[0].dark)  # nothing before the first exposure
    silent = float(first.dark[0, 0])
    after_click = float(LAW.sight(LAW.after(-np.log(silent), np.zeros(2), 1)))
    ways = machine.levels[0].successors[:, 0].tolist()
    if ways[0] != ways[1]:
        for clicked, node in enumerate(ways):
            if node < len(second.dark):
                wanted = float(plain.steps[1].dark[node, 0]) * np.exp(-after_click * clicked)
                assert float(second.dark[node, 0]) == pytest.approx(wanted, rel=1e-9)
    assert float(passed.clicks()) > 1.01 * float(plain.clicks())
