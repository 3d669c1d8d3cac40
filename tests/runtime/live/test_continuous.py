"""Running for days: the state file, metrics over HTTP, signals that end a run, and the command with all of them."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from commands import fixed_run
from live_status import small_status

from pans.app.main import main
from pans.app.run.one_run import _exit_code
from pans.base.errors import RecordingError
from pans.base.files.output_files import locked
from pans.bundle.sensor.bundle import write_bundle
from pans.decide.decision import DECISION_DTYPE
from pans.decide.still import Core
from pans.live.options import RunOptions
from pans.live.stop import AGAIN_S, ASKED_TO_STOP, INTERRUPTED, RECORDING_DELETED, Stop, stop_signals
from pans.live.watch.metrics import MetricsServer
from pans.live.watch.state_file import StateFile, picture_of
from pans.live.watch.watchers import Watchers
from pans.record.reading import read_recording
from pans.record.reading.parts import parts_in
from pans.record.recorder import Recorder
from pans.report.files.verify import verify_parts
from pans_sim.ports.virtual import VirtualLink
from pans_sim.testing import small_setup

DEVICE = "sim:ideal?scene=uniform&seed=3"
PATIENCE_S = 600.0  # kernels may be compiled, and on a busy machine


def test_the_state_file_is_always_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, looks = tmp_path / "state.json", iter(range(1000))
    state = StateFile(path, lambda: {"n": next(looks)})
    assert json.loads(path.read_text()) == {"n": 0}
    state.leave({"ended": "so"})
    state.close()
    found = json.loads(path.read_text())
    assert (found["n"] >= 2, found["ended"], state.trouble) == (True, "so", "")
    monkeypatch.setattr(os, "fsync", MagicMock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    state.leave({})
    assert list(tmp_path.iterdir()) == [path]  # what a full disk cut off does not stay
    assert (json.loads(path.read_text()), state.trouble) == ({"n": found["n"] + 1}, "")  # in place of the bytes before
    monkeypatch.setattr(StateFile, "_overwrite", lambda self, data: False)
    state.close()
    assert "No space left" in state.trouble
    assert not path.exists()  # what it said is not true any more


def test_the_state_of_a_run_that_an_error_ended_is_stopped(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    with (
        pytest.raises(RecordingError),
        Watchers(RunOptions(state=path), None, None, Stop(continuous=True), None),
    ):
        raise RecordingError("run.pansrec: No space left on device")
    found = json.loads(path.read_text())
    assert (found["state"], found["ended"]) == ("stopped", "run.pansrec: No space left on device")


def test_two_runs_do_not_share_a_state_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = tmp_path / "state.json"
    with locked(tmp_path / ".state.json.lock"):
        assert main([*fixed_run(3), "--state", str(state), "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert f"{state}: another run writes here (process {os.getpid()})" in said
    assert "give each run a file of its own" in said
    assert main([*fixed_run(3), "--state", str(state), "--out", str(tmp_path / "run")]) == 0
    assert not (tmp_path / ".state.json.lock").exists()


@pytest.mark.parametrize(
    "before", [b'{"format":"pans-state 1","verdict":-Infinity}', b'{"format":"pans-state 1","verdict":[1]}']
)
def test_a_state_file_of_another_hand_does_not_keep_a_run_from_starting(before: bytes, tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(before)
    with Watchers(RunOptions(state=path), None, None, Stop(continuous=True), None) as seen:
        assert seen.look().get("last_verdict") in (None, "cut")
    assert json.loads(path.read_text())["state"] == "setting up"


def test_a_state_file_that_cannot_be_written_does_not_end_the_run(tmp_path: Path) -> None:
    state = StateFile(tmp_path / "missing" / "state.json", dict)
    state.close()
    assert "No such file" in state.trouble


def test_a_run_knows_the_verdict_of_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "state.json"

    def run(concludes: tuple[str, ...]) -> list[str | None]:
        with Watchers(RunOptions(state=path), None, None, Stop(continuous=True), None) as seen:
            found = [seen.look().get("last_verdict")]
            for verdict in concludes:
                seen.conclude(verdict, ["the light has changed"])
            return [*found, seen.look().get("last_verdict")]

    assert run(("FAIL",)) == [None, "FAIL"]
    assert json.loads(path.read_text())["faults"] == ["the light has changed"]
    assert run(()) == ["FAIL", "FAIL"]  # it ends without a verdict, as one that was killed
    assert run(("PASS",)) == ["cut", "PASS"]
    path.write_text(json.dumps(json.loads(path.read_text()) | {"recording": "/data/run-7/run-0001.pansrec"}))
    with Watchers(RunOptions(state=path), None, None, Stop(continuous=True), None) as seen:
        assert seen.look()["last_folder"] == "run-7"


def test_metrics_are_served() -> None:
    pytest.importorskip("prometheus_client")
    picture: dict[str, Any] = {"decisions": 7, "late_cause": {"link": 3}, "state": "running", "handles": 7}
    picture |= {"alarms": {"hot": 1, "light": 0}, "last_verdict": "cut", "last_folder": "2026"}
    with closing(MetricsServer("0", lambda: picture)) as server:
        lines = urllib.request.urlopen(f"http://127.0.0.1:{server.port}/metrics").read().decode().splitlines()
    causes = 'pans_late_decisions_by_cause_total{cause="link"} 3.0'
    assert {"pans_decisions_total 7.0", causes, "pans_running 1.0", "pans_open_handles 7.0"} <= set(lines)
    assert {
        'pans_alarm{kind="hot"} 1.0',
        'pans_alarm{kind="light"} 0.0',
        'pans_last_run_failed{folder="2026"} 1.0',
    } <= set(lines)


def test_signals_become_words_while_somebody_looks() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_signals(continuous=True) as stop:
        stop.polled = True
        signal.raise_signal(signal.SIGTERM)
        assert stop.word == ASKED_TO_STOP
        with pytest.raises(KeyboardInterrupt):  # the second time
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
    for continuous, signum, word in ((False, signal.SIGTERM, INTERRUPTED), (True, signal.SIGINT, INTERRUPTED)):
        asked = Stop(continuous=continuous)
        with pytest.raises(KeyboardInterrupt, match=word):  # nobody looks
            asked.ask(signum, None)


def test_a_signal_that_came_while_a_library_loaded_comes_again_unless_it_was_obeyed() -> None:
    loading: Any = SimpleNamespace(f_globals={"__name__": "numba.core"}, f_back=None)
    with stop_signals(continuous=False) as stop:
        stop.obey()
        stop.ask(signal.SIGTERM, loading)
        with pytest.raises(KeyboardInterrupt, match=INTERRUPTED):
            time.sleep(10 * AGAIN_S)
    with stop_signals(continuous=False) as stop:
        stop.ask(signal.SIGTERM, loading)
        with pytest.raises(KeyboardInterrupt, match=INTERRUPTED):
            stop.obey()
        time.sleep(10 * AGAIN_S)  # and no more


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs SIGHUP")
def test_nohup_keeps_what_runs_beyond_its_terminal() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_signals(continuous=False) as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.word
            signal.signal(signal.SIGHUP, signal.SIG_DFL)
        with stop_signals(continuous=False), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="module")
def bundle_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bundle") / "grid.pans"
    write_bundle(small_setup("sequential")[1], path)
    return path


@pytest.mark.skipif(not hasattr(signal, "SIGTERM") or sys.platform == "win32", reason="needs signals")
@pytest.mark.parametrize("limit", [[], ["--seconds", "600"]])
def test_sigterm_ends_a_continuous_run_well(bundle_file: Path, tmp_path: Path, limit: list[str]) -> None:
    with _running(bundle_file, tmp_path, "--rotate-mb", "0.02", *limit) as process:
        _wait_for(lambda: _state(tmp_path).get("parts", 0) >= 3)
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=PATIENCE_S)
    summary = json.loads(out)
    assert summary["ended"] == (INTERRUPTED if limit else ASKED_TO_STOP)
    failed = 4 if summary["late"] or summary["lost"] else 1  # as on a busy machine
    assert process.returncode == (130 if limit else 0 if summary["verdict"] == "PASS" else failed)
    state = _state(tmp_path)
    assert (state["state"], state["decisions"]) == ("stopped", summary["decisions"])
    assert (state["verdict"], state["faults"]) == (summary["verdict"], summary["faults"])
    assert all(verdict.ok for verdict in verify_parts(tmp_path / "out"))
    assert sum(read_recording(path).n_decisions for path in parts_in(tmp_path / "out")) == summary["decisions"]


@contextmanager
def _running(bundle_file: Path, folder: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    """A run in a process of its own, with its files in `folder`."""
    words = ["run", "--device", DEVICE, "--no-realtime", "--json", str(bundle_file), *more]
    words += ["--out", str(folder / "out"), "--state", str(folder / "state.json")]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-m", "pans", *words], **pipes)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("facts", "code"),
    [
        ({"verdict": "PASS", "ended": ASKED_TO_STOP}, 0),
        ({"verdict": "FAIL", "ended": ASKED_TO_STOP}, 1),  # reconnections alone
        ({"verdict": "FAIL", "ended": ASKED_TO_STOP, "too_late": True}, 4),
        ({"verdict": "FAIL", "ended": ASKED_TO_STOP, "exposure_timing": {"within": False}}, 4),
        ({"verdict": "FAIL", "ended": ASKED_TO_STOP, "link_lost": True}, 3),
        ({"verdict": "FAIL", "ended": RECORDING_DELETED}, 1),
        ({"verdict": "PASS", "ended": INTERRUPTED}, 130),
    ],
)
def test_exit_codes_of_a_run(facts: dict[str, Any], code: int) -> None:
    fine = {
        "link_lost": False,
        "too_late": False,
        "lost": 0,
        "stream": {"lost_messages": 0},
        "contradictions": {},
        "exposure_timing": {},
    }
    assert _exit_code(SimpleNamespace(**{**fine, **facts})) == code  # type: ignore[arg-type]


def test_the_state_names_only_what_is_written(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.pansrec", {"simulated": True}) as recorder:
        run = small_status(recorder)
        run.accounts.journal.note("light_changed", words="more light")
        recorder.add_decisions(np.zeros(3, DECISION_DTYPE))
        assert picture_of(run, recorder, 0.0)["decisions"] == 0
        recorder.flush()
        assert picture_of(run, recorder, 0.0)["decisions"] == 3
        hot = [SimpleNamespace(kind="hot", rate=rate, expected=expected) for rate, expected in ((6, 2), (1, 0), (3, 2))]
        assert isinstance(run.core, Core)
        run.core.guard = SimpleNamespace(serious=hot)  # type: ignore[assignment]
        picture = picture_of(run, recorder, 0.0)
        assert [kind for kind, lasts in picture["alarms"].items() if lasts] == ["hot", "light"]
        assert picture["times_expected"] == {"hot": 3.0}
        run.session.close()


@pytest.mark.skipif(sys.platform != "linux", reason="needs files that are read without a name")
@pytest.mark.parametrize("parts", [[], ["--rotate-mb", "0.2"]])
def test_a_run_whose_folder_is_deleted_keeps_its_recording(bundle_file: Path, tmp_path: Path, parts: list[str]) -> None:
    with _running(bundle_file, tmp_path, *parts) as process:
        _wait_for(lambda: _state(tmp_path).get("parts", 0) >= 3 if parts else _state(tmp_path).get("decisions", 0) > 50)
        _wait_for(lambda: shutil.rmtree(tmp_path / "out", ignore_errors=True) or not (tmp_path / "out").exists())
        out, told = process.communicate(timeout=PATIENCE_S)
    summary, kept = json.loads(out), tmp_path / "out-kept"
    assert (process.returncode, summary["ended"], summary["verdict"]) == (1, RECORDING_DELETED, "FAIL")
    recording = read_recording(summary["recording"])
    assert recording.path.parent == Path(summary["report"]).parent == kept
    assert recording.complete
    assert 0 < recording.n_decisions <= summary["decisions"]
    assert bool(parts) or recording.n_decisions == summary["decisions"]
    assert any(str(kept) in fault for fault in summary["faults"])
    assert RECORDING_DELETED in told
    assert RECORDING_DELETED in (kept / "summary.md").read_text()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the simulator's process as Linux shows it")
def test_a_run_that_looks_for_its_device_ends_with_its_summary(bundle_file: Path, tmp_path: Path) -> None:
    """The simulator's process answers no more and cannot be ended in time either: the recording and the summary come first."""
    with _running(bundle_file, tmp_path, "--reconnect-s", "600") as process:
        _wait_for(lambda: _state(tmp_path).get("decisions", 0) >= 100)
        for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
            os.kill(int(child), signal.SIGSTOP)
        _wait_for(lambda: "link_lost" in json.dumps(_state(tmp_path)))
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE_S)
    summary = json.loads(out)
    assert summary["ended"] == ASKED_TO_STOP, err
    assert any("had not been found again" in fault for fault in summary["faults"])
    assert process.returncode == 3
    kept = read_recording(tmp_path / "out" / "run.pansrec")
    assert kept.complete
    assert kept.n_decisions == summary["decisions"]


