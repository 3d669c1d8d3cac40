"""Evaluation of automata: exact against a sum over all words and against trials, calibration, and what the command says."""

import math
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import naive_automaton as naive
import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from commands import Pans

from pans.bundle.automaton import Automaton
from pans.bundle.backends import make_decider
from pans.bundle.sensor import Bundle, expected_differences, with_expected, write_bundle
from pans.instrument.click_law import CountLaw, click_probability, count_chances, object_transmission
from pans.instrument.profile import load_profile
from pans_trainer.evaluate import evaluate
from pans_trainer.evaluate.accuracy import outcome_law_of
from pans_trainer.evaluate.walks import calibration_bins, confusion_of, measured_walks, walks_of
from pans_trainer.options import Conditions

RNG = np.random.default_rng(0)
PROFILE = load_profile("oled-qcmos")
COUNTING = replace(PROFILE, detector=replace(PROFILE.detector, photon_number_max=15))
LABELS = RNG.integers(0, 3, 60)
IMAGES = RNG.integers(0, 256, (60, 2, 2), dtype=np.uint8)


def bundle(**facts: Any) -> Bundle:
    return automaton_bundle(random_automaton(3, slots=6), **{"photons_per_level": 0.15} | facts)


def by_hand(model: Bundle, dark: float, eta: float, confidence: float) -> dict[str, Any]:
    """The same figures by a sum over all click words, with the decider's own answers."""
    assert model.automaton is not None
    decider: Any = make_decider(model, confidence=confidence)
    automaton = decider.automaton
    seen = object_transmission(PROFILE, IMAGES.reshape(60, -1))
    law = outcome_law_of(model, PROFILE, dark=dark)
    sums = dict.fromkeys(("right", "decided", "clicks", "photons", "illumination", "exposures", "bits"), 0.0)
    for row, label in zip(seen, LABELS):
        whole = model.pattern_levels[automaton.pattern] * (eta * model.photons_per_level)
        states = whole * (automaton.dwell / automaton.dwell_steps)[:, None]
        light = states @ row
        found = naive.expectation(automaton, click_probability(law, light).tolist(), 1.0)
        sums["clicks"] += found["clicks"]
        sums["exposures"] += found["exposures"]
        sums["photons"] += float(np.dot(found["shown"], light))
        sums["illumination"] += float(np.dot(found["shown"], states.sum(axis=1)))
        sums["right"] += sum(p for leaf, p in enumerate(found["leaves"]) if decider.decide_leaf(leaf).label == label)
        said = automaton.posteriors[automaton.n_states :, label]
        sums["bits"] += math.log2(60 / (label == LABELS).sum()) + float(np.dot(found["leaves"], np.log2(said)))
        sums["decided"] += sum(p for leaf, p in enumerate(found["leaves"]) if decider.decide_leaf(leaf).label < 3)
    return sums


@pytest.mark.parametrize(("dark", "eta", "confidence"), [(0.02, 1.0, 0.0), (0.0, 2.0, 0.7)])
def test_exact_figures_are_sums_over_all_words(dark: float, eta: float, confidence: float) -> None:
    model = bundle()
    walks = walks_of(model, PROFILE, IMAGES, LABELS, Conditions(dark=dark, eta=eta, confidence=confidence))
    found, wanted = measured_walks(walks), by_hand(model, dark, eta, confidence)
    assert found.accuracy_mean == pytest.approx(wanted["right"] / wanted["decided"], rel=1e-9)
    assert found.abstained == pytest.approx(1 - wanted["decided"] / 60, abs=1e-9)
    assert (found.abstained > 0.01) == (confidence > 0)
    means = (found.clicks_mean, found.photons_mean, found.illumination, found.exposures_mean)
    assert [60 * mean for mean in means] == pytest.approx(
        [wanted[name] for name in ("clicks", "photons", "illumination", "exposures")], rel=1e-9
    )
    bits, photons, sent = (wanted[name] for name in ("bits", "photons", "illumination"))
    of_light = (found.bits, found.bits_per_photon, found.bits_per_illumination)
    assert of_light == pytest.approx((bits / 60, bits / photons, bits / sent), rel=1e-6)
    assert confusion_of(walks).sum() == pytest.approx(wanted["decided"], rel=1e-9)
    assert np.trace(confusion_of(walks)) == pytest.approx(wanted["right"], rel=1e-9)


