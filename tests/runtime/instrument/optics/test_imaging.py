"""What the pattern grid meets of an object, held against renderings; the spelling of --optics; bleaching, to 60 digits."""

import math

import numpy as np
import pytest
from naive_imaging import rendered

from pans.instrument.optics import (
    IDENTITY,
    NO_BLEACHING,
    Bleaching,
    Imaging,
    Tolerance,
    bleached,
    bleaching_of,
    imaging_of,
    is_spec,
    levelled,
    mean_left,
    met,
    operator,
    seen,
    tolerance_of,
)
from pans.instrument.optics.sampling import _gathered, _tail

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")

SHAPE = (9, 12)


def picture(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).random((3, *shape))


@pytest.mark.parametrize(
    ("imaging", "within"),
    [
        (Imaging(0.5, -0.25), 1e-12),
        (Imaging(1.0625, 0.375, psf_px=0.6), 1e-3),
        (Imaging(-0.5, 0.25, scale=1.25, psf_px=0.5), 5e-3),
        (Imaging(0.25, 0.5, rotation_deg=2.0, psf_px=0.6), 5e-3),
        # no blur: the corners of turned squares, and the points' own error
        (Imaging(0.25, 0.5, rotation_deg=-3.0, scale=0.97), 2e-2),
        (Imaging(rotation_deg=30.0, psf_px=0.7), 5e-3),
    ],
)
def test_what_is_seen_is_what_a_rendering_with_256_points_per_pixel_gives(imaging, within):
    image = picture()[0]
    expected = rendered(imaging, image)
    found = seen(imaging, image.reshape(1, -1), SHAPE)[0].reshape(SHAPE)
    np.testing.assert_allclose(found, expected, atol=within)
    other = Imaging(**(imaging.numbers() | {"right_px": imaging.right_px + 0.5}))
    assert np.abs(rendered(other, image) - expected).max() > 4 * within  # so that the comparison can fail


def test_the_object_moves_right_and_down_and_turns_counter_clockwise():
    dot = np.zeros((1, *SHAPE))
    dot[0, 4, 5] = 1.0
    moved = seen(Imaging(right_px=2, down_px=1), dot.reshape(1, -1), SHAPE).reshape(SHAPE)
    assert np.argwhere(moved).tolist() == [[5, 7]]
    east = np.zeros((1, 11, 11))
    east[0, 5, 10] = 1.0
    turned = seen(Imaging(rotation_deg=30.0), east.reshape(1, -1), (11, 11)).reshape(11, 11)
    down, right = (turned * np.mgrid[0:11, 0:11]).sum(axis=(1, 2)) / turned.sum()
    assert (right - 5, down - 5) == pytest.approx((5 * math.cos(math.pi / 6), -5 * math.sin(math.pi / 6)), abs=0.05)


def test_quarter_turns_are_those_of_numpy():
    images = picture(shape=(8, 8))
    for quarters in (-4, -3, -1, 1, 2, 3, 4):
        turned = seen(Imaging(rotation_deg=90.0 * quarters), images.reshape(3, -1), (8, 8))
        np.testing.assert_array_equal(turned.reshape(-1, 8, 8), np.rot90(images, quarters, axes=(1, 2)))


def test_perfect_optics_change_no_bit_and_whole_shifts_move_pixels():
    images = picture().reshape(3, -1)
    np.testing.assert_array_equal(seen(IDENTITY, images, SHAPE), images)
    np.testing.assert_array_equal(seen(Imaging(black=0.1, gain=2.0), images, SHAPE), images)
    expected = np.zeros((3, *SHAPE))
    expected[:, 2:, :-3] = images.reshape(-1, *SHAPE)[:, :-2, 3:]
    np.testing.assert_array_equal(seen(Imaging(-3.0, 2.0), images, SHAPE).reshape(-1, *SHAPE), expected)


@pytest.mark.parametrize("frequency", [1 / 16, 2 / 16, 3 / 16])
def test_a_wave_is_shifted_and_damped_as_fourier_says(frequency):
    """Two squares and a Gaussian: the wave's amplitude falls by sinc(f)**2 exp(-2 (pi sigma f)**2), its phase by the shift."""
    x, sigma, shift = np.arange(80), 0.9, 0.37
    wave = np.cos(2 * math.pi * frequency * x)
    found = seen(Imaging(right_px=shift, psf_px=sigma), wave.reshape(1, -1), (1, 80))[0]
    inner = slice(20, 60)  # beyond reach of the ends
    height = seen(Imaging(psf_px=sigma), np.ones((1, 5)), (5, 1))[0, 2]  # what is lost above and below a single row
    row = seen(Imaging(psf_px=sigma), np.array([[1.0]]), (1, 1))[0, 0] ** 0.5
    amplitude = row * np.sinc(frequency) ** 2 * math.exp(-2 * (math.pi * sigma * frequency) ** 2)
    np.testing.assert_allclose(
        found[inner], amplitude * np.cos(2 * math.pi * frequency * (x - shift))[inner], atol=3e-6
    )
    assert height < 1


