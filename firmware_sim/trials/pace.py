"""Real time at real pace: decisions at 1000/s, the demo beside a busy core, automata driven by the host and by the device.

Owns the three parts, their rows and bars; processes and attribution are those of pans.firmware_sim.probes. At the other end is the
reference instrument in C (`pans simulate --engine c`) on the other core, its light SIMULATED. It shows no scene that moves: cells in flow
are those of flow.py, on the simulator in Python, and the demo has the instrument that it always has. `pans run` takes whatever turn it
chooses, or what stands behind `--`. It fails when a bar is missed (docs/how-to/real-time.md has them).

    objects   1000 still objects per second, one decision each, deadline 1 ms
    demo      `pans demo` again and again, while another process keeps one core busy
    walks     an automaton: the host drives at 1 kHz and 10 kHz, the device at 100 kHz
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from pans.firmware_sim.options import option
from pans.firmware_sim.probes.attribution import LINK, MACHINE
from pans.firmware_sim.probes.late_figures import late_figures, unexplained
from pans.firmware_sim.probes.processes import has_real_time
from pans.firmware_sim.probes.scheduling_probe import EVERY_US
from pans.firmware_sim.probes.watched import Outcome, Watched, run_watched
from pans.runtime.bench.loop import NO_TURNS, slot_profile
from pans.runtime.bundle.model import Bundle, bundle_path, load_bundle
from pans.runtime.cli import say
from pans.runtime.core.plan import build_plan
from pans.runtime.errors import UsageError

from . import Report, Trial
from .flow import cores_of

PARTS = ("objects", "demo", "walks")
LINKS = ("pty", "tcp")
SCENE = "fashion200"
STILL, WALKING = "fashion10", "fashion-adaptive"
OBJECT_SLOT_US = 1000 / 11  # ten patterns and a dark slot make a millisecond
OBJECT_DEADLINE_US = 1000.0
DEMO_DEADLINE_US = 16_667.0
FINISHED = (0, 1, 4)  # slots that stayed dark make a run fail, with figures
BUSY = "import os; os.sched_setaffinity(0, {%d})\nwhile True: sum(range(10000))"
LATE, OURS, MISSED = 1e-4, 1e-5, 0.002  # bars, as shares
KEPT = ("accuracy", "latency_us", "late_cause", "page_faults", "realtime", "armed_after_s", "ended", "turn", "faults")


class Walk(NamedTuple):
    """One automaton's run: who drives, exposure and the host's turn in us; their sum is a slot."""

    drive: str
    exposure_us: float
    turn_us: float

    @property
    def slots_hz(self) -> float:
        """Slots per second."""
        return 1e6 / (self.exposure_us + self.turn_us)


WALKS = (Walk("host", 100.0, 900.0), Walk("host", 10.0, 90.0), Walk("device", 10.0, 0.0))


@dataclass(frozen=True, slots=True)
class Settings:
    """What to measure, for how long, and where the processes run."""

    parts: tuple[str, ...] = option(
        (), f"{', '.join(PARTS)} (repeatable; default all)", flag="--part", action="append", choices=PARTS
    )
    seconds: float = option(60.0, "of each run of objects and walks (default 60)")
    times: int = option(20, "runs of the demo (default 20)")
    trials: int = option(5, "decisions per object of the demo (default 5: 1000 decisions)")
    links: tuple[str, ...] = option(
        (), "pty or tcp (repeatable; default both)", flag="--link", action="append", choices=LINKS
    )
    seed: int = option(1, "of the simulated light (default 1)")
    pin: tuple[int, int] | None = option(
        (0, 1), "cores of host and device, or none (default 0,1)", type=cores_of, metavar="HOST,DEVICE"
    )
    awake: bool = option(False, "bind the two loops alone, and keep their cores awake (--core)", action="store_true")
    canary_us: int = option(EVERY_US, f"period of the scheduling probes, 0: none (default {EVERY_US})")
    more: tuple[str, ...] = option((), "after --: further words for `pans run` and `pans demo`", flag="more", nargs="*")

    def watched(self, seconds: float, link: str) -> Watched:
        """Where and for how long the processes of one run are."""
        return Watched(self.pin, self.awake, self.canary_us, seconds, FINISHED, link)


# ---- the parts ----


def objects_rows(settings: Settings, links: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield a row for each link: decisions at 1000/s of still objects."""
    bundle, _ = load_bundle(STILL)
    with tempfile.TemporaryDirectory() as scratch:
        profile = Path(scratch) / "objects.toml"
        plan = build_plan(slot_profile(bundle, OBJECT_SLOT_US, profile), bundle)
        rate_hz = 1e6 / (plan.cycle_us * plan.cycles_per_object)
        for link in links:
            outcome = _run(settings, Path(scratch), profile, STILL, link, ["--deadline-us", str(OBJECT_DEADLINE_US)])
            row = _row(f"objects at {rate_hz:.0f}/s", link, outcome, OBJECT_DEADLINE_US)
            tracked = outcome.summary["stream"]["exposures"] / plan.slots_per_cycle
            row |= {"missed": max(0.0, 1 - row["decisions"] / max(tracked, 1.0)), **_kept(outcome)}
            yield row | {"broken": objects_broken(row)}


