"""SIGKILL, SIGTERM and SIGSTOP at every stage of a run: dark within the lease, the right code, a recording that verifies and replays."""

from __future__ import annotations

import random
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from host_process import STAGES, Host, Lit, lit_instrument, start_host, until

from pans.runtime.cli import EXIT_ALERT, EXIT_DEVICE, EXIT_FINE, EXIT_INTERRUPTED, EXIT_TIMING
from pans.runtime.record import read_recording
from pans.runtime.record.replaying import replay
from pans.runtime.report.verify import verify_file

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs forkserver and signals")
LEASE_MS = 400
SLACK_S = 0.5  # the instrument is a thread of this process, beside many others
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
    asked_s = time.perf_counter()
    try:
        until(lambda: not lit.device.projector_lit, LEASE_MS / 1000 + SLACK_S)
    except RuntimeError:
        yield f"lit for more than {time.perf_counter() - asked_s:.3f} s, lease {LEASE_MS} ms"


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
