"""Whole sessions in which a device, or the host, says something else in one field (`pans fuzz --fields N`).

Owns the choice of a mutation from the message dictionary, the link that carries it out with a right checksum, and what must hold after
every session: errors of the package's own and no others, bounded time, a recording that can be read and replays to the same decisions,
and no PASS where the evidence contradicts what was said. Host, instrument and recording are the ordinary ones, in virtual time.
"""

from __future__ import annotations

import os
import random
import resource
import threading
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from pans.firmware_sim.checks.mutation import LAYOUTS, MISSING, STAMP, Mutation, by, field_of, is_of, mutate, to
from pans.firmware_sim.device.clock import DeviceClock, SteppedDevice
from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.engine import SteppedEngine
from pans.firmware_sim.ports.serve import SimOptions
from pans.firmware_sim.ports.shell import TcpPort, serve
from pans.firmware_sim.ports.virtual import START_NS, VirtualLink
from pans.firmware_sim.scene.moving import SceneFile
from pans.firmware_sim.scene.still import Scene, scene_from_arrays
from pans.firmware_sim.testing import small_setup
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import PansError
from pans.runtime.link.base import Link, open_link
from pans.runtime.live import RunOptions, run_live
from pans.runtime.record import Recorder, read_recording, replay
from pans.runtime.report.summary import Summary, summarise
from pans.runtime.timing.ledger import frozen_heap
from pans.runtime.wire import messages
from pans.runtime.wire.fields import FACTS, wrong_facts
from pans.runtime.wire.frame import Frame
from pans.runtime.wire.framing import FrameDecoder, encode_frame
from pans.runtime.wire.messages import NO_OBJECT, DeviceState, MalformedMessage, MessageType, decode_counts

OBJECTS = 12
SESSIONS_AT_ONCE = 25  # that one process is given
SHOTS = 1
MAX_GROWTH_MIB = 300  # of the process, during any number of sessions: below 400 with the 100 that it starts with
MAX_MIB = 400  # of each process of sessions in several, at its highest
MAX_SESSION_S = 30.0  # of processor time; one takes some 50 ms
EDGES = (0, 1, 2, 1 << 15, 1 << 16, 1 << 31, (1 << 32) - 1, 1 << 32, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
REALS = (0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), float("-inf"), 3e38, 1e-45)
STRANGE_FACTS: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1 << 63,
    (1 << 64) - 1,
    1.5,
    float("nan"),
    float("inf"),
    "",
    "x" * 257,
    b"b",
    [],
    {"a": [{}]},
)
TO_DEVICE = ("HELLO", "PING", "COMMAND", "GRANT", "LOAD_PATTERN", "LOAD_PLAN", "PLAN_SLOT", "ARM", "GATE")
BLOCKS = ("CLICKS", "FRAMES", "COUNTS")
FROM_DEVICE = ("WELCOME", "PONG", "ACK", "STATUS", "MARK")  # and the blocks of MODES
COUNTED = ("COUNTS", "COUNTS", STAMP, "READ_COUNTS", "READ_COUNTS", "LOAD_COUNT_STATES", "COUNT_STATE")
MODES = {  # and what a session of each has on the wire beside what all have
    "sequential": ("CLICKS", "CLICKS", STAMP),
    "parallel": ("FRAMES", "FRAMES"),
    "device-driven": ("CLICKS", STAMP, STAMP, "LOAD_MASKS", "LOAD_STATES", "STATE", "STATE"),
    "host-driven": ("CLICKS", STAMP, STAMP, "LOAD_MASKS", "SHOW", "SHOW"),
    "device-driven-counts": COUNTED,
    "device-driven-detectors": COUNTED,
}


