"""Whole sessions in which a device, or the host, says something else in one field, under a right checksum.

`Mutation` names a field of the message dictionary and its change, `MutatedLink` carries it out, `Stage.run` runs an ordinary session
with it and judges what must hold of any: no errors but the package's own, bounded time, a recording that replays to the same
decisions, and no PASS where the evidence contradicts what was said.
"""

import struct
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import numpy as np

from pans.base.errors import PansError
from pans.bundle.backends.choose import make_decider
from pans.decide.still.core import Core
from pans.live.loop import Job, run_live
from pans.live.options import RunOptions
from pans.protocol.links import Link
from pans.protocol.wire import messages as wire
from pans.protocol.wire.framing import Frame, FrameDecoder, encode_frame
from pans.protocol.wire.schema import ALL_MESSAGES, AUTOMATON_MESSAGES, Field, wrong_facts
from pans.record.reading import read_recording
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans.report.summary.summary import Summary, summarise
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.virtual import START_NS, VirtualLink
from pans_sim.scene.still import Scene, scene_from_arrays
from pans_sim.testing import small_setup

COMMANDS = ("LOAD_PATTERN", "LOAD_PLAN", "ARM", "GATE", "READ_COUNTS", "LOAD_COUNT_STATES")
BODIES = {  # of commands: which of them holds the layout, and where in the payload it begins; of rows, the first
    **{name: (name, wire.STRUCTS["COMMAND"].size) for name in (*COMMANDS, *AUTOMATON_MESSAGES)},
    "PLAN_SLOT": ("LOAD_PLAN", wire.STRUCTS["COMMAND"].size + wire.STRUCTS["LOAD_PLAN"].size),
    "STATE": ("LOAD_STATES", wire.STRUCTS["COMMAND"].size + wire.STRUCTS["LOAD_STATES"].size),
    "COUNT_STATE": ("LOAD_COUNT_STATES", wire.STRUCTS["COMMAND"].size + wire.STRUCTS["LOAD_COUNT_STATES"].size),
}
STAMP = "STAMP"  # not a message: the first pattern or state that is stamped in a block of clicks or of photon numbers
LAYOUTS = {**ALL_MESSAGES, STAMP: (Field("pattern", "H"),)}


KEEP, MISSING = object(), object()


class Mutation(NamedTuple):
    """In `message`s, from number `first` on and at most `most` of them, the field `name` becomes `to`, or moves by `by`.

    `name` may be a key of WELCOME's map behind "map."; MISSING takes it away.
    """

    message: str
    name: str
    to: Any = KEEP
    by: int = 0
    first: int = 0
    most: int = 1 << 30

    def changed(self, value: Any) -> Any:
        """Return what becomes of `value`."""
        return value + self.by if self.to is KEEP else self.to


def is_of(frame: Frame, message: str) -> bool:
    """Whether a frame is of the kind whose fields stand under `message` in LAYOUTS."""
    if message in BODIES:
        return frame.type == wire.MessageType.COMMAND and frame.payload[4] == wire.Opcode[BODIES[message][0]]
    return frame.type in (
        (wire.MessageType.CLICKS, wire.MessageType.COUNTS) if message == STAMP else (wire.MessageType[message],)
    )


def _layout(mutation: Mutation) -> tuple[struct.Struct, int, int]:
    """The layout of the fields that `mutation` changes, where it begins in the payload, and the place of the field in it."""
    place = [one.name for one in LAYOUTS[mutation.message]].index(mutation.name)
    if mutation.message == STAMP:
        return struct.Struct("<H"), wire.BLOCK_HEADER_BYTES, place
    return wire.STRUCTS[mutation.message], BODIES.get(mutation.message, ("", 0))[1], place


def field_of(payload: bytes, mutation: Mutation) -> Any:
    """Return what stands in the field that `mutation` changes."""
    layout, start, place = _layout(mutation)
    return layout.unpack_from(payload, start)[place]


def mutate(payload: bytes, mutation: Mutation) -> bytes:
    """Return `payload` with one field changed; whatever does not fit the field's bits is cut to them."""
    if mutation.name.startswith("map."):
        head, facts = payload[: wire.STRUCTS["WELCOME"].size], msgpack.unpackb(payload[wire.STRUCTS["WELCOME"].size :])
        key = mutation.name[4:]
        value = mutation.changed(facts.get(key))
        if value is MISSING:
            facts.pop(key, None)
        else:
            facts[key] = value
        return head + msgpack.packb(facts)
    layout, start, place = _layout(mutation)
    values = list(layout.unpack_from(payload, start))
    values[place] = fitted(LAYOUTS[mutation.message][place], mutation.changed(values[place]))
    return payload[:start] + layout.pack(*values) + payload[start + layout.size :]


def fitted(field: Field, value: Any) -> Any:
    """Return `value` as the field's bits hold it."""
    if field.code == "f":
        return struct.unpack("<f", struct.pack("<f", value))[0]
    size = struct.calcsize(field.code)
    return int.from_bytes((int(value) % (1 << 8 * size)).to_bytes(size, "little"), "little", signed=field.code == "h")


