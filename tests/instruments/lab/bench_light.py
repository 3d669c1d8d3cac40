"""The optical table of the stand-ins ALP4 and Swabian.TimeTagger: lamp, mirrors, object, detector and cables, in real time.

Both libraries share one of it, as both devices stand on one table. Photons are drawn from a generator of its own: for each display a
Poisson number of clicks at uniform times. The tagger's clock is not the computer's: it has an offset and runs fast.
`PANS_TABLE` sets fields in JSON; the file named in `unplug` pulls the cable of what it names: alp or tagger.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np

SCENE = Path(__file__).parents[3] / "firmware_sim/pans_sim/scenes" / "fashion200.npz"
DRIFT_PPM, OFFSET_PS = 40, 7_000_000_000_000
SYNCH_V = CLICK_V = 2.5


class Table:
    """What is on the table; times are ps of the tagger's clock."""

    size = (768, 1024)
    peak_hz = 3000.0
    dark_hz = 25.0
    delay_us = (150.0, 400.0)  # from the command to the light
    seed = 1
    unplug = ""
    pixels = 28  # of an object's side

    def __init__(self) -> None:
        for name, value in json.loads(os.environ.get("PANS_TABLE", "{}")).items():
            setattr(self, name, value)
        with np.load(SCENE) as scene:
            self.images, self.labels = scene["images"] / 255.0, scene["labels"]
        if self.pixels != 28:  # a lab's own small objects
            self.images = np.random.default_rng(2).random((200, self.pixels, self.pixels))
            self.labels = np.arange(200) % 3
        self.object = 0
        self._dice = np.random.default_rng(self.seed)
        self._darkness = np.random.default_rng(self.seed + 1)
        self._zero_ns = time.perf_counter_ns()
        self._dark_to = self.now()
        self.busy_to = 0  # end of the last display
        self.events: list[tuple[int, str]] = []

    def now(self) -> int:
        since = time.perf_counter_ns() - self._zero_ns
        return OFFSET_PS + since * 1000 + since * DRIFT_PPM // 1000

    def is_plugged(self, what: str) -> bool:
        return not (self.unplug and Path(self.unplug).exists() and what in Path(self.unplug).read_text())

    def display(self, picture: np.ndarray, light_us: float) -> None:
        """Show `picture`, float (rows, columns) from 0 to 1, once: as soon as the mirrors are free."""
        start = max(self.now(), self.busy_to) + round(self._dice.uniform(*self.delay_us) * 1e6)
        self.busy_to = start + round(light_us * 1e6)
        side = min(self.size) // self.pixels * self.pixels
        top, left = (self.size[0] - side) // 2, (self.size[1] - side) // 2
        seen = picture[top : top + side, left : left + side].reshape(self.pixels, side // self.pixels, self.pixels, -1)
        mean = float((seen.mean(axis=(1, 3)) * self.images[self.object]).sum()) * self.peak_hz * light_us * 1e-6
        clicks = start + self._dice.random(self._dice.poisson(mean)) * (self.busy_to - start)
        self.events += [(start, "rise"), (self.busy_to, "fall"), *((int(at), "click") for at in clicks)]

    def dark(self) -> None:
        """Stop a display: light that has not come by now does not come, and its synch pulse ends."""
        now = self.now()
        if now < self.busy_to:
            self.busy_to = now
            self.events = [event for event in self.events if event[0] < now] + [(now, "fall")]

    def take(self, until: int) -> list[tuple[int, str]]:
        """Return what happened up to `until`, in order, and forget it."""
        if until > self._dark_to:
            number = self._darkness.poisson(self.dark_hz * (until - self._dark_to) * 1e-12)
            at = self._dark_to + self._darkness.random(number) * (until - self._dark_to)
            self.events += [(int(one), "click") for one in at]
            self._dark_to = until
        here = sorted(event for event in self.events if event[0] < until)
        self.events = [event for event in self.events if event[0] >= until]
        return here


TABLE = Table()


class Shelf:
    """The objects of the scene in their order: for `--objects bench_light:Shelf`."""

    simulated = True

    def __init__(self, profile: object) -> None:
        pass

    def place(self, number: int) -> int:
        TABLE.object = number % len(TABLE.images)
        return int(TABLE.labels[TABLE.object])
