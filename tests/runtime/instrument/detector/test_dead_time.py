"""Dead time: the law against a detector simulated photon by photon, its table, and the same numbers in torch (fixed seeds)."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from naive_dead_time import share_of_clicks

from pans.calibrate.estimate import CountModel, Counts, fit_light
from pans.instrument.click_law import ClickLaw, both_chances, click_law, click_probability, dead_time_of
from pans.instrument.detector import dead_time as law_module
from pans.instrument.detector.dead_time import DeadTime, counted_mean
from pans.instrument.profile import load_profile

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")

MEANS = (0.2, 1.0, 3.0, 8.0, 20.0)
KINDS = tuple(itertools.product((False, True), repeat=2))  # free-running, paralysable
WORST = 0.002


def settings() -> list[tuple[DeadTime, float]]:
    """Contiguous exposures and pauses of a third and four fifths of the dead time, every kind, dim to bright."""
    found = []
    for dead, part, (free, paralysable) in itertools.product(
        (0.02, 0.1, 0.3, 0.5, 0.8, 1.0, 1.2), (0, 0.3, 0.8), KINDS
    ):
        fits = dead <= 1 + part * dead and (part > 0 or not free)
        found += [(DeadTime(dead, part * dead, free, paralysable), mean) for mean in MEANS if fits]
    return found


def off(dead_time: DeadTime, mean: float, exposures: int, seed: int) -> tuple[float, float]:
    """By how much the law misses the simulated share, and the standard error of that share."""
    kind = (dead_time.dead, dead_time.pause, dead_time.free_running, dead_time.paralysable)
    share, error = share_of_clicks(mean, *kind, exposures, seed)
    return abs(float(click_probability(ClickLaw(dead_time=dead_time), mean)) - share), error


def test_the_law_against_every_photon() -> None:
    telling = [(DeadTime(1.0, 0.25), 4.0), (DeadTime(0.9, 0.225), 3.0)]  # a density w that is far from even
    for number, (dead_time, mean) in enumerate([*telling, *settings()[::22]]):
        found, error = off(dead_time, mean, 1_000_000, number)
        assert error < 0.0006
        assert found < WORST, (dead_time, mean)


@pytest.mark.slow
def test_the_law_against_every_photon_on_the_whole_grid() -> None:
    grid = settings()
    assert len(grid) >= 200
    found = [off(*one, 4_000_000, number) for number, one in enumerate(grid)]
    assert max(error for _, error in found) < 0.0004
    assert max(wrong for wrong, _ in found) < WORST


@pytest.mark.parametrize(
    "dead_time",
    [DeadTime(0.0, 0.4, True, True), DeadTime(0.3, 0.3), DeadTime(0.3, 0.5, False, True), ClickLaw().dead_time],
)
def test_a_pause_that_outlasts_it_leaves_nothing(dead_time: DeadTime) -> None:
    mean = np.array([0.0, 0.5, 1e7])
    assert np.array_equal(counted_mean(dead_time, mean), mean)


@pytest.mark.parametrize("dead_time", [DeadTime(0.6), DeadTime(0.6, 0.2, True, True)])
def test_a_calibration_finds_the_light_of_a_blinded_detector(dead_time: DeadTime) -> None:
    kind = (dead_time.dead, dead_time.pause, dead_time.free_running, dead_time.paralysable)
    n, drive = 200_000, np.array([0.4, 0.8, 1.2])
    clicks = [round(n * share_of_clicks(mean, *kind, n, 11 + at)[0]) for at, mean in enumerate(drive.tolist())]
    dark = np.append(clicks, 0), np.full(4, n, np.int64), np.zeros(4), np.arange(4)
    counts = Counts(np.append(drive, 0.0), *dark)
    found, unaware = (fit_light(counts, CountModel(ClickLaw(dead_time=one))).level for one in (dead_time, DeadTime()))
    assert found.low - 0.005 < 1.0 < found.high + 0.005
    assert abs(found.value - 1.0) < 0.01 < 0.04 < abs(unaware.value - 1.0)


CASES = (
    *(DeadTime(0.5, 0.0, False, kind) for kind in (False, True)),
    DeadTime(0.02, 0.01),
    DeadTime(0.9, 0.2),
    DeadTime(1.1, 0.2, True),
    DeadTime(1.1, 0.2, True, True),
    DeadTime(0.004, 0.0, False, True),
)


@pytest.mark.parametrize("dead_time", CASES)
def test_the_table_is_fine_enough(dead_time: DeadTime) -> None:
    mean = np.exp(np.random.default_rng(1).uniform(-6, 4, 40))
    mean.sort()
    exact = (law_module._paralysable if dead_time.paralysable else law_module._non_paralysable)(dead_time, mean)
    silent = np.exp(-counted_mean(dead_time, mean))
    np.testing.assert_allclose(silent, np.exp(-exact), atol=2e-5)
    np.testing.assert_allclose(-np.expm1(-exact[:8]), 1 - silent[:8], rtol=1e-4)


def exact_silence(mean: float, dead: float, reach: float) -> mpmath.mpf:
    """P0 of a paralysable detector: the module's integral over u, of the alternating series with 60 digits."""
    with mpmath.workdps(60):
        m, f, r = mpmath.mpf(mean), mpmath.mpf(dead), mpmath.mpf(reach)

        def undetected(until: mpmath.mpf) -> mpmath.mpf:
            rests = itertools.takewhile(lambda rest: rest > 0, (until - k * f for k in itertools.count()))
            return mpmath.fsum(
                (-m * mpmath.exp(-m * f) * rest) ** k / mpmath.factorial(k) for k, rest in enumerate(rests)
            )

        integral = mpmath.quad(lambda u: m * (mpmath.exp(-m * u) - mpmath.exp(-m * r)) * undetected(1 - u), [0, r])
        return mpmath.exp(-m) + integral


