"""What the reference instrument says when it needs light: lines of text with bytes behind them, and one line back.

Owns the words of these requests (firmware_sim/reference/posix/light.c sends them); never computes light and never touches a pipe.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.device.upload import MAX_PATTERN_PIXELS, PatternMemory, Refused
from pans.firmware_sim.device.view import View
from pans.runtime.wire.messages import AckStatus

from .light import LightService, TooMuchLight

STATE_ROW_BYTES = 20


def light_desk(view: View, folder: Path) -> LightDesk:
    """Return the desk of a device that looks at `view`; its files go to `folder`."""
    projector = view.profile.projector
    if view.profile.mode == "sequential":
        from pans.firmware_sim.device import walk_kernels

        walk_kernels.warm_up()  # a host that has sent states must not wait for a compiler
    pixels = min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS)
    return LightDesk(LightService(view, PatternMemory(projector.pattern_memory, pixels, projector.levels), folder))


class LightDesk:
    """Takes requests one after another, in the order in which the device made them."""

    def __init__(self, service: LightService) -> None:
        self._light = service

    def take(self, line: bytes, requests: IO[bytes]) -> str | None:
        """Serve the request that begins with `line` and goes on in `requests`; return the answer's line, if it asks for one.

        ValueError when the request is cut short or no request.
        """
        word, *numbers = line.split()
        if word == b"forget":
            self._light.forget()
            return None
        if word == b"pixels":
            pattern, first, whole, count, bits = map(int, numbers)
            data = _exactly(requests, (count + 7) // 8 if bits else 2 * count)
            self._light.pixels(pattern, first, whole, count, data if bits else None, data)
            return None
        if word == b"light":
            n_patterns, exposure_ticks, adaptive, n_states = map(int, numbers)
            rows = np.frombuffer(_exactly(requests, STATE_ROW_BYTES * n_states), np.uint32).reshape(n_states, 5)
            return self._table(n_patterns, exposure_ticks, bool(adaptive), rows)
        raise ValueError(f"not a request for light: {line[:60]!r}")

    def _table(self, n_patterns: int, exposure_ticks: int, adaptive: bool, rows: NDArray[np.uint32]) -> str:
        try:
            return f"table {self._light.table(n_patterns, exposure_ticks, adaptive, rows)}"
        except Refused as refusal:
            return f"refused {int(refusal.status)} {refusal.text}"
        except TooMuchLight as error:
            return f"refused {int(AckStatus.OUT_OF_RANGE)} {error}"


def _exactly(pipe: IO[bytes], count: int) -> bytes:
    data = pipe.read(count)
    if len(data) != count:
        raise ValueError("the reference instrument broke off in a request")
    return data
