"""The law of afterpulses and the simulator, each against carriers that are counted one by one."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from lab_afterpulses import clicks
from steady_afterpulses import correlation, stationary_chance

from pans.firmware_sim.scene.detector import sample_clicks
from pans.firmware_sim.scene.detector_model import DetectorModel
from pans.runtime.detector import Afterpulses
from pans.runtime.instrument.click_law import ClickLaw

SIGMAS = 4.5
ALLOWED, OF_WORDS = 0.002, 0.004  # of a probability; of a word, whose counts have errors of up to 0.0006 below
SEQUENCE = (1.5, 0.1, 0.02, 0.8, 3.0, 0.05, 0.3, 0.0)  # mean photoelectrons of exposures one after the other


def settings(count: int) -> list[tuple[float, Afterpulses]]:
    """Draw settings over the whole range of light, probability, time constant and pause, gated and not."""
    rng = np.random.default_rng(7)
    drawn = []
    for number in range(count):
        tau = float(rng.choice([0.2, 0.5, 1.0, 2.0, 5.0, 20.0]))
        p, pause = float(rng.choice([0.005, 0.02, 0.05, 0.1])), float(rng.choice([0.0, 0.2, 1.0]))
        mean = math.exp(rng.uniform(math.log(0.02), math.log(4.0)))
        drawn.append((mean, Afterpulses(p, tau, pause, bool(number % 2))))
    return drawn


def counted(light: np.ndarray, law: Afterpulses, seed: int) -> np.ndarray:
    """Clicks uint8 (2, instruments, exposures): of light alone, and with afterpulses."""
    return clicks(light, law.carriers, law.time, law.pause, law.free_running, seed)


def steady(mean: float, law: Afterpulses, exposures: int, seed: int, length: int = 200) -> tuple[float, float]:
    """Share of clicks when the traps have settled, and its standard error over instruments.

    What light alone would do is known: only the difference has an error.
    """
    before = math.ceil(8 * law.time / (1 + law.pause)) + 3
    found = counted(np.full((max(2, exposures // length), before + length), mean), law, seed)[:, :, before:]
    rows = found[1].mean(axis=1) - found[0].mean(axis=1)
    return float(rows.mean()) - math.expm1(-mean), float(rows.std(ddof=1) / len(rows) ** 0.5)


def words_of(law: Afterpulses, light: tuple[float, ...]) -> np.ndarray:
    """Chances of all words of clicks by the law, exposure by exposure from empty traps; the first exposure is the lowest bit."""
    chance, memory = np.ones(1), np.zeros((2, 1))
    for mean in light:
        click = law.chance(-math.expm1(-mean), memory)
        chance = np.concatenate([chance * (1 - click), chance * click])
        memory = np.concatenate([law.after(mean, memory, clicked) for clicked in (0, 1)], axis=1)
    return chance


def shares_of_words(found: np.ndarray) -> np.ndarray:
    words = (found.astype(np.int64) << np.arange(found.shape[1])).sum(axis=1)
    return np.bincount(words, minlength=1 << found.shape[1]) / len(words)


def counted_words(light: tuple[float, ...], law: Afterpulses, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Shares of all words from empty traps, and their errors; those of light alone are known, and correct for what was drawn."""
    alone, found = counted(np.tile(light, (n, 1)), law, seed)
    known = words_of(Afterpulses(0.0, 1.0), light)
    shares, drawn = shares_of_words(found), shares_of_words(alone)
    changed = found[(alone != found).any(axis=1)], alone[(alone != found).any(axis=1)]
    moved = shares_of_words(changed[0]) + shares_of_words(changed[1]) if len(changed[0]) else shares * 0
    errors = np.sqrt(np.maximum(moved * len(changed[0]), 1.0)) / n
    return shares - drawn + known, errors


@pytest.mark.parametrize("number", range(8))
def test_steady_light_clicks_as_often_as_the_law_says(number: int) -> None:
    mean, law = settings(8)[number]
    share, error = steady(mean, law, 40_000, number)
    assert abs(share - stationary_chance(law, mean)) < SIGMAS * error
    without = -math.expm1(-mean)
    assert stationary_chance(law, mean) > without  # else the test could not tell the law from none


def test_clicks_depend_on_each_other_as_the_law_says() -> None:
    law, mean, n = Afterpulses(0.2, 2.0, 0.3), 0.3, 40_000
    found = counted(np.full((n, 30), mean), law, 3)[1, :, 20:].astype(np.float64)
    for lag, wanted in enumerate(correlation(law, mean, 4).tolist(), 1):
        pairs = (found[:, :-lag] - found.mean()) * (found[:, lag:] - found.mean())
        rows = pairs.mean(axis=1)
        error = float(rows.std(ddof=1)) / math.sqrt(n)
        assert abs(float(rows.mean()) - wanted) < SIGMAS * error
        assert wanted > 3 * error


