"""Export: folded normalisation with dead and saturated channels, the ONNX graph, and parity of the written file."""

# ruff: noqa: E402  (what follows needs torch)
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")
onnx = pytest.importorskip("onnx", reason="needs the train extra")

from pans.runtime.bundle.model import Shown, load_bundle
from pans.runtime.errors import PansError
from pans.trainer.export import onnx_heads
from pans.trainer.export.onnx_heads import DEAD_VARIANCE, IR_VERSION, fold_normalisation, head_onnx
from pans.trainer.export.writer import Description, compare, export, reference_scores
from pans.trainer.model.heads import EPSILON, ConvHead, DeepHead, MlpHead

RNG = np.random.default_rng(0)


def trained_head(d_f, n_classes=4, seed=0):
    head = MlpHead(d_f, 16, n_classes, torch.Generator().manual_seed(seed))
    with torch.no_grad():
        head.norm.gain.copy_(torch.from_numpy(RNG.uniform(0.5, 2, d_f)))
        head.norm.bias.copy_(torch.from_numpy(RNG.normal(size=d_f)))
    return head.eval()


def written(path, head, mean, d_f):
    about = Description("small", "own", tuple("abcd"), (2, 3), {"seed": 0})
    levels = RNG.integers(0, 124, (d_f, 6)).astype(np.uint16)
    return export(path, head, mean, Shown(124, levels, 0.01), about)


def test_folded_layer_is_normalisation_then_layer():
    weight, bias, gain, shift = RNG.normal(size=(7, 5)), RNG.normal(size=7), RNG.normal(size=5), RNG.normal(size=5)
    mean = np.array([0.3, 0.5, 1e-4, 0.999, 0.7])
    folded, folded_bias, dead = fold_normalisation(weight, bias, gain, shift, mean)
    clicks = RNG.uniform(size=(20, 5))
    wanted = ((clicks - mean) / np.sqrt(mean * (1 - mean) + EPSILON) * gain + shift) @ weight.T + bias
    assert clicks @ folded.T + folded_bias == pytest.approx(wanted, rel=1e-12)
    assert dead == ()


@pytest.mark.parametrize("value", [0.0, 1.0, 1e-12, 1 - 1e-12])
def test_dead_and_saturated_channels_are_dropped_not_blown_up(value):
    weight, bias, gain, shift = RNG.normal(size=(7, 3)), RNG.normal(size=7), np.full(3, 1e3), RNG.normal(size=3)
    mean = np.array([0.4, value, 0.6])
    folded, folded_bias, dead = fold_normalisation(weight, bias, gain, shift, mean)
    assert dead == (1,)
    assert np.all(folded[:, 1] == 0)
    live = [0, 2]
    clicks = RNG.integers(0, 2, (20, 3)).astype(float)
    normal = (clicks[:, live] - mean[live]) / np.sqrt(mean[live] * (1 - mean[live]) + EPSILON) * gain[live] + shift[
        live
    ]
    wanted = normal @ weight[:, live].T + weight[:, 1] * shift[1] + bias
    assert clicks @ folded.T + folded_bias == pytest.approx(wanted, rel=1e-10)


def test_variance_of_a_barely_live_channel_is_kept():
    mean = np.array([2 * DEAD_VARIANCE])
    folded, _, dead = fold_normalisation(np.ones((1, 1)), np.zeros(1), np.ones(1), np.zeros(1), mean)
    assert dead == ()
    assert folded[0, 0] == pytest.approx(1 / np.sqrt(mean[0] * (1 - mean[0]) + EPSILON))


def test_graph_is_conservative():
    graph, _ = head_onnx(trained_head(5), np.full(5, 0.4))
    model = onnx.load_from_string(graph)
    assert model.ir_version == IR_VERSION <= 10  # what onnxruntime 1.18 reads
    assert model.opset_import[0].version <= 21
    assert [node.op_type for node in model.graph.node] == ["Gemm", "Relu", "Gemm"]


