"""Cells in flow at real pace, watched by scheduling probes: every late decision with its cause, and whether the cores were there at all.

Owns the processes, what they are asked and the report; which gap explains which decision is flow_attribution.py's. Host and instrument
are the ordinary programs (`pans run`, `pans simulate`) at real pace, SIMULATED light; each core has a probe, which notes each time when
it woke later than its period. Linux, with the right to SCHED_FIFO. It fails when a bar is missed: too many late, missed or doubled
decisions, or a late one that the machine's gaps do not explain.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections import Counter
from dataclasses import MISSING, asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from pans.firmware_sim.options import option
from pans.runtime.cli import say
from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import load_profile
from pans.runtime.record import read_recording

from . import Report, Trial, figures_text
from .flow_attribution import (
    MACHINE,
    OURS,
    PARTLY,
    LateDecision,
    attribute,
    gap_figures,
    late_entry,
    late_table,
    verdict_of,
    worked_off,
)
from .processes import has_real_time, processor_s, real_time_programs, start_command, stolen_s, tail
from .scheduling_probe import EVERY_US, ProbeLog, SchedulingProbe

BARS = {"late": 1e-4, "missed": 0.005, "doubled": 0.001}
TOLD = 200  # late decisions that the machine does not explain, in the report; all of them are in the recording
LONGER_S = 120.0
LATE_EXIT = 4  # of `pans run`: finished, with late or lost work
PROGRESS_S = 10.0
KEPT = (
    "decisions", "accuracy", "accuracy_ci", "missed", "missed_ci", "doubled", "doubled_ci", "purity", "yield",
    "clicks_mean", "photons_mean", "aborted", "gates", "passages", "latency_us", "late", "late_blame", "late_cause",
    "lost", "realtime", "ended", "versions",
)  # fmt: skip


def _cores(text: str) -> tuple[int, int] | None:
    if text == "none":
        return None
    host, simulator = (int(core) for core in text.split(","))
    if not {host, simulator} <= os.sched_getaffinity(0):
        raise argparse.ArgumentTypeError(f"{text}: this process may use the cores {sorted(os.sched_getaffinity(0))}")
    return host, simulator


@dataclass(frozen=True, slots=True)
class Job:
    """What to run: as the options of the two programs; `pin` the cores of host and instrument, None to leave them free."""

    bundle: Path = option(MISSING, "a bundle trained for the profile and the scene", type=Path)  # noqa: RUF009
    profile: str = option("wdm-snspd", "hardware profile (default wdm-snspd)")
    scene: str = option("cells-in-flow", "what passes by (default: the shipped cells-in-flow)")
    flow: str = option("cells", "settings of the flow: cells or a TOML file (default cells)")
    seconds: float = option(600.0, "of instrument time, which is real time (default 600)")
    seed: int = option(5, "of the simulated instrument (default 5)")
    link: str = option("tcp", "between the two (default tcp)", choices=("tcp", "pty"))
    gate_classes: tuple[str, ...] = option(
        (), "to pulse for (repeatable, or a,b)", flag="--gate-class", action="append", metavar="NAME"
    )
    deadline_us: float = option(0.0, "from leaving to the decision (default: the profile's)")
    pin: tuple[int, int] | None = option(
        (0, 1), "cores of the two, or none (default 0,1)", type=_cores, metavar="HOST,SIM"
    )
    more: tuple[str, ...] = option((), "after --: further words for `pans run`", flag="more", nargs="*")
    canary_us: int = option(EVERY_US, f"period of the scheduling probes, and how late is a gap (default {EVERY_US})")
    awake: bool = option(
        False, "bind the two loops alone to their cores, and keep these awake (--core)", action="store_true"
    )
    folder: Path | None = option(None, "where to leave recording and summary (default: nowhere)", type=Path)  # noqa: RUF009


class Outcome(NamedTuple):
    """What came of a job: the summary of `pans run`, its recording, what the probes saw, processor time per second of the two."""

    summary: dict[str, Any]
    recording: Path
    logs: tuple[ProbeLog, ...]
    busy: dict[str, float]
    stolen_s: dict[int, float]  # by core, as the hypervisor tells in /proc/stat, while the probes were there
    others: tuple[str, ...]  # further programs of real-time priority on this computer: then it was not quiet


def carry_out(job: Job, folder: Path) -> Outcome:
    """Run host, instrument and a probe per core to their ends; RuntimeError when one of them fails."""
    cores = sorted(os.sched_getaffinity(0) if job.pin is None else set(job.pin))
    probes: list[SchedulingProbe] = []
    simulator = start_command(
        ["simulate", "--profile", job.profile, "--scene", job.scene, "--seed", str(job.seed), "--until-stdin-closes",
         "--listen", "pty" if job.link == "pty" else "tcp:127.0.0.1:0", *_awake_on(job, 1)],
        folder / "simulator.txt",
        _bound_to(job, 1),
    )  # fmt: skip
    host: subprocess.Popen[str] | None = None
    try:
        assert simulator.stdout is not None
        url = simulator.stdout.readline().strip()
        if not url:
            raise RuntimeError(f"the simulator ended with {simulator.wait()}: {tail(folder / 'simulator.txt')}")
        probes = [SchedulingProbe(core, every_us=job.canary_us) for core in cores]
        stolen_before = stolen_s(cores)
        words = ["run", str(job.bundle), "--device", url, "--profile", job.profile, "--flow", job.flow]
        words += ["--seconds", str(job.seconds), "--out", str(folder / "out"), "--json"]
        words += [word for name in job.gate_classes for word in ("--gate-class", name)]
        words += ["--deadline-us", str(job.deadline_us)] if job.deadline_us else []
        host = start_command([*words, *_awake_on(job, 0), *job.more], folder / "host.txt", _bound_to(job, 0))
        busy, others = _wait(host, simulator, job.seconds, {probe.pid for probe in probes})
        out, _ = host.communicate()
        if host.returncode not in (0, LATE_EXIT):
            raise RuntimeError(f"the host ended with {host.returncode}: {tail(folder / 'host.txt')}")
        stolen = {core: since - stolen_before[core] for core, since in stolen_s(cores).items()}
        logs = tuple(probe.end() for probe in probes)
        summary = json.loads(out)
        return Outcome(summary, Path(summary["recording"]), logs, busy, stolen, others)
    finally:
        for probe in probes:
            probe.kill()
        for process in (host, simulator):
            if process is not None:
                process.kill()
                process.communicate()


def _awake_on(job: Job, which: int) -> list[str]:
    """Options that pin the loop of host (0) or instrument (1) to its core."""
    return ["--core", str(job.pin[which])] if job.awake and job.pin is not None else []


def _bound_to(job: Job, which: int) -> int | None:
    """The core that the whole process of host (0) or instrument (1) is bound to."""
    return None if job.awake or job.pin is None else job.pin[which]


def _wait(
    host: subprocess.Popen[str], simulator: subprocess.Popen[str], seconds: float, probes: set[int]
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Wait for the host's end; return what `Outcome` calls `busy`, between a fifth of the run and its end, and `others`."""
    others: set[str] = set()
    began = time.monotonic()
    samples: list[tuple[float, float, float]] = []
    while host.poll() is None:
        elapsed = time.monotonic() - began
        if elapsed > seconds + LONGER_S:
            raise RuntimeError(f"the host did not end within {elapsed:.0f} s")
        try:
            samples.append((elapsed, processor_s(host.pid), processor_s(simulator.pid)))
        except OSError:  # it has just ended
            break
        others |= real_time_programs(probes | {host.pid, simulator.pid})
        if len(samples) % round(PROGRESS_S) == 0:
            say(f"{elapsed:6.0f} s")
        time.sleep(min(1.0, max(seconds / 10, 0.05)))
    host.wait()
    last = samples[-2] if len(samples) > 1 else samples[-1]
    first = next(sample for sample in samples if sample[0] >= 0.2 * last[0])
    lasted = max(last[0] - first[0], 1e-9)
    busy = {"host": (last[1] - first[1]) / lasted, "simulator": (last[2] - first[2]) / lasted}
    return busy, tuple(sorted(others))


