"""`pans bench link`: the round trip from a command to a click block, beside the raw echo of the same bytes in the same run.

Owns the measurement and its report; the instrument is the simulator in a process of its own (over pyusb: in a thread). The device holds
finished blocks back until the receive window lets them out, and each GRANT that moves the window by one releases exactly one. What is
timed is from making the GRANT until the core has digested the block. The raw echo sends as many bytes and gets as many back, through the
same link, from a process that does nothing else. Both alternate in short turns, so that whatever else the machine does hits both.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from .bundle import Bundle, make_bundle
from .connection import Connection
from .core import Core
from .decide import make_decider
from .errors import LinkError
from .link import Link, open_link
from .plan import Plan, build_plan
from .profile import load_profile
from .timing import arm_realtime
from .wire import DeviceState, FrameDecoder, Opcode
from .wire_commands import Arm, pack_arm

PROFILE = "ideal"
N_PATTERNS = 4
TURN = 100  # round trips of one kind in a row
BUFFER_MESSAGES = 1 << 15
PATIENCE_S = 20.0
WARM_UP = 200


def bench_link(transports: Sequence[str] = ("pty", "tcp", "usb"), samples: int = 4000) -> list[dict[str, Any]]:
    """Return rows of {name, p50_us, p99_us, p999_us, max_us, samples, ratio_p50}; `ratio_p50` is to the raw echo of that transport.

    Rows per transport: the raw echo, the round trip read directly, and through the reading thread of the live loop. pyusb's echo is
    the loopback socket below its backend, since nothing is nearer to a wire there.
    """
    rows = []
    for transport in transports:
        if transport == "pty" and not hasattr(os, "openpty"):
            continue
        rows += _bench_transport(transport, samples)
    return rows


def _bench_transport(transport: str, samples: int) -> list[dict[str, Any]]:
    listen = "pty" if transport == "pty" else "tcp:127.0.0.1:0"
    request, answer_bytes = _sizes()
    with _simulator(listen, "--echo", str(answer_bytes)) as echo_url, _instrument(transport, listen) as link:
        echo = open_link(echo_url)
        trip = _RoundTrip(link)
        times: dict[str, list[int]] = {"raw echo": [], "round trip": [], "through the reader thread": []}
        turns: dict[str, Callable[[], int]] = {
            "raw echo": lambda: _echo_once(echo, request, answer_bytes),
            "round trip": trip.direct,
        }
        with arm_realtime(True):
            for _ in range(WARM_UP):
                for once in turns.values():
                    once()
            for _ in range(-(-samples // TURN)):
                for name, once in turns.items():
                    times[name] += [once() for _ in range(TURN)]
            trip.start_reader()
            for _ in range(WARM_UP + samples):
                times["through the reader thread"].append(trip.through_reader())
        del times["through the reader thread"][:WARM_UP]
        echo.close()
        trip.stop_reader()
    raw_us = float(np.median(times["raw echo"])) / 1000
    return [_row(f"{transport}: {name}", values, raw_us) for name, values in times.items()]


def _row(name: str, times_ns: list[int], raw_us: float) -> dict[str, Any]:
    p50, p99, p999 = (float(value) / 1000 for value in np.quantile(times_ns, [0.5, 0.99, 0.999]))
    return {
        "name": name,
        "p50_us": p50,
        "p99_us": p99,
        "p999_us": p999,
        "max_us": max(times_ns) / 1000,
        "samples": len(times_ns),
        "ratio_p50": p50 / raw_us,
    }


def _echo_once(link: Link, request: bytes, answer_bytes: int) -> int:
    started = time.perf_counter_ns()
    link.write(request)
    missing = answer_bytes
    while missing > 0:
        missing -= len(link.read(1.0))
    return time.perf_counter_ns() - started


class _RoundTrip:
    """A device full of finished blocks, and the ways to ask for the next one."""

    def __init__(self, link: Link) -> None:
        bundle, plan = _bundle_and_plan()
        self._link = link
        self._connection = Connection(link)
        self._connection.handshake()
        self._connection.upload(plan, bundle)
        clock = self._connection.synchronise()
        self._core = Core(plan, make_decider(bundle), 1, 0)
        self._core.warm_up()
        session = self._connection.session
        start = clock.to_tick(link.now_ns() + 50_000_000)
        cycles = BUFFER_MESSAGES - 1  # and one mark
        session.submit(Opcode.ARM, pack_arm(Arm(start, cycles, 60_000)))
        self._connection.settle()
        deadline = link.now_ns() + int(PATIENCE_S * 1e9)
        while session.status is None or session.status.state != DeviceState.IDLE or session.status.tick < start:
            self._connection.pump(0.05)
            if link.now_ns() > deadline:
                raise LinkError(f"the simulated instrument did not finish its exposures within {PATIENCE_S:g} s")
        self._core.begin(start, 0)
        self._limit = 0
        self._decoder: FrameDecoder = self._connection.decoder
        self._connection.reader.stop()
        self.direct()  # the mark

    def direct(self) -> int:
        """Ask for one message and digest it; return the nanoseconds that it took."""
        session, link, started = self._connection.session, self._link, time.perf_counter_ns()
        self._limit += 1
        session.grant(self._limit, 0)
        link.write(session.take_output())
        while True:
            data = link.read(1.0)
            arrival_ns = time.perf_counter_ns()
            for frame in self._decoder.feed(data):
                if session.on_frame(frame, arrival_ns):
                    self._core.step(frame)
            if self._core.tracker.next_seq == self._limit:
                return time.perf_counter_ns() - started

    def start_reader(self) -> None:
        """Read through a thread from now on, as the live loop does."""
        self._connection = _rejoin(self._connection, self._link)

    def through_reader(self) -> int:
        """As `direct`, by the live loop's own pump."""
        connection, started = self._connection, time.perf_counter_ns()
        self._limit += 1
        connection.session.grant(self._limit, 0)
        while True:
            for _, frame in connection.pump(1.0):
                self._core.step(frame)
            if self._core.tracker.next_seq == self._limit:
                return time.perf_counter_ns() - started

    def stop_reader(self) -> None:
        """End the thread."""
        self._connection.detach()