def test_no_light_is_made_or_lost_inside_and_a_magnified_object_has_more_of_it():
    dot = np.zeros((1, 31, 31))
    dot[0, 14:16, 15] = 0.7
    for imaging in (Imaging(0.3, -0.8), Imaging(1.7, 0.2, psf_px=1.1), Imaging(0.4, 0.1, scale=1.3, psf_px=0.8)):
        total = seen(imaging, dot.reshape(1, -1), (31, 31)).sum()
        assert total == pytest.approx(1.4 * imaging.scale**2, abs=1e-12 if imaging.scale == 1 else 2e-3)
    assert seen(Imaging(2.0, rotation_deg=7.0, psf_px=0.6), dot.reshape(1, -1), (31, 31)).sum() == pytest.approx(
        1.4, abs=2e-3
    )
    even = seen(Imaging(0.3, 0.4, 5.0, 1.0, 0.5), np.ones((1, 31 * 31)), (31, 31)).reshape(31, 31)
    np.testing.assert_allclose(even[8:-8, 8:-8], 1.0, atol=1e-12)  # an even object is seen even
    assert seen(Imaging(100.0), dot.reshape(1, -1), (31, 31)).max() == 0.0


def test_the_map_is_linear_and_its_matrix_and_the_form_without_a_matrix_agree():
    images = picture().reshape(3, -1)
    for imaging in (Imaging(0.7, 0.3, psf_px=0.7), Imaging(0.7, 0.3, 11.0, 1.1, 0.7), Imaging(-4.0, 0.3, 200.0, 0.8)):
        found = seen(imaging, images, SHAPE)
        np.testing.assert_allclose(images @ operator(imaging, SHAPE).T, found, atol=1e-14)
        np.testing.assert_allclose(_gathered(imaging, images, SHAPE), found, atol=1e-14)
        np.testing.assert_allclose(
            seen(imaging, 2 * images[:1] - images[1:2], SHAPE), 2 * found[:1] - found[1:2], atol=1e-14
        )


def test_tiny_and_huge_numbers_give_what_their_limits_give():
    images = picture().reshape(3, -1)
    np.testing.assert_allclose(seen(Imaging(psf_px=1e-300), images, SHAPE), images, atol=1e-15)
    np.testing.assert_allclose(seen(Imaging(1e-13, rotation_deg=1e-13), images, SHAPE), images, atol=1e-11)
    wide = seen(Imaging(psf_px=1000.0), images, SHAPE)
    expected = images.sum(axis=1, keepdims=True) / (2 * math.pi * 1000.0**2)
    np.testing.assert_allclose(wide, np.broadcast_to(expected, wide.shape), rtol=1e-4)
    assert seen(Imaging(-1e4, 1e4, 45.0, 10.0), images, SHAPE).max() == 0.0
    assert np.isfinite(seen(Imaging(scale=0.1, psf_px=3.0, rotation_deg=1.0), images, SHAPE)).all()


def test_the_tail_of_the_normal_law_is_that_of_erfc():
    z = np.random.default_rng(3).uniform(0, 8.5, 2000)
    expected = [0.5 * math.erfc(value / math.sqrt(2)) for value in z]
    np.testing.assert_allclose(_tail(z), expected, atol=1e-15)


def test_the_light_of_a_pattern_has_black_flat_field_and_gain_once_each():
    rng = np.random.default_rng(5)
    flat = rng.random(SHAPE)
    flat /= flat.mean()
    imaging = Imaging(0.4, -0.2, 3.0, 1.05, 0.6, black=0.01, gain=1.3, flat=flat)
    patterns, objects = rng.random((4, 108)), picture().reshape(3, -1)
    field = seen(imaging, objects, SHAPE)
    by_hand = np.array(
        [
            [1.3 * sum(flat.ravel()[i] * (0.01 + 0.99 * p[i]) * x[i] for i in range(108)) for x in field]
            for p in patterns
        ]
    )
    np.testing.assert_allclose(met(imaging, patterns, SHAPE) @ objects.T, by_hand, rtol=1e-12)
    np.testing.assert_allclose(levelled(imaging, 7 * patterns, SHAPE, 7.0), 7 * levelled(imaging, patterns, SHAPE))
    np.testing.assert_array_equal(met(IDENTITY, patterns, SHAPE), patterns)


