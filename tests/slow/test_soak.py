"""A run with faults for minutes of real time, watched from outside, then SIGTERM: it stays flat, keeps what it must and ends well.

`PANS_SOAK_MINUTES` says how long (2 unless it is set).
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.base import SHIPPED
from pans.record.reading import read_recording
from pans.record.reading.parts import parts_in
from pans.record.replay import replay
from pans.report.files.verify import verify_parts

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")]
FAULTS = (
    "loss:0.001,flip:0.001,duplicate:0.001,truncate:0.0005,reorder:0.001,stall:600ms/45s,late:60ms/20s,"
    "disconnect:400ms/40s,clock_step:2ms/60s"
)
DEVICE = f"sim:oled-qcmos?scene=fashion200&seed=1&pace=real&faults={FAULTS}"
MINUTES = float(os.environ.get("PANS_SOAK_MINUTES", "2"))
ROTATE_MB, KEEP_MB = 0.5, 3.0
SAMPLES = 60
WARM_UP_SHARE = 0.2  # of the run: caches and histories fill
FLAT_RSS_BYTES = 4 << 20  # growth over the judged time, at the upper end of the slope's interval
FLAT_HANDLES = FLAT_THREADS = 2  # a scrape or a reconnection may be under way


def sample(pid: int, port: int, elapsed_s: float) -> dict[str, Any]:
    """Memory, handles and threads of a process from /proc; its metrics must answer."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        assert b"pans_decisions_total" in answer.read()
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    rss = int(status["VmRSS"].split()[0]) * 1024
    return {
        "s": elapsed_s,
        "rss": rss,
        "handles": len(os.listdir(f"/proc/{pid}/fd")),
        "threads": int(status["Threads"]),
    }


def wait_until_running(process: subprocess.Popen[str], state: Path) -> None:
    """Wait until the state file says that the run is under way."""
    until = time.monotonic() + 120
    while not (state.exists() and json.loads(state.read_text())["state"] == "running"):
        assert process.poll() is None, f"the run did not start (exit code {process.poll()})"
        assert time.monotonic() < until
        time.sleep(0.2)


def test_a_long_run_with_faults_stays_flat_and_ends_well(tmp_path: Path) -> None:
    out, state = tmp_path / "out", tmp_path / "state.json"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = int(server.getsockname()[1])
    words = ["run", str(SHIPPED / "fashion10.pans"), "--device", DEVICE, "--trials", "5", "--out", str(out), "--json"]
    words += ["--rotate-mb", str(ROTATE_MB), "--keep-mb", str(KEEP_MB), "--state", str(state)]
    words += ["--metrics", f"127.0.0.1:{port}", "--reconnect-s", "20"]
    call = [sys.executable, "-c", "import sys; from pans.app.main import main; sys.exit(main(sys.argv[1:]))", *words]
    samples = []
    with (tmp_path / "stderr").open("w") as errors:
        process = subprocess.Popen(call, stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        wait_until_running(process, state)
        started = time.monotonic()
        while (elapsed := time.monotonic() - started) < MINUTES * 60:
            assert process.poll() is None, (tmp_path / "stderr").read_text()[-2000:]
            samples.append(sample(process.pid, port, elapsed))
            time.sleep(MINUTES * 60 / SAMPLES)
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    summary = json.loads(said)
    assert summary["ended"] == "stopped by SIGTERM"
    assert (process.returncode == 0) == (summary["verdict"] == "PASS")  # with faults the verdict is FAIL
    later = [one for one in samples if one["s"] >= WARM_UP_SHARE * samples[-1]["s"]]
    seconds, rss = np.array([one["s"] for one in later]), np.array([one["rss"] for one in later], float)
    print("MiB", (rss[::6] / 2**20).round(1).tolist())
    (slope, _), covariance = np.polyfit(seconds, rss, 1, cov=True)
    assert (slope + 1.96 * covariance[0, 0] ** 0.5) * float(np.ptp(seconds)) <= FLAT_RSS_BYTES
    assert later[-1]["handles"] - later[0]["handles"] <= FLAT_HANDLES
    assert later[-1]["threads"] - later[0]["threads"] <= FLAT_THREADS
    paths = parts_in(out)
    assert [text for one in verify_parts(out) for text in (*one.violations, *one.alerts)] == []
    assert sum(path.stat().st_size for path in paths) <= (KEEP_MB + ROTATE_MB) * 2**20
    for path in paths:
        recording = read_recording(path)
        again = replay(recording, recording.bundle())
        assert (again.decisions, again.sha256) == (recording.n_decisions, recording.decisions_sha256)
