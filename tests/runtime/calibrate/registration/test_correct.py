"""Patterns corrected for a measured table: exact where levels allow it, whole levels within range, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from pans.base import SHIPPED
from pans.base.errors import ConfigError
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import load_bundle
from pans.calibrate.registration.correct import corrected
from pans.calibrate.registration.file import trained_optics
from pans.instrument.optics import IDENTITY, Imaging, seen

SHAPE = (28, 28)
TURNED = Imaging(right_px=1.0, down_px=1.0, rotation_deg=2.0)


@pytest.fixture(scope="module")
def fashion10() -> Bundle:
    return load_bundle(SHIPPED / "fashion10.pans")[0]


def inside(bundle: Bundle, rows: int, seed: int) -> Bundle:
    """The bundle with random patterns of its levels, a few pixels lit, none near the border."""
    rng, levels = np.random.default_rng(seed), np.zeros((rows, *SHAPE), np.uint16)
    levels[:, 6:22, 6:22] = rng.integers(1, bundle.levels, (rows, 16, 16)) * (rng.random((rows, 16, 16)) < 0.3)
    return replace(bundle, pattern_levels=levels.reshape(rows, -1))


def blobs(seed: int, count: int = 200) -> np.ndarray:
    """Smooth images from 0 to 1, (count, pixels): a prior of its own, not the one that the correction assumes."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:28, 0:28]
    centre, width = rng.uniform(6, 22, (2, count, 4, 1, 1)), rng.uniform(2, 6, (count, 4, 1, 1))
    bumps = np.exp(-((y - centre[0]) ** 2 + (x - centre[1]) ** 2) / (2 * width**2))
    return np.minimum(bumps.sum(axis=1), 1.0).reshape(count, -1)


def test_perfect_optics_change_nothing(fashion10: Bundle) -> None:
    shown, found = corrected(fashion10, IDENTITY)
    np.testing.assert_array_equal(shown.pattern_levels, fashion10.pattern_levels)
    assert (found.light_kept, found.error_before, found.error_after) == (1.0, 0.0, 0.0)


def test_a_shift_of_whole_pixels_moves_the_patterns(fashion10: Bundle) -> None:
    bundle = inside(fashion10, 8, 1)
    shown, _ = corrected(bundle, Imaging(right_px=2.0, down_px=-1.0))
    moved = np.roll(bundle.pattern_levels.reshape(-1, *SHAPE), (-1, 2), axis=(1, 2))
    np.testing.assert_array_equal(shown.pattern_levels.reshape(-1, *SHAPE), moved)


@pytest.mark.parametrize("levels", [2, 124])
def test_what_objects_receive_comes_near_to_what_was_trained(fashion10: Bundle, levels: int) -> None:
    bundle = inside(replace(fashion10, levels=levels), 12, 2)
    images = blobs(3)
    shown, found = corrected(bundle, replace(TURNED, scale=1.01))
    met = seen(replace(TURNED, scale=1.01), images, SHAPE)  # of the object, where the correction uses the adjoint
    wanted = images @ bundle.pattern_levels.T.astype(np.float64)
    before = met @ bundle.pattern_levels.T.astype(np.float64) - wanted
    after = met @ shown.pattern_levels.T.astype(np.float64) - wanted
    assert np.sqrt(np.mean(after**2)) < 0.3 * np.sqrt(np.mean(before**2))
    assert shown.pattern_levels.max() < levels
    assert found.error_after < 0.5 * found.error_before
    assert found.light_kept == pytest.approx(1.0, abs=0.02)
    assert shown.pattern_levels.sum() == pytest.approx(bundle.pattern_levels.sum() / 1.01**2, rel=0.03)


def test_the_flat_field_is_levelled(fashion10: Bundle) -> None:
    bundle = inside(fashion10, 8, 4)
    half = replace(bundle, pattern_levels=bundle.pattern_levels // 2)  # so that there is room above
    field = np.tile(np.linspace(0.8, 1.2, 28), (28, 1))
    shown, _ = corrected(half, Imaging(flat=field))
    light, wanted = shown.pattern_levels * field.reshape(-1), half.pattern_levels.astype(np.float64)
    lit = wanted > 10
    assert np.abs(light - wanted)[lit].max() < 3  # levels, where the field alone would leave up to 12
    assert (shown.pattern_levels[~(wanted > 0)] <= 1).all()


def test_a_table_that_loses_the_light_is_refused(fashion10: Bundle) -> None:
    with pytest.raises(
        ConfigError, match=r"table\.json: on the measured table .* has its place on the grid, needed 80%"
    ):
        corrected(inside(fashion10, 4, 5), Imaging(right_px=16.0), where="table.json")


@pytest.mark.parametrize(
    ("told", "psf"),
    [
        ({"optics": "shift=1:rotate=2:psf=0.5..0.8:black=0.002"}, 0.65),
        ({"optics": "of=another"}, 0.0),
        (None, 0.0),
        ([], 0.0),
    ],
)
def test_a_bundle_says_for_which_optics_it_was_trained(fashion10: Bundle, told: object, psf: float) -> None:
    bundle = replace(fashion10, provenance={"tolerates": told})
    found = trained_optics(bundle)
    assert (found.psf_px, found.right_px, found.rotation_deg) == (pytest.approx(psf), 0.0, 0.0)
