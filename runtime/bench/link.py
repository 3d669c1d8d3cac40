"""`pans bench link`: the round trip from a command to a click block, beside the raw echo of the same bytes in the same run.

Owns the measurement and its report; instrument and echo are processes of their own: the reference instrument and an echo in C where there
is a C compiler, else the simulator in Python. The device holds finished blocks back
until the receive window lets them out, and each GRANT that moves the window by one releases exactly one. What is timed is the live
loop's own path, from making the GRANT: until the click block is decoded and checked (`command to click block`), and until it is
decided and accounted for (`command to decision`). The raw echo sends as many bytes and gets as many back through the same kind of
link, once waiting in an ordinary read, and once awake, as the live loop waits for an answer (LinkReader). All
alternate in short turns, so that whatever else the machine does hits all of them.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pans.runtime.bundle.model import BackEnd, Bundle, Shown, make_bundle
from pans.runtime.core.decision import Output
from pans.runtime.core.plan import Plan, build_plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import LinkError
from pans.runtime.instrument.profile import load_profile
from pans.runtime.link.base import Link, open_link
from pans.runtime.link.connection import Connection
from pans.runtime.live import LiveRun, RunConfig
from pans.runtime.live.compiled import CompiledTurns
from pans.runtime.record import Recorder
from pans.runtime.timing.ledger import arm_realtime
from pans.runtime.turn import rings as ring
from pans.runtime.turn.engine import Turn
from pans.runtime.turn.system import offered
from pans.runtime.wire.commands import Arm, pack_arm
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import DeviceState, Frame, Opcode

from .other_end import PATIENCE_S, other_end
from .rows import BenchOptions, Row
from .turn_c import DEVICE, built

PROFILE = "ideal"
N_PATTERNS = 4
TURN = 100  # round trips of one kind in a row
BUFFER_MESSAGES = 1 << 15
WARM_UP = 200


def bench_link(options: BenchOptions) -> list[Row]:
    """Return the rows of every transport that this system has."""
    return link_rows(samples=400 if options.quick else 4000)


def link_rows(transports: Sequence[str] = ("pty", "tcp", "usb"), samples: int = 4000) -> list[Row]:
    """Return rows of {name, p50_us, p99_us, p999_us, max_us, samples, ratio_p50}; `ratio_p50` is to the raw echo of that transport.

    Over pyusb both the instrument and the echo stand behind its backend's socket; the same echo without pyusb is told beside it.
    """
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        device = built(DEVICE, "device", Path(folder))
        for transport in transports:
            if transport == "pty" and not hasattr(os, "openpty"):
                continue
            rows += _bench_transport(transport, samples, _other_ends(transport, device))
    return rows


class _OtherEnds(NamedTuple):
    """Words that start the instrument and the echo of one transport, and what both are written in."""

    instrument: list[str]
    echo: list[str]
    written_in: str


def _other_ends(transport: str, device: Path | str) -> _OtherEnds:
    """Both in C, or both in Python where `device` is a word on why there is no C."""
    listen = "pty" if transport == "pty" else "tcp:127.0.0.1:0"
    request, answer_bytes = _sizes()
    words = [sys.executable, "-m", "pans.firmware_sim", "--profile", PROFILE, "--scene", "uniform", "--listen", listen]
    words.append("--until-stdin-closes")
    instrument = [*words, "--buffer", str(BUFFER_MESSAGES)]
    if isinstance(device, str):
        return _OtherEnds(instrument, [*words, "--echo", str(answer_bytes)], "Python")
    echo = [str(device), listen.partition(":")[0], *map(str, (0, 0, 0, len(request), answer_bytes, 1))]
    return _OtherEnds([*instrument, "--engine", "c"], echo, "C")


def _bench_transport(transport: str, samples: int, ends: _OtherEnds) -> list[Row]:
    request, answer_bytes = _sizes()
    echoes = ("raw echo", "raw echo of its socket") if transport == "usb" else ("raw echo",)
    with ExitStack() as stack:
        trips = {"": stack.enter_context(_RoundTrip(_opened(stack, transport, ends.instrument)))}
        if transport == "usb" and not offered():
            trips[", compiled"] = stack.enter_context(
                _RoundTrip(_opened(stack, transport, ends.instrument), compiled=True)
            )
        turns: dict[str, Callable[[], tuple[int, ...]]] = {}
        for name in echoes:
            echo = _opened(stack, transport if name == "raw echo" else "tcp", ends.echo)
            turns[name] = partial(_echo_once, echo, request, answer_bytes, 1.0)
            turns[f"{name}, awake"] = partial(_echo_once, echo, request, answer_bytes, 0.0)
        turns |= {f"round trip{turn}": trip.once for turn, trip in trips.items()}
        times: dict[str, list[tuple[int, ...]]] = {name: [] for name in turns}
        with arm_realtime(True):
            for _ in range(WARM_UP):
                for once in turns.values():
                    once()
            for _ in range(-(-samples // TURN)):
                for name, once in turns.items():
                    times[name] += [once() for _ in range(TURN)]
    raw_us = float(np.median(times["raw echo"])) / 1000
    rows = [_row(f"{transport}: {name}", [one[0] for one in times[name]], raw_us) for name in turns if "echo" in name]
    for turn in trips:
        for place, name in enumerate(("command to click block", "command to decision")):
            found = [one[place] for one in times[f"round trip{turn}"]]
            rows.append(_row(f"{transport}: {name}{turn}", found, raw_us))
    return [row | {"other_end": ends.written_in} for row in rows]


def _row(name: str, times_ns: list[int], raw_us: float) -> Row:
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


def _echo_once(link: Link, request: bytes, answer_bytes: int, timeout_s: float) -> tuple[int, ...]:
    started = time.perf_counter_ns()
    link.write(request)
    missing = answer_bytes
    while missing > 0:
        missing -= len(link.read(timeout_s))
    return (time.perf_counter_ns() - started,)


class _NotingCore(Core):
    """A core that notes when a click block reached it, decoded and checked."""

    block_ns = 0

    def _on_status(self, frame: Frame) -> Output:
        """The device has long finished, which would settle all blocks that have not been asked for."""
        return Output([], [], None)

    def step_messages(self, messages: Messages, place: int) -> tuple[int, Output]:
        self.block_ns = time.perf_counter_ns()
        return super().step_messages(messages, place)


class _RoundTrip(ExitStack):
    """A device full of finished blocks, and a live run that asks for the next one and records it, in Python's turn or compiled ones."""

    def __init__(self, link: Link, *, compiled: bool = False) -> None:
        super().__init__()
        bundle, plan = _bundle_and_plan()
        self._connection = connection = Connection(link)
        connection.handshake()
        connection.upload(plan, bundle)
        clock = connection.synchronise()
        connection.decoder.use_kernels()
        self._core = _NotingCore(plan, make_decider(bundle), 1, 0)
        self._core.warm_up()
        folder = self.enter_context(tempfile.TemporaryDirectory())
        recorder = self.enter_context(Recorder(Path(folder) / "bench.pansrec", {}))
        self._run = LiveRun(connection, plan, self._core, len(bundle.classes), RunConfig(deadline_us=1e9), recorder, 0)
        self._compiled = self._compiled_turns() if compiled else None
        if not compiled:
            self._core.warm_up_steps()
        session = connection.session
        start = clock.to_tick(link.now_ns() + 50_000_000)
        cycles = BUFFER_MESSAGES - 1  # and one mark
        session.submit(Opcode.ARM, pack_arm(Arm(start, cycles, 60_000)))
        self._run.armed = connection
        connection.settle()
        deadline = link.now_ns() + int(PATIENCE_S * 1e9)
        while session.status is None or session.status.state != DeviceState.IDLE or session.status.tick < start:
            connection.pump(0.05)
            if link.now_ns() > deadline:
                raise LinkError(f"the simulated instrument did not finish its exposures within {PATIENCE_S:g} s")
        self._core.begin(start, 0)
        self._run.lateness.attach(connection, link.now_ns())
        self.callback(connection.detach)
        self.callback(self._run.lateness.close)
        self._limit = 0
        self.once()  # the mark

    def once(self) -> tuple[int, ...]:
        """Ask for one message; return the nanoseconds until its click block was there, and until it was dealt with."""
        run, connection, tracker, started = self._run, self._connection, self._core.tracker, time.perf_counter_ns()
        self._limit += 1
        connection.session.grant(self._limit, 0)
        while tracker.next_seq != self._limit:
            if self._compiled is None:
                run.take(connection.pump(1.0))
            else:
                self._compiled.turn(1.0)
            if time.perf_counter_ns() - started > PATIENCE_S * 1e9:
                raise LinkError(f"no click block within {PATIENCE_S:g} s of asking for it")
        return self._core.block_ns - started, time.perf_counter_ns() - started

    def _compiled_turns(self) -> CompiledTurns:
        """Return the turns of what Python reads: `pans run` takes them over links without a descriptor."""
        turns, core = CompiledTurns(self._run, self._core, prompt=False), self._core

        def note(turn: Turn, _: Output) -> None:
            if turn.counts.steps:
                core.block_ns = int(turn.blocks[-1, ring.DECODED])

        turns.prepare()
        turns.settled = note
        return turns


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
        optics=Shown(top + 1, levels, exposure_s * profile.projector.peak_photoelectrons_hz / top),
        back_end=BackEnd(table=np.zeros((1 << N_PATTERNS, 2), np.float32)),
        provenance={},
    )
    return bundle, build_plan(profile, bundle, shots_per_object=BUFFER_MESSAGES)


def _sizes() -> tuple[bytes, int]:
    """Return the bytes of one request and how many one answer has: 12 + 36 + 2n + n/8 bytes and their framing."""
    from pans.runtime.wire.messages import ClickBlock, Grant, encode_clicks, encode_grant

    _, plan = _bundle_and_plan()
    n = plan.slots_per_cycle
    block = ClickBlock(1000, 0, 123_456_789, 5000, 10, 0, np.zeros(n, np.uint16), np.zeros(n, np.uint8))
    return encode_grant(Grant(1000, 0), 0x12345678), len(encode_clicks(block, 0x12345678))


def _opened(stack: ExitStack, transport: str, words: list[str]) -> Link:
    """Return a link of that kind to a new other end; both end with the stack."""
    url = stack.enter_context(other_end(words))
    link = open_link(f"simusb:{url.removeprefix('serial:')}" if transport == "usb" else url)
    stack.callback(link.close)
    return link