# ---- what came of it ----


def report(job: Job, outcome: Outcome) -> dict[str, Any]:
    """Return the figures, every late decision that the machine does not explain, and `broken`: a sentence for each bar missed."""
    recording = read_recording(outcome.recording)
    timings, events = recording.timings(), list(recording.events())
    late_numbers = [int(event["decision"]) for event in events if event["kind"] == "late"]
    verdicts = [event for event in events if event["kind"] == "blame" and event["what"] == "late"]
    gaps = [gap for log in outcome.logs for gap in log.gaps]
    deadline_us = job.deadline_us or load_profile(job.profile).timing.decision_deadline_us
    found = attribute(timings, late_numbers, gaps, round(deadline_us * 1000))
    whose = Counter(late.whose for late in found)
    begin_ns = int(timings["device_end_ns"][0]) if len(timings) else 0
    end_ns = int(timings["decided_ns"][-1]) if len(timings) else 1
    entries = [late_entry(late, verdict_of(late.number, verdicts)) for late in found]
    unexplained = [entry for entry in entries if entry["whose"] != MACHINE]
    facts = {key: value for key, value in asdict(job).items() if key != "folder"}
    summary = {key: outcome.summary[key] for key in KEPT if key in outcome.summary}
    result = {
        "simulated": True,
        "job": {key: str(value) if isinstance(value, Path) else value for key, value in facts.items()},
        "deadline_us": deadline_us,
        "seconds": (end_ns - begin_ns) / 1e9,
        "decisions": len(timings),
        "late": len(late_numbers),
        "late_share": len(late_numbers) / max(len(timings), 1),
        "whose": {name: whose[name] for name in (MACHINE, PARTLY, OURS)},
        "partly_worked_off": sum(worked_off(late, outcome.busy["host"]) for late in found),
        "machine_by_core": _by_core(found),
        "machine_queued": sum(late.queued for late in found if late.whose == MACHINE),
        "named": late_table(found, verdicts),
        "gaps": [
            gap_figures(log, begin_ns, end_ns) | {"stolen_ms": 1000 * outcome.stolen_s[log.core]}
            for log in outcome.logs
        ],
        "busy": outcome.busy,
        "other_real_time_programs": list(outcome.others),
        "run": summary,
        "explained": [entry for entry in entries if entry["whose"] == MACHINE][:TOLD],
        "unexplained": unexplained[:TOLD],
    }
    return result | {"broken": broken_bars(result)}


