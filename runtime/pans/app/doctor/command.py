"""`pans devices` and `pans doctor`: where instruments may be, and what in this machine helps or hurts; each finding with its remedy.

No port is opened (that would reset some boards) and nothing is changed. A check is a generator of `Finding`s; one that itself fails is a
finding too.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from pans.app.command import Command
from pans.base import SHIPPED
from pans.base.console import emit, install, progress_bar, say
from pans.base.errors import EXIT_ALERT, EXIT_FINE, UsageError
from pans.base.machine import FIFO_PRIORITY, GRANTED, first_line, isolated_cores, lacking, load_average
from pans.protocol.links import FTDI_SLOW_MS, LINKS, latency_timer_ms

if TYPE_CHECKING:
    from .rehearsal import Rehearsal

RULE = "70-pans.rules"
RULES_FOLDERS = ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
UDEV = "pans doctor --udev prints a rule to install"
LIMITS = "for steadier latencies: echo '{line}' | sudo tee -a /etc/security/limits.d/pans.conf, log in again"
CLOCK_READS, CLOCK_COARSE_NS = 2000, 1_000
TRIAL_PATIENCE_S = 120.0  # compiling on a busy machine
HELPS, HARMS = 0.9, 1.1  # ratio of quantiles, besides every round
AWAY_MS_PER_S, AWAY_US = 1.0, 200.0  # a fifth of the shortest deadline (1 ms)
OPEN_FILES = 15  # the port, the recording, the log and what Python and the loop have open; measured
RECORDED = (("fashion-adaptive", "dmd-spad"), ("fashion10", "oled-qcmos"))


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at; `remedy` is empty when nothing needs doing. What is `needed` and missing stops a run."""

    check: str
    ok: bool
    found: str
    remedy: str = ""
    needed: bool = False


@dataclass(frozen=True, slots=True)
class PortState:
    """One place where an instrument may be; `state` is free, busy, no permission, or not there."""

    url: str
    kind: str
    description: str
    vid_pid_serial: str
    state: str
    remedy: str = ""


def serial_ports() -> list[PortState]:
    """Return the serial ports with their state, without opening one."""
    from serial.tools import list_ports

    states = []
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        ids = f"{port.vid:04x}:{port.pid:04x}:{port.serial_number or ''}" if port.vid is not None else ""
        state, remedy = port_state(str(port.device))
        url = f"serial:{ids.rstrip(':') or port.device}"
        states.append(PortState(url, "serial", f"{port.device}: {port.description}", ids, state, remedy))
    return states


def port_state(device: str, proc: Path = Path("/proc")) -> tuple[str, str]:
    """Return (state, remedy) of a device file: not there, no permission, busy (and who), free as far as can be seen."""
    if sys.platform == "win32":
        return "unknown", "Windows tells only by opening it"
    if not os.path.exists(device):
        return "not there", "check the cable"
    if not os.access(device, os.R_OK | os.W_OK):
        return "no permission", f"{UDEV}; or: sudo usermod -aG dialout $USER, log in again"
    holder = _holder(device, proc)
    return ("busy", f"close {holder} first") if holder else ("free", "")


def _holder(device: str, proc: Path) -> str:
    """Return who has `device` open, as far as this user may see; "" for nobody."""
    wanted = os.path.realpath(device)
    for folder in proc.glob("[0-9]*"):
        try:
            if any(os.readlink(entry) == wanted for entry in (folder / "fd").iterdir()):
                return f"{(folder / 'comm').read_text().strip()} (process {folder.name})"
        except OSError:  # another user's process, or one that has just ended
            continue
    return ""