@pytest.mark.parametrize("law", [Afterpulses(0.1, 2.0, 0.2), Afterpulses(0.05, 0.5, 0.5, True)])
def test_words_of_unequal_exposures_come_as_often_as_the_law_says(law: Afterpulses) -> None:
    light = SEQUENCE[:4]
    shares, errors = counted_words(light, law, 150_000, 5)
    wanted = words_of(law, light)
    assert wanted.sum() == pytest.approx(1)
    assert np.all(np.abs(shares - wanted) < SIGMAS * errors + 2e-4)
    independent = words_of(Afterpulses(0.0, 1.0), light)
    assert np.abs(shares - independent).max() > 0.005


@pytest.mark.parametrize("law", [Afterpulses(0.1, 2.0, 0.2), Afterpulses(0.2, 1.0, 0.5, True), Afterpulses(0.3, 0.0)])
def test_the_simulator_clicks_as_carriers_do(law: Afterpulses) -> None:
    model = DetectorModel(
        ClickLaw(),
        law.probability,
        trap_time=law.time,
        pause=law.pause,
        on_in_pause=law.free_running,
        crosstalk_further=() if law.time else (0.0,),  # which takes the path of detectors that remember
    )
    chance = np.tile(-np.expm1(-np.array(SEQUENCE)), 8000)[:, None]
    found = sample_clicks(model, chance, 11, 0, np.zeros(1, np.uint8))[:, 0].reshape(-1, len(SEQUENCE))
    if not law.time:
        first, expected, before = -np.expm1(-np.array(SEQUENCE)), np.zeros(len(SEQUENCE)), 0.0
        for i in (*range(len(SEQUENCE)), *range(len(SEQUENCE))):  # the second round begins where the first one ended
            expected[i] = before = first[i] + (1 - first[i]) * law.probability * before
    else:
        rows = counted(np.tile(SEQUENCE, (2000, 12)), law, 4)[1]
        expected = rows.reshape(2000, 12, len(SEQUENCE))[:, 6:].mean(axis=(0, 1))
    errors = np.sqrt(np.maximum(expected * (1 - expected), 1e-4) * (1 / len(found) + (1 / 12_000 if law.time else 0)))
    assert np.all(np.abs(found.mean(axis=0) - expected) < SIGMAS * errors)


def test_how_exposures_are_cut_into_batches_changes_no_click() -> None:
    model = DetectorModel(
        ClickLaw(), 0.3, trap_time=3.0, pause=0.1, crosstalk_probability=0.1, crosstalk_further=(0.05,)
    )
    chance, none = np.full((40, 5), 0.2), np.zeros(5, np.uint8)
    whole = sample_clicks(model, chance, 2, 100, none)
    memory = np.zeros(5)
    parts = [sample_clicks(model, chance[a:b], 2, 100 + a, none, memory) for a, b in ((0, 1), (1, 17), (17, 40))]
    assert np.array_equal(whole, np.concatenate(parts))


@pytest.mark.slow
def test_the_worst_of_200_settings() -> None:
    """Steady light, and all words of four unequal exposures: the figures of docs/explanation/detector.md."""
    worst, at = (0.0, 0.0), ""
    for number, (mean, law) in enumerate(settings(200)):
        share, error = steady(mean, law, 600_000, number)
        worst, at = max((worst, at), ((abs(share - stationary_chance(law, mean)), error), f"{mean:.3f} {law}"))
    print(f"steady light: worst {worst[0]:.5f} (error {worst[1]:.5f}) at {at}")
    assert worst[0] < ALLOWED
    worst = (0.0, 0.0)
    for number, (_, law) in enumerate(settings(200)):
        light = tuple(np.random.default_rng(number).permutation(SEQUENCE)[:4].tolist())
        shares, errors = counted_words(light, law, 200_000, number)
        far = np.abs(shares - words_of(law, light))
        worst, at = max((worst, at), ((float(far.max()), float(errors[far.argmax()])), f"{light} {law}"))
    print(f"words of four exposures: worst {worst[0]:.5f} (error {worst[1]:.5f}) at {at}")
    assert worst[0] < OF_WORDS


def test_what_no_traps_do_is_refused() -> None:
    for wrong in ((0.7, 1.0), (-0.1, 0.0), (0.1, math.inf), (0.1, 1.0, -1.0)):
        with pytest.raises(ValueError, match="allowed"):
            Afterpulses(*wrong)
    assert not Afterpulses(0.0)
    assert all(Afterpulses(p, t) for p, t in product((0.1,), (0.0, 1.0)))
