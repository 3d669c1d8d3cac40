"""A projector and a counter of a lab as one instrument, on a clock that the counter keeps right: what `pans instrument` serves.

A lab's own adapters are classes like `Projector`, `Counter` and `Objects`, made from the profile and settings by name, with `close` where
that is needed; `alp` and `tagger` are two. They join through the entry points `pans.projectors`, `pans.counters`, `pans.objects`, or are
named as module:Class. `core` runs the C core of firmware_sim/pans_sim/reference over them.
"""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pans.base.console import load_offered
from pans.base.errors import ConfigError, LinkError, PansError, UsageError
from pans.instrument.profile import Profile
from pans.protocol.wire import DARK_PATTERN, PatternChunk
from pans_sim.device.upload import Refused

from .core import Hardware

SPIN_NS = 300_000  # a sleep ends late by about a tenth of this: the rest is waited for awake
AHEAD_NS = 300_000  # how much earlier than needed an exposure is attended to
GAIN = 1 / 64  # of what the clock is found to be wrong by
USUAL = 1.5  # times the shortest time of an answer: what took longer says little
EARLIEST_NS = 200_000  # kept free below a projector's least delay: no exposure may begin before its tick
LEARN = 16  # displays before any is started ahead of its tick
RISE = 1 / 1024  # of the way from the least delay to that of an exposure
CHECK_NS, CHECK_WITHIN_NS = (
    1_000_000_000,
    50_000_000,
)  # how often an idle instrument is looked at, and the time that takes at most


