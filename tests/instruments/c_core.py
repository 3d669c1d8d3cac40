"""The reference firmware in this process: the C core as a shared library, with light that the simulator's own physics computes.

`CDevice` takes bytes and ticks and returns bytes, as the simulator's `Instrument` does, so that both can be compared. The library asks
for light in lines of text (firmware_sim/reference/posix/light.c); the answer names a file of click thresholds: 53 random bits below one
are a click.
"""

from __future__ import annotations

import ctypes
import hashlib
import io
import math
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from pans.firmware_sim.device import readings
from pans.firmware_sim.device.gates import GATE_CHANNELS, MAX_PENDING_GATES
from pans.firmware_sim.device.states import MAX_SHOWS
from pans.firmware_sim.device.upload import MAX_PATTERN_PIXELS, MAX_SLOTS, MAX_UPLOAD_BYTES, PatternMemory, Refused
from pans.firmware_sim.device.view import View
from pans.firmware_sim.program import Program, States
from pans.firmware_sim.scene.detector_kernels import click_thresholds
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
from pans.firmware_sim.scene.scene_file import open_scene
from pans.runtime.instrument.dead_time import STEP, counted_table
from pans.runtime.instrument.profile import Profile
from pans.runtime.wire.commands import MODES, MaskChunk, PatternChunk
from pans.runtime.wire.messages import ADAPTIVE_PATTERN, MAX_PAYLOAD_BYTES

FOLDER = Path(readings.__file__).parents[1] / "reference"
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra")
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), "")
MAGIC, HEADER_WORDS = 0x31474C534E4150, 16  # "PANSLG1"
ROOM = 1 << 18  # of output that is taken at once
NEVER = (1 << 64) - 1
_ANSWER = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t)


def core_sources(folder: Path = FOLDER) -> list[Path]:
    """Return the C files of the core, which need nothing of a system."""
    return sorted(folder.glob("*.c"))


def build_library(folder: Path = FOLDER, cache: Path | None = None, flags: tuple[str, ...] = FLAGS) -> Path:
    """Return the core with the program's light as a shared library, compiled where no earlier build of the sources is in `cache`."""
    digest = hashlib.sha256(" ".join(flags).encode())
    for path in sorted(folder.rglob("*.[ch]")):
        digest.update(path.read_bytes())
    cache = cache or Path(tempfile.gettempdir()) / f"pans-c-core-{os.getuid()}"
    cache.mkdir(mode=0o700, exist_ok=True)
    target = cache / digest.hexdigest()[:20]
    if not target.is_file():
        sources = [*core_sources(folder), *(folder / "posix" / name for name in ("bench.c", "light.c"))]
        sources += sorted((folder / "library").glob("*.c"))
        made = target.with_suffix(f".{os.getpid()}")
        subprocess.run([COMPILER, *flags, "-shared", "-fPIC", *sources, "-lm", "-o", made], check=True)
        made.replace(target)
    return target