class Evidence(NamedTuple):
    """What the host knows of a session: the exposures of the plan, the classes, ticks per second."""

    exposures: int
    n_classes: int
    tick_hz: int

    def excludes(self, message: str, name: str, old: Any, new: Any) -> bool:
        """Whether a host that compares all that it was told must find the change from `old` to `new`, each allowed by itself.

        What is not listed is believed: nobody but the device knows it.
        """
        known: dict[tuple[str, str], bool] = {
            ("STATUS", "next_exposure"): new > self.exposures,
            ("STATUS", "drops"): new > self.exposures,
            ("MARK", "truth"): new >= self.n_classes,
            ("MARK", "object_index"): new != NO_OBJECT,
            ("ACK", "last_id"): new > self.exposures,
            ("BLOCK", "object_index"): new != NO_OBJECT,
            ("BLOCK", "tick"): abs(new - old) > self.tick_hz,
        }
        always = {
            **{STAMP: ("pattern",), "MARK": ("seq", "exposure_index", "half_exposures"), "PONG": ("host_ns",)},
            "BLOCK": ("seq", "drops", "exposure_index", "period_ticks", "count", "word_bytes", "largest"),
        }
        kind = "BLOCK" if message in BLOCKS else message
        return known.get((kind, name), name in always.get(kind, ()))


class MutatedLink:
    """An ordinary link around another one; `changed` counts changed messages, `impossible` names those that the evidence excludes."""

    def __init__(self, link: Any, mutations: tuple[Mutation, ...], evidence: Evidence) -> None:
        self._link, self._mutations, self._evidence = link, mutations, evidence
        self._armed = False
        self.impossible: list[str] = []
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.now_ns, self.close = link.now_ns, link.close
        self._decoders = {"read": FrameDecoder(), "write": FrameDecoder()}
        self._seen: Counter[tuple[int, int]] = Counter()
        self.changed = 0

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        return self._passed("read", self._link.read(timeout_s))

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._link.write(self._passed("write", data))

    def _passed(self, way: str, data: bytes) -> bytes:
        return b"".join(self._mutated(frame) for frame in self._decoders[way].feed(data))

    def _mutated(self, frame: Frame) -> bytes:
        payload = frame.payload
        self._armed |= is_of(frame, "ARM")
        for place, mutation in enumerate(self._mutations):
            if not is_of(frame, mutation.message):
                continue
            number = self._seen[place, 0]
            self._seen[place, 0] += 1
            if mutation.first <= number < mutation.first + mutation.most:
                changed = mutate(payload, mutation)
                self.changed += changed != payload
                if (
                    changed != payload
                    and frame.type >= MessageType.WELCOME
                    and self._excludes(mutation, frame.type, payload, changed)
                ):
                    self.impossible.append(str(mutation))
                payload = changed
        return encode_frame(frame.type, payload, frame.session, frame.flags)

    def _excludes(self, mutation: Mutation, kind: int, old: bytes, new: bytes) -> bool:
        """Whether the changed message of that type makes no sense, or cannot be true."""
        try:
            decoded = _decoded(kind, new)
        except MalformedMessage:
            return True
        if mutation.message == "WELCOME":
            return bool(wrong_facts(decoded.facts))
        if len(self._mutations) > 1:
            return False  # the other one may make it a message that is dropped: of another probe, or of an earlier run
        if mutation.message == "STATUS" and (not self._armed or decoded.state == DeviceState.ARMED):
            return False  # of no run, or of one that has not begun
        values = [field_of(payload, mutation) for payload in (old, new)]
        return self._evidence.excludes(mutation.message, mutation.name, *values)


def _decoded(kind: int, payload: bytes) -> Any:
    name = MessageType(kind).name.lower()
    return decode_counts(payload) if kind == MessageType.COUNTS else getattr(messages, f"decode_{name}")(payload)


