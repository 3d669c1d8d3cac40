"""The fits: against sums written out, against rates that are known, and against a Pólya urn drawn ball by ball."""

import math
from itertools import pairwise

import numpy as np
import onnxruntime
import pytest

from pans.bundle.heads.layers import Layer, read_layers, reference_scores
from pans.calibrate.refit.evidence import KAPPAS, best_kappa, fit, log_likelihood, log_softmax, shrunk
from pans.calibrate.refit.rebuild import chain_onnx, corrected_layers

BLOCKS = ("bias", "scores", "clicks")


def case(seed: int, rows: int = 40, classes: int = 3, clicks: int = 4):
    rng = np.random.default_rng(seed)
    scores = rng.normal(size=(rows, classes))
    scores -= scores.mean(axis=1, keepdims=True)
    bits = rng.integers(0, 2, (rows, clicks)).astype(float)
    counts = rng.integers(0, 4, (rows, classes)).astype(float)
    return scores, bits, counts


def test_no_step_in_any_direction_makes_the_fit_likelier() -> None:
    scores, bits, counts = case(1)
    found, prior = fit(BLOCKS, scores, bits, counts)
    total = counts.sum()
    raw = np.concatenate([scores, bits], axis=1)
    weight = counts.sum(axis=1) / total
    mean = weight @ raw
    spread = np.sqrt(weight @ (raw - mean) ** 2)

    def loss(weights):  # standardised features, a term per decision and a term per weight
        value = 0.0
        for row in range(len(raw)):
            features = [1.0, *((raw[row] - mean) / spread)]
            logits = scores[row] + np.array(features) @ weights
            value -= sum(n * (logits[c] - math.log(np.exp(logits).sum())) for c, n in enumerate(counts[row]))
        widths = [prior.precision[0]] + [prior.precision[1]] * 3 + [prior.precision[2]] * 4
        return value + 0.5 * sum(width * (row**2).sum() for width, row in zip(widths, weights))

    best, rng = loss(prior.weights), np.random.default_rng(2)
    for _ in range(30):
        assert loss(prior.weights + 1e-3 * rng.normal(size=prior.weights.shape)) > best
    logits = scores + (raw - mean) / spread @ prior.weights[1:] + prior.weights[0]
    assert np.allclose(log_softmax(found.apply(scores, bits)), log_softmax(logits))


def test_changed_click_rates_are_found() -> None:
    """Independent clicks whose rates changed: the exact posteriors are the old ones and a term linear in the clicks."""
    rng = np.random.default_rng(3)
    words = np.arange(64)[:, None] >> np.arange(6) & 1
    old, new = rng.uniform(0.1, 0.9, (2, 4, 6))
    chance = [np.prod(np.where(words[:, None, :], rate, 1 - rate), axis=2) for rate in (old, new)]
    seen = np.stack([rng.multinomial(50_000, one) for one in chance[1].T], axis=1).astype(float)
    before = np.log(chance[0] / chance[0].sum(axis=1, keepdims=True))
    before -= before.mean(axis=1, keepdims=True)
    exact = chance[1] / chance[1].sum(axis=1, keepdims=True)
    found, _ = fit(("bias", "clicks"), before, words.astype(float), seen)
    after = np.exp(log_softmax(found.apply(before, words.astype(float))))
    assert np.abs(after - exact).max() < 0.02 < np.abs(np.exp(log_softmax(before)) - exact).max()


def test_what_was_not_seen_to_differ_stays() -> None:
    scores, bits, _ = case(4, rows=200)
    rng = np.random.default_rng(5)
    counts = np.stack([rng.multinomial(5, one) for one in np.exp(log_softmax(scores))]).astype(float)
    found, prior = fit(BLOCKS, scores, bits, counts)
    assert prior.precision.min() > 20
    assert np.abs(np.exp(log_softmax(found.apply(scores, bits))) - np.exp(log_softmax(scores))).max() < 0.08


def test_how_the_counts_lie_in_rows_makes_no_difference() -> None:
    scores, bits, counts = case(10)
    whole, prior = fit(BLOCKS, scores, bits, counts)
    spread, again = fit(BLOCKS, *(np.tile(part, (150, 1)) for part in (scores, bits, counts / 150)))
    assert np.allclose(spread.gain, whole.gain, atol=1e-6)
    assert np.allclose(again.precision, prior.precision, rtol=1e-6)


def test_a_feature_that_never_varies_has_no_gain() -> None:
    scores, bits, counts = case(6)
    bits[:, 2] = 1.0
    found, _ = fit(BLOCKS, scores, bits, counts)
    assert not found.gain[3 + 2].any()


def test_the_marginal_likelihood_is_that_of_an_urn() -> None:
    belief, kappa, drawn = np.array([[0.5, 0.3, 0.2]]), 3.0, [0, 0, 2, 1, 0]
    logs, seen = 0.0, np.zeros(3)
    for label in drawn:
        logs += math.log((seen[label] + kappa * belief[0, label]) / (seen.sum() + kappa))
        seen[label] += 1
    assert log_likelihood(belief, seen[None], kappa) == pytest.approx(logs)
    assert shrunk(belief, seen[None], kappa)[0] == pytest.approx((seen + kappa * belief[0]) / 8)


@pytest.mark.parametrize(("weight", "low", "high"), [(3.0, 1.0, 8.0), (1e9, 200.0, KAPPAS[-1])])
def test_kappa_is_what_the_rows_were_drawn_with(weight: float, low: float, high: float) -> None:
    rng = np.random.default_rng(7)
    belief = rng.dirichlet(np.ones(4), 300)
    truth = belief if weight > 1e6 else np.stack([rng.dirichlet(weight * one) for one in belief])
    counts = np.stack([rng.multinomial(20, one) for one in truth]).astype(float)
    assert low <= best_kappa(belief, counts) <= high


@pytest.mark.parametrize("hidden", [(), (5,), (5, 7)])
@pytest.mark.parametrize("blocks", [("bias",), ("bias", "scores"), BLOCKS])
def test_a_corrected_head_answers_the_corrected_scores(hidden: tuple[int, ...], blocks: tuple[str, ...]) -> None:
    rng = np.random.default_rng(8)
    sizes = (4, *hidden, 3)
    layers = tuple(
        Layer(rng.normal(size=(a, b)).astype(np.float32), rng.normal(size=b).astype(np.float32), b != 3)
        for a, b in pairwise(sizes)
    )
    means = rng.integers(0, 3, (50, 4)) / 2
    scores = reference_scores(layers, means)
    scores -= scores.mean(axis=1, keepdims=True)
    found, _ = fit(blocks, scores, means, rng.integers(0, 4, (50, 3)).astype(float))
    wanted = found.apply(scores, means)
    new = corrected_layers(layers, found)
    assert np.allclose(reference_scores(new, means), wanted, atol=1e-5)
    model = chain_onnx(new)
    session = onnxruntime.InferenceSession(model)
    assert np.allclose(session.run(None, {"clicks": means.astype(np.float32)})[0], wanted, atol=1e-4)
    again = read_layers(model, 4, 3)
    assert again is not None
    assert all(np.array_equal(a.weights, b.weights) for a, b in zip(again, new))