@pytest.mark.parametrize("afterpulse", [0.0, 0.4])
def test_trials_agree_with_the_expectation_within_their_error(afterpulse: float) -> None:
    """400 walks of each object; 5 standard errors, seed fixed."""
    model, trials = bundle(), 400
    profile = replace(PROFILE, detector=replace(PROFILE.detector, afterpulse_probability=afterpulse))
    conditions = Conditions(dark=0.02, confidence=0.7, seed=4)
    exact, sampled = (
        measured_walks(walks_of(model, profile, IMAGES, LABELS, conditions, number)) for number in (None, trials)
    )
    assert abs(sampled.accuracy_mean - exact.accuracy_mean) < 5 * exact.accuracy_std / math.sqrt(trials)
    n = len(LABELS) * trials
    assert abs(sampled.abstained - exact.abstained) < 5 * math.sqrt(0.25 / n)
    assert abs(sampled.exposures_mean - exact.exposures_mean) < 5 * 6 / 2 / math.sqrt(n)
    assert abs(sampled.clicks_mean - exact.clicks_mean) < 5 * 6 / 2 / math.sqrt(n)
    assert sampled.photons_mean == pytest.approx(exact.photons_mean, rel=0.05)
    assert sampled.illumination == pytest.approx(exact.illumination, rel=0.05)
    assert (sampled.trials, exact.trials) == (trials, 0)


def two_leaves(sure: float) -> Bundle:
    """A click says class 1, no click class 0, each with the probability `sure`."""
    posteriors = [[0.5, 0.5], [sure, 1 - sure], [1 - sure, sure]]
    automaton = Automaton([0], [1], 1, [[1, 2]], posteriors)
    return automaton_bundle(automaton, pattern_levels=np.full((1, 4), 3), photons_per_level=1.0)


def test_calibration_compares_probability_and_accuracy() -> None:
    """White objects click always, black ones never; a quarter of each has the other label: 75 % right, whatever is claimed."""
    images = np.repeat(np.array([0, 255], np.uint8), 40)[:, None, None] * np.ones((1, 2, 2), np.uint8)
    labels = np.repeat([0, 1], 40)
    labels[:10], labels[40:50] = 1, 0
    ideal = load_profile("ideal")
    for sure in (0.75, 0.95):
        walks = walks_of(two_leaves(sure), ideal, images, labels, Conditions(dark=0.0, eta=50.0))
        (only,) = calibration_bins(walks)
        assert (only.share, only.accuracy) == pytest.approx((1.0, 0.75), abs=1e-9)
        assert only.probability == pytest.approx(sure, abs=1e-6)
        found = measured_walks(walks)
        assert found.expected_calibration_error == pytest.approx(sure - 0.75, abs=1e-6)
        # what is claimed too surely conveys less, down to nothing
        assert found.bits == pytest.approx(1 + 0.75 * math.log2(sure) + 0.25 * math.log2(1 - sure), abs=1e-6)


@pytest.fixture
def own_task(tmp_path: Path) -> str:
    path = tmp_path / "own.npz"
    rng = np.random.default_rng(2)
    images = rng.integers(0, 256, (230, 2, 2), dtype=np.uint8)
    np.savez(path, images=images, labels=np.arange(230) % 3, classes=np.array(["c0", "c1", "c2"]))
    return str(path)


def test_the_command_gives_all_figures(own_task: str, tmp_path: Path, pans: Pans) -> None:
    model = bundle()
    write_bundle(model, tmp_path / "a.pans")
    found = pans("evaluate", tmp_path / "a.pans", "--task", own_task, "--profile", "ideal")
    figures = evaluate(model, task=own_task, conditions=Conditions("ideal"))
    assert {name: found[name] for name in asdict(figures)} == asdict(figures)
    assert (found["trials"], found["objects"], found["shots"], found["exposures_longest"]) == (0, 230, 1, 6)
    assert found["first_200"]["objects"] == 200
    assert sum(one["share"] for one in found["calibration"]) == pytest.approx(1.0)
    few = pans("evaluate", tmp_path / "a.pans", "--task", own_task, "--profile", "ideal", "--objects", "200")
    assert few["first_200"] is None
    for name in ("accuracy_mean", "clicks_mean", "photons_mean", "exposures_mean"):
        assert few[name] == pytest.approx(found["first_200"][name], rel=1e-12)
    more = ("--profile", "ideal", "--confidence", "0.6", "--exact")
    sure = pans("evaluate", tmp_path / "a.pans", "--task", own_task, *more)
    assert (sure["confidence"], sure["trials"]) == (0.6, 0)
    assert 0 < sure["abstained"] < 1
    assert sure["exposures_mean"] < found["exposures_mean"]