OBJECTS = 12
MAX_SESSION_S = 30.0  # of processor time; one takes some 50 ms
BLOCKS = ("CLICKS", "FRAMES", "COUNTS")


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
            ("MARK", "object_index"): new != wire.NO_OBJECT,
            ("ACK", "last_id"): new > self.exposures,
            ("BLOCK", "object_index"): new != wire.NO_OBJECT,
            ("BLOCK", "tick"): abs(new - old) > self.tick_hz,
        }
        always = {
            **{STAMP: ("pattern",), "MARK": ("seq", "exposure_index", "half_exposures"), "PONG": ("host_ns",)},
            "BLOCK": ("seq", "drops", "exposure_index", "period_ticks", "count", "word_bytes", "largest"),
        }
        kind = "BLOCK" if message in BLOCKS else message
        return known.get((kind, name), name in always.get(kind, ()))


class MutatedLink(Link):
    """An ordinary link around another one; `changed` counts changed messages, `impossible` has those that the evidence excludes."""

    def __init__(self, link: Any, mutations: tuple[Mutation, ...], evidence: Evidence) -> None:
        self._link, self._mutations, self._evidence = link, mutations, evidence
        self._armed = False
        self.impossible: list[Mutation] = []
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
                sent_back = changed != payload and frame.type >= wire.MessageType.WELCOME
                if sent_back and self._excludes(mutation, frame.type, payload, changed):
                    self.impossible.append(mutation)
                payload = changed
        return encode_frame(frame.type, payload, frame.session, frame.flags)

    def _excludes(self, mutation: Mutation, kind: int, old: bytes, new: bytes) -> bool:
        """Whether the changed message of that type makes no sense, or cannot be true."""
        try:
            decoded = wire.DECODERS[kind](new)
        except wire.MalformedMessage:
            return True
        if mutation.message == "WELCOME":
            return bool(wrong_facts(decoded.facts))
        if len(self._mutations) > 1:
            return False  # the other one may make it a message that is dropped: of another probe, or of an earlier run
        if mutation.message == "STATUS" and (not self._armed or decoded.state == wire.DeviceState.ARMED):
            return False  # of no run, or of one that has not begun
        values = [field_of(payload, mutation) for payload in (old, new)]
        return self._evidence.excludes(mutation.message, mutation.name, *values)


@dataclass(slots=True)
class Session:
    """What came of one mutated session; `error` is one of the package's own, `wrong` what must not be."""

    summary: Summary | None = None
    error: str = ""
    changed: int = 0
    wrong: list[str] = field(default_factory=list)


class Stage:
    """What sessions of one mode have in common, made once."""

    def __init__(self, mode: str) -> None:
        self.profile, self.bundle, self.plan = small_setup(mode)
        images = np.random.default_rng(2).integers(0, 256, (6, 2, 2)).astype(np.uint8)
        self.scene: Scene = scene_from_arrays("fields", images, np.arange(6) % 3, ("a", "b", "c"))
        self.backend = "table" if self.bundle.automaton is None else "automaton"
        self.decider = make_decider(self.bundle, shots=1, backend=self.backend)

    def run(self, folder: Path, seed: int, *mutations: Mutation) -> Session:
        """Run one session with `mutations` and judge what can be judged of any."""
        exposures = OBJECTS * self.plan.cycles_per_object * self.plan.slots_per_cycle
        evidence = Evidence(exposures, len(self.bundle.classes), self.profile.clock.tick_hz)
        link = MutatedLink(self.link(Instrument, seed), mutations, evidence)
        session = self.session(link, folder)
        session.changed = link.changed
        if session.summary is not None and session.summary.verdict == "PASS":
            session.wrong += [f"PASS in spite of {mutation}" for mutation in link.impossible[:3]]
        return session

    def link(self, kind: Any, seed: int) -> VirtualLink:
        """Return the link to a device that `kind` makes as `Instrument` is made."""
        clock = DeviceClock(self.profile.clock.tick_hz)
        device = kind(self.profile, self.scene, seed=seed, power_on_tick=clock.tick_at(START_NS))
        return VirtualLink(device, clock, "fields")

    def session(self, link: Any, folder: Path, objects: int = OBJECTS) -> Session:
        """Run one session of `objects` decisions behind `link` and judge what must hold of any."""
        session, began_s, path = Session(), time.process_time(), folder / "fields.pansrec"
        try:
            session.summary = self._run(link, path, objects)
        except PansError as error:
            session.error = f"{type(error).__name__}: {error.message}"
        except Exception:
            session.wrong.append(traceback.format_exc())
        if session.summary is not None:
            recording = read_recording(path)
            again = replay(recording, self.bundle)
            if (again.decisions, again.sha256) != (recording.n_decisions, recording.decisions_sha256):
                session.wrong.append(f"a replay gives {again}, recorded are {recording.n_decisions} decisions")
        if (took_s := time.process_time() - began_s) > MAX_SESSION_S:
            session.wrong.append(f"it took {took_s:.1f} s of processor time, allowed {MAX_SESSION_S:g}")
        return session

    def _run(self, link: Any, path: Path, objects: int) -> Summary:
        # No claim on the processor: many sessions share it, and none is judged by its latencies.
        config = RunOptions(n_cycles=objects * self.plan.cycles_per_object, deadline_us=1e5, realtime=False)
        core = Core(self.plan, self.decider, 1, config.n_cycles)
        facts = {"shots": 1, "tick_hz": self.profile.clock.tick_hz, "backend": self.backend}
        header = {"config": {**facts, "drive": self.plan.drive, "confidence": 0.0}}
        with Recorder(path, header, overwrite=True) as recorder:
            result = run_live(link, Job(self.profile, self.bundle, self.plan, config), core, recorder)
            decisions = objects * self.plan.shots_per_object
            summary = summarise(result, illumination=1.0, expected_decisions=decisions)
            recorder.close(summary.as_json())
        return summary