def test_the_summary_comes_before_the_link_is_closed(
    bundle_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    there: list[tuple[bool, bool]] = []

    def close(link: VirtualLink) -> None:
        summary = (tmp_path / "out" / "summary.md").exists() and '"verdict"' in capsys.readouterr().out
        there.append((summary, read_recording(tmp_path / "out" / "run.pansrec").complete))

    monkeypatch.setattr(VirtualLink, "close", close)
    words = ["--device", "sim:ideal?scene=uniform&pace=fast", "--decisions", "20", "--out", str(tmp_path / "out")]
    assert main(["run", str(bundle_file), "--json", *words]) == 0
    assert there[0] == (True, True)


def _state(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / "state.json").read_text()))
    except FileNotFoundError:
        return {}


def _wait_for(condition: Any) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_an_interrupt_that_a_library_turns_into_an_error_of_its_own_stays_an_interrupt(
    bundle_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loading(*_: Any) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as interrupt:
            raise ImportError("initialization failed") from interrupt

    monkeypatch.setattr("pans.app.run.one_run.prepare", loading)
    words = ["run", str(bundle_file), "--device", "sim:ideal?pace=fast&scene=uniform", "--out", str(tmp_path / "out")]
    assert main([*words, "--decisions", "4"]) == 130


def test_a_signal_waits_until_a_library_is_loaded() -> None:
    """Interrupted in its middle, a compiled kernel that is loaded aborts the process."""
    space: dict[str, Any] = {"__name__": "llvmlite.binding", "signal": signal, "time": time, "done": []}
    exec("def load():\n    signal.raise_signal(signal.SIGTERM)\n    time.sleep(0.1)\n    done.append(1)", space)
    with stop_signals(continuous=True), pytest.raises(KeyboardInterrupt, match=ASKED_TO_STOP):
        space["load"]()
        time.sleep(10)
    assert space["done"] == [1]