def test_expected_figures_are_held_against_what_is_found(own_task: str, tmp_path: Path, pans: Pans) -> None:
    model = bundle()
    found = evaluate(model, task=own_task, conditions=Conditions("ideal"))
    named = {"profile": "ideal", "task": Path(own_task).stem, "split": "test", "objects": 230}
    figures = {
        **{"accuracy": found.accuracy_mean, "clicks": found.clicks_mean, "photons": found.photons_mean},
        **{"illumination": found.illumination, "exposures": found.exposures_mean},
    }
    write_bundle(with_expected(model, named | figures), tmp_path / "true.pans")
    words = ("--task", own_task, "--profile", "ideal")
    assert pans("evaluate", tmp_path / "true.pans", *words)["expected_differences"] == []
    write_bundle(with_expected(model, named | figures | {"accuracy": 0.999}), tmp_path / "false.pans")
    wrong = pans("evaluate", tmp_path / "false.pans", *words, code=1)
    assert "expected accuracy is 0.999 in the bundle" in wrong["expected_differences"][0]
    other = ("evaluate", tmp_path / "false.pans", *words, "--dark", "0.1")
    assert pans(*other)["expected_differences"] is None
    assert expected_differences(named | figures, named | figures | {"objects": 3, "accuracy": 0.0}) == []


def test_pictures_of_an_automaton(own_task: str, tmp_path: Path, pans: Pans) -> None:
    pytest.importorskip("matplotlib")
    write_bundle(bundle(), tmp_path / "a.pans")
    words = ("--task", own_task, "--pictures", tmp_path / "drawn")
    found = pans("evaluate", tmp_path / "a.pans", *words)
    assert {Path(path).name for path in found["pictures"]} == {"patterns.png", "reliability.png", "confusion.png"}
    for path in found["pictures"]:
        assert Path(path).read_bytes().startswith(b"\x89PNG")


def test_dark_counts_do_not_follow_the_dwell() -> None:
    automaton = random_automaton(3, slots=6)
    short = Automaton(automaton.pattern, np.ones_like(automaton.dwell), 8, automaton.successors, automaton.posteriors)
    ideal = load_profile("ideal")
    for one in (automaton, short):
        found = measured_walks(walks_of(automaton_bundle(one), ideal, IMAGES, LABELS, Conditions(dark=0.3, eta=0.0)))
        assert found.clicks_mean == pytest.approx((1 - math.exp(-0.3)) * found.exposures_mean, rel=1e-12)


def counting_bundle() -> Bundle:
    """An automaton of photon numbers: the edges of a random one, and more of them."""
    few = random_automaton(3, slots=4, channels=2)
    automaton = Automaton(few.pattern, few.dwell, few.dwell_steps, few.successors, few.posteriors, counts=True)
    assert automaton.n_outcomes == 4
    return automaton_bundle(automaton, photons_per_level=0.4)


def test_photon_numbers_are_summed_over_all_words() -> None:
    """Every word of readings, chances by the law of one exposure, the decider's own answers."""
    model = counting_bundle()
    automaton = model.automaton
    decider: Any = make_decider(model)
    law = CountLaw(0.02, 0.2, (0.84, 1.5, 2.5))
    images, labels = IMAGES[:6], LABELS[:6]
    sums = np.zeros(4)  # right, clicks, photons, exposures
    for row, label in zip(object_transmission(PROFILE, images.reshape(6, -1)), labels):
        light = (model.pattern_levels[automaton.pattern] * model.photons_per_level) @ row
        light = light * automaton.dwell / automaton.dwell_steps
        chances = count_chances(law, light)
        for word in product(range(4), repeat=automaton.n_slots):
            chance, states = 1.0, naive.walk(automaton, word, counts=True)
            for state, reading in zip(states.states, word):
                chance *= chances[reading, state]
            chance /= 4 ** (automaton.n_slots - len(states.states))  # words that differ behind the leaf are one walk
            right = decider.decide_leaf(states.leaf).label == label
            seen = sum(word[: len(states.states)])
            sums += chance * np.array([right, seen, light[states.states].sum(), len(states.states)])
    found = measured_walks(walks_of(model, COUNTING, images, labels, Conditions(dark=0.02)))
    wanted = (found.accuracy_mean, found.clicks_mean, found.photons_mean, found.exposures_mean)
    np.testing.assert_allclose(sums / 6, wanted, rtol=1e-9)
    drawn = measured_walks(walks_of(model, COUNTING, images, labels, Conditions(dark=0.02, seed=1), trials=3000))
    assert abs(drawn.clicks_mean - found.clicks_mean) < 5 * 3 * 4 / math.sqrt(6 * 3000)
    assert abs(drawn.accuracy_mean - found.accuracy_mean) < 5 * found.accuracy_std / math.sqrt(3000)
