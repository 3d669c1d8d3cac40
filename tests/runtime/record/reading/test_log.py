"""The compact decision log: the rows come back bit for bit, its hash is one of the rows alone."""

import hashlib
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_runs import log_sha256

from pans.base.errors import DamagedFileError
from pans.decide import RUN_DTYPE, VERDICT_DTYPE
from pans.decide.decision import DECISION_DTYPE
from pans.record.reading import decision_log as record_log
from pans.record.reading import read_recording
from pans.record.reading.decision_log import LogEncoder, LogReader
from pans.record.reading.format import LONG_VERDICT
from pans.record.recorder import Recorder


def naive_sha256(rows: np.ndarray) -> str:
    """The hash in plain words: verdicts in the order in which they appear, a code for each row, and runs as long as they can be."""
    known: dict[bytes, int] = {}
    verdicts, codes, exposures = b"", b"", b""
    runs: list[list[int]] = []  # first row, count, steps of tick, exposure and shot
    for row in rows:
        verdict = b"".join(row[name].tobytes() for name in record_log.VERDICT_FIELDS)
        walked = row["exposures"].tobytes()
        if verdict + walked not in known:
            verdicts += verdict
            exposures += walked
            if len(known) < LONG_VERDICT:
                known[verdict + walked] = len(known)
        codes += struct.pack("<H", known.get(verdict + walked, LONG_VERDICT))
        values = [int(row[name]) for name in ("index", "object", "truth", "tick", "exposure_index", "shot")]
        if runs and continues(runs[-1], values):
            runs[-1][1] += 1
        else:
            runs.append([values, 1, [0, 0, 0]])
    packed = b"".join(
        struct.pack("<QQQIIIIIIhH", v[0], v[3], v[4], v[1], v[5], count, *steps, v[2], 0) for v, count, steps in runs
    )
    parts = (verdicts, codes, packed, *([exposures] if any(exposures) else []))
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def continues(run: list[Any], values: list[int]) -> bool:
    first, count, steps = run
    if values[0] != (first[0] + count) % 2**64 or values[1:3] != first[1:3]:
        return False
    if count == 1:
        found = [(now - then) % 2**64 for now, then in zip(values[3:], first[3:])]
        if max(found) >= 2**32:
            return False
        run[2] = found
        return True
    return all(now == (then + count * step) % 2**64 for now, then, step in zip(values[3:], first[3:], steps))


PINNED = (
    "63f7ea273cb08c6019f7e672c69d2521231946b9d7a9fd99fd01fbf880fbfda0"  # of a log of fixed patterns: must not change
)
edges = st.sampled_from([0, 1, 2, 2**31, 2**32 - 1, 2**32, 2**63, 2**64 - 2, 2**64 - 1])
small = st.integers(0, 3)


@st.composite
def logs(draw: st.DrawFn) -> np.ndarray:
    """Rows that go on regularly, break off, stand still, jump back and overflow."""
    rows: list[tuple[Any, ...]] = []
    walks = draw(st.booleans())
    for _ in range(draw(st.integers(1, 6))):
        index, tick, exposure = draw(edges), draw(edges), draw(edges)
        number, shot, truth = draw(small), draw(st.sampled_from([0, 5, 2**32 - 3])), draw(st.integers(-1, 1))
        steps = [draw(st.sampled_from([0, 1, 100, 2**32 - 1, 2**32])) for _ in range(2)] + [draw(small)]
        for k in range(draw(st.integers(1, 7))):
            label, probability = draw(small), draw(st.sampled_from([0.5, 0.0, -0.0, float("nan")]))
            walked = draw(st.sampled_from([0, 1, 2**32 - 1])) if walks else 0
            when = ((start + k * step) % 2**64 for start, step in ((index, 1), (tick, steps[0]), (exposure, steps[1])))
            what = (number, (shot + k * steps[2]) % 2**32, label, label, truth, 0, probability, 7 * label, walked)
            rows.append((*when, *what))
    return np.array(rows, DECISION_DTYPE)


