"""The simulator's shells: URLs, virtual time, and a pty and TCP through real pyserial (waits are bounded, nothing sleeps)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pans.base.errors import ConfigError, LinkError, UsageError
from pans.base.machine.realtime import scheduled
from pans.bundle.backends.choose import make_decider
from pans.decide.still.core import Core
from pans.instrument.profile import load_profile
from pans.live.loop import Job, Observers, RunResult, run_live
from pans.live.options import RunOptions
from pans.live.session import Session
from pans.protocol.links.base import Link, open_link
from pans.protocol.wire import DeviceState
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports import shell
from pans_sim.ports.serve import ChildLink, SimOptions, build_instrument, open_sim, parse_sim_url
from pans_sim.ports.shell import Port, TcpPort, open_port, serve
from pans_sim.ports.virtual import START_NS, VirtualLink
from pans_sim.scene.still import load_scene
from pans_sim.testing import small_setup

PATIENCE_S = 20.0
FAST = "sim:ideal?scene=uniform&pace=fast"
needs_pty = pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")


# -- URLs --------------------------------------------------------------------------------------------------------------


def test_a_url_names_the_instrument() -> None:
    assert parse_sim_url("sim:ideal") == SimOptions("ideal")
    url = "sim:my/lab.toml?scene=a%20b.npz&seed=7&pace=fast&offset=5&drift_ppm=-30.5"
    assert parse_sim_url(url) == SimOptions("my/lab.toml", "a b.npz", 7, "fast", 5, -30.5)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("sim:", "is no simulator URL"),
        ("sim:?seed=1", "is no simulator URL"),
        ("sim:ideal?sead=1", "unknown key 'sead'"),
        ("sim:ideal?profile=other", "unknown key 'profile'"),
        ("sim:ideal?seed", "no list of key=value"),
        ("sim:ideal?seed=x", "seed must be a whole number, found 'x'"),
        ("sim:ideal?seed=-1", "seed=-1"),
        ("sim:ideal?pace=slow", "pace=slow"),
        ("sim:ideal?offset=-1", "offset=-1"),
        ("sim:ideal?drift_ppm=nan", "drift_ppm=nan"),
        ("sim:ideal?drift_ppm=5000", "drift_ppm=5000"),
        ("sim:ideal?optics=shift=1", "allowed: shift=RIGHT,DOWN"),
        ("sim:ideal?optics=psf=-1", "psf_px is -1.0"),
        ("sim:ideal?optics=psf=1:tilt=2", "'tilt=2', allowed: KEY=VALUE"),
        ("sim:ideal?" + "&".join(["seed=1"] * 50), "no list of key=value"),
    ],
)
def test_what_cannot_be_meant_is_refused(url: str, text: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_sim_url(url)
    assert text in str(caught.value)


def test_hidden_optics_change_the_light_and_are_announced() -> None:
    options = parse_sim_url("sim:ideal?scene=fashion200&pace=fast&optics=shift=1,-2:black=0.01:gain=5%")
    instrument, _ = build_instrument(options, START_NS)
    assert isinstance(instrument, Instrument)
    imaging = instrument.view.scene.what.imaging  # type: ignore[union-attr]
    assert (imaging.right_px, imaging.down_px, imaging.black, imaging.gain) == (1.0, -2.0, 0.01, 1.05)
    assert instrument._facts()["simulated_optics"] == "right_px 1, down_px -2, black 0.01, gain 1.05"
    perfect, _ = build_instrument(parse_sim_url("sim:ideal?scene=fashion200&pace=fast"), START_NS)
    assert "simulated_optics" not in perfect._facts()  # type: ignore[attr-defined]


def test_optics_are_for_objects_that_stand_still() -> None:
    options = parse_sim_url("sim:flow-snspd?scene=cells-in-flow&pace=fast&optics=psf=0.5")
    with pytest.raises(ConfigError, match="'cells-in-flow' moves: optics other than perfect"):
        build_instrument(options, START_NS)


@pytest.mark.parametrize("pace", ["fast", "real"])
def test_a_wrong_profile_or_scene_is_told_by_the_opener(pace: str) -> None:
    with pytest.raises(ConfigError):
        open_sim(f"sim:nowhere?pace={pace}")
    with pytest.raises(ConfigError):
        open_sim(f"sim:ideal?scene=nowhere&pace={pace}")


@pytest.mark.parametrize("listen", ["", "tcp", "tcp:", "tcp:x", "tcp:127.0.0.1:70000", "udp:1", "pty:1"])
def test_an_unknown_port_is_refused(listen: str) -> None:
    with pytest.raises(UsageError, match="cannot listen on"):
        open_port(listen)


def test_a_taken_port_is_a_link_error() -> None:
    first = open_port("tcp:0")
    try:
        with pytest.raises(LinkError, match="cannot listen"):
            open_port(f"tcp:{first.url.rpartition(':')[2]}")
    finally:
        first.close()


# -- the device's clock ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drift_ppb", [-100_000, 0, 20_000, 123_456])
@pytest.mark.parametrize("tick_hz", [1000, 1_000_000, 100_000_000, 10_000_000_000])
def test_ticks_and_nanoseconds_are_inverse(tick_hz: int, drift_ppb: int) -> None:
    clock = DeviceClock(tick_hz, 55, drift_ppb)
    for tick in (55, 56, 1000, 123_456_789, 2**61):
        host_ns = clock.host_ns_at(tick)
        assert clock.tick_at(host_ns) >= tick
        assert host_ns == 0 or clock.tick_at(host_ns - 1) < tick
    assert clock.tick_at(0) == 55


def test_the_clock_drifts_as_told() -> None:
    clock = DeviceClock(1_000_000, 0, 20_000)
    assert clock.tick_at(10**9 * 1000) == 1_000_000 * 1000 + 20_000


# -- virtual time ------------------------------------------------------------------------------------------------------


def test_virtual_time_stops_at_each_emission() -> None:
    link = open_sim(FAST)
    assert isinstance(link, VirtualLink)
    assert (link.simulated, link.virtual, link.name) == (True, True, FAST)
    assert link.now_ns() == START_NS
    assert link.read(0.5) == b""  # nothing to come before a session
    assert link.now_ns() == START_NS + 500_000_000
    Session(link).handshake()
    before = link.now_ns()
    status = link.read(10.0)
    assert len(status) > 20
    second = link.now_ns() - before
    assert second == link.clock.host_ns_at(link.device.next_event_tick() - 1_000_000) - before
    assert abs(second - 10**9) < 50_000  # 20 ppm fast, and one microsecond tick
    assert link.read(0.0) == b""


# -- real pace -----------------------------------------------------------------------------------------------------------


@contextmanager
def serving(listen: str) -> Iterator[tuple[Port, Instrument]]:
    """An instrument behind a real port, served by a thread; a failure there fails the test."""
    profile = load_profile("ideal")
    clock = DeviceClock(profile.clock.tick_hz)
    device = Instrument(profile, load_scene("uniform"), power_on_tick=clock.tick_at(time.perf_counter_ns()))
    port, stop, died = open_port(listen), threading.Event(), []

    def work() -> None:
        try:
            serve(device, clock, port, stop.is_set)
        except BaseException as error:
            died.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield port, device
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        port.close()
    assert not thread.is_alive()
    assert not died


@pytest.mark.parametrize("listen", [pytest.param("pty", marks=needs_pty), "tcp:127.0.0.1:0"])
def test_a_client_that_hangs_up_leaves_the_light_off_and_may_return(listen: str) -> None:
    profile, bundle, plan = small_setup()

    def run_on(link: Link, n_cycles: int, observers: Observers) -> RunResult:
        core = Core(plan, make_decider(bundle), 1, n_cycles)
        options = RunOptions(n_cycles=n_cycles, deadline_us=1e9, lease_ms=300, realtime=False)
        return run_live(link, Job(profile, bundle, plan, options), core, observers=observers)

    with serving(listen) as (port, device):
        link = open_link(port.url)
        assert run_on(link, 0, Observers(lambda run, output: link.close())).link_lost
        wait_for(lambda: device.state is DeviceState.SAFE)
        assert not device.projector_lit
        assert run_on(open_link(port.url), 20, Observers()).tally.decisions == 20


def wait_for(condition: Any) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"


def test_tcp_listens_on_loopback_unless_told_otherwise() -> None:
    port = open_port("tcp:0")
    assert port.url.startswith("serial:socket://127.0.0.1:")
    port.close()


def test_without_a_client_output_is_lost_not_kept() -> None:
    port = TcpPort("127.0.0.1", 0)
    assert port.write(b"abc") == 3
    assert port.read() == b""
    port.close()


class StuckPort:
    """A port whose client never reads."""

    url = "stuck"

    def __init__(self) -> None:
        self.waits = 0
        self.largest = 0

    def read(self) -> bytes:
        return b""

    def write(self, data: bytes) -> int:
        self.largest = max(self.largest, len(data))
        return 0

    def wait(self, timeout_s: float, wants_to_write: bool) -> bool:
        self.waits += 1
        return False

    def close(self) -> None:
        pass


class Talker:
    """A device that always has something to say."""

    session = 0

    def step(self, tick: int, data: bytes) -> bytes:
        return b"x" * 1000 + b"\0"

    def next_event_tick(self) -> int | None:
        return None

    def draw_ahead(self) -> bool:
        return False


def test_a_client_that_never_reads_costs_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shell, "MAX_BACKLOG_BYTES", 10_000)
    port = StuckPort()
    serve(Talker(), DeviceClock(1_000_000), port, lambda: port.waits > 100)
    assert port.largest == 9 * 1001  # whole outputs only


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not bind threads to cores")
def test_the_loop_on_a_core_of_its_own_runs_and_gives_its_priority_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its spinner waits on the same core: with the loop's priority it would never let the loop run."""
    monkeypatch.setattr(shell, "MAX_BACKLOG_BYTES", 10_000)
    port, before = StuckPort(), (os.sched_getscheduler(0), os.sched_getaffinity(0))
    serve(Talker(), DeviceClock(1_000_000), port, lambda: port.waits > 100, max(before[1]), realtime=True)
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="this system has no such priorities")
def test_a_simulator_has_real_time_priority_only_where_it_is_asked_for() -> None:
    with scheduled("SCHED_FIFO", shell.FIFO_PRIORITY):
        wanted = os.sched_getscheduler(0)
    for realtime, policy in ((False, os.sched_getscheduler(0)), (True, wanted)):
        port, seen = StuckPort(), set[int]()

        def stopped(port: StuckPort = port, seen: set[int] = seen) -> bool:
            seen.add(os.sched_getscheduler(0))
            return port.waits > 3

        serve(Talker(), DeviceClock(1_000_000), port, stopped, realtime=realtime)
        assert seen == {policy}


