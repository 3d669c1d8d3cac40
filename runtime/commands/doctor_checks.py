"""What in this machine helps or hurts: ports, permissions, libraries, clock, scheduler; each finding with its remedy.

Owns the checks; never opens a port (that would reset some boards) and never changes anything. Each check returns `Finding`s; a check that
itself fails is a finding too. `needed` tells what stops a run from what only makes it slower.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from pans.runtime import SHIPPED
from pans.runtime.link.serial import FTDI_SLOW_MS, latency_timer_ms

RULE = "70-pans.rules"
RULES_FOLDERS = ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
CLOCK_READS = 2000
CLOCK_COARSE_NS = 1_000


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at; `remedy` is empty when nothing needs doing."""

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


def udev_rule() -> str:
    """Return the text of the shipped udev rule."""
    return (SHIPPED / RULE).read_text(encoding="utf-8")


# -- ports -------------------------------------------------------------------------------------------------------------


def serial_ports() -> list[PortState]:
    """Return the serial ports with their state, without opening one."""
    from serial.tools import list_ports

    states = []
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        named = port.vid is not None
        ids = f"{port.vid:04x}:{port.pid:04x}:{port.serial_number or ''}" if named else ""
        state, remedy = port_state(str(port.device))
        url = f"serial:{ids.rstrip(':')}" if named else f"serial:{port.device}"
        states.append(PortState(url, "serial", f"{port.device}: {port.description}", ids, state, remedy))
    return states


def port_state(device: str, proc: Path = Path("/proc")) -> tuple[str, str]:
    """Return (state, remedy) of a device file: not there, no permission, busy (and who), free as far as can be seen."""
    if sys.platform == "win32":
        return "unknown", "Windows tells only by opening it"
    if not os.path.exists(device):
        return "not there", "check the cable"
    if not os.access(device, os.R_OK | os.W_OK):
        return (
            "no permission",
            "pans doctor --udev prints a rule to install; or: sudo usermod -aG dialout $USER, log in again",
        )
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

    states = []
    try:
        found = list(usb.core.find(find_all=True) or [])
    except usb.core.NoBackendError:
        return []
    for device in found:
        if device.bDeviceClass == 9:  # hubs
            continue
        ids, state, remedy = f"{device.idVendor:04x}:{device.idProduct:04x}", "free", ""
        try:
            ids += f":{device.serial_number or ''}"
        except (usb.core.USBError, ValueError, NotImplementedError):
            state, remedy = "no permission", "pans doctor --udev prints a rule to install"
        states.append(
            PortState(f"usb:{ids.rstrip(':')}", "usb", f"bus {device.bus} address {device.address}", ids, state, remedy)
        )
    return states


def schemes() -> list[str]:
    """Return the URL schemes that this installation opens."""
    return sorted({"serial", "usb", *(point.name for point in entry_points(group="pans.devices"))})


# -- the machine -------------------------------------------------------------------------------------------------------


def check_python() -> Iterator[Finding]:
    """The interpreter is new enough."""
    found = ".".join(str(part) for part in sys.version_info[:3])
    yield Finding("python", sys.version_info >= (3, 11), found, "install Python 3.11 or newer", needed=True)


def check_numba() -> Iterator[Finding]:
    """Compiled kernels load, and are kept between runs."""
    import numba
    from numba.core import config

    yield Finding("numba", True, f"numba {numba.__version__}", needed=True)
    folder = Path(config.CACHE_DIR) if config.CACHE_DIR else Path(__file__).parent / "__pycache__"
    ok = os.access(folder, os.W_OK) or (not folder.exists() and os.access(folder.parent, os.W_OK))
    remedy = "export NUMBA_CACHE_DIR=~/.cache/pans: without a cache every start compiles for seconds"
    yield Finding("numba cache", ok, str(folder), "" if ok else remedy)


def check_libusb() -> Iterator[Finding]:
    """pyusb finds libusb."""
    import usb.backend.libusb1

    ok = usb.backend.libusb1.get_backend() is not None
    remedy = "only for usb: devices: pip install 'pans-runtime[usb]', or install libusb-1.0"
    yield Finding("libusb", ok, "found" if ok else "not found", "" if ok else remedy)