@pytest.mark.parametrize(
    "mean", [np.full(6, 0.4), np.array([0.0, 1.0, 0.5, 1e-9, 0.2, 0.9])], ids=["live", "dead ones"]
)
def test_written_bundle_decides_as_the_model_on_all_words(tmp_path, mean):
    head = trained_head(6)
    done = written(tmp_path / "small.pans", head, mean, 6)
    assert done.words_compared == 64
    assert done.score_difference <= 1e-5
    again, digest = load_bundle(tmp_path / "small.pans")
    assert digest == done.sha256
    words = (np.arange(64)[:, None] >> np.arange(6)) & 1
    wanted = reference_scores(head, mean, words.astype(np.float32))
    assert again.table == pytest.approx(wanted, abs=1e-5 * max(1, np.abs(wanted).max()))


def test_beyond_twelve_patterns_random_words_are_compared(tmp_path):
    done = written(tmp_path / "wide.pans", trained_head(14), np.full(14, 0.3), 14)
    assert done.words_compared == 10_000
    assert done.bundle.table is None


def test_patterns_in_another_order_are_held_against_the_model(tmp_path):
    head, mean, order = trained_head(5, seed=3), np.array([0.2, 0.0, 0.5, 0.7, 0.4]), [4, 2, 0, 1, 3]
    about = Description("small", "own", tuple("abcd"), (2, 3), {"seed": 0})
    levels = RNG.integers(0, 124, (5, 6)).astype(np.uint16)

    def ordering(_):
        return order, {"order": {"patterns": order}}

    shown = Shown(124, levels, 0.01)
    done = export(tmp_path / "small.pans", head, mean, shown, about, ordering=ordering)
    assert done.words_compared == 32
    np.testing.assert_array_equal(done.bundle.pattern_levels, levels[order])
    assert done.dead_patterns == (3,)  # pattern 1, where it is now
    assert done.bundle.provenance["order"] == {"patterns": order}
    with pytest.raises(PansError, match="differs from the trained model"):
        compare(done.bundle, head, mean)


def test_another_model_is_noticed(tmp_path):
    mean = np.full(6, 0.4)
    done = written(tmp_path / "small.pans", trained_head(6, seed=1), mean, 6)
    other = trained_head(6, seed=1)
    with torch.no_grad():
        other.output.bias[0] += 1e-3
    with pytest.raises(PansError, match="differs from the trained model"):
        compare(done.bundle, other, mean)


def test_a_wrong_fold_never_leaves_the_export(tmp_path, monkeypatch):
    def wrong(weight, bias, gain, shift, click_mean):
        return fold_normalisation(weight, bias, gain, shift, click_mean * 1.001)

    monkeypatch.setattr(onnx_heads, "fold_normalisation", wrong)
    with pytest.raises(PansError, match="differs from the trained model"):
        written(tmp_path / "small.pans", trained_head(6), np.full(6, 0.4), 6)
    assert not (tmp_path / "small.pans").exists()


@pytest.mark.parametrize("d_f", [2, 5, 12, 20])
def test_a_convolutional_head_is_exported_and_compared(d_f, tmp_path):
    head = ConvHead(d_f, 8, 4, torch.Generator().manual_seed(0)).eval()
    mean = RNG.uniform(0.1, 0.9, d_f)
    mean[0] = 0.0  # a dead pattern stays at its constant value
    done = written(tmp_path / "conv.pans", head, mean, d_f)
    assert done.dead_patterns == (0,)
    assert done.score_difference <= 1e-5
    assert done.words_compared == (1 << d_f if d_f <= 12 else 10_000)


def test_a_head_of_two_hidden_layers_is_exported_and_compared(tmp_path):
    done = written(
        tmp_path / "deep.pans", DeepHead(5, 8, 4, torch.Generator().manual_seed(0)).eval(), np.full(5, 0.3), 5
    )
    assert done.score_difference <= 1e-5
    assert done.words_compared == 32