def usb_devices() -> list[PortState]:
    """Return the USB devices with vendor-specific bulk interfaces; [] without libusb."""
    import usb.core

    try:
        found = list(usb.core.find(find_all=True) or [])
    except usb.core.NoBackendError:
        return []
    states = []
    for device in found:
        if device.bDeviceClass == 9:  # hubs
            continue
        ids, state, remedy = f"{device.idVendor:04x}:{device.idProduct:04x}", "free", ""
        try:
            ids += f":{device.serial_number or ''}"
        except (usb.core.USBError, ValueError, NotImplementedError):
            state, remedy = "no permission", UDEV
        where = f"bus {device.bus} address {device.address}"
        states.append(PortState(f"usb:{ids.rstrip(':')}", "usb", where, ids, state, remedy))
    return states


def schemes() -> list[str]:
    """Return the URL schemes that this installation opens."""
    return sorted({*LINKS, *(point.name for point in entry_points(group="pans.devices"))})


def check_python() -> Iterator[Finding]:
    """The interpreter is new enough."""
    found = ".".join(str(part) for part in sys.version_info[:3])
    yield Finding("python", sys.version_info >= (3, 11), found, "install Python 3.11 or newer", needed=True)


def check_numba() -> Iterator[Finding]:
    """Compiled kernels load, and are kept between runs."""
    import numba

    from pans.base.machine import FOLDER, kernel_folder

    yield Finding("numba", True, f"numba {numba.__version__}", needed=True)
    folder = kernel_folder()
    ok, found = FOLDER.fullmatch(folder.name) is not None, f"{folder}: {len(list(folder.glob('*.nbc')))} kernels"
    remedy = (
        "export NUMBA_CACHE_DIR=FOLDER, a folder of yours: without a cache every start compiles for some ten seconds"
    )
    yield Finding("numba cache", ok, found, "" if ok else remedy)


def check_libusb() -> Iterator[Finding]:
    """pyusb finds libusb."""
    import usb.backend.libusb1

    ok = usb.backend.libusb1.get_backend() is not None
    remedy = f"only for usb: devices: {install('usb')}, or install libusb-1.0"
    yield Finding("libusb", ok, "found" if ok else "not found", "" if ok else remedy)


