"""A replay in bulk gives what the core gives that takes each message by itself: of every kind of recording, whole or cut off."""

import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from bundles import made_bundle
from single_messages import replay_one_by_one
from small_files import blocks_of, record_automaton, record_flow, record_run, sealed
from small_runs import record_small
from thirds import write_thirds

from pans.base import SHIPPED
from pans.bundle.sensor.bundle import write_bundle
from pans.protocol.wire import HEADER, MessageType
from pans.record.reading import open_recording
from pans.record.reading.format import MESSAGE, Kind
from pans.record.recorder import PartLimits
from pans.record.replay import ClickLog, replay

FAULTS = "&faults=loss:0.02,duplicate:0.02,flip:0.01"
TAPE = 'kind = "tape"\nbars_per_s = 20000.0\n'
DARK_FRAMES = 'kind = "cells"\nfields_per_s = 20000.0\nonset_frames = 4\ndark_every = 2\n'


def small(path: Path, faults: str = "", parts: bool = False) -> Path:
    record_small(path / "run.pansrec", faults=faults, limits=PartLimits(rotate_bytes=40_000) if parts else None)
    return path if parts else path / "run.pansrec"


def head(path: Path) -> Path:
    return record_run(path, SHIPPED / "fashion10.pans", "oled-qcmos", FAULTS, decisions=60, backend="onnx")


def parallel(path: Path) -> Path:
    write_thirds(path)
    return record_run(path, path / "thirds.pans", "flow-snspd", FAULTS, decisions=2000)


def walk(path: Path, drive: str, profile: str = "dmd-spad", **outcomes: int) -> Path:
    automaton = random_automaton(4, slots=7, width=6, patterns=4, **outcomes)
    write_bundle(automaton_bundle(automaton, levels=2, photons_per_level=0.29), path / "walk.pans")
    more = "&faults=loss:0.01,disconnect:100ms/700ms"
    return record_run(path, path / "walk.pans", profile, more, decisions=100, drive=drive, confidence=0.6)


def numbers(path: Path) -> Path:
    levels = np.eye(3, 16, dtype=np.int64)
    table = np.random.default_rng(2).normal(size=(64, 2))
    write_bundle(
        made_bundle(3, 2, table=table, outcomes=4, pattern_levels=levels, image_shape=(4, 4), photons_per_level=0.25),
        path / "table.pans",
    )
    return record_run(path, path / "table.pans", "dmd-qcmos", FAULTS, decisions=60)


def darker(path: Path, policy: str) -> Path:
    more = "&changes=dark:at_s=2:factor=500"
    return record_run(path, SHIPPED / "fashion10.pans", "oled-qcmos", more, decisions=150, on_dark=policy, dark_slots=5)


def flow(path: Path, text: str = "", **options: object) -> Path:
    if text:
        (path / "other.toml").write_text(text)
        options["flow"] = path / "other.toml"
    return record_flow(path, FAULTS, seconds=0.06, **options)


