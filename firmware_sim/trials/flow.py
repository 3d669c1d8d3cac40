"""Cells in flow at real pace, watched by scheduling probes: every late decision with its cause, and whether the cores were there at all.

Owns the processes, what they are asked and the report; which gap explains which decision is probes/attribution.py's. Host and instrument
are the ordinary programs (`pans run`, `pans simulate`) at real pace, SIMULATED light; each core has a probe, which notes each time when
it woke later than its period. Linux, with the right to SCHED_FIFO. It fails when a bar is missed: too many late, missed or doubled
decisions, or a late one that the machine's gaps do not explain.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import MISSING, asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pans.firmware_sim.options import option
from pans.firmware_sim.probes.attribution import LINK, MACHINE, OURS, PARTLY
from pans.firmware_sim.probes.late_figures import late_figures
from pans.firmware_sim.probes.processes import has_real_time
from pans.firmware_sim.probes.scheduling_probe import EVERY_US
from pans.firmware_sim.probes.watched import Outcome, Watched, run_watched
from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import load_profile

from . import Report, Trial, figures_text

BARS = {"late": 1e-4, "missed": 0.005, "doubled": 0.001}
TOLD = 200  # late decisions that the machine does not explain, in the report; all of them are in the recording
KEPT = (
    "decisions", "accuracy", "accuracy_ci", "missed", "missed_ci", "doubled", "doubled_ci", "purity", "yield",
    "clicks_mean", "photons_mean", "aborted", "gates", "passages", "latency_us", "late", "late_blame", "late_cause",
    "lost", "realtime", "ended", "versions",
)  # fmt: skip


def cores_of(text: str) -> tuple[int, int] | None:
    """Return the cores of host and instrument of a word `HOST,SIM`; None for `none`."""
    if text == "none":
        return None
    host, simulator = (int(core) for core in text.split(","))
    if not {host, simulator} <= os.sched_getaffinity(0):
        raise argparse.ArgumentTypeError(f"{text}: this process may use the cores {sorted(os.sched_getaffinity(0))}")
    return host, simulator


@dataclass(frozen=True, slots=True)
class Job:
    """What to run: as the options of the two programs; `pin` the cores of host and instrument, None to leave them free."""

    bundle: Path = option(MISSING, "a bundle trained for the profile and the scene", type=Path)
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
        (0, 1), "cores of the two, or none (default 0,1)", type=cores_of, metavar="HOST,SIM"
    )
    more: tuple[str, ...] = option((), "after --: further words for `pans run`", flag="more", nargs="*")
    canary_us: int = option(EVERY_US, f"period of the scheduling probes, and how late is a gap (default {EVERY_US})")
    awake: bool = option(
        False, "bind the two loops alone to their cores, and keep these awake (--core)", action="store_true"
    )
    folder: Path | None = option(None, "where to leave recording and summary (default: nowhere)", type=Path)


def carry_out(job: Job, folder: Path) -> Outcome:
    """Run host, instrument and a probe per core to their ends; RuntimeError when one of them fails."""
    port = "pty" if job.link == "pty" else "tcp:127.0.0.1:0"
    words = ["--profile", job.profile, "--scene", job.scene, "--seed", str(job.seed), "--listen", port]

    def run_words(url: str) -> list[str]:
        words = ["run", str(job.bundle), "--device", url, "--profile", job.profile, "--flow", job.flow]
        words += ["--seconds", str(job.seconds)]
        words += [word for name in job.gate_classes for word in ("--gate-class", name)]
        words += ["--deadline-us", str(job.deadline_us)] if job.deadline_us else []
        return [*words, *job.more]

    watched = Watched(job.pin, awake=job.awake, canary_us=job.canary_us, seconds=job.seconds, link=job.link)
    return run_watched(words, run_words, watched, folder)


# ---- what came of it ----


def report(job: Job, outcome: Outcome) -> dict[str, Any]:
    """Return the figures, every late decision that the machine does not explain, and `broken`: a sentence for each bar missed."""
    deadline_us = job.deadline_us or load_profile(job.profile).timing.decision_deadline_us
    figures, entries = late_figures(outcome, deadline_us)
    facts = {key: value for key, value in asdict(job).items() if key != "folder"}
    result = {
        "simulated": True,
        "job": {key: str(value) if isinstance(value, Path) else value for key, value in facts.items()},
        **figures,
        "run": {key: outcome.summary[key] for key in KEPT if key in outcome.summary},
        "explained": [entry for entry in entries if entry["whose"] in (MACHINE, LINK)][:TOLD],
        "unexplained": [entry for entry in entries if entry["whose"] not in (MACHINE, LINK)][:TOLD],
    }
    return result | {"broken": broken_bars(result)}


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
