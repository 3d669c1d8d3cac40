"""The reference instrument in this process: bytes and ticks in, bytes out, as the simulator's own instrument.

Owns the library's handle and its output buffer; never reads a clock. What `VirtualLink` and the shells need of a device is here, so that
the C core stands wherever the Python one does.
"""

from __future__ import annotations

import ctypes
import io
import tempfile
from pathlib import Path

from pans.firmware_sim.device.view import View
from pans.firmware_sim.ports.on_table import scene_on_table
from pans.firmware_sim.ports.serve import SimOptions
from pans.firmware_sim.scene.moving import SceneFile
from pans.runtime.instrument.profile import Profile, load_profile

from .build import engine_library
from .requests import light_desk
from .settings import settings_text

ROOM = 1 << 18  # of output that is taken at once
NEVER = (1 << 64) - 1
_ANSWER = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t)


class SteppedEngine:
    """The C core from power-on at `tick`, with the profile and scene of `options` or those given; not for several threads."""

    def __init__(
        self,
        options: SimOptions,
        tick: int = 0,
        *,
        profile: Profile | None = None,
        scene: SceneFile | None = None,
        library: Path | None = None,
    ) -> None:
        profile = profile or load_profile(options.profile)
        scene = scene or scene_on_table(options.scene, options.changes, options.optics, profile)
        text = settings_text(options, profile, scene)
        view = View(profile, scene, None, options.seed)
        view.check_and_warm_up()
        self._folder = tempfile.TemporaryDirectory(prefix="pans-engine-")
        self._desk = light_desk(view, Path(self._folder.name))
        self._library = _load(library or engine_library())
        self._answer = _ANSWER(self._ask)  # kept: the library calls it
        self._error: BaseException | None = None
        self._tick, self.session = tick, 0
        self._out = ctypes.create_string_buffer(ROOM)
        self._handle = self._library.instrument_open(text.encode(), self._answer, tick)

    @property
    def tick(self) -> int:
        """Device time of the latest step."""
        return self._tick

    def step(self, tick: int, data: bytes) -> bytes:
        """Advance to `tick` (never back), digest `data` as having arrived then, and return all bytes sent by then."""
        if tick < self._tick:
            raise ValueError(f"device time cannot go back: at {self._tick}, asked for {tick}")
        self._tick = tick
        sent = b""
        # The line takes all: what is due is taken at once, so that nothing waits in the buffer that the window lets out.
        while (due := self._library.instrument_next_tick(self._handle)) <= tick:
            self._library.instrument_step(self._handle, due, b"", 0)
            sent += self._take(due)
        self._library.instrument_step(self._handle, tick, data, len(data))
        self._raise()
        return sent + self._take(tick)

    def next_event_tick(self) -> int | None:
        """Tick at which the device does something by itself next; None when it only waits for the host."""
        due = int(self._library.instrument_next_tick(self._handle))
        return None if due == NEVER else due

    def draw_ahead(self) -> bool:
        """Nothing: clicks are drawn when an exposure ends."""
        return False

    def close(self) -> None:
        """Free the device; idempotent."""
        if self._handle:
            self._library.instrument_close(self._handle)
            self._handle = None
            self._folder.cleanup()

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self.close()

    def _take(self, tick: int) -> bytes:
        sent = b""
        while count := self._library.instrument_output(self._handle, tick, self._out, ROOM):
            sent += self._out.raw[:count]
        return sent

    def _ask(self, request: int, count: int, line: int, room: int) -> None:
        """Answer the library's requests; the last of them is the one that waits for a line."""
        answer = None
        try:
            requests = io.BytesIO(ctypes.string_at(request, count))
            while words := requests.readline():
                answer = self._desk.take(words, requests)
            text = (answer or "").encode()
        except Exception as error:  # through C it cannot pass: it comes up again in `step`
            self._error, text = error, b"refused 4 no light could be computed"
        ctypes.memmove(line, text[: room - 1] + b"\0", min(len(text), room - 1) + 1)

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error


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
