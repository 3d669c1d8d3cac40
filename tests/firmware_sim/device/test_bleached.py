"""Objects that bleach before the simulator: held against pixels that fade one by one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pans.base.errors import ConfigError, UsageError
from pans.instrument.optics import Bleaching, Imaging, met
from pans.instrument.profile import load_profile
from pans.protocol.wire import DARK_PATTERN
from pans.protocol.wire.commands import SEQUENTIAL
from pans_sim.device.bleached import Sample, bleached_photoelectrons
from pans_sim.device.instrument import Instrument
from pans_sim.device.view import View
from pans_sim.device.walking import PatternLight
from pans_sim.ports.serve import build_instrument, parse_sim_url
from pans_sim.ports.virtual import START_NS
from pans_sim.scene.moving import SceneFile
from pans_sim.scene.optics import photons_per_level
from pans_sim.scene.program import Program
from pans_sim.scene.still import Scene, load_scene, scene_from_arrays

IDEAL = load_profile("ideal")
RNG = np.random.default_rng(12)
LEVELS = RNG.integers(0, IDEAL.projector.levels, (3, 6)).astype(np.uint16)
TICKS = 400
EXPOSURE_US = TICKS * 1e6 / IDEAL.clock.tick_hz
LIGHT = LEVELS * photons_per_level(IDEAL, EXPOSURE_US)  # of each pixel
D0 = float(LIGHT.max())


def scene(mixed: bool = False, imaging: Imaging | None = None) -> Scene:
    images = RNG.integers(0, 256, (4, 2, 3)).astype(np.uint8)
    found = replace(scene_from_arrays("toy", images, None, ()), bleaching=Bleaching(D0, mixed))
    return found if imaging is None else replace(found, imaging=imaging)


def program(patterns: list[int], cycles_per_object: int) -> Program:
    shown = np.array([DARK_PATTERN if number < 0 else number for number in patterns], np.uint16)
    n = len(shown)
    return Program(
        SEQUENTIAL, 3, TICKS, 100, 100 * n, cycles_per_object, np.arange(n, dtype=np.int64) * 100, shown, ((0, n),)
    )


def fading(transmission: np.ndarray, shown: list[np.ndarray], mixed: bool) -> list[float]:
    """The photoelectrons of each exposure of one object, pixel by pixel."""
    left, found = [1.0] * len(transmission), []
    for light in shown:
        own = [sum(light) / len(light)] * len(light) if mixed else list(light)
        total = 0.0
        for i, dose in enumerate(own):
            mean = (1 - math.exp(-dose / D0)) / (dose / D0) if dose else 1.0
            total += transmission[i] * left[i] * light[i] * mean
            left[i] *= math.exp(-dose / D0)
        found.append(total)
    return found


@pytest.mark.parametrize("mixed", [False, True])
def test_a_plan_fades_every_object_from_its_first_exposure_to_its_last(mixed: bool) -> None:
    toy, plan = scene(mixed), program([2, -1, 0, 1], 2)
    view = View(IDEAL, SceneFile("toy", toy))
    table = view.tabulate(plan, LEVELS)
    light, _ = view.light_and_clicks(plan, 0, table)  # type: ignore[arg-type]
    rows, row_of = light.rows(0, 5 * 8)  # the fifth object is the first again, and fresh
    found = rows[row_of, 0].reshape(5, 8)
    dark = np.zeros(6)
    for visit in range(5):
        transmission = toy.images[visit % 4].reshape(-1) / 255
        shown = [LIGHT[2], dark, LIGHT[0], LIGHT[1]] * 2
        np.testing.assert_allclose(found[visit], fading(transmission, shown, mixed), rtol=1e-12)
    assert found[0, 4] < 0.9 * found[0, 0]


@pytest.mark.parametrize("mixed", [False, True])
def test_a_walk_fades_its_object_by_what_it_shows(mixed: bool) -> None:
    toy = scene(mixed)
    sample = PatternLight(IDEAL, toy, LEVELS, EXPOSURE_US).fresh_sample()
    assert sample is not None
    shown = [(2, 1.0), (0, 0.25), (2, 0.5)]
    for visit in (0, 1, 4):
        transmission = toy.images[visit % 4].reshape(-1) / 255
        wanted = fading(transmission, [LIGHT[pattern] * share for pattern, share in shown], mixed)
        assert [sample.photoelectrons(visit, *one) for one in shown] == pytest.approx(wanted, rel=1e-12)
    assert PatternLight(IDEAL, replace(toy, bleaching=Bleaching()), LEVELS, EXPOSURE_US).fresh_sample() is None


def test_imperfect_optics_bleach_what_they_light() -> None:
    imaging = Imaging(right_px=0.4, psf_px=0.6, black=0.05)
    toy, plan = scene(imaging=imaging), program([0, 1, 2], 1)
    full = (IDEAL.projector.levels - 1) * photons_per_level(IDEAL, EXPOSURE_US)
    light = met(imaging, LIGHT, (2, 3), full)
    found = bleached_photoelectrons(IDEAL, toy, LEVELS, plan, EXPOSURE_US)
    for number in range(4):
        transmission = toy.images[number].reshape(-1) / 255
        np.testing.assert_allclose(found[number], fading(transmission, list(light), False), rtol=1e-12)
    sample = Sample(IDEAL, toy, LEVELS, EXPOSURE_US)
    assert [sample.photoelectrons(2, number, 1.0) for number in range(3)] == pytest.approx(found[2].tolist())


def test_a_target_fades_too_and_a_dark_one_gives_nothing() -> None:
    plan = program([0, 1], 1)
    uniform = replace(load_scene("uniform"), bleaching=Bleaching(D0))
    found = bleached_photoelectrons(IDEAL, uniform, LEVELS, plan, EXPOSURE_US)
    np.testing.assert_allclose(found[0], fading(np.ones(6), [LIGHT[0], LIGHT[1]], False), rtol=1e-12)
    dark = replace(load_scene("dark"), bleaching=Bleaching(D0))
    assert not bleached_photoelectrons(IDEAL, dark, LEVELS, plan, EXPOSURE_US).any()
    with pytest.raises(ValueError, match="objects that bleach through 40000000 exposures"):
        bleached_photoelectrons(IDEAL, uniform, LEVELS, program([0, 1], 20_000_000), EXPOSURE_US)


def test_the_device_says_that_its_objects_bleach() -> None:
    options = parse_sim_url("sim:ideal?scene=fashion200&pace=fast&bleach=40:mixed")
    instrument, _ = build_instrument(options, START_NS)
    assert isinstance(instrument, Instrument)
    assert instrument._facts()["simulated_bleaching"] == "1/e after 40 photoelectrons per pixel, emitters mixed"
    steady, _ = build_instrument(parse_sim_url("sim:ideal?scene=fashion200&pace=fast"), START_NS)
    assert "simulated_bleaching" not in steady._facts()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("url", "error", "text"),
    [
        ("sim:ideal?bleach=0", UsageError, "bleaching dose is 0"),
        ("sim:ideal?bleach=fast", UsageError, "bleaching is 'fast', allowed: D0, or D0:mixed"),
        (
            "sim:flow-snspd?scene=cells-in-flow&pace=fast&bleach=4",
            ConfigError,
            "bleaching is simulated for still objects",
        ),
        ("sim:wdm-snspd?scene=fashion200&pace=fast&bleach=4", ConfigError, "where pattern follows pattern"),
    ],
)
def test_what_cannot_bleach_is_refused(url: str, error: type[Exception], text: str) -> None:
    with pytest.raises(error) as caught:
        build_instrument(parse_sim_url(url), START_NS)
    assert text in str(caught.value)
