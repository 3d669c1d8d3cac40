"""One contract for every link: pty, socket://, pyserial's URL handler, pyusb, a process of its own, and virtual time.

The instrument behind each is the simulator, reached through real pyserial and real pyusb. Waits are bounded; nothing sleeps."""

import os
import select
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from links import served
from tree import ROOT

import pans
from pans.base.errors import LinkError, UsageError
from pans.bundle.backends.choose import make_decider
from pans.decide.still.core import Core
from pans.live.loop import Job, Observers, Recovery, RunResult, run_live
from pans.live.options import RunOptions
from pans.live.session import Session
from pans.protocol.links import base as link_module
from pans.protocol.links import reader as link_reader
from pans.protocol.links.base import Link, open_link
from pans.protocol.links.reader import LinkReader
from pans.protocol.links.serial import SerialLink, latency_timer_ms, port_of, usb_target
from pans.protocol.links.usb import UsbLink
from pans.protocol.wire import messages as wire
from pans_sim.ports import usb_backend
from pans_sim.ports.protocol_panssim import register
from pans_sim.ports.serve import SimOptions, ThreadedInstrument, build_instrument
from pans_sim.ports.shell import serve
from pans_sim.testing import small_setup

PATIENCE_S = 20.0
OPTIONS = SimOptions("ideal", "uniform")


@dataclass
class Rig:
    """An open link, and how to take the instrument away from it."""

    link: Any
    vanish: Callable[[], None]
    url: str


def rig(kind: str) -> Rig:
    if kind in ("pty", "tcp", "usb elsewhere"):
        running = ExitStack()
        device, clock = build_instrument(OPTIONS, time.perf_counter_ns())
        url = running.enter_context(served(device, clock, "pty" if kind == "pty" else "tcp:127.0.0.1:0")).url
        url = url.replace("serial:", "simusb:") if kind == "usb elsewhere" else url
        return Rig(open_link(url), running.close, url)
    scheme, more = {
        "handler": ("simserial", ""),
        "usb": ("simusb", ""),
        "child": ("sim", ""),
        "virtual": ("sim", "&pace=fast"),
    }[kind]
    link: Any = open_link(url := f"{scheme}:ideal?scene=uniform{more}")
    vanish: Callable[[], None] = {
        "usb": lambda: partial(setattr, link.backend, "plugged", False),
        "handler": lambda: link._port._instrument.close,
        "child": lambda: link._end_child,
        "virtual": lambda: partial(setattr, link, "_broken", True),
    }[kind]()
    return Rig(link, vanish, url)


KINDS = ["tcp", "handler", "usb", "usb elsewhere", "child", "virtual", *(["pty"] if hasattr(os, "openpty") else [])]


@pytest.fixture(params=KINDS)
def rigged(request: pytest.FixtureRequest) -> Iterator[Rig]:
    made = rig(request.param)
    yield made
    made.link.close()
    made.vanish()


def test_without_data_a_read_comes_back_empty_after_its_time(rigged: Rig) -> None:
    before_ns = rigged.link.now_ns()
    assert rigged.link.read(0.03) == b""
    waited_s = (rigged.link.now_ns() - before_ns) / 1e9
    assert 0.02 < waited_s < PATIENCE_S


def test_every_byte_arrives_in_order(rigged: Rig) -> None:
    """Two thousand probes in writes of many sizes: 256 byte values, long writes, and one answer each."""
    link = rigged.link
    connection = Session(link)
    connection.handshake()
    nonce = connection.host.nonce
    connection.reader.stop()
    probes = 2000
    data = b"".join(wire.encode_ping(number, number * 0x0101_0101_0101, nonce) for number in range(probes))
    writer = threading.Thread(target=write_in_parts, args=(link, data), daemon=True)
    decoder = wire.FrameDecoder()
    answers: list[wire.Pong] = []
    if link.virtual:
        write_in_parts(link, data)
    else:
        writer.start()
    deadline = time.monotonic() + PATIENCE_S
    while len(answers) < probes and time.monotonic() < deadline:
        for frame in decoder.feed(link.read(0.05)):
            if frame.type == wire.MessageType.PONG:
                answers.append(wire.decode_pong(frame.payload))
    assert [answer.probe_id for answer in answers] == list(range(probes))
    assert all(answer.host_ns == answer.probe_id * 0x0101_0101_0101 for answer in answers)
    assert decoder.counters.bytes_discarded == 0


