"""Plan: what is exposed when, in device ticks, and whether this hardware can do it at all.

Owns the order and times of the exposures of one cycle and the refusal of what the profile cannot do, with the numbers; never talks
to a device. `build_plan` returns a `Plan` or raises PlanError. A plan repeats one *cycle* of slots, one exposure each:

- **shot-major** (sequential): every pattern once, one exposure each; a cycle is one shot, an object takes `shots_per_object` cycles.
- **pattern-major** (sequential, the paper's protocol): every pattern is displayed once and exposed `shots_per_object` times in a
  row, within a whole number of refresh periods of the projector; a cycle is one object.
- **parallel**: all patterns shine at once, a slot exposes all channels (its pattern index is 0); a cycle is one object, its
  frames are the shots. For objects that pass by, flow/plan.py lays out frames without end.

Dark displays stand before the patterns, spread evenly; a cycle ends with light, so that no decision waits for a dark exposure.
The device ends a block at the end of a cycle and where the spacing changes: the last block there may be a shorter one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import PlanError, UsageError
from pans.runtime.instrument.profile import Profile
from pans.runtime.wire.messages import DARK_PATTERN as DARK_PATTERN

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle

NO_SHOT = 0xFFFF  # shot number of a dark slot
ORDERS = ("auto", "pattern-major", "shot-major")
MAX_SLOTS = 1 << 20  # of one cycle; more would be 16 MB of plan on the wire
MAX_BLOCK_EXPOSURES = 1024  # keeps a click block near 2 kB
MAX_BLOCK_BYTES = 16384  # and a block of wide frames far below the longest message
_MAX_SHOTS = 0xFFFE
_U32 = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """One cycle of exposures; arrays are read-only, in order of time, one element per slot."""

    mode: str
    n_patterns: int
    slot_offset_ticks: NDArray[np.int64]  # start of the exposure within the cycle
    slot_pattern: NDArray[np.uint16]  # DARK_PATTERN in a dark slot, 0 in parallel mode
    slot_shot: NDArray[np.uint16]  # the shot of the cycle that the exposure belongs to; NO_SHOT in a dark slot
    exposure_ticks: int
    slot_period_ticks: int  # distance of exposures inside a block
    cycle_ticks: int
    shots_per_cycle: int
    cycles_per_object: int
    block_exposures: int  # most exposures of one click block
    exposure_us: float  # of the exposure in whole ticks

    @property
    def slots_per_cycle(self) -> int:
        """Exposures of one cycle, dark ones too."""
        return len(self.slot_pattern)

    @property
    def dark_slots_per_cycle(self) -> int:
        """Dark exposures of one cycle."""
        return int(np.count_nonzero(self.slot_pattern == DARK_PATTERN))

    @property
    def shots_per_object(self) -> int:
        """How often each pattern is exposed on one object: the K of a decision."""
        return self.shots_per_cycle * self.cycles_per_object

    @property
    def tick_us(self) -> float:
        """Length of one device tick in microseconds."""
        return self.exposure_us / self.exposure_ticks

    @property
    def cycle_us(self) -> float:
        """Length of one cycle in microseconds."""
        return self.cycle_ticks * self.tick_us

    @property
    def object_ticks(self) -> int:
        """Time for one object in ticks."""
        return self.cycle_ticks * self.cycles_per_object

    @property
    def objects_hz(self) -> float:
        """Objects, and so decisions, per second."""
        return 1e6 / (self.object_ticks * self.tick_us)

    @property
    def block_bytes(self) -> int:
        """Length of the longest click block's payload, about: clicks and pattern numbers, or words."""
        if self.mode == "parallel":
            return self.block_exposures * -(-self.n_patterns // 8)
        return self.block_exposures * 17 // 8


@dataclass(frozen=True, slots=True)
class Ticks:
    """The times that all orders share, in whole ticks."""

    exposure: int
    spacing: int  # exposure and readout: the least distance of two exposures
    refresh: float  # one refresh period of the projector, not rounded
    block: float  # longest block: a quarter of the decision deadline


def build_plan(
    profile: Profile,
    bundle: Bundle,
    *,
    shots_per_object: int = 1,
    dark_slots_per_cycle: int = 1,
    order: str = "auto",
) -> Plan:
    """Lay out the exposures that measure `bundle`'s patterns `shots_per_object` times per object on `profile`'s hardware.

    `dark_slots_per_cycle` counts displays of the dark pattern (in pattern-major order each holds `shots_per_object` exposures).
    `order` is for sequential profiles; "auto" takes the one with the shorter time per object, shot-major if they are equal.
    Raises PlanError with the numbers if the hardware cannot do it, UsageError if `order` is none.
    """
    if order not in ORDERS:
        raise UsageError(f"order must be one of {', '.join(ORDERS)}, found {order!r}")
    _check_counts(shots_per_object, dark_slots_per_cycle)
    check_fit(profile, bundle)
    ticks = ticks_of(profile, exposure_us(profile, bundle))
    if profile.mode == "parallel":
        if order != "auto":
            raise PlanError(f"order must be auto in parallel mode, found {order}", remedy="leave --order out")
        return _parallel(profile, bundle.n_features, shots_per_object, dark_slots_per_cycle, ticks)
    makers = {"shot-major": _shot_major, "pattern-major": _pattern_major}
    if order != "auto":
        return makers[order](profile, bundle.n_features, shots_per_object, dark_slots_per_cycle, ticks)
    plan = _shot_major(profile, bundle.n_features, shots_per_object, dark_slots_per_cycle, ticks)
    displays = bundle.n_features + dark_slots_per_cycle
    if displays * shots_per_object > MAX_SLOTS or displays * _hold(shots_per_object, ticks) >= plan.object_ticks:
        return plan
    return _pattern_major(profile, bundle.n_features, shots_per_object, dark_slots_per_cycle, ticks)


def exposure_us(profile: Profile, bundle: Bundle) -> float:
    """The exposure in microseconds at which the top level gives as many photoelectrons as `bundle` expects.

    Raises PlanError, with the factor by which the light is too weak or too bright, if the profile does not allow it.
    """
    if bundle.analyser is not None:
        return _passive_exposure_us(profile, bundle.analyser.exposure_us)
    top = bundle.photons_per_level * (bundle.levels - 1)
    if not 0 < top < math.inf:
        raise PlanError(f"photons_per_level must be finite and above 0, found {bundle.photons_per_level!r}")
    peak_hz = profile.projector.peak_photoelectrons_hz
    needed_us = top / peak_hz * 1e6
    low, high = profile.exposure.min_us, profile.exposure.max_us
    said = (
        f"{profile.name}: the brightest pixel needs {top:.4g} photoelectrons per exposure; at "
        f"projector.peak_photoelectrons_hz = {peak_hz:.6g} that takes {needed_us:.6g} us, allowed are {low:g} to {high:g} us"
    )
    if needed_us > high * (1 + 1e-9):
        raise PlanError(
            f"{said}: the light is too weak by a factor of {needed_us / high:.4g}",
            remedy=f"make it brighter, to at least {top / high * 1e6:.4g} photoelectrons/s, and calibrate; or train for less light",
        )
    if needed_us < low * (1 - 1e-9):
        raise PlanError(
            f"{said}: the light is too bright by a factor of {low / needed_us:.4g}",
            remedy=f"put a filter of optical density {math.log10(low / needed_us):.2f} or a little more before the detector "
            f"(at most {top / low * 1e6:.4g} photoelectrons/s), and calibrate",
        )
    return needed_us


def _passive_exposure_us(profile: Profile, wanted_us: float) -> float:
    """A passive sensor was trained for one exposure: another would bring other light and other dark counts."""
    low, high = profile.exposure.min_us, profile.exposure.max_us
    if not low * (1 - 1e-9) <= wanted_us <= high * (1 + 1e-9):
        raise PlanError(
            f"the bundle's passive optics were trained for {wanted_us:g} us, {profile.name} exposes {low:g} to {high:g} us",
            remedy=f"retrain: pans train --profile {profile.name}",
        )
    return wanted_us


def _check_counts(shots: int, dark: int) -> None:
    if not 1 <= shots <= _MAX_SHOTS:
        raise PlanError(f"shots per object must be from 1 to {_MAX_SHOTS}, found {shots}")
    if not 0 <= dark <= _MAX_SHOTS:
        raise PlanError(f"dark slots per cycle must be from 0 to {_MAX_SHOTS}, found {dark}")


def check_fit(profile: Profile, bundle: Bundle) -> None:
    if bundle.analyser is None:
        _check_projector(profile, bundle)
    if profile.mode == "parallel" and bundle.n_features > profile.detector.channels:
        raise PlanError(
            f"the bundle has {bundle.n_features} patterns, {profile.name} has {profile.detector.channels} detector channels, "
            "one per pattern",
            remedy=f"pans train --features {profile.detector.channels}, or fewer",
        )


def _check_projector(profile: Profile, bundle: Bundle) -> None:
    projector, retrain = profile.projector, f"retrain or requantise: pans train --profile {profile.name}"
    if bundle.levels != projector.levels:
        raise PlanError(
            f"the bundle's patterns have {bundle.levels} levels, the projector of {profile.name} has {projector.levels}",
            remedy=retrain,
        )
    height, width = bundle.image_shape
    if height > projector.height_px or width > projector.width_px:
        raise PlanError(
            f"the patterns are {width} x {height} pixels (width x height), the panel of {profile.name} has "
            f"{projector.width_px} x {projector.height_px}",
            remedy="train with smaller images, or use a projector with more pixels",
        )
    if height * width != bundle.n_pixels:
        raise PlanError(
            f"the patterns have {bundle.n_pixels} pixels, the image shape {height} x {width} says {height * width}"
        )
    if bundle.n_features > projector.pattern_memory:
        raise PlanError(
            f"the bundle has {bundle.n_features} patterns, the pattern memory of {profile.name} holds {projector.pattern_memory}",
            remedy=f"pans train --features {projector.pattern_memory}, or fewer",
        )


def ticks_of(profile: Profile, exposure: float) -> Ticks:
    """Return the times of a plan with exposures of `exposure` us in whole ticks; PlanError beyond what the protocol counts."""
    per_us = profile.clock.tick_hz / 1e6
    exposure_ticks = max(1, round(exposure * per_us))
    spacing = exposure_ticks + _up(profile.exposure.readout_us * per_us)
    refresh = profile.clock.tick_hz / profile.projector.pattern_rate_max_hz
    if max(spacing, refresh) > _U32:
        longest_s = _U32 / profile.clock.tick_hz
        raise PlanError(
            f"exposure and readout, or one refresh period, take {max(spacing, refresh):.4g} ticks of {profile.name}'s clock; "
            f"the protocol counts up to {_U32} ({longest_s:.4g} s)",
            remedy="use a slower clock.tick_hz or a shorter exposure",
        )
    return Ticks(exposure_ticks, spacing, refresh, profile.timing.decision_deadline_us * per_us / 4)


def _up(ticks: float) -> int:
    """Round up to whole ticks, forgiving the last digits of a float."""
    return math.ceil(ticks * (1 - 1e-12))


def _hold(shots: int, ticks: Ticks) -> int:
    """How long one display lasts in pattern-major order: enough whole refresh periods for all its exposures."""
    periods = max(1, _up(shots * ticks.spacing / ticks.refresh))
    return max(shots * ticks.spacing, _up(periods * ticks.refresh))


def _shot_major(profile: Profile, n: int, shots: int, dark: int, ticks: Ticks) -> Plan:
    patterns = _interleave(np.arange(n), dark)
    period = max(ticks.spacing, _up(ticks.refresh))
    cycle = Cycle(
        patterns,
        np.zeros(len(patterns), np.int64),
        offsets=np.arange(len(patterns)) * period,
        cycle_ticks=len(patterns) * period,
        period=period,
        shots_per_cycle=1,
        cycles_per_object=shots,
        block=_block(len(patterns), period, ticks, MAX_BLOCK_EXPOSURES),
    )
    return lay_out(profile, n, cycle, ticks)


def _pattern_major(profile: Profile, n: int, shots: int, dark: int, ticks: Ticks) -> Plan:
    _check_slots((n + dark) * shots, "order shot-major has one shot per cycle")
    displays = _interleave(np.arange(n), dark)
    hold = _hold(shots, ticks)
    offsets = np.arange(len(displays))[:, None] * hold + np.arange(shots)[None, :] * ticks.spacing
    cycle = Cycle(
        np.repeat(displays, shots),
        np.tile(np.arange(shots), len(displays)),
        offsets=offsets.ravel(),
        cycle_ticks=len(displays) * hold,
        period=ticks.spacing,
        shots_per_cycle=shots,
        cycles_per_object=1,
        block=_even_blocks(shots, MAX_BLOCK_EXPOSURES),
    )
    return lay_out(profile, n, cycle, ticks)


def _parallel(profile: Profile, n: int, shots: int, dark: int, ticks: Ticks) -> Plan:
    frames = _interleave(np.arange(shots), dark)
    word_bytes = -(-n // 8) + 8  # a word is rounded up, by less than 8 bytes
    cycle = Cycle(
        np.where(frames == DARK_PATTERN, DARK_PATTERN, 0),
        frames,
        offsets=np.arange(len(frames)) * ticks.spacing,
        cycle_ticks=len(frames) * ticks.spacing,
        period=ticks.spacing,
        shots_per_cycle=shots,
        cycles_per_object=1,
        block=_block(len(frames), ticks.spacing, ticks, min(MAX_BLOCK_EXPOSURES, MAX_BLOCK_BYTES // word_bytes)),
    )
    return lay_out(profile, n, cycle, ticks)


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """One cycle of a plan to be made: `patterns`, `shots` and `offsets` int64 (slots,), the rest in ticks and exposures."""

    patterns: NDArray[np.int64]
    shots: NDArray[np.int64]
    offsets: NDArray[np.int64]
    cycle_ticks: int
    period: int
    shots_per_cycle: int
    cycles_per_object: int
    block: int


def lay_out(profile: Profile, n_patterns: int, cycle: Cycle, ticks: Ticks) -> Plan:
    """Return the plan of one cycle of `n_patterns` patterns."""
    arrays = (
        cycle.offsets.astype(np.int64),
        cycle.patterns.astype(np.uint16),
        np.where(cycle.patterns == DARK_PATTERN, NO_SHOT, cycle.shots).astype(np.uint16),
    )
    for array in arrays:
        array.setflags(write=False)
    return Plan(
        mode=profile.mode,
        n_patterns=n_patterns,
        slot_offset_ticks=arrays[0],
        slot_pattern=arrays[1],
        slot_shot=arrays[2],
        exposure_ticks=ticks.exposure,
        slot_period_ticks=cycle.period,
        cycle_ticks=cycle.cycle_ticks,
        shots_per_cycle=cycle.shots_per_cycle,
        cycles_per_object=cycle.cycles_per_object,
        block_exposures=cycle.block,
        exposure_us=ticks.exposure * 1e6 / profile.clock.tick_hz,
    )


def _interleave(light: NDArray[np.int64], dark: int) -> NDArray[np.int64]:
    """Put `dark` dark displays before and between the `light` ones, evenly: dark display j before number floor(j n / dark)."""
    before = np.arange(dark) * len(light) // max(dark, 1)
    return np.insert(light, before, DARK_PATTERN)


def _check_slots(slots: int, remedy: str) -> None:
    if slots > MAX_SLOTS:
        raise PlanError(f"one cycle would have {slots} slots, allowed are {MAX_SLOTS}", remedy=remedy)


def _block(slots: int, period: int, ticks: Ticks, most: int) -> int:
    """Exposures per block: blocks of about equal size that last at most a quarter of the decision deadline."""
    return _even_blocks(slots, max(1, min(most, int(ticks.block // period))))


def _even_blocks(exposures: int, most: int) -> int:
    blocks = -(-exposures // most)
    return -(-exposures // blocks)
