"""Export: folded normalisation with dead and saturated channels, the ONNX graph, and parity of the written file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from heads import head_bundle, random_layers
from naive_decide import int8_reference
from trainings import bars_task, short_fits  # noqa: F401 - a fixture

from pans.base.errors import PansError, UsageError
from pans.bundle.backends.choose import make_decider
from pans.bundle.heads.layers import quantise_head
from pans.bundle.heads.layers import reference_scores as layer_scores
from pans.bundle.sensor.bundle import Shown, load_bundle
from pans.instrument.click_law import CountLaw
from pans.instrument.optics import imaging_of
from pans.instrument.profile import load_profile
from pans_trainer.evaluate.accuracy import evaluate_exactly, light_of
from pans_trainer.evaluate.held_out import HeldOut
from pans_trainer.evaluate.optics import figures_under, misalignment_curves
from pans_trainer.export import onnx_heads
from pans_trainer.export.automaton import export_automaton
from pans_trainer.export.onnx_heads import fold_normalisation, int8_onnx
from pans_trainer.export.writer import Description, compare, export, export_trained, reference_scores
from pans_trainer.model.heads import EPSILON, ConvHead, MlpHead
from pans_trainer.options import AutomatonOptions, Conditions, Options, check_options
from pans_trainer.train.automaton.train import train_automaton
from pans_trainer.train.gradient.loop import train

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


@pytest.mark.parametrize("value", [0.5, 1e-4, 0.999, 0.0, 1.0, 1e-12, 1 - 1e-12])
def test_a_folded_layer_is_normalisation_then_layer_without_dead_and_saturated_channels(value):
    weight, bias, gain, shift = RNG.normal(size=(7, 3)), RNG.normal(size=7), np.full(3, 1e3), RNG.normal(size=3)
    mean = np.array([0.4, value, 0.6])
    folded, folded_bias, dead = fold_normalisation(weight, bias, gain, shift, mean)
    assert dead == (() if 1e-5 < value < 1 - 1e-5 else (1,))
    assert np.all(folded[:, list(dead)] == 0)
    clicks = RNG.integers(0, 2, (20, 3)).astype(float)
    normal = (clicks - mean) / np.sqrt(mean * (1 - mean) + EPSILON) * gain
    normal[:, list(dead)] = 0
    assert clicks @ folded.T + folded_bias == pytest.approx((normal + shift) @ weight.T + bias, rel=1e-10)


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
    for backend in ("int8", "int8-onnx"):
        found = make_decider(again, backend=backend).scores_batch(words, 1)
        assert np.abs(found - wanted).max() < 0.02 * max(1, np.abs(wanted).max())


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


def test_a_wrong_fold_never_leaves_the_export(tmp_path, monkeypatch):
    fold = fold_normalisation
    monkeypatch.setattr(onnx_heads, "fold_normalisation", lambda *layer: fold(*layer[:4], layer[4] * 1.001))
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


def test_the_model_gives_the_scores_of_the_integers() -> None:
    layers = random_layers([16, 48, 10], seed=2)
    head = quantise_head(layers)
    bundle = head_bundle(layers, int8_head=head, int8_onnx=int8_onnx(head))
    counts = np.random.default_rng(0).integers(0, 2, (500, 16))
    found = make_decider(bundle, backend="int8-onnx").scores_batch(counts, 1)
    own = make_decider(bundle, backend="int8").scores_batch(counts, 1)
    wanted = int8_reference(head, counts, 1)
    steps = np.abs(head.matrices()[1][1]).max() * 127  # a hidden value at a half may round either way
    assert np.abs(found - wanted).max() <= 2 * steps
    assert (np.abs(found - wanted).max(axis=1) < 1e-5).mean() > 0.98
    assert (found.argmax(axis=1) == own.argmax(axis=1)).mean() > 0.99
    assert (layer_scores(layers, counts).argmax(axis=1) == own.argmax(axis=1)).mean() > 0.97


@pytest.mark.usefixtures("short_fits")
def test_trained_numbers_are_exported_as_they_were_trained(tmp_path: Path) -> None:
    task, profile = bars_task(), load_profile("dmd-qcmos")
    options = Options(3, photons=8.0, outcomes=4, estimator="local", epochs=6, hidden=16, batch=64, warm=0.5)
    trained = train(task, profile, options)
    assert isinstance(trained.law, CountLaw)
    assert trained.law.outcomes == 4
    exported = export_trained(tmp_path / "n.pans", trained, task, profile, name="n", provenance={})
    bundle, _ = load_bundle(tmp_path / "n.pans")
    assert (bundle.outcomes, exported.words_compared) == (4, 64)
    assert bundle.table is not None
    words = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
    with torch.no_grad():
        scores = trained.head(torch.from_numpy((words / 3).astype(np.float32))).numpy()
    assert np.allclose(bundle.table, scores, atol=1e-4)
    light = light_of(bundle, profile, task.test.images)
    found = evaluate_exactly(bundle, light, task.test.labels)
    assert found.accuracy_mean > 1.5 / len(task.classes)
    mean = trained.click_mean.numpy() * 3  # of the training objects, which the test objects are like
    assert np.allclose(mean, light_of(bundle, profile, task.train.images).probability.mean(axis=0), atol=0.02)


IDEAL = load_profile("ideal")
TABLE = "shift=0.2:psf=0.6:black=0.02"
HIDDEN = imaging_of("psf=0.6:black=0.02")
SMALL = AutomatonOptions(photons=4.0, exposures=5, states=8, batch=64, tune_epochs=2, epochs=4, first_price=0.1, soft=0)


def accuracy(bundle, task):
    return figures_under(bundle, HeldOut(task, task.test, IDEAL), HIDDEN, Conditions()).accuracy_mean


@pytest.mark.slow
def test_an_automaton_trained_through_optics_is_better_there_and_says_what_it_tolerates(tmp_path):
    task = bars_task()
    bundles = {}
    for name, optics in (("perfect", None), ("through", TABLE)):
        trained = train_automaton(task, IDEAL, replace(SMALL, optics=optics))
        made = export_automaton(tmp_path / f"{name}.pans", trained, task, IDEAL, name=name, provenance={})
        bundles[name] = made.bundle
    assert accuracy(bundles["through"], task) > accuracy(bundles["perfect"], task) + 0.03
    assert "tolerates" not in bundles["perfect"].provenance
    told = bundles["through"].provenance["tolerates"]
    assert told["optics"] == TABLE
    assert told["simulated"] is True
    assert (told["edge"]["tables"], told["middle"]["tables"]) == (4, 1)
    middle = figures_under(bundles["through"], HeldOut(task, task.test, IDEAL), HIDDEN, Conditions())
    assert told["middle"]["accuracy"] == pytest.approx(middle.accuracy_mean, abs=1e-5)
    assert told["edge"]["accuracy_worst"] <= told["edge"]["accuracy"]


@pytest.mark.usefixtures("short_fits")
def test_fixed_patterns_are_trained_through_optics_too(tmp_path):
    task = bars_task()
    options = Options(features=3, epochs=6, batch=64, hidden=16, alpha=0.0, optics=TABLE)
    check_options(options, IDEAL)
    trained = train(task, IDEAL, options)
    bundle = export_trained(tmp_path / "fixed.pans", trained, task, IDEAL, name="fixed", provenance={}).bundle
    told = bundle.provenance["tolerates"]
    assert told["within"]["tables"] == 16
    # of four classes, in six epochs
    assert told["within"]["accuracy"] > 0.25 + 5 * told["within"]["accuracy_se_objects"]
    curves = misalignment_curves(bundle, HeldOut(task, task.test.first(50), IDEAL), HIDDEN)
    assert curves["black"][0]["value"] == 0.0
    assert np.diff([point["photons_mean"] for point in curves["black"]]).min() > 0  # dark pixels bring light
    with pytest.raises(UsageError, match="coherent encoder shows no patterns"):
        check_options(replace(options, encoder="coherent", optics="psf=0.5"), IDEAL)