def _by_core(found: list[LateDecision]) -> dict[str, int]:
    return dict(Counter("+".join(map(str, late.cores)) for late in found if late.whose == MACHINE))


def broken_bars(result: dict[str, Any]) -> list[str]:
    """Return one sentence for each bar that was missed."""
    run, whose = result["run"], result["whose"]
    shares = {"late": result["late_share"], "missed": run.get("missed"), "doubled": run.get("doubled")}
    broken = [
        f"{name}: {share:.3g} of the decisions, allowed {BARS[name]:g}"
        for name, share in shares.items()
        if share is not None and share > BARS[name]
    ]
    short = whose[PARTLY] - result["partly_worked_off"]
    if short + whose[OURS]:
        broken.append(f"{whose[OURS]} late decisions without any gap of the machine, {short} with too short ones")
    return broken


def run(job: Job) -> Report:
    """Run and judge."""
    if not has_real_time():
        raise UsageError("this needs Linux and two cores: one each for host and instrument")
    classes = tuple(name for names in job.gate_classes for name in names.split(","))
    with tempfile.TemporaryDirectory() as scratch:
        folder = job.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        job = replace(job, gate_classes=classes, more=tuple(job.more))
        figures = report(job, carry_out(job, folder))
    words = figures_text({key: value for key, value in figures.items() if key not in ("job", "explained")})
    return Report(figures, not figures["broken"], words)


TRIAL = Trial(Job, run, json_to_file=True)
