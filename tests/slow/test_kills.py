"""Hosts that are killed at a random moment: the light goes off within a lease, and what was acted upon is on record."""

from __future__ import annotations

import multiprocessing
import os
import random
import secrets
import signal
import struct
import sys
import time
from pathlib import Path

import pytest
from host_process import lit_instrument, start_host, until

from pans.firmware_sim.ports.serve import open_sim
from pans.firmware_sim.testing import small_setup
from pans.runtime.bundle.model import bundle_bytes
from pans.runtime.core.decision import Output
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.live import LiveRun, Observers, RunOptions, run_live
from pans.runtime.record import Recorder, read_recording
from pans.runtime.report.verify import verify_file
from pans.runtime.wire.messages import DeviceState, StateReason

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="SIGKILL and fork")]
LEASE_MS = 200
KILLS = 40
ACT_EVERY = 5  # decisions
ACTED = struct.Struct("<Q")


def test_the_light_goes_off_within_a_lease_of_the_hosts_death(tmp_path: Path) -> None:
    seed = secrets.randbelow(1 << 32)
    print(f"seed {seed}")
    dice, lease_ticks = random.Random(seed), LEASE_MS * small_setup()[0].clock.tick_hz // 1000
    with lit_instrument() as lit:
        for number in range(KILLS // 4):
            host = start_host(tmp_path / str(number), lit.url, LEASE_MS, ["--seconds", "60"], stage="running")
            host.wait_for_stage()
            host.let_go()
            until(lambda: lit.device.projector_lit)
            time.sleep(dice.random() * LEASE_MS / 500)  # up to two leases, so that it has been renewed several times
            host.signal(signal.SIGKILL)
            host.process.join(30)
            until(lambda: not lit.device.projector_lit)
            state, reason, tick, _ = lit.device.changes[-1]
            assert (state, reason) == (DeviceState.SAFE, StateReason.LEASE_EXPIRED)
            assert tick == lit.device.granted_tick + lease_ticks


def recording_host(path: Path, acted: int, seed: int) -> None:
    """A host in virtual time that records, acts on every fifth decision and says so on the pipe `acted`."""
    profile, bundle, plan = small_setup("sequential")
    header = {"config": {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table"}}
    header["profile"] = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}

    def act(run: LiveRun, output: Output) -> None:
        for decision in output.decisions:
            if decision.number % ACT_EVERY == 0 and output.block_end_tick is not None:
                run.gate(output.block_end_tick + 5000, 10, 0)
                os.write(acted, ACTED.pack(decision.number))

    with Recorder(path, header, bundle=bundle_bytes(bundle)) as recorder:
        config = RunOptions(deadline_us=1e9, lease_ms=1000, realtime=False)
        link = open_sim(f"sim:ideal?scene=uniform&pace=fast&seed={seed}")
        core = Core(plan, make_decider(bundle), 1, 0)
        run_live(link, profile, bundle, plan, core, config, recorder, observers=Observers(act))


def last_acted(reader: int) -> int:
    """The last decision that the pipe heard of; -1 for none."""
    data = b""
    while piece := os.read(reader, 1 << 16):
        data = (data + piece)[-2 * ACTED.size :]
    whole = len(data) // ACTED.size * ACTED.size
    return int(ACTED.unpack(data[whole - ACTED.size : whole])[0]) if whole else -1


def test_a_killed_recorder_leaves_whole_blocks_and_all_that_was_acted_upon(tmp_path: Path) -> None:
    seed = secrets.randbelow(1 << 32)
    print(f"seed {seed}")
    dice, context, acted_on, torn = random.Random(seed), multiprocessing.get_context("fork"), 0, 0
    for number in range(KILLS):
        path, (reader, writer) = tmp_path / f"{number}.pansrec", os.pipe()
        process = context.Process(target=recording_host, args=(path, writer, number))
        process.start()
        os.close(writer)
        os.read(reader, ACTED.size)  # until it has acted for the first time
        time.sleep(dice.random() * 0.5)
        os.kill(process.pid or 0, signal.SIGKILL)
        process.join(30)
        last = last_acted(reader)
        os.close(reader)
        recording, verdict = read_recording(path), verify_file(path)
        rows = recording.decisions()
        assert not recording.complete
        assert not verdict.damaged
        assert rows["index"].tolist() == list(range(recording.n_decisions))
        assert last < len(rows), f"decision {last} was acted upon, on record are {len(rows)}"
        acted_on += last >= 0
        torn += recording.end_offset < recording.size
        path.unlink()
    assert acted_on > KILLS // 2
    print(f"{torn} of {KILLS} were cut within a block")
