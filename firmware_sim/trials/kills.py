"""Hosts that are killed: does the light go off within a lease, and is everything on record that was acted upon?

    lease      SIGKILL while the projector is lit, at a random moment
    recorder   SIGKILL while it records, at a random moment

Owns the killing and the judgement; host and instrument are the ordinary ones. Real time passes here: each kill takes about a second.
A host is a process of its own (`run_live` with a recorder), started from a server that has everything imported.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import struct
import tempfile
import threading
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.options import option
from pans.firmware_sim.ports.serve import open_sim
from pans.firmware_sim.ports.shell import TcpPort, serve
from pans.firmware_sim.probes.processes import PATIENCE_S, wait_until
from pans.firmware_sim.scene.still import load_scene
from pans.firmware_sim.testing import small_setup
from pans.runtime.bundle.model import bundle_bytes
from pans.runtime.core.decision import Output
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import PansError
from pans.runtime.link.base import open_link
from pans.runtime.live import LiveRun, Observers, RunOptions, run_live
from pans.runtime.record import Recorder, read_recording
from pans.runtime.report.verify import verify_file
from pans.runtime.wire.messages import DeviceState, StateReason

from . import Report, Trial, figures_text

LEASE_MS = 200
WALL_SLACK_MS = 50.0  # the simulator is woken by the operating system; in device ticks there is no slack
ACT_EVERY = 5  # decisions
ACTED = struct.Struct("<Q")


class LightLog(Instrument):
    """An instrument that notes when its light goes on and off, in device ticks and on the wall."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.changes: list[tuple[DeviceState, StateReason, int, float]] = []
        self.granted_tick = 0
        super().__init__(*args, **options)

    def _enter(self, state: DeviceState, reason: StateReason) -> None:
        super()._enter(state, reason)
        self.changes.append((state, reason, self.tick, time.perf_counter()))

    def _renew(self, lease_ms: int) -> None:
        super()._renew(lease_ms)
        self.granted_tick = self.tick


def lit_host(url: str) -> None:
    """A host that runs until it is killed."""
    profile, bundle, plan = small_setup("sequential")
    config = RunOptions(deadline_us=1e9, lease_ms=LEASE_MS, realtime=False)
    run_live(open_link(url), profile, bundle, plan, Core(plan, make_decider(bundle), 1, 0), config)


def recording_host(path: str, acted: int, seed: int) -> None:
    """A host in virtual time that records, acts on every fifth decision and says so on the pipe `acted`."""
    profile, bundle, plan = small_setup("sequential")
    link = open_sim(f"sim:ideal?scene=uniform&pace=fast&seed={seed}")
    data = bundle_bytes(bundle)
    header = {"config": {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table"}}
    header["profile"] = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}

    def act(run: LiveRun, output: Output) -> None:
        for decision in output.decisions:
            if decision.number % ACT_EVERY == 0 and output.block_end_tick is not None:
                run.gate(output.block_end_tick + 5000, 10, 0)
                os.write(acted, ACTED.pack(decision.number))

    with Recorder(path, header, bundle=data) as recorder:
        config = RunOptions(deadline_us=1e9, lease_ms=1000, realtime=False)
        core = Core(plan, make_decider(bundle), 1, 0)
        run_live(link, profile, bundle, plan, core, config, recorder, observers=Observers(act))


def _context() -> Any:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pans.firmware_sim.trials.kills"])
    return context


def _kill(process: Any) -> None:
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE_S)