class SteeredClock:
    """The instrument's ticks by this computer's clock, moved towards another clock; `tick_hz` ticks per second."""

    def __init__(self, tick_hz: int) -> None:
        self._hz, self._offset, self._last, self._width_ns = tick_hz, 0.0, 0, math.inf

    def tick_at(self, host_ns: int) -> int:
        """The tick at `time.perf_counter_ns()` = host_ns; it never goes back."""
        self._last = max(self._last, host_ns * self._hz // 10**9 + round(self._offset))
        return self._last

    def host_ns_at(self, tick: int) -> int:
        """The first nanosecond of `tick`, by what is known now."""
        return -(-(tick - round(self._offset)) * 10**9 // self._hz)

    def steer(self, before_ns: int, tick: int, after_ns: int) -> None:
        """Learn that it was `tick` at some time between the two, of which the middle is taken, unless it took longer than usual."""
        width, first = after_ns - before_ns, self._width_ns == math.inf
        self._width_ns = min(width, self._width_ns * (1 + GAIN))
        if width <= USUAL * self._width_ns:
            error = tick - (before_ns + after_ns) // 2 * self._hz / 10**9 - self._offset
            self._offset += error * (1.0 if first else GAIN)

    def wait(self, tick: int, early_ns: int = 0) -> None:
        """Return `early_ns` before `tick`; it sleeps, and spins at the end."""
        while (left := self.host_ns_at(tick) - early_ns - time.perf_counter_ns()) > 0:
            if left > SPIN_NS:
                time.sleep((left - SPIN_NS) * 1e-9)


class Projector(Protocol):
    """What shows patterns; LinkError where it is gone.

    `load` keeps a pattern, uint16 (pixels,) of the profile's levels, or raises `Refused`. `show` gets ready to show one for so long;
    `start` shows it as soon as it can and returns at once. It goes dark by itself, or at once by `dark`. `check` tells whether it is there.
    """

    shortest_us: float  # light that it can show

    def load(self, number: int, levels: NDArray[np.uint16]) -> None: ...

    def show(self, number: int, light_us: float) -> None: ...

    def start(self) -> None: ...

    def dark(self) -> None: ...

    def check(self) -> None: ...


class Counter(Protocol):
    """What counts clicks and knows when light was; ticks are those of its `clock`, which it steers. LinkError where it is gone.

    `light_on` waits for the light that the projector was told of: the tick at which it came. `count` waits until `ticks` after `began` are
    over; it returns the clicks in them, and for how many ticks the light was on, which should be `light_ticks` (0 of the dark).
    """

    clock: SteeredClock

    def light_on(self) -> int: ...

    def count(self, began: int, ticks: int, light_ticks: int) -> tuple[int, int]: ...

    def check(self) -> None: ...


class Objects(Protocol):
    """What brings objects before the detector: `place` brings one by its number since ARM, and returns its class or -1."""

    def place(self, number: int) -> int: ...


PROTOCOLS: dict[str, Any] = {"projectors": Projector, "counters": Counter, "objects": Objects}
MEMBERS: dict[
    str, dict[str, tuple[str, Callable[[Any], bool]]]
] = {  # by kind: a member that is no method, what it is, and whether it is
    "projectors": {
        "shortest_us": (
            "a number of microseconds, from 0: the shortest light that it can show",
            lambda us: isinstance(us, Real) and not isinstance(us, bool) and 0 <= float(us) < math.inf,
        )
    },
    "counters": {
        "clock": (
            "a pans_sim.pc_instrument.SteeredClock, of the profile's ticks",
            lambda clock: isinstance(clock, SteeredClock),
        )
    },
    "objects": {},
}


class Apparatus(Hardware):
    """A projector and a counter as the hardware of the C core."""

    def __init__(
        self, profile: Profile, projector: Projector, counter: Counter, objects: Objects | None = None
    ) -> None:
        self._projector, self._counter, self._objects = projector, counter, objects
        self._hz, self.clock = profile.clock.tick_hz, counter.clock
        self._parts: dict[int, NDArray[np.uint16]] = {}  # patterns that have not come as a whole
        self._refusal: Refused | None = None
        self._lit = self._exposing = False
        self._place: tuple[int, int] | None = None  # number and class of the object
        self._delay_ns, self._displays = math.inf, 0  # the least delay of the projector, of so many displays
        self._checked_ns = 0
        shortest = profile.exposure.min_us / max(1, profile.projector.dwell_steps)
        if shortest < projector.shortest_us:
            what = f"{profile.name}: exposure.min_us / projector.dwell_steps is {shortest:g}"
            raise ConfigError(f"{what}, this projector shows light of {projector.shortest_us:g} us at least")
        if profile.mode != "sequential" or profile.detector.channels != 1:
            what = f"{profile.name}: mode {profile.mode}, {profile.detector.channels} channels"
            raise ConfigError(f"{what}: here patterns follow each other before one detector", remedy="see dmd-spad")

    @property
    def lead_ticks(self) -> int:  # type: ignore[override]
        """Ahead of light only: what ends is known from the counter."""
        ahead = self._lit and not self._exposing
        return (self._early_ns() + AHEAD_NS) * self._hz // 10**9 if ahead else 0

    def _early_ns(self) -> int:
        return max(0, round(self._delay_ns) - EARLIEST_NS) if self._displays >= LEARN else 0

    def now(self) -> int:
        return self.clock.tick_at(time.perf_counter_ns())

    def store(self, chunk: PatternChunk | None) -> None:
        if chunk is None:
            self._parts, self._refusal = {}, None
            return
        if chunk.first_pixel == 0:
            self._parts[chunk.pattern] = np.zeros(chunk.n_pixels, np.uint16)
        end = chunk.first_pixel + len(chunk.levels)
        self._parts[chunk.pattern][chunk.first_pixel : end] = chunk.levels
        if end == chunk.n_pixels:
            try:
                self._projector.load(chunk.pattern, self._parts.pop(chunk.pattern))
            except Refused as refusal:  # ARM tells it
                self._refusal = refusal

    def prepare(self, task: Any) -> None:
        if self._refusal is not None:
            raise self._refusal
        self._place = None

    def show(self, exposure: Any) -> None:
        self._lit = exposure.light.pattern != DARK_PATTERN
        if self._objects is not None and (self._place is None or self._place[0] != exposure.object):
            self._place = exposure.object, self._objects.place(exposure.object)
        if self._lit:
            self._projector.show(exposure.light.pattern, exposure.light.ticks * 1e6 / self._hz)

    def expose(self, exposure: Any) -> int:
        self._exposing, self._ticks, self._began = True, exposure.ticks, exposure.tick
        self._light = 0 if exposure.light.pattern == DARK_PATTERN else exposure.light.ticks
        if self._light:
            self.clock.wait(exposure.tick, self._early_ns())
            told = time.perf_counter_ns()
            self._projector.start()
            self._began = self._counter.light_on()
            delay = self.clock.host_ns_at(self._began) - told
            risen = self._delay_ns + RISE * (delay - self._delay_ns) if self._displays else math.inf
            self._delay_ns, self._displays = min(delay, risen), self._displays + 1
        return self._began

    def clicks(self) -> tuple[int, Any]:
        clicks, light = self._counter.count(self._began, self._ticks, self._light)
        self._exposing = self._lit = False  # an exposure that the host has not named is not shown
        if abs(light - self._light) > self._light // 50 + 2 * self._hz // 10**6:
            found, asked = (f"{one * 1e6 / self._hz:g} us" for one in (light, self._light))
            remedy = "compare the synch output's polarity and pulse width on an oscilloscope"
            raise LinkError(f"the light was on for {found}, asked for were {asked}", remedy=remedy)
        # What was longer or shorter is the light; clicks are those of the exposure as it was asked for.
        return self._began + self._ticks + light - self._light, [clicks > 0]

    def dark(self) -> None:
        self._lit = self._exposing = False
        self._projector.dark()

    def mark(self, number: int) -> tuple[int, float] | None:
        if self._place is None or self._place[0] != number:
            return None
        return self._place[1], math.nan

    def idle(self, ticks: int) -> bool:
        now = time.perf_counter_ns()
        if self._exposing or now - self._checked_ns < CHECK_NS or ticks * 10**9 // self._hz < CHECK_WITHIN_NS:
            return False
        self._projector.check()
        self._counter.check()
        self._checked_ns = time.perf_counter_ns()
        return True


def adapter_names(kind: str) -> list[str]:
    """Return the names of the adapters of `kind`: projectors, counters or objects."""
    return sorted(point.name for point in entry_points(group=f"pans.{kind}"))


def make_adapter(kind: str, text: str, profile: Profile) -> Any:
    """Make the adapter that `text` names: NAME or module:Class, and ,setting=value of its own; UsageError for what there is not."""
    name, *pairs = text.split(",")
    known = {point.name: point for point in entry_points(group=f"pans.{kind}")}
    if name not in known and ":" not in name:
        remedy = f"known: {', '.join(known)}, or module:Class"
        raise UsageError(f"there is none of the {kind} called {name!r}", remedy=remedy)
    make = load_offered(known.get(name) or EntryPoint(name, name, f"pans.{kind}"))
    if not callable(make):
        raise UsageError(
            f"{name} is a {type(make).__name__}, allowed: a class that is made from the profile and settings"
        )
    defaults = {one.name: one.default for one in list(inspect.signature(make).parameters.values())[1:]}
    settings = {}
    for pair in pairs:
        key, _, value = pair.partition("=")
        try:
            settings[key] = type(defaults[key])(value)
        except (KeyError, ValueError) as error:
            words = "they are " + ", ".join(f"{one}={usual!r}" for one, usual in defaults.items())
            raise UsageError(f"{name}: {pair!r} is no setting", remedy=words) from error
    try:
        made = make(profile, **settings)
    except (PansError, OSError, ImportError):  # what is not there, in words of its own
        raise
    except Exception as error:
        what = f"{name}: its class, called with the profile and settings, raised {type(error).__name__}: {error}"
        raise UsageError(what, remedy="repair the adapter; --debug shows where") from error
    check_adapter(kind, name, made)
    return made


def check_adapter(kind: str, name: str, adapter: Any) -> None:
    """Raise UsageError for an adapter of `kind` that lacks a member of its protocol, or has another type of it; it names that member."""
    protocol = PROTOCOLS[kind]
    remedy = f"see pans_sim.pc_instrument.{protocol.__name__}, which lists its members"
    for member, (words, fits) in MEMBERS[kind].items():
        if not hasattr(adapter, member):
            raise UsageError(f"{name} has no {member}, needed: {words}", remedy=remedy)
        if not fits(value := getattr(adapter, member)):
            found = f"{value!r}" if isinstance(value, int | float | str | None) else f"a {type(value).__name__}"
            raise UsageError(f"{name}: {member} is {found}, needed: {words}", remedy=remedy)
    for member, wanted in inspect.getmembers(protocol, inspect.isfunction):
        if member.startswith("_"):
            continue
        names = [*inspect.signature(wanted).parameters][1:]
        call = f"a method, called as {member}({', '.join(names)})"
        method = getattr(adapter, member, None)
        if not callable(method):
            found = f"has no {member}" if method is None else f"has a {type(method).__name__} as {member}"
            raise UsageError(f"{name} {found}, needed: {call}", remedy=remedy)
        try:
            inspect.signature(method).bind(*names)
        except ValueError:  # a method of a compiled library tells nothing of itself
            continue
        except TypeError as error:
            raise UsageError(f"{name}: {member} cannot be called so: {error}, needed: {call}", remedy=remedy) from error
