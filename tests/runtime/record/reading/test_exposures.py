"""Exposures of a recording in arrays: as the messages give them one by one, whatever a link did to them, in memory of fixed size."""

import random
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plans import parallel, shot_major

from pans.decide.plan.plan import Plan
from pans.protocol.session import STREAM_TYPES
from pans.protocol.tracker import StreamTracker
from pans.protocol.wire import DARK_PATTERN
from pans.protocol.wire.framing import FrameDecoder, pack_body, unpack_body
from pans.protocol.wire.messages import ClickBlock, FrameBlock, Mark, encode_clicks, encode_frames, encode_mark
from pans.protocol.wire.schema import HEADER, MAX_GAP_EXPOSURES, RECEIVE_WINDOW
from pans.record.reading import exposures
from pans.record.reading.exposures import iter_exposures
from pans.report.pages.rates import Rates

N = 5  # patterns, or channels


def body_of(encoded: bytes) -> bytes:
    (frame,) = FrameDecoder().feed(encoded)
    return pack_body(frame)


def stream(kind: str, n: int, rng: np.random.Generator, session: int = 7) -> Iterator[bytes]:
    """Yield `n` messages of a device without faults: blocks of one kind, and a mark before each object."""
    exposure = 0
    for seq in range(n):
        number = seq // 6
        if seq % 6 == 0:
            yield body_of(encode_mark(Mark(seq, number, number % 3, exposure, 100 * exposure, 1.5), session))
            continue
        count = int(rng.integers(1, 12))
        head = (seq, 0, 100 * exposure, exposure, 100, number)
        shown = rng.choice(np.array([*range(N), DARK_PATTERN], np.uint16), count)
        if kind == "frames":
            yield body_of(encode_frames(FrameBlock(*head, rng.integers(0, 32, (count, 1), np.uint8)), session))
        elif kind == "counts":
            yield body_of(encode_clicks(ClickBlock(*head, shown, rng.integers(0, 4, count, np.uint8), 3), session))
        else:
            yield body_of(encode_clicks(ClickBlock(*head, shown, rng.integers(0, 2, count, np.uint8)), session))
        exposure += count


def patched(body: bytes, place: int, size: int, value: int) -> bytes:
    at = HEADER.size + place
    return body[:at] + value.to_bytes(size, "little") + body[at + size :]


def spoilt(bodies: list[bytes], dice: random.Random) -> list[bytes]:
    """Repeat, lose, swap and damage some of the messages, as a link and a strange device would."""
    found: list[bytes] = []
    for body in bodies:
        what = dice.randrange(60)
        is_mark = len(body) == HEADER.size + 32
        found.append(body)
        if what == 0:
            found += [dice.choice(found)] * 2  # late or repeated
        elif what == 1:
            found.pop()  # lost
        elif what == 2:
            found[-1] = body + b"\0"  # not as long as it says
        elif what == 3:
            found[-1] = patched(body, 0, 4, int.from_bytes(body[8:12], "little") + RECEIVE_WINDOW)
        elif what == 4 and not is_mark:
            found[-1] = patched(body, 16, 8, 2 * MAX_GAP_EXPOSURES)  # far beyond
        elif what == 5 and not is_mark:
            found[-1] = patched(body, 24, 4, 0)  # no period
        elif what == 6 and is_mark:
            found[-1] = patched(body, 8, 2, 0xFFF0)  # truth -16
        elif what == 7 and is_mark:
            found[-1] = patched(body, 28, 4, 0xBF800000)  # -1.0 photons
        elif what == 8 and not is_mark:
            found[-1] = patched(body, 8, 8, 1 << 63)  # a tick that no counter has
        elif what == 9:
            found.append(HEADER.pack(0x85, 0, 7) + b"no stream message")
        elif what == 10:
            found[-1:] = found[-1:-3:-1]  # overtaken
        elif what == 11 and body[0] == 0x93:
            found[-1] = body[:-1] + b"\x09"  # a number above the largest
    return found


def recording_of(bodies: list[bytes]) -> Any:
    """What `iter_exposures` asks of a recording."""
    return SimpleNamespace(header={}, messages=lambda: ((0, body) for body in bodies))


def one_by_one(bodies: list[bytes], plan: Plan) -> list[tuple[Any, ...]]:
    """Every exposure by itself: stream, begin of its message, object, number, begin, pattern, state, photons."""
    tracker, session, number, rows = StreamTracker(), None, -1, []
    for body in bodies:
        frame = unpack_body(body)
        if frame.type not in STREAM_TYPES:
            continue
        if frame.session != session:
            session, number = frame.session, number + 1
            tracker.restart()
        block, _ = tracker.accept(frame)
        if block is None or isinstance(block, Mark):
            continue
        for i in range(len(block[6])):
            at = block.exposure_index + i
            tick = block.tick + i * block.period_ticks
            if isinstance(block, FrameBlock):
                shown = int(plan.slot_pattern[at % plan.slots_per_cycle])
                photons = [int(block.words[i, 0]) >> channel & 1 for channel in range(N)]
            else:
                shown, photons = int(block.patterns[i]), [int(block.bits[i])]
            rows.append((number, block.tick, block.object_index, at, tick, shown, shown, photons))
    return rows


def in_arrays(recording: Any, plan: Plan) -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = []
    for item in iter_exposures(recording, plan):
        columns = (item.message_tick, item.object, item.number, item.start_tick, item.pattern, item.state, item.photons)
        rows += [(item.stream, *row) for row in zip(*(column.tolist() for column in columns))]
        assert np.array_equal(item.clicks, item.photons > 0)
    return rows


@pytest.mark.parametrize("kind", ["clicks", "frames", "counts"])
def test_exposures_are_those_of_the_messages_one_by_one(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exposures, "EXPOSURES_AT_ONCE", 200)
    plan = parallel(N, 3) if kind == "frames" else replace(shot_major(N, 2), largest=3 if kind == "counts" else 1)
    dice, rng = random.Random(kind), np.random.default_rng(3)
    clean = list(stream(kind, 600, rng))
    again = list(stream(kind, 600, rng, session=9))  # the device was lost and armed again
    bodies = [*spoilt(clean, dice), *spoilt(again, dice)]
    assert in_arrays(recording_of(clean), plan) == one_by_one(clean, plan)
    found = in_arrays(recording_of(bodies), plan)
    assert found == one_by_one(bodies, plan)
    assert {row[0] for row in found} == {0, 1}


def test_memory_for_the_rates_does_not_grow_with_the_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four times the messages: the same memory, not four times as much."""
    monkeypatch.setattr(exposures, "EXPOSURES_AT_ONCE", 4000)
    plan = shot_major(N, 2)
    bodies = list(stream("clicks", 8_000, np.random.default_rng(5)))
    peaks = []
    for n in (2_000, 8_000):
        recording = recording_of(bodies[:n])
        tracemalloc.start()
        rates = Rates(plan, 3)
        for item in iter_exposures(recording, plan):
            rates.take(item)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        shown = rates.over.sums["exposures"].sum()
        assert shown > 4 * n
        assert 0 < rates.class_exposures.sum() == shown
    assert peaks[1] < 1.5 * peaks[0]