def write_in_parts(link: Link, data: bytes) -> None:
    rng = np.random.default_rng(1)
    while data:
        size = int(rng.choice([1, 7, 64, 500, 4096]))
        link.write(data[:size])
        data = data[size:]


def test_a_closed_link_is_gone_and_may_be_closed_again(rigged: Rig) -> None:
    rigged.link.close()
    rigged.link.close()
    with pytest.raises(LinkError):
        rigged.link.read(0.01)
    with pytest.raises(LinkError):
        rigged.link.write(b"\0")


def test_when_the_instrument_vanishes_the_reader_ends_loudly(rigged: Rig) -> None:
    reader = LinkReader(rigged.link)
    rigged.vanish()
    deadline = time.monotonic() + PATIENCE_S
    with pytest.raises(LinkError):
        while time.monotonic() < deadline:
            reader.wait(0.05)
    reader.stop()


def run_on(link: Link, n_cycles: int, recovery: Recovery | None = None, pull: Any = None) -> RunResult:
    """Run `n_cycles` one-shot cycles of the small set-up on `link`; `pull` observes each block."""
    profile, bundle, plan = small_setup("sequential")
    core = Core(plan, make_decider(bundle), 1, n_cycles)
    config = RunOptions(n_cycles=n_cycles, deadline_us=1e9, realtime=False)
    return run_live(link, Job(profile, bundle, plan, config), core, recovery=recovery, observers=Observers(pull))


def test_a_whole_run_decides(rigged: Rig) -> None:
    result = run_on(rigged.link, 200)
    assert (result.ended, result.tally.decisions, result.tally.abstained) == ("completed", 200, 0)
    assert result.stream["lost_exposures"] == 0
    assert result.device["simulated"] is True


def test_a_device_that_stays_away_ends_the_run_loudly() -> None:
    made = rig("virtual")

    def absent(lost: Link) -> Link:
        raise LinkError("it is not there")

    recovery = Recovery(absent, 5.0, made.link.pause)
    result = run_on(made.link, 400, recovery, lambda run, output: made.vanish())
    assert result.link_lost
    assert result.ended == "the link was lost: it is not there (5 attempts in 5 s)"


def test_none_busy_and_no_permission_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    import serial

    with pytest.raises(LinkError, match="it is not there"):
        open_link("serial:/dev/no-such-port")
    for number, words in ((13, "no permission"), (16, "it is busy")):

        def refuse(*args: Any, _number: int = number, **options: Any) -> None:
            raise serial.SerialException(_number, "could not open port")

        monkeypatch.setattr(serial, "serial_for_url", refuse)
        with pytest.raises(LinkError, match=words) as caught:
            open_link("serial:/dev/ttyACM0")
        assert caught.value.remedy


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")
def test_a_port_that_another_link_holds_is_busy() -> None:
    made = rig("pty")
    try:
        with pytest.raises(LinkError, match="busy"):
            open_link(made.url)
    finally:
        made.link.close()
        made.vanish()


def test_usb_errors_are_told_apart() -> None:
    backend = usb_backend.SimBackend(ThreadedInstrument(OPTIONS))
    name = f"{usb_backend.VENDOR_ID:04x}:{usb_backend.PRODUCT_ID:04x}"
    try:
        first = UsbLink(name, backend)
        with pytest.raises(LinkError, match="busy"):
            UsbLink(f"{name}:{usb_backend.SERIAL_NUMBER}", backend)
        with pytest.raises(LinkError, match="is not there"):
            UsbLink(f"{name}:OTHER", backend)
        first.close()
        UsbLink(name, backend).close()
        backend.plugged = False
        with pytest.raises(LinkError, match="is not there"):
            UsbLink(name, backend)
    finally:
        backend.close()
    assert usb_target("1209:0001:A:B") == (0x1209, 1, "A:B")
    with pytest.raises(UsageError, match="in hex"):
        open_link("usb:xyz")


