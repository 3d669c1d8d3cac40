"""The spelling of --optics, and draws within a tolerance."""

import numpy as np
import pytest

from pans.runtime.imaging import Tolerance, imaging_of, is_spec, tolerance_of


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
