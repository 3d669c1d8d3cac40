"""Order and dose of patterns over photon numbers: held against sums over all numbers written out, exposure by exposure."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from bundles import made_bundle
from commands import json_of

from pans.runtime.bundle.layers import Layer
from pans.runtime.bundle.model import Bundle, bundle_bytes, load_bundle
from pans.runtime.decide.backends import make_decider
from pans.runtime.imaging import Bleaching
from pans.runtime.instrument.profile import load_profile
from pans.runtime.refit.rebuild import chain_onnx
from pans.trainer.evaluate.accuracy import light_of
from pans.trainer.evaluate.dose import dose_curve, of_first, training_readings
from pans.trainer.evaluate.held_out import Conditions, HeldOut
from pans.trainer.export.ordering import _Samples, information_order, reordered
from pans.trainer.tasks.registry import Objects, Task

PROFILE = load_profile("dmd-qcmos")
RNG = np.random.default_rng(33)
IMAGES = RNG.integers(0, 256, (24, 2, 3), dtype=np.uint8)
LABELS = RNG.integers(0, 3, 24)
OBJECTS = Objects(IMAGES, LABELS)
TASK = Task("toy", ("a", "b", "c"), OBJECTS, OBJECTS, "0" * 64, "none")
OUTCOMES = 3
WORDS = np.array(list(itertools.product(range(OUTCOMES), repeat=3)))  # (27, 3): numbers of three patterns


def bundle_of(d_f: int = 3) -> Bundle:
    layers = (
        Layer(RNG.normal(size=(d_f, 6)).astype(np.float32), RNG.normal(size=6).astype(np.float32), True),
        Layer(RNG.normal(size=(6, 3)).astype(np.float32), RNG.normal(size=3).astype(np.float32), False),
    )
    levels = RNG.integers(0, 2, (d_f, 6)) | np.eye(d_f, 6, dtype=np.int64)
    facts = {"image_shape": (2, 3), "levels": 2, "pattern_levels": levels, "photons_per_level": 1.3}
    return made_bundle(d_f, 3, head_onnx=chain_onnx(layers), outcomes=OUTCOMES, **facts)


def row_of(word: np.ndarray) -> int:
    return int(sum(int(number) * OUTCOMES**place for place, number in enumerate(word)))


def bits_of(chances: np.ndarray) -> float:
    """I(class; numbers) in bits, by the definition, of chances (n, patterns, outcomes)."""
    n, d_f, _ = chances.shape
    of_class, total = np.bincount(LABELS, minlength=3) / n, 0.0
    for word in itertools.product(range(OUTCOMES), repeat=d_f):
        chance = [math.prod(row[i][number] for i, number in enumerate(word)) / n for row in chances]
        for label in range(3):
            joint = sum(c for c, own in zip(chance, LABELS) if own == label)
            if joint > 0:
                total += joint * math.log2(joint / (sum(chance) * of_class[label]))
    return total


@pytest.mark.parametrize("by", ["information", "dose"])
def test_numbers_that_tell_most_come_first(by: str) -> None:
    bundle = bundle_of()
    chances, light = light_of(bundle, PROFILE, IMAGES).chances, bundle.patterns().sum(axis=1)
    assert chances.sum(axis=2) == pytest.approx(1.0)
    chosen: list[int] = []
    bits: list[float] = []
    while len(chosen) < 3:
        rest = [j for j in range(3) if j not in chosen]
        after = {j: bits_of(chances[:, [*chosen, j]]) for j in rest}
        before = bits[-1] if bits else 0.0
        best = max(rest, key=lambda j: (after[j] - before) / (light[j] if by == "dose" else 1.0))
        chosen.append(best)
        bits.append(after[best])
    found = information_order(bundle, PROFILE, OBJECTS, by=by)
    assert found.patterns == tuple(chosen)
    assert found.exact
    assert found.bits == pytest.approx(bits, abs=1e-12)
    bleached = information_order(bundle, PROFILE, OBJECTS, by=by, bleaching=Bleaching(3.0))
    left = light_of(reordered(bundle, bleached.patterns, {}), PROFILE, IMAGES, bleaching=Bleaching(3.0))
    assert bleached.bits[-1] == pytest.approx(bits_of(left.chances), abs=1e-12)


def test_sampled_numbers_estimate_the_same_information() -> None:
    chances = RNG.dirichlet([1.0, 0.6, 0.3], (24, 4))
    known = _Samples(np.tile(LABELS, 60), 3, 0)
    many = np.tile(chances, (60, 1, 1))
    for number in range(3):
        wanted = [bits_of(chances[:, [*range(number), j]]) for j in range(number, 4)]
        assert known.bits_with(many[:, number:]) == pytest.approx(wanted, abs=0.04)
        known.take(many[:, number])


def test_a_reordered_bundle_of_numbers_decides_as_before() -> None:
    bundle, order = bundle_of(), [2, 0, 1]
    new = reordered(bundle, order, {})
    assert (new.outcomes, bundle.table is None, new.table is None) == (OUTCOMES, False, False)
    for backend in ("table", "onnx"):
        old, moved = make_decider(bundle, backend=backend), make_decider(new, backend=backend)
        np.testing.assert_allclose(moved.scores_batch(WORDS[:, order], 1), old.scores_batch(WORDS, 1), atol=1e-5)


def test_what_is_left_of_numbers_sums_over_the_others() -> None:
    bundle = bundle_of()
    assert bundle.table is not None
    readings = training_readings(bundle, PROFILE, OBJECTS)
    found = of_first(bundle, 2, readings)
    assert (found.n_features, found.outcomes) == (2, OUTCOMES)
    assert found.table is not None
    for seen in itertools.product(range(OUTCOMES), repeat=2):
        joint = np.zeros(3)
        for last in range(OUTCOMES):
            word = np.array([*seen, last])
            chance = np.mean([math.prod(row[i][number] for i, number in enumerate(word)) for row in readings])
            odds = np.exp(bundle.table[row_of(word)].astype(np.float64))
            joint += chance * odds / odds.sum()
        np.testing.assert_allclose(np.exp(found.table[row_of(np.array(seen))]), joint / joint.sum(), rtol=2e-6)
    many = bundle_of(8)  # 6561 words: the head takes the means
    readings = training_readings(many, PROFILE, OBJECTS)
    shorter = of_first(many, 2, readings)
    mean = readings.mean(axis=0) @ [0, 1, 2]
    wanted = _head_at(many, np.array([[1.0, 2.0, *mean[2:]]]) / 2)
    np.testing.assert_allclose(make_decider(shorter).scores_batch([[1, 2]], 1), wanted, atol=1e-4)


def _head_at(bundle: Bundle, means: np.ndarray) -> np.ndarray:
    import onnxruntime

    assert bundle.head_onnx is not None
    session = onnxruntime.InferenceSession(bundle.head_onnx)
    return np.asarray(session.run(None, {session.get_inputs()[0].name: means.astype(np.float32)})[0])


def test_accuracy_against_dose_of_numbers_is_the_sum_over_what_is_seen() -> None:
    bundle = bundle_of()
    points = dose_curve(bundle, HeldOut(TASK, OBJECTS, PROFILE), Conditions())
    assert [point["exposures_most"] for point in points] == [1, 2, 3]
    readings = training_readings(bundle, PROFILE, OBJECTS)
    for count, point in enumerate(points, start=1):
        decider, right = make_decider(of_first(bundle, count, readings)), 0.0
        for word in itertools.product(range(OUTCOMES), repeat=count):
            label = decider.decide(np.array(word), 1).label
            chance = [math.prod(row[i][number] for i, number in enumerate(word)) for row in readings]
            right += sum(c for c, own in zip(chance, LABELS) if own == label) / len(LABELS)
        assert point["accuracy_mean"] == pytest.approx(right, abs=1e-9)
        assert point["illumination"] == pytest.approx(bundle.patterns()[:count].sum())


def test_the_command_orders_numbers_within_a_dose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    labels = np.arange(60) % 3
    images = RNG.integers(0, 256, (60, 2, 3), dtype=np.uint8)
    np.savez(tmp_path / "toy.npz", images=images, labels=labels, classes=np.array(["c0", "c1", "c2"]))
    bundle = bundle_of()
    (tmp_path / "old.pans").write_bytes(bundle_bytes(bundle))
    given = ("order", tmp_path / "old.pans", "--task", tmp_path / "toy.npz", "--profile", "dmd-qcmos", "--by", "dose")
    found = json_of(capsys, *given, "-o", tmp_path / "new.pans")
    order = [row["pattern"] for row in found["patterns"]]
    np.testing.assert_array_equal(load_bundle(tmp_path / "new.pans")[0].pattern_levels, bundle.pattern_levels[order])
    cap = found["patterns"][1]["illumination"]
    within = json_of(capsys, *given, "--dose-cap", cap, "-o", tmp_path / "dim.pans")
    assert within["illumination"] == pytest.approx(cap)
    dim = load_bundle(tmp_path / "dim.pans")[0]
    assert (dim.n_features, dim.outcomes) == (2, OUTCOMES)
    bleached = json_of(
        capsys,
        "evaluate",
        tmp_path / "new.pans",
        "--task",
        tmp_path / "toy.npz",
        "--profile",
        "dmd-qcmos",
        "--bleach",
        "2",
    )
    assert 0 < bleached["accuracy_mean"] < 1