@pytest.mark.parametrize(
    ("fact", "words"),
    [
        ({"right_px": math.nan}, "right_px is nan"),
        ({"scale": 0.0}, "scale is 0.0, allowed: a number from 0.1 to 10"),
        ({"psf_px": -0.1}, "psf_px is -0.1"),
        ({"black": 1.0}, "black is 1"),
        ({"gain": 0.0}, "gain is 0"),
        ({"flat": np.full(SHAPE, 1.1)}, "flat has the mean 1.1"),
        ({"flat": np.ones(4)}, r"flat is \(4,\)"),
        ({"flat": np.full(SHAPE, math.inf)}, "not finite"),
    ],
)
def test_impossible_optics_are_refused(fact, words):
    with pytest.raises(ValueError, match=words):
        Imaging(**fact)


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="images are"):
        seen(IDENTITY, np.zeros((1, 7)), SHAPE)
    with pytest.raises(ValueError, match="up to 4096 pixels"):
        operator(IDENTITY, (65, 64))
    with pytest.raises(ValueError, match="flat field is"):
        met(Imaging(flat=np.ones((2, 2))), np.zeros((1, 108)), SHAPE)


def test_one_truth_is_read():
    found = imaging_of("shift=0.7,-0.3:rotate=1.5:scale=98%:psf=0.7:gain=-5%:black=0.002".replace("98%", "0.98"))
    assert found.numbers() == {
        "right_px": 0.7,
        "down_px": -0.3,
        "rotation_deg": 1.5,
        "scale": 0.98,
        "psf_px": 0.7,
        "black": 0.002,
        "gain": 0.95,
    }


def test_a_tolerance_is_read_and_drawn_from():
    found = tolerance_of("shift=1:rotate=2:scale=3%:psf=0.5..0.8:black=0.002:gain=0.9..1.05")
    assert found == Tolerance((-1, 1), (-1, 1), (-2, 2), (0.97, 1.03), (0.5, 0.8), (0.002, 0.002), (0.9, 1.05))
    random = np.random.default_rng(1)
    draws = [found.draw(random).numbers() for _ in range(2000)]
    for name, (low, high) in found.as_dict().items():
        values = np.array([one[name] for one in draws])
        assert low <= values.min()
        assert values.max() <= high
        assert abs(values.mean() - (low + high) / 2) <= 5 * (high - low) / np.sqrt(12 * len(values)) + 1e-12
        assert values.std() == pytest.approx((high - low) / np.sqrt(12), rel=0.1, abs=1e-12)
    pairs = np.array([(one["right_px"], one["down_px"]) for one in draws])
    assert abs(np.corrcoef(pairs.T)[0, 1]) < 5 / np.sqrt(2000)


def test_the_edges_are_the_corners_of_shift_and_rotation():
    edges = tolerance_of("shift=1,0.5:rotate=2:psf=0.5..0.8:black=0.002").edges()
    assert {(one.right_px, one.down_px, one.rotation_deg) for one in edges} == {
        (right, down, turn) for right in (-1, 1) for down in (-0.5, 0.5) for turn in (-2, 2)
    }
    assert {(one.psf_px, one.black) for one in edges} == {(0.8, 0.002)}
    assert len(tolerance_of("psf=0.5").edges()) == 1


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (imaging_of, "", "0 characters"),
        (imaging_of, "x" * 500, "500 characters"),
        (imaging_of, "shift", "KEY=VALUE"),
        (imaging_of, "tilt=1", "shift, rotate"),
        (imaging_of, "psf=0.5:psf=0.6", "twice"),
        (imaging_of, "shift=1", "RIGHT,DOWN"),
        (imaging_of, "psf=nan", "finite"),
        (imaging_of, "psf=-1", "psf_px"),
        (imaging_of, "gain=-100%", "gain"),
        (tolerance_of, "psf=0.8..0.5", "lower one first"),
        (tolerance_of, "shift=1,2,3", "RIGHT,DOWN"),
        (tolerance_of, "rotate=1e9", "rotation_deg"),
    ],
)
def test_what_cannot_be_meant_is_refused(read, text, words):
    with pytest.raises(ValueError, match=words):
        read(text)


def test_a_spec_is_told_from_the_name_of_a_bundle():
    assert is_spec("shift=1,2")
    assert not is_spec("folder/shift=1.pans")
    assert not is_spec("psf")


