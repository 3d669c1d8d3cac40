"""`RunOptions`: what `pans run` and `pans demo` are asked for. Each option is a field, written here once.

The command line and the file of options fill it, the recording's header records it, `run_live` takes it. To add an option: add a field
here, use it where it acts, test it, describe it in docs/reference/commands.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pans.base.console import option
from pans.base.files import MIB, RUNS
from pans.base.numbers import Range
from pans.bundle.backends import backend_names
from pans.instrument.calibration_file import MAX_AGE_H

AUTOMATA = "automata (docs/how-to/automata.md)"
LIVE_PAGE = "live page (docs/how-to/live-view.md)"
NEIGHBOURS = "neighbours (docs/how-to/neighbours.md)"
FLOW = "objects in flow (docs/how-to/flow.md)"
DARK = "calibration and dark counts (docs/how-to/calibrate.md, docs/how-to/dark-counts.md)"
DAYS = "running for days"
DEVICE = "device"  # of `act`: the pulse is the device's own
DISK_RESERVE_MB = 64.0  # half a minute of the fastest shipped profile, and room for the summary
COUNT = Range(1, 1 << 20, whole=True)
DECISIONS_MAX, SECONDS_MAX = 10**12, 1e9  # thirty years: at 1000 decisions a second, and in seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """What to run. The fields at the end are no options: a program sets them."""

    bundle: Path = option(Path(), "a trained bundle (.pans)", flag="bundle")
    device: str = option("", "device URL, for example serial:/dev/ttyACM0 or sim:ideal?pace=fast", required=True)
    profile: str | None = option(
        None, "hardware profile: a shipped name or a TOML file (default: the sim: URL's, of the demo dmd-spad)"
    )
    record: Path | None = option(None, "recording to write (default: run.pansrec in --out)", type=Path)
    decisions: int = option(0, "stop after this many decisions", range=Range(0, DECISIONS_MAX, whole=True))
    dose_cap: float | None = option(
        None,
        "no object receives more than N photoelectrons of illumination: walks end in time, fixed patterns must all fit",
        range=Range(1e-9, 1e15),
        metavar="N",
    )
    shots: int = option(1, "shots per decision (default 1)", range=COUNT, metavar="K")
    trials: int = option(1, "decisions per object (default 1, of the demo 5)", range=COUNT, metavar="N")
    seconds: float = option(0.0, "stop after this time", range=Range(0, SECONDS_MAX))
    deadline_us: float = option(
        0.0, "decision deadline (default: the profile's; of the demo 16667)", range=Range(0, 1e9)
    )
    order: str = option("auto", "pattern order", choices=("auto", "pattern-major", "shot-major"))
    dark_slots: int = option(1, "dark displays per cycle (default 1)", range=Range(0, 65534, whole=True))
    backend: str = option("auto", "decision back end", choices=backend_names)
    realtime: bool = option(True, "do not ask for SCHED_FIFO and locked memory", flag="--no-realtime")
    realtime_simulated: bool = option(
        False, "ask for SCHED_FIFO and locked memory with a simulated device too", flag="--realtime"
    )
    core: int | None = option(None, "pin to core N and busy-wait; uses 100 %% of that core", type=int, metavar="N")
    any_core: bool = option(False, "do not keep a core for the thread that decides")
    out: Path | None = option(
        None, f"folder for the recording and the summary (default: a new one in {RUNS})", type=Path, metavar="DIR"
    )
    force: bool = option(False, "replace files that exist")
    reconnect_s: float = option(
        10.0, "how long to look for a lost device (default 10, 0: not at all)", range=Range(0, 1e6)
    )
    trace: Path | None = option(
        None, "write all bytes of both directions as hex, with times", type=Path, metavar="FILE"
    )

    drive: str = option(
        "auto",
        "who chooses the next pattern by the clicks: the device where it can (auto), the device, or the host",
        choices=("auto", "device", "host"),
        group=AUTOMATA,
    )
    confidence: float = option(
        0.0,
        "decide as soon as a class is this probable, and abstain where none is at the end (default: walk to the end)",
        range=Range(0.0, 1.0),
        metavar="C",
        group=AUTOMATA,
    )

    serve: str = option(
        "", "show the run as a web page; a port alone: this machine only", metavar="HOST:PORT", group=LIVE_PAGE
    )
    serve_public: bool = option(False, "let other machines see the page; there is no password", group=LIVE_PAGE)
    serve_control: bool = option(False, "let the page stop the run and put notes into the recording", group=LIVE_PAGE)

    osc: str = option(
        "",
        "send each decision there as an OSC message; a port alone: this machine",
        metavar="HOST:PORT",
        group=NEIGHBOURS,
    )

    flow: str | None = option(
        None, "settings of the flow: shipped ones or a TOML file", metavar="cells|tape|FILE", group=FLOW
    )
    gate_class: tuple[str, ...] = option(
        (), "class to pulse for (repeatable, or a,b)", action="append", metavar="NAME", group=FLOW
    )
    gate_delay_us: float | None = option(
        None, "from leaving to the pulse (default: the settings', 900)", range=Range(0, 1e6), metavar="US", group=FLOW
    )
    act: str = option(
        DEVICE,
        "what makes the pulse: device (default: its GATE command), a second instrument's URL (tcp:HOST:PORT too), or NAME:...",
        metavar="URL",
        group=FLOW,
    )
    act_profile: str | None = option(
        None, "hardware profile of the second instrument (default: that of the first)", metavar="PROFILE", group=FLOW
    )
    pool: int | None = option(
        None,
        "windows side by side whose evidence is added (default: the settings', 1)",
        range=Range(1, 64, whole=True),
        metavar="N",
        group=FLOW,
    )

    calibration: Path | None = option(
        None, "what `pans calibrate` measured on this instrument", type=Path, metavar="FILE", group=DARK
    )
    registration: Path | None = option(
        None,
        "correct the patterns for the table that `pans calibrate --registration` measured",
        type=Path,
        metavar="FILE",
        group=DARK,
    )
    calibration_max_age_h: float = option(
        MAX_AGE_H,
        f"older is stale: a calibration is warned about, a registration refused (default {MAX_AGE_H:g})",
        range=Range(1e-9, 1e6),
        metavar="H",
        group=DARK,
    )
    on_dark: str = option(
        "warn",
        "when dark counts have changed: report it (default), decide with adapted tables, leave channels out, or abstain",
        choices=("warn", "tables", "mask", "abstain"),
        group=DARK,
    )

    rotate_mb: float | None = option(
        None, "record in parts of about N MiB (default: one file)", range=Range(1e-6, 1e6), metavar="N", group=DAYS
    )
    keep_mb: float | None = option(
        None, "delete the oldest parts above N MiB (default: keep all)", range=Range(1e-6, 1e9), metavar="N", group=DAYS
    )
    keep_runs_mb: float | None = option(
        None,
        f"at the start, delete the oldest runs in {RUNS} of the same command, so that all stay within N MiB (default: keep all)",
        range=Range(1e-6, 1e9),
        metavar="N",
        group=DAYS,
    )
    disk_reserve_mb: float = option(
        DISK_RESERVE_MB,
        f"stop in order before less than N MiB are free on the recording's disk (default {DISK_RESERVE_MB:g}; 0: never)",
        range=Range(0, 1e9),
        metavar="N",
        group=DAYS,
    )
    late_allowed: float = option(
        0.0,
        "share of decisions that may be late before the verdict is FAIL, such as 0.001 (default 0)",
        range=Range(0.0, 1.0),
        metavar="SHARE",
        group=DAYS,
    )
    state: Path | None = option(
        None, "write the run's state there as JSON, each second", type=Path, metavar="FILE", group=DAYS
    )
    metrics: str = option(
        "", "serve figures for Prometheus; a port alone: this machine only", metavar="HOST:PORT", group=DAYS
    )
    metrics_public: bool = option(False, "let other machines read the figures; there is no password", group=DAYS)

    out_root: Path | None = None  # where a new folder, named by date and bundle, is made and becomes `out`
    files_read: tuple[Path, ...] = ()  # beside those that the options name
    command: str = ""  # the command line, for the recording and the page
    display: bool = True  # what happens, on stderr
    warns_uncalibrated: bool = False  # where a calibration is missing or old
    may_be_busy: bool = False  # few decisions that a busy computer made late are no fault
    n_cycles: int = 0  # 0: until `seconds` have passed or the device stops
    lease_ms: int = 1000
    started_ns: int = 0  # time.perf_counter_ns from which "armed after" counts; 0: the call of run_live

    @property
    def recording(self) -> Path | None:
        """The recording to write, if any."""
        return self.record if self.record or self.out is None else self.out / "run.pansrec"

    @property
    def page(self) -> Path | None:
        """The summary page to write, if any."""
        if self.out is not None:
            return self.out / "summary.md"
        return None if self.record is None else self.record.with_name(f"{self.record.stem}.summary.md")

    @property
    def rotate_bytes(self) -> int:
        """At how many bytes a part of the recording ends; 0: the recording is one file."""
        return max(1, round(self.rotate_mb * MIB)) if self.rotate_mb else 0

    @property
    def keep_bytes(self) -> int:
        """How many bytes of parts are kept; 0: all."""
        return round((self.keep_mb or 0.0) * MIB)

    @property
    def stop_below(self) -> int:
        """Bytes of free disk below which a run ends. Where parts can be deleted that comes first."""
        reserve = round(self.disk_reserve_mb * MIB)
        return min(reserve, self.rotate_bytes // 2) if self.rotate_bytes else reserve
