"""The order of patterns: information held against sums over all words written out, and bundles that decide as before."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from bundles import made_bundle
from commands import json_of
from naive_decide import int8_reference

from pans.bundle.backends.choose import make_decider
from pans.bundle.heads.layers import Layer, quantise_head, reference_scores
from pans.bundle.sensor import Bundle, bundle_bytes, parse_bundle
from pans.bundle.sensor.bundle import load_bundle
from pans.calibrate.refit.rebuild import chain_onnx
from pans.instrument.optics import Bleaching
from pans.instrument.profile import Profile, load_profile
from pans_trainer.evaluate.accuracy import light_of
from pans_trainer.evaluate.dose import of_first, plain_layers, training_readings
from pans_trainer.export.ordering import information_order, reordered
from pans_trainer.tasks.registry import Objects

IDEAL, COUNTING = load_profile("ideal"), load_profile("dmd-qcmos")
OUTCOMES = 3
RNG = np.random.default_rng(21)
IMAGES = RNG.integers(0, 256, (24, 2, 3), dtype=np.uint8)
LABELS = RNG.integers(0, 3, 24)
OBJECTS = Objects(IMAGES, LABELS)


def layers_of(d_f: int) -> tuple[Layer, ...]:
    return (
        Layer(RNG.normal(size=(d_f, 6)).astype(np.float32), RNG.normal(size=6).astype(np.float32), True),
        Layer(RNG.normal(size=(6, 3)).astype(np.float32), RNG.normal(size=3).astype(np.float32), False),
    )


def bundle_of(d_f: int, levels: np.ndarray | None = None) -> Bundle:
    layers = layers_of(d_f)
    shown = RNG.integers(1, 16, (d_f, 6)) if levels is None else levels
    facts = {"levels": 16, "pattern_levels": shown, "photons_per_level": 0.1, "image_shape": (2, 3)}
    return made_bundle(d_f, 3, head_onnx=chain_onnx(layers), int8_head=quantise_head(layers), **facts)


def bundle_of_numbers(d_f: int = 3) -> Bundle:
    levels = RNG.integers(0, 2, (d_f, 6)) | np.eye(d_f, 6, dtype=np.int64)
    facts = {"image_shape": (2, 3), "levels": 2, "pattern_levels": levels, "photons_per_level": 1.3}
    return made_bundle(d_f, 3, head_onnx=chain_onnx(layers_of(d_f)), outcomes=OUTCOMES, **facts)


def chances_of(bundle: Bundle, profile: Profile, images: np.ndarray = IMAGES, **bleaching: Bleaching) -> np.ndarray:
    """Chances of the outcomes, float64 (objects, patterns, outcomes)."""
    return light_of(bundle, profile, images, **bleaching).chances


def bits_of(chances: np.ndarray) -> float:
    """I(class; outcomes) in bits, by the definition: all words, all classes, all objects."""
    n, d_f, outcomes = chances.shape
    of_class, total = np.bincount(LABELS, minlength=3) / n, 0.0
    for word in itertools.product(range(outcomes), repeat=d_f):
        chance = [math.prod(row[i][number] for i, number in enumerate(word)) / n for row in chances]
        for label in range(3):
            joint = sum(c for c, own in zip(chance, LABELS) if own == label)
            if joint > 0:
                total += joint * math.log2(joint / (sum(chance) * of_class[label]))
    return total


@pytest.mark.parametrize("by", ["information", "dose"])
@pytest.mark.parametrize("counts", [False, True], ids=["clicks", "numbers"])
def test_the_order_takes_what_tells_most_next(by: str, counts: bool) -> None:
    bundle, profile = (bundle_of_numbers(), COUNTING) if counts else (bundle_of(4), IDEAL)
    chances, light = chances_of(bundle, profile), bundle.patterns().sum(axis=1)
    assert chances.sum(axis=2) == pytest.approx(1.0)
    chosen: list[int] = []
    bits: list[float] = []
    while rest := [j for j in range(bundle.n_patterns) if j not in chosen]:
        after = {j: bits_of(chances[:, [*chosen, j]]) for j in rest}
        before = bits[-1] if bits else 0.0
        best = max(rest, key=lambda j: (after[j] - before) / (light[j] if by == "dose" else 1.0))
        chosen.append(best)
        bits.append(after[best])
    found = information_order(bundle, profile, OBJECTS, by=by)
    assert found.patterns == tuple(chosen)
    assert found.exact
    assert found.bits == pytest.approx(bits, abs=1e-12)
    bleached = information_order(bundle, profile, OBJECTS, by=by, bleaching=Bleaching(3.0))
    left = chances_of(reordered(bundle, bleached.patterns, {}), profile, bleaching=Bleaching(3.0))
    assert bleached.bits[-1] == pytest.approx(bits_of(left), abs=1e-12)


def test_a_sample_that_bleaches_changes_the_order() -> None:
    # pattern 0 tells most and, where it bleaches, leaves nothing for its twin, pattern 1: the dim pattern 2 then comes before it
    images = np.zeros((24, 2, 3), np.uint8)
    images[LABELS == 0, 0, 0] = 255
    images[LABELS == 1, 1, 2] = 90
    levels = np.zeros((3, 6), np.int64)
    levels[0, 0], levels[1, 0], levels[2, 5] = 12, 11, 4
    bundle, objects = bundle_of(3, levels), Objects(images, LABELS)
    steady = information_order(bundle, IDEAL, objects)
    bleaching = information_order(bundle, IDEAL, objects, bleaching=Bleaching(0.1))
    assert steady.patterns == (0, 1, 2)
    assert bleaching.patterns == (0, 2, 1) or bleaching.patterns == (1, 2, 0)
    left = chances_of(reordered(bundle, bleaching.patterns, {}), IDEAL, images, bleaching=Bleaching(0.1))
    assert bleaching.bits[-1] == pytest.approx(bits_of(left), abs=1e-12)


def test_a_reordered_bundle_decides_as_before(tmp_path: Path) -> None:
    bundle, order = bundle_of(5), [3, 0, 4, 1, 2]
    new = parse_bundle(bundle_bytes(reordered(bundle, order, {"order": "told"})), "new")
    words = np.array(list(itertools.product((0, 1), repeat=5)))
    np.testing.assert_array_equal(new.pattern_levels, bundle.pattern_levels[order])
    for backend in ("table", "onnx"):
        old, moved = make_decider(bundle, backend=backend), make_decider(new, backend=backend)
        np.testing.assert_allclose(moved.scores_batch(words[:, order], 1), old.scores_batch(words, 1), atol=1e-5)
    found, wanted = int8_reference(new.int8_head, words[:, order], 1), int8_reference(bundle.int8_head, words, 1)
    np.testing.assert_array_equal(found, wanted)
    assert new.provenance["order"] == "told"
    back = reordered(new, np.argsort(order).tolist(), {})
    np.testing.assert_array_equal(back.table, bundle.table)


def test_the_command_orders_and_caps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    labels = np.arange(60) % 3
    images = RNG.integers(0, 256, (60, 2, 3), dtype=np.uint8)
    np.savez(tmp_path / "toy.npz", images=images, labels=labels, classes=np.array(["c0", "c1", "c2"]))
    bundle = bundle_of(4)
    (tmp_path / "old.pans").write_bytes(bundle_bytes(bundle))
    given = ("order", tmp_path / "old.pans", "--task", tmp_path / "toy.npz", "--profile", "ideal")
    found = json_of(capsys, *given, "-o", tmp_path / "new.pans")
    order = [row["pattern"] for row in found["patterns"]]
    new = load_bundle(tmp_path / "new.pans")[0]
    np.testing.assert_array_equal(new.pattern_levels, bundle.pattern_levels[order])
    assert new.provenance["order"]["patterns"] == order
    cap = found["patterns"][1]["illumination"]
    within = json_of(capsys, *given, "--dose-cap", cap, "--by", "information", "-o", tmp_path / "dim.pans")
    assert within["illumination"] == pytest.approx(cap)
    dim = load_bundle(tmp_path / "dim.pans")[0]
    np.testing.assert_array_equal(dim.pattern_levels, bundle.pattern_levels[order[:2]])
    words = ("--task", tmp_path / "toy.npz", "--profile", "ideal")
    judged = json_of(capsys, "evaluate", tmp_path / "dim.pans", *words, "--exact")
    capped = json_of(capsys, "evaluate", tmp_path / "new.pans", *words, "--dose-cap", cap)
    assert capped["accuracy_mean"] == pytest.approx(judged["accuracy_mean"], abs=1e-12)
    assert capped["illumination"] == pytest.approx(cap)
    refused = json_of(capsys, "order", tmp_path / "old.pans", "--by", "none", "-o", tmp_path / "no.pans", code=2)
    assert "changes nothing" in refused["error"]["message"]
    assert not (tmp_path / "no.pans").exists()


def row_of(word: np.ndarray) -> int:
    return int(sum(int(number) * OUTCOMES**place for place, number in enumerate(word)))


def test_what_is_left_of_numbers_sums_over_the_others() -> None:
    bundle = bundle_of_numbers()
    readings = training_readings(bundle, COUNTING, OBJECTS)
    found = of_first(bundle, 2, readings)
    assert (found.n_features, found.outcomes) == (2, OUTCOMES)
    for seen in itertools.product(range(OUTCOMES), repeat=2):
        joint = np.zeros(3)
        for last in range(OUTCOMES):
            word = np.array([*seen, last])
            chance = np.mean([math.prod(row[i][number] for i, number in enumerate(word)) for row in readings])
            odds = np.exp(bundle.table[row_of(word)].astype(np.float64))
            joint += chance * odds / odds.sum()
        np.testing.assert_allclose(np.exp(found.table[row_of(np.array(seen))]), joint / joint.sum(), rtol=2e-6)
    many = bundle_of_numbers(8)  # 6561 words: the head takes the means
    readings = training_readings(many, COUNTING, OBJECTS)
    mean = readings.mean(axis=0) @ [0, 1, 2]
    wanted = reference_scores(plain_layers(many), np.array([[1.0, 2.0, *mean[2:]]]) / 2)
    np.testing.assert_allclose(make_decider(of_first(many, 2, readings)).scores_batch([[1, 2]], 1), wanted, atol=1e-4)
