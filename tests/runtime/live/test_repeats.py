"""Messages that come twice: equal ones change nothing, another content under the same number is a contradiction, whichever came first."""

import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fault_grid
import pytest
from commands import json_of, page_of, words_of

from pans.base import SHIPPED
from pans.live.loop import Job, RunResult, run_live
from pans.live.options import RunOptions
from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import MessageType
from pans.protocol.wire.framing import FrameDecoder, encode_frame
from pans.record.reading import Recording, read_recording
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans.report.summary.summary import contradictions_of, find_faults
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.virtual import START_NS, VirtualLink

FRAMES = 60  # stream messages of a session
MOST_LATER = 40  # messages between the two
CLEAN, EQUAL, CHANGED_FIRST, CHANGED_LATER, MIXED = range(5)  # what comes twice in a session
HOW = ("clean", "equal", "changed first", "changed later", "mixed")


class Repeats:
    """Some of a device's stream messages twice, at once or up to MOST_LATER messages later; `changed` counts those of another content."""

    def __init__(self, how: int, seed: int, often: float) -> None:
        self.equal = self.changed = 0
        self._how, self._often, self._dice = how, often, random.Random(seed)
        self._later: list[list[Any]] = []  # messages to pass, frame

    def spoil(self, sent: bytes) -> bytes:
        return b"".join(self._twice(piece + b"\0") for piece in sent.split(b"\0")[:-1])

    def _twice(self, message: bytes) -> bytes:
        dice, frame = self._dice, FrameDecoder().feed(message)[0]
        if frame.type not in STREAM_TYPES:
            return message
        out, rest = message, []
        for held in self._later:
            held[0] -= 1
            if held[0] <= 0:
                out += self._sent(*held[1:])
            else:
                rest.append(held)
        self._later = rest
        how = dice.choice((EQUAL, CHANGED_FIRST, CHANGED_LATER)) if self._how == MIXED else self._how
        if how == CLEAN or dice.random() >= self._often:
            return out
        again = message if how == EQUAL else self._change(frame)
        if how == CHANGED_FIRST:
            return self._sent(how, again) + out
        if dice.random() < 0.5:
            self._later.append([dice.randint(1, MOST_LATER), how, again])
            return out
        return out + self._sent(how, again)

    def _sent(self, how: int, message: bytes) -> bytes:
        self.equal += how == EQUAL
        self.changed += how != EQUAL
        return message

    def _change(self, frame: Any) -> bytes:
        """The same number (the first four bytes), one bit of what follows another: clicks, where there are some."""
        payload = bytearray(frame.payload)
        first = 4 if frame.type == MessageType.MARK or self._dice.random() < 0.3 else 36
        payload[self._dice.randrange(first, len(payload))] ^= 1 << self._dice.randrange(8)
        return encode_frame(frame.type, bytes(payload), frame.session)


class Repeating(Instrument):
    """An instrument whose messages `repeats` spoils."""

    repeats: Repeats

    def step(self, tick: int, data: bytes) -> bytes:
        return self.repeats.spoil(super().step(tick, data))


def session(path: Path, mode: str, how: int, seed: int, often: float) -> tuple[RunResult, Recording, Repeats]:
    one, (result, repeats) = fault_grid.Case.of(mode, FRAMES), (None, Repeats(how, seed, often))
    clock = DeviceClock(one.profile.clock.tick_hz)
    device = Repeating(one.profile, one.scene, seed=seed, power_on_tick=clock.tick_at(START_NS))
    device.repeats = repeats
    config = RunOptions(n_cycles=one.n_cycles, deadline_us=1e9, realtime=False)
    header = one.recorded()
    with Recorder(path, {"config": header}, overwrite=True) as recorder:
        link = VirtualLink(device, clock, "sim:repeats")
        result = run_live(link, Job(one.profile, one.bundle, one.plan, config), one.core, recorder)
        recorder.close({})
    recording = read_recording(path)
    again = replay(recording, one.bundle)
    assert again.as_recorded
    told = {
        what: count for what, count in result.contradictions.items() if what != "future_tick"
    }  # no clock in a replay
    assert again.contradictions == told
    events = [event["what"] for event in recording.events() if event["kind"] == "contradiction"]
    assert events.count("repeat") == told.get("repeat", 0) == result.stream["repeats_differing"]
    return result, recording, repeats


