"""Rates at real pace over TCP: still objects at 1000/s, an automaton that the host drives at 1 kHz, one that the device drives at 100 kHz.

`pans simulate` and `pans run` are processes of their own, each on a core. Probes of high priority on both cores note when a core was away;
a late decision counts here only if the gaps that they saw do not explain it. Counts are asserted (missed, lost, late without a gap); `-s`
prints the rest. The rates need a quiet machine with two cores and the right to real-time priority.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.app.bench.loop import slot_profile
from pans.bundle.sensor.bundle import load_bundle
from pans.decide.plan.plan import build_plan
from pans.record.reading import read_recording

HOST, DEVICE = 0, 1  # cores
POSSIBLE = sys.platform == "linux" and {HOST, DEVICE} <= os.sched_getaffinity(0) and os.geteuid() == 0
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not POSSIBLE, reason="needs Linux, two cores and the right to real-time priority"),
]
PANS = [sys.executable, "-c", "import sys; from pans.app.main import main; sys.exit(main(sys.argv[1:]))"]
OBJECT_SLOT_US = 1000 / 11  # ten patterns and a dark slot make a millisecond
DEADLINE_US = 1000.0
OURS = 1e-5  # share of the decisions that may be late without a gap of the machine
CATCH_UP = 3  # what waited during a gap is worked off within three times its length
PROBE_S = 0.0002
PROBE = f"""
import json, os, sys, time
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
gaps, due = [], time.perf_counter()
os.set_blocking(0, False)
print("ready", flush=True)
for number in range(sys.maxsize):
    due = max(due, time.perf_counter()) + {PROBE_S}
    time.sleep(max(due - time.perf_counter(), 0))
    late = time.perf_counter() - due
    if late > {PROBE_S}:
        gaps.append((int(due * 1e9), int((due + late) * 1e9)))
    if number % 100 == 0 and sys.stdin.buffer.read(1) == b"":
        break
print(json.dumps(gaps))
"""


@contextmanager
def process(words: list[str], core: int, log: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a program on one core; it ends when its standard input closes."""
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with log.open("w") as errors:
        child = subprocess.Popen(words, stderr=errors, preexec_fn=lambda: os.sched_setaffinity(0, {core}), **pipes)
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def first_line(child: subprocess.Popen[str]) -> str:
    return child.stdout.readline().strip()


def measured(bundle: str, profile: Path, seconds: float, *more: str) -> tuple[dict[str, Any], np.ndarray]:
    """Run a bundle on a simulated instrument of `profile`; return the summary, and the gaps of both cores, host ns (n, 2)."""
    folder = profile.parent
    device = [*PANS, "simulate", "--profile", str(profile), "--seed", "1", "--listen", "tcp:127.0.0.1:0"]
    with process([*device, "--until-stdin-closes"], DEVICE, folder / "device.txt") as instrument:
        words = [*PANS, "run", bundle, "--device", first_line(instrument), "--profile", str(profile), "--json"]
        words += ["--out", str(folder / "out"), "--seconds", str(seconds), *more]
        probe = [sys.executable, "-c", PROBE]
        with (
            process(probe, HOST, folder / "0.txt") as first,
            process(probe, DEVICE, folder / "1.txt") as second,
            process(words, HOST, folder / "host.txt") as host,
        ):
            assert [first_line(one) for one in (first, second)] == ["ready"] * 2
            said, _ = host.communicate(timeout=seconds + 240)
            gaps = [gap for one in (first, second) for gap in json.loads(one.communicate(timeout=10)[0])]
    assert host.returncode in (0, 1, 4), (folder / "host.txt").read_text()[-2000:]
    return json.loads(said), np.array(sorted(gaps), np.int64).reshape(-1, 2)


def explained(row: np.void, gaps: np.ndarray, deadline_ns: float) -> bool:
    """Whether a decision would have been on time without the gaps that it met, or that were still being worked off."""
    begin, end = int(row["device_end_ns"]), int(row["decided_ns"])
    met = gaps[(gaps[:, 0] < end) & (begin - gaps[:, 1] <= CATCH_UP * (gaps[:, 1] - gaps[:, 0]))]
    return bool((met[:, 1] - met[:, 0]).sum() >= end - begin - deadline_ns)


def report(name: str, summary: dict[str, Any], gaps: np.ndarray, **more: object) -> None:
    lengths_ms = (gaps[:, 1] - gaps[:, 0]) / 1e6
    figures = {key: summary.get(key) for key in ("decisions", "late", "late_cause", "late_slots", "lost", "latency_us")}
    figures |= {"turn_us": summary.get("turn_us"), "exposures": summary["stream"]["exposures"], **more}
    figures |= {"gaps": len(gaps), "longest_gap_ms": float(lengths_ms.max(initial=0)), "load": os.getloadavg()[0]}
    print(f"\nSIMULATED {name}: {json.dumps(figures)}")


def test_a_thousand_still_objects_per_second(tmp_path: Path) -> None:
    bundle, _ = load_bundle("fashion10")
    plan = build_plan(slot_profile(bundle, OBJECT_SLOT_US, tmp_path / "objects.toml"), bundle)
    summary, gaps = measured("fashion10", tmp_path / "objects.toml", 60, "--deadline-us", str(DEADLINE_US))
    recording = read_recording(Path(summary["recording"]))
    timings = recording.timings()
    late = timings[[int(event["decision"]) for event in recording.events() if event["kind"] == "late"]]
    ours = [row for row in late if not explained(row, gaps, DEADLINE_US * 1000)]
    missed = summary["stream"]["exposures"] // (plan.slots_per_cycle * plan.cycles_per_object) - summary["decisions"]
    report("objects at 1000/s", summary, gaps, missed=missed, late_outside_gaps=len(ours))
    assert (missed, summary["lost"]) == (0, 0)
    assert len(timings) > 59_000
    assert len(ours) <= OURS * len(timings)


@pytest.mark.parametrize(
    ("drive", "exposure_us", "turn_us", "seconds"),
    [("host", 100.0, 900.0, 60), ("device", 10.0, 0.0, 10)],
    ids=["host at 1 kHz", "device at 100 kHz"],
)
def test_an_automaton_loses_no_exposure(
    drive: str, exposure_us: float, turn_us: float, seconds: float, tmp_path: Path
) -> None:
    bundle, _ = load_bundle("fashion-adaptive")
    path = tmp_path / "walks.toml"
    slot_profile(bundle, exposure_us, path)
    path.write_text(path.read_text().replace("host_turn_us = 1000.0", f"host_turn_us = {turn_us}"))
    summary, gaps = measured("fashion-adaptive", path, seconds, "--drive", drive)
    report(f"{drive} drives", summary, gaps)
    assert summary["lost"] == 0
    assert summary["stream"]["exposures"] * (exposure_us + turn_us) >= 0.95e6 * seconds
