"""The compiled detector draws the very bits of the plain one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pans.instrument.click_law import ClickLaw
from pans_sim.scene.detector import sample_clicks, uniform_numbers
from pans_sim.scene.detector_kernels import click_thresholds, sample_words
from pans_sim.scene.detector_model import DetectorModel

PLAIN = DetectorModel(ClickLaw())


def draw(
    model: DetectorModel, p: np.ndarray, rows: np.ndarray, first: int, previous: np.ndarray, width: int
) -> np.ndarray:
    words = np.full((len(rows), width), 0xEE, np.uint8)
    with np.errstate(over="ignore"):
        sample_words(model, p, rows, 42, first, previous, words)
    return words


@pytest.mark.uncompiled("0.0-0.0-10", "0.3-0.2-10")
@pytest.mark.parametrize("channels", [1, 8, 10, 70])
@pytest.mark.parametrize(("p_ap", "p_ct"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.2), (0.3, 0.2)])
def test_the_bits_are_those_of_the_plain_detector(channels: int, p_ap: float, p_ct: float) -> None:
    model = replace(PLAIN, afterpulse_probability=p_ap, crosstalk_probability=p_ct)
    rng = np.random.default_rng(channels)
    p = rng.random((5, channels))
    p[0], p[1], p[2] = 0.0, 1.0, 2.0**-53
    rows = rng.integers(0, 5, 300)
    before = rng.integers(0, 2, channels).astype(np.uint8)
    wanted = sample_clicks(model, p[rows], 42, 2**33, before)
    width = -(-channels // 8) + 1
    previous = before.copy()
    words = np.concatenate(
        [draw(model, p, rows[:120], 2**33, previous, width), draw(model, p, rows[120:], 2**33 + 120, previous, width)]
    )
    assert (np.unpackbits(words, axis=1, bitorder="little")[:, :channels] == wanted).all()
    assert (previous == wanted[-1]).all()
    assert (words[:, -1] == 0).all()


def test_thresholds_are_exact() -> None:
    numbers = uniform_numbers(3, 0, 2000, 1).ravel()
    whole = (numbers * 2.0**53).astype(np.uint64)
    for p in (0.0, 2.0**-53, 0.1, 0.5, np.nextafter(1, 0), 1.0, *numbers[:20], *np.nextafter(numbers[:20], 1)):
        assert ((whole < click_thresholds(np.array(p))) == (numbers < p)).all()
