"""What the host has uploaded: pattern memory and plan memory, with every limit checked before anything is stored.

A chunk of LOAD_PATTERN or LOAD_PLAN that makes no sense raises `Refused` with the status and text of the acknowledgement, and leaves the
memory as it was. Chunks come in order; the one that starts at 0 starts over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pans.instrument.profile import Profile
from pans.protocol.wire import (
    ADAPTIVE_PATTERN,
    BLOCK_HEADER_BYTES,
    DARK_PATTERN,
    MAX_PAYLOAD_BYTES,
    MODES,
    PARALLEL,
    AckStatus,
    MaskChunk,
    PatternChunk,
    PlanChunk,
)
from pans_sim.scene.program import Program

MAX_PATTERN_PIXELS = 1 << 22
MAX_UPLOAD_BYTES = 1 << 28
MAX_SLOTS = 1 << 20
MAX_CYCLE_TICKS = 1 << 48


class Refused(Exception):
    """A command that the device does not carry out; becomes the acknowledgement's status and text."""

    def __init__(self, status: AckStatus, text: str) -> None:
        super().__init__(text)
        self.status = status
        self.text = text


@dataclass(slots=True)
class _Pattern:
    levels: NDArray[np.unsignedinteger]
    filled: int = 0


@dataclass(slots=True)
class PatternMemory:
    """The uploaded patterns; `revision` changes whenever a pixel does."""

    capacity: int
    max_pixels: int
    levels: int
    revision: int = 0
    held_bytes: int = 0
    _patterns: dict[int, _Pattern] = field(default_factory=dict)

    def load(self, chunk: PatternChunk) -> None:
        """Store one chunk, or raise `Refused`."""
        top = int(chunk.levels.max())
        _require(top < self.levels, lambda: f"level {top}: the projector has 0..{self.levels - 1}")
        self._store(chunk)

    def load_masks(self, chunk: MaskChunk) -> None:
        """Store masks as patterns of the levels 0 and 1, or raise `Refused` and store none."""
        count, held = len(chunk.rows), self.held_bytes
        last = chunk.first_pattern + count - 1
        _require(last < self.capacity, lambda: f"pattern {last}: memory holds {self.capacity}")
        if chunk.first_pixel == 0:  # before any of them is stored: a refused command stores nothing
            known = (self._patterns.get(index) for index in range(chunk.first_pattern, last + 1))
            wanted = held + 2 * count * chunk.n_pixels - sum(2 * len(one.levels) for one in known if one is not None)
            _require(wanted <= MAX_UPLOAD_BYTES, lambda: f"patterns of {wanted} bytes: memory has {MAX_UPLOAD_BYTES}")
        for row, packed in enumerate(chunk.rows):
            levels = np.unpackbits(packed, count=chunk.pixels, bitorder="little").astype(np.uint16)
            self._store(PatternChunk(chunk.first_pattern + row, chunk.first_pixel, chunk.n_pixels, levels))

    def _store(self, chunk: PatternChunk) -> None:
        _require(chunk.pattern < self.capacity, lambda: f"pattern {chunk.pattern}: memory holds {self.capacity}")
        allowed = min(self.max_pixels, MAX_PATTERN_PIXELS)
        _require(chunk.n_pixels <= allowed, lambda: f"pattern of {chunk.n_pixels} pixels: allowed {allowed}")
        pattern = self._patterns.get(chunk.pattern)
        if chunk.first_pixel == 0:
            pattern = self._new(chunk)
        if pattern is None or chunk.first_pixel != pattern.filled or chunk.n_pixels != len(pattern.levels):
            expected = f"{pattern.filled} of {len(pattern.levels)}" if pattern else "0"
            found = f"{chunk.first_pixel} of {chunk.n_pixels}"
            raise Refused(AckStatus.OUT_OF_RANGE, f"pattern {chunk.pattern}: pixel {found}, expected {expected}")
        pattern.levels[pattern.filled : pattern.filled + len(chunk.levels)] = chunk.levels
        pattern.filled += len(chunk.levels)
        self.revision += 1

    def _new(self, chunk: PatternChunk) -> _Pattern:
        before = self._patterns.get(chunk.pattern)
        wanted = self.held_bytes + 2 * chunk.n_pixels - (0 if before is None else 2 * len(before.levels))
        _require(wanted <= MAX_UPLOAD_BYTES, lambda: f"patterns of {wanted} bytes: memory has {MAX_UPLOAD_BYTES}")
        self.held_bytes = wanted
        dtype = np.uint8 if self.levels <= 256 else np.uint16  # tens of thousands are tens of MiB
        pattern = self._patterns[chunk.pattern] = _Pattern(np.zeros(chunk.n_pixels, dtype))
        return pattern

    def stack(self, n_patterns: int) -> NDArray[np.unsignedinteger]:
        """Return patterns 0..n-1 (n, pixels), in one byte where levels fit; `Refused` if one is missing, incomplete or of another size."""
        chosen = [self._patterns.get(index) for index in range(n_patterns)]
        complete = [one for one in chosen if one is not None and one.filled == len(one.levels)]
        if len(complete) < n_patterns:
            raise Refused(
                AckStatus.WRONG_STATE, f"{n_patterns - len(complete)} of {n_patterns} patterns are not loaded"
            )
        sizes = sorted({len(one.levels) for one in complete})
        if len(sizes) > 1:
            raise Refused(AckStatus.OUT_OF_RANGE, f"patterns have different sizes: {sizes[0]} and {sizes[-1]} pixels")
        stacked = np.empty((n_patterns, sizes[0]), complete[0].levels.dtype)
        for row, one in zip(stacked, complete):
            row[:] = one.levels
            one.levels = row  # what is in the memory already does not stand there twice
        return stacked


