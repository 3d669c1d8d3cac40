"""From real patterns to levels: what rounding may change is bounded, and the bound is reached."""

import numpy as np
import pytest

from pans.bundle.making.quantise import quantise_patterns

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("levels", [2, 16, 124, 65536])
@pytest.mark.parametrize("top", [None, 1.5])
def test_no_object_changes_by_more_than_the_bound(levels, top):
    patterns = RNG.exponential(0.3, (4, 50))
    found = quantise_patterns(patterns, levels, top)
    change = found.patterns() - patterns
    for transmission in [RNG.uniform(size=(200, 50)), np.ones((1, 50)), np.zeros((1, 50))]:
        assert np.all(np.abs(transmission @ change.T) <= found.error_bound * (1 + 1e-12) + 1e-15)
    # reached by the object that lets through only the light added, or only the light taken away
    worst = np.maximum((change * (change > 0)).sum(axis=1), -(change * (change < 0)).sum(axis=1))
    assert found.error_bound == pytest.approx(worst, rel=1e-12)


def test_the_brightest_pixel_is_the_top_level_none_moves_by_more_than_half_a_level_and_brighter_ones_are_clipped():
    patterns = RNG.uniform(0, 2, (3, 30))
    found = quantise_patterns(patterns, 124)
    assert (found.pattern_levels.max(), found.pattern_levels.dtype) == (123, np.uint16)
    assert np.abs(found.patterns() - patterns).max() <= found.photons_per_level / 2 * (1 + 1e-12)
    found = quantise_patterns(np.array([[0.2, 3.0]]), 11, 1.0)
    assert found.pattern_levels.tolist() == [[2, 10]]
    assert found.error_bound == pytest.approx([2.0])


def test_quantising_refuses_what_is_not_light() -> None:
    for bad, words in (
        *((np.array([[1.0, value]]), "allowed: finite photons") for value in (-1e-9, np.nan, np.inf)),
        (np.zeros((2, 2)), "no pattern has any light"),
        *((shape, "floats") for shape in (np.ones((2, 2), dtype=int), np.ones(3))),
    ):
        with pytest.raises(ValueError, match=words):
            quantise_patterns(bad, 4)


def test_quantising_rounds_to_the_nearest_level() -> None:
    found = quantise_patterns(np.array([[0.0, 0.1, 0.26, 0.74, 1.5]], dtype=np.float32), 4)
    assert found.pattern_levels.tolist() == [[0, 0, 1, 1, 3]]
    assert (found.photons_per_level, found.pixels_lost) == (0.5, 1)
    errors = found.error_max, found.illumination, found.illumination_wanted
    assert errors == pytest.approx((0.24, 2.5, 2.6), abs=1e-6)
    full = quantise_patterns(np.array([[0.0, 1e-30, 5e-324 + 1e-25]]), 65536)
    assert full.pattern_levels[0, 2] == 65535


def floyd_steinberg_by_hand(wanted: np.ndarray, levels: int) -> np.ndarray:
    """The definition, one pattern and one pixel at a time, on a copy that takes the errors."""
    rows, columns = wanted.shape
    left, shown = wanted.copy(), np.zeros_like(wanted)
    for row in range(rows):
        step = 1 if row % 2 == 0 else -1
        for column in range(columns) if step == 1 else reversed(range(columns)):
            shown[row, column] = min(levels - 1, max(0, round(left[row, column])))
            error = left[row, column] - shown[row, column]
            for down, along, share in ((0, step, 7), (1, -step, 3), (1, 0, 5), (1, step, 1)):
                if row + down < rows and 0 <= column + along < columns:
                    left[row + down, column + along] += error * share / 16
    return shown


@pytest.mark.parametrize("levels", [2, 3, 4])
def test_error_diffusion_is_that_of_floyd_and_steinberg(levels: int) -> None:
    patterns = RNG.uniform(0, 1, (3, 6 * 9))
    top = float(patterns.max())
    found = quantise_patterns(patterns, levels, top, dither=(6, 9))
    scale = top / (levels - 1)
    for pattern, shown in zip(patterns, found.pattern_levels):
        assert np.array_equal(shown.reshape(6, 9), floyd_steinberg_by_hand(pattern.reshape(6, 9) / scale, levels))


def test_error_diffusion_keeps_the_light_of_dim_patterns_that_rounding_loses() -> None:
    dim = np.full((1, 40 * 40), 0.2)
    dim[0, 0] = 1.0
    rounded, spread = quantise_patterns(dim, 2), quantise_patterns(dim, 2, dither=(40, 40))
    assert rounded.illumination == 1.0
    assert spread.illumination == pytest.approx(dim.sum(), rel=0.03)
    parts = spread.patterns().reshape(4, 10, 4, 10).sum(axis=(1, 3))
    assert np.abs(parts / 20 - 1).max() < 0.3  # everywhere, not only on the whole
    change = spread.patterns() - dim
    assert spread.error_bound == pytest.approx([max(change[change > 0].sum(), -change[change < 0].sum())])


def test_error_diffusion_leaves_what_is_a_level_already() -> None:
    levels = RNG.integers(0, 4, (2, 30)) / 3
    levels[0, 0] = 1.0
    found = quantise_patterns(levels, 4, 1.0, dither=(5, 6))
    assert np.array_equal(found.patterns(), quantise_patterns(levels, 4).patterns())
    with pytest.raises(ValueError, match="4 pixels, their shape is given as 2 x 3"):
        quantise_patterns(np.ones((1, 4)), 2, dither=(2, 3))


def test_one_bright_pixel_does_not_take_the_levels_of_all_others() -> None:
    patterns = RNG.uniform(0, 0.02, (4, 400))
    patterns[0, 210] = 1.0
    found = quantise_patterns(patterns, 2, dither=(20, 20))
    assert found.photons_per_level < 0.1
    assert found.illumination == pytest.approx(patterns.sum(), rel=0.1)
    as_bright = quantise_patterns(patterns, 2, 1.0, dither=(20, 20))

    def blocks(patterns: np.ndarray) -> np.ndarray:
        return patterns[1:].reshape(3, 5, 4, 5, 4).sum(axis=(2, 4))

    errors = [np.abs(blocks(one.patterns()) - blocks(patterns)).mean() for one in (found, as_bright)]
    assert errors[0] < errors[1] / 3