def any_mutation(dice: random.Random, mode: str) -> Mutation:
    """Draw a mutation of a session in `mode`."""
    names = [
        *FROM_DEVICE,
        *MODES[mode],
        "MARK",
        "STATUS",
        *TO_DEVICE,
    ]
    message = dice.choice(names)
    first, most = dice.choice((0, 0, 1, 3, 10)), dice.choice((1, 1, 3, 1 << 30))
    if message == "WELCOME" and dice.random() < 0.8:
        key = dice.choice((*FACTS, "extra"))
        value = dice.choice((MISSING, *STRANGE_FACTS, "1000000"))
        return Mutation(
            message, f"map.{key}", *(to(value) if value is not MISSING else (lambda _: MISSING, "is missing")), first=0
        )
    chosen = dice.choice([one for one in LAYOUTS[message] if one.name not in ("reserved",)])
    if chosen.code == "f":
        change, words = to(dice.choice(REALS))
    elif dice.random() < 0.3:
        change, words = by(dice.choice((-1, 1, 100, -100, 10**6, 10**9)))
    else:
        change, words = to(dice.choice(EDGES) if dice.random() < 0.7 else dice.getrandbits(dice.randint(1, 64)))
    return Mutation(message, chosen.name, change, words, first, most)


@dataclass(slots=True)
class Session:
    """What came of one mutated session; `error` is one of the package's own, `wrong` what must not be."""

    mutations: tuple[Mutation, ...]
    summary: Summary | None = None
    error: str = ""
    changed: int = 0
    impossible: list[str] = field(default_factory=list)  # changed messages that the evidence excludes
    wrong: list[str] = field(default_factory=list)