def lease_kills(kills: int, seed: int = 1) -> dict[str, Any]:
    """Kill that many lit hosts; return how long the light stayed on after each, and how many broke the promise."""
    dice = random.Random(seed)
    profile, _, _ = small_setup("sequential")
    clock = DeviceClock(profile.clock.tick_hz)
    device = LightLog(profile, load_scene("uniform"), power_on_tick=clock.tick_at(time.perf_counter_ns()))
    port, stopped = TcpPort("127.0.0.1", 0), threading.Event()
    server = threading.Thread(target=serve, args=(device, clock, port, stopped.is_set), daemon=True)
    server.start()
    context, lit_ms, late = _context(), [], []
    try:
        for number in range(kills):
            process = context.Process(target=lit_host, args=(port.url,))
            process.start()
            wait_until(lambda: device.projector_lit)
            time.sleep(dice.random() * LEASE_MS / 500)  # up to two leases, so that it has been renewed several times
            killed = time.perf_counter()
            _kill(process)
            wait_until(lambda: not device.projector_lit)
            state, reason, tick, dark = device.changes[-1]
            lit_ms.append((dark - killed) * 1000)
            lease_ticks = LEASE_MS * profile.clock.tick_hz // 1000
            exact = (state, reason) == (
                DeviceState.SAFE,
                StateReason.LEASE_EXPIRED,
            ) and tick == device.granted_tick + lease_ticks
            if not exact or lit_ms[-1] > LEASE_MS + WALL_SLACK_MS:
                late.append({"kill": number, "lit_ms": lit_ms[-1], "state": state.name, "reason": reason.name})
    finally:
        stopped.set()
        server.join(PATIENCE_S)
        port.close()
    return {
        "kills": kills,
        "lease_ms": LEASE_MS,
        "dark_in_time": kills - len(late),
        "lit_ms_median": float(np.median(lit_ms)),
        "lit_ms_max": max(lit_ms),
        "broken": late,
    }


def recorder_kills(kills: int, folder: Path, seed: int = 1, longest_s: float = 0.6) -> dict[str, Any]:
    """Kill that many recording hosts; return how much was readable each time, and what was missing."""
    dice, context = random.Random(seed), _context()
    broken, decisions, acted_on, torn = [], [], 0, 0
    for number in range(kills):
        path = folder / f"kill-{number}.pansrec"
        reader, writer = context.Pipe(duplex=False)
        process = context.Process(target=_recording_child, args=(str(path), writer, number))
        process.start()
        writer.close()
        reader.poll(PATIENCE_S)  # until it has acted for the first time
        time.sleep(dice.random() * longest_s)
        _kill(process)
        with reader:
            last = _last_acted(reader.fileno())
        problem, count, cut = judge_recording(path, last)
        decisions.append(count)
        acted_on += last >= 0
        torn += cut
        if problem:
            broken.append({"kill": number, "problem": problem})
        path.unlink()
    return {
        "kills": kills,
        "readable": kills - len(broken),
        "with_actions": acted_on,
        "cut_within_a_block": torn,
        "decisions_median": float(np.median(decisions)),
        "broken": broken,
    }


def judge_recording(path: Path, last_acted: int) -> tuple[str, int, bool]:
    """Return what is wrong ("" for nothing), how many decisions are readable, and whether the last block was cut."""
    try:
        recording = read_recording(path)
        rows = recording.decisions()
        numbers = rows["index"]
        verdict = verify_file(path)
    except PansError as error:
        return error.message, 0, False
    expected = [
        f"{recording.end_offset} of {recording.size} bytes hold whole blocks" in text for text in verdict.violations
    ]
    if recording.complete or verdict.damaged or expected != [True]:
        return f"verify says {verdict.violations}", len(rows), False
    if len(numbers) != recording.n_decisions or (len(numbers) and int(numbers[-1]) != len(numbers) - 1):
        return "decisions are missing in the middle", len(rows), False
    if last_acted >= len(rows):
        return f"decision {last_acted} was acted upon, on record are {len(rows)}", len(rows), False
    return "", len(rows), recording.end_offset < recording.size


def _recording_child(path: str, pipe: Connection, seed: int) -> None:
    recording_host(path, pipe.fileno(), seed)


def _last_acted(reader: int) -> int:
    data = b""
    while piece := os.read(reader, 1 << 16):
        data = (data + piece)[-(ACTED.size * 2) :]
    whole = len(data) // ACTED.size * ACTED.size
    return int(ACTED.unpack(data[whole - ACTED.size : whole])[0]) if whole else -1


@dataclass(frozen=True, slots=True)
class Settings:
    """Whom to kill, and how often."""

    what: str = option(
        "lease", "the host whose light must go off, or the one that records", flag="what", choices=("lease", "recorder")
    )
    kills: int | None = option(None, "how many (default: 100 for lease, 200 for recorder)", type=int)
    seed: int = option(1, "of the moments (default 1)")


def run(settings: Settings) -> Report:
    """Kill hosts."""
    if settings.what == "lease":
        figures = lease_kills(settings.kills or 100, settings.seed)
    else:
        with tempfile.TemporaryDirectory() as folder:
            figures = recorder_kills(settings.kills or 200, Path(folder), settings.seed)
    return Report(figures, not figures["broken"], figures_text(figures))


TRIAL = Trial(Settings, run)