def check_clock() -> Iterator[Finding]:
    """The clock is fine enough to time decisions."""
    readings = [time.perf_counter_ns() for _ in range(CLOCK_READS)]
    finest = min((after - before for before, after in itertools.pairwise(readings) if after > before), default=10**9)
    source = first_line(Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")) or "source unknown"
    ok = finest <= CLOCK_COARSE_NS
    remedy = "" if ok else "boot with clocksource=tsc; a virtual machine may hide it"
    yield Finding("clock resolution", ok, f"{finest} ns ({source})", remedy)


# What a child process tries, each answer on a line: integers and floats in vectors, the golden scores of a shipped head, privileges.
# A refused instruction ends the process, and what is locked must not stay so here.
_TRIAL = """
import numba, numpy
@numba.njit
def kernel(integers, floats):
    total, kept = 0, 0.0
    for i in range(len(integers)):
        total += integers[i] * integers[i]
        floats[i] = floats[i] * floats[i] + floats[i]
    return total
floats = numpy.arange(1000.0)
right = kernel(numpy.arange(1000), floats) == 332833500 and (floats == numpy.arange(1000.0) * numpy.arange(1, 1001)).all()
print("compiled=" + ("right" if right else "wrong results"), flush=True)
from pans.base import SHIPPED
from pans.bundle.sensor import load_bundle
from pans.bundle.backends import OnnxDecider
try:
    OnnxDecider(load_bundle(SHIPPED / "fashion10.pans")[0])
    print("onnxruntime=right", flush=True)
except Exception as error:
    print(f"onnxruntime={error}".splitlines()[0], flush=True)
from pans.base.machine import FIFO_PRIORITY, locked_memory, scheduled
with scheduled("SCHED_FIFO", FIFO_PRIORITY) as answer:
    print("sched_fifo=" + answer, flush=True)
with locked_memory() as answer:
    print("mlockall=" + answer, flush=True)
import resource
print("resident=" + str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss), flush=True)
"""


@cache
def _tried() -> Mapping[str, str]:
    """Return what a child process answered for each name; for those without an answer, how it ended."""
    try:
        done = subprocess.run([sys.executable, "-c", _TRIAL], capture_output=True, text=True, timeout=TRIAL_PATIENCE_S)
        printed, reason = done.stdout, (done.stderr.strip().splitlines() or [""])[-1]
        ended = f"the process ended by signal {-done.returncode}" if done.returncode < 0 else reason
    except subprocess.TimeoutExpired as error:
        printed, ended = (error.stdout or b"").decode(), f"no answer within {TRIAL_PATIENCE_S:.0f} s"
    answers = dict(line.split("=", 1) for line in printed.splitlines() if "=" in line)
    return defaultdict(lambda: ended, answers)


def check_processor() -> Iterator[Finding]:
    """Kernels and heads compute, SCHED_FIFO and locked memory are granted: announced, tried in a child process, taken."""
    import llvmlite.binding
    import numba
    import onnxruntime

    tried = _tried()
    host, chosen = llvmlite.binding.get_host_cpu_name(), numba.config.CPU_NAME
    right = tried["compiled"] == "right"
    found = f"announced {host}; works {tried['compiled']}; taken {chosen or host}"
    remedy = "export NUMBA_CPU_NAME=generic: kernels without the instructions that are refused here"
    yield Finding("numba's target", right, found, "" if right else remedy, needed=True)
    announced, right = ", ".join(onnxruntime.get_available_providers()), tried["onnxruntime"] == "right"
    works = f"works {tried['onnxruntime']}; taken CPUExecutionProvider"
    found = f"{onnxruntime.__version__}: announced {announced}; {works}"
    remedy = "pip install --force-reinstall onnxruntime; a bundle with a table decides without it"
    yield Finding("onnxruntime", right, found, "" if right else remedy, needed=True)
    if sys.platform == "win32":
        return
    import resource

    user = os.environ.get("USER", "$USER")
    settings = (("SCHED_FIFO", "RTPRIO", "sched_fifo", "20"), ("locked memory", "MEMLOCK", "mlockall", "unlimited"))
    for check, name, key, wanted in settings:
        number = getattr(resource, f"RLIMIT_{name}", None)
        limit = resource.getrlimit(number)[0] if number is not None else None
        stated = "root" if os.geteuid() == 0 else "unlimited" if limit == resource.RLIM_INFINITY else f"limit {limit}"
        ok, remedy = tried[key] == "granted", LIMITS.format(line=f"{user} - {name.lower()} {wanted}")
        if stated in ("root", "unlimited"):
            remedy += "; a container or virtual machine may refuse it all the same"
        taken = "asked for by a run on a device" if ok else "runs go on without it"
        yield Finding(check, ok, f"announced {stated}; works {tried[key]}; taken: {taken}", "" if ok else remedy)


def check_share() -> Iterator[Finding]:
    """What a run takes from this machine, and what it leaves."""
    tried = _tried()
    resident = tried["resident"]
    mib = int(resident) / (2**20 if sys.platform == "darwin" else 2**10) if resident.isdecimal() else math.nan
    fifo = (
        f"SCHED_FIFO {FIFO_PRIORITY}" if tried["sched_fifo"] == GRANTED else "ordinary priority, since none is granted"
    )
    locked = f"{mib:.0f} MiB" + " locked" * (tried["mlockall"] == GRANTED)
    yield Finding("a run on a device", True, f"{fifo}, {locked}, one core at most, about {OPEN_FILES} open files")
    found = (
        f"a second process of {mib:.0f} MiB; both at ordinary priority without locked memory, unless --realtime asks"
    )
    yield Finding("a simulated device", True, found)
    yield Finding("a live page (--serve)", True, "one more process at ordinary priority")
    rates = [f"{disk_mib_per_hour(*one):.0f} MiB per hour ({one[0]} on {one[1]})" for one in RECORDED]
    yield Finding("a recording", True, f"{'; '.join(rates)}; --rotate-mb and --keep-mb bound it")


def disk_mib_per_hour(bundle_name: str, profile_name: str) -> float:
    """Return how much a recording of a shipped bundle on a shipped profile grows: the bytes of its blocks, each with its stamp."""
    from pans.bundle.sensor import load_bundle
    from pans.decide.plan import build_plan
    from pans.instrument.profile import load_profile
    from pans.protocol.wire import ClickBlock, encode_clicks
    from pans.record.reading import MESSAGE

    plan = build_plan(load_profile(profile_name), load_bundle(SHIPPED / f"{bundle_name}.pans")[0])
    n = plan.block_exposures
    block = ClickBlock(0, 0, 0, 0, 1, 0, np.ones(n, np.uint16), np.zeros(n, np.uint8))
    blocks_hz = plan.slots_per_cycle / n / (plan.cycle_ticks * plan.tick_us * 1e-6)
    return (len(encode_clicks(block, 1)) + MESSAGE.size) * blocks_hz * 3600 / 2**20


def check_system() -> Iterator[Finding]:
    """What this system does not have, named at once."""
    missing = lacking()
    found = f"{sys.platform}: tried on Linux only" if sys.platform != "linux" else "linux"
    found += f"; not here: {', '.join(missing)}" if missing else ""
    remedy = "runs do without, and deadlines of milliseconds are then not kept reliably: docs/how-to/real-time.md"
    yield Finding("system", not missing, found, remedy if missing else "")


def check_load() -> Iterator[Finding]:
    """Other programs leave a processor to the loop, and one to a simulated instrument."""
    load, cores = load_average(), os.cpu_count() or 1
    ok = load < cores
    remedy = "end other programs: decisions are late while more of them compute than there are cores"
    yield Finding("load", ok, f"{load:.1f} on {cores} cores in the last minute", "" if ok else remedy)


def check_governor() -> Iterator[Finding]:
    """The processor does not slow down between decisions."""
    governor = first_line(Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"))
    ok = governor in ("", "performance")
    remedy = "" if ok else "for steadier latencies: sudo cpupower frequency-set -g performance"
    yield Finding("processor governor", ok, governor or "not offered by this system", remedy)


def check_udev() -> Iterator[Finding]:
    """The rule that gives access to instruments is installed."""
    if sys.platform != "linux":
        return
    import grp

    where = next((folder for folder in RULES_FOLDERS if (Path(folder) / RULE).exists()), "")
    mine = set(os.getgroups())
    member = any(group.gr_gid in mine for group in grp.getgrall() if group.gr_name == "dialout")
    found = f"rule in {where}" if where else f"no rule, {'in' if member else 'not in'} group dialout"
    ok = bool(where) or member or os.geteuid() == 0
    remedy = f"pans doctor --udev | sudo tee /etc/udev/rules.d/{RULE}; or join the group dialout"
    yield Finding("access to ports", ok, found, "" if ok else remedy)


def check_ports() -> Iterator[Finding]:
    """Every port that is there can be opened; FTDI adapters pass bytes on at once."""
    ports = serial_ports()
    if not ports:
        yield Finding("serial ports", True, "none; pseudo-terminals and socket:// are never listed")
    for port in ports:
        yield Finding(f"port {port.url}", port.state == "free", f"{port.description}: {port.state}", port.remedy)
        device = port.description.partition(":")[0]
        timer_ms = latency_timer_ms(device)
        if timer_ms is not None:
            ok = timer_ms <= FTDI_SLOW_MS
            remedy = "" if ok else f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{Path(device).name}/latency_timer"
            yield Finding(f"FTDI latency {device}", ok, f"{timer_ms} ms", remedy)


def check_others() -> Iterator[Finding]:
    """What other packages check, by the entry points `pans.checks`: torch's products among them."""
    for point in entry_points(group="pans.checks"):
        yield from point.load()()


Check = Callable[[], Iterator[Finding]]
LIBRARIES: tuple[Check, ...] = (check_python, check_system, check_numba, check_libusb, check_clock, check_processor)
CHECKS = (*LIBRARIES, check_share, check_load, check_governor, check_udev, check_ports, check_others)


def examine(checks: tuple[Check, ...] = CHECKS) -> list[Finding]:
    """Run all checks; one that breaks becomes a finding and stops no other."""
    findings: list[Finding] = []
    for check in checks:
        name = check.__name__.removeprefix("check_").replace("_", " ")
        try:
            findings += check()
        except ImportError as error:
            remedy = "install pans again, from where it came"
            findings.append(Finding(name, False, f"cannot be loaded: {error}", remedy, needed=True))
        except Exception as error:
            findings.append(Finding(name, False, f"the check itself failed: {error!r}", "report this with its text"))
    return findings


# Row, the arms without and with it ("base": bound, at the best priority that is granted), the quantile that is compared, and what to do by
# effect; "refused" for an arm that was not granted.
COMPARED: tuple[tuple[str, str, str, float, dict[str, str]], ...] = (
    ("SCHED_FIFO", "ordinary", "SCHED_FIFO", 0.99, {
        "harms": "compare once more on a quiet machine; --no-realtime leaves it out",
        "refused": LIMITS.format(line="$USER - rtprio 20"),
    }),
    ("affinity", "ordinary", "bound", 0.99, {"helps": "--core {host} binds the loop"}),
    ("core kept awake", "base", "kept awake", 0.99, {
        "helps": "pans run --core {host}, and a simulated device on pans simulate --core {device}: each takes all of its core",
        "harms": "leave --core out",
    }),
    ("C-states", "base", "shallow idle states", 0.5, {
        "helps": "--core keeps one core out of them; for all: idle=poll or processor.max_cstate=1 at boot",
        "refused": "to try it, run this as root: the file /dev/cpu_dma_latency is root's",
    }),
)  # fmt: skip


ROW: dict[str, Any] = {  # of a setting that is not tried: judged by its effect
    "measured": "for how long a core ran something else",
    **{"without": {}, "with": {}, "rounds_better": None, "rounds": None, "effect": ""},
}


def settings_of(found: Rehearsal) -> list[dict[str, Any]]:
    """Return a row for each setting: what is in force, what was measured without and with it, and what to do."""
    isolated, cores = isolated_cores(), ", ".join(str(row["core"]) for row in found.cores) or "unknown"
    in_force = {
        "SCHED_FIFO": "granted" if found.fifo else "refused",
        "affinity": f"cores {cores} allowed",
        "core kept awake": "no: by --core N",
        "C-states": first_line(Path("/sys/devices/system/cpu/cpuidle/current_driver")) or "not told by this system",
    }
    rows = []
    for setting, before, after, q, do in COMPARED:
        base = "bound, SCHED_FIFO" if found.fifo else "bound"
        figures = _compared(found, base if before == "base" else before, after, q)
        advice = do.get(figures["effect"] or "refused", "nothing").format(host=found.host, device=found.device)
        advice = advice.replace(", and a simulated device on pans simulate --core None", "")
        rows.append(ROW | {"setting": setting, "in_force": in_force[setting], "do": advice} | figures)
    others = next((row for row in found.cores if row["core"] == found.host), {})
    is_shared = found.host not in isolated and not found.fifo and others.get("away_ms_per_s", 0.0) > AWAY_MS_PER_S
    isolate = f"allow SCHED_FIFO; or isolcpus={found.host} at boot, then --core {found.host}"
    worst = max(found.cores, key=lambda row: float(row.get("fifo_away_ms_per_s", 0.0)), default={})
    beyond = {name.removeprefix("fifo_"): value for name, value in worst.items() if name.startswith("fifo_")}
    stolen = "unknown" if found.steal_ms is None else f"{found.steal_ms:.0f} ms stolen in {found.seconds:.0f} s"
    held = float(beyond.get("largest_away_us", 0.0)) > AWAY_US
    own = "a computer of its own, or cores of its own: no priority helps against interrupts and the hypervisor"
    for setting, text, away, advice in (
        ("isolcpus", f"cores {sorted(isolated)}", others, isolate if is_shared else "nothing"),
        ("virtualisation", stolen, beyond, own if held else "nothing"),
    ):
        without = {name: away[name] for name in ("away_ms_per_s", "largest_away_us") if name in away}
        rows.append(ROW | {"setting": setting, "in_force": text, "without": without, "do": advice})
    return rows


def _compared(found: Rehearsal, before: str, after: str, q: float) -> dict[str, Any]:
    """Compare two arms by quantile `q`: one helps or harms only if it does so in every round."""
    arms = [found.arms.get(name) for name in (before, after)]
    first, second = ([float(np.quantile(one, q)) for one in arm.rounds_ns] if arm else [] for arm in arms)
    effect, better, n = "", None, len(first)
    if first and n == len(second):
        better, worse = (sum(one > two for one, two in zip(*arms)) for arms in ((first, second), (second, first)))
        ratio = median(second) / median(first)
        effect = "helps" if better == n and ratio < HELPS else "harms" if worse == n and ratio > HARMS else "none"
    without, with_it = (arm.figures() if arm else {} for arm in arms)
    measured = f"woken by a timer: {before}; {after} (compared by p{100 * q:.0f})"
    rounds = {"rounds_better": better, "rounds": n if effect else None, "effect": effect}
    return {"measured": measured, "without": without, "with": with_it, **rounds}


def table_text(rows: list[dict[str, Any]], found: Rehearsal) -> str:
    """Return the table, a line of figures and one of advice for each row."""
    lines = [f"{'setting':<16} {'in force':<32} {'without':>28} {'with':>28}   times in us: p50 / p99 / p99.9 / max"]
    for row in rows:
        rounds = f"; better in {row['rounds_better']} of {row['rounds']} rounds: {row['effect']}" * bool(row["effect"])
        lines += [
            f"{row['setting']:<16} {row['in_force']:<32} {_cell(row['without']):>28} {_cell(row['with']):>28}",
            f"{'':<16} {row['measured']}{rounds}",
            f"{'':<16} do: {row['do']}",
        ]
    pair = f"--core {found.host} for the run" if found.host is not None else "no cores to choose from"
    pair += "" if found.device is None else f", --core {found.device} for a simulated device on this computer"
    load = "{:.2f} before, {:.2f} after".format(*found.load_1min)
    lines += [f"cores suggested: {pair}", f"load of one minute: {load}; measured for {found.seconds:.1f} s"]
    return "\n".join(lines)


def _cell(values: dict[str, Any]) -> str:
    if "away_ms_per_s" in values:
        return f"{values['away_ms_per_s']:.2f} ms/s, {values['largest_away_us']:.0f} us"
    if "p50_us" not in values:
        return "not tried"
    some = (("p50_us", ".1f"), ("p99_us", ".1f"), ("p999_us", ".0f"), ("max_us", ".0f"))
    return " / ".join("-" if values[name] is None else f"{values[name]:{form}}" for name, form in some)


def _configure_devices(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--no-usb", action="store_true", help="do not look at the USB bus")


def _devices(args: argparse.Namespace) -> int:
    ports = serial_ports() + ([] if args.no_usb else usb_devices())
    lines = [f"{port.url:<36} {port.state:<14} {port.description}" for port in ports]
    lines += [f"    remedy: {port.remedy}" for port in ports if port.remedy]
    lines = lines or ["no serial port and no USB device was found"]
    lines.append(f"schemes: {', '.join(schemes())}   (without hardware: sim:ideal, simserial:ideal, simusb:ideal)")
    emit(args, {"devices": [asdict(port) for port in ports], "schemes": schemes()}, "\n".join(lines))
    return EXIT_FINE


def _configure_doctor(parser: argparse.ArgumentParser) -> None:
    for option, words in (
        ("--udev", "print the udev rule that gives access to instruments, and end"),
        ("--realtime", "measure for about 10 s what each real-time setting brings here"),
        ("--warm", "compile all kernels into the cache, on all cores, so that a first run need not"),
    ):
        parser.add_argument(option, action="store_true", help=words)


def _doctor(args: argparse.Namespace) -> int:
    if args.udev:
        rule = (SHIPPED / RULE).read_text(encoding="utf-8")
        emit(args, {"udev": rule}, rule.rstrip())
        return EXIT_FINE
    if args.warm:
        return _warm(args)
    findings = examine()
    broken = [finding.check for finding in findings if finding.needed and not finding.ok]
    payload: dict[str, Any] = {"findings": [asdict(finding) for finding in findings], "ready": not broken}
    lines = []
    for finding in findings:
        mark = "ok" if finding.ok else "FAIL" if finding.needed else "note"
        lines.append(f"{mark:<5}{finding.check:<22} {finding.found}")
        lines += [] if finding.ok else [f"     remedy: {finding.remedy}"]
    lines.append(f"cannot run: {', '.join(broken)}" if broken else "ready to run")
    emit(args, payload, _realtime(payload) if args.realtime else "\n".join(lines))
    return EXIT_ALERT if broken else EXIT_FINE


def _realtime(payload: dict[str, Any]) -> str:
    """Measure, add the figures to `payload`, and return the table; UsageError where this system has no such measurement."""
    if sys.platform == "win32":
        remedy = "pans bench link measures the whole path"
        raise UsageError("--realtime measures on Linux and macOS only", remedy=remedy)
    from .rehearsal import SECONDS, rehearse

    say(f"pans: measuring wake-ups for about {SECONDS:.0f} s; all that runs takes part, and a live run would suffer")
    # no thread that draws: it would take part in what is measured
    with progress_bar("real time", 1.0, threaded=False) as report:
        found = rehearse(SECONDS, report)
    rows = settings_of(found)
    for row in rows:
        ok = row["do"].startswith(("nothing", "leave"))
        finding = Finding(f"realtime: {row['setting']}", ok, row["in_force"], "" if ok else row["do"])
        payload["findings"].append(asdict(finding))
    payload["realtime"] = {
        "settings": rows,
        "wakeups": {name: {"asked": turns.asked, "sleep": turns.figures()} for name, turns in found.arms.items()},
        "cores": found.cores,
        "suggested": {"host": found.host, "device": found.device},
        "steal_ms": found.steal_ms,
        "load_1min": list(found.load_1min),
        "seconds": found.seconds,
    }
    return table_text(rows, found)


def _warm(args: argparse.Namespace) -> int:
    from .warm import warm, words_of

    say("pans: compiling all kernels of runs: once per machine and version; half a minute on two idle cores")
    with progress_bar("kernels", 1.0) as report:
        found = warm(report)
    emit(args, {"warm": found}, words_of(found))
    return EXIT_FINE if all(row["ok"] for row in found["jobs"]) else EXIT_ALERT


DEVICES = Command(
    "list ports and USB devices, and whether they can be opened",
    _configure_devices,
    _devices,
    examples=("pans devices",),
)
DOCTOR = Command(
    "check this machine: ports, permissions, libraries, clock, scheduler",
    _configure_doctor,
    _doctor,
    examples=(
        "pans doctor",
        "pans doctor --realtime",
        "pans doctor --warm",
        "pans doctor --udev | sudo tee /etc/udev/rules.d/70-pans.rules",
    ),
)
