"""The estimate of where a target stands: its model against a rendering of its own, its slopes, and truths that it must find."""

from dataclasses import replace

import numpy as np
import pytest
from naive_imaging import rendered
from numpy.typing import NDArray

from pans.base.errors import UsageError
from pans.calibrate.registration.estimate import Estimate, Library, Observed, estimate
from pans.calibrate.registration.measure import bench_of, check_estimate, check_saturation, scattered, telling
from pans.calibrate.registration.parameters import (
    DARK,
    PARAMETERS,
    WORTHS,
    Bench,
    flat_basis,
    information_per_exposure,
    vector_of,
)
from pans.calibrate.registration.target import built_in_target, target_sha256
from pans.instrument.optics import Imaging
from pans.instrument.profile import load_profile

PROFILE = load_profile("dmd-spad")
DARK_MEAN = 0.004
F64 = NDArray[np.float64]


def field(coefficients: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a flat field (rows, columns) of mean 1 with slopes and curvatures across the grid."""
    y, x = (np.linspace(-1, 1, size) for size in shape)
    across, down = np.meshgrid(x, y)
    terms = [across, down, 1.5 * across**2, across * down, 1.5 * down**2]
    bent = sum(c * term for c, term in zip(coefficients, terms))
    return np.asarray(1 + bent - np.mean(bent))


@pytest.fixture(scope="module")
def bench() -> Bench:
    return bench_of(PROFILE, built_in_target())


@pytest.fixture(scope="module")
def library(bench: Bench) -> Library:
    return Library(bench, np.arange(-3.0, 4.0, 1.5))  # coarser than the command's, as tests must be quick


def counted(
    bench: Bench, truth: Imaging, patterns: F64, exposures: int, seed: int, coefficients: F64 | None = None
) -> Observed:
    """Draw clicks of `exposures` of each pattern, and of a tenth as many dark ones, from a rendering of the target."""
    met = rendered(truth, bench.target.reshape(bench.shape))
    met = met if coefficients is None else met * field(coefficients, bench.shape)
    scale = truth.gain * bench.photons_per_level
    lit = scale * (truth.black * (bench.levels - 1) * met.sum() + (1 - truth.black) * (patterns @ met.reshape(-1)))
    means = np.append(lit, 0.0) + DARK_MEAN
    n = np.append(np.full(len(patterns), exposures), max(1, exposures * len(patterns) // 10))
    clicks = np.random.default_rng(seed).binomial(n, 1 - np.exp(-means))
    return Observed(patterns, np.append(np.arange(len(patterns)), -1), clicks, n, np.zeros(len(n)))


def test_slopes_are_those_of_the_means(bench: Bench, library: Library) -> None:
    vector = vector_of(
        Imaging(right_px=0.4, down_px=-0.6, rotation_deg=1.1, scale=1.01, psf_px=0.6, black=0.003, gain=1.2),
        (0.03, -0.02, 0.01, 0.02, -0.04),
        DARK_MEAN,
    )
    patterns = scattered(bench, library, 5, 24).astype(np.float64)
    _, slopes = bench.slopes(vector, patterns)
    steps = np.append(1e-3 * WORTHS, 1e-5)
    for index, step in enumerate(steps):
        ahead, behind = vector.copy(), vector.copy()
        ahead[index] += step
        behind[index] -= step
        by_hand = (bench.means(ahead, patterns) - bench.means(behind, patterns)) / (2 * step)
        np.testing.assert_allclose(slopes[:, index], by_hand, rtol=1e-4, atol=1e-6 * np.abs(by_hand).max())


def test_a_truth_is_found_in_two_stages_to_its_own_precision(bench: Bench, library: Library) -> None:
    truth = Imaging(right_px=1.7, down_px=-1.9, rotation_deg=2.8, scale=0.975, psf_px=0.8, black=0.004, gain=0.8)
    coefficients = np.array([0.04, -0.03, 0.02, 0.01, -0.05])
    first = counted(bench, truth, scattered(bench, library, 1).astype(np.float64), 250, 2, coefficients)
    known = estimate(bench, first, library)
    second = telling(bench, known, 3, 1000).astype(np.float64)
    found = estimate(bench, first.joined(counted(bench, truth, second, 1000, 4, coefficients)), start=known.values)
    wanted = vector_of(truth, coefficients, DARK_MEAN)
    off = (found.values - wanted) / found.errors
    assert np.abs(off).max() < 4.5  # of 13 normal variables: one in 10 000 tables
    assert found.errors[:3].max() < 0.05
    assert found.p_value > 1e-3
    assert found.errors[2] < known.errors[2] / 4


def test_the_flat_field_is_written_down_as_it_is_fitted() -> None:
    coefficients = np.array([0.04, -0.03, 0.02, 0.01, -0.05])
    np.testing.assert_allclose(
        1 + coefficients @ flat_basis((28, 20)), field(coefficients, (28, 20)).reshape(-1), atol=1e-12
    )


def errors_of_a_click(bench: Bench, vector: F64, patterns: F64) -> F64:
    """Standard errors of shift and rotation after one click, in light that gives one photoelectron per exposure."""
    light = bench.means(vector, patterns).mean() - vector[DARK]
    dimmed = replace(bench, photons_per_level=bench.photons_per_level / light)
    chance, told = information_per_exposure(dimmed, vector, patterns)
    information = told.T @ told / chance.sum()
    scale = np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information / np.outer(scale, scale) + 1e-13 * np.eye(len(scale)))
    return (np.sqrt(np.diag(inverse)) / scale)[:3]


def test_telling_patterns_need_far_fewer_clicks_than_others(bench: Bench, library: Library) -> None:
    vector = vector_of(Imaging(right_px=0.7, down_px=-0.6, rotation_deg=1.5, psf_px=0.7, black=0.005), dark=DARK_MEAN)
    errors = {}
    rough = Estimate(vector, np.diag(np.append(WORTHS * 2, 1e-3) ** 2), 0.0, 0.0, 1, 1, 1)
    half = np.random.default_rng(0).integers(0, 2, (300, 784)).astype(np.float64)
    for name, patterns in {
        "telling": telling(bench, rough, 1, 1000).astype(np.float64),
        "scattered": scattered(bench, library, 1).astype(np.float64),
        "half of all pixels": half,
    }.items():
        errors[name] = errors_of_a_click(bench, vector, patterns)
    assert (5 * errors["telling"] < errors["half of all pixels"]).all()
    assert (2 * errors["telling"] < errors["scattered"]).all()


def good(**changes: float) -> Estimate:
    """An estimate that a run would accept, with `changes`."""
    values = vector_of(Imaging(psf_px=0.7), dark=DARK_MEAN)
    return replace(Estimate(values, np.diag(np.full(DARK + 1, 1e-2) ** 2), 0.0, 100.0, 100, 10_000, 20_000), **changes)  # type: ignore[arg-type]


def test_too_few_photons_say_how_many_more_seconds() -> None:
    check_estimate(good(), 10.0)
    with pytest.raises(UsageError, match=r"too few photons: right_px is known to ±0\.196") as error:
        check_estimate(good(covariance=np.diag(np.full(DARK + 1, 0.1) ** 2)), 10.0, (0.05, 10.0))
    assert "--seconds 169: 159 s more" in error.value.remedy  # (0.196 / 0.05)^2 times 10 s, and a tenth more


def test_an_estimate_at_the_edge_of_the_search_is_refused() -> None:
    values = good().values.copy()
    values[1] = 3.0
    with pytest.raises(UsageError, match=r"edge of the search: down_px 3, looked for from -3 to 3"):
        check_estimate(good(values=values), 10.0)


def test_another_target_does_not_explain_the_counts(bench: Bench, library: Library) -> None:
    other = replace(bench, target=bench.target.reshape(bench.shape)[::-1].reshape(-1))
    patterns = scattered(bench, library, 1).astype(np.float64)
    found = estimate(bench, counted(other, Imaging(psf_px=0.5), patterns, 300, 1), library)
    with pytest.raises(UsageError, match=r"edge of the search|does not explain the counts"):
        check_estimate(found, 10.0, (10.0, 10.0))
    assert found.p_value < 1e-6


@pytest.mark.parametrize(("clicks", "words"), [(990, "saturates: 990 of 1000"), (0, "none of 1000 exposures")])
def test_a_detector_that_tells_nothing_is_refused(clicks: int, words: str) -> None:
    one, lit = np.ones(1, np.int64), np.zeros(1, np.int64)
    with pytest.raises(UsageError, match=words):
        check_saturation(Observed(np.ones((1, 4)), lit, clicks * one, 1000 * one, np.zeros(1)))


def test_the_targets_identity_is_its_pixels_and_shape() -> None:
    target = built_in_target()
    assert target.shape == (28, 28)
    assert target_sha256(target) != target_sha256(target.reshape(14, 56))
    assert len(PARAMETERS) == DARK