def settings_text(profile: Profile, scene: Any, seed: int, buffer: int) -> str:
    """Return what the library is told before it starts: lines of whole ticks, bytes and counts, `start` the last of them."""
    hz, projector, exposure = profile.clock.tick_hz, profile.projector, profile.exposure
    parallel = profile.mode == "parallel"
    lines = {
        "tick_hz": hz,
        "parallel": int(parallel),
        "channels": profile.detector.channels,
        "levels": projector.levels,
        "pattern_memory": projector.pattern_memory,
        "pattern_pixels": min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS),
        "pixel_memory": MAX_UPLOAD_BYTES // 2,
        "slot_memory": MAX_SLOTS,
        "automaton_states": 0 if parallel else projector.automaton_states,
        "dwell_steps": 0 if parallel else projector.dwell_steps,
        "show_memory": 0 if parallel else MAX_SHOWS,
        # a tick more or less is allowed for rounding, as by the simulator in Python
        "exposure_min_ticks": max(1, round(exposure.min_us * hz / 1e6) - 1),
        "exposure_max_ticks": round(exposure.max_us * hz / 1e6) + 1,
        "readout_ticks": max(0, math.ceil(exposure.readout_us * hz / 1e6) - 1),
        "pattern_ticks": max(0, math.ceil(hz / projector.pattern_rate_max_hz) - 1),
        "turn_ticks": max(0, math.ceil(profile.timing.device_turn_us * hz / 1e6) - 1),
        "buffer_messages": buffer,
        "buffer_bytes": min(buffer * (MAX_PAYLOAD_BYTES + MAX_PAYLOAD_BYTES // 254 + 64), 1 << 26),
        "gate_outputs": GATE_CHANNELS,
        "gate_pulses": MAX_PENDING_GATES,
        **{"epoch": 1, "offset_ticks": 0, "rate": 10**9, "objects": scene.n_objects, "seed": seed, "awake": 0},
        **{"listen": "none", "firmware": "pans-reference 1", "serial": f"SIM-{seed & 0xFFFFFFFF:08X}"},
        **{"profile": profile.name, "scene": scene.name[:60]},
    }
    return "".join(f"{name} {value}\n" for name, value in lines.items()) + "start\n"


class Light:
    """The patterns of one device, and the files of thresholds that are made from them in `folder`."""

    def __init__(self, view: View, folder: Path) -> None:
        self._view, self._folder, self._files, self._table = view, folder, 0, (None, None)
        self._forget(1)

    def _forget(self, revision: int) -> None:
        projector = self._view.profile.projector
        pixels = min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS)
        self._patterns = PatternMemory(projector.pattern_memory, pixels, projector.levels, revision)

    def answer(self, line: bytes, rest: io.BytesIO) -> str:
        """Serve the request that begins with `line`; return the line that answers it, "" where none is expected."""
        word, *words = line.split()
        numbers = list(map(int, words))
        if word == b"forget":
            self._forget(self._patterns.revision + 1)
        elif word == b"pixels":
            pattern, first, whole, count, bits = numbers
            data = rest.read((count + 7) // 8 if bits else 2 * count)
            if bits:
                self._patterns.load_masks(
                    MaskChunk(pattern, first, whole, count, np.frombuffer(data, np.uint8)[None, :])
                )
            else:
                self._patterns.load(PatternChunk(pattern, first, whole, np.frombuffer(data, "<u2").astype(np.uint16)))
        elif word == b"light":
            n_patterns, exposure_ticks, adaptive, n_states = numbers
            states = np.frombuffer(rest.read(20 * n_states), np.uint32).reshape(n_states, 5)
            try:
                return f"table {self._file(n_patterns, exposure_ticks, bool(adaptive), states)}"
            except Refused as refusal:
                return f"refused {int(refusal.status)} {refusal.text}"
        return ""

    def _file(self, n_patterns: int, exposure_ticks: int, adaptive: bool, rows: np.ndarray) -> Path:
        """Write the light of a measurement; rows uint32 (n, 5): states, none for fixed patterns or a host that drives."""
        view, one = self._view, np.zeros(1, np.int64)
        shown = np.full(1, ADAPTIVE_PATTERN if adaptive else 0, np.uint16)
        program = Program(
            MODES[view.profile.mode], n_patterns, exposure_ticks, 1, exposure_ticks, 1, one, shown, ((0, 1),)
        )
        key = (self._patterns.revision, n_patterns, exposure_ticks, adaptive)
        if self._table[0] != key:
            self._table = key, view.tabulate(program, self._patterns.stack(n_patterns))
        light, model = self._table[1], detector_model(view.profile, view.exposure_us(program))
        objects, mean = range(view.scene.n_objects), None
        if isinstance(light, LightTable):
            probability, photons = light.probability, light.photoelectrons.sum(axis=1)
        elif len(rows):
            states = States(rows[:, 0].astype(np.int64), rows[:, 1] / rows[:, 2], rows[:, 3:].astype(np.int64))
            lit = [np.asarray(light.of(number)[states.pattern] * states.light) for number in objects]
            both = [readings.click_chances(model, np.append(one, 0.0)) for one in lit]
            probability = np.stack([one[0] for one in both])
            photons = np.array([
                readings.expected_light(np.stack([1 - chance[:, :-1], chance[:, :-1]], axis=1), one, states.successors)
                for chance, one in zip(both, lit)
            ])  # fmt: skip
        else:  # the host names states: what they show is known when it does, so the expected photoelectrons go along
            mean = np.stack([light.of(number) for number in objects])
            probability = first_click_probability(model, np.column_stack([mean, np.zeros(len(mean))]))
            photons = np.full(len(mean), math.nan)
        self._files += 1
        path = self._folder / f"light-{self._files}"
        path.write_bytes(self._words(model, probability, photons, mean).tobytes())
        return path

    def _words(self, model: DetectorModel, probability: Any, photons: Any, mean: Any) -> np.ndarray:
        after, law, view = model.afterpulse_probability, model.law, self._view
        counted = counted_table(law.dead_time) if law.dead_time.reach else np.zeros(0)
        real = np.array([law.dark_per_exposure, after, STEP], np.float64)
        keys = [
            stream_key(view.seed, stream) for stream in (CLICK_STREAM, LOWER_CROSSTALK_STREAM, UPPER_CROSSTALK_STREAM)
        ]
        crosstalk = int(click_thresholds(np.array(model.crosstalk_probability)))
        objects, columns = probability.shape[0], probability.shape[1] - 1
        whole = [MAGIC, objects, columns, int(view.profile.mode == "parallel"), *keys, crosstalk, bool(after)]
        whole += [mean is not None, counted.size]
        header = np.zeros(HEADER_WORDS, np.uint64)
        header[: len(whole)] = np.array([int(number) for number in whole], np.uint64)
        header[len(whole) : len(whole) + len(real)] = real.view(np.uint64)
        parts = [header, click_thresholds(probability).ravel()]
        if after:
            parts.append(click_thresholds(1.0 - (1.0 - probability) * (1.0 - after)).ravel())
        if mean is not None:
            parts.append(np.ascontiguousarray(mean).view(np.uint64).ravel())
        labels = view.scene.what.labels.astype(np.int64)
        parts += [np.ascontiguousarray(photons).view(np.uint64), labels.view(np.uint64), counted.view(np.uint64)]
        return np.concatenate(parts)


class CDevice:
    """The C core from power-on at `tick`: a `SteppedDevice`."""

    def __init__(
        self, profile: Profile, scene: Any = None, *, tick: int = 0, seed: int = 0, buffer: int = 256,
        library: Path | None = None,
    ) -> None:  # fmt: skip
        scene = scene or open_scene("uniform")
        view = View(profile, scene, None, seed)
        view.check_and_warm_up()
        readings.warm_up()
        self._folder = tempfile.TemporaryDirectory(prefix="pans-c-core-")
        self._light, self._library = Light(view, Path(self._folder.name)), _load(library or build_library())
        self._answer = _ANSWER(self._ask)  # kept: the library calls it
        self._error: BaseException | None = None
        self.tick, self.session = tick, 0
        self._out = ctypes.create_string_buffer(ROOM)
        text = settings_text(profile, scene, seed, buffer).encode()
        self._handle = self._library.instrument_open(text, self._answer, tick)

    def step(self, tick: int, data: bytes) -> bytes:
        """Advance to `tick`, digest `data` as having arrived then, and return all bytes sent by then."""
        self.tick, sent = tick, b""
        # The line takes all: what is due is taken at once, so that nothing waits in the buffer that the window lets out.
        while (due := self._library.instrument_next_tick(self._handle)) <= tick:
            self._digest(due, b"")
            sent += self._take(due)
        self._digest(tick, data)
        return sent + self._take(tick)

    def next_event_tick(self) -> int | None:
        """Tick at which the device does something by itself next."""
        due = int(self._library.instrument_next_tick(self._handle))
        return None if due == NEVER else due

    def draw_ahead(self) -> bool:
        """Nothing: clicks are drawn when an exposure ends."""
        return False

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._library.instrument_close(self._handle)
            self._folder.cleanup()

    def _digest(self, tick: int, data: bytes) -> None:
        self._library.instrument_step(self._handle, tick, data, len(data))
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _take(self, tick: int) -> bytes:
        sent = b""
        while count := self._library.instrument_output(self._handle, tick, self._out, ROOM):
            sent += self._out.raw[:count]
        return sent

    def _ask(self, request: int, count: int, line: int, room: int) -> None:
        """Answer the library's requests; the last of them is the one that waits for a line."""
        text = b""
        try:
            requests = io.BytesIO(ctypes.string_at(request, count))
            while words := requests.readline():
                text = self._light.answer(words, requests).encode()
        except Exception as error:  # through C it cannot pass: it is raised again in `step`
            self._error, text = error, b"refused 4 no light could be computed"
        ctypes.memmove(line, text[: room - 1] + b"\0", min(len(text), room - 1) + 1)


def _load(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    handle, size, tick = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_uint64
    library.instrument_open.restype = handle
    library.instrument_open.argtypes = [ctypes.c_char_p, _ANSWER, tick]
    library.instrument_step.argtypes = [handle, tick, ctypes.c_char_p, size]
    library.instrument_output.argtypes = [handle, tick, ctypes.c_void_p, size]
    library.instrument_output.restype = size
    library.instrument_next_tick.argtypes = [handle]
    library.instrument_next_tick.restype = tick
    library.instrument_close.argtypes = [handle]
    return library
