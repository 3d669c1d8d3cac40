"""`sim:` device URLs -> an open link to a simulated instrument, in process or in a process of its own.

`open_sim` returns a Link: pace=fast is virtual time in process (virtual.py), pace=real a child behind an ordinary port (shell.py), since
in one process the interpreter's lock would let the instrument disturb the host that it is there to measure.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, replace
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from pans.base.console import option, words_of
from pans.base.errors import ConfigError, LinkError, UsageError, as_usage_error
from pans.bundle.sensor import Analyser, load_bundle
from pans.instrument.optics import bleaching_of, imaging_of, is_spec
from pans.instrument.profile import Profile, load_profile
from pans.protocol.links import Link, descriptor_of, open_link
from pans_sim.device.clock import BUFFER_MESSAGES, DEFAULT_DRIFT_PPM, DEFAULT_OFFSET_TICKS, DeviceClock, SteppedDevice

from .faults import NO_FAULTS, check_possible, parse_faults
from .faulty import FaultyDevice
from .shell import TcpPort, serve
from .virtual import START_NS, VirtualLink

if TYPE_CHECKING:
    from pans_sim.device.instrument import Instrument

DEFAULT_SCENE = "fashion200"
MAX_DRIFT_PPM = 1000.0
MAX_EXPOSURE_ERROR_US = 1e6
GOODBYE_S = 2.0
MAX_BUFFER_MESSAGES = 1 << 16


@dataclass(frozen=True, slots=True)
class SimOptions:
    """What a simulated instrument is made of; the field names are the URL's keys, and all but `pace` are options of `pans simulate`."""

    profile: str = option(MISSING, "a shipped profile's name or a .toml file")
    scene: str = option(DEFAULT_SCENE, "a shipped scene, uniform, dark, a .npz or a .toml file")
    seed: int = option(0, "of the detector's clicks (default 0)")
    pace: str = "real"
    offset: int = option(DEFAULT_OFFSET_TICKS, "device ticks at host time 0")
    drift_ppm: float = option(DEFAULT_DRIFT_PPM, "rate error of the device's clock")
    faults: str = option("", "like loss:0.01,stall:600ms/5s, or all, or a .toml file")
    buffer: int = option(BUFFER_MESSAGES, f"stream messages that the device can hold back (default {BUFFER_MESSAGES})")
    optics: str = option(
        "",
        "hidden truth of the optics, like shift=0.7,0.3:rotate=1.5:psf=0.7:gain=5%%:black=0.002; or a bundle, whose passive optics"
        " take the place of a projector",
        metavar="SPEC|BUNDLE",
    )
    bleach: str = option(
        "",
        "objects bleach: 1/e of a pixel's light is left after D0 photoelectrons on it; like 40 or 40:mixed",
        metavar="D0[:mixed]",
    )
    changes: str = option("", "like dark:at_s=30:factor=2,dead:at_s=40:channel=3 (docs/reference/simulator.md)")
    realtime: bool = option(False, "ask for real-time priority, above that of a run: most of a core is then its own")
    exposure_late_us: float = option(0.0, "a fault: exposures begin so much later than planned")
    exposure_short_us: float = option(0.0, "a fault: exposures are so much shorter than planned")


def parse_sim_url(url: str) -> SimOptions:
    """Read `sim:PROFILE[?scene=...&seed=N&pace=real|fast&faults=...&changes=...&optics=...&...]`, or raise UsageError."""
    scheme, _, rest = url.partition(":")
    profile, _, query = rest.partition("?")
    if scheme != "sim" or not profile:
        raise UsageError(f"{url!r} is no simulator URL", remedy="write sim:PROFILE, for example sim:ideal?pace=fast")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query), max_num_fields=16)
    except ValueError as error:
        raise UsageError(
            f"{url!r}: the part after ? is no list of key=value: {error}",
            remedy="for example sim:ideal?scene=uniform&seed=1",
        ) from error
    known = {field.name: field.type for field in fields(SimOptions) if field.name != "profile"}
    options = SimOptions(profile)
    for key, text in pairs:
        if key not in known:
            raise UsageError(f"{url!r}: unknown key {key!r}", remedy=f"known keys: {', '.join(known)}")
        if not text and key == "scene":
            raise UsageError(f"{url!r}: scene is empty", remedy="name a scene, or leave scene= out")
        options = replace(options, **{key: _value(url, key, text, str(known[key]))})
    return check_options(options)


