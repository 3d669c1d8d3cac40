"""A run for a long time in real time, with faults on, watched from outside; then SIGTERM: does it stay flat and end well?

Owns the run's command line, the samples and the judgement; host and instrument are the ordinary programs. Memory, handles and threads are
read from /proc by this process, not asked of the one that is judged.
"""

from __future__ import annotations

import importlib.resources
import json
import os
import signal
import socket
import subprocess
import tempfile
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pans.firmware_sim.options import option
from pans.firmware_sim.probes.processes import start_command, wait_until
from pans.runtime.cli import EXIT_FINE, say
from pans.runtime.errors import PansError
from pans.runtime.live.continuous import ASKED_TO_STOP
from pans.runtime.record import read_recording, replay
from pans.runtime.record.part_names import parts_in
from pans.runtime.report.verify import verify_parts

from . import Report, Trial, figures_text

PROFILE, SCENE, BUNDLE = "oled-qcmos", "fashion200", "fashion10.pans"
FAULTS = (
    "loss:0.001,flip:0.001,duplicate:0.001,truncate:0.0005,reorder:0.001,stall:600ms/45s,late:60ms/20s,"
    "disconnect:400ms/120s,clock_step:2ms/300s"
)
ROTATE_MB, KEEP_MB = 0.5, 3.0
SAMPLES = 180
WARM_UP_SHARE = 0.2  # of the run: caches and histories fill
READY_S, GOODBYE_S = 120.0, 60.0
KEPT = ("ended", "decisions", "accuracy", "late", "late_cause", "lost", "lost_cause", "reconnects", "verdict")
FLAT_RSS_BYTES = 4 << 20  # growth over the judged time, at the upper end of the slope's interval
FLAT_HANDLES = FLAT_THREADS = 2  # a scrape or a reconnection may be under way


def soak(minutes: float, seed: int, folder: Path) -> dict[str, Any]:
    """Run, watch, stop; return samples, slopes, and what was broken."""
    state, port = folder / "state.json", _free_port()
    bundle = Path(str(importlib.resources.files("pans.runtime") / "shipped" / BUNDLE))
    device = f"sim:{PROFILE}?scene={SCENE}&seed={seed}&pace=real&faults={FAULTS}"
    words = ["run", str(bundle), "--device", device, "--trials", "5", "--out", str(folder / "out"), "--json"]
    words += ["--rotate-mb", str(ROTATE_MB), "--keep-mb", str(KEEP_MB), "--state", str(state)]
    words += ["--metrics", f"127.0.0.1:{port}", "--reconnect-s", "20"]
    process = start_command(words, folder / "stderr.txt")
    samples: list[dict[str, Any]] = []
    try:
        _wait_until_running(process, state)
        started = time.monotonic()
        while (elapsed := time.monotonic() - started) < minutes * 60 and process.poll() is None:
            samples.append(_sample(process.pid, state, port, folder / "out", elapsed))
            if len(samples) % 6 == 1:
                say(_line(samples[-1]))
            time.sleep(min(minutes * 60 / SAMPLES, max(minutes * 60 - elapsed, 0.0)))
        asked = time.monotonic()
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=GOODBYE_S)
        goodbye_s = time.monotonic() - asked
    finally:
        process.kill()
        process.wait()
    summary = json.loads(out) if out else {}
    return judged(samples, process.returncode, summary, folder / "out", goodbye_s)


