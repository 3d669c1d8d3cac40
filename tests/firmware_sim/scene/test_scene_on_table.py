"""What a profile states of its optics and its source is what the simulated light does, and a hidden truth takes its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pans.instrument.profile import Optics, load_profile
from pans_sim.scene.changes import Changes
from pans_sim.scene.detector_model import detector_model, first_click_probability
from pans_sim.scene.scene_file import scene_on_table
from pans_sim.scene.still import Scene


def profile(**optics: float):  # type: ignore[no-untyped-def]
    return replace(load_profile("ideal"), optics=Optics(**optics))  # type: ignore[arg-type]


def test_the_stated_optics_hold_and_a_hidden_truth_replaces_what_it_names() -> None:
    stated = profile(psf_px=0.6, right_px=0.5, shift_tolerance_px=1.0, dark_pixel=0.001)
    scene = scene_on_table("fashion200", "", "", stated).what
    assert isinstance(scene, Scene)
    assert scene.imaging.words() == "right_px 0.5, psf_px 0.6, black 0.001"
    hidden = scene_on_table("fashion200", "", "shift=-1,0.25:gain=2%", stated).what
    assert isinstance(hidden, Scene)
    assert hidden.imaging.words() == "right_px -1, down_px 0.25, psf_px 0.6, black 0.001, gain 1.02"
    perfect = scene_on_table("fashion200", "", "", load_profile("ideal")).what
    assert isinstance(perfect, Scene)
    assert perfect.imaging.is_identity


def test_a_source_that_drifts_does_so_all_the_time() -> None:
    scene = scene_on_table("fashion200", "dark:at_s=30:factor=2", "", profile(source_drift_percent_per_hour=-3.6))
    assert len(scene.changes) == 2
    assert Changes(scene.changes, 1).efficiency(np.array([0.0, 3600.0])) == pytest.approx([1.0, 1 - 0.036])
    assert not scene_on_table("fashion200", "", "", profile(psf_px=0.5)).changes


def test_light_that_fluctuates_clicks_as_drawn_factors_do() -> None:
    model = detector_model(profile(source_fluctuation=0.25), 1000.0)
    light = np.array([0.0, 0.2, 1.0, 3.0])
    factors = np.maximum(0.0, 1 + 0.25 * np.random.default_rng(0).standard_normal(400_000))
    steady = replace(model, fluctuation=0.0)
    wanted = [first_click_probability(steady, factors * mean).mean() for mean in light]
    errors = [first_click_probability(steady, factors * mean).std() / np.sqrt(400_000) for mean in light]
    found = first_click_probability(model, light)
    assert np.all(np.abs(found - wanted) <= 5 * np.array(errors) + 1e-12)
    assert np.all(found[1:] < first_click_probability(steady, light)[1:] - 10 * np.array(errors[1:]))
