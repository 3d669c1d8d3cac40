"""Accuracy against dose: held against words and walks that are gone through one by one."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from bundles import automaton_bundle, made_bundle, six_states

from pans.bundle.heads.layers import Layer, reference_scores
from pans.bundle.sensor import Bundle
from pans.calibrate.refit.rebuild import chain_onnx
from pans.instrument.click_law import object_transmission
from pans.instrument.optics import Bleaching
from pans.instrument.profile import load_profile
from pans_trainer.evaluate.accuracy import light_of
from pans_trainer.evaluate.dose import (
    caps_of,
    dose_curve,
    figures_of,
    knowledge_of,
    of_first,
    patterns_within,
    training_readings,
    within_cap,
)
from pans_trainer.evaluate.held_out import HeldOut
from pans_trainer.evaluate.pictures import draw_dose
from pans_trainer.evaluate.walks import walks_of
from pans_trainer.options import Conditions
from pans_trainer.tasks.registry import Objects, Task

IDEAL = load_profile("ideal")
RNG = np.random.default_rng(8)
IMAGES = RNG.integers(0, 256, (12, 2, 3), dtype=np.uint8)
LABELS = RNG.integers(0, 3, 12)
TASK = Task("toy", ("a", "b", "c"), Objects(IMAGES, LABELS), Objects(IMAGES, LABELS), "0" * 64, "none")
HELD_OUT = HeldOut(TASK, TASK.test, IDEAL)
LAW = Bleaching(2.0)


def fixed(d_f: int = 3) -> Bundle:
    levels, table = RNG.integers(1, 16, (d_f, 6)), RNG.normal(size=(1 << d_f, 3))
    return made_bundle(d_f, 3, image_shape=(2, 3), levels=16, pattern_levels=levels, photons_per_level=0.1, table=table)


def transmission() -> np.ndarray:
    return object_transmission(IDEAL, IMAGES.reshape(len(IMAGES), -1))


def test_fixed_patterns_bring_what_pixels_have_left() -> None:
    bundle = fixed()
    found = light_of(bundle, IDEAL, IMAGES, bleaching=LAW)
    for row, object_ in enumerate(transmission()):
        left = [1.0] * 6
        for number, pattern in enumerate(bundle.patterns()):
            signal = 0.0
            for pixel, light in enumerate(pattern):
                signal += object_[pixel] * left[pixel] * 2.0 * (1 - math.exp(-light / 2.0))
                left[pixel] *= math.exp(-light / 2.0)
            assert found.photoelectrons[row, number] == pytest.approx(signal, rel=1e-12)
    assert found.illumination == pytest.approx(bundle.illumination())


@pytest.mark.parametrize("mixed", [False, True])
def test_walks_before_samples_that_bleach_are_those_of_all_words(mixed: bool) -> None:
    law = Bleaching(2.0, mixed)
    bundle = automaton_bundle(six_states(), photons=1.5)
    automaton, trials = bundle.automaton, 1500
    wanted, photons = np.zeros((len(IMAGES), automaton.n_leaves)), np.zeros(len(IMAGES))
    for row, object_ in enumerate(transmission()):
        for word in itertools.product((0, 1), repeat=automaton.n_slots):
            node, chance, dose, spent = 0, 1.0, np.zeros(6), 0.0
            for click in word:
                if node >= automaton.n_states:
                    chance *= 0.5  # the clicks behind a leaf are summed over
                    continue
                light = bundle.patterns()[automaton.pattern[node]] * automaton.dwell[node] / 4
                own = np.full(6, light.mean()) if mixed else light
                signal = sum(
                    object_[i]
                    * math.exp(-dose[i] / 2)
                    * light[i]
                    * ((1 - math.exp(-own[i] / 2)) / (own[i] / 2) if own[i] else 1)
                    for i in range(6)
                )
                dose, spent = dose + own, spent + signal
                dark = math.exp(-signal - 0.0)
                chance *= 1 - dark if click else dark
                node = int(automaton.successors[node, click])
            wanted[row, node - automaton.n_states] += chance
            photons[row] += chance * spent
    found = walks_of(bundle, IDEAL, IMAGES, LABELS, Conditions(bleaching=law, dark=0.0), trials=trials)
    by_class = np.stack([wanted[label == LABELS].sum(axis=0) for label in range(3)])
    error = 5 * np.sqrt(by_class / trials) + 1e-3
    assert (np.abs(found.by_class - by_class) <= error).all()
    assert found.photons.mean() == pytest.approx(photons.mean(), rel=5 / math.sqrt(trials * len(IMAGES)))
    with pytest.raises(ValueError, match="sample trials instead"):
        walks_of(bundle, IDEAL, IMAGES, LABELS, Conditions(bleaching=law))


def test_a_table_of_the_first_patterns_sums_over_the_others() -> None:
    bundle = fixed()
    readings = training_readings(bundle, IDEAL, TASK.train)
    clicks, found = readings[:, :, 1], of_first(bundle, 2, readings)
    assert found.n_features == 2
    for seen in range(4):
        joint = np.zeros(3)
        for last in range(2):
            word = seen + 4 * last
            bits = [(word >> i) & 1 for i in range(3)]
            chance = np.mean([math.prod(p if bit else 1 - p for p, bit in zip(row, bits)) for row in clicks])
            odds = np.exp(bundle.table[word].astype(np.float64))
            joint += chance * odds / odds.sum()
        np.testing.assert_allclose(np.exp(found.table[seen]), joint / joint.sum(), rtol=2e-6)


def test_a_head_of_the_first_patterns_takes_the_mean_of_the_others() -> None:
    layers = (
        Layer(RNG.normal(size=(14, 5)).astype(np.float32), RNG.normal(size=5).astype(np.float32), True),
        Layer(RNG.normal(size=(5, 3)).astype(np.float32), np.zeros(3, np.float32), False),
    )
    levels = RNG.integers(1, 16, (14, 6))
    facts = {"levels": 16, "pattern_levels": levels, "photons_per_level": 0.1}
    bundle = made_bundle(14, 3, image_shape=(2, 3), head_onnx=chain_onnx(layers), **facts)
    readings = training_readings(bundle, IDEAL, TASK.train)
    clicks, found = readings[:, :, 1], of_first(bundle, 4, readings)
    assert found.head_onnx is not None
    assert found.table is not None  # of 4 patterns it can be made
    words = np.array(list(itertools.product((0, 1), repeat=4)))
    means = np.concatenate([words, np.broadcast_to(clicks.mean(axis=0)[4:], (16, 10))], axis=1)
    np.testing.assert_allclose(found.table[words @ (1, 2, 4, 8)], reference_scores(layers, means), atol=1e-4)


def test_a_cap_stops_before_the_pattern_that_would_pass_it() -> None:
    bundle = fixed()
    light = np.cumsum(bundle.patterns().sum(axis=1))
    assert [patterns_within(bundle, cap) for cap in (light[0], light[1] * 0.999, light[1], 1e9)] == [1, 1, 2, 3]
    with pytest.raises(ValueError, match="the first pattern alone brings"):
        patterns_within(bundle, light[0] * 0.99)
    known = knowledge_of(bundle, HELD_OUT)
    found = figures_of(within_cap(bundle, light[1], HELD_OUT, known), HELD_OUT, Conditions())
    assert found.illumination == pytest.approx(light[1])
    assert within_cap(bundle, 1e9, HELD_OUT, known).bundle is bundle


@pytest.mark.parametrize("which", ["fixed", "automaton"])
def test_a_curve_ends_at_the_whole_bundle(which: str, tmp_path: Path) -> None:
    bundle = fixed() if which == "fixed" else automaton_bundle(six_states(), photons=1.5)
    points = dose_curve(bundle, HELD_OUT, Conditions(bleaching=LAW))
    assert [point["dose_cap"] for point in points] == caps_of(bundle)
    whole = figures_of(within_cap(bundle, 1e9, HELD_OUT, knowledge_of(bundle, HELD_OUT)), HELD_OUT, Conditions())
    assert points[-1]["accuracy_unbleached"] == pytest.approx(whole.accuracy_mean, abs=1e-12)
    assert points[-1]["illumination"] == pytest.approx(whole.illumination, rel=0.2)
    assert points[-1]["photons_mean"] < 0.95 * whole.photons_mean
    for point in points:
        assert point["illumination"] <= point["dose_cap"] * (1 + 1e-9)
    pytest.importorskip("matplotlib")
    assert draw_dose(tmp_path, {"toy": points}).read_bytes()[:4] == b"\x89PNG"