def check_clock() -> Iterator[Finding]:
    """The clock is fine enough to time decisions."""
    readings = [time.perf_counter_ns() for _ in range(CLOCK_READS)]
    steps = [after - before for before, after in itertools.pairwise(readings) if after > before]
    finest = min(steps, default=10**9)
    source = _first_line("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    ok = finest <= CLOCK_COARSE_NS
    remedy = "" if ok else "boot with clocksource=tsc; a virtual machine may hide it"
    yield Finding("clock resolution", ok, f"{finest} ns ({source or 'source unknown'})", remedy)


def check_processor() -> Iterator[Finding]:
    """Kernels and heads compute, SCHED_FIFO and locked memory are granted: announced, tried in a child process, taken.

    A child, since an instruction that is announced and not granted ends the process, and so that nothing stays locked here.
    """
    import llvmlite.binding
    import numba
    import onnxruntime

    tried = _tried("compiled", "onnxruntime", "sched_fifo", "mlockall")
    host, chosen = llvmlite.binding.get_host_cpu_name(), numba.config.CPU_NAME
    right = tried["compiled"] == "right"
    yield Finding(
        "numba's target",
        right,
        f"announced {host}; works {tried['compiled']}; taken {chosen or host}",
        "" if right else "export NUMBA_CPU_NAME=generic: kernels without the instructions that are refused here",
        needed=True,
    )
    announced, right = ", ".join(onnxruntime.get_available_providers()), tried["onnxruntime"] == "right"
    yield Finding(
        "onnxruntime",
        right,
        f"{onnxruntime.__version__}: announced {announced}; works {tried['onnxruntime']}; taken CPUExecutionProvider",
        "" if right else "pip install --force-reinstall onnxruntime; a bundle with a table decides without it",
        needed=True,
    )
    if sys.platform == "win32":
        return
    import resource

    user = os.environ.get("USER", "$USER")
    for check, name, key, line in (
        ("SCHED_FIFO", "RLIMIT_RTPRIO", "sched_fifo", f"{user} - rtprio 20"),
        ("locked memory", "RLIMIT_MEMLOCK", "mlockall", f"{user} - memlock unlimited"),
    ):
        limit = resource.getrlimit(getattr(resource, name))[0] if hasattr(resource, name) else None
        stated = "root" if os.geteuid() == 0 else "unlimited" if limit == resource.RLIM_INFINITY else f"limit {limit}"
        ok = tried[key] == "granted"
        remedy = (
            f"for steadier latencies: echo '{line}' | sudo tee -a /etc/security/limits.d/pans.conf, log in again"
            + ("; a container or virtual machine may refuse it all the same" if stated in ("root", "unlimited") else "")
        )
        taken = "asked for by each run" if ok else "runs go on without it"
        yield Finding(check, ok, f"announced {stated}; works {tried[key]}; taken: {taken}", "" if ok else remedy)


# What a child process tries, each answer on a line: integers and floats in vectors, the golden scores of a shipped head, privileges.
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
from pans.runtime import SHIPPED
from pans.runtime.bundle.model import load_bundle
from pans.runtime.decide.onnx import OnnxDecider
try:
    OnnxDecider(load_bundle(SHIPPED / "fashion10.pans")[0])
    print("onnxruntime=right", flush=True)
except Exception as error:
    print(f"onnxruntime={error}".splitlines()[0], flush=True)
from pans.runtime.timing.ledger import request_fifo, request_mlockall
print("sched_fifo=" + request_fifo([0]), flush=True)
print("mlockall=" + request_mlockall(), flush=True)
"""
TRIAL_PATIENCE_S = 120.0  # compiling on a busy machine


def _tried(*names: str) -> dict[str, str]:
    """Return what a child process answered for each name; how it ended, for those without an answer."""
    try:
        done = subprocess.run([sys.executable, "-c", _TRIAL], capture_output=True, text=True, timeout=TRIAL_PATIENCE_S)
        printed, reason = done.stdout, (done.stderr.strip().splitlines() or [""])[-1]
        ended = f"the process ended by signal {-done.returncode}" if done.returncode < 0 else reason
    except subprocess.TimeoutExpired as error:
        printed, ended = (error.stdout or b"").decode(), f"no answer within {TRIAL_PATIENCE_S:.0f} s"
    answers = dict(line.split("=", 1) for line in printed.splitlines() if "=" in line)
    return {name: answers.get(name, ended) for name in names}


def check_governor() -> Iterator[Finding]:
    """The processor does not slow down between decisions."""
    governor = _first_line("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    ok = governor in ("", "performance")
    remedy = "" if ok else "for steadier latencies: sudo cpupower frequency-set -g performance"
    yield Finding("processor governor", ok, governor or "not offered by this system", remedy)


def check_udev() -> Iterator[Finding]:
    """The rule that gives access to instruments is installed."""
    if sys.platform != "linux":
        return
    where = next((folder for folder in RULES_FOLDERS if (Path(folder) / RULE).exists()), "")
    groups = _group_names()
    remedy = f"pans doctor --udev | sudo tee /etc/udev/rules.d/{RULE}; or join the group dialout"
    ok = bool(where) or "dialout" in groups or os.geteuid() == 0
    found = (
        f"rule in {where}"
        if where
        else "no rule, " + ("in group dialout" if "dialout" in groups else "not in group dialout")
    )
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


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_python,
    check_numba,
    check_libusb,
    check_clock,
    check_processor,
    check_governor,
    check_udev,
    check_ports,
    check_others,
)


def examine(checks: tuple[Callable[[], Iterator[Finding]], ...] = CHECKS) -> list[Finding]:
    """Run all checks; one that breaks becomes a finding and stops no other."""
    findings: list[Finding] = []
    for check in checks:
        name = check.__name__.removeprefix("check_").replace("_", " ")
        try:
            findings += check()
        except ImportError as error:
            remedy = "pip install --force-reinstall pans-runtime"
            findings.append(Finding(name, False, f"cannot be loaded: {error}", remedy, needed=True))
        except Exception as error:
            findings.append(Finding(name, False, f"the check itself failed: {error!r}", "report this with its text"))
    return findings


def _first_line(path: str) -> str:
    try:
        return Path(path).read_text().splitlines()[0].strip()
    except (OSError, IndexError, UnicodeDecodeError):
        return ""


def _group_names() -> set[str]:
    import grp

    names: set[Any] = set()
    for number in os.getgroups():
        try:
            names.add(grp.getgrgid(number).gr_name)
        except KeyError:
            continue
    return names
