"""The head's own kernels against plain loops, against float64, one by one and in a batch; what rounding the patterns costs."""

import naive_decide as naive
import numpy as np
import pytest
from bundles import made_bundle
from heads import head_bundle, onnx_chain, random_layers
from models import parsed

from pans.base.errors import UsageError
from pans.bundle.backends.choose import make_decider
from pans.bundle.backends.int8 import Int8Decider, SparseDecider, golden_counts
from pans.bundle.backends.table import count_table, fits_count_table
from pans.bundle.backends.verdict import softmax_winner
from pans.bundle.heads.layers import Int8Head, Layer, quantise_head, read_layers, reference_scores
from pans.bundle.making.cost import quantisation_cost
from pans.bundle.sensor import Bundle, bundle_bytes, parse_bundle

SHAPES = [[5, 3], [10, 24, 10], [7, 33, 17, 4]]
EPSILON = 2.0**-24  # float32: half a unit in the last place of 1


def counts_of(n_features: int, shots: int, n: int = 40, seed: int = 1) -> np.ndarray:
    counts = np.random.default_rng(seed).integers(0, shots + 1, (n, n_features))
    counts[0], counts[1] = 0, shots
    return counts


def error_bound(layers: tuple[Layer, ...], means: np.ndarray) -> np.ndarray:
    """What rounding may do at most: (operations + 2) half units of the sum of all magnitudes, layer by layer."""
    size, bound = means.astype(np.float64), np.zeros(means.shape)
    for layer in layers:
        weights = np.abs(layer.weights.astype(np.float64))
        grown = size @ weights + np.abs(layer.bias)
        bound = bound @ weights + (len(weights) + 2) * EPSILON * grown
        size = grown
    return bound