def wrong_verdicts(folder: Path, sessions: int, monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], list[int]]:
    """Run so many sessions; return those whose verdict is wrong, and how many were of each kind of HOW."""
    wrong, kinds = [], [0] * len(HOW)
    monkeypatch.setattr("pans.live.session.secrets", SimpleNamespace(randbelow=random.Random(1).randrange))
    modes = fault_grid.MODES
    for number in range(sessions):
        mode = modes[number % len(modes)]
        how, often = 1 + (number + number // len(modes)) % 4, (0.3, 1.0, 0.1, 0.01)[number // 4 % 4]
        result, recording, repeats = session(folder / "run.pansrec", mode, how, number, often)
        clean, undisturbed, _ = session(folder / "clean.pansrec", mode, CLEAN, number, 0.0)
        kinds[how if repeats.changed or how == EQUAL else EQUAL] += 1
        assert result.ended == "completed"
        faults = [words for words in find_faults(result, 0, aborts_are_faults=False) if "contradict" in words]
        same = recording.decisions().tobytes() == undisturbed.decisions().tobytes()
        told = contradictions_of(result)
        verdict = (bool(faults), bool(told)) == (bool(repeats.changed),) * 2 and not contradictions_of(clean)
        labels = same or (repeats.changed and how in (CHANGED_FIRST, MIXED))
        counted = repeats.changed or result.stream["repeated"] <= repeats.equal
        if not (verdict and labels and counted):
            wrong.append(f"{number}: {mode}, {HOW[how]}, {repeats.changed} changed: {told}, same {same}")
    return wrong, kinds


@pytest.mark.parametrize(("sessions", "each"), [(6, 1), pytest.param(200, 21, marks=pytest.mark.slow)])
def test_no_session_is_judged_wrongly(
    sessions: int, each: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong, kinds = wrong_verdicts(tmp_path, sessions, monkeypatch)
    assert wrong == []
    assert min(kinds[1:]) >= each


@pytest.mark.parametrize(("how", "code"), [(EQUAL, 0), (CHANGED_FIRST, 4), (CHANGED_LATER, 4)])
@pytest.mark.parametrize("parts", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_exit_code_and_each_file_tell(
    how: int,
    code: int,
    parts: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Also where the two stand in different parts of a recording, which are replayed one by one."""
    repeats, step = Repeats(how, 1, 0.2), Instrument.step
    monkeypatch.setattr(Instrument, "step", lambda device, tick, data: repeats.spoil(step(device, tick, data)))
    device = "sim:dmd-spad?scene=fashion200&seed=1&pace=fast"
    words = ("--decisions", 400 if parts else 60, "--out", tmp_path / "run", *(("--rotate-mb", 0.02) if parts else ()))
    told = json_of(capsys, "run", SHIPPED / "fashion-adaptive.pans", "--device", device, *words, code=code)
    n = told["stream"]["repeats_differing"]
    assert (told["verdict"], n > 0) == ("PASS" if code == 0 else "FAIL", code != 0)
    assert told["stream"]["repeated"] > 10
    assert told["stream"]["repeats_unchecked"] == 0
    assert told["contradictions"].get("repeat", 0) == n
    assert ("repeat" in " ".join(told["faults"])) == (code != 0)
    page = (tmp_path / "run" / "summary.md").read_text()
    assert f"; {told['stream']['repeated']} messages repeated or overtaken" in page
    assert (f"({n} differing)" in page, f"repeat {n}" in page) == (code != 0,) * 2
    shown = words_of(page_of(tmp_path / "run" if parts else Path(told["recording"]), tmp_path))
    assert f"; {told['stream']['repeated']} messages repeated or overtaken" in shown
    assert (f"({n} differing)" in shown) == (code != 0)
    again = json_of(capsys, "replay", tmp_path / "run" if parts else told["recording"])
    found = again["parts"] if parts else [again]
    assert sum(part["contradictions"].get("repeat", 0) for part in found) == n
    assert len(found) > 3 or not parts
