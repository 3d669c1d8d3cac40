"""Recordings: every byte is covered, a cut file reads up to its last whole block, and what went in comes out."""

import errno
import itertools
import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle
from bundles import made_bundle
from small_runs import Disk, fails, log_sha256

from pans.base.errors import DamagedFileError, PansError, RecordingError, UsageError
from pans.decide.decision import DECISION_DTYPE, DecisionFlag
from pans.protocol.clock import CLOCK_DTYPE
from pans.record.reading import Recording, read_recording
from pans.record.reading.format import TIMING_RUN_DTYPE, Kind
from pans.record.reading.sent_plan import automaton_of
from pans.record.recorder import Recorder

HEADER = {"created_utc": "2025-01-01T00:00:00+00:00", "simulated": True, "seed": 7}


def decisions(count: int, first: int = 0) -> np.ndarray:
    """Rows of decisions, from number `first` on."""
    made = [(i, 1000 * i, 9 * i + 8, i, 0, 4, i % 3, -1, 0, 0.5, 12345, 0) for i in range(first, first + count)]
    return np.array(made, DECISION_DTYPE)


def write_recording(path: Path, count: int = 5, bundle: bytes = b"") -> str:
    with Recorder(path, HEADER, bundle=bundle) as recorder:
        recorder.add_command(10, b"arm")
        for index in range(count):
            recorder.add_message(100 + index, bytes([index % 256]) * (index % 7))
        recorder.add_decisions(decisions(count))
        recorder.add_timing_runs(np.array([(index, 1, 2, 3, 4, 1) for index in range(count)], TIMING_RUN_DTYPE))
        recorder.add_clock(np.array([(5, 6, 7), (8, 9, 10)], dtype=CLOCK_DTYPE))
        recorder.add_event({"kind": "gap", "lost": 3})
        recorder.add_event({"kind": "late", "text": "a line\nof two"})
        return recorder.close({"accuracy": 0.75})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A recording of five decisions."""
    write_recording(tmp_path / "a.pansrec")
    return tmp_path / "a.pansrec"


def facts(recording: Recording) -> tuple[int, bool]:
    return recording.n_decisions, recording.complete


def test_everything_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    digest = write_recording(path)
    found = read_recording(path)
    assert (*facts(found), found.damage, found.summary) == (5, True, "", {"accuracy": 0.75})
    assert (found.header["seed"], found.header["format_version"]) == (7, 1)
    assert found.end_offset == found.size == path.stat().st_size
    assert list(found.messages()) == [(100 + i, bytes([i]) * i) for i in range(5)]
    assert list(found.commands()) == [(10, b"arm")]
    np.testing.assert_array_equal(found.decisions(), decisions(5))
    assert digest == found.decisions_sha256 == log_sha256(decisions(5))
    assert found.timings().tolist() == [(index, 1, 2, 3, 4) for index in range(5)]
    assert np.concatenate(list(found.iter_clock_samples())).tolist() == [(5, 6, 7), (8, 9, 10)]
    assert list(found.events()) == [{"kind": "gap", "lost": 3}, {"kind": "late", "text": "a line\nof two"}]
    assert found.bundle_data() == b""
    with pytest.raises(UsageError, match="no bundle"):
        found.bundle()


def test_times_that_decisions_share_stand_once(tmp_path: Path) -> None:
    """Between single ones, in the order of time."""
    runs = [(0, 9, 19, 29, 39, 1), (1, 10, 20, 30, 40, 3), (4, 11, 21, 31, 41, 1), (5, 12, 22, 32, 42, 9000)]
    with Recorder(tmp_path / "runs", {}) as recorder:
        recorder.add_timing_runs(np.array(runs, TIMING_RUN_DTYPE))
        recorder.close({})
    found = read_recording(tmp_path / "runs")
    assert found.timings().tolist() == [(first + k, *times) for first, *times, count in runs for k in range(count)]
    assert found.size < 2000


@pytest.mark.parametrize("counts", [[0], [1 << 20, 1], [0xFFFFFFFF] * 3])
def test_runs_that_ask_for_much_memory_are_refused(tmp_path: Path, counts: list[int]) -> None:
    runs = np.zeros(len(counts), TIMING_RUN_DTYPE)
    runs["count"] = counts
    with Recorder(tmp_path / "a", {}) as recorder:
        recorder.add_timing_runs(runs)
        recorder.close({})
    with pytest.raises(DamagedFileError, match="allowed: 1 or more in each, 1048576 at most"):
        read_recording(tmp_path / "a").timings()


def test_times_and_flags_are_those_of_the_document() -> None:
    assert TIMING_RUN_DTYPE.names[1:5] == ("device_end_ns", "arrival_ns", "decided_ns", "recorded_ns")
    assert [int(flag) for flag in DecisionFlag] == [1, 2, 4, 8, 16, 32, 64, 128, 256]


def test_any_flipped_byte_is_detected(tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    write_recording(path, 2)
    data = path.read_bytes()
    for position in range(len(data)):
        changed = bytearray(data)
        changed[position] ^= (0x01, 0xFF)[position % 2]
        path.write_bytes(changed)
        with pytest.raises(DamagedFileError):
            read_recording(path)


def test_a_cut_file_reads_up_to_the_last_whole_block(path: Path) -> None:
    data = path.read_bytes()
    whole = read_recording(path)
    ends = [block.end for block in whole.iter_blocks()]
    decided = next(block.end for block in whole.iter_blocks(Kind.DECISIONS))
    for length in range(len(data)):
        path.write_bytes(data[:length])
        if length < ends[0]:
            with pytest.raises(DamagedFileError, match="cut after"):
                read_recording(path)
            continue
        found = read_recording(path)
        assert not found.complete
        assert found.summary == {}
        assert found.end_offset == max(end for end in ends if end <= length)
        assert found.n_decisions == (5 if length >= decided else 0)
        assert len(list(found.iter_blocks())) == sum(end <= length for end in ends)
        assert len(found.decisions()) == found.n_decisions


def test_zeros_left_by_a_power_cut_are_a_cut(path: Path) -> None:
    ends = [block.end for block in read_recording(path).iter_blocks()]
    path.write_bytes(path.read_bytes()[: ends[2]] + bytes(5000))
    found = read_recording(path)
    assert not found.complete
    assert (found.end_offset, found.size) == (ends[2], ends[2] + 5000)


def test_moved_removed_and_doubled_blocks_are_detected(path: Path) -> None:
    data = path.read_bytes()
    ends = [16, *(block.end for block in read_recording(path).iter_blocks())]
    pieces = [data[a:b] for a, b in itertools.pairwise(ends)]
    for i in range(len(pieces) - 1):
        swapped = [*pieces[:i], pieces[i + 1], pieces[i], *pieces[i + 2 :]]
        for order in (swapped, pieces[:i] + pieces[i + 1 :], [*pieces[: i + 1], *pieces[i:]]):
            path.write_bytes(data[:16] + b"".join(order))
            with pytest.raises(DamagedFileError):
                read_recording(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(DamagedFileError, match="behind the END"):
        read_recording(path)


def test_salvage_reads_what_stands_before_the_damage(path: Path) -> None:
    ends = [block.end for block in read_recording(path).iter_blocks()]
    data = bytearray(path.read_bytes())
    data[ends[-2] - 1] ^= 4
    path.write_bytes(data)
    with pytest.raises(
        DamagedFileError, match=f"block {len(ends) - 2} at byte {ends[-3]}: altered.*{len(ends) - 2} whole"
    ):
        read_recording(path)
    found = read_recording(path, salvage=True)
    assert "altered" in found.damage
    assert not found.complete
    assert found.end_offset == ends[-3]
    assert len(found.decisions()) == found.n_decisions == 5


def forged(path: Path, blocks: list[tuple[int, bytes]]) -> Path:
    """A file whose checksums all fit, whatever its blocks say."""
    start = b"PANSRECD" + struct.pack("<I", 1)
    chain = zlib.crc32(start)
    out = start + struct.pack("<I", chain)
    for index, (kind, payload) in enumerate(blocks):
        head = struct.pack("<IIBxxx", len(payload), index, kind)
        first = zlib.crc32(head, chain)
        chain = zlib.crc32(payload, first)
        out += head + struct.pack("<I", first) + payload + struct.pack("<I", chain)
    path.write_bytes(out)
    return path


@pytest.mark.parametrize(
    ("blocks", "reason"),
    [
        ([(3, b"")], "MESSAGES does not belong"),
        ([(1, b"{}"), (1, b"{}")], "HEADER does not belong"),
        ([(1, b"[]")], "JSON object"),
        ([(1, b'{"a": NaN}')], "JSON"),
        ([(1, b"{}"), (77, b"")], "kind 77"),
        ([(1, b"{}"), (2, b"abc")], "header says None"),
        ([(1, b"{}"), (6, b"abc")], "3 bytes"),
        ([(1, b"{}"), (9, b"{}")], "blocks = None, found 1"),
        ([(1, b"{}"), (9, json.dumps({"blocks": 1, "decisions": 9}).encode())], "decisions = 9, found 0"),
        ([(1, b"{}"), (3, bytes((2 << 20) + 1))], "allowed at most 2097152"),
    ],
)
def test_a_forged_file_is_refused_with_the_reason(blocks: list[tuple[int, bytes]], reason: str, tmp_path: Path) -> None:
    with pytest.raises(DamagedFileError, match=reason):
        read_recording(forged(tmp_path / "f.pansrec", blocks))


@pytest.mark.parametrize(
    "payload", [b"short", struct.pack("<qI", 0, 50) + b"x" * 49, struct.pack("<qI", 0, 0xFFFFFFFF)]
)
def test_messages_cannot_reach_past_their_block(payload: bytes, tmp_path: Path) -> None:
    found = read_recording(forged(tmp_path / "f.pansrec", [(1, b"{}"), (3, payload)]))
    with pytest.raises(DamagedFileError, match="past its block"):
        list(found.messages())


def test_a_length_beyond_the_file_allocates_nothing(tmp_path: Path) -> None:
    start = b"PANSRECD" + struct.pack("<I", 1)
    head = struct.pack("<IIBxxx", 0xFFFFFFFF, 0, 1)
    crc = zlib.crc32(start)
    path = tmp_path / "f.pansrec"
    path.write_bytes(start + struct.pack("<I", crc) + head + struct.pack("<I", zlib.crc32(head, crc)))
    with pytest.raises(DamagedFileError, match="4294967295 bytes of kind 1, allowed at most 4194304"):
        read_recording(path)


def test_an_existing_file_is_not_overwritten_unasked(tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    write_recording(path)
    before = path.read_bytes()
    with pytest.raises(UsageError, match="exists already"):
        Recorder(path, HEADER)
    assert path.read_bytes() == before
    with Recorder(path, HEADER, overwrite=True) as recorder:
        recorder.close({})
    assert facts(read_recording(path)) == (0, True)
    with pytest.raises(UsageError, match="cannot be written"):
        Recorder(tmp_path / "no" / "folder.pansrec", HEADER)
    with pytest.raises(UsageError, match="cannot be read"):
        read_recording(tmp_path / "none.pansrec")


def test_an_exception_leaves_an_incomplete_recording_with_all_that_was_added(tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    recorder = Recorder(path, HEADER)
    with pytest.raises(RuntimeError, match="the run broke"), recorder:
        recorder.add_decisions(decisions(1))
        raise RuntimeError("the run broke")
    assert facts(read_recording(path)) == (1, False)
    with pytest.raises(UsageError, match="closed"):
        recorder.add_clock(np.zeros(1, CLOCK_DTYPE))


def test_what_is_flushed_is_readable_while_recording_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    with Recorder(path, HEADER) as recorder:
        recorder.add_decisions(decisions(1))
        assert facts(read_recording(path)) == (0, False)
        recorder.flush()
        assert facts(read_recording(path)) == (1, False)
        recorder.add_decisions(decisions(1, 1))
        recorder.sync()
        assert facts(read_recording(path)) == (2, False)


def test_beginning_syncs_and_end_survive_a_power_cut(tmp_path: Path, synced: dict[int, Any]) -> None:
    path = tmp_path / "a.pansrec"

    def survives() -> bool:
        return bool(synced[path.stat().st_ino] == path.stat().st_size)

    with Recorder(path, HEADER) as recorder:
        assert survives()
        assert synced[tmp_path.stat().st_ino] == {"a.pansrec"}
        recorder.add_decisions(decisions(1))
        recorder.flush()
        assert not survives()
        recorder.sync()
        assert survives()
        recorder.close({})
    assert survives()


def test_decisions_are_in_the_file_before_what_acts_upon_them(tmp_path: Path) -> None:
    """`flush_decisions`, with the messages that they are made of; the rest may wait."""
    path = tmp_path / "a.pansrec"
    with Recorder(path, HEADER) as recorder:
        recorder.add_message(1, b"hi")
        recorder.add_decisions(decisions(1))
        recorder.add_timing_runs(np.ones(1, TIMING_RUN_DTYPE))
        recorder.flush_decisions()
        found = read_recording(path)
        assert facts(found) == (1, False)
        assert list(found.messages()) == [(1, b"hi")]
        assert len(found.timings()) == 0


def test_a_block_of_times_stays_below_what_a_reader_allows(tmp_path: Path) -> None:
    runs = np.zeros(40, TIMING_RUN_DTYPE)
    runs["count"] = 1 << 16
    with Recorder(tmp_path / "a", {}) as recorder:
        for run in range(len(runs)):
            recorder.add_timing_runs(runs[run : run + 1])
        recorder.close({})
    assert len(read_recording(tmp_path / "a").timings()) == 40 << 16


def test_buffers_are_written_when_full_and_lose_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    rng = np.random.default_rng(4)
    sizes = [*rng.integers(0, 3000, size=400).tolist(), 1 << 20, 262_144 - 12, 262_145, 0]
    messages = [(i, bytes([i % 251]) * size) for i, size in enumerate(sizes)]
    with Recorder(path, HEADER) as recorder:
        for host_ns, data in messages:
            recorder.add_message(host_ns, memoryview(data))
        for index in range(10_000):
            recorder.add_event({"kind": "x", "index": index})
            if index % 50 == 49:
                recorder.add_decisions(decisions(50, index - 49))
        assert recorder.close({}) == log_sha256(decisions(10_000))
    found = read_recording(path)
    assert list(found.messages()) == messages
    assert found.kinds[Kind.DECISIONS] == 5
    assert found.decisions()["index"].tolist() == list(range(10_000))
    assert [event["index"] for event in found.events()] == list(range(10_000))
    assert max(len(block.payload) for block in found.iter_blocks()) <= (1 << 20) + 12
    with Recorder(tmp_path / "b.pansrec", HEADER) as recorder:
        with pytest.raises(UsageError, match="message of 1048577"):
            recorder.add_message(0, bytes((1 << 20) + 1))
        with pytest.raises(UsageError, match="an event of"):
            recorder.add_event({"text": "x" * 70_000})


def test_a_full_disk_ends_the_recording_at_a_whole_block(tmp_path: Path) -> None:
    path, room = tmp_path / "a.pansrec", [10]
    recorder = Recorder(path, HEADER)
    recorder.add_decisions(decisions(1))
    recorder.flush()
    real = recorder.open_file._file

    def write(data: memoryview) -> int:
        """Take ten more bytes, then refuse."""
        return int(real.write(data[: room.pop()] if room else fails(errno.ENOSPC)()))

    recorder.open_file._file = Disk(real, write=write)
    recorder.add_decisions(decisions(1, 1))
    with pytest.raises(PansError, match="recording stops after"):
        recorder.flush()
    found = read_recording(path)
    assert facts(found) == (1, False)
    assert found.size == found.end_offset


def test_short_writes_are_continued(tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    with Recorder(path, HEADER) as recorder:
        real = recorder.open_file._file
        recorder.open_file._file = Disk(real, write=lambda data: real.write(data[:7]))
        recorder.add_message(1, b"hello" * 20)
        recorder.close({})
    assert list(read_recording(path).messages()) == [(1, b"hello" * 20)]


def test_a_header_that_json_cannot_hold_makes_no_file(tmp_path: Path) -> None:
    for strange in (float("nan"), np.float32(1.0), {1: 2}):
        with pytest.raises((ValueError, TypeError)):
            Recorder(tmp_path / "a.pansrec", {"value": strange})
    assert os.listdir(tmp_path) == []


def test_a_recording_must_say_who_drove_its_automaton() -> None:
    walks, fixed = automaton_bundle(), made_bundle(table=np.zeros((4, 2)))
    assert automaton_of({}, fixed) is None
    assert automaton_of({"drive": "device", "confidence": 0.0}, walks) is walks.automaton
    with pytest.raises(ValueError, match="does not say who drove"):
        automaton_of({"confidence": 0.0}, walks)
    with pytest.raises(ValueError, match="not in the recording"):
        automaton_of({"drive": "host", "confidence": 0.0}, fixed)


@pytest.mark.parametrize("leaves", [False, True], ids=["close", "exit"])
def test_a_disk_that_fails_at_close_is_told_with_the_files_name(leaves: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.pansrec"
    recorder = Recorder(path, HEADER)
    real = recorder.open_file._file

    def close() -> None:
        if not real.closed:
            real.close()
            fails(errno.EIO)()

    recorder.open_file._file = Disk(real, close=close)
    with pytest.raises(RecordingError, match=r"a\.pansrec: the disk failed when the recording was closed"):
        if leaves:
            with recorder:
                pass
        else:
            recorder.close({})
    assert recorder.open_file._file.closed