@settings(deadline=None, max_examples=60)
@given(rows=logs(), cuts=st.lists(st.integers(0, 42), max_size=4))
def test_rows_come_back_and_the_hash_is_theirs_alone(rows: np.ndarray, cuts: list[int]) -> None:
    encoder, reader = LogEncoder(), LogReader()
    pieces = np.split(rows, sorted(cuts))
    found = [reader.rows(encoder.block(piece), "a log") for piece in pieces]
    assert np.concatenate(found).tobytes() == rows.tobytes()
    assert encoder.hexdigest() == reader.hexdigest() == log_sha256(rows) == naive_sha256(rows)
    if len(rows) > 1:
        assert log_sha256(rows[:-1]) != encoder.hexdigest()


def regular(n: int, verdicts: int, seed: int = 0) -> np.ndarray:
    rows = np.zeros(n, DECISION_DTYPE)
    k = np.arange(n)
    rows["index"], rows["tick"], rows["exposure_index"], rows["shot"] = k, 5 + 100 * k, 3 + k, k
    rows["object"], rows["truth"] = 7, 2
    rows["counts_crc"] = np.random.default_rng(seed).integers(0, verdicts, n) * 2654435761 % 2**32
    rows["probability"] = rows["counts_crc"] / np.float32(2**32)
    return rows


def test_a_fast_stream_takes_two_bytes_a_decision_and_exposures_of_walks_stand_beside(tmp_path: Path) -> None:
    assert log_sha256(regular(5000, 100)) == PINNED
    for walked in (0, 1):
        rows = regular(100_000, 1024)
        rows["exposures"] = walked * (1 + rows["counts_crc"] % 28)
        with Recorder(tmp_path / str(walked), {}) as recorder:
            recorder.add_decisions(rows)
            digest = recorder.close({})
        found = read_recording(tmp_path / str(walked))
        assert found.size < 2.3 * len(rows)
        assert found.decisions().tobytes() == rows.tobytes()
        assert digest == found.decisions_sha256 == log_sha256(rows)
    assert digest != log_sha256(regular(100_000, 1024))


def test_more_verdicts_than_have_numbers() -> None:
    rows = regular(3 * LONG_VERDICT, 2 * LONG_VERDICT)
    encoder, reader = LogEncoder(), LogReader()
    step = record_log.BLOCK_ROWS
    blocks = [encoder.block(rows[start : start + step]) for start in range(0, len(rows), step)]
    assert max(map(len, blocks)) < 2 << 20
    assert b"".join(reader.rows(block, "a log").tobytes() for block in blocks) == rows.tobytes()
    assert encoder.hexdigest() == reader.hexdigest() == log_sha256(rows)
    assert len({row.tobytes() for row in rows["counts_crc"]}) > LONG_VERDICT


def block(runs: list[tuple[Any, ...]], verdicts: int, codes: list[int]) -> bytes:
    data = np.array(runs, RUN_DTYPE).tobytes() + np.zeros(verdicts, VERDICT_DTYPE).tobytes()
    return struct.pack("<III", len(runs), verdicts, len(codes)) + data + np.array(codes, "<u2").tobytes()


RUN = (0, 0, 0, 0, 0, 2, 1, 1, 1, -1, 0)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"abc", "3 bytes"),
        (block([RUN], 1, [0, 0])[:-1], "allowed"),
        (struct.pack("<III", 0, 0, 1 << 30), "allowed"),
        (block([RUN], 1, [0]), "do not add up"),
        (block([(*RUN[:5], 0, *RUN[6:])], 1, []), "do not add up"),
        (block([(*RUN[:-1], 2)], 1, [0, 0]), "do not add up"),
        (block([RUN, (*RUN[:-1], 1)], 1, [0] * 4), "do not add up"),
        (block([RUN], 1, [0, 1]), "do not fit"),
        (block([RUN], 0, [0, 0]), "do not fit"),
        (block([RUN], 0, [LONG_VERDICT, 0]), "do not fit"),
    ],
)
def test_blocks_whose_parts_do_not_fit_are_refused(payload: bytes, reason: str) -> None:
    with pytest.raises(DamagedFileError, match=reason):
        LogReader().rows(payload, "block 3")


@pytest.mark.parametrize("version", [0, 2])
def test_a_recording_of_another_version_is_refused(tmp_path: Path, version: int) -> None:
    start = b"PANSRECD" + struct.pack("<I", version)
    (tmp_path / "a.pansrec").write_bytes(start + struct.pack("<I", zlib.crc32(start)))
    with pytest.raises(DamagedFileError, match=f"format version {version}, allowed: 1"):
        read_recording(tmp_path / "a.pansrec")
