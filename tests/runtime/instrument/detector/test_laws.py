"""The laws of the detector against single events: unequal light, dark exposures, all effects that a profile may state (fixed seeds)."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from single_events import crosstalk_on, rounds_of

from pans.instrument.click_law import BRIGHT, STATED, law_warnings
from pans.instrument.detector import Afterpulses, afterpulses_of
from pans.instrument.detector.afterpulses import HOLDS_TO
from pans.instrument.detector.crosstalk import fired, seen_from_own, with_crosstalk, without_crosstalk
from pans.instrument.detector.dead_time import NO_DEAD_TIME, DeadTime, counted_mean, unequal_error
from pans.instrument.profile import Profile, load_profile

F64 = np.ndarray
SIGMAS = 5
NONE = Afterpulses(0.0)


@dataclass(frozen=True)
class Setting:
    """Exposures of `light` photoelectrons on one detector; `cycle`: only the last exposures of that length are compared."""

    effect: str
    light: tuple[float, ...]
    afterpulses: Afterpulses = NONE
    dead_time: DeadTime = NO_DEAD_TIME
    cycle: int = 0

    def law(self) -> F64:
        """Chances of a click, then of clicks in both of two neighbouring exposures."""
        chance, memory = np.ones(1), np.zeros((2, 1))
        for mean in counted_mean(self.dead_time, self.light).tolist():
            click = self.afterpulses.chance(-np.expm1(-mean), memory)
            after = [self.afterpulses.after(mean, memory, clicked) for clicked in (0, 1)]
            chance, memory = np.concatenate([chance * (1 - click), chance * click]), np.concatenate(after, axis=1)
        bits = (np.arange(len(chance))[:, None] >> np.arange(len(self.light))) & 1
        return self.compared(bits, chance)

    def counted(self, rounds: int, seed: int) -> F64:
        """The shares of the same in `rounds` rounds of single events."""
        traps, blind = self.afterpulses, self.dead_time
        pause, free_running = (traps.pause, traps.free_running) if traps else (blind.pause, blind.free_running)
        facts = {"dead": blind.dead, "paralysable": blind.paralysable, "pause": pause, "free_running": free_running}
        found = rounds_of(list(self.light), rounds, seed, **facts, afterpulse=traps.probability, tau=traps.time)
        return self.compared(found, np.full(rounds, 1 / rounds))

    def compared(self, clicks: F64, weights: F64) -> F64:
        kept = clicks[:, -self.cycle :] if self.cycle else clicks
        pairs = kept[:, 1:] & kept[:, :-1]
        return np.concatenate([weights @ kept, [] if self.effect == "dead time, equal light" else weights @ pairs])


def levels(rng: np.random.Generator, n: int, brightest: float = BRIGHT) -> tuple[float, ...]:
    """0.01 to `brightest` photoelectrons, evenly in their logarithm; one of four is dark."""
    lit = np.exp(rng.uniform(np.log(0.01), np.log(brightest), n))
    return tuple(np.where(rng.random(n) < 0.25, 0.0, lit).round(4).tolist())


def with_traps() -> list[Setting]:
    """Bright before dark, as automata have it, and levels at random."""
    rng, found = np.random.default_rng(1), []
    for number, tau in enumerate((0.2, 0.5, 1.0, 3.0, 10.0)):
        for p in (0.05, 0.1, 0.2, HOLDS_TO):
            law = Afterpulses(p, tau, (0.0, 0.3, 1.0)[number % 3], number % 2 == 1)
            found += [Setting("afterpulses", light, law) for light in ((20.0, 0.0, 0.0, 0.5, 0.0), levels(rng, 5))]
    return found


def blinded() -> list[Setting]:
    """Alternating and random levels of light, dead time to the longest within the stated range; and equal light at any dead time."""
    rng, found = np.random.default_rng(2), []
    longest = {
        (False, False): (0.0279, 0.166, 0.134),
        (True, False): (0.0279, 0.049, 0.113),
        (False, True): (0.0204, 0.137, 0.116),
        (True, True): (0.0204, 0.039, 0.097),
    }
    for (free, paralysable), deads in longest.items():
        for dead, (pause, bright) in zip(deads, ((0.0, 30.0), (0.1, 8.0), (0.02, 1.0))):
            law = DeadTime(dead, pause, free, paralysable)
            assert 0.0025 < unequal_error(law, bright) <= STATED
            dim = min(1.0, bright / 10)
            found.append(Setting("dead time, unequal light", (bright, dim, bright, 0.0, dim, bright, dim), NONE, law))
            found.append(Setting("dead time, unequal light", levels(rng, 7, bright), NONE, law))
    for dead, pause, mean in ((0.1, 0.0, 3.0), (0.4, 0.1, 8.0), (0.8, 0.2, 1.0), (1.1, 0.2, 2.0)):
        for free in (False, True):
            law = DeadTime(dead, pause, free, free and mean > 2)
            found.append(Setting("dead time, equal light", (mean,) * 14, NONE, law, cycle=4))
    return found


def both() -> list[Setting]:
    """Afterpulses and dead time together, as much as the stated range allows."""
    rng, found = np.random.default_rng(3), []
    for dead, p, tau, bright in (
        (0.01, 0.02, 1.0, 30.0), (0.0015, 0.1, 0.5, 30.0), (0.02, 0.05, 3.0, 5.0), (0.01, 0.1, 0.3, 5.0), (0.03, 0.2, 1.0, 0.7),
        (0.005, 0.3, 2.0, 3.0),
    ):  # fmt: skip
        law = Afterpulses(p, tau, 0.0, False, dead)
        assert max(law.blinded_error(bright), unequal_error(DeadTime(dead), bright)) <= STATED
        for light in ((bright, 0.0, bright / 10, 0.0, bright), levels(rng, 5, bright)):
            found.append(Setting("afterpulses and dead time", light, law, DeadTime(dead)))
    return found


def off(setting: Setting, rounds: int, seed: int) -> tuple[float, float]:
    """By how much the law misses single events at worst, and the standard error of those."""
    law = setting.law()
    wrong = np.abs(setting.counted(rounds, seed) - law)
    worst = int(wrong.argmax())
    return float(wrong[worst]), float(np.sqrt(max(law[worst] * (1 - law[worst]), 1e-6) / rounds))


def few() -> list[Setting]:
    """Some of each for the ordinary suite."""
    return [*with_traps()[3:24:5], *blinded()[:16:7], *both()[:4:3]]


def test_the_laws_hold_for_unequal_light() -> None:
    for number, setting in enumerate(few()):
        wrong, error = off(setting, 60_000, number)
        assert wrong < STATED + SIGMAS * error, setting


def off_without_memory(number: int, rounds: int) -> tuple[str, float, float]:
    """Crosstalk of words, and afterpulses without a time constant: setting `number` of 12."""
    rng = np.random.default_rng(number)
    if number < 8:
        n, kernel = 6, ((0.05,), (0.3, 0.1), (0.01, 0.005, 0.002), (0.1,))[number % 4]
        own = -np.expm1(-np.exp(rng.uniform(np.log(0.01), np.log(30.0), n)))
        clicks = crosstalk_on((rng.random((rounds, n)) < own).astype(np.uint8), list(kernel), number)
        bits = (np.arange(1 << n)[:, None] >> np.arange(n)) & 1
        words = np.prod(np.where(bits, own, 1 - own), axis=1)
        pairs = np.column_stack([bits, bits[:, 1:] & bits[:, :-1], np.eye(1 << n)])
        law = words @ seen_from_own(pairs.astype(np.float64), n, kernel)
        drawn = np.bincount((clicks.astype(np.int64) << np.arange(n)).sum(axis=1), minlength=1 << n) / rounds
        found, effect = drawn @ pairs, "crosstalk"
        assert np.abs(law[:n] - with_crosstalk(own, kernel)).max() < 1e-12
    else:
        p, light = (0.005, 0.1, 0.5, 0.9)[number - 8], (3.0, 0.0, 0.2, 0.0, 20.0, 0.0)
        last, clicks = np.zeros(rounds, np.bool_), []
        for mean in light:
            last = (rng.poisson(mean, rounds) > 0) | (last & (rng.random(rounds) < p))
            clicks.append(last)
        setting = Setting("afterpulses of the next exposure", light, Afterpulses(p))
        found, law = setting.compared(np.array(clicks).T, np.full(rounds, 1 / rounds)), setting.law()
        effect = setting.effect
    wrong = np.abs(found - law)
    worst = int(wrong.argmax())
    return effect, float(wrong[worst]), float(np.sqrt(max(law[worst] * (1 - law[worst]), 1e-6) / rounds))


@pytest.mark.parametrize("number", [0, 1, 10])
def test_laws_of_one_exposure_are_exact(number: int) -> None:
    _, wrong, error = off_without_memory(number, 60_000)
    assert wrong < SIGMAS * error


@pytest.mark.slow
def test_the_worst_of_all_settings() -> None:
    """The ranges of docs/explanation/detector.md."""
    rows = [(one.effect, *off(one, 2_000_000, at), one) for at, one in enumerate([*with_traps(), *blinded(), *both()])]
    rows += [(*off_without_memory(number, 2_000_000), number) for number in range(12)]
    assert len(rows) >= 94
    for effect in dict.fromkeys(row[0] for row in rows):
        of_effect = [row for row in rows if row[0] == effect]
        worst = max(of_effect, key=lambda row: row[1])
        print(f"{effect}: {len(of_effect)} settings, worst {worst[1]:.4f} (error {worst[2]:.4f}) at {worst[3]}")
    assert all(wrong < STATED + SIGMAS * error for _, wrong, error, _ in rows)


def test_crosstalk_is_taken_back_and_drawn() -> None:
    own, kernel = np.random.default_rng(0).random((3, 5)) * 0.8, (0.3, 0.1)
    seen = with_crosstalk(own, kernel)
    assert (seen > own).all()
    assert without_crosstalk(seen, kernel) == pytest.approx(own, abs=1e-12)
    rng = np.random.default_rng(1)
    drawn = fired(rng.random((100_000, 3, 5)) < own, kernel, rng).mean(axis=0)
    assert np.abs(drawn - seen).max() < SIGMAS * 0.5 / np.sqrt(100_000)
    assert np.array_equal(with_crosstalk(own, ()), own)


def changed(name: str, **facts: object) -> Profile:
    profile = load_profile(name)
    return replace(profile, detector=replace(profile.detector, **facts))


def test_what_leaves_the_stated_range_is_warned_of() -> None:
    free = changed("microled-spad", between_exposures="free-running")
    assert not law_warnings(free, 2.3, 8.0)  # 35 ns in 2.3 us
    (blind,) = law_warnings(replace(free, detector=replace(free.detector, dead_time_ns=230.0)), 2.3, 8.0)
    assert "dead_time_ns reaches 0.1 of an exposure" in blind
    assert "off by up to 0.0092" in blind
    (strong,) = law_warnings(changed("dmd-spad", afterpulse_probability=0.5, afterpulse_time_us=50.0), 50.0)
    assert "hold to 0.003 up to 0.3" in strong
    (together,) = law_warnings(
        changed("dmd-spad", afterpulse_probability=0.3, afterpulse_time_us=50.0, dead_time_ns=500.0), 50.0
    )
    assert "dead_time_ns and afterpulses" in together
    neighbours = changed("wdm-snspd", crosstalk_probability=0.05)
    assert not law_warnings(neighbours, 5.0)
    assert "crosstalk of 0.05" in law_warnings(neighbours, 5.0, one_by_one=True)[0]
    (parallel,) = law_warnings(changed("wdm-snspd", afterpulse_probability=0.02), 5.0)
    assert "left out of parallel exposures" in parallel


def test_no_shipped_profile_leaves_the_stated_range() -> None:
    from pans.instrument.profile import shipped_profiles

    for profile in map(load_profile, shipped_profiles()):
        assert law_warnings(profile, profile.exposure.min_us, one_by_one=True) == []


def test_a_profile_gives_its_dead_time_to_the_afterpulses() -> None:
    profile = changed("dmd-spad", afterpulse_time_us=50.0, dead_time_ns=500.0)
    assert afterpulses_of(profile, 50.0).dead == pytest.approx(0.01)


@pytest.mark.parametrize("wrong", [(0.7, 1.0), (-0.1, 0.0), (0.1, float("inf")), (0.1, 1.0, -1.0)])
def test_what_no_traps_do_is_refused(wrong: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="allowed"):
        Afterpulses(*wrong)