# -- processes of their own --------------------------------------------------------------------------------------------


def test_the_process_of_real_pace_ends_with_the_link() -> None:
    link = open_sim("sim:ideal?scene=uniform")
    assert isinstance(link, ChildLink)
    link.close()
    assert link._child.wait(60) == 0
    link.close()


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs SIGSTOP")
def test_closing_a_link_does_not_wait_for_a_child_that_hangs() -> None:
    link = open_sim("sim:ideal?scene=uniform")
    assert isinstance(link, ChildLink)
    child = link._child
    child.send_signal(signal.SIGSTOP)
    link.close()
    assert child.returncode is None
    assert child.wait(60) == -signal.SIGKILL  # the thread that waits for it has ended it


def test_the_child_ends_when_its_parent_dies() -> None:
    code = "import os, sys; from pans_sim.ports.serve import open_sim\n"
    code += "link = open_sim('sim:ideal?scene=uniform'); print(link._child.pid, flush=True); os._exit(9)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        parent.stdout.read()  # also the child has closed it: it is gone
    assert parent.returncode == 9

    def gone() -> bool:
        try:
            return "State:\tZ" in Path(f"/proc/{pid}/status").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return True

    if sys.platform == "linux":
        wait_for(gone)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM to catch")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
@pytest.mark.parametrize("how", [["-m", "pans_sim"], ["-m", "pans.app", "simulate"]])
def test_simulate_prints_its_url_and_serves_until_told_to_end(how: list[str], number: int, code: int) -> None:
    if "pans.app" in how:
        how = ["-c", "import sys; from pans.app.main import main; sys.exit(main())", "simulate"]
    words = [sys.executable, *how, "--profile", "ideal", "--scene", "uniform", "--listen", "tcp:0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().decode().strip()
            link = open_link(url)
            assert Session(link).handshake().facts["simulated"] is True
            link.close()
            process.send_signal(number)
            assert process.wait(PATIENCE_S) == code
        finally:
            process.kill()


def test_a_mistake_on_the_command_line_is_told() -> None:
    words = [sys.executable, "-m", "pans_sim", "--profile", "nowhere"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "there is no profile 'nowhere'" in done.stderr


def test_the_simulator_starts_lean() -> None:
    code = "import sys, pans_sim.commands; print([m for m in sys.modules if '.' not in m])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    for heavy in ("numba", "onnxruntime", "rich", "torch", "usb"):
        assert f"'{heavy}'" not in done.stdout
