"""What the reference instrument sees: its requests for light -> a file of click thresholds, computed by the simulator's own physics.

Owns the file's layout (firmware_sim/reference/posix/light.c reads it) and the patterns as they were uploaded; never draws a click. A
threshold is a whole number: 53 random bits below it are a click.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.device.upload import PatternMemory
from pans.firmware_sim.device.view import View
from pans.firmware_sim.device.walking import PatternLight
from pans.firmware_sim.program import Program, States
from pans.firmware_sim.scene.detector_model import (
    CLICK_STREAM,
    LOWER_CROSSTALK_STREAM,
    UPPER_CROSSTALK_STREAM,
    DetectorModel,
    detector_model,
    first_click_probability,
    stream_key,
)
from pans.firmware_sim.scene.light import LightTable
from pans.firmware_sim.scene.still import Scene
from pans.runtime.instrument.dead_time import STEP, counted_table
from pans.runtime.wire.commands import MODES, PARALLEL, MaskChunk, PatternChunk
from pans.runtime.wire.messages import ADAPTIVE_PATTERN

MAGIC = 0x31474C534E4150  # "PANSLG1"
HEADER_WORDS = 16
MAX_FILE_BYTES = 1 << 30
STATE_ROW = np.dtype("<u4")  # five of them: pattern, dwell, dwell steps, next without a click, next after one
F64 = NDArray[np.float64]
U64 = NDArray[np.uint64]


class TooMuchLight(Exception):
    """The table would not fit; its text goes back to the host as a refusal."""


class LightService:
    """The patterns of one device, and the files made from them in `folder`; the newest stays until the next is made."""

    def __init__(self, view: View, patterns: PatternMemory, folder: Path) -> None:
        assert isinstance(view.scene.what, Scene)
        self._view, self._patterns, self._folder = view, patterns, folder
        self._scene: Scene = view.scene.what
        self._light: tuple[tuple[int, int, int, bool], LightTable | PatternLight] | None = None
        self._files = 0

    def forget(self) -> None:
        """A new session: no pattern is loaded."""
        old = self._patterns
        self._patterns = PatternMemory(old.capacity, old.max_pixels, old.levels, old.revision + 1)

    def pixels(self, pattern: int, first: int, whole: int, count: int, packed: bytes | None, levels: bytes) -> None:
        """Take pixels that the device has accepted: 16-bit levels, or bits in `packed`."""
        if packed is not None:
            rows = np.frombuffer(packed, np.uint8)[None, :]
            self._patterns.load_masks(MaskChunk(pattern, first, whole, count, rows))
        else:
            self._patterns.load(PatternChunk(pattern, first, whole, np.frombuffer(levels, "<u2").astype(np.uint16)))

    def table(self, n_patterns: int, exposure_ticks: int, adaptive: bool, states: NDArray[np.uint32]) -> Path:
        """Return a new file for a measurement; states uint32 (n, 5), none for fixed patterns or a host that drives.

        Raises `Refused` for patterns that do not fit the scene, `TooMuchLight` for a table that is too large.
        """
        program = self._program(n_patterns, exposure_ticks, adaptive)
        light = self._tabulate(program)
        model = detector_model(self._view.profile, self._view.exposure_us(program))
        if isinstance(light, LightTable):
            words = self._fixed(light, model)
        elif len(states):
            words = self._followed(light, model, states)
        else:
            words = self._named(light, model, n_patterns)
        self._files += 1
        path = self._folder / f"light-{self._files}"
        path.write_bytes(words.tobytes())
        (self._folder / f"light-{self._files - 1}").unlink(missing_ok=True)
        return path

    def _program(self, n_patterns: int, exposure_ticks: int, adaptive: bool) -> Program:
        """What the view needs to know of a plan to compute its light; no schedule is in it."""
        one, shown = np.zeros(1, np.int64), np.full(1, ADAPTIVE_PATTERN if adaptive else 0, np.uint16)
        mode = MODES[self._view.profile.mode]
        return Program(mode, n_patterns, exposure_ticks, 1, exposure_ticks, 1, one, shown, ((0, 1),))

    def _tabulate(self, program: Program) -> LightTable | PatternLight:
        key = (self._patterns.revision, program.n_patterns, program.exposure_ticks, program.adaptive)
        if self._light is None or self._light[0] != key:
            made = self._view.tabulate(program, self._patterns.stack(program.n_patterns))
            assert isinstance(made, (LightTable, PatternLight))  # nothing that moves: see CEngine
            self._light = (key, made)
        return self._light[1]

    # -- the file ------------------------------------------------------------------------------------------------------

    def _fixed(self, table: LightTable, model: DetectorModel) -> U64:
        return self._file(model, table.probability, table.photoelectrons.sum(axis=1))

    def _followed(self, light: PatternLight, model: DetectorModel, rows: NDArray[np.uint32]) -> U64:
        from pans.firmware_sim.device.walk_kernels import chances, expected_light

        states = States(rows[:, 0].astype(np.int64), rows[:, 1] / rows[:, 2], rows[:, 3:].astype(np.int64))
        n_objects = self._scene.n_objects
        self._check_size(n_objects * (len(rows) + 1) * (2 if model.afterpulse_probability else 1))
        probability, photons = np.empty((n_objects, len(rows) + 1)), np.empty(n_objects)
        for number in range(n_objects):
            photoelectrons = np.asarray(light.of(number)[states.pattern] * states.light)
            both = chances(model, np.append(photoelectrons, 0.0))
            probability[number] = both[0]
            photons[number] = expected_light(both[:, :-1], photoelectrons, states.successors)
        return self._file(model, probability, photons)

    def _named(self, light: PatternLight, model: DetectorModel, n_patterns: int) -> U64:
        """The host names states: what they show is known when it does, so the expected photoelectrons go along."""
        n_objects = self._scene.n_objects
        self._check_size(3 * n_objects * (n_patterns + 1))
        mean = np.stack([light.of(number) for number in range(n_objects)])
        with_dark = np.column_stack([mean, np.zeros(n_objects)])
        probability = first_click_probability(model, with_dark)
        return self._file(model, probability, np.full(n_objects, math.nan), mean)

    def _file(self, model: DetectorModel, probability: F64, photons: F64, mean: F64 | None = None) -> U64:
        """The words of a file: probability float64 (objects, columns + 1), photons float64 (objects,), mean float64 (objects, columns)."""
        from pans.firmware_sim.scene.detector_kernels import click_thresholds  # loads the compiler

        after = model.afterpulse_probability
        self._check_size(probability.size * (2 if after else 1) + (0 if mean is None else mean.size))
        parts = [_header(self._view, model, probability, mean), click_thresholds(probability).ravel()]
        if after:
            parts.append(click_thresholds(1.0 - (1.0 - probability) * (1.0 - after)).ravel())
        if mean is not None:
            parts.append(np.ascontiguousarray(mean).view(np.uint64).ravel())
        parts += [np.ascontiguousarray(photons).view(np.uint64), self._scene.labels.astype(np.int64).view(np.uint64)]
        if model.law.dead_time.reach:
            parts.append(counted_table(model.law.dead_time).view(np.uint64))
        return np.concatenate(parts)

    def _check_size(self, words: int) -> None:
        if 8 * words > MAX_FILE_BYTES:
            raise TooMuchLight(f"a table of {8 * words >> 20} MiB: the engine holds {MAX_FILE_BYTES >> 20} MiB")


def _header(view: View, model: DetectorModel, probability: F64, mean: F64 | None) -> U64:
    real = np.array([model.law.dark_per_exposure, model.afterpulse_probability, STEP], np.float64)
    keys = [stream_key(view.seed, stream) for stream in (CLICK_STREAM, LOWER_CROSSTALK_STREAM, UPPER_CROSSTALK_STREAM)]
    from pans.firmware_sim.scene.detector_kernels import click_thresholds  # loads the compiler

    crosstalk = int(click_thresholds(np.array(model.crosstalk_probability)))
    n_objects, columns = probability.shape[0], probability.shape[1] - 1
    parallel = int(MODES[view.profile.mode] == PARALLEL)
    whole = [
        MAGIC,
        n_objects,
        columns,
        parallel,
        *keys,
        crosstalk,
        bool(model.afterpulse_probability),
        mean is not None,
        counted_table(model.law.dead_time).size if model.law.dead_time.reach else 0,
    ]
    header = np.zeros(HEADER_WORDS, np.uint64)
    header[: len(whole)] = np.array([int(number) for number in whole], np.uint64)
    header[len(whole) : len(whole) + len(real)] = real.view(np.uint64)
    return header
