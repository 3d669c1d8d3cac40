"""A run and its instrument as two processes at real pace, with a scheduling probe on every core that they use.

Owns the processes from start to end and what is read of them meanwhile; what came of a run is the trial's. Both are the ordinary programs
(`pans run` or `pans demo`, `pans simulate`). Linux, with the right to SCHED_FIFO.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from pans.runtime.cli import say

from .link_probe import LinkLog, LinkProbe
from .processes import processor_s, real_time_programs, start_command, stolen_s, tail
from .scheduling_probe import EVERY_US, ProbeLog, SchedulingProbe

LONGER_S = 120.0
FINISHED = (0, 4)  # exit codes of `pans run`: as promised, or with late or lost work
PROGRESS_S = 10.0


class Watched(NamedTuple):
    """Where the two processes run: `pin` the cores of host and instrument (None: anywhere), and how the cores are probed.

    `awake` binds the two loops alone and keeps their cores from halting (--core). `finished` are the exit codes of a run that gave figures.
    `link`, "pty" or "tcp", is probed by a pair of processes beside, between the two cores; "" leaves that out.
    """

    pin: tuple[int, int] | None
    awake: bool = False
    canary_us: int = EVERY_US
    seconds: float = 0.0  # that the run takes once it is armed
    finished: tuple[int, ...] = FINISHED
    link: str = ""

    def awake_on(self, which: int) -> list[str]:
        """Options that pin the loop of host (0) or instrument (1) to its core."""
        return ["--core", str(self.pin[which])] if self.awake and self.pin is not None else []

    def bound_to(self, which: int) -> int | None:
        """The core that the whole process of host (0) or instrument (1) is bound to."""
        return None if self.awake or self.pin is None else self.pin[which]


class Outcome(NamedTuple):
    """What came of a run: the summary of `pans run`, its recording, what the probes saw, processor time per second of the two."""

    summary: dict[str, Any]
    recording: Path
    logs: tuple[ProbeLog, ...]
    busy: dict[str, float]
    stolen_s: dict[int, float]  # by core, as the hypervisor tells in /proc/stat, while the probes were there
    link: LinkLog | None  # what the pair beside saw
    others: tuple[str, ...]  # further programs of real-time priority on this computer: then it was not quiet


def run_watched(
    instrument: list[str] | None, run_words: Callable[[str], list[str]], watched: Watched, folder: Path
) -> Outcome:
    """Run the host's command, `run_words` of the device's URL, to its end; RuntimeError when a process fails.

    `instrument` are the words behind `pans simulate`; None for a command that starts its own (the URL is then empty).
    """
    cores = sorted(os.sched_getaffinity(0) if watched.pin is None else set(watched.pin))
    probes: list[SchedulingProbe] = []
    pair: LinkProbe | None = None
    simulator: subprocess.Popen[str] | None = None
    host: subprocess.Popen[str] | None = None
    try:
        url = ""
        if instrument is not None:
            words = ["simulate", *instrument, "--until-stdin-closes", *watched.awake_on(1)]
            simulator = start_command(words, folder / "simulator.txt", watched.bound_to(1))
            assert simulator.stdout is not None
            url = simulator.stdout.readline().strip()
            if not url:
                raise RuntimeError(f"the simulator ended with {simulator.wait()}: {tail(folder / 'simulator.txt')}")
        if watched.canary_us:
            probes = [SchedulingProbe(core, every_us=watched.canary_us) for core in cores]
        if watched.link and watched.canary_us and watched.pin is not None:
            pair = LinkProbe(watched.link, watched.pin)
        stolen_before = stolen_s(cores)
        words = [*run_words(url), "--out", str(folder / "out"), "--json", *watched.awake_on(0)]
        host = start_command(words, folder / "host.txt", watched.bound_to(0))
        known = {probe.pid for probe in probes} | ({pair.pid} if pair is not None else set())
        busy, others = _wait(host, simulator, watched.seconds, known)
        out, _ = host.communicate()
        if host.returncode not in watched.finished:
            raise RuntimeError(f"the host ended with {host.returncode}: {tail(folder / 'host.txt')}")
        stolen = {core: since - stolen_before[core] for core, since in stolen_s(cores).items()}
        logs = tuple(probe.end() for probe in probes)
        link = None if pair is None else pair.end()
        summary = json.loads(out)
        return Outcome(summary, Path(summary["recording"]), logs, busy, stolen, link, others)
    finally:
        for probe in probes:
            probe.kill()
        if pair is not None:
            pair.kill()
        for process in (host, simulator):
            if process is not None:
                _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    """Let a process end by closing its standard input, as its own children do; kill it if it does not."""
    try:
        process.communicate(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _wait(
    host: subprocess.Popen[str], simulator: subprocess.Popen[str] | None, seconds: float, probes: set[int]
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Wait for the host's end; return what `Outcome` calls `busy`, between a fifth of the run and its end, and `others`."""
    others: set[str] = set()
    began = time.monotonic()
    pids = [process.pid for process in (host, simulator) if process is not None]
    samples: list[tuple[float, ...]] = []
    told = 0.0
    while host.poll() is None:
        elapsed = time.monotonic() - began
        if elapsed > seconds + LONGER_S:
            raise RuntimeError(f"the host did not end within {elapsed:.0f} s")
        try:
            samples.append((elapsed, *(processor_s(pid) for pid in pids)))
        except OSError:  # it has just ended
            break
        others |= real_time_programs(probes | set(pids), frozenset(probes | set(pids)))
        if elapsed > told + PROGRESS_S:
            told = elapsed
            say(f"{elapsed:6.0f} s")
        time.sleep(min(1.0, max(seconds / 10, 0.05)))
    host.wait()
    last = samples[-2] if len(samples) > 1 else samples[-1]
    first = next(sample for sample in samples if sample[0] >= 0.2 * last[0])
    lasted = max(last[0] - first[0], 1e-9)
    shares = [(late - early) / lasted for early, late in zip(first[1:], last[1:])]
    return dict(zip(("host", "simulator"), shares)), tuple(sorted(others))