@dataclass(slots=True)
class PlanMemory:
    """The uploaded plan; `program` is None until its last slot has come and all of it can be done."""

    profile: Profile
    adaptive: bool = False  # whether the clicks may choose what a slot shows
    program: Program | None = None
    _head: PlanChunk | None = None
    _slots: list[NDArray[np.void]] = field(default_factory=list)
    _filled: int = 0

    def load(self, chunk: PlanChunk) -> None:
        """Store one chunk, or raise `Refused`; the last one compiles the program."""
        if chunk.first_slot == 0:
            _check_head(self.profile, chunk)
            self._head, self._slots, self._filled, self.program = chunk, [], 0, None
        if self._head is None or chunk.first_slot != self._filled or _facts(chunk) != _facts(self._head):
            raise Refused(
                AckStatus.OUT_OF_RANGE, f"slot {chunk.first_slot} does not continue the plan at {self._filled}"
            )
        _check_slots(chunk, self.adaptive)
        self._slots.append(chunk.slots)
        self._filled += len(chunk.slots)
        if self._filled == chunk.n_slots:
            self.program = self._compile(chunk, np.concatenate(self._slots))

    def _compile(self, head: PlanChunk, slots: NDArray[np.void]) -> Program:
        offsets = slots["offset_ticks"].astype(np.int64)
        gaps = np.diff(offsets, append=offsets[0] + head.cycle_ticks)
        _check_spacing(self.profile, head, gaps)
        shown = slots["pattern"]
        adaptive = (shown == ADAPTIVE_PATTERN) & self.adaptive
        fixed = int(np.count_nonzero(~adaptive & (shown != DARK_PATTERN)))
        _require(not (fixed and adaptive.any()), lambda: f"{fixed} slots with a fixed pattern beside adaptive ones")
        if head.mode != PARALLEL:
            _check_pattern_rate(self.profile, head, offsets[adaptive | (shown != np.roll(shown, 1))])
        return Program(
            head.mode, head.n_patterns, head.exposure_ticks, head.slot_period_ticks, head.cycle_ticks,
            head.cycles_per_object, offsets, slots["pattern"].astype(np.uint16),
            _cut_into_blocks(gaps, head.slot_period_ticks, head.block_exposures),
        )  # fmt: skip


