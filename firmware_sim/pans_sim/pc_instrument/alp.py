"""A micromirror device with a controller of ViALUX, through ALP4lib 1.1.0 (https://github.com/wavefrontshaping/ALP4lib).

All patterns are one sequence in the controller's memory. An exposure shows one picture of it once: in normal mode mirrors are off
before and after (AlpSeqTiming). The frame synch output is high while it is shown, and says when that was.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError, LinkError
from pans.instrument.profile import Profile
from pans.protocol.wire import AckStatus
from pans_sim.device.upload import Refused

REMEDY = "check its power and its USB cable, then start `pans instrument` again"


class Alp:
    """The projector `alp`. version, folder: of the vendor's library; serial: 0 for the first device; width: of a pattern, 0: square.

    A pattern is shown in the middle, each of its pixels as a square of mirrors. With 2 levels a picture is one bit, else 8 bits.
    """

    def __init__(
        self,
        profile: Profile,
        version: str = "4.3",
        folder: str = "",
        serial: int = 0,
        width: int = 0,
        shortest_us: float = 0.0,
    ) -> None:
        import ALP4

        self._library, self._width = ALP4, width
        projector = profile.projector
        self._levels, self._shown, self._timed = projector.levels, projector.pattern_memory, 0
        with contextlib.redirect_stdout(sys.stderr):  # the library prints; stdout is the command's
            self._device = self._told(lambda: ALP4.ALP4(version=version, libDir=folder or None), "load the library")
            self._told(lambda: self._device.Initialize(serial or None), "open")
        self._size = self._device.nSizeY, self._device.nSizeX
        found, stated = (
            f"{self._device.nSizeX} x {self._device.nSizeY}",
            f"{projector.width_px} x {projector.height_px}",
        )
        if found != stated:
            raise ConfigError(
                f"{profile.name}: projector has {stated} pixels, the DMD {found}", remedy="correct the profile"
            )
        if self._levels > 256:
            raise ConfigError(f"{profile.name}: projector.levels is {self._levels}, a DMD shows 2 to 256")
        depth, memory = 1 if self._levels == 2 else 8, self._inquire(ALP4.ALP_AVAIL_MEMORY)
        self.shortest_us = shortest_us or (10.0 if depth == 1 else 3400.0)
        self.serial = f"ALP-{self._inquire(ALP4.ALP_DEVICE_NUMBER)}"
        if projector.pattern_memory * depth > memory:
            what = f"{profile.name}: projector.pattern_memory is {projector.pattern_memory}"
            raise ConfigError(f"{what}, the DMD's memory holds {memory // depth}", remedy="correct the profile")
        self._sequence = self._told(lambda: self._device.SeqAlloc(projector.pattern_memory, depth), "allocate patterns")
        self._control(ALP4.ALP_SEQ_REPEAT, 1)

    def load(self, number: int, levels: NDArray[np.uint16]) -> None:
        width = self._width or math.isqrt(len(levels))
        height, rest = divmod(len(levels), width)
        scale = min(self._size[0] // height, self._size[1] // width) if height else 0
        if rest or not scale:
            words = f"a pattern of {len(levels)} pixels: rows of {width} pixels on {self._size[1]} x {self._size[0]} mirrors"
            raise Refused(AckStatus.OUT_OF_RANGE, words)
        bright = np.rint(levels.reshape(height, width) * (255 / (self._levels - 1))).astype(np.uint8)
        picture = np.zeros(self._size, np.uint8)
        top, left = (self._size[0] - scale * height) // 2, (self._size[1] - scale * width) // 2
        enlarged = bright.repeat(scale, 0).repeat(scale, 1)
        picture[top : top + scale * height, left : left + scale * width] = enlarged
        self._told(lambda: self._device.SeqPut(picture.ravel(), self._sequence, number, 1), "load a pattern")

    def show(self, number: int, light_us: float) -> None:
        """See `Projector`; light in whole microseconds."""
        both = [self._library.ALP_FIRSTFRAME, self._library.ALP_LASTFRAME]
        for frame in both if number < self._shown else reversed(both):  # the first is never behind the last
            if number != self._shown:
                self._control(frame, number)
        if round(light_us) != self._timed:
            self._told(
                lambda: self._device.SetTiming(self._sequence, illuminationTime=round(light_us)),
                "set the time of light",
            )
        self._shown, self._timed = number, round(light_us)

    def start(self) -> None:
        self._told(lambda: self._device.Run(self._sequence, loop=False), "show a pattern")

    def dark(self) -> None:
        self._told(lambda: self._device.Halt(), "go dark")

    def check(self) -> None:
        self._inquire(self._library.ALP_DEV_STATE)

    def close(self) -> None:
        """Go dark and free the device."""
        with contextlib.suppress(LinkError):
            self.dark()
            self._told(lambda: self._device.FreeSeq(self._sequence), "free memory")
        with contextlib.suppress(LinkError):
            self._told(lambda: self._device.Free(), "close")

    def _inquire(self, what: int) -> int:
        return int(self._told(lambda: self._device.DevInquire(what), "answer"))

    def _control(self, what: int, value: int) -> None:
        self._told(lambda: self._device.SeqControl(what, value, self._sequence), "choose a pattern")

    def _told(self, call: Callable[[], Any], what: str) -> Any:
        try:
            return call()
        except (self._library.ALPError, OSError, ValueError, KeyError) as error:  # KeyError: a code without words
            raise LinkError(f"the DMD could not {what}: {error}", remedy=REMEDY) from error
