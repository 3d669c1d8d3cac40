"""Optics: lambda against the plain formula, exactness, and what does not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pans.instrument.click_law import object_transmission
from pans.instrument.optics import Imaging, imaging_of
from pans.instrument.profile import ObjectModulator, Profile, load_profile
from pans_sim.scene import optics
from pans_sim.scene.optics import expected_photoelectrons, photons_per_level
from pans_sim.scene.still import Scene, load_scene, scene_from_arrays

RNG = np.random.default_rng(5)
SCENE: Scene = scene_from_arrays("noise", RNG.integers(0, 256, (9, 7, 6), dtype=np.uint8), None, ())
LEVELS = RNG.integers(0, 124, (4, 42)).astype(np.uint16)


def profiles() -> list[Profile]:
    paper, ideal = load_profile("oled-qcmos"), load_profile("ideal")
    coarse = replace(paper, object_modulator=ObjectModulator(contrast=20.0, levels=5))
    return [ideal, paper, coarse]


@pytest.mark.parametrize("profile", profiles(), ids=["ideal", "paper", "coarse"])
def test_lambda_is_the_sum_of_pattern_times_transmission(profile: Profile) -> None:
    pattern = LEVELS * photons_per_level(profile, 1500.0)
    expected = object_transmission(profile, SCENE.images).reshape(9, -1) @ pattern.T
    found = expected_photoelectrons(profile, SCENE, LEVELS, 1500.0)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_the_top_level_yields_the_peak_rate() -> None:
    profile = load_profile("oled-qcmos")
    top = profile.projector.levels - 1
    one = expected_photoelectrons(profile, load_scene("uniform"), np.array([[top]], np.uint16), 2000.0)
    assert one[0, 0] == pytest.approx(profile.projector.peak_photoelectrons_hz * 2e-3, rel=1e-15)


def test_uniform_passes_everything_and_dark_nothing() -> None:
    profile = load_profile("oled-qcmos")
    uniform = expected_photoelectrons(profile, load_scene("uniform"), LEVELS, 1000.0)
    np.testing.assert_allclose(uniform[0], LEVELS.sum(1) * photons_per_level(profile, 1000.0), rtol=1e-14)
    assert not expected_photoelectrons(profile, load_scene("dark"), LEVELS, 1000.0).any()


def test_blocks_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    profile = load_profile("oled-qcmos")
    whole = expected_photoelectrons(profile, SCENE, LEVELS, 1000.0)
    monkeypatch.setattr(optics, "_VALUES_PER_BLOCK", 2)
    assert np.array_equal(whole, expected_photoelectrons(profile, SCENE, LEVELS, 1000.0))


def test_patterns_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"patterns have 41 pixels, scene 'noise' has 42 \(7 x 6\)"):
        expected_photoelectrons(load_profile("ideal"), SCENE, LEVELS[:, :41], 1000.0)


def test_the_table_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optics, "MAX_TABLE_ENTRIES", 35)
    with pytest.raises(ValueError, match="9 objects x 4 patterns"):
        expected_photoelectrons(load_profile("ideal"), SCENE, LEVELS, 1000.0)


def rendered(image: np.ndarray, pattern: np.ndarray, right: float, down: float) -> float:
    """Pattern times the object moved, by 20 x 20 points per pixel."""
    fine = np.kron(image, np.ones((20, 20)))
    moved = np.zeros_like(fine)
    rows, columns, x, y = *fine.shape, round(20 * right), round(20 * down)
    moved[max(y, 0) : rows + min(y, 0), max(x, 0) : columns + min(x, 0)] = fine[
        max(-y, 0) : rows + min(-y, 0), max(-x, 0) : columns + min(-x, 0)
    ]
    return float((moved * np.kron(pattern, np.ones((20, 20)))).sum() / 400)


@pytest.mark.parametrize("profile", profiles(), ids=["ideal", "paper", "coarse"])
def test_an_object_out_of_place_brings_the_light_of_where_it_stands(profile: Profile) -> None:
    scene = replace(SCENE, imaging=imaging_of("shift=0.7,-0.3:black=0.01:gain=5%"))
    found = expected_photoelectrons(profile, scene, LEVELS, 1000.0)
    top, unit = profile.projector.levels - 1, photons_per_level(profile, 1000.0)
    for i, j in ((0, 0), (8, 3), (4, 2)):
        transmission = object_transmission(profile, SCENE.images[i : i + 1])[0]
        pattern = 1.05 * (0.99 * LEVELS[j].reshape(7, 6) + 0.01 * top)
        assert found[i, j] == pytest.approx(unit * rendered(transmission, pattern, 0.7, -0.3), rel=1e-12)


def test_a_target_fills_the_field_wherever_it_stands() -> None:
    profile = load_profile("oled-qcmos")
    perfect = expected_photoelectrons(profile, load_scene("uniform"), LEVELS, 1000.0)
    moved = replace(load_scene("uniform"), imaging=Imaging(3.0, 2.0, 10.0, psf_px=1.0, gain=0.5))
    np.testing.assert_allclose(expected_photoelectrons(profile, moved, LEVELS, 1000.0), 0.5 * perfect, rtol=1e-13)
    lit = replace(load_scene("uniform"), imaging=Imaging(black=0.25))
    dark = expected_photoelectrons(profile, lit, np.zeros((1, 42), np.uint16), 1000.0)
    top = profile.projector.levels - 1
    assert dark[0, 0] == pytest.approx(0.25 * 42 * top * photons_per_level(profile, 1000.0), rel=1e-13)