def word_bytes(n_channels: int) -> int:
    """Bytes of one frame word: 1, 2, 4 or a multiple of 8, at least one bit for each channel."""
    needed = (n_channels + 7) // 8
    return next((size for size in (1, 2, 4) if needed <= size), (needed + 7) // 8 * 8)


def _facts(chunk: PlanChunk) -> tuple[int, ...]:
    return (*chunk[:3], *chunk[4:9])


def _check_head(profile: Profile, head: PlanChunk) -> None:
    tick_hz = profile.clock.tick_hz
    channels = profile.detector.channels if head.mode == PARALLEL else profile.projector.pattern_memory
    low, high = (round(us * tick_hz / 1e6) for us in (profile.exposure.min_us, profile.exposure.max_us))
    per_exposure = word_bytes(head.n_patterns) if head.mode == PARALLEL else 2 + 1 / 8
    longest = int((MAX_PAYLOAD_BYTES - BLOCK_HEADER_BYTES - 1) / per_exposure)
    _require(head.mode == MODES[profile.mode], lambda: f"mode {head.mode}: this instrument is {profile.mode}")
    _require(1 <= head.n_patterns <= channels, lambda: f"{head.n_patterns} patterns: allowed 1..{channels}")
    _require(1 <= head.n_slots <= MAX_SLOTS, lambda: f"{head.n_slots} slots: allowed 1..{MAX_SLOTS}")
    _require(low - 1 <= head.exposure_ticks <= high + 1, lambda: f"exposure {head.exposure_ticks}: {low}..{high} ticks")
    _require(head.exposure_ticks > 0, lambda: "exposure of 0 ticks")
    _require(head.slot_period_ticks > 0, lambda: "exposures 0 ticks apart: at least 1 is needed")
    _require(0 < head.cycle_ticks <= MAX_CYCLE_TICKS, lambda: f"cycle of {head.cycle_ticks}: up to {MAX_CYCLE_TICKS}")
    _require(1 <= head.block_exposures <= longest, lambda: f"{head.block_exposures} exposures per block: 1..{longest}")
    _require(head.cycles_per_object > 0, lambda: "0 cycles per object: at least 1 is needed")


def _check_slots(chunk: PlanChunk, adaptive: bool) -> None:
    last = int(chunk.slots["offset_ticks"].max())
    limit = chunk.cycle_ticks
    _require(last < limit, lambda: f"exposure at {last} of a cycle of {limit} ticks")
    shown = chunk.slots["pattern"]
    chosen = (shown == ADAPTIVE_PATTERN) & adaptive
    lit = shown[(shown != DARK_PATTERN) & ~chosen]
    top = int(lit.max()) if lit.size else 0
    _require(top < chunk.n_patterns, lambda: f"a slot shows pattern {top}: the plan has {chunk.n_patterns}")


def _check_spacing(profile: Profile, head: PlanChunk, gaps: NDArray[np.int64]) -> None:
    """Refuse exposures closer than the detector can read; a tick less is forgiven for rounding."""
    readout_ticks = profile.exposure.readout_us * profile.clock.tick_hz / 1e6
    needed = head.exposure_ticks + max(0, math.ceil(readout_ticks) - 1)
    shortest = int(gaps.min())
    _require(shortest >= needed, lambda: f"exposures {shortest} ticks apart: at least {needed} are needed")


def _check_pattern_rate(profile: Profile, head: PlanChunk, changes: NDArray[np.int64]) -> None:
    """Refuse patterns that follow each other faster than the projector can change them, at ticks `changes` of the cycle."""
    if not len(changes):
        return
    shortest = int(np.diff(changes, append=changes[0] + head.cycle_ticks).min())
    needed = math.ceil(profile.clock.tick_hz / profile.projector.pattern_rate_max_hz) - 1
    _require(shortest >= needed, lambda: f"patterns change after {shortest} ticks: the projector needs {needed}")


def _cut_into_blocks(gaps: NDArray[np.int64], period: int, longest: int) -> tuple[tuple[int, int], ...]:
    blocks, first = [], 0
    for slot, gap in enumerate(gaps.tolist(), start=1):
        if slot == len(gaps) or gap != period or slot - first == longest:
            blocks.append((first, slot - first))
            first = slot
    return tuple(blocks)


def _require(fine: bool, text: Callable[[], str]) -> None:
    if not fine:
        raise Refused(AckStatus.OUT_OF_RANGE, text())