def judged(
    samples: list[dict[str, Any]], exit_code: int, summary: dict[str, Any], out: Path, goodbye_s: float
) -> dict[str, Any]:
    """Return the figures and `broken`, one sentence for each promise that was not kept."""
    ended, verdict = summary.get("ended"), summary.get("verdict")
    # with faults the verdict is FAIL, which is never exit code 0
    ended_well = ended == ASKED_TO_STOP and (exit_code == EXIT_FINE) == (verdict == "PASS")
    broken = [] if ended_well else [f"exit code {exit_code} after SIGTERM, ended {ended!r} with verdict {verdict}"]
    later = [sample for sample in samples if sample["elapsed_s"] >= WARM_UP_SHARE * samples[-1]["elapsed_s"]]
    minutes = np.array([sample["elapsed_s"] / 60 for sample in later])
    rss = np.array([sample["rss_bytes"] for sample in later], float)
    slope, error = slope_of(minutes, rss)
    growth = (slope + 1.96 * error) * float(np.ptp(minutes))
    if growth > FLAT_RSS_BYTES:
        broken.append(f"resident memory may have grown by {growth / 1024:.0f} KiB, allowed {FLAT_RSS_BYTES >> 10} KiB")
    spans = {}
    for key, allowed in (("handles", FLAT_HANDLES), ("threads", FLAT_THREADS)):
        values = [sample[key] for sample in later]
        spans[key] = [min(values), max(values), values[-1]]
        if values[-1] - values[0] > allowed:
            broken.append(f"{key} grew from {values[0]} to {values[-1]}")
    missed = sum(not sample["metrics"] for sample in samples)
    if missed:
        broken.append(f"{missed} of {len(samples)} scrapes of the metrics gave nothing")
    verdicts = verify_parts(out)
    broken += [f"{verdict.path}: {text}" for verdict in verdicts for text in (*verdict.violations, *verdict.alerts)]
    paths = parts_in(out)
    broken += [problem for path in paths if (problem := _replay_problem(path))]
    kept = sum(path.stat().st_size for path in paths)
    if kept > (KEEP_MB + ROTATE_MB) * 2**20:
        broken.append(f"{kept} bytes are kept, allowed {KEEP_MB} MiB and a part")
    return {
        "simulated": True,
        "minutes": samples[-1]["elapsed_s"] / 60,
        "samples": samples,
        "rss_first_bytes": int(rss[0]),
        "rss_last_bytes": int(rss[-1]),
        "rss_slope_kib_per_min": slope / 1024,
        "rss_slope_error_kib_per_min": 1.96 * error / 1024,
        **{f"{key}_min_max_last": span for key, span in spans.items()},
        "exit_code": exit_code,
        "goodbye_s": goodbye_s,
        "parts_kept": len(paths),
        "kept_bytes": kept,
        "decisions_kept": sum(read_recording(path).n_decisions for path in paths),
        "run": {key: summary.get(key) for key in KEPT},
        "broken": broken,
    }


def slope_of(x: np.ndarray[Any, Any], y: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Return the least-squares slope of y over x and its standard error; with neighbouring samples alike the error is too small."""
    if len(x) < 3 or not np.ptp(x):
        return 0.0, 0.0
    around = x - x.mean()
    slope = float(around @ y / (around @ around))
    residual = y - y.mean() - slope * around
    return slope, float(np.sqrt(residual @ residual / (len(x) - 2) / (around @ around)))


def _replay_problem(path: Path) -> str:
    try:
        recording = read_recording(path)
        found = replay(recording, recording.bundle())
    except PansError as error:
        return error.message
    return "" if found[:2] == (recording.n_decisions, recording.decisions_sha256) else f"{path}: its replay differs"


def _sample(pid: int, state: Path, port: int, out: Path, elapsed_s: float) -> dict[str, Any]:
    told = json.loads(state.read_text())
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    parts = list(out.glob("*.pansrec"))
    return {
        "elapsed_s": round(elapsed_s, 1),
        "rss_bytes": int(status["VmRSS"].split()[0]) * 1024,
        "handles": len(os.listdir(f"/proc/{pid}/fd")),
        "threads": int(status["Threads"]),
        "metrics": _scrape(port),
        "parts_on_disk": len(parts),
        "disk_bytes": sum(path.stat().st_size for path in parts),
        **{key: told.get(key, 0) for key in ("decisions", "late", "lost_exposures", "reconnects", "parts", "state")},
    }


def _scrape(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            return b"pans_decisions_total" in answer.read()
    except OSError:
        return False


def _wait_until_running(process: subprocess.Popen[str], state: Path) -> None:
    def running() -> bool:
        if process.poll() is not None:
            raise RuntimeError(f"the run did not start (exit code {process.poll()})")
        return state.exists() and json.loads(state.read_text())["state"] == "running"

    wait_until(running, READY_S, 0.2)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def _line(sample: dict[str, Any]) -> str:
    return (
        f"{sample['elapsed_s'] / 60:6.1f} min  {sample['state']:<12} RSS {sample['rss_bytes'] / 2**20:7.2f} MiB  "
        f"handles {sample['handles']:3}  threads {sample['threads']:2}  decisions {sample['decisions']:8}  "
        f"late {sample['late']:6}  lost {sample['lost_exposures']:7}  reconnects {sample['reconnects']:3}  "
        f"part {sample['parts']:4}, {sample['parts_on_disk']} on disk, {sample['disk_bytes'] / 2**20:.1f} MiB"
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """How long to run, and where."""

    minutes: float = option(30.0, "how long (default 30)")
    seed: int = option(1, "of the instrument and its faults (default 1)")
    folder: Path | None = option(None, "where to leave the recording and the state (default: nowhere)", type=Path)


def run(settings: Settings) -> Report:
    """Run, watch and judge."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = settings.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        figures = soak(settings.minutes, settings.seed, folder)
    words = figures_text({key: value for key, value in figures.items() if key != "samples"})
    return Report(figures, not figures["broken"], words)


TRIAL = Trial(Settings, run)
