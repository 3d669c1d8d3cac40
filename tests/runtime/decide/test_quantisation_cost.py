"""What rounding the patterns costs: compared with an exact sum over all click words."""

from __future__ import annotations

import numpy as np
import pytest
from bundles import made_bundle

from pans.runtime.bundle.model import Bundle
from pans.runtime.decide.quantisation_cost import quantisation_cost

RNG = np.random.default_rng(3)
IMAGES = RNG.integers(0, 256, (300, 2, 2)).astype(np.uint8)
LABELS = (IMAGES[:, 0, 0] > IMAGES[:, 1, 1]).astype(np.int64)
PATTERNS = np.array([[3.4, 0.2, 0.1, 0.0], [0.0, 0.3, 0.1, 2.6]])
TABLE = np.array([[0.1, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 0.1]], np.float32)  # bit 0: the first pattern clicked


def bundle_of(step: float) -> Bundle:
    shown = {"levels": 64, "pattern_levels": np.rint(PATTERNS / step).astype(np.uint16), "photons_per_level": step}
    return made_bundle(classes=["low", "high"], image_shape=(2, 2), table=TABLE, **shown)


def exact(patterns: np.ndarray) -> float:
    """The accuracy as a sum over the four click words, with Poisson light."""
    miss = np.exp(-(IMAGES.reshape(-1, 4) / 255) @ patterns.T)
    total = 0.0
    for word in range(4):
        chance = np.prod([1 - miss[:, bit] if word >> bit & 1 else miss[:, bit] for bit in range(2)], axis=0)
        total += float((chance * (TABLE[word].argmax() == LABELS)).mean())
    return total


@pytest.mark.parametrize("step", [0.1, 1.5, 2.5])
def test_both_accuracies_are_those_of_their_patterns(step: float) -> None:
    bundle = bundle_of(step)
    cost = quantisation_cost(PATTERNS, bundle, IMAGES, LABELS, 0.0)
    sampled = 5 * 0.5 / np.sqrt(cost.objects * cost.trials)
    assert cost.accuracy_given == pytest.approx(exact(PATTERNS), abs=sampled)
    assert cost.accuracy_shown == pytest.approx(exact(bundle.patterns()), abs=sampled)
    change = exact(bundle.patterns()) - exact(PATTERNS)
    assert abs(cost.accuracy_shown - cost.accuracy_given - change) < 5 * cost.difference_se + 1e-9


def test_patterns_that_are_on_the_levels_cost_nothing() -> None:
    bundle = bundle_of(0.1)
    cost = quantisation_cost(bundle.patterns(), bundle, IMAGES, LABELS, 0.0)
    assert (cost.accuracy_given, cost.difference_se) == (cost.accuracy_shown, 0.0)


def test_what_does_not_fit_is_refused() -> None:
    for images, labels, said in (
        (IMAGES[:, :1], LABELS, "allowed with these patterns"),
        (IMAGES, LABELS + 1, "labels must be 0 to 1"),
        (IMAGES[:0], LABELS[:0], "labels must be"),
    ):
        with pytest.raises(ValueError, match=said):
            quantisation_cost(PATTERNS, bundle_of(0.1), images, labels, 0.0)
