"""The process simulator: `pans run` in a process of its own against an instrument in this one, stopped, killed or hung at any stage.

Owns the child, the stages of a run at which it can be met, and the instrument's log of its light. The child is the ordinary command; at a
stage it says so on a pipe and waits to be let go, so that a signal meets it there.
"""

import ctypes
import faulthandler
import importlib
import json
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from typing import Any

import pytest
from tree import ROOT

from pans.bundle.backends import Verdict
from pans.bundle.sensor.bundle import write_bundle
from pans.instrument.profile import load_profile
from pans.protocol.wire import DeviceState, StateReason
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.shell import TcpPort, serve
from pans_sim.scene.still import load_scene
from pans_sim.testing import small_setup

# stage -> where the child is met: module, class or "" and name; the call before which it waits
STAGES = {
    "opening": ("pans.app.run.one_run", "", "open_link", 1),
    "handshake": ("pans.live.session", "Session", "handshake", 1),
    "upload": ("pans.live.session", "Session", "upload", 1),
    "armed": ("pans.live.loop", "", "_turn", 1),
    "running": ("pans.live.loop", "", "_turn", 60),
    "stopping": ("pans.live.loop", "", "stop", 1),
    "closing": ("pans.record.recorder", "Recorder", "close", 1),
}
HANGS = ("python", "native", "file")
HANGS_AFTER = 30  # decisions


class LightLog(Instrument):
    """An instrument that notes when its light goes on and off, in device ticks and on the clock of time.perf_counter."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.changes: list[tuple[DeviceState, StateReason, int, float]] = []
        self.granted_tick = 0
        super().__init__(*args, **options)

    def _enter(self, state: DeviceState, reason: StateReason) -> None:
        super()._enter(state, reason)
        self.changes.append((state, reason, self.tick, time.perf_counter()))

    def _renew(self, lease_ms: int) -> None:
        super()._renew(lease_ms)
        self.granted_tick = self.tick


@dataclass
class Lit:
    """An instrument that a host reaches over TCP; `device.changes` has its light on the clock of time.perf_counter."""

    device: LightLog
    url: str

    def dark_s(self) -> float:
        """When the light went off last."""
        return self.device.changes[-1][3]


@contextmanager
def lit_instrument() -> Iterator[Lit]:
    """Serve one."""
    profile, _, _ = small_setup("sequential")
    clock = DeviceClock(profile.clock.tick_hz)
    device = LightLog(profile, load_scene("uniform"), power_on_tick=clock.tick_at(time.perf_counter_ns()))
    port, stopped = TcpPort("127.0.0.1", 0), threading.Event()
    server = threading.Thread(target=serve, args=(device, clock, port, stopped.is_set), daemon=True)
    server.start()
    try:
        yield Lit(device, port.url)
    finally:
        stopped.set()
        server.join(30)
        port.close()


def write_inputs(folder: Path, lease_ms: int) -> tuple[Path, Path]:
    """Write the bundle and the profile of the instrument, with that lease; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    text = (ROOT / "hw_profiles" / "ideal.toml").read_text()
    profile, bundle = folder / "ideal.toml", folder / "small.pans"
    profile.write_text(text.replace("lease_ms = 1000", f"lease_ms = {lease_ms}"))
    assert load_profile(str(profile)).timing.lease_ms == lease_ms
    write_bundle(small_setup("sequential")[1], bundle)
    return bundle, profile


def offer_backend(folder: Path) -> None:
    """Install a package of a lab's own in `folder`: its back end `hanging` never returns from one of its decisions."""
    facts = folder / "hanging-1.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: hanging\nVersion: 1\n")
    (facts / "entry_points.txt").write_text("[pans.backends]\nhanging = host_process:Hanging\n")


class Hanging:
    """A lab's back end: it answers at first, then hangs as HANG says."""

    def __init__(self, bundle: Any) -> None:
        self.name, self.n_features, self.n_classes = "hanging", bundle.n_features, len(bundle.classes)
        self._left, self._due_s = HANGS_AFTER + 64 + 16, 0.0  # and those that it is tried with

    def decide(self, counts: Any, shots: int) -> Verdict:
        """Answer, or hang: half a second later, since one call of the loop may hold many decisions, and is accounted for at its end."""
        self._left -= 1
        if self._left < 0:
            self._due_s = self._due_s or time.monotonic() + 0.5
            if time.monotonic() >= self._due_s:
                _hang(os.environ["HANG"])
        return Verdict(0, 1.0)


def _hang(how: str) -> None:
    Path(os.environ["HUNG"]).touch()
    if how == "python":
        while True:
            pass
    if how == "native":  # a lock that is never given back, without the interpreter's: no signal handler runs here
        library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(256)
        library.pthread_mutex_lock(mutex)
        library.pthread_mutex_lock(mutex)
    if how == "file":  # what a file system that was paused does to a write
        os.read(os.pipe()[0], 1)


