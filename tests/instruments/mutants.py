"""Copies of the C core with one fault each, and a conformance test of one: for the tests of `pans conform`."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from c_core import CDevice

from pans.instrument.profile import load_profile
from pans_sim.conform import Finding, conform
from pans_sim.device.clock import DeviceClock, SteppedDevice
from pans_sim.pc_instrument.core import FOLDER, build_library
from pans_sim.ports.virtual import START_NS, VirtualLink

PIECE = 64  # bytes that a slow line takes at once


class Mutant(NamedTuple):
    """A fault: file of the core, what stands there once, what takes its place, and the rules that must find it."""

    file: str
    sound: str
    planted: str
    rules: set[str]
    line_bytes_s: int = 0  # of the line to the host; 0: it takes everything at once
    profile: str = "ideal"


def sources_with(mutant: Mutant, folder: Path) -> Path:
    """Copy the C sources with the fault in them; fails when the text that it replaces does not stand there exactly once."""
    for path in FOLDER.rglob("*.[ch]"):
        copy = folder / path.relative_to(FOLDER)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(path.read_text())
    text = (folder / mutant.file).read_text()
    assert text.count(mutant.sound) == 1, f"{mutant.file} says {text.count(mutant.sound)} times {mutant.sound!r}"
    (folder / mutant.file).write_text(text.replace(mutant.sound, mutant.planted))
    return folder


def built(mutant: Mutant, folder: Path) -> Path:
    """Return the library with this fault, compiled without optimisation in `folder`."""
    return build_library(sources_with(mutant, folder / "sources"), folder / "cache", ("-std=c99", "-O0"))


def c_core(name: str, library: Path | None = None, line_bytes_s: int = 0) -> tuple[SteppedDevice, DeviceClock]:
    """The C core in this process."""
    profile = load_profile(name)
    clock = DeviceClock(profile.clock.tick_hz)
    kind = SlowLine if line_bytes_s else CDevice
    device = kind(profile, tick=clock.tick_at(START_NS), library=library)
    if isinstance(device, SlowLine):
        device.ticks_per_byte = clock.tick_hz / line_bytes_s
    return device, clock


def tried(name: str, device: SteppedDevice, clock: DeviceClock, *only: str, long: bool = False) -> dict[str, Finding]:
    """Try the rules in virtual time."""
    link = VirtualLink(device, clock, "conform")
    return {one.number: one for one in conform(link, load_profile(name), pixels=16, only=only, long=long)}


def broken_by(mutant: Mutant, tmp_path: Path, *only: str, long: bool = False) -> set[str]:
    """The rules that a copy of the C core with this fault breaks."""
    device = c_core(mutant.profile, built(mutant, tmp_path), mutant.line_bytes_s)
    found = tried(mutant.profile, *device, *only, long=long)
    broken = {number for number, one in found.items() if one.verdict in ("broken", "gone")}
    assert all(found[number].why and found[number].pieces for number in broken)
    return broken


class SlowLine(CDevice):
    """The C core behind a line of so many bytes per second; what the line does not take yet waits in the device."""

    ticks_per_byte = 1.0
    _free_tick = 0  # when the line takes the next piece

    def step(self, tick: int, data: bytes) -> bytes:
        """As CDevice.step, but no more than the line takes by then."""
        sent = self._drain(tick)
        self._call("pans_step", tick, data, len(data))
        self.tick = tick
        return sent + self._drain(tick)

    def next_event_tick(self) -> int | None:
        """When the line is free again, else when the device does something by itself."""
        return self._free_tick if self._free_tick > self.tick else super().next_event_tick()

    def _drain(self, tick: int) -> bytes:
        sent = b""
        while self._free_tick <= tick:
            at = max(self._free_tick, self.tick)
            count = self._call("pans_output", at, self._out, PIECE)
            self.tick = at
            sent += bytes(memoryview(self._out)[:count])
            if count:
                self._free_tick = at + max(1, round(count * self.ticks_per_byte))
            elif (due := super().next_event_tick()) is not None and due <= tick:
                self._free_tick = due
            else:
                break
        return sent
