"""`pans doctor --realtime`: what each real-time setting brings on this computer, as a table and as JSON.

Owns the rows, what is compared with what, and the advice; measuring is pans.runtime.timing.rehearsal's. A condition counts as a help (or
a harm) only if it was better (or worse) in every round: anything less may be the machine's noise of that second.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any, NamedTuple

from pans.runtime.cli import say
from pans.runtime.cli.talk import is_quiet
from pans.runtime.errors import UsageError
from pans.runtime.link.serial import FTDI_SLOW_MS
from pans.runtime.timing.conditions import GRANTED
from pans.runtime.timing.machine import Machine, read_machine
from pans.runtime.timing.rehearsal import SECONDS, Rehearsal, Turns, rehearse
from pans.runtime.timing.wakeups import figures

from .doctor_checks import Finding

HELPS, HARMS = 0.9, 1.1  # ratio of p99, besides every round
LIMITS = "allow it: echo '$USER - {line}' | sudo tee -a /etc/security/limits.d/pans.conf, log in again"
SLOW_WORK = 1.25  # work after a pause against work without one
AWAY_MS_PER_S = 1.0
AWAY_US = 200.0  # a fifth of the shortest deadline (1 ms)


@dataclass(frozen=True, slots=True)
class Setting:
    """One row: what is in force, what was measured without and with it (figures, or {} where it was not tried), and what to do."""

    setting: str
    in_force: str
    measured: str
    without: dict[str, Any]
    with_it: dict[str, Any]
    rounds_better: int | None
    rounds: int | None
    effect: str  # helps, harms, none, or "" where nothing was compared
    do: str

    def as_json(self) -> dict[str, Any]:
        """Return the row; `with` is a word of Python."""
        facts = asdict(self)
        return {("with" if key == "with_it" else key): value for key, value in facts.items()}


def measure(seconds: float = SECONDS) -> tuple[Machine, Rehearsal]:
    """Measure, with a sign of life and a bar; UsageError where this system has no such measurement."""
    if sys.platform == "win32":
        raise UsageError(
            "--realtime measures on Linux and macOS only", remedy="pans bench link measures the whole path"
        )
    say(
        f"pans: measuring wake-ups for about {seconds:.0f} s; what else runs now takes part, and a live run would suffer"
    )
    machine = read_machine()
    with _bar() as tell:
        return machine, rehearse(machine, seconds, tell)


@contextmanager
def _bar() -> Iterator[Callable[[float], None]]:
    if is_quiet() or not sys.stderr.isatty():
        yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (TextColumn("real time"), BarColumn(), TaskProgressColumn())
    # no thread that draws: it would take part in what is measured
    with Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False) as progress:
        task = progress.add_task("", total=1.0)

        def tell(share: float) -> None:
            progress.update(task, completed=share)
            progress.refresh()

        yield tell


# ---- the rows ----


def settings_of(machine: Machine, found: Rehearsal) -> list[Setting]:
    """Return a row for each setting."""
    rows = [_fifo(found), _bound(found), _awake(found), _idle(machine, found), _timers(found)]
    rows += [_governor(machine, found), _isolated(machine, found), _locked(found), _virtual(machine, found)]
    rows.append(_terminal(found))
    return [*rows, *_serial(machine)]


class _Of(NamedTuple):
    """What a row compares: a kind of wake-up under two arms, by a quantile."""

    kind: str
    before: str
    after: str
    quantile: float = 0.99


_WOKEN = {"sleep": "woken by a timer", "pipe": "woken by another process"}


def _compared(name: str, in_force: str, what: _Of, found: Rehearsal, do: dict[str, str]) -> Setting:
    """A row that compares two arms; `do` by effect, and "refused" for an arm that was not granted."""
    before, after = (found.arms.get(arm, Turns()) for arm in (what.before, what.after))
    first, second = (arm.by_round(what.kind, what.quantile) for arm in (before, after))
    effect, better = _effect(first, second)
    return Setting(
        setting=name,
        in_force=in_force,
        measured=f"{_WOKEN[what.kind]}: {what.before}; {what.after} (compared by p{100 * what.quantile:.0f})",
        without=figures(before.all_of(what.kind)),
        with_it=figures(after.all_of(what.kind)),
        rounds_better=better if effect else None,
        rounds=len(first) if effect else None,
        effect=effect,
        do=do.get(effect or "refused", do["none"]),
    )


def _effect(before: list[float], after: list[float]) -> tuple[str, int]:
    """Return what a condition does, by one figure of each round, and in how many rounds it was better; "" where it was not tried."""
    if not before or len(before) != len(after):
        return "", 0
    better = sum(one > two for one, two in zip(before, after))
    worse = sum(one < two for one, two in zip(before, after))
    ratio = median(after) / median(before)
    if better == len(before) and ratio < HELPS:
        return "helps", better
    return ("harms" if worse == len(before) and ratio > HARMS else "none"), better


def _fifo(found: Rehearsal) -> Setting:
    do = dict.fromkeys(("helps", "none"), "nothing: a run asks for it")
    do |= {"harms": "compare once more on a quiet machine; --no-realtime leaves it out"}
    do |= {"refused": LIMITS.format(line="rtprio 20")}
    return _compared("SCHED_FIFO", found.fifo, _Of("pipe", "ordinary", "SCHED_FIFO"), found, do)


def _bound(found: Rehearsal) -> Setting:
    cores = ", ".join(str(row["core"]) for row in found.cores) or "unknown"
    do = {
        "helps": f"--core {found.host} binds the loop",
        "harms": "nothing: bind only with SCHED_FIFO, since others keep running on that core",
        "none": "nothing",
    }
    return _compared("affinity", f"cores {cores} allowed", _Of("pipe", "ordinary", "bound"), found, do)


def _awake(found: Rehearsal) -> Setting:
    pair = f"pans run --core {found.host}"
    pair += "" if found.device is None else f", and a simulated device on pans simulate --core {found.device}"
    do = {"helps": f"{pair}: each takes all of its core", "harms": "leave --core out", "none": "leave --core out here"}
    return _compared("core kept awake", "no: by --core N", _Of("pipe", found.base, "kept awake"), found, do)


def _idle(machine: Machine, found: Rehearsal) -> Setting:
    states = ", ".join(f"{state.name} {state.exit_us} us" for state in machine.idle_states)
    told = f"{machine.idle_driver or 'no driver'}: {states}" if states else "not told by this system"
    do = {
        "helps": "--core keeps one core out of them; for all: idle=poll or processor.max_cstate=1 at boot",
        "harms": "leave them as they are",
        "none": "nothing",
        "refused": "to try it, run this as root: the file /dev/cpu_dma_latency is root's",
    }
    return _compared("C-states", told, _Of("sleep", found.base, "shallow idle states", 0.5), found, do)


def _timers(found: Rehearsal) -> Setting:
    do = {
        "helps": "nothing: SCHED_FIFO has exact timers" if found.fifo == GRANTED else "allow SCHED_FIFO",
        "none": "nothing",
    }
    return _compared("timer slack", "50 us unless set", _Of("sleep", "ordinary", "exact timers", 0.5), found, do)


def _governor(machine: Machine, found: Rehearsal) -> Setting:
    hot, cold = found.work["without a pause"], found.work["after a pause"]
    slow = bool(hot.get("p50_us")) and cold.get("p50_us", 0.0) > SLOW_WORK * hot["p50_us"]
    awake = found.work["after a pause, kept awake"]
    do = "nothing"
    if slow and machine.governor not in ("", "performance"):
        do = "sudo cpupower frequency-set -g performance"
    elif slow and awake.get("p50_us", cold["p50_us"]) < HELPS * cold["p50_us"]:
        do = "--core keeps it warm"
    return Setting(
        setting="governor",
        in_force=machine.governor or "not offered by this system",
        measured="the same calculation after a pause of 1 ms: as it is, core kept awake",
        without=cold,
        with_it=awake,
        rounds_better=None,
        rounds=None,
        effect="",
        do=do,
    )


def _isolated(machine: Machine, found: Rehearsal) -> Setting:
    row = next((row for row in found.cores if row["core"] == found.host), {})
    names = ("away_ms_per_s", "largest_away_us")
    before = {name: row[name] for name in names if name in row}
    after = {name: row[f"fifo_{name}"] for name in names if f"fifo_{name}" in row}
    held = before.get("away_ms_per_s", 0.0) - after.get("away_ms_per_s", 0.0)
    do = "nothing: hardly anything else ran there"
    if found.host in machine.isolated:
        do = f"nothing: core {found.host} is isolated"
    elif held > AWAY_MS_PER_S:
        do = "nothing: SCHED_FIFO keeps the others away"
    elif not after and before.get("away_ms_per_s", 0.0) > AWAY_MS_PER_S:
        do = f"allow SCHED_FIFO; or isolcpus={found.host} at boot, then --core {found.host}"
    cores = ", ".join(map(str, sorted(machine.isolated)))
    return Setting(
        setting="isolcpus",
        in_force=f"cores {cores}" if cores else "none",
        measured=f"core {found.host} ran something else: beside an ordinary thread, beside one of SCHED_FIFO",
        without=before,
        with_it=after,
        rounds_better=None,
        rounds=None,
        effect="",
        do=do,
    )


def _locked(found: Rehearsal) -> Setting:
    as_it_comes, locked = found.first_touch["as it comes"], found.first_touch["locked"]
    granted = locked.get("asked") == GRANTED
    return Setting(
        setting="mlockall",
        in_force=str(locked.get("asked", "unknown")),
        measured="first touch of a page: as it comes, locked",
        without=as_it_comes,
        with_it={key: value for key, value in locked.items() if key != "asked"},
        rounds_better=None,
        rounds=None,
        effect="",
        do="nothing: a run asks for it" if granted else LIMITS.format(line="memlock unlimited"),
    )


def _virtual(machine: Machine, found: Rehearsal) -> Setting:
    away = [row for row in found.cores if "fifo_away_ms_per_s" in row]
    worst = max(away, key=lambda row: float(row["fifo_away_ms_per_s"]), default={})
    stolen = "unknown" if found.steal_ms is None else f"{found.steal_ms:.0f} ms stolen in {found.seconds:.0f} s"
    do = "nothing"
    if machine.hypervisor and float(worst.get("fifo_largest_away_us", 0.0)) > AWAY_US:
        do = "a computer of its own, or a virtual one with cores of its own: no priority helps against its host"
    return Setting(
        setting="virtualisation",
        in_force=f"{'a hypervisor is there' if machine.hypervisor else 'none seen'}; {stolen}",
        measured="what no priority helps against (interrupts, hypervisor), worst core",
        without={key.removeprefix("fifo_"): value for key, value in worst.items() if key.startswith("fifo_")},
        with_it={},
        rounds_better=None,
        rounds=None,
        effect="",
        do=do,
    )


def _terminal(found: Rehearsal) -> Setting:
    """Bytes of serial ports and pseudo-terminals wait for a worker of the kernel, which has no priority over other programs."""
    turns = found.arms[found.free]
    first, second = (turns.by_round(kind, 0.99) for kind in ("terminal", "pipe"))
    effect, better = _effect(first, second)
    advice = "over TCP (serial:socket://) or usb: bytes do not wait so; or keep a core free of other programs for the kernel's workers"
    return Setting(
        setting="terminal layer",
        in_force="in the way of serial ports and pseudo-terminals",
        measured=f"{_WOKEN['pipe']}, {found.free}: through a terminal; through a pipe (compared by p99)",
        without=figures(turns.all_of("terminal")),
        with_it=figures(turns.all_of("pipe")),
        rounds_better=better if effect else None,
        rounds=len(first) if effect else None,
        effect=effect,
        do=advice if effect == "helps" else "nothing",
    )


def _serial(machine: Machine) -> Iterator[Setting]:
    for port in machine.serial:
        slow = port.timer_ms is not None and port.timer_ms > FTDI_SLOW_MS
        timer = "no FTDI timer" if port.timer_ms is None else f"FTDI timer {port.timer_ms} ms"
        flag = {None: "", True: ", low_latency", False: ", no low_latency flag"}[port.low_latency]
        do = "pans bench link measures it with the instrument"
        if slow:
            do = f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{port.name}/latency_timer"
        yield Setting(
            setting=f"port {port.name}",
            in_force=timer + flag,
            measured="not opened, since that resets some boards",
            without={"p99_us": 1000.0 * port.timer_ms} if port.timer_ms is not None else {},
            with_it={},
            rounds_better=None,
            rounds=None,
            effect="",
            do=do,
        )


# ---- what is told ----


def table_text(rows: list[Setting], found: Rehearsal) -> str:
    """Return the table, a line of figures and one of advice for each row."""
    lines = [f"{'setting':<16} {'in force':<44} {'without':>28} {'with':>28}   times in us: p50 / p99 / p99.9 / max"]
    for row in rows:
        lines.append(f"{row.setting:<16} {row.in_force:<44} {_cell(row.without):>28} {_cell(row.with_it):>28}")
        rounds = "" if row.rounds is None else f"; better in {row.rounds_better} of {row.rounds} rounds: {row.effect}"
        lines += [f"{'':<16} {row.measured}{rounds}", f"{'':<16} do: {row.do}"]
    pair = f"--core {found.host} for the run" if found.host is not None else "no cores to choose from"
    pair += "" if found.device is None else f", --core {found.device} for a simulated device on this computer"
    load = "{:.2f} before, {:.2f} after".format(*found.load_1min)
    lines += [f"cores suggested: {pair}", f"load of one minute: {load}; measured for {found.seconds:.1f} s"]
    return "\n".join(lines)


def _cell(values: dict[str, Any]) -> str:
    if "away_ms_per_s" in values:
        return f"{values['away_ms_per_s']:.2f} ms/s, {values['largest_away_us']:.0f} us"
    if "p50_us" not in values:
        return f"to {values['p99_us']:.0f}" if "p99_us" in values else "not tried"
    return f"{values['p50_us']:.1f} / {values['p99_us']:.1f} / {values['p999_us']:.0f} / {values['max_us']:.0f}"


def payload_of(rows: list[Setting], found: Rehearsal) -> dict[str, Any]:
    """Return the figures of the table and those behind it."""
    return {
        "settings": [row.as_json() for row in rows],
        "wakeups": {
            name: {"asked": turns.asked, **{kind: figures(turns.all_of(kind)) for kind in turns.late_ns}}
            for name, turns in found.arms.items()
        },
        "cores": found.cores,
        "suggested": {"host": found.host, "device": found.device},
        "first_touch": found.first_touch,
        "work": found.work,
        "steal_ms": found.steal_ms,
        "load_1min": list(found.load_1min),
        "seconds": found.seconds,
    }


def findings_of(rows: list[Setting]) -> list[Finding]:
    """Return the rows as findings: a setting that asks for something to be done is not ok."""
    idle = ("nothing", "leave", "pans bench")
    return [
        Finding(f"realtime: {row.setting}", ok, row.in_force, "" if ok else row.do)
        for row in rows
        for ok in [row.do.startswith(idle)]
    ]