def _meet(stage: str, said: int, go: int) -> None:
    """Have this process wait where `stage` begins."""
    module, owner, name, wanted = STAGES[stage]
    place: Any = importlib.import_module(module)
    place = getattr(place, owner) if owner else place
    original, calls = getattr(place, name), [0]

    def met(*args: Any, **options: Any) -> Any:
        calls[0] += 1
        if calls[0] == wanted:
            os.write(said, b"x")
            os.read(go, 1)
        return original(*args, **options)

    setattr(place, name, met)


def _child(words: list[str], stage: str, pipes: Any, folder: str, environment: dict[str, str]) -> None:
    out = os.open(f"{folder}/stdout", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    errors = os.open(f"{folder}/stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    os.dup2(errors, 2)
    faulthandler.enable()
    os.environ.update(environment)
    sys.path.insert(0, f"{folder}/packages")
    from pans.app.main import main

    if environment.get("HANG") == "file":
        _hang_in_writes()
    if stage:
        _meet(stage, *(pipe.fileno() for pipe in pipes))
    code = main(words)
    sys.stdout.flush()
    os._exit(code)


def _hang_in_writes() -> None:
    from pans.record.recorder import Recorder

    original, writes = Recorder._write, [0]

    def write(self: Recorder, *pieces: Any) -> None:
        writes[0] += 1
        if writes[0] > 6:
            _hang("file")
        original(self, *pieces)

    Recorder._write = write  # type: ignore[method-assign]


@dataclass
class Host:
    """One `pans run` in a process of its own, in `folder`."""

    folder: Path
    process: Any
    said: Any
    goes: Any
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def recording(self) -> Path:
        """Where it records."""
        return self.folder / "out" / "run.pansrec"

    def state(self) -> dict[str, Any]:
        """What its state file says, {} before there is one."""
        try:
            return dict(json.loads((self.folder / "state.json").read_text()))
        except FileNotFoundError:
            return {}

    def wait_for_stage(self) -> None:
        """Wait until it waits at its stage."""
        assert self.said.poll(60), self.errors()
        os.read(self.said.fileno(), 1)

    def let_go(self) -> None:
        """Let it go on from its stage."""
        with suppress(BrokenPipeError):
            os.write(self.goes.fileno(), b"x")

    def signal(self, signum: int) -> None:
        """Send it a signal, if it is still there."""
        with suppress(ProcessLookupError):
            os.kill(self.process.pid, signum)

    def code(self, patience_s: float = 60.0) -> int:
        """Wait for its end and return its exit code."""
        self.process.join(patience_s)
        assert self.process.exitcode is not None, f"it did not end within {patience_s} s; {self.errors()}"
        return int(self.process.exitcode)

    def errors(self) -> str:
        """The end of what it wrote to stderr."""
        return (self.folder / "stderr").read_text(errors="replace")[-2000:]


def start_host(folder: Path, url: str, lease_ms: int, words: list[str], *, stage: str = "", hang: str = "") -> Host:
    """Start `pans run` on the instrument at `url` with `words`; it waits at `stage`, hangs as `hang` says."""
    bundle, profile = write_inputs(folder, lease_ms)
    offer_backend(folder / "packages")
    fixed = ["run", str(bundle), "--device", url, "--profile", str(profile), "--no-realtime", "--json"]
    places = ["--out", str(folder / "out"), "--state", str(folder / "state.json"), "--reconnect-s", "0.3"]
    if hang in ("python", "native"):
        places += ["--backend", "hanging"]
    environment = {"HANG": hang, "HUNG": str(folder / "hung"), "OMP_NUM_THREADS": "1"}
    context = multiprocessing.get_context("forkserver")
    (hears, tells), (waits, goes) = context.Pipe(duplex=False), context.Pipe(duplex=False)
    parts = ([*fixed, *places, *words], stage, (tells, waits), str(folder), environment)
    process = context.Process(target=_child, args=parts)
    with _SERVER:
        _start_server(context)
        process.start()
    tells.close()
    waits.close()
    return Host(folder, process, hears, goes)


_SERVER = threading.Lock()


def _start_server(context: Any) -> None:
    """Start the server of the hosts, unless it is there; it finds `warm_host` by PYTHONPATH alone."""
    context.set_forkserver_preload(["warm_host"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        ensure_running()


def until(condition: Callable[[], object], patience_s: float = 60.0) -> float:
    """Wait until `condition()`; return when it held, on the clock of time.perf_counter."""
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, f"nothing happened for {patience_s} s"
        time.sleep(0.01)
    return time.perf_counter()