def test_ports_are_named_by_vendor_product_and_serial(monkeypatch: pytest.MonkeyPatch) -> None:
    from serial.tools import list_ports
    from serial.tools.list_ports_common import ListPortInfo

    ports = []
    for number in range(2):
        port = ListPortInfo(f"/dev/ttyACM{number}")
        port.vid, port.pid, port.serial_number = 0x1209, 1, f"A{number}"
        ports.append(port)
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    assert port_of("1209:0001:A1") == "/dev/ttyACM1"
    assert port_of("/dev/ttyS0") == "/dev/ttyS0"
    assert port_of("COM7") == "COM7"
    with pytest.raises(LinkError, match=r"matches 2 ports: /dev/ttyACM0 \(serial number A0\)"):
        port_of("1209:0001")
    with pytest.raises(LinkError, match="matches 0 ports: none"):
        port_of("1209:0002")


def test_the_url_handler_is_an_ordinary_pyserial_port() -> None:
    import serial

    register()
    with serial.serial_for_url("panssim://ideal?scene=uniform", timeout=5) as port:
        port.write(wire.encode_hello(7))
        assert port.read_until(b"\0") == b"\0"  # the end of whatever an earlier host left
        frame = wire.FrameDecoder().feed(port.read_until(b"\0"))[0]
    assert frame.type == wire.MessageType.WELCOME
    with pytest.raises(serial.SerialException, match="no profile"):
        serial.serial_for_url("panssim://nowhere")
    with pytest.raises(LinkError, match="cannot open"):
        SerialLink("panssim://nowhere")


def test_an_ftdi_adapters_latency_is_read(tmp_path: Any) -> None:
    folder = tmp_path / "bus" / "usb-serial" / "devices" / "ttyUSB3"
    folder.mkdir(parents=True)
    (folder / "latency_timer").write_text("16\n")
    assert latency_timer_ms("/dev/ttyUSB3", tmp_path) == 16
    assert latency_timer_ms("/dev/ttyACM0", tmp_path) is None


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < deadline:
        threading.Event().wait(0.001)


class Flood(Link):
    """A link that never runs dry."""

    name, simulated, virtual = "flood", True, False

    def __init__(self) -> None:
        self.reads = 0

    def read(self, timeout_s: float) -> bytes:
        self.reads += 1
        return b"x" * 1000

    def write(self, data: bytes) -> None:
        pass

    def now_ns(self) -> int:
        return time.perf_counter_ns()

    def close(self) -> None:
        pass


def test_the_readers_queue_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_reader, "MAX_QUEUED_BYTES", 10_000)
    flood = Flood()
    reader = LinkReader(flood)
    wait_for(lambda: reader._queued_bytes > 10_000)
    first = flood.reads
    threading.Event().wait(0.02)
    assert flood.reads <= first + 1  # the thread has stopped reading
    assert sum(len(chunk.data) for chunk in reader.wait(1.0)) <= 12_000
    reader.close()


class Counting(Flood):
    """A link that sends 0, 1, 2, ... one byte per read, until it breaks."""

    broken = False

    def read(self, timeout_s: float) -> bytes:
        if self.broken:
            raise LinkError("the cable was pulled")
        threading.Event().wait(0.0005)
        self.reads += 1
        return bytes([(self.reads - 1) % 256])


def test_a_thread_stands_in_while_the_loop_is_busy_and_keeps_the_order() -> None:
    link = Counting()
    reader = LinkReader(link)
    arrived: list[Any] = []
    deadline = time.monotonic() + PATIENCE_S
    stood_in = 0
    while stood_in < 3 and time.monotonic() < deadline:
        arrived += reader.wait(0.1, eager=len(arrived) % 2 == 0)
        before = link.reads
        threading.Event().wait(0.03)  # the loop is busy
        stood_in += link.reads > before
    arrived += reader.wait(0.1)
    reader.stop()
    while left := list(reader._chunks):
        arrived += reader.wait(0.0)
        assert left
    assert stood_in == 3
    assert b"".join(chunk.data for chunk in arrived) == bytes(number % 256 for number in range(len(arrived)))
    stamps = [chunk.arrival_ns for chunk in arrived]
    assert stamps == sorted(stamps)


