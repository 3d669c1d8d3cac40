"""The C core of firmware_sim/pans_sim/reference in this process: compiled once per user, called through ctypes, with hardware in Python.

`Core` takes bytes and ticks and returns bytes, as the simulator's `Instrument` does. `Hardware` is what it asks of the instrument.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from ctypes import c_char_p, c_size_t, c_uint64, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import install
from pans.base.errors import ConfigError
from pans.base.files import own_folder, user_cache
from pans.instrument.profile import Profile
from pans.protocol.wire import MAX_PAYLOAD_BYTES, AckStatus, PatternChunk
from pans_sim.device.states import MAX_SHOWS
from pans_sim.device.upload import MAX_PATTERN_PIXELS, MAX_SLOTS, MAX_UPLOAD_BYTES, Refused

FOLDER = Path(__file__).parents[1] / "reference"
WIDTHS = ("uint8", "uint16", "uint32", "uint64", "int16")
FLAGS = ("-std=c99", "-O2")
ROOM = 1 << 18  # bytes of output that are taken at once
NEVER = (1 << 64) - 1
CALLS = {  # name: result, arguments after the device
    "pans_edge_tick": (c_uint64, ()),
    "pans_edge": (None, ()),
    "pans_step": (None, (c_uint64, c_char_p, c_size_t)),
    "pans_output": (c_size_t, (c_uint64, c_void_p, c_size_t)),
    "pans_next_tick": (c_uint64, ()),
}


def _structures(header: str) -> dict[str, Any]:
    """Return the structures of a header as ctypes has them: what stands there is the only description of them."""
    known: dict[str, Any] = {f"{name}_t": getattr(ctypes, f"c_{name}") for name in WIDTHS}
    known["size_t"] = c_size_t
    known |= {"bool": ctypes.c_bool, "float": ctypes.c_float, "pans_status": ctypes.c_int, "void": None}

    def kind_of(words: str) -> tuple[str, Any]:
        found = re.fullmatch(r"(?:const )?(?:struct |enum )?(\w+) (\**)(\w+)(\[\d+\])?", words)
        assert found is not None, words
        base, stars, name, many = found.groups()
        depth, kind = len(stars) + bool(many), known[base] if base != "char" else None
        if depth and kind is None:
            depth, kind = depth - 1, c_char_p if base == "char" else c_void_p
        for _ in range(depth):
            kind = ctypes.POINTER(kind)
        return name, kind

    def fields_of(declaration: str) -> Iterator[tuple[str, Any]]:
        if called := re.fullmatch(r"(.+?)\(\*(\w+)\)\((.*)\)", declaration):
            result, name, arguments = called.groups()
            kinds = [kind_of(words)[1] for words in (f"{result.strip()} it", *arguments.split(", "))]
            yield name, ctypes.CFUNCTYPE(*kinds)
            return
        first, *others = declaration.split(", ")
        for words in (first, *(f"{first.rsplit(' ', 1)[0]} {one}" for one in others)):
            yield kind_of(words)

    plain = " ".join(re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL).split())
    for name, body in re.findall(r"struct (pans_\w+) \{(.*?)\};", plain):
        fields = [field for one in body.split(";") if one.strip() for field in fields_of(one.strip())]
        known[name] = type(name, (ctypes.Structure,), {"_fields_": fields})
    return known


STRUCTURES = _structures((FOLDER / "pans_device.h").read_text())
_HARDWARE = dict(STRUCTURES["pans_hardware"]._fields_)


def states_of(task: Any) -> NDArray[np.int64]:
    """Pattern, dwell, dwell steps and the two successors of every state of a `pans_task`, int64 (states, 5)."""
    rows, after = np.zeros((task.n_states, 5), np.int64), (ctypes.c_uint32 * 2)()
    for number, row in enumerate(rows):
        light = task.state(task.device, number, after)
        row[:] = light.pattern, light.dwell, light.dwell_steps, *after
    return rows


class Hardware:
    """What the C core asks of the instrument; exposures and tasks are structures of pans_device.h, ticks those of `now`.

    Nothing waits for the host. An exception ends the run: the instrument is told to go dark, and `Core.step` raises it.
    """

    lead_ticks = 0  # by how much `expose` is called ahead of its tick

    def now(self) -> int:
        """Return the tick; it never goes back."""
        return 0

    def store(self, chunk: PatternChunk | None) -> None:
        """Take pixels of a pattern, in order; None: forget all."""

    def prepare(self, task: Any) -> None:
        """Get ready for a measurement, or raise `Refused`."""

    def show(self, exposure: Any) -> None:
        """Get ready for the next exposure, as soon as it is known."""

    def expose(self, exposure: Any) -> int:
        """Wait for its tick, let there be light; return the tick at which it began."""
        raise NotImplementedError

    def clicks(self) -> tuple[int, Any]:
        """Wait for the end of the exposure; return the tick at which it ended, and the click of each channel."""
        raise NotImplementedError

    def dark(self) -> None:
        """End all light at once: the run is over."""

    def gate(self, output: int, is_open: bool, tick: int) -> None:
        """Wait for the tick, switch the output."""

    def mark(self, number: int) -> tuple[int, float] | None:
        """Return class (-1: unknown) and expected photoelectrons (NaN: unknown) of an object, None where neither is known."""

    def idle(self, ticks: int) -> bool:
        """Do a piece of work while nothing is due for so long; whether there was any."""
        return False


class Core:
    """The C core from power-on at `tick`: a `SteppedDevice`."""

    session = 0  # not known here

    def __init__(self, limits: Any, hardware: Hardware, tick: int, library: Path | None = None) -> None:
        self.tick = tick
        self._hardware, self._limits = hardware, limits
        self._error: BaseException | None = None
        self._why, self._out = b"", ctypes.create_string_buffer(ROOM)
        self._library = ctypes.CDLL(str(library or build_library()))
        for name, (result, words) in CALLS.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, (c_void_p, *words)
        self._library.pans_memory_bytes.restype = c_size_t
        self._library.pans_start.restype = c_void_p
        needed = self._library.pans_memory_bytes(ctypes.byref(limits))
        self._memory = (c_uint64 * (needed // 8 + 1))()
        self._functions = STRUCTURES["pans_hardware"](None, *map(self._kind_of, list(_HARDWARE)[1:]))
        blocks = (ctypes.byref(one) for one in (limits, self._functions, self._memory))
        start = *blocks, c_size_t(needed), c_uint64(tick)
        self._device = c_void_p(self._library.pans_start(*start) if needed else None)
        if not self._device:
            raise ConfigError("the C core cannot be what the profile says", remedy="see pans_limits in pans_device.h")

    def step(self, tick: int, data: bytes) -> bytes:
        """Advance to `tick`, digest `data` as having arrived then, and return what has been sent by then.

        Where nothing is to be sent and an edge is near, it follows: hardware waits for the tick itself.
        """
        sent = b""
        # The line takes all: what is due is taken at once, so that nothing waits in the buffer that the window lets out.
        while (due := self._call("pans_next_tick")) <= tick:
            self._call("pans_step", due, b"", 0)
            sent += self._take(due)
        self._call("pans_step", tick, data, len(data))
        tick = max(tick, self._hardware.now())  # later than it was, where an edge took time
        sent += self._take(tick)
        if not sent and self._call("pans_edge_tick") - self._hardware.lead_ticks <= tick:
            self._call("pans_edge")
            tick = max(tick, self._hardware.now())
            self._call("pans_step", tick, b"", 0)
            sent = self._take(tick)
        self.tick = tick
        return sent

    def next_event_tick(self) -> int | None:
        """Tick at which `step` has something to do; None: when bytes come."""
        due = self._call("pans_next_tick")
        edge = self._call("pans_edge_tick") - self._hardware.lead_ticks
        return None if due == NEVER else min(due, edge)

    def draw_ahead(self) -> bool:
        """See `SteppedDevice`."""
        due = self.next_event_tick()
        return self._hardware.idle(NEVER if due is None else due - self._hardware.now())

    def _take(self, tick: int) -> bytes:
        sent = b""
        while count := self._call("pans_output", tick, self._out, ROOM):
            sent += ctypes.string_at(self._out, count)
        return sent

    def _call(self, name: str, *words: Any) -> Any:
        result = getattr(self._library, name)(self._device, *words)
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        return result

    # -- called by the library

    def _kind_of(self, name: str) -> Any:
        kind, result = _HARDWARE[name], _HARDWARE[name]._restype_
        if name in ("read", "write", "hold"):  # the bytes are `step`'s, and no interrupt is to be kept away
            return kind()
        own: Callable[..., Any] = getattr(self, f"_{name}", None) or getattr(self._hardware, name)

        def call(_self: int, *words: Any) -> Any:
            try:
                return own(*words) if self._error is None or name == "dark" else result and 0
            except BaseException as error:  # through C it cannot pass: `_call` raises it
                self._error = self._error or error
                return result and 0

        return kind(call)

    def _store(self, piece: Any) -> None:
        if not piece:
            self._hardware.store(None)
            return
        one = piece.contents
        data = np.frombuffer(ctypes.string_at(one.data, (one.count + 7) // 8 if one.bits else 2 * one.count), np.uint8)
        levels = np.unpackbits(data, count=one.count, bitorder="little") if one.bits else data.view("<u2")
        self._hardware.store(PatternChunk(one.pattern, one.first, one.whole, levels.astype(np.uint16)))

    def _prepare(self, task: Any, why: Any) -> int:
        try:
            self._hardware.prepare(task.contents)
        except Refused as refusal:
            self._why = why[0] = refusal.text.encode()
            return int(refusal.status)
        return int(AckStatus.DONE)

    def _mark(self, number: int, truth: Any, photons: Any) -> bool:
        known = self._hardware.mark(number)
        if known is not None:
            truth[0], photons[0] = known
        return known is not None

    def _show(self, exposure: Any) -> None:
        self._hardware.show(exposure.contents)

    def _expose(self, exposure: Any) -> int:
        return self._hardware.expose(exposure.contents)

    def _clicks(self, word: Any, room: int) -> int:
        tick, clicks = self._hardware.clicks()
        packed = np.packbits(np.asarray(clicks, np.uint8), bitorder="little").tobytes()
        ctypes.memmove(word, packed, min(room, len(packed)))
        return tick


def limits_of(profile: Profile, facts: Mapping[str, str | int], *, firmware: str, serial: str, **words: Any) -> Any:
    """Return the limits of an instrument with this profile, and more keys of WELCOME; `words` are fields that are not the profile's."""
    hz, projector, exposure = profile.clock.tick_hz, profile.projector, profile.exposure
    parallel = profile.mode == "parallel"
    buffer = words.setdefault("buffer_messages", 256)
    fact = STRUCTURES["pans_fact"]
    known = [fact(key.encode(), of.encode() if isinstance(of, str) else None, of if isinstance(of, int) else 0)
             for key, of in facts.items()]  # fmt: skip
    return STRUCTURES["pans_limits"](
        tick_hz=hz,
        parallel=parallel,
        channels=profile.detector.channels,
        levels=projector.levels,
        pattern_memory=projector.pattern_memory,
        pattern_pixels=min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS),
        pixel_memory=MAX_UPLOAD_BYTES // 2,
        slot_memory=MAX_SLOTS,
        automaton_states=0 if parallel else projector.automaton_states,
        dwell_steps=0 if parallel else projector.dwell_steps,
        show_memory=0 if parallel else MAX_SHOWS,
        # a tick more or less is allowed for rounding, as by the simulator in Python
        exposure_min_ticks=max(1, round(exposure.min_us * hz / 1e6) - 1),
        exposure_max_ticks=round(exposure.max_us * hz / 1e6) + 1,
        readout_ticks=max(0, math.ceil(exposure.readout_us * hz / 1e6) - 1),
        pattern_ticks=max(0, math.ceil(hz / projector.pattern_rate_max_hz) - 1),
        turn_ticks=max(0, math.ceil(profile.timing.device_turn_us * hz / 1e6) - 1),
        buffer_bytes=min(buffer * (MAX_PAYLOAD_BYTES + MAX_PAYLOAD_BYTES // 254 + 64), 1 << 26),
        block_bytes=MAX_PAYLOAD_BYTES,
        payload_bytes=MAX_PAYLOAD_BYTES,
        port_bytes=1,  # pans_turn is not called
        pending_exposures=2,
        firmware=firmware.encode(),
        serial=serial.encode(),
        facts=(fact * len(known))(*known),
        n_facts=len(known),
        **words,
    )


# -- the library


def find_compiler() -> tuple[str, ...]:
    """Return the words that start a C compiler: the system's, or that of the `compiler` extra; none: ()."""
    found = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if found is None and importlib.util.find_spec("ziglang") is not None:
        return (sys.executable, "-m", "ziglang", "cc")
    return () if found is None else (found,)


def core_sources(folder: Path = FOLDER) -> list[Path]:
    """Return the C files of the core, which need nothing of a system."""
    return sorted(folder.glob("*.c"))


def build_library(folder: Path = FOLDER, cache: Path | None = None, flags: tuple[str, ...] = FLAGS) -> Path:
    """Return the core as a shared library; it is compiled where no build of these sources is in `cache`, by default the user's.

    ConfigError where others could put a library of their own there: it is loaded.
    """
    compiler, place = find_compiler(), "-fPIC" if os.name == "posix" else "-Wl,--export-all-symbols"
    digest = hashlib.sha256(" ".join((sys.platform, *flags)).encode())
    for path in sorted(folder.glob("*.[ch]")):
        digest.update(path.read_bytes())
    try:
        cache = own_folder(cache or user_cache() / "core")
    except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
        raise ConfigError(
            f"the C core cannot be kept: {error}", remedy="name a folder of your own: XDG_CACHE_HOME"
        ) from error
    target = cache / f"pans-core-{digest.hexdigest()[:20]}.{'so' if os.name == 'posix' else 'dll'}"
    if target.is_file():
        return target
    if not compiler:
        raise ConfigError("no C compiler was found, and the core is C", remedy=install("compiler"))
    with tempfile.TemporaryDirectory(dir=cache) as made:
        library = Path(made) / target.name
        words = [*compiler, *flags, "-shared", place, *map(str, core_sources(folder)), "-o", str(library)]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            raise ConfigError(f"the C core did not compile: {done.stderr[:500]}", remedy=f"try {compiler[0]} by itself")
        library.replace(target)
    return target
