"""Plan: what is exposed when, in device ticks, and whether this hardware can do it at all.

`build_plan` returns a `Plan` or raises PlanError. A plan repeats one *cycle* of slots, one exposure each:

- **shot-major** (sequential): every pattern once, one exposure each; a cycle is one shot, an object takes `shots_per_object` cycles.
- **pattern-major** (sequential, the paper's protocol): every pattern is displayed once and exposed `shots_per_object` times in a
  row, within a whole number of refresh periods of the projector; a cycle is one object.
- **parallel**: all patterns shine at once, a slot exposes all channels (its pattern index is 0); a cycle is one object, its
  frames are the shots. For objects in flow, decide/flow/make.py lays out frames without end.

- **walks** (sequential, of an automaton): one exposure for each step of the longest walk, its pattern chosen by the clicks before it;
  a cycle is one walk, an object takes `shots_per_object` walks. What is left of a cycle behind a leaf is dark.

Dark displays stand before the patterns, spread evenly; a cycle ends with light, so that no decision waits for a dark exposure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import PlanError, UsageError
from pans.instrument.click_law import BRIGHT, cannot_count, law_warnings
from pans.instrument.profile import Profile
from pans.protocol.wire import ADAPTIVE_PATTERN as ADAPTIVE_PATTERN
from pans.protocol.wire import DARK_PATTERN as DARK_PATTERN
from pans.protocol.wire import U32_MAX

if TYPE_CHECKING:
    from pans.bundle.automaton import Automaton
    from pans.bundle.sensor import Bundle

NO_SHOT = 0xFFFF  # shot number of a dark slot
MAX_SLOTS = 1 << 20  # of one cycle; more would be 16 MB of plan on the wire
MAX_BLOCK_EXPOSURES = 1024  # keeps a click block near 2 kB


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """One cycle of exposures; arrays are read-only, in order of time, one element per slot."""

    mode: str
    n_patterns: int
    slot_offset_ticks: NDArray[np.int64]  # start of the exposure within the cycle
    # DARK_PATTERN in a dark slot, ADAPTIVE_PATTERN where the clicks choose, 0 in parallel mode
    slot_pattern: NDArray[np.uint16]
    slot_shot: NDArray[np.uint16]  # the shot of the cycle that the exposure belongs to; NO_SHOT in a dark slot
    exposure_ticks: int
    slot_period_ticks: int  # distance of exposures inside a block
    cycle_ticks: int
    shots_per_cycle: int
    cycles_per_object: int
    block_exposures: int  # most exposures of one click block
    exposure_us: float  # of the exposure in whole ticks
    automaton: Automaton | None = None  # what chooses the patterns of adaptive slots
    drive: str = ""  # of an automaton: "device" if the device follows it, "host" if the host names each state
    largest: int = 1  # the largest number that an exposure can have: 1 of the clicks of one detector

    @property
    def channels_at_once(self) -> int:
        """Detectors that each exposure of a walk reads; their clicks are the bits of its number. 1 of fixed patterns."""
        return 1 if self.automaton is None else self.automaton.channels

    @property
    def n_channels(self) -> int:
        """Detectors that every exposure reads: all of a parallel plan, those of a walk, else 1."""
        return self.n_patterns if self.mode == "parallel" else self.channels_at_once

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


@dataclass(frozen=True, slots=True)
class Ticks:
    """The times that all orders share, in whole ticks."""

    exposure: int
    spacing: int  # exposure and readout: the least distance of two exposures
    refresh: float  # one refresh period of the projector, not rounded
    block: float  # longest block: a quarter of the decision deadline


def ticks_of(profile: Profile, exposure: float) -> Ticks:
    """Return the times of a plan with exposures of `exposure` us in whole ticks; PlanError beyond what the protocol counts."""
    per_us = profile.clock.tick_hz / 1e6
    exposure_ticks = max(1, round(exposure * per_us))
    spacing = exposure_ticks + up(profile.exposure.readout_us * per_us)
    refresh = profile.clock.tick_hz / profile.projector.pattern_rate_max_hz
    if max(spacing, refresh) > U32_MAX:
        longest_s = U32_MAX / profile.clock.tick_hz
        raise PlanError(
            f"exposure and readout, or one refresh period, take {max(spacing, refresh):.4g} ticks of {profile.name}'s clock; "
            f"the protocol counts up to {U32_MAX} ({longest_s:.4g} s)",
            remedy="use a slower clock.tick_hz or a shorter exposure",
        )
    return Ticks(exposure_ticks, spacing, refresh, profile.timing.decision_deadline_us * per_us / 4)


def up(ticks: float) -> int:
    """Round up to whole ticks, forgiving the last digits of a float."""
    return math.ceil(ticks * (1 - 1e-12))


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


def interleave(light: NDArray[np.int64], dark: int) -> NDArray[np.int64]:
    """Put `dark` dark displays before and between the `light` ones, evenly: dark display j before number floor(j n / dark)."""
    before = np.arange(dark) * len(light) // max(dark, 1)
    return np.insert(light, before, DARK_PATTERN)


def check_slots(slots: int, remedy: str) -> None:
    """Raise PlanError, with `remedy`, when a cycle would have too many slots."""
    if slots > MAX_SLOTS:
        raise PlanError(f"one cycle would have {slots} slots, allowed are {MAX_SLOTS}", remedy=remedy)


def block_exposures(slots: int, period: int, ticks: Ticks, most: int) -> int:
    """Exposures per block: blocks of about equal size that last at most a quarter of the decision deadline."""
    return even_blocks(slots, max(1, min(most, int(ticks.block // period))))


def even_blocks(exposures: int, most: int) -> int:
    """The length of as few blocks as possible of about equal length, none longer than `most`."""
    blocks = -(-exposures // most)
    return -(-exposures // blocks)


ORDERS = ("auto", "pattern-major", "shot-major")
DRIVES = ("auto", "device", "host")
MAX_BLOCK_BYTES = 16384  # keeps a block of wide frames far below the longest message
_MAX_SHOTS = 0xFFFE
_ROUNDING = 1e-6  # of an exposure: training keeps to the limits in float32, and a tick is longer


def build_plan(
    profile: Profile,
    bundle: Bundle,
    *,
    shots_per_object: int = 1,
    dark_slots_per_cycle: int = 1,
    order: str = "auto",
    drive: str = "auto",
    automaton: Automaton | None = None,
) -> Plan:
    """Lay out the exposures that measure `bundle`'s patterns `shots_per_object` times per object on `profile`'s hardware.

    `dark_slots_per_cycle` counts displays of the dark pattern (in pattern-major order each holds `shots_per_object` exposures).
    `order` is for sequential profiles; "auto" takes the one with the shorter time per object, shot-major if they are equal.
    `drive` is for automata; "auto" takes "device" where the profile says that the device can. `automaton` is the one to run in place of
    the bundle's, as `stopped` returns it.
    Raises PlanError with the numbers if the hardware cannot do it, UsageError if `order` or `drive` is none.
    """
    if order not in ORDERS:
        raise UsageError(f"order must be one of {', '.join(ORDERS)}, found {order!r}")
    if drive not in DRIVES:
        raise UsageError(f"drive must be one of {', '.join(DRIVES)}, found {drive!r}")
    _check_counts(shots_per_object, dark_slots_per_cycle)
    check_fit(profile, bundle)
    ticks = ticks_of(profile, exposure_us(profile, bundle))
    if (chosen := automaton or bundle.automaton) is not None:
        if order == "pattern-major":
            raise PlanError(
                "an automaton shows each pattern once per walk: there is no order pattern-major",
                remedy="leave --order out",
            )
        return _walks(profile, bundle, chosen, drive, shots_per_object, dark_slots_per_cycle, ticks)
    if drive != "auto":
        raise PlanError(f"{bundle.name} has fixed patterns, found drive {drive}", remedy="leave --drive out")
    if bundle.largest > 1:
        demand_counting(profile, bundle.outcomes, bundle.name)
    plan = _fixed(profile, bundle.n_features, order, shots_per_object, dark_slots_per_cycle, ticks)
    return replace(plan, largest=bundle.largest)


def demand_counting(profile: Profile, outcomes: int, who: str) -> None:
    """Raise PlanError unless the detector of `profile` tells `outcomes` readings of one exposure apart, pattern after pattern."""
    why = cannot_count(profile, outcomes)
    if not why and profile.mode != "sequential":
        why = f"photon numbers of one pattern after the other, {profile.name} measures in {profile.mode} mode"
    if why:
        raise PlanError(
            f"{who} has {why}",
            remedy=f"choose a profile whose detector counts, or retrain: pans train --profile {profile.name}",
        )


def _fixed(profile: Profile, n: int, order: str, shots: int, dark: int, ticks: Ticks) -> Plan:
    """`n` patterns that do not depend on clicks, in the `order` that is asked for or takes the shorter time."""
    if profile.mode == "parallel":
        if order != "auto":
            raise PlanError(f"order must be auto in parallel mode, found {order}", remedy="leave --order out")
        return _parallel(profile, n, shots, dark, ticks)
    makers = {"shot-major": _shot_major, "pattern-major": _pattern_major}
    if order != "auto":
        return makers[order](profile, n, shots, dark, ticks)
    plan, displays = _shot_major(profile, n, shots, dark, ticks), n + dark
    if displays * shots > MAX_SLOTS or displays * _hold(shots, ticks) >= plan.object_ticks:
        return plan
    return _pattern_major(profile, n, shots, dark, ticks)


def detector_warnings(
    profile: Profile, bundle: Bundle, exposure_us: float, *, eta: float = 1.0, one_by_one: bool = False
) -> list[str]:
    """Return where the laws of `profile`'s detector do not hold as stated for the light of `bundle` times `eta` (instrument/click_law.py).

    `one_by_one`: the clicks of an exposure are taken to be independent.
    """
    light = BRIGHT
    if bundle.automaton is not None:
        light = float(bundle.state_light().max())
    elif bundle.analyser is None:
        light = int(bundle.pattern_levels.sum(axis=1, dtype=np.uint64).max()) * bundle.photons_per_level
    return law_warnings(profile, exposure_us, light * eta, one_by_one=one_by_one)


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
    if needed_us > high * (1 + _ROUNDING):
        raise PlanError(
            f"{said}: the light is too weak by a factor of {needed_us / high:.4g}",
            remedy=f"make it brighter, to at least {top / high * 1e6:.4g} photoelectrons/s, and calibrate; or train for less light",
        )
    if needed_us < low * (1 - _ROUNDING):
        raise PlanError(
            f"{said}: the light is too bright by a factor of {low / needed_us:.4g}",
            remedy=f"put a filter of optical density {math.log10(low / needed_us):.2f} or a little more before the detector "
            f"(at most {top / low * 1e6:.4g} photoelectrons/s), and calibrate",
        )
    return needed_us


def _passive_exposure_us(profile: Profile, wanted_us: float) -> float:
    """A passive sensor was trained for one exposure: another would bring other light and other dark counts."""
    low, high = profile.exposure.min_us, profile.exposure.max_us
    if not low * (1 - _ROUNDING) <= wanted_us <= high * (1 + _ROUNDING):
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
    if profile.mode == "parallel" and bundle.automaton is None and bundle.n_features > profile.detector.channels:
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
    if bundle.n_shown > projector.pattern_memory:
        option = "--features" if bundle.automaton is None else "--patterns"
        raise PlanError(
            f"the bundle has {bundle.n_shown} patterns, the pattern memory of {profile.name} holds {projector.pattern_memory}",
            remedy=f"pans train {option} {projector.pattern_memory}, or fewer",
        )


def _hold(shots: int, ticks: Ticks) -> int:
    """How long one display lasts in pattern-major order: enough whole refresh periods for all its exposures."""
    return up(max(1, up(shots * ticks.spacing / ticks.refresh)) * ticks.refresh)


def _shot_major(profile: Profile, n: int, shots: int, dark: int, ticks: Ticks) -> Plan:
    patterns = interleave(np.arange(n), dark)
    period = max(ticks.spacing, up(ticks.refresh))
    block = block_exposures(len(patterns), period, ticks, MAX_BLOCK_EXPOSURES)
    return lay_out(profile, n, _single_shots(patterns, period, shots, block), ticks)


def _single_shots(patterns: NDArray[np.int64], period: int, cycles_per_object: int, block: int) -> Cycle:
    """Return a cycle of one shot: an exposure of each pattern, `period` ticks apart."""
    return Cycle(
        patterns,
        np.zeros(len(patterns), np.int64),
        offsets=np.arange(len(patterns)) * period,
        cycle_ticks=len(patterns) * period,
        period=period,
        shots_per_cycle=1,
        cycles_per_object=cycles_per_object,
        block=block,
    )


def _pattern_major(profile: Profile, n: int, shots: int, dark: int, ticks: Ticks) -> Plan:
    check_slots((n + dark) * shots, "order shot-major has one shot per cycle")
    displays = interleave(np.arange(n), dark)
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
        block=even_blocks(shots, MAX_BLOCK_EXPOSURES),
    )
    return lay_out(profile, n, cycle, ticks)


def _walks(
    profile: Profile, bundle: Bundle, automaton: Automaton, drive: str, walks: int, dark: int, ticks: Ticks
) -> Plan:
    """One exposure of every cycle for each step of the longest walk; the turn of whoever chooses the patterns comes between them."""
    drive = _checked_drive(profile, automaton, drive)
    turn_us = profile.timing.host_turn_us if drive == "host" else profile.timing.device_turn_us
    turn = up(turn_us * profile.clock.tick_hz / 1e6)
    period = max(ticks.spacing, ticks.exposure + turn, up(ticks.refresh))
    if period > U32_MAX:
        raise PlanError(f"an exposure and the {drive}'s turn take {period} ticks, the protocol counts up to {U32_MAX}")
    slots = interleave(np.full(automaton.n_slots, ADAPTIVE_PATTERN), dark)
    check_slots(len(slots), "fewer dark slots")
    block = 1 if drive == "host" else block_exposures(len(slots), period, ticks, MAX_BLOCK_EXPOSURES)
    plan = lay_out(profile, len(bundle.pattern_levels), _single_shots(slots, period, walks, block), ticks)
    return replace(plan, automaton=automaton, drive=drive, largest=automaton.n_outcomes - 1)


def _checked_drive(profile: Profile, automaton: Automaton, drive: str) -> str:
    """Return "device" or "host", whichever is asked for and possible; PlanError says what is not, in numbers."""
    if automaton.counts:
        demand_counting(profile, automaton.n_outcomes, "the automaton")
    if profile.mode != "sequential" or automaton.channels > profile.detector.channels:
        raise PlanError(
            f"the automaton reads {automaton.channels} detectors at once, {profile.name} measures in {profile.mode} mode and has "
            f"{profile.detector.channels}; a walk shows pattern after pattern",
            remedy="choose a sequential profile with as many detectors (detector.channels), or train with fewer --channels",
        )
    steps, can = automaton.dwell_steps, profile.projector.dwell_steps
    if can % steps:
        raise PlanError(
            f"the automaton's light is on for 1 to {steps} parts of an exposure, {profile.name} divides one into {can} "
            f"(projector.dwell_steps)",
            remedy=f"retrain: pans train --encoder automaton --profile {profile.name}",
        )
    held = profile.projector.automaton_states
    if drive == "auto":
        return "device" if automaton.n_states <= held else "host"
    if drive == "device" and automaton.n_states > held:
        raise PlanError(
            f"the automaton has {automaton.n_states} states, the device of {profile.name} follows {held} (projector.automaton_states)",
            remedy="--drive host: the host names each state; or train with fewer states",
        )
    return drive


def _parallel(profile: Profile, n: int, shots: int, dark: int, ticks: Ticks) -> Plan:
    frames = interleave(np.arange(shots), dark)
    word_bytes = -(-n // 8) + 8  # a word is rounded up, by less than 8 bytes
    cycle = Cycle(
        np.where(frames == DARK_PATTERN, DARK_PATTERN, 0),
        frames,
        offsets=np.arange(len(frames)) * ticks.spacing,
        cycle_ticks=len(frames) * ticks.spacing,
        period=ticks.spacing,
        shots_per_cycle=shots,
        cycles_per_object=1,
        block=block_exposures(
            len(frames), ticks.spacing, ticks, min(MAX_BLOCK_EXPOSURES, MAX_BLOCK_BYTES // word_bytes)
        ),
    )
    return lay_out(profile, n, cycle, ticks)
