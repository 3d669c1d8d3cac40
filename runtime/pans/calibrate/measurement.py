"""What a calibration shows, counts and says: random binary patterns on a clear field, dark slots, the core that adds up their clicks.

The estimate is calibrate/estimate.py's, the file instrument/calibration_file.py's. Two stages: a
short ladder of drives from far too dim to far too bright, then drives around 1.6 expected photoelectrons, where clicks tell
most of the level per exposure (the information `n lambda^2 / (exp(lambda) - 1)` is greatest at 1.59).

Detectors that are read at once are measured by an automaton whose states come in a fixed order, with or without clicks: each state
shows a pattern to every detector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import PlanError, UsageError
from pans.base.numbers import jeffreys_interval
from pans.bundle.automaton import Automaton
from pans.bundle.sensor import Bundle
from pans.decide import Follower, Output
from pans.decide.plan import Plan, build_plan
from pans.decide.still import DARK_CLICKS, DARK_EXPOSURES, N_TALLIES, WRONG_PATTERNS
from pans.instrument.calibration_file import now_utc
from pans.instrument.click_law import cannot_read_at_once, click_law
from pans.instrument.detector import Afterpulses, afterpulses_of, crosstalk_of, spared_by_neighbours, without_crosstalk
from pans.instrument.profile import Profile
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, ClickBlock, FrameBlock

from .estimate import CountModel, Counts, fit_light, fit_spread

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
LADDER = (0.05, 0.2, 0.8, 3.0, 12.0)  # expected photoelectrons of the first stage, if the profile is right
TELLING = (1.0, 1.6, 2.2)  # of the second, around the most informative
SEQUENTIAL_PATTERNS = 60
PARALLEL_FRAMES = 900
DARK_SHARE = 0.1
BLOCK_US = 5_000.0  # of exposures that are told at once: nothing waits for them
LEAST_SEQUENTIAL_US, LEAST_PARALLEL_US = 40.0, 50.0  # shorter exposures would only load the link
SILENT = 20.0  # clicks; that none of so many comes has the chance 2e-9
PATTERNS_DIFFER = 0.01  # p-value of the test that they do not, below which the level's interval holds their spread
_SIDES = (32, 64, 128, 256, 512)


@dataclass(frozen=True, slots=True)
class Design:
    """Patterns as a bundle that the ordinary session uploads, the plan, and the drive of each pattern (levels, summed over pixels).

    Of detectors that are read at once, pattern k is shown to detector k modulo their number.
    """

    bundle: Bundle
    plan: Plan
    drives: F64
    n_cycles: int


def count_model(profile: Profile, exposure_us: float) -> CountModel:
    """What the profile says of the detector beyond light and dark counts, for this exposure."""
    return CountModel(replace(click_law(profile, exposure_us), dark_per_exposure=0.0))


def calibration_exposure_us(profile: Profile) -> float:
    """The shortest exposure that the profile allows and the link carries: most clicks, and so most knowledge, per second."""
    least = LEAST_PARALLEL_US if profile.mode == "parallel" else LEAST_SEQUENTIAL_US
    return min(max(profile.exposure.min_us, least), profile.exposure.max_us)


def profile_level(profile: Profile, exposure_us: float) -> float:
    """Photoelectrons of one level of one pixel in one exposure, as the profile says."""
    return profile.projector.peak_photoelectrons_hz * exposure_us * 1e-6 / (profile.projector.levels - 1)


def detectors_at_once(profile: Profile) -> int:
    """Return how many detectors of a sequential profile a calibration reads at once: all, or one where that cannot be done.

    It takes detectors that click independently, and a device that follows automata.
    """
    channels = profile.detector.channels
    states = _states_of(channels)
    held = min(profile.projector.automaton_states // states, profile.projector.pattern_memory // (states * channels))
    return 1 if channels == 1 or cannot_read_at_once(profile, channels) or not held else channels


def _states_of(channels: int) -> int:
    return SEQUENTIAL_PATTERNS // channels


def design_run(profile: Profile, targets: Sequence[float], level: float, seconds: float, seed: int) -> Design:
    """Lay out patterns whose expected photoelectrons are `targets` in turn if one level of one pixel gives `level`.

    Every detector that is read at once is shown all of them. PlanError when even one pixel at the lowest level is far too
    bright. `seed` chooses the lit pixels.
    """
    channels = 1
    if profile.mode == "parallel":
        n = profile.detector.channels
    else:
        channels = detectors_at_once(profile)
        n = min(_states_of(channels), profile.projector.pattern_memory)
    drives = np.repeat(np.resize(np.asarray(targets), n) / level, channels)
    levels = _random_patterns(profile, drives, np.random.default_rng(seed))
    side = round(levels.shape[1] ** 0.5)
    return design_of(profile, levels, (side, side), seconds, channels)


def design_of(
    profile: Profile, levels: NDArray[np.uint16], shape: tuple[int, int], seconds: float, channels: int = 1
) -> Design:
    """Lay out the patterns `levels` (n, pixels) of `shape` (rows, columns), dark slots between them, for `seconds` of instrument time.

    With `channels` above 1 so many detectors are read at once, of that many patterns in turn. PlanError when the profile cannot
    show them.
    """
    exposure_us = calibration_exposure_us(profile)
    n = len(levels)
    bundle = Bundle(
        name="calibration", task="calibration", classes=("light",), encoder="active", image_shape=shape,
        levels=profile.projector.levels, pattern_levels=levels, photons_per_level=profile_level(profile, exposure_us),
        head_onnx=None, table=None, golden_means=np.zeros((0, n), np.float32), golden_scores=np.zeros((0, 1), np.float32),
        provenance={}, automaton=None if channels == 1 else _one_after_another(n // channels, channels),
    )  # fmt: skip
    plan = _plan(profile, bundle, n, exposure_us)
    n_cycles = max(1, int(seconds * 1e6 / plan.cycle_us))
    return Design(bundle, plan, levels.sum(axis=1).astype(np.float64), n_cycles)


def _one_after_another(n: int, channels: int) -> Automaton:
    """An automaton of `n` states in a fixed order, with or without clicks: fully lit, each with patterns of its own."""
    following = np.repeat(np.arange(1, n + 1, dtype=np.uint32)[:, None], 1 << channels, axis=1)
    shown, lit = np.arange(n, dtype=np.uint16) * np.uint16(channels), np.ones(n, np.uint16)
    return Automaton(shown, lit, 1, following, np.full((n + 1, 2), 0.5, np.float32))


def _plan(profile: Profile, bundle: Bundle, n: int, exposure_us: float) -> Plan:
    deadline_us = max(4 * BLOCK_US, profile.timing.decision_deadline_us)
    profile = replace(profile, timing=replace(profile.timing, decision_deadline_us=deadline_us))
    if bundle.automaton is not None:
        dark = max(1, round(DARK_SHARE * bundle.automaton.n_slots))
        return build_plan(profile, bundle, dark_slots_per_cycle=dark, drive="device")
    if profile.mode == "parallel":
        dark = max(1, round(DARK_SHARE * PARALLEL_FRAMES))
        return build_plan(profile, bundle, shots_per_object=PARALLEL_FRAMES, dark_slots_per_cycle=dark)
    spacing = exposure_us + profile.exposure.readout_us
    shots = max(1, int(1e6 / profile.projector.pattern_rate_max_hz / spacing))  # as many as fit into one display
    dark = max(1, round(DARK_SHARE * n))
    order = "pattern-major" if shots > 1 else "shot-major"
    return build_plan(profile, bundle, shots_per_object=shots, dark_slots_per_cycle=dark, order=order)


def _random_patterns(profile: Profile, drives: F64, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return uint16 (n, pixels): random pixels, as many as the drive asks for, at the lowest level that needs at most half of
    the panel."""
    panel = min(profile.projector.width_px, profile.projector.height_px)
    sides = [side for side in _SIDES if side <= panel] or [panel]
    top = profile.projector.levels - 1
    side = next((side for side in sides if drives.max() <= top * (side * side // 2)), sides[-1])
    pixels = side * side
    lit_level = min(top, max(1, int(np.ceil(drives.max() / (pixels // 2)))))
    lit = np.clip(np.rint(drives / lit_level), 1, pixels).astype(np.int64)
    if drives.max() < 0.2:
        raise PlanError(
            f"{profile.name}: one pixel at the lowest level gives {1.6 / drives.max():.3g} photoelectrons per exposure, far too many",
            remedy="put a filter before the detector",
        )
    levels = np.zeros((len(drives), pixels), np.uint16)
    for row, count in zip(levels, lit):
        row[rng.permutation(pixels)[:count]] = lit_level
    return levels


def shown_in_slots(plan: Plan) -> I64:
    """Return what each slot of a cycle shows, int64: the number of its pattern, or of the state an automaton is in, or DARK_PATTERN."""
    adaptive = plan.slot_pattern == ADAPTIVE_PATTERN
    return np.where(adaptive, adaptive.cumsum() - 1, plan.slot_pattern.astype(np.int64))


class CalibrationCore(Follower):
    """Adds up clicks by channel, pattern and whether the exposure before clicked; decides nothing."""

    def __init__(self, plan: Plan, n_cycles: int) -> None:
        super().__init__(plan, n_cycles)
        self.parallel, self.channels = plan.mode == "parallel", plan.n_channels
        n_shown = plan.n_patterns // self.channels  # patterns, or states with one for each detector
        self._tallies: I64 = np.zeros(N_TALLIES, np.int64)
        # channel, pattern (the last is dark; in parallel mode 0 is lit), was there a click before, exposures and clicks
        self.sums: I64 = np.zeros((self.channels, n_shown + 1, 2, 2), np.int64)
        self._slot_pattern = shown_in_slots(plan)
        self._before: NDArray[np.uint8] | None = None  # clicks of the exposure before, (channels,), where it is known
        self._next = 0

    @property
    def tallies(self) -> I64:
        """See Follower."""
        return self._tallies

    def cycles_left(self, n_cycles: int) -> int:
        """Return the cycles that were not seen whole."""
        return n_cycles - self.tracker.next_exposure // self._slots_per_cycle

    def _fits(self, block: ClickBlock | FrameBlock) -> bool:
        if isinstance(block, FrameBlock):
            return self.parallel and 8 * block.words.shape[1] >= self.channels
        return not self.parallel and block.largest == self.plan.largest

    def _take(self, block: ClickBlock | FrameBlock, n_exposures: int, end_tick: int) -> Output:
        self._skip_to(block.exposure_index, block.tick)
        self.take_block(block)
        return Output([], [], None)

    def take_block(self, block: ClickBlock | FrameBlock) -> None:
        """Count a block that follows the one before without a gap."""
        n_exposures = len(block.words) if isinstance(block, FrameBlock) else len(block.patterns)
        slots = (block.exposure_index + np.arange(n_exposures)) % self._slots_per_cycle
        planned = self._slot_pattern[slots]
        if isinstance(block, FrameBlock):
            bits = np.unpackbits(block.words, axis=1, bitorder="little", count=self.channels)
            right = np.ones(n_exposures, np.bool_)
        else:
            bits = np.asarray(block.bits)[:, None] >> np.arange(self.channels, dtype=np.uint8) & np.uint8(1)
            right = np.asarray(block.patterns) == planned
        known = right.copy()
        known[0] &= self._before is not None
        first = np.zeros((1, self.channels), np.uint8) if self._before is None else self._before[None, :]
        before = np.concatenate([first, bits[:-1]])
        dark = planned == DARK_PATTERN
        column = np.where(dark, self.sums.shape[1] - 1, 0 if self.parallel else planned)
        for channel in range(self.channels):
            where = (column[known], before[known, channel])
            np.add.at(self.sums[channel, :, :, 0], where, 1)
            np.add.at(self.sums[channel, :, :, 1], where, bits[known, channel])
        self._before, self._next = bits[-1].copy(), block.exposure_index + n_exposures
        self._tallies[DARK_EXPOSURES] += int((dark & right).sum()) * self.channels
        self._tallies[DARK_CLICKS] += int(bits[dark & right].sum())
        self._tallies[WRONG_PATTERNS] += int((~right).sum())

    def _skip_to(self, exposure_index: int, tick: int) -> Output:
        if exposure_index != self._next:
            self._before = None  # what the exposure before did is not known behind a gap
        self._next = exposure_index
        return Output([], [], None)

    def _give_up(self) -> Output:
        self._before, self._next = None, 0
        return Output([], [], None)


def counts_of(core: CalibrationCore, design: Design, profile: Profile) -> list[Counts]:
    """Return each channel's counts, with what the exposure before and the neighbours add to a click's probability."""
    afterpulses, kernel = afterpulses_of(profile, design.plan.exposure_us), crosstalk_of(profile)
    pooled = core.sums.sum(axis=2)  # channel, pattern, (exposures, clicks)
    rate = pooled[..., 1] / np.maximum(pooled[..., 0], 1)
    across = spared_by_neighbours(without_crosstalk(rate.T, kernel), kernel).T  # of each channel and pattern
    result = []
    for channel in range(core.channels):
        own = np.arange(channel, len(design.drives), core.channels)  # what it was shown; in parallel mode one pattern
        drive, pattern = np.append(design.drives[own], 0.0), np.append(own, -1)
        primed = -_memory_of_patterns(afterpulses, rate[channel], design.plan, core.parallel)
        exposures, clicks = (core.sums[channel, :, :, column].ravel() for column in range(2))
        other = (primed + across[channel][:, None]).ravel()
        result.append(Counts(np.repeat(drive, 2), clicks, exposures, other, np.repeat(pattern, 2)))
    if not any(int(counts.exposures.sum()) for counts in result):
        raise UsageError("the device sent no exposures that could be counted")
    return result


def _memory_of_patterns(afterpulses: Afterpulses, rate: F64, plan: Plan, parallel: bool) -> F64:
    """Return the afterpulses that an exposure of each pattern (the last: dark) sees after silence and after a click, (patterns, 2)."""
    dark = len(rate) - 1
    shown = np.where(plan.slot_pattern == DARK_PATTERN, dark, 0 if parallel else shown_in_slots(plan))
    before = afterpulses.sight_by_last(rate[shown])
    sums, counts = np.zeros((len(rate), 2)), np.bincount(shown, minlength=len(rate))
    np.add.at(sums, shown, before)
    return np.asarray(sums / np.maximum(counts, 1)[:, None])


def joined_counts(parts: Sequence[Counts]) -> Counts:
    """All channels' counts as one data set, but for those of silent ones: they tell nothing of the light."""
    silent = silent_channels(parts)
    heard = [part for channel, part in enumerate(parts) if channel not in silent]
    return Counts(*(np.concatenate([getattr(part, name) for part in heard]) for name in Counts._fields))


def silent_channels(parts: Sequence[Counts]) -> list[int]:
    """Return the channels that never clicked in light in which the mean channel would have, `SILENT` times or more; never all."""
    clicks = np.array([part.clicks[part.drive > 0].sum() for part in parts])
    exposures = np.array([part.exposures[part.drive > 0].sum() for part in parts])
    mean = clicks.sum() / max(1, exposures.sum())
    return np.flatnonzero((clicks == 0) & (mean * exposures >= SILENT)).tolist()


def plan_facts(design: Design) -> dict[str, Any]:
    """What a calibration file says about how it was measured."""
    return {
        "patterns": len(design.drives),
        "lit_pixels_mean": float((design.bundle.pattern_levels > 0).sum(axis=1).mean()),
        "exposure_us": design.plan.exposure_us,
        "cycles": design.n_cycles,
        "instrument_seconds": design.n_cycles * design.plan.cycle_us * 1e-6,
    }


def calibration_values(parts: Sequence[Counts], model: CountModel, design: Design, profile: Profile) -> dict[str, Any]:
    """Return what a calibration file says of the counts `parts` (one for each channel), but for device, seed and command."""
    together = joined_counts(parts)
    fit = fit_light(together, model)
    if not 0 < fit.level.value < math.inf:
        raise UsageError(
            f"{'no' if fit.level.value <= 0 else 'every'} exposure with light clicked: nothing bounds the photon level on both sides",
            remedy="check the light path; the brightness may have changed since the first stage",
        )
    spread = fit_spread(together, model, fit.level.value, fit.dark.value)
    uniform = spread.p_value >= PATTERNS_DIFFER or spread.patterns < 3
    scale = (1.0, fit.level.low / fit.level.value, fit.level.high / fit.level.value) if uniform else spread.mean
    level, low, high = (fit.level.value * factor for factor in scale)
    exposure_us = design.plan.exposure_us
    to_peak = (profile.projector.levels - 1) / (exposure_us * 1e-6)
    expected = profile_level(profile, exposure_us)
    channels, silent = [_channel(part, model, level) for part in parts], silent_channels(parts)
    heard = [row for channel, row in enumerate(channels) if channel not in silent]
    dark = sum(row["dark_clicks"] for row in heard), sum(row["dark_exposures"] for row in heard)
    return {
        "made_utc": now_utc().isoformat(timespec="seconds"),
        "profile": {"name": profile.name, "sha256": profile.sha256},
        "exposure_us": exposure_us,
        "photons_per_level": level,
        "photons_per_level_ci": [low, _bound(high)],
        "peak_photoelectrons_hz": level * to_peak,
        "peak_photoelectrons_hz_ci": [low * to_peak, _bound(high * to_peak)],
        "dark_per_exposure": dark[0] / dark[1] if dark[1] else 0.0,
        "dark_ci": list(jeffreys_interval(*dark)),
        "channels": channels,
        "silent_channels": silent,
        "non_uniformity": {
            "relative": spread.relative.value,
            "relative_ci": [spread.relative.low, _bound(spread.relative.high)],
            "p_value": spread.p_value,
            "patterns": spread.patterns,
            "found": not uniform,
        },
        "efficiency": {
            "relative_to_profile": level / expected,
            "relative_ci": [low / expected, _bound(high / expected)],
            "means": "flux x transmission x efficiency over the profile's; clicks cannot tell the three apart",
        },
        "counts": {"exposures": int(together.exposures.sum()), "clicks": int(together.clicks.sum())},
        "design": plan_facts(design),
    }


def _channel(part: Counts, model: CountModel, level: float) -> dict[str, Any]:
    """One channel's dark rate (exposures behind a silent one alone, where afterpulses cannot lie) and light relative to all."""
    plain = (part.drive == 0) & (part.log_other == part.log_other.max())
    clicks, exposures = int(part.clicks[plain].sum()), int(part.exposures[plain].sum())
    lit = int(part.exposures[part.drive > 0].sum())
    own = fit_light(part, model).level if lit else None
    return {
        "dark_per_exposure": clicks / exposures if exposures else 0.0,
        "dark_ci": list(jeffreys_interval(clicks, exposures)),
        "dark_clicks": clicks,
        "dark_exposures": exposures,
        "level_relative": None if own is None or not math.isfinite(own.value) else own.value / level,
        "level_relative_ci": None if own is None else [own.low / level, _bound(own.high / level)],
    }


def _bound(value: float) -> float | None:
    return value if math.isfinite(value) else None
