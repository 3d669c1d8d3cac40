"""SIGKILL, SIGTERM and SIGSTOP at every stage of a run: dark within the lease, the right code, a recording that verifies and replays.

A host that is killed at any moment has on record what it acted upon.
"""

import multiprocessing
import os
import random
import signal
import struct
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from host_process import STAGES, Host, Lit, lit_instrument, start_host, until
from live_status import ask_for_gate

from pans.base.errors import EXIT_ALERT, EXIT_DEVICE, EXIT_FINE, EXIT_INTERRUPTED, EXIT_TIMING
from pans.bundle.backends.choose import make_decider
from pans.bundle.sensor import bundle_bytes
from pans.decide.decision import Output
from pans.decide.still.core import Core
from pans.live.loop import Job, Observers, Status, run_live
from pans.live.options import RunOptions
from pans.protocol.wire import DeviceState, StateReason
from pans.record.reading import read_recording
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans.report.files.verify import verify_file
from pans_sim.ports.serve import open_sim
from pans_sim.testing import small_setup

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs forkserver and signals")
LEASE_MS = 400
DECISIONS = 600
ENDED = {EXIT_FINE, EXIT_ALERT, EXIT_TIMING}  # by itself, on a loaded machine
CODES = {
    "SIGTERM": {EXIT_INTERRUPTED},
    "SIGKILL": {-signal.SIGKILL},
    "SIGSTOP": {EXIT_DEVICE},  # where there is no time left to come back
}


def check(case: tuple[str, str, Path, float]) -> list[str]:
    """Meet a run at a stage with a signal, or `delay_s` behind it; return what does not hold."""
    name, stage, folder, delay_s = case
    with lit_instrument() as lit:
        host = start_host(folder, lit.url, LEASE_MS, ["--decisions", str(DECISIONS)], stage=stage)
        try:
            host.wait_for_stage()
            if delay_s:
                host.let_go()
                time.sleep(delay_s)
            host.signal(getattr(signal, name))
            host.let_go()
            found = list(_light_stays(lit)) if name != "SIGTERM" else []
            if name == "SIGSTOP":
                host.signal(signal.SIGCONT)
            code = host.code()
            if code not in CODES[name] and not (code in ENDED and _is_completed(host)):
                found.append(f"exit code {code}; {host.errors()}")
            until(lambda: not lit.device.projector_lit)
            return [
                f"{name} at {stage} after {delay_s:.4f} s: {text}" for text in (*found, *_recording_faults(host, stage))
            ]
        finally:
            host.process.kill()


def _is_completed(host: Host) -> bool:
    """Whether the run had made all its decisions by then."""
    return host.recording.exists() and read_recording(host.recording).summary.get("ended") == "completed"


def _light_stays(lit: Lit) -> Iterator[str]:
    """Wait until the light is off; where the lease made it so, it was on to the very tick."""
    until(lambda: not lit.device.projector_lit)
    for state, reason, tick, _ in lit.device.changes[-1:]:
        ticks = LEASE_MS * small_setup()[0].clock.tick_hz // 1000
        if reason is StateReason.LEASE_EXPIRED and (state, tick) != (DeviceState.SAFE, lit.device.granted_tick + ticks):
            yield f"{state.name} at {tick}, the lease of {ticks} ticks was renewed at {lit.device.granted_tick}"


def _recording_faults(host: Host, stage: str) -> Iterator[str]:
    if not host.recording.exists():
        if stage != "opening":
            yield "there is no recording"
        return
    verdict = verify_file(host.recording)
    if verdict.damaged or any("incomplete" not in text for text in verdict.violations):
        yield f"verify: {verdict.violations}"
        return
    recording = read_recording(host.recording)
    again = replay(recording, recording.bundle())
    if not again.as_recorded:
        yield f"replay: {again}, recorded {recording.n_decisions}"


def check_all(folder: Path, rounds: int, longest_s: float, stages: Iterable[str] = STAGES) -> None:
    """Meet each of `stages` with every signal, that many times."""
    seed = random.SystemRandom().randrange(1 << 32)
    dice = random.Random(seed)
    cases = [
        (name, stage, folder / f"{turn}-{name}-{stage}", dice.random() * longest_s * (turn % 4 > 0))
        for turn in range(rounds)
        for name in CODES
        for stage in stages
    ]
    with ThreadPoolExecutor(4) as pool:
        faults = [text for found in pool.map(check, cases) for text in found]
    assert not faults, f"seed {seed}, {len(faults)} of {len(cases)} runs:\n" + "\n".join(faults)


def test_a_signal_leaves_no_light_and_a_readable_recording(tmp_path: Path) -> None:
    check_all(tmp_path, rounds=1, longest_s=0.0, stages=("running", "stopping"))


@pytest.mark.slow
def test_signals_at_any_stage_many_times(tmp_path: Path) -> None:
    check_all(tmp_path, rounds=12, longest_s=0.3)


KILLS = 40
ACT_EVERY = 5  # decisions
ACTED = struct.Struct("<Q")


def recording_host(path: Path, acted: int, seed: int) -> None:
    """A host in virtual time that records, acts on every fifth decision and says so on the pipe `acted`."""
    profile, bundle, plan = small_setup("sequential")
    header = {"config": {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table"}}
    header["profile"] = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}

    def act(run: Status, output: Output) -> None:
        for decision in output.decisions:
            if decision.number % ACT_EVERY == 0 and output.block_end_tick is not None:
                ask_for_gate(run, output.block_end_tick + 5000, 10, 0)
                os.write(acted, ACTED.pack(decision.number))

    with Recorder(path, header, bundle=bundle_bytes(bundle)) as recorder:
        config = RunOptions(deadline_us=1e9, lease_ms=1000, realtime=False)
        link = open_sim(f"sim:ideal?scene=uniform&pace=fast&seed={seed}")
        core = Core(plan, make_decider(bundle), 1, 0)
        run_live(link, Job(profile, bundle, plan, config), core, recorder, observers=Observers(act))


def last_acted(reader: int) -> int:
    """The last decision that the pipe heard of; -1 for none."""
    data = b""
    while piece := os.read(reader, 1 << 16):
        data = (data + piece)[-2 * ACTED.size :]
    whole = len(data) // ACTED.size * ACTED.size
    return int(ACTED.unpack(data[whole - ACTED.size : whole])[0]) if whole else -1


@pytest.mark.slow
def test_a_killed_recorder_leaves_whole_blocks_and_all_that_was_acted_upon(tmp_path: Path) -> None:
    context, acted_on = multiprocessing.get_context("fork"), 0
    for number in range(KILLS):
        path, (reader, writer) = tmp_path / f"{number}.pansrec", os.pipe()
        process = context.Process(target=recording_host, args=(path, writer, number))
        process.start()
        os.close(writer)
        os.read(reader, ACTED.size)  # until it has acted for the first time
        time.sleep(random.random() * 0.5)
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
        path.unlink()
    assert acted_on > KILLS // 2
