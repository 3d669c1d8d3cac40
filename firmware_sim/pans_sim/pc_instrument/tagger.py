"""A Time Tagger of Swabian Instruments, through its Python client 2.22.6 (https://www.swabianinstruments.com/static/documentation/TimeTagger).

The instrument's clock is the tagger's. The projector's synch output is tagged at both edges: when the light of every exposure began and
ended. Clicks are counted between tags, so that what is late in the computer changes no count.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pans.base.errors import LinkError
from pans.instrument.profile import Profile

from . import SteeredClock

PS = 10**12
MAX_TAGS = 1 << 20  # between two readings
BLOCK_TAGS = 1 << 17  # of the stream, the client's default
PATIENCE_NS = 1_000_000_000
FIRST_PROBES = 20
LOOK_EVERY_S = 50e-6
REMEDY = "check its power and its cable, then start `pans instrument` again"


class Tagger:
    """The counter `tagger`. serial: "" for the first device; server: HOST:PORT of a tagger's server; clicks, synch: input channels.

    Levels in volts, the latency of the tag stream in whole milliseconds.
    """

    def __init__(
        self, profile: Profile, serial: str = "", server: str = "", clicks: int = 1, synch: int = 2,
        click_level_v: float = 0.5, synch_level_v: float = 0.5, latency_ms: int = 1,
    ) -> None:  # fmt: skip
        from Swabian import TimeTagger

        self._library, self._hz, self._clicks, self._synch = TimeTagger, profile.clock.tick_hz, clicks, synch
        self.clock = SteeredClock(self._hz)
        self._times, self._channels = np.zeros(0, np.int64), np.zeros(0, np.int32)
        self._position = self._counted = 0  # ps up to which tags have come, and up to which they are done with
        make = TimeTagger.createTimeTaggerNetwork if server else TimeTagger.createTimeTagger
        self._tagger = self._told(lambda: make(*filter(None, (server or serial,))))
        self._told(lambda: self._tagger.setTriggerLevel(clicks, click_level_v))
        self._told(lambda: self._tagger.setTriggerLevel(synch, synch_level_v))
        if not server:  # of a server, who started it
            self._told(lambda: self._tagger.setStreamBlockSize(max_events=BLOCK_TAGS, max_latency=latency_ms))
        self.serial = self._told(lambda: self._tagger.getSerial())
        self._fell = self._tagger.getInvertedChannel(synch)
        channels = [clicks, synch, self._fell]
        self._stream = self._told(lambda: TimeTagger.TimeTagStream(self._tagger, MAX_TAGS, channels))
        probes = [self._probe() for _ in range(FIRST_PROBES)]
        self.clock.steer(*min(probes, key=lambda one: one[2] - one[0]))

    def light_on(self) -> int:
        self._rose = self._edge(self._synch, self._counted, "begin", self._read)
        return self._tick(self._rose)

    def count(self, began: int, ticks: int, light_ticks: int) -> tuple[int, int]:
        start = self._rose if light_ticks else -(-began * PS // self._hz)
        end = start + ticks * PS // self._hz
        light = light_ticks
        self.clock.wait(began + ticks)
        self._until(lambda: self._position >= end, "no tags have come", self._steer)
        if light_ticks:
            light = self._tick(self._edge(self._fell, start, "end", self._steer)) - began
        here = (self._channels == self._clicks) & (self._times >= start) & (self._times < end)
        self._counted = max(end, start + light * PS // self._hz)
        later = self._times > self._counted
        self._times, self._channels = self._times[later], self._channels[later]
        return int(here.sum()), light

    def check(self) -> None:
        self._steer()
        self._times, self._channels = self._times[:0], self._channels[:0]
        self._counted = self._position

    def close(self) -> None:
        """Free the device."""
        self._library.freeTimeTagger(self._tagger)

    def _tick(self, ps: int) -> int:
        return ps * self._hz // PS

    def _probe(self) -> tuple[int, int, int]:
        """Ask for all tags up to now: a time before, the tick that the stream is at then, a time after."""
        before = time.perf_counter_ns()
        if not self._told(lambda: self._tagger.sync(timeout=PATIENCE_NS // 10**6)):
            raise LinkError("the time tagger does not answer", remedy=REMEDY)
        self._read()
        return before, self._tick(self._position), time.perf_counter_ns()

    def _edge(self, channel: int, after: int, what: str, read: Callable[[], None]) -> int:
        """Wait for a tag of `channel` after `after` ps."""

        def found() -> Any:
            return self._times[(self._channels == channel) & (self._times > after)]

        self._until(lambda: bool(found().size), f"no {what} of a synch pulse has come on channel {self._synch}", read)
        return int(found()[0])

    def _until(self, done: Callable[[], bool], what: str, read: Callable[[], None]) -> None:
        deadline = time.perf_counter_ns() + PATIENCE_NS
        while not done():
            if time.perf_counter_ns() > deadline:
                remedy = (
                    "check the projector's synch output, its cable and synch_level_v, and the time tagger's own cable"
                )
                raise LinkError(f"the time tagger: {what} for 1 s", remedy=remedy)
            before = self._position
            read()
            if self._position == before:
                time.sleep(LOOK_EVERY_S)

    def _steer(self) -> None:
        self.clock.steer(*self._probe())

    def _read(self) -> None:
        data: Any = self._told(lambda: self._stream.getData())
        if data.hasOverflows or data.size >= MAX_TAGS:
            remedy = "less light on the detector, or a higher trigger level"
            raise LinkError("the time tagger has lost tags: more came than it can tell", remedy=remedy)
        self._position = max(self._position, int(data.tGetData))
        if data.size:
            self._times = np.concatenate([self._times, data.getTimestamps()])
            self._channels = np.concatenate([self._channels, data.getChannels()])

    def _told(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except (RuntimeError, ValueError, OSError) as error:
            raise LinkError(f"the time tagger: {error}", remedy=REMEDY) from error