def _rejoin(before: Connection, link: Link) -> Connection:
    connection = Connection(link)
    connection.session, connection.decoder, connection.clock = before.session, before.decoder, before.clock
    return connection


def _bundle_and_plan() -> tuple[Bundle, Plan]:
    profile = load_profile(PROFILE)
    top = profile.projector.levels - 1
    levels = np.full((N_PATTERNS, 4), top, np.uint16)
    exposure_s = profile.exposure.min_us * 1e-6
    bundle = make_bundle(
        name="bench",
        task="bench",
        classes=("a", "b"),
        image_shape=(2, 2),
        levels=top + 1,
        pattern_levels=levels,
        photons_per_level=exposure_s * profile.projector.peak_photoelectrons_hz / top,
        table=np.zeros((1 << N_PATTERNS, 2), np.float32),
        provenance={},
    )
    return bundle, build_plan(profile, bundle, shots_per_object=BUFFER_MESSAGES)


def _sizes() -> tuple[bytes, int]:
    """Return the bytes of one request and how many one answer has: 12 + 36 + 2n + n/8 bytes and their framing."""
    from .wire import ClickBlock, Grant, encode_clicks, encode_grant

    _, plan = _bundle_and_plan()
    n = plan.slots_per_cycle
    block = ClickBlock(1000, 0, 123_456_789, 5000, 10, 0, np.zeros(n, np.uint16), np.zeros(n, np.uint8))
    return encode_grant(Grant(1000, 0), 0x12345678), len(encode_clicks(block, 0x12345678))


@contextmanager
def _instrument(transport: str, listen: str) -> Iterator[Link]:
    if transport == "usb":
        link = open_link(f"simusb:{PROFILE}?scene=uniform&buffer={BUFFER_MESSAGES}")
        try:
            yield link
        finally:
            link.close()
        return
    with _simulator(listen, "--buffer", str(BUFFER_MESSAGES)) as url:
        link = open_link(url)
        try:
            yield link
        finally:
            link.close()


@contextmanager
def _simulator(listen: str, *more: str) -> Iterator[str]:
    """Run a simulator in a process of its own; yield its device URL."""
    words = [sys.executable, "-m", "pans.firmware_sim", "--profile", PROFILE, "--scene", "uniform", "--listen", listen]
    child = subprocess.Popen([*words, *more, "--until-stdin-closes"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        url = child.stdout.readline().decode().strip()
        if not url:
            raise LinkError("the simulator did not start", remedy="run `pans simulate --profile ideal` to see why")
        yield url
    finally:
        child.stdin.close()
        child.stdout.close()
        child.wait(PATIENCE_S)
