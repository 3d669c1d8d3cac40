"""A stand-in of Swabian-TimeTagger 2.22.6 by its public interface, on the table of bench_light: clicks on 1, synch on 2.

Tags come in blocks, as late as the stream's latency says (20 ms unless set); `sync` waits for all up to now. An input whose level is above
the pulse sees nothing. A device that is pulled falls silent: the stream's position stands still, and `sync` fails after its time.
"""

from __future__ import annotations

import time

import numpy as np
from bench_light import CLICK_V, SYNCH_V, TABLE

CHANNEL_UNUSED = -134217728
INPUTS = {"click": (1, CLICK_V), "rise": (2, SYNCH_V), "fall": (-2, SYNCH_V)}
FENCE_S = 300e-6
_open: list[TimeTagger] = []


class TimeTagger:
    def __init__(self) -> None:
        self._levels, self._latency_ps, self._streams = dict.fromkeys(range(1, 9), 0.5), 20_000_000_000, []
        self._position = TABLE.now()

    def getSerial(self) -> str:
        self._ready()
        return "1234567ABC"

    def setTriggerLevel(self, channel: int, voltage: float) -> None:
        self._ready()
        if channel not in self._levels or not -2.5 <= voltage <= 2.5:
            raise ValueError(f"channel {channel}, {voltage} V")
        self._levels[channel] = voltage

    def setStreamBlockSize(self, max_events: int, max_latency: int) -> None:
        self._ready()
        if not 4096 <= max_events <= 1 << 25 or not 1 <= max_latency <= 10_000:
            raise ValueError("out of range")
        self._latency_ps = max_latency * 10**9

    def getInvertedChannel(self, channel: int) -> int:
        self._ready()
        return -channel if abs(channel) in self._levels else CHANNEL_UNUSED

    def sync(self, timeout: int = -1) -> bool:
        self._ready()
        if not TABLE.is_plugged("tagger"):
            time.sleep(timeout * 1e-3)
            return False
        time.sleep(FENCE_S)
        self._advance(TABLE.now())
        return True

    def _ready(self) -> None:
        if self not in _open:
            raise RuntimeError("the time tagger has been freed")

    def _advance(self, until: int) -> None:
        """Hand what happened by `until` to all measurements."""
        if until <= self._position or not TABLE.is_plugged("tagger"):
            return
        self._position = until
        tags = [(at, *INPUTS[what]) for at, what in TABLE.take(until)]
        for stream in self._streams:
            stream._tags += [(at, channel) for at, channel, volts in tags if channel in stream._channels
                             and self._levels[abs(channel)] < volts]  # fmt: skip


class TimeTagStreamBuffer:
    def __init__(self, tags: list[tuple[int, int]], position: int) -> None:
        self._tags, self.size, self.hasOverflows, self.tGetData = tags, len(tags), False, position

    def getTimestamps(self) -> np.ndarray:
        return np.array([at for at, _ in self._tags], np.int64)

    def getChannels(self) -> np.ndarray:
        return np.array([channel for _, channel in self._tags], np.int32)


class TimeTagStream:
    def __init__(self, tagger: TimeTagger, n_max_events: int, channels: list[int]) -> None:
        tagger._ready()
        if any(abs(channel) not in tagger._levels for channel in channels):
            raise ValueError(f"no such channel among {channels}")
        self._tagger, self._channels, self._most, self._tags = tagger, set(channels), n_max_events, []
        tagger._streams.append(self)

    def getData(self) -> TimeTagStreamBuffer:
        self._tagger._ready()
        latency = self._tagger._latency_ps
        self._tagger._advance(TABLE.now() // latency * latency)  # a block is handed over when its time is over
        tags, self._tags = self._tags[: self._most], []
        return TimeTagStreamBuffer(tags, self._tagger._position)


def createTimeTagger(serial: str = "") -> TimeTagger:
    if not TABLE.is_plugged("tagger") or _open:
        raise RuntimeError("No Time Tagger attached or already in use")
    _open.append(TimeTagger())
    return _open[-1]


def createTimeTaggerNetwork(address: str = "localhost:41101") -> TimeTagger:
    return createTimeTagger()


def freeTimeTagger(tagger: TimeTagger) -> None:
    if not isinstance(tagger, TimeTagger):
        raise TypeError("in method 'freeTimeTagger', argument 1 of type 'TimeTaggerBase'")
    _open.remove(tagger)
