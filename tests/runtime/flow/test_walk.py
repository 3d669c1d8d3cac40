"""Stream messages taken many at once give what they give one by one, whatever is lost, repeated or strange among them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flows import NOTHING, PERIOD_TICKS, SESSION, by_one, frame, make, plan_of, scene, state_of, strange, stream
from hypothesis import given, settings
from hypothesis import strategies as st

from pans.runtime.core.dark_guard import DarkGuard
from pans.runtime.core.decision import Output, joined
from pans.runtime.flow.core import FlowCore
from pans.runtime.instrument.cusum import ChannelWatch
from pans.runtime.link.connection import Connection
from pans.runtime.record import Recorder, read_recording
from pans.runtime.wire import messages as wire
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.frame import Messages, pack_body
from pans.runtime.wire.messages import FrameDecoder, MessageType


def by_many(core: FlowCore, data: bytes, cuts: list[int]) -> Output:
    output, decoder = NOTHING, BulkDecoder()
    for first, stop in zip([0, *cuts], [*cuts, len(data)]):
        spans, place = decoder.take(data[first:stop]), 0
        while place < len(spans):
            end = decoder.stream_stop(spans, place, SESSION)
            messages, at = Messages(decoder.buffer, spans[place:end]), 0
            while at < end - place:
                taken, came = core.step_messages(messages, at)
                assert taken >= 1
                output, at = joined(output, came), at + taken
            place = end + 1
    return joined(output, core.end())


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_many_at_once_are_each_one_by_one(data: st.DataObject) -> None:
    starts = np.cumsum(data.draw(st.lists(st.integers(60, 150), min_size=3, max_size=7))).tolist()
    words = scene(*((first, 40 + first % 30, first % 4) for first in starts), n=1000)
    block, dark = data.draw(st.sampled_from([1, 7, 20, 50])), data.draw(st.booleans())
    dark = dark and block > 1
    tape = {"kind": "tape", "bars_per_s": 20_000.0}
    changes: dict[str, Any] = tape if data.draw(st.booleans()) else {}
    messages = stream(words, block)
    kinds = ["lost", "twice", "another session", "short", "drops", "period"]
    for place in sorted(data.draw(st.sets(st.integers(0, len(messages) - 1), max_size=4)), reverse=True):
        kind = data.draw(st.sampled_from(kinds))
        if kind == "period" and frame(messages[place]).type == MessageType.MARK:  # it has none
            kind = "lost"
        messages[place : place + 1] = strange(kind, messages[place])
    wire_bytes = b"".join(messages)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(wire_bytes) - 1), max_size=12)))
    one, many = make(block, dark, **changes), make(block, dark, **changes)
    wanted, found = by_one(one, wire_bytes), by_many(many, wire_bytes, cuts)
    assert found._replace(block_end_tick=None) == wanted._replace(block_end_tick=None)
    assert state_of(many) == state_of(one)


@pytest.mark.parametrize("kind", ["lost", "twice", "another session", "short", "drops"])
@pytest.mark.parametrize("place", [3, 8])  # a mark, a block
def test_each_oddity_changes_nothing_between_the_two(kind: str, place: int) -> None:
    messages = stream(scene((100, 60, 0), (300, 60, 1)), 20)
    assert (FrameDecoder().feed(messages[place])[0].type == wire.MessageType.MARK) == (place == 3)
    messages[place : place + 1] = strange(kind, messages[place])
    one, many = make(), make()
    wanted, found = by_one(one, b"".join(messages)), by_many(many, b"".join(messages), [400])
    assert found._replace(block_end_tick=None) == wanted._replace(block_end_tick=None)
    assert state_of(many) == state_of(one)


def test_a_block_of_another_period_is_refused_by_both() -> None:
    messages = stream(scene((100, 60, 0)), 20)
    messages[2:3] = strange("period", messages[2])
    one, many = make(), make()
    assert by_many(many, b"".join(messages), []).events == by_one(one, b"".join(messages)).events
    assert many.contradictions == {"beyond_plan": 1}


def test_a_block_that_ends_when_the_plan_does_not_is_seen() -> None:
    messages = stream(scene((100, 60, 0)), 20)
    frame = FrameDecoder().feed(messages[-1])[0]
    late = (1000 + 980 * PERIOD_TICKS + 3).to_bytes(8, "little")
    messages[-1] = wire.encode_frame(frame.type, frame.payload[:8] + late + frame.payload[16:], SESSION)
    core = make()
    by_many(core, b"".join(messages), [])
    assert core.jitter_ticks == 3


@pytest.mark.parametrize("dark", [False, True])
def test_the_guard_is_told_at_the_same_places(dark: bool) -> None:
    """With dark slots it sees every block; without, it is told of empty frames, and its news come at the same exposures."""
    rng = np.random.default_rng(3)
    words = (rng.random((30_000, 10)) < 0.02) @ (1 << np.arange(10))
    found = []
    for way in (by_one, lambda core, data: by_many(core, data, list(range(5000, len(data), 5000)))):
        core = make(50, dark)
        core.guard = DarkGuard(plan_of(50, dark), ChannelWatch(10, np.full(10, 1e-3)))
        found.append(way(core, b"".join(stream(words.astype(np.uint16), 50))).events)
    assert found[0] == found[1]
    assert found[0], "a rate of twenty times the expected one was not seen"


# -- the way there ---------------------------------------------------------------------------------------------------------


class _Reads:
    """A link whose reads are given."""

    name, virtual = "given", True

    def __init__(self, reads: list[bytes]) -> None:
        self._reads = reads

    def read(self, timeout_s: float) -> bytes:
        return self._reads.pop(0) if self._reads else b""

    def write(self, data: bytes) -> None: ...

    def now_ns(self) -> int:
        return 5

    def close(self) -> None: ...


def test_a_connection_keeps_the_order_of_messages_and_answers() -> None:
    messages = stream(scene((100, 60, 0)), 50)
    ack = wire.encode_frame(wire.MessageType.ACK, b"\0" * 3, SESSION)  # malformed: counted, and in nobody's way
    foreign = wire.encode_frame(wire.MessageType.FRAMES, b"x", SESSION + 1)
    data = b"".join([*messages[:4], ack, foreign, *messages[4:]])
    connection = Connection(_Reads([data[:700], data[700:]]))  # type: ignore[arg-type]
    connection.session.nonce = SESSION
    connection.decoder.use_kernels()
    bodies = []
    for _ in range(2):
        for arrived in connection.pump(0.0):
            assert isinstance(arrived.what, Messages)
            bodies += [pack_body(arrived.what.frame(place)) for place in range(len(arrived.what.spans))]
    assert bodies == [pack_body(FrameDecoder().feed(message)[0]) for message in messages]
    assert (connection.session.counters.malformed, connection.session.counters.wrong_session) == (1, 1)


def test_messages_that_are_kept_outlive_the_next_bytes() -> None:
    decoder = BulkDecoder()
    messages = stream(scene((100, 60, 0)), 50)
    kept = Messages(decoder.buffer, decoder.take(b"".join(messages[:5]))).kept()
    decoder.take(b"".join(messages[5:]))
    assert [pack_body(kept.frame(place)) for place in range(5)] == [
        pack_body(FrameDecoder().feed(message)[0]) for message in messages[:5]
    ]


def test_a_long_read_is_taken_in_pieces() -> None:
    data = b"".join(stream(np.zeros(200_000, np.uint16), 50, 0))
    pieces = BulkDecoder.pieces(data)
    assert len(pieces) > 1
    assert b"".join(pieces) == data
    decoder = BulkDecoder()
    assert sum(len(decoder.take(piece)) for piece in pieces) == 4000


def test_recorded_many_at_once_is_recorded_one_by_one(tmp_path: Path) -> None:
    decoder = BulkDecoder()
    spans = decoder.take(b"".join(stream(np.arange(60_000).astype(np.uint16), 600)))
    messages = Messages(decoder.buffer, spans)
    with Recorder(tmp_path / "many", {}) as many, Recorder(tmp_path / "one", {}) as one:
        for host_ns in (7, 1 << 40):
            many.add_messages(host_ns, messages, 0, 3)
            many.add_messages(host_ns, messages, 3, len(spans) - 3)
            for place in range(len(spans)):
                one.add_message(host_ns, pack_body(messages.frame(place)))
        for recorder in (many, one):
            recorder.close({})
    found, wanted = (list(read_recording(tmp_path / name).messages()) for name in ("many", "one"))
    assert found == wanted
    assert len(found) == 2 * len(spans)