def check_options(options: SimOptions) -> SimOptions:
    """Return `options` if they can be meant; UsageError names the one that cannot."""
    if options.pace not in ("real", "fast"):
        raise UsageError(f"pace={options.pace}: allowed are real and fast")
    if not 0 <= options.seed < 1 << 64:
        raise UsageError(f"seed={options.seed}: allowed are 0..2^64-1")
    if not 1 <= options.buffer <= MAX_BUFFER_MESSAGES:
        raise UsageError(f"buffer={options.buffer}: allowed are 1..{MAX_BUFFER_MESSAGES} messages")
    if not 0 <= options.offset < 1 << 60:
        raise UsageError(f"offset={options.offset}: allowed are 0..2^60-1 ticks")
    check_possible(parse_faults(options.faults), pace=options.pace)
    if is_spec(options.optics):
        with as_usage_error():
            imaging_of(options.optics)
    if options.bleach:
        with as_usage_error():
            bleaching_of(options.bleach)
    for name in ("exposure_late_us", "exposure_short_us"):
        if not 0 <= getattr(options, name) <= MAX_EXPOSURE_ERROR_US:
            raise UsageError(f"{name}={getattr(options, name)}: allowed are 0..{MAX_EXPOSURE_ERROR_US:g}")
    if not abs(options.drift_ppm) <= MAX_DRIFT_PPM:
        raise UsageError(f"drift_ppm={options.drift_ppm}: allowed are -{MAX_DRIFT_PPM:g}..{MAX_DRIFT_PPM:g}")
    return options


def build_instrument(options: SimOptions, host_ns: int) -> tuple[SteppedDevice, DeviceClock]:
    """Make the instrument, switched on at `host_ns`, and its clock; ConfigError for an impossible profile or scene.

    With faults, the instrument stands behind a bad link.
    """
    from pans_sim.device.instrument import Instrument  # only where the instrument is: a host waits for it
    from pans_sim.scene.scene_file import scene_on_table

    profile = load_profile(options.profile)
    clock = DeviceClock(profile.clock.tick_hz, options.offset, round(options.drift_ppm * 1000))
    scene = scene_on_table(options.scene, options.changes, options.optics, profile, options.bleach, options.seed)
    faults = parse_faults(options.faults)
    optics = _optics(options.optics)

    def switch_on(epoch: int, tick: int) -> Instrument:
        return Instrument(
            profile,
            scene,
            seed=options.seed,
            power_on_tick=tick,
            epoch=epoch,
            buffer_messages=options.buffer,
            optics=optics,
            exposure_late_us=options.exposure_late_us,
            exposure_short_us=options.exposure_short_us,
        )

    start_tick = clock.tick_at(host_ns)
    if faults == NO_FAULTS:
        return switch_on(1, start_tick), clock
    return FaultyDevice(switch_on, clock, faults, options.seed, start_tick), clock


def _optics(path: str) -> Analyser | None:
    if not path or is_spec(path):
        return None
    found = load_bundle(path)[0].analyser
    if found is None:
        raise ConfigError(f"{path}: an active bundle: it shows patterns and has no optics", remedy="leave optics= out")
    return found


def open_sim(url: str) -> Link:
    """Open a `sim:` URL (entry point of `pans.devices`); the link's `close` ends what it started."""
    options = parse_sim_url(url)
    if options.pace == "real":
        return ChildLink(url, options, load_profile(options.profile))
    instrument, clock = build_instrument(options, START_NS)
    return VirtualLink(instrument, clock, url)