class Stage:
    """What sessions of one mode have in common, made once; `over`: see `pans fuzz`."""

    def __init__(self, mode: str, over: str = "virtual") -> None:
        self.mode, self._over = mode, over
        self.profile, self.bundle, self.plan = small_setup(mode)
        images = np.random.default_rng(2).integers(0, 256, (6, 2, 2)).astype(np.uint8)
        self.scene: Scene = scene_from_arrays("fields", images, np.arange(6) % 3, ("a", "b", "c"))
        self.backend = "table" if self.bundle.automaton is None else "automaton"
        self.decider = make_decider(self.bundle, shots=SHOTS, backend=self.backend)

    def run(self, folder: Path, seed: int, *mutations: Mutation) -> Session:
        """Run one session with `mutations` and judge what can be judged of any."""
        session = Session(mutations)
        began_s = time.process_time()
        path = folder / "fields.pansrec"
        try:
            self._run(path, seed, session)
        except PansError as error:
            session.error = f"{type(error).__name__}: {error.message}"
        except Exception:
            session.wrong.append(traceback.format_exc())
        try:
            if session.summary is not None:
                self._check_recording(path, session)
        except Exception:
            session.wrong.append(traceback.format_exc())
        if (took_s := time.process_time() - began_s) > MAX_SESSION_S:
            session.wrong.append(f"it took {took_s:.1f} s of processor time, allowed {MAX_SESSION_S:g}")
        if session.summary is not None and session.summary.verdict == "PASS":
            session.wrong += [f"PASS though {what}" for what in session.impossible[:3]]
        return session

    def _run(self, path: Path, seed: int, session: Session) -> None:
        clock = DeviceClock(self.profile.clock.tick_hz)
        start_ns = time.perf_counter_ns() if self._over == "tcp" else START_NS
        device = self._device(seed, clock.tick_at(start_ns))
        exposures = OBJECTS * self.plan.cycles_per_object * self.plan.slots_per_cycle
        evidence = Evidence(exposures, len(self.bundle.classes), self.profile.clock.tick_hz)
        with tcp_link(device, clock) if self._over == "tcp" else virtual_link(device, clock) as way:
            self._drive(MutatedLink(way, session.mutations, evidence), path, session)

    def _device(self, seed: int, tick: int) -> SteppedDevice:
        if self._over != "c":
            return Instrument(self.profile, self.scene, seed=seed, power_on_tick=tick)
        options = SimOptions(self.profile.name, seed=seed)
        return SteppedEngine(options, tick, profile=self.profile, scene=SceneFile("fields", self.scene))

    def _drive(self, link: MutatedLink, path: Path, session: Session) -> None:
        # No claim on the processor: many sessions share it, and none is judged by its latencies.
        config = RunOptions(
            shots=SHOTS, n_cycles=OBJECTS * self.plan.cycles_per_object, deadline_us=1e5, realtime=False
        )
        core = Core(self.plan, self.decider, SHOTS, config.n_cycles)
        config_of_run = {"shots": SHOTS, "tick_hz": self.profile.clock.tick_hz, "backend": self.backend}
        header = {"config": {**config_of_run, "drive": self.plan.drive, "confidence": 0.0}}
        with Recorder(path, header, overwrite=True) as recorder:
            try:
                result = run_live(link, self.profile, self.bundle, self.plan, core, config, recorder)
            finally:
                session.changed, session.impossible = link.changed, link.impossible
            shots = OBJECTS * self.plan.shots_per_object
            summary = summarise(result, illumination=1.0, expected_decisions=shots // SHOTS)
            recorder.close(summary.as_json())
        session.summary = summary

    def _check_recording(self, path: Path, session: Session) -> None:
        recording = read_recording(path)
        again = replay(recording, self.bundle)
        if (again.decisions, again.sha256) != (recording.n_decisions, recording.decisions_sha256):
            session.wrong.append(
                f"a replay gives {again.decisions} decisions of {recording.n_decisions}, or other ones"
            )


@contextmanager
def virtual_link(device: SteppedDevice, clock: DeviceClock) -> Iterator[Link]:
    """A link to `device` whose time passes while the host waits."""
    yield VirtualLink(device, clock, "fields")


@contextmanager
def tcp_link(device: SteppedDevice, clock: DeviceClock) -> Iterator[Link]:
    """A socket to `device`, which a thread serves in real time."""
    port, stopped = TcpPort("127.0.0.1", 0), threading.Event()
    thread = threading.Thread(target=serve, args=(device, clock, port, stopped.is_set), daemon=True)
    thread.start()
    try:
        yield open_link(port.url)
    finally:
        stopped.set()
        thread.join(2.0)
        port.close()


def sessions(seed: int, count: int, over: str = "virtual") -> tuple[Counter[str], list[str]]:
    """Run `count` sessions, one mutation each, or two; return how they ended and what was wrong, with the seed of each."""
    # The instrument in C reads one detector, and counts no photons.
    stages = {mode: Stage(mode, over) for mode, named in MODES.items() if over != "c" or named is not COUNTED}
    ended: Counter[str] = Counter()
    wrong: list[str] = []
    with TemporaryDirectory() as folder, frozen_heap():
        for number in range(seed, seed + count):
            dice = random.Random(number)
            mode = dice.choice(tuple(stages))
            mutations = tuple(any_mutation(dice, mode) for _ in range(dice.choice((1, 1, 1, 2))))
            session = stages[mode].run(Path(folder), number, *mutations)
            ended[_ending(session)] += 1
            wrong += [f"seed {number}, {mode}: {'; '.join(map(str, mutations))}: {what}" for what in session.wrong]
    return ended, wrong


def _measured(seed: int, count: int, over: str) -> tuple[Counter[str], list[str], int]:
    """As `sessions`, with the most memory that this process has ever held, in MiB."""
    ended, wrong = sessions(seed, count, over)
    return ended, wrong, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10


def sessions_beside(seed: int, count: int, over: str, jobs: int) -> tuple[Counter[str], list[str], int]:
    """As `sessions`, in `jobs` processes: over a socket most of a session is waiting. Also return the most MiB that one of them held."""
    firsts = range(seed, seed + count, SESSIONS_AT_ONCE)
    counts = [min(SESSIONS_AT_ONCE, seed + count - first) for first in firsts]
    ended: Counter[str] = Counter()
    wrong: list[str] = []
    most_mib = 0
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for some, found, mib in pool.map(_measured, firsts, counts, [over] * len(counts)):
            ended += some
            wrong += found
            most_mib = max(most_mib, mib)
    return ended, wrong, most_mib


def _ending(session: Session) -> str:
    if session.wrong:
        return "wrong"
    if session.error:
        return "refused"
    assert session.summary is not None
    return "unchanged" if not session.changed else session.summary.verdict.lower()


def resident_mib() -> int:
    """Return the resident memory of this process in MiB; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") >> 20
    except (OSError, ValueError):
        return 0