def demo_rows(settings: Settings) -> Iterator[dict[str, Any]]:
    """Yield a row for each run of the demo, while another process keeps the device's core busy."""
    core = max(os.sched_getaffinity(0)) if settings.pin is None else settings.pin[1]
    with _busy(core):
        for number in range(settings.times):
            with tempfile.TemporaryDirectory() as scratch:
                words = ["demo", "--trials", str(settings.trials), "--seed", str(settings.seed + number)]
                # the demo's two processes go where the scheduler puts them, as they do for a user
                watched = Watched(None, False, settings.canary_us, 0.0, FINISHED)
                outcome = run_watched(None, partial(_same, [*words, *settings.more]), watched, Path(scratch))
                row = _row(f"demo {number + 1} beside a busy core {core}", "tcp", outcome, DEMO_DEADLINE_US)
                row |= _kept(outcome)
            yield row | {"broken": demo_broken(row)}


def _same(words: list[str], url: str) -> list[str]:
    """The words of a command that opens a device of its own."""
    return words


def walk_rows(settings: Settings, links: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield a row for each automaton's run and link."""
    bundle, _ = load_bundle(WALKING)
    with tempfile.TemporaryDirectory() as scratch:
        for walk in WALKS:
            turns = {"host_turn_us": walk.turn_us} if walk.drive == "host" else NO_TURNS
            profile = Path(scratch) / f"{walk.drive}-{walk.slots_hz:.0f}.toml"
            slot_profile(bundle, walk.exposure_us, profile, turns)
            for link in links:
                outcome = _run(settings, Path(scratch), profile, WALKING, link, ["--drive", walk.drive])
                yield _walk_row(walk, link, bundle, outcome)


def _walk_row(walk: Walk, link: str, bundle: Bundle, outcome: Outcome) -> dict[str, Any]:
    summary = outcome.summary
    row = _row(f"{walk.drive} drives at {walk.slots_hz:.0f} slots/s", link, outcome, summary["deadline_us"])
    exposures = summary["stream"]["exposures"]
    turn = summary.get("turn_us") or {}
    row |= {
        "slots_hz": walk.slots_hz,
        "drive": walk.drive,
        "exposures": exposures,
        "late_slots": summary["late_slots"],
        "late_slots_share": summary["late_slots"] / max(exposures, 1),
        "lost": summary["lost"],
        "turn_us": turn,
        "turn_budget_us": summary["turn_budget_us"],
        "expected_accuracy": None if bundle.expected is None else bundle.expected["accuracy"],
        **_kept(outcome),
    }
    return row | {"broken": walk_broken(row)}


def _run(settings: Settings, scratch: Path, profile: Path, bundle: str, link: str, more: list[str]) -> Outcome:
    port = "pty" if link == "pty" else "tcp:127.0.0.1:0"
    instrument = [
        "--engine",
        "c",
        "--profile",
        str(profile),
        "--scene",
        SCENE,
        "--seed",
        str(settings.seed),
        "--listen",
        port,
    ]
    fixed = ["--profile", str(profile), "--seconds", str(settings.seconds), "--force", *more, *settings.more]

    def run_words(url: str) -> list[str]:
        return ["run", str(bundle_path(Path(bundle))), "--device", url, *fixed]

    return run_watched(instrument, run_words, settings.watched(settings.seconds, link), scratch)


def _row(name: str, link: str, outcome: Outcome, deadline_us: float) -> dict[str, Any]:
    figures, entries = late_figures(outcome, deadline_us)
    load = os.getloadavg()[0]
    told = [entry for entry in entries if entry["whose"] not in (MACHINE, LINK)]
    return {
        "name": name,
        "link": link,
        **figures,
        "unexplained": unexplained(figures),
        "told": told[:20],
        "load_1min": load,
    }


def _kept(outcome: Outcome) -> dict[str, Any]:
    return {key: outcome.summary[key] for key in KEPT if key in outcome.summary}


@contextmanager
def _busy(core: int) -> Iterator[None]:
    hog = subprocess.Popen([sys.executable, "-c", BUSY % core])
    try:
        yield
    finally:
        hog.kill()
        hog.wait()


# ---- the bars ----


def objects_broken(row: dict[str, Any]) -> list[str]:
    """Return a sentence for each bar that decisions at 1000/s missed."""
    n = max(row["decisions"], 1)
    broken = []
    if row["unexplained"] / n > OURS:
        broken.append(
            f"{row['unexplained']} of {n} late without a gap of the machine or its link that explains it, allowed {OURS:g}"
        )
    if row["late_share"] > LATE and row["unexplained"]:
        broken.append(f"late {row['late_share']:.2g}, allowed {LATE:g} or what the probes saw")
    if row["missed"] > MISSED:
        broken.append(f"missed {row['missed']:.2g}, allowed {MISSED:g}")
    return broken


def demo_broken(row: dict[str, Any]) -> list[str]:
    """Return a sentence if a demo had a late decision that no gap of the machine explains."""
    return [f"{row['unexplained']} of {row['late']} late are not the machine's"] if row["unexplained"] else []


def walk_broken(row: dict[str, Any]) -> list[str]:
    """Return a sentence for each bar that an automaton missed."""
    broken = []
    if row["drive"] == "host" and row["late_slots_share"] > LATE:
        broken.append(f"late slots {row['late_slots_share']:.2g}, allowed {LATE:g}")
    if row["drive"] == "device" and row["late"]:
        broken.append(f"{row['late']} late decisions, allowed none")
    if row["lost"]:
        broken.append(f"{row['lost']} exposures lost, allowed none")
    return broken


# ---- what is told ----


def row_words(row: dict[str, Any]) -> str:
    """Return one row in a line."""
    latency, whose = row["latency_us"], row["whose"]
    worst = max((gaps["largest_ms"] for gaps in row["gaps"]), default=0.0)
    text = (
        f"{row['name']:<32} {row['link']:<4} decisions {row['decisions']:>7}  late {row['late']:>5} "
        f"({', '.join(f'{name} {number}' for name, number in whose.items())})  "
        f"p50 {latency['p50']:.0f} p99 {latency['p99']:.0f} max {latency['max']:.0f} us  largest gap {worst:.1f} ms"
    )
    if "missed" in row:
        text += f"  missed {row['missed']:.3%}"
    if "late_slots" in row:
        turn = row["turn_us"]
        text += f"  late slots {row['late_slots']} of {row['exposures']} ({row['late_slots_share']:.2g})  lost {row['lost']}"
        text += f"  turn p50 {turn['p50']:.0f} p99 {turn['p99']:.0f} us of {row['turn_budget_us']:.0f}" if turn else ""
    accuracy = "unknown" if row["accuracy"] is None else f"{row['accuracy']:.2%}"
    return f"{text}  accuracy {accuracy}  load {row['load_1min']:.2f}" + "".join(
        f"\n    BROKEN {one}" for one in row["broken"]
    )


def run(settings: Settings) -> Report:
    """Run the parts that were asked for, and judge."""
    if not has_real_time():
        raise UsageError("this needs Linux and two cores: one each for host and device")
    links = tuple(settings.links) or LINKS
    made: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {
        "objects": lambda: objects_rows(settings, links),
        "demo": lambda: demo_rows(settings),
        "walks": lambda: walk_rows(settings, links),
    }
    rows = []
    for part in tuple(settings.parts) or PARTS:
        for row in made[part]():
            say(row_words(row))
            rows.append({"part": part, **row})
    broken = [f"{row['name']}, {row['link']}: {one}" for row in rows for one in row["broken"]]
    figures = {"simulated": True, "seconds": settings.seconds, "rows": rows, "broken": broken}
    words = "\n".join(["SIMULATED", *map(row_words, rows)])
    return Report(figures, not broken, words)


TRIAL = Trial(Settings, run, json_to_file=True)