def test_a_tolerance_is_spelled_as_it_is_read():
    found = tolerance_of("shift=1,0.1:rotate=2:scale=3%:psf=0.5..0.8:black=0.002:gain=0.9..1.05")
    assert tolerance_of(found.spelled()) == found
    assert found.words().startswith("right_px -1 to 1, down_px -0.1 to 0.1, rotation_deg -2 to 2, scale 0.97 to 1.03")
    assert Tolerance().words() == "perfect optics"


RNG = np.random.default_rng(11)


@pytest.mark.parametrize("dose", [1e-9, 1e-3, 0.7, 40.0, 1e6, 1e15])
def test_the_law_holds_at_tiny_and_huge_doses(dose: float) -> None:
    light = np.array([[1e-12, 0.3, 5.0, 1e4], [0.0, 2.0, 1e-6, 20.0], [3.0, 0.1, 9.0, 1e-3]])
    found = bleached(Bleaching(dose), light)
    with mpmath.workdps(60):
        for pixel in range(light.shape[1]):
            before = mpmath.mpf(0)
            for row in range(len(light)):
                shown = mpmath.mpf(light[row, pixel])
                after = before + shown
                wanted = mpmath.mpf(dose) * (mpmath.exp(-before / dose) - mpmath.exp(-after / dose))
                # the exponent itself is known to a few ulp, so that its exponential is to that many times its size
                size = max(1.0, min(750.0, float(before / dose)))
                assert abs(found[row, pixel] - wanted) <= 4e-15 * size * wanted + mpmath.mpf(10) ** -300
                before = after


def test_the_mean_over_an_exposure_has_its_limits() -> None:
    assert mean_left(np.array([0.0, 5e-324, 1e-9])).tolist() == [1.0, 1.0, 1.0 - 0.5e-9]
    assert mean_left(np.array([1e30]))[0] == pytest.approx(1e-30, rel=1e-15)
    assert mean_left(np.array([math.log(2)]))[0] == pytest.approx(0.5 / math.log(2), rel=1e-15)


def _dying(light: np.ndarray, dose: float, mixed: bool, emitters: int, steps: int) -> np.ndarray:
    """Emitters that die one by one: in every small step each one glows by its light, then dies with that light's chance."""
    pixels = light.shape[1]
    alive = np.ones((pixels, emitters), bool)
    glow = np.zeros(light.shape)
    for row, shown in enumerate(light):
        part = shown / steps
        for _ in range(steps):
            glow[row] += alive.mean(axis=1) * part
            received = np.full(pixels, part.mean()) if mixed else part
            alive &= RNG.random(alive.shape) >= (received / dose)[:, None]
    return glow


@pytest.mark.parametrize("mixed", [False, True])
def test_emitters_that_die_one_by_one_give_the_law(mixed: bool) -> None:
    light = np.array([[4.0, 0.0, 1.0], [0.0, 6.0, 2.0], [3.0, 1.0, 0.5]])
    dose, emitters, steps = 5.0, 20_000, 100
    found = bleached(Bleaching(dose, mixed), light)
    simulated = _dying(light, dose, mixed, emitters, steps)
    # the share alive has at most the variance 1/4 over the emitters; a step of light / steps is off by half of itself over the dose
    allowed = light * (5 * 0.5 / math.sqrt(emitters) + light.max() / steps / dose)
    assert (np.abs(found - simulated) <= allowed).all()
    assert (found[2] < 0.75 * light[2]).all()  # it bleaches by much more than that


def test_light_that_stays_is_as_it_was_and_order_matters() -> None:
    light = RNG.random((4, 9)) * 3
    np.testing.assert_array_equal(bleached(NO_BLEACHING, light), light)
    one = bleached(Bleaching(2.0), light)
    back = bleached(Bleaching(2.0), light[::-1])[::-1]
    np.testing.assert_allclose(one.sum(axis=0), back.sum(axis=0), rtol=1e-13)  # what a pixel gives in all is the same
    assert not np.allclose(one, back)
    np.testing.assert_allclose(bleached(Bleaching(1e14), light), light, rtol=1e-12)


@pytest.mark.parametrize("text", ["", "x", "0", "-3", "nan", "inf", "40:", "40:fixed", "1e16", "40:mixed:"])
def test_what_is_no_law_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="bleaching"):
        bleaching_of(text)


@pytest.mark.parametrize("law", [Bleaching(40.0), Bleaching(0.3, True)])
def test_a_law_is_read_back_as_it_was_spelled(law: Bleaching) -> None:
    assert bleaching_of(law.spelled()) == law
