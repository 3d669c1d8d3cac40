"""Recordings decided again: whole, cut off at any byte, refused, or with blocks that say something else than the run."""

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import json_of
from small_files import blocks_of, record_flow, record_passive, record_run, sealed, use_file
from small_runs import record_small

from pans.app.main import main
from pans.base.errors import DeviceError
from pans.live.loop import Status
from pans.protocol.wire import MessageType, Opcode, unpack_body
from pans.record.reading import Recording, read_recording
from pans.record.reading.format import Kind
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans.report.files.verify import verify_file

ALL_FAULTS = "loss:0.01,duplicate:0.01,flip:0.01,stall:300ms/700ms"
Change = Callable[[list[tuple[int, bytes]]], list[tuple[int, bytes]]]


def cut_at(whole: bytes, size: int, path: Path) -> Recording:
    path.write_bytes(whole[:size])
    return read_recording(path)


@pytest.mark.parametrize("faults", ["", ALL_FAULTS])
def test_what_is_recorded_of_a_cut_run_is_decided_again(
    tmp_path: Path, faults: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Buffers are full now and then, each in its own time."""
    monkeypatch.setattr("pans.record.recorder.BUFFER_ROWS", 23)
    monkeypatch.setattr("pans.record.recorder._MESSAGE_BUFFER_BYTES", 3001)
    seed = random.SystemRandom().randrange(1 << 32)
    rng = random.Random(seed)
    path = tmp_path / "run.pansrec"
    record_small(path, faults=faults, seed=seed)
    whole, recording = path.read_bytes(), read_recording(path)
    complete = replay(recording, recording.bundle())
    assert (complete.as_recorded, complete.more) == (True, 0)
    ends = [block.end for block in recording.iter_blocks()]
    assert recording.kinds[Kind.DECISIONS] > 10
    most = 0, 0
    for size in sorted({*rng.sample(ends[1:-1], 12), *(rng.randrange(ends[1], len(whole)) for _ in range(6))}):
        part = cut_at(whole, size, path)
        again = replay(part, part.bundle())
        assert again.as_recorded, f"seed {seed}, {size} of {len(whole)} bytes: {part.n_decisions} recorded, {again}"
        assert complete.decisions >= again.decisions >= part.n_decisions == again.recorded
        most = max(most, (again.more, size))
    part = cut_at(whole, most[1], path)
    found = json_of(capsys, "replay", path, code=0)
    assert (found["identical"], found["complete"]) == (True, False)
    assert (found["decisions_recorded"], found["decisions_more"]) == (part.n_decisions, most[0])
    assert most[0] == found["decisions"] - part.n_decisions > 0
    assert found["sha256"] != found["recorded_sha256"]
    part = cut_at(whole, ends[1], path)  # behind the bundle, before it armed
    again = replay(part, part.bundle())
    assert (again.decisions, again.sha256, again.passages) == (0, part.decisions_sha256, None)


def test_what_the_device_answered_is_on_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.pansrec"
    record_small(path, 40)
    recording = read_recording(path)
    kinds = [unpack_body(body).type for _, body in recording.answers()]
    assert kinds[0] == MessageType.WELCOME
    assert {MessageType.ACK, MessageType.PONG} <= set(kinds)
    assert MessageType.STATUS not in kinds
    facts = json_of(capsys, "info", path)
    (session,) = facts["handshakes"]
    assert session["device"]["simulated"] is True
    assert (session["welcomes"], session["refused"], session["malformed"]) == (1, [], 0)
    assert session["acks"] + session["pongs"] + 1 == facts["answers"] == len(kinds)
    assert json_of(capsys, "verify", path, code=0)["ok"]


def test_a_refusal_that_ends_the_set_up_is_on_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(run: Status) -> None:
        run.session.host.submit(Opcode.LOAD_PLAN, b"nothing that is a plan")
        run.session.wait_acknowledged()

    path = tmp_path / "run.pansrec"
    with pytest.raises(DeviceError, match="refused command"):
        record_small(path, 40, prepared=refused)
    (session,) = json_of(capsys, "info", path)["handshakes"]
    (found,) = session["refused"]
    assert (found["command"], found["status"] > 0) == ("LOAD_PLAN", True)
    recording = read_recording(path)
    again = replay(recording, recording.bundle())
    assert (again.decisions, again.sha256) == (0, recording.decisions_sha256)


@pytest.mark.parametrize(
    ("body", "words"), [(b"short", "answer 0"), (bytes([MessageType.STATUS]) + bytes(20), "allowed: WELCOME")]
)
def test_an_answer_that_is_none_is_a_violation(tmp_path: Path, body: bytes, words: str) -> None:
    path = tmp_path / "run.pansrec"
    with Recorder(path, {}) as recorder:
        recorder.add_answer(1, body)
        recorder.close({})
    assert words in " ".join(verify_file(path).violations)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return record_run(tmp_path_factory.mktemp("run")).read_bytes()


def without(*kinds: Kind) -> Change:
    return lambda blocks: [block for block in blocks if block[0] not in kinds]


def event(text: bytes) -> Change:
    return lambda blocks: [(kind, text if kind == Kind.EVENTS else payload) for kind, payload in blocks]


@pytest.mark.parametrize("profile", [7, "ideal", [], {"toml": 5}, None])
def test_a_header_with_a_profile_of_another_type_is_replayed(profile: object, whole: bytes, tmp_path: Path) -> None:
    def change(blocks: list[tuple[Kind, bytes]]) -> list[tuple[Kind, bytes]]:
        header = json.loads(blocks[0][1]) | {"profile": profile}
        return [(blocks[0][0], json.dumps(header).encode()), *blocks[1:]]

    path = tmp_path / "run.pansrec"
    path.write_bytes(sealed(change(blocks_of(whole))))
    recording = read_recording(path)
    assert replay(recording, recording.bundle()).exposure_timing == {}
    assert main(["replay", str(path)]) == 0
    assert main(["export", str(path), "--format", "csv", "-o", str(tmp_path / "csv")]) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without(Kind.COMMANDS), "the device was never armed"),
        (without(Kind.COMMANDS, Kind.MESSAGES), "the device was never armed"),
        (event(b'{"why":"no kind"}'), "the event has no kind"),
        (event(b'{"kind":"gate_refused","decision":"7"}'), "decision is '7', allowed: a whole number"),
        (event(b'{"kind":"gate_refused","decision":-1}'), "decision is -1, allowed: a whole number"),
        (without(Kind.COMMANDS, Kind.MESSAGES, Kind.DECISIONS, Kind.TIMINGS), ""),  # it decided nothing
    ],
)
def test_what_cannot_be_replayed_or_read_is_a_violation(
    change: Change, words: str, whole: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "run.pansrec"
    path.write_bytes(sealed(change(blocks_of(whole))))
    found = " ".join(verify_file(path).violations)
    assert words in found if words else not found
    if not words:
        use_file("recording", path)


@pytest.mark.parametrize("make", [record_run, record_passive, pytest.param(record_flow, marks=pytest.mark.slow)])
def test_the_files_that_are_changed_are_whole_and_decide(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path)
    assert verify_file(path).violations == []
    assert read_recording(path).n_decisions > 0
    use_file("recording", path)