KINDS: dict[str, Callable[[Path], Path]] = {
    "fixed": small,
    "fixed, faults": lambda path: small(path, "loss:0.01,duplicate:0.01,flip:0.01,stall:300ms/700ms"),
    "parts": lambda path: small(path, parts=True),
    "parallel": parallel,
    "head": head,
    "numbers": numbers,
    "automaton": record_automaton,
    "walk by the device": lambda path: walk(path, "device"),
    "walk by the host": lambda path: walk(path, "host"),
    "walk by numbers": lambda path: walk(path, "device", "dmd-qcmos", outcomes=4),
    "dark, warn": lambda path: darker(path, "warn"),
    "dark, abstain": lambda path: darker(path, "abstain"),
    "flow": flow,
    "flow, gates": lambda path: flow(path, gate_class=("b",), pool=2),
    "flow, abstain": lambda path: flow(path, DARK_FRAMES, on_dark="abstain"),
    "tape": lambda path: flow(path, TAPE),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_replay_is_that_of_single_messages(kind: str, tmp_path: Path) -> None:
    recording = open_recording(KINDS[kind](tmp_path))
    bundle, logs = recording.bundle(), (ClickLog(), ClickLog())
    found, wanted = replay(recording, bundle), replay_one_by_one(recording, bundle)
    assert found == wanted
    assert found.as_recorded
    assert found.decisions > 2
    if "flow" not in recording.header["config"]:
        assert replay(recording, bundle, logs[0]) == replay_one_by_one(recording, bundle, logs[1]) == found
        assert logs[0].decisions == logs[1].decisions
        assert np.array(logs[0].counts).tolist() == np.array(logs[1].counts).tolist()


@pytest.mark.parametrize("make", [small, flow])
def test_a_cut_recording_is_replayed_in_bulk_as_by_single_messages(
    make: Callable[[Path], Path], tmp_path: Path
) -> None:
    path = make(tmp_path)
    whole, recording = path.read_bytes(), open_recording(path)
    ends = [block.end for block in recording.iter_blocks()]
    for size in random.Random(1).sample(range(ends[2], len(whole)), 6):
        path.write_bytes(whole[:size])
        part = open_recording(path)
        assert replay(part, part.bundle()) == replay_one_by_one(part, part.bundle())


def spoilt(bodies: list[bytes], rng: random.Random) -> list[bytes]:
    """Lost, repeated and swapped messages, and others that say something else than the device did, STATUS and EXPOSED above all."""
    changed = list(bodies)
    told = [at for at, body in enumerate(bodies) if body[0] in (MessageType.STATUS, MessageType.EXPOSED)]
    for at in sorted({*rng.sample(range(len(bodies)), 12), *rng.sample(told, min(6, len(told)))}, reverse=True):
        body, fate = changed[at], rng.choice(("lost", "twice", "later", "earlier", "flipped", "flipped"))
        if fate == "lost":
            del changed[at]
        elif fate == "twice":
            changed.insert(at + rng.randrange(1, 30), body)
        elif fate in ("later", "earlier"):
            changed.insert(max(0, at + rng.randrange(1, 30) * (1 if fate == "later" else -1)), changed.pop(at))
        elif len(body) > HEADER.size:
            place = rng.randrange(HEADER.size, min(len(body), HEADER.size + 40))
            changed[at] = body[:place] + bytes([body[place] ^ 1 << rng.randrange(8)]) + body[place + 1 :]
    return changed


@pytest.mark.parametrize(
    "kind", ["fixed", "parallel", "numbers", "walk by the device", "dark, warn", "flow", "flow, abstain", "tape"]
)
def test_messages_that_contradict_each_other_are_found_in_bulk_too(kind: str, tmp_path: Path) -> None:
    path = KINDS[kind](tmp_path)
    recording, blocks = open_recording(path), blocks_of(path.read_bytes())
    bodies, bundle = [body for _, body in recording.messages()], recording.bundle()
    first = next(at for at, (block, _) in enumerate(blocks) if block == Kind.MESSAGES)
    others = [[one for one in some if one[0] != Kind.MESSAGES] for some in (blocks[:first], blocks[first:])]
    found = Counter[str]()
    for seed in range(4):
        some = spoilt(bodies, random.Random(seed))
        pieces = [
            b"".join(MESSAGE.pack(0, len(body)) + body for body in some[at : at + 50]) for at in range(0, len(some), 50)
        ]
        path.write_bytes(sealed([*others[0], *((Kind.MESSAGES, piece) for piece in pieces), *others[1]]))
        changed = open_recording(path)
        again = replay(changed, bundle)
        assert again == replay_one_by_one(changed, bundle), seed
        found.update(again.contradictions)
    assert len(found) > 2


def test_messages_are_gathered_from_many_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = open_recording(small(tmp_path, "loss:0.01"))
    bodies = [body for _, body in recording.messages()]
    for gathered, at_once in ((1, 1 << 14), (1000, 7), (1 << 18, 64), (1 << 18, len(bodies))):
        monkeypatch.setattr("pans.record.reading.recording.GATHERED_BYTES", gathered)
        monkeypatch.setattr("pans.record.reading.recording.MESSAGES_AT_ONCE", at_once)
        found = [
            some.buffer[first:stop].tobytes()
            for some in recording.iter_messages()
            for first, stop in some.spans.tolist()
        ]
        assert found == bodies