def test_a_link_that_breaks_while_the_loop_is_busy_ends_every_further_wait() -> None:
    link = Counting()
    reader = LinkReader(link)
    assert reader.wait(0.1)
    link.broken = True
    wait_for(lambda: reader._death is not None)
    for _ in range(3):
        with pytest.raises(LinkError, match="the cable was pulled"):
            while True:
                reader.wait(0.01)
    reader.stop()


class FifoPort:
    """The instrument's end of two named pipes."""

    url = "fifo"

    def __init__(self, name: str) -> None:
        for end in ("in", "out"):
            os.mkfifo(f"{name}.{end}")
        self._in, self._out = (os.open(f"{name}.{end}", os.O_RDWR | os.O_NONBLOCK) for end in ("in", "out"))

    def read(self) -> bytes:
        with suppress(BlockingIOError):
            return os.read(self._in, 1 << 16)
        return b""

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError):
            return os.write(self._out, data)
        return 0

    def wait(self, timeout_s: float, wants_to_write: bool) -> bool:
        return bool(select.select([self._in], [self._out] if wants_to_write else [], [], timeout_s)[0])

    def hang_up(self) -> None:
        pass

    def close(self) -> None:
        os.close(self._in)
        os.close(self._out)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_the_documented_driver_works_by_its_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs" / "how-to" / "own-device.md").read_text()
    source = text.partition("```python\n")[2].partition("```")[0]
    assert len(source.splitlines()) <= 60
    driver = types.ModuleType("mylab_pipe")
    exec(compile(source, "docs/how-to/own-device.md", "exec"), driver.__dict__)
    monkeypatch.setitem(sys.modules, "mylab_pipe", driver)
    point = EntryPoint("pipe", "mylab_pipe:open_pipe", "pans.devices")
    monkeypatch.setattr(link_module, "entry_points", lambda group: [point])
    with pytest.raises(LinkError, match="start the instrument first"):
        open_link(f"pipe:{tmp_path}/none")
    device, clock = build_instrument(OPTIONS, time.perf_counter_ns())
    port, stopped = FifoPort(f"{tmp_path}/lab"), threading.Event()
    thread = threading.Thread(target=serve, args=(device, clock, port, stopped.is_set), daemon=True)
    thread.start()
    try:
        link = open_link(f"pipe:{tmp_path}/lab")
        result = run_on(link, 100)
        assert (result.ended, result.tally.decisions) == ("completed", 100)
        link.close()
        with pytest.raises(LinkError, match="is closed"):
            link.read(0.01)
    finally:
        stopped.set()
        thread.join(PATIENCE_S)
        port.close()


@pytest.mark.parametrize(
    ("body", "kind", "words"),
    [
        ("raise OSError(5, 'no such board')", LinkError, "cannot be opened by .*no such board"),
        ("return object()", UsageError, "as object, which has no name, simulated"),
    ],
)
def test_a_driver_that_does_not_keep_the_contract_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, kind: type[Exception], words: str
) -> None:
    (tmp_path / f"odd{kind.__name__}.py").write_text(f"def open_odd(url):\n    {body}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    point = EntryPoint("odd", f"odd{kind.__name__}:open_odd", "pans.devices")
    monkeypatch.setattr(link_module, "entry_points", lambda group: [point])
    with pytest.raises(kind, match=words):
        open_link("odd:1")


def test_a_simulated_instrument_behind_another_scheme_is_recorded_as_simulated(tmp_path: Path) -> None:
    url = "simserial:oled-qcmos?scene=fashion200&pace=fast"
    result = pans.run("fashion10", url, profile="oled-qcmos", decisions=5, out=tmp_path / "out")
    assert result.recording is not None
    recording = pans.load_recording(result.recording)
    assert recording.header["simulated"] is recording.simulated is result.summary.simulated is True


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells whose sockets are connected")
def test_a_device_that_another_program_uses_is_said_to_be_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pans.protocol.session.HELLO_GIVE_UP_NS", 300_000_000)
    device, clock = build_instrument(OPTIONS, time.perf_counter_ns())
    with served(device, clock) as port:
        first = Session(open_link(port.url))
        first.handshake()
        second = Session(open_link(port.url))
        with pytest.raises(LinkError, match="in use by another program") as refused:
            second.handshake()
        assert "firmware" not in refused.value.remedy
        second.close()
        first.close()
        third = Session(open_link(port.url))
        third.handshake()
        third.close()