class ChildLink(Link):
    """An instrument in a process of its own, reached through the runtime's ordinary serial link."""

    simulated = True
    virtual = False

    def __init__(self, url: str, options: SimOptions, profile: Profile) -> None:
        self.name = url
        self._closed = False
        self._child = _spawn(options)
        try:
            # while the child starts: it has far more to load before it could tell a mistake
            _check_scene(options, profile)
            self._url = self._first_line()
            self._connect()
        except BaseException:
            self._child.kill()  # it may not have come to where it sees that it is to end
            self._end_child()
            raise

    def _connect(self) -> None:
        self._link = open_link(self._url)

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        return self._link.read(timeout_s)

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._link.write(data)

    def now_ns(self) -> int:
        """See `Link.now_ns`."""
        return self._link.now_ns()

    def fileno(self) -> int | None:
        """Return the port's descriptor."""
        return descriptor_of(self._link)

    def reopen(self) -> ChildLink:
        """Open the port of the same instrument again."""
        self._link.close()
        self._connect()
        return self

    def close(self) -> None:
        """Close the port and let the child end, which a thread waits for: what a run has to tell does not; idempotent."""
        self._link.close()
        if not self._closed:
            self._closed = True
            threading.Thread(target=self._end_child, name="pans-sim-end").start()

    def _first_line(self) -> str:
        assert self._child.stdout is not None
        line = self._child.stdout.readline().decode("utf-8", "replace").strip()
        if not line:
            code = self._child.wait(GOODBYE_S)
            raise LinkError(f"the simulator of {self.name} did not start (exit code {code})")
        return line

    def _end_child(self) -> None:
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._child.wait(GOODBYE_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()


def _check_scene(options: SimOptions, profile: Profile) -> None:
    """Raise what is wrong with the scene here, where the message is clearer than the child's."""
    from pans_sim.scene.scene_file import scene_on_table

    scene_on_table(options.scene, options.changes, options.optics, profile, options.bleach, options.seed)
    _optics(options.optics)


def _spawn(options: SimOptions) -> subprocess.Popen[bytes]:
    # TCP, not a pseudo-terminal: a busy machine's kernel hands the bytes of a terminal on tens of milliseconds late
    # (docs/measurements/index.md), and a terminal cannot be unplugged.
    listen = ["--listen", "tcp:127.0.0.1:0"]
    words = [sys.executable, "-m", "pans_sim", *words_of(options), *listen, "--until-stdin-closes"]
    # One BLAS thread: the instrument shares the machine with the host that it is to measure. A session of its own: Ctrl-C is
    # for the host, which then leaves the instrument in a safe state.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    return subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, start_new_session=True, bufsize=0
    )


_READ: dict[str, Callable[[str], Any]] = {
    "int": int,
    "float": float,
    "str": str,
    "bool": {"0": False, "1": True}.__getitem__,
}


def _value(url: str, key: str, text: str, kind: str) -> Any:
    try:
        return _READ[kind](text)
    except (ValueError, KeyError):
        noun = {"int": "a whole number", "bool": "0 or 1"}.get(kind, "a number")
        raise UsageError(f"{url!r}: {key} must be {noun}, found {text!r}") from None


class ThreadedInstrument:
    """An instrument in a thread of this process, until `close`, for drivers that need a device; one host at a time.

    Python's lock lets it disturb the host, so that latencies measured this way are upper bounds.
    """

    def __init__(self, options: SimOptions) -> None:
        self._device, clock = build_instrument(options, time.perf_counter_ns())
        self._port = TcpPort("127.0.0.1", 0)
        self._stopped = threading.Event()
        args = (self._device, clock, self._port, self._stopped.is_set)
        self._thread = threading.Thread(target=serve, args=args, name="pans-sim", daemon=True)
        self._thread.start()

    def connect(self) -> socket.socket:
        """Return a socket to the instrument."""
        connection = socket.create_connection(self._port.address, timeout=GOODBYE_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def close(self) -> None:
        """Switch off; idempotent."""
        self._stopped.set()
        self._thread.join(GOODBYE_S)
        self._port.close()
