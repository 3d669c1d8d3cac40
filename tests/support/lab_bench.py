"""The independent firmware (tests/independent/) under the package's live loop, in virtual time: one run with everything on record."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

import numpy as np
from lab_bundle import read_bundle
from lab_decisions import decide_again
from lab_firmware import Books, Firmware
from lab_light import Light
from lab_recording import read_recording
from tree import ROOT

from pans.bundle.backends import make_decider
from pans.bundle.sensor import load_bundle
from pans.decide.plan import build_plan
from pans.decide.still import Core
from pans.instrument.profile import load_profile
from pans.live.loop import Job, Observers, Recovery, RunResult, run_live
from pans.live.options import RunOptions
from pans.protocol.links import Link
from pans.record.recorder import Recorder

FASHION = ROOT / "runtime/pans/shipped" / "fashion10.pans"
SCENE = ROOT / "firmware_sim/pans_sim/scenes" / "fashion200.npz"
LEVELS, D_F, EXPOSURE_US = 124, 10, 200.0
TOP = 0.0975609756097561 * (LEVELS - 1)  # photoelectrons of the brightest pixel in one exposure of fashion10
PEAK_HZ = TOP / (EXPOSURE_US * 1e-6)


def profile_text(mode: str, deadline_us: float = 1e6) -> str:
    """A profile of the lab's instrument: the shipped `ideal` with other figures."""
    text = (ROOT / "hw_profiles" / "ideal.toml").read_text().replace('"sequential"', f'"{mode}"')
    text = text.replace("levels = 65_536", f"levels = {LEVELS}")
    text = text.replace("peak_photoelectrons_hz = 10_000.0", f"peak_photoelectrons_hz = {PEAK_HZ}")
    text = text.replace("decision_deadline_us = 10_000.0", f"decision_deadline_us = {deadline_us}")
    text = text.replace("lease_ms = 1000", "lease_ms = 2000" if deadline_us >= 1e6 else "lease_ms = 1000")
    return text if mode == "sequential" else text.replace("channels = 1\n", f"channels = {D_F}\n")


class VirtualLab(Link):
    """A link of the package's contract to a firmware in this process, in virtual time: 30 us each way, some writes and reads lost."""

    simulated, virtual, name = True, True, "lab"
    DELAY_NS = 30_000

    def __init__(self, firmware: Firmware, lose: float = 0.0, seed: int = 0) -> None:
        self.firmware, self.ns = firmware, 1_000_000_000
        self._lose, self._rng = lose, np.random.default_rng(seed)
        firmware.advance(self.ticks())

    def ticks(self) -> int:
        """The tick of the device now; its crystal is 20 ppm fast."""
        return int((self.ns + 5_000_000_000) * 1.00002) * self.firmware.tick_hz // 1_000_000_000

    def read(self, timeout_s: float) -> bytes:
        end_ns = self.ns + max(int(timeout_s * 1e9), 1000)
        while True:
            self.firmware.advance(self.ticks())
            data = self.firmware.take()
            if data:
                self.ns += self.DELAY_NS
                return b"" if self._rng.random() < self._lose else data
            if self.ns >= end_ns:
                return b""
            due = self.firmware.next_due()
            ahead_ns = (
                end_ns - self.ns if due is None else int((due - self.ticks()) * 1e9 / self.firmware.tick_hz) + 1000
            )
            self.ns = min(end_ns, self.ns + ahead_ns)

    def write(self, data: bytes) -> None:
        self.ns += self.DELAY_NS
        if self._rng.random() >= self._lose:
            self.firmware.receive(data, self.ticks())

    def now_ns(self) -> int:
        return self.ns

    def pause(self, seconds: float) -> None:
        """The host stands still, the device does not."""
        self.ns += int(seconds * 1e9)

    def reopen(self) -> VirtualLab:
        return self

    def close(self) -> None:
        pass


class Bench:
    """One run of the package's loop on the firmware in virtual time."""

    def __init__(self, folder: Path, deadline_us: float = 1e6, lose: float = 0.0, **settings: Any) -> None:
        self.seed = secrets.randbelow(1 << 32)
        print(f"seed {self.seed}")
        (folder / "lab.toml").write_text(profile_text("sequential", deadline_us))
        self.profile = load_profile(str(folder / "lab.toml"))
        self.bundle, _ = load_bundle(FASHION)
        self.plan = build_plan(self.profile, self.bundle)
        self.firmware = Firmware(Light.of_scene(SCENE, PEAK_HZ, LEVELS, self.seed), **settings)
        self.link = VirtualLab(self.firmware, lose, self.seed)
        self.path = folder / "run.pansrec"

    def run(self, observers: Observers, decisions: int = 0, seconds: float = 0.0) -> RunResult:
        config = RunOptions(n_cycles=decisions, seconds=seconds, deadline_us=1e9, lease_ms=self.profile.timing.lease_ms)
        core = Core(self.plan, make_decider(self.bundle, backend="table"), 1, decisions)
        header = {"config": {"shots": 1, "tick_hz": self.profile.clock.tick_hz, "backend": "table", "dark": {}}}
        with Recorder(self.path, header, bundle=FASHION.read_bytes()) as recorder:
            recovery = Recovery.of(self.link, "", 30.0)
            result = run_live(
                self.link, Job(self.profile, self.bundle, self.plan, config), core, recorder, recovery, observers
            )
            recorder.close({})
        recording = read_recording(self.path.read_bytes())
        rows = decide_again(recording, read_bundle(FASHION.read_bytes()))
        assert rows.tobytes() == recording.rows.tobytes()
        assert len(rows) == result.tally.decisions
        return result

    @property
    def books(self) -> Books:
        return self.firmware.books
