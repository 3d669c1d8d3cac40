"""What the system says about real time: cores, idle states, frequency, hypervisor, limits, latency timers of serial adapters.

Owns the reading of /proc and /sys under a root that tests may replace; never changes or measures anything. What a system does not tell is
empty.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

ASYNC_LOW_LATENCY = 1 << 13  # linux/tty_flags.h


@dataclass(frozen=True, slots=True)
class IdleState:
    """One idle state of a core: the kernel's name, and how long the core needs to leave it."""

    name: str
    exit_us: int


@dataclass(frozen=True, slots=True)
class SerialTimer:
    """A serial port that may hold bytes back: its FTDI latency timer in ms (None: no such timer), the low_latency flag (None: unknown)."""

    name: str
    timer_ms: int | None
    low_latency: bool | None


@dataclass(frozen=True, slots=True)
class Machine:
    """Facts of a computer."""

    isolated: frozenset[int]
    siblings: tuple[frozenset[int], ...]  # cores that share one physical core
    governor: str
    idle_driver: str
    idle_states: tuple[IdleState, ...]
    hypervisor: bool
    rt_share: float | None  # of the time that real-time threads may take; 1.0: all
    serial: tuple[SerialTimer, ...]


def read_machine(root: Path = Path("/")) -> Machine:
    """Read the facts."""
    cpu = root / "sys/devices/system/cpu"
    runtime_us, period_us = (
        _number(_line(root / f"proc/sys/kernel/sched_rt_{name}_us")) for name in ("runtime", "period")
    )
    share = None
    if runtime_us is not None and period_us:
        share = 1.0 if runtime_us < 0 else runtime_us / period_us
    lists = {_line(path) for path in cpu.glob("cpu[0-9]*/topology/thread_siblings_list")}
    return Machine(
        isolated=cores_of(_line(cpu / "isolated")),
        siblings=tuple(sorted((cores_of(text) for text in lists if text), key=sorted)),
        governor=_line(cpu / "cpu0/cpufreq/scaling_governor"),
        idle_driver=_line(cpu / "cpuidle/current_driver"),
        idle_states=_idle_states(cpu / "cpu0/cpuidle"),
        hypervisor="hypervisor" in _field(root / "proc/cpuinfo", "flags").split(),
        rt_share=share,
        serial=_serial(root / "sys"),
    )


def steal_ms(root: Path = Path("/")) -> float | None:
    """Return for how long the hypervisor ran something else since the start, all cores together; None where that is not told."""
    fields = _line(root / "proc/stat").split()
    if len(fields) < 9 or not hasattr(os, "sysconf"):
        return None
    return int(fields[8]) * 1000 / os.sysconf("SC_CLK_TCK")


def cores_of(text: str) -> frozenset[int]:
    """Return the cores of a list as the kernel writes it.

    >>> sorted(cores_of("0-2,5"))
    [0, 1, 2, 5]
    """
    found: set[int] = set()
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if first.isdecimal():
            found |= set(range(int(first), int(last or first) + 1))
    return frozenset(found)


def _idle_states(folder: Path) -> tuple[IdleState, ...]:
    states = []
    for path in sorted(folder.glob("state[0-9]*")):
        if _line(path / "disable") in ("", "0"):
            states.append(IdleState(_line(path / "name"), _number(_line(path / "latency")) or 0))
    return tuple(states)


def _serial(sys: Path) -> tuple[SerialTimer, ...]:
    found = []
    for path in sorted((sys / "class/tty").glob("tty[SUA]*")):
        kind = _number(_line(path / "type"))
        usb = path.name.startswith(("ttyUSB", "ttyACM"))
        if not usb and not kind:  # a ttyS that has no chip behind it
            continue
        timer = _number(_line(sys / "bus/usb-serial/devices" / path.name / "latency_timer"))
        text = _line(path / "flags")
        low = bool(int(text, 16) & ASYNC_LOW_LATENCY) if text.startswith("0x") else None
        found.append(SerialTimer(path.name, timer, low))
    return tuple(found)


def _line(path: Path) -> str:
    try:
        return path.read_text().split("\n", 1)[0].strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _field(path: Path, name: str) -> str:
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def _number(text: str) -> int | None:
    return int(text) if text.removeprefix("-").isdecimal() else None
