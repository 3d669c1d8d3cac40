"""What an automaton does: sums against an enumeration of all walks, sampled walks, and pictures of them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from automata import automaton_bundle, diamond, early_leaf, random_automaton
from bundles import made_bundle

from pans.runtime.bundle.model import with_expected, write_bundle
from pans.trainer.frontier.explained import automaton_of, entropy_of, explain, sample_walk, state_light
from pans.trainer.tasks.registry import Objects, Task

AUTOMATA = {"early": early_leaf(), "diamond": diamond(), "random": random_automaton(3)}


def all_walks(bundle, transmission):
    """(chance, nodes, clicks, expected) of every walk of one object, by plain recursion."""
    automaton, light = bundle.automaton, state_light(bundle)
    going = [(1.0, [0], [], [])]
    while going:
        chance, nodes, clicks, expected = going.pop()
        if nodes[-1] >= automaton.n_states:
            yield chance, nodes, clicks, expected
            continue
        mean = sum(a * b for a, b in zip(light[nodes[-1]].tolist(), transmission))
        for clicked, p in ((0, math.exp(-mean)), (1, 1 - math.exp(-mean))):
            after = int(automaton.successors[nodes[-1], clicked])
            going.append((chance * p, [*nodes, after], [*clicks, clicked], [*expected, mean]))


def entropy(posterior):
    return -sum(p * math.log2(p) for p in posterior if p > 0)


@pytest.mark.parametrize("name", AUTOMATA)
def test_the_sums_are_those_over_all_walks(name):
    bundle = automaton_bundle(AUTOMATA[name])
    automaton, n = bundle.automaton, 3
    objects = np.random.default_rng(1).random((n, 4))
    found = explain(bundle, objects)
    slots, nodes_in_all = automaton.n_slots, len(automaton.posteriors)
    reach, clicked = np.zeros(nodes_in_all), np.zeros(automaton.n_states)
    photons, clicks, lit, after = np.zeros(slots), np.zeros(slots), np.zeros(slots), np.zeros(slots + 1)
    pixels = np.zeros(4)
    for row in objects:
        for chance, nodes, bits, expected in all_walks(bundle, row.tolist()):
            share = chance / n
            for k, (node, bit, mean) in enumerate(zip(nodes, bits, expected)):
                clicked[node] += share * bit
                photons[k] += share * mean
                clicks[k] += share * bit
                lit[k] += share
                pixels += share * state_light(bundle)[node]
            reach[nodes] += share
            for made in range(slots + 1):
                after[made] += share * entropy(automaton.posteriors[nodes[min(made, len(nodes) - 1)]].tolist())
    np.testing.assert_allclose(found.reach, reach, atol=1e-12)
    np.testing.assert_allclose(found.click, clicked / reach[: automaton.n_states], rtol=1e-9)
    for ours, wanted in (
        (found.photons, photons),
        (found.clicks, clicks),
        (found.lit, lit),
        (found.pixel_light, pixels),
    ):
        np.testing.assert_allclose(ours, wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.entropy[:, 0], after, rtol=1e-6)
    assert (found.entropy[:, 1] <= found.entropy[:, 2]).all()


def test_the_tenths_hold_four_fifths_of_the_walks():
    bundle = automaton_bundle(random_automaton(5, slots=5))
    row = np.random.default_rng(2).random(4)
    found = explain(bundle, row[None])
    ends = [
        (chance, entropy(bundle.automaton.posteriors[nodes[-1]].tolist()))
        for chance, nodes, _, _ in all_walks(bundle, row.tolist())
    ]
    low, high = found.entropy[-1, 1:]
    assert (
        sum(chance for chance, bits in ends if bits < low - 1e-6)
        <= 0.1
        <= sum(chance for chance, bits in ends if bits <= low + 1e-6)
    )
    assert (
        sum(chance for chance, bits in ends if bits < high - 1e-6)
        <= 0.9
        <= sum(chance for chance, bits in ends if bits <= high + 1e-6)
    )


def test_sampled_walks_come_as_often_as_they_should():
    bundle, n = automaton_bundle(diamond()), 3000
    row = np.random.default_rng(4).random(4)
    rng = np.random.default_rng(5)
    seen = [tuple(sample_walk(bundle, row, rng).nodes.tolist()) for _ in range(n)]
    chances: dict[tuple[int, ...], float] = {}
    for chance, nodes, _, _ in all_walks(bundle, row.tolist()):
        chances[tuple(nodes)] = chances.get(tuple(nodes), 0.0) + chance
    for nodes, p in chances.items():
        assert abs(seen.count(nodes) / n - p) < 5 * math.sqrt(p * (1 - p) / n) + 1e-12
    walk = sample_walk(bundle, row, rng)
    assert len(walk.nodes) == len(walk.states) + 1 == len(walk.clicks) + 1 == len(walk.expected) + 1


def test_entropy_is_that_of_the_definition_and_0_where_all_is_known():
    rows = np.array([[1.0, 0.0], [0.5, 0.5], [0.25, 0.75]])
    np.testing.assert_allclose(entropy_of(rows), [0.0, 1.0, entropy([0.25, 0.75])])


def test_a_bundle_without_an_automaton_or_no_objects_are_refused():
    with pytest.raises(ValueError, match="has no automaton"):
        automaton_of(made_bundle(table=np.full((4, 2), 0.5)))
    with pytest.raises(ValueError, match="no objects"):
        explain(automaton_bundle(), np.zeros((0, 4)))


def test_every_picture_is_drawn(tmp_path):
    image = pytest.importorskip("matplotlib.image")
    pytest.importorskip("torch", reason="needs the train extra")
    from pans.trainer.frontier import pictures

    facts = {
        "profile": "ideal",
        "task": "t",
        "split": "test",
        "objects": 9,
        "accuracy": 0.5,
        "clicks": 1.0,
        "photons": 12.3,
    }
    bundle = automaton_bundle(random_automaton(6, slots=20, width=4), task="a-task-of-long-name")
    bundle = with_expected(bundle, facts | {"illumination": 100.0, "exposures": 12.0})
    write_bundle(bundle, tmp_path / "a.pans")
    rng = np.random.default_rng(0)
    objects = Objects(rng.integers(0, 256, (9, 2, 2)).astype(np.uint8), np.arange(9) % 3)
    shown = pictures.shown_automaton(
        tmp_path / "a.pans", Task("t", ("Shirt", "Sneaker", "c"), objects, objects, "0" * 64, "")
    )
    assert [name for name, _, _ in shown.walks] == ["Sneaker", "Shirt"]
    assert [
        int(objects.labels[[np.array_equal(i, picture) for i in objects.images].index(True)])
        for _, picture, _ in shown.walks
    ] == [1, 0]
    sizes = {}
    for draw in (pictures.tree, pictures.walks, pictures.light, pictures.entropy):
        path = tmp_path / f"{draw.__name__}.png"
        draw(path, shown)
        drawn = image.imread(path)[..., :3]
        sizes[draw.__name__] = drawn.shape
        assert drawn.std() > 0.01
        for edge in (drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]):
            assert (edge == 1).all()  # nothing is cut off at the edge
    assert len(set(sizes.values())) > 1


def test_the_walks_of_the_oracle_are_all_of_them():
    for automaton in AUTOMATA.values():
        bundle = automaton_bundle(automaton)
        total = sum(chance for chance, *_ in all_walks(bundle, [0.3, 0.2, 0.9, 1.0]))
        assert total == pytest.approx(1.0)
    assert len(list(itertools.islice(all_walks(automaton_bundle(early_leaf()), [1, 1, 1, 1]), 9))) == 3