@pytest.mark.uncompiled("1-sizes0")
@pytest.mark.parametrize("sizes", SHAPES)
@pytest.mark.parametrize("shots", [1, 7])
def test_sparse_scores_are_the_oracles_within_the_bound_of_rounding(sizes: list[int], shots: int) -> None:
    layers = random_layers(sizes)
    decider = SparseDecider(head_bundle(layers))
    counts = counts_of(sizes[0], shots)
    found = decider.scores_batch(counts, shots)
    plain = [(layer.weights.tolist(), layer.bias.tolist(), layer.relu) for layer in layers]
    wanted = np.array([naive.mlp_scores(row, shots, plain) for row in counts.tolist()])
    bound = error_bound(layers, counts / shots) + EPSILON * 4 * np.abs(wanted)
    assert (np.abs(found - wanted) <= bound).all()
    np.testing.assert_allclose(reference_scores(layers, counts / shots), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("backend", ["sparse", "int8"])
def test_one_alone_and_many_give_the_same_bits(backend: str) -> None:
    layers = random_layers([10, 40, 6])
    decider = make_decider(head_bundle(layers, int8_head=quantise_head(layers)), backend=backend)
    for shots in (1, 5):
        counts = counts_of(10, shots)
        labels, probabilities = decider.verdicts(counts, shots)
        scores = decider.scores_batch(counts, shots)
        assert decider.decide_batch(counts, shots).tolist() == labels.tolist() == scores.argmax(axis=1).tolist()
        for row, label, probability, score in zip(counts, labels, probabilities, scores):
            verdict = decider.decide(row, shots)
            assert (verdict.label, np.float32(verdict.probability)) == (label, probability)
            assert verdict.probability == pytest.approx(softmax_winner(score).probability, rel=1e-6)


@pytest.mark.uncompiled
def test_ties_and_scores_that_are_not_finite() -> None:
    flat = (Layer(np.zeros((3, 4), np.float32), np.array([1, 2, 2, 0], np.float32), False),)
    decider = SparseDecider(head_bundle(flat))
    assert decider.decide(np.zeros(3, np.int64), 1).label == 1
    steep = (Layer(np.array([[3e38, 1]], np.float32), np.array([3e38, 0], np.float32), False),)
    large = SparseDecider(head_bundle((Layer(steep[0].weights * 0, steep[0].bias * 0, False),)))
    numbers = np.zeros(4, np.float32)
    numbers[[0, 1, 2]] = 3e38, 1, 3e38  # one row of weights, then the biases: their sum is no float32
    meta = large.layers.meta.copy()
    meta[-2] = 0  # no groups: the rows are added as they are
    large.layers = large.layers._replace(meta=meta, numbers=numbers)
    verdict = large.decide(np.ones(1, np.int64), 1)
    assert verdict.probability == 0.0


@pytest.mark.parametrize(("style", "float_data"), [("gemm", False), ("transposed", False), ("matmul", True)])
def test_layers_are_read_from_onnx(style: str, float_data: bool) -> None:
    layers = random_layers([4, 9, 3])
    found = read_layers(onnx_chain(layers, style, float_data), 4, 3)
    for wanted, layer in zip(layers, found or (), strict=True):
        assert np.array_equal(layer.weights, wanted.weights)
        assert np.array_equal(layer.bias, wanted.bias)
        assert layer.relu == wanted.relu


def test_what_is_no_plain_chain_is_left_to_onnxruntime() -> None:
    pytest.importorskip("onnx")
    model = parsed("sums = MatMul(means, w) scores = Sigmoid(sums)", 2, w=np.ones((2, 2), np.float32))
    assert read_layers(model.SerializeToString(), 2, 2) is None
    assert read_layers(b"\xff\xff", 2, 2) is None
    assert read_layers(onnx_chain(random_layers([4, 3])), 4, 2) is None


def test_golden_means_are_told_as_counts() -> None:
    means = np.array([[0, 1], [1 / 3, 1], [0.5, 0.25], [0.123, 0.4]], np.float32)
    rows, counts, shots = golden_counts(means)
    assert rows.tolist() == [0, 1, 2]
    assert (counts.tolist(), shots.tolist()) == ([[0, 1], [1, 3], [2, 1]], [1, 3, 4])


def test_a_table_of_counts_is_exactly_the_head() -> None:
    bundle = head_bundle(random_layers([4, 16, 5]))
    decider = count_table(bundle, 3)
    every = np.array([[r // 4**i % 4 for i in range(4)] for r in range(256)])
    onnx = make_decider(bundle, backend="onnx")
    assert (decider.scores_batch(every, 3) == onnx.scores_batch(every, 3)).all()
    assert (decider.decide_batch(every, 3) == onnx.decide_batch(every, 3)).all()
    for row in every[::17]:
        assert decider.decide(row, 3).label == decider.decide_batch(row[None], 3)[0]
    with pytest.raises(UsageError, match="answers 3 shots"):
        decider.decide(every[0], 2)


def test_tables_of_counts_stay_small() -> None:
    assert [fits_count_table(*size) for size in ((16, 1), (17, 1), (4000, 60000))] == [True, False, False]
    with pytest.raises(UsageError, match="rows"):
        count_table(head_bundle(random_layers([13, 4])), 4)


@pytest.mark.uncompiled("5-sizes1")
@pytest.mark.parametrize("sizes", SHAPES)
@pytest.mark.parametrize("shots", [1, 5])
def test_int8_scores_are_those_of_the_definition(sizes: list[int], shots: int) -> None:
    layers = random_layers(sizes)
    head = quantise_head(layers)
    decider = Int8Decider(head_bundle(layers, int8_head=head))
    counts = counts_of(sizes[0], shots)
    wanted = naive.int8_reference(head, counts, shots)
    np.testing.assert_allclose(decider.scores_batch(counts, shots), wanted, rtol=3e-7, atol=1e-6)


def test_int8_errors_stay_within_their_bound() -> None:
    """Rounding moves a weight by at most half its column's scale and a hidden value by half a step; nothing else happens."""
    layers = random_layers([12, 64, 6], seed=4)
    calibration = counts_of(12, 1, 4096, seed=2)
    head = quantise_head(layers, calibration)
    (w1, s1, _), (w2, s2, _) = head.matrices()
    step = np.maximum(calibration @ layers[0].weights + layers[0].bias, 0).max(0) * 1.05 / 255
    step = np.where(step > 0, step, 1 / 255)
    found, wanted = naive.int8_reference(head, calibration, 1), reference_scores(layers, calibration)
    hidden_error = calibration.sum(1)[:, None] * (s1 * step / 2)[None, :] + step / 2
    hidden = np.maximum(calibration @ layers[0].weights.astype(float) + layers[0].bias, 0)
    bound = hidden_error @ np.abs(layers[1].weights.astype(float))
    bound += (hidden / step + 1) @ (s2 / 2 * np.ones((64, 6))) * 1.02
    assert (np.abs(found - wanted) <= bound).all()
    assert np.abs(found - wanted).max() < 0.1 * np.abs(wanted).max()
    assert w1.dtype == w2.dtype == np.int8
    assert np.abs(w1.astype(int)).max() == 127


def test_dead_units_and_columns_do_no_harm() -> None:
    weights = np.array([[0.0, -1.0], [0.0, -2.0]], np.float32)
    layers = (Layer(weights, np.array([0.0, -1.0], np.float32), True), Layer(weights, np.zeros(2, np.float32), False))
    head = quantise_head(layers)
    assert np.isfinite(head.affine).all()
    assert naive.int8_reference(head, np.array([[1, 1]]), 1).tolist() == [[0.0, 0.0]]


def test_heads_that_eight_bits_cannot_hold_are_refused() -> None:
    with pytest.raises(ValueError, match="rectified"):
        quantise_head(tuple(Layer(layer.weights, layer.bias, False) for layer in random_layers([3, 4, 2])))
    infinite = (Layer(np.full((2, 2), np.inf, np.float32), np.zeros(2, np.float32), False),)
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="finite"):
        quantise_head(infinite)


def test_a_bundle_keeps_its_int8_head() -> None:
    layers = random_layers([6, 8, 3])
    head = quantise_head(layers)
    bundle = head_bundle(layers, int8_head=head, int8_onnx=onnx_chain(layers))
    back = parse_bundle(bundle_bytes(bundle), "test")
    assert back.int8_head is not None
    for name in ("sizes", "weights", "affine"):
        assert (getattr(back.int8_head, name) == getattr(head, name)).all()
        assert getattr(back.int8_head, name).dtype == getattr(head, name).dtype
    assert back.int8_onnx == bundle.int8_onnx
    assert make_decider(back, backend="int8-onnx").name == "int8-onnx"
    counts = counts_of(6, 1)
    found = make_decider(back, backend="int8").scores_batch(counts, 1)
    assert (found == Int8Decider(bundle).scores_batch(counts, 1)).all()


def test_int8_heads_of_wrong_shape_are_refused() -> None:
    layers = random_layers([6, 8, 3])
    head = quantise_head(layers)
    for change in ({"sizes": np.array([6, 8, 4])}, {"weights": head.weights[1:]}, {"affine": head.affine[:, 1:]}):
        parts = {name: getattr(head, name) for name in ("sizes", "weights", "affine")} | change
        with pytest.raises(UsageError, match="int8"):
            head_bundle(layers, int8_head=Int8Head(**parts))


@pytest.mark.parametrize(("d_f", "bits"), [(1, 5), (10, 5), (11, 5), (32, 4), (64, 0)])
def test_single_shots_from_groups_of_patterns(d_f: int, bits: int) -> None:
    """Fewer sums than row by row, each rounded once: no further from float64, give or take a half."""
    layers = random_layers([d_f, 512, 10], seed=d_f)
    decider = SparseDecider(head_bundle(layers))
    assert int(decider.layers.meta[-2]) == bits
    counts = np.random.default_rng(d_f).integers(0, 2, (300, d_f))
    found = decider.scores_batch(counts, 1)
    wanted = reference_scores(layers, counts.astype(np.float64))
    meta = decider.layers.meta.copy()
    meta[-2] = 0
    grouped, decider.layers = decider.layers, decider.layers._replace(meta=meta)
    plain = decider.scores_batch(counts, 1)
    decider.layers = grouped
    assert (found != plain).any() == (bits > 0 and d_f > 5)
    assert np.abs(found - wanted).max() <= 1.5 * np.abs(plain - wanted).max() + 1e-7
    alone = [decider.decide(row, 1).label for row in counts]
    assert alone == decider.decide_batch(counts, 1).tolist()


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