@pytest.mark.parametrize(
    ("flux", "dead", "within"),
    [
        (1.0, 0.02, 1e-9),
        (8.0, 0.02, 1e-9),
        (11.5, 0.02, 1e-5),
        (17.9, 0.02, 0.03),
        (18.1, 0.02, 0.03),
        (34.0, 0.01, 0.03),
    ],
)
def test_a_paralysed_silence_at_both_sides_of_where_its_series_cancels(flux: float, dead: float, within: float) -> None:
    with mpmath.workdps(30):
        mean = float(mpmath.findroot(lambda m: m * mpmath.exp(-m * dead) - flux, flux * 1.3))
        wanted = float(-mpmath.log(exact_silence(mean, dead, dead / 2)))
    (found,) = law_module._paralysable(DeadTime(dead, dead / 2, False, True), np.array([mean])).tolist()
    assert found == pytest.approx(wanted, rel=within)


def test_more_light_clicks_more_unless_it_paralyses() -> None:
    mean = np.geomspace(1e-3, law_module.LARGEST_MEAN, 400)
    for dead_time in CASES:
        p = click_probability(ClickLaw(dead_time=dead_time), mean)
        assert (np.diff(p) >= -1e-5).all() or dead_time.paralysable
        assert (p <= click_probability(ClickLaw(), mean) + 1e-12).all()
    assert p[-1] < 1e-6  # the last of them is paralysed


def test_light_beyond_the_most_clicks_is_taken_as_that_light() -> None:
    paralysed = DeadTime(1.1, 0.2, True, True)  # clicks in mean exp(-1.1 mean) of all exposures, at most at 1/1.1
    assert law_module.mean_of_most_clicks(paralysed) == pytest.approx(1 / 1.1, rel=0.01)
    assert law_module.mean_of_most_clicks(replace(paralysed, paralysable=False)) == np.inf
    model = CountModel(ClickLaw(dead_time=paralysed))
    miss = model.log_miss(np.array([0.5, 0.91, 3.0, 100.0]))
    assert miss[0] > miss[1]
    assert np.exp(miss[1:]) == pytest.approx(1 - np.exp(-1) / 1.1, abs=1e-4)
    assert model.log_miss_slope(np.array([3.0]))[0] == 0.0


def test_both_chances_agree() -> None:
    law = ClickLaw(0.01, dead_time=DeadTime(0.5))
    mean = np.array([0.0, 1e-6, 0.7, 30.0])
    click, miss = both_chances(law, mean)
    np.testing.assert_allclose(click + miss, 1.0)
    np.testing.assert_allclose(click, click_probability(law, mean))


@pytest.mark.parametrize("wrong", [{"dead": -0.1}, {"dead": 1.1}, {"pause": -1.0}, {"pause": np.inf}, {"dead": np.nan}])
def test_what_no_detector_has_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="found"):
        DeadTime(**wrong)


def test_a_profile_says_what_its_detector_does() -> None:
    led = load_profile("microled-spad")  # 35 ns, and half a microsecond of readout
    assert click_law(led, 2.3).dead_time == DeadTime()
    free = replace(led, detector=replace(led.detector, between_exposures="free-running", dead_time_kind="paralysable"))
    readout = led.exposure.readout_us / 2.3
    found = click_law(free, 2.3).dead_time
    assert (found.dead, found.pause) == pytest.approx((0.035 / 2.3, readout))
    assert found.free_running
    assert found.paralysable
    longest = replace(free, detector=replace(free.detector, dead_time_ns=1000 * (2.3 + led.exposure.readout_us)))
    assert click_law(longest, 2.2999).dead_time.dead == pytest.approx(1 + led.exposure.readout_us / 2.2999)
    assert click_law(load_profile("dmd-spad"), 50.0).dead_time == DeadTime()  # 24 ns: below a permille


@pytest.mark.parametrize(("share", "counts"), [(0.9e-3, False), (1.1e-3, True), (0.4, True)])
def test_dead_time_counts_from_a_permille_on_and_where_it_outlasts_the_pause(share: float, counts: bool) -> None:
    led = load_profile("microled-spad")
    detector = replace(led.detector, dead_time_ns=share * 1e5, between_exposures="free-running")
    free = replace(led, detector=detector, exposure=replace(led.exposure, readout_us=10.0))
    found = dead_time_of(free, 100.0)
    assert (found.dead, found.pause) == (pytest.approx((share, 0.1)) if counts else (0.0, 0.0))
    assert found.free_running == counts
    gated = dead_time_of(replace(free, detector=replace(detector, between_exposures="gated")), 100.0)
    assert gated.reach == pytest.approx(max(0.0, share - 0.1))


def test_torch_has_the_same_numbers_and_their_derivative() -> None:
    torch = pytest.importorskip("torch")
    from pans_trainer.model import detection
    from pans_trainer.train.automaton.outcomes import no_click

    for dead_time in CASES:
        law = ClickLaw(0.02, dead_time=dead_time)
        light = torch.tensor([0.0, 0.1, 1.0, 7.0, 60.0], dtype=torch.float64, requires_grad=True)
        p = detection.click_probability(light, law)
        np.testing.assert_allclose(p.detach(), click_probability(law, light.detach().numpy()), rtol=1e-9)
        p.sum().backward()
        silent, fall = no_click(light.detach(), law)
        np.testing.assert_allclose(silent, 1 - p.detach(), atol=1e-12)
        np.testing.assert_allclose(fall, light.grad, atol=1e-12)
