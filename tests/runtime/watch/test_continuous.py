"""Running for days: the state file, metrics over HTTP, signals that end a run, and the command with all of them."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from pans.firmware_sim.testing import small_setup
from pans.runtime.bundle.model import write_bundle
from pans.runtime.cli import main
from pans.runtime.errors import UsageError
from pans.runtime.live.continuous import ASKED_TO_STOP, INTERRUPTED, Stop, stop_signals
from pans.runtime.record import read_recording
from pans.runtime.record.parts import parts_in
from pans.runtime.report.verify import verify_parts
from pans.runtime.watch.metrics import FIGURES, MetricsServer, parse_address
from pans.runtime.watch.state_file import FORMAT, StateFile, picture_of


def test_the_state_file_is_always_whole(tmp_path: Path) -> None:
    path, looks = tmp_path / "state.json", iter(range(1000))
    state = StateFile(path, lambda: {"n": next(looks)})
    assert json.loads(path.read_text()) == {"n": 0}
    state.close()
    assert json.loads(path.read_text())["n"] >= 1
    assert list(tmp_path.iterdir()) == [path]
    assert state.trouble == ""


def test_a_state_file_that_cannot_be_written_does_not_end_the_run(tmp_path: Path) -> None:
    state = StateFile(tmp_path / "missing" / "state.json", dict)
    state.close()
    assert "No such file" in state.trouble


def test_what_a_full_disk_cut_off_does_not_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = StateFile(tmp_path / "state.json", lambda: {"n": 1})

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    state.close()
    assert "No space left" in state.trouble
    assert [one.name for one in tmp_path.iterdir()] == ["state.json"]
    assert json.loads((tmp_path / "state.json").read_text()) == {"n": 1}


def test_before_the_run_there_is_a_picture_too() -> None:
    picture = picture_of(None, None, time.monotonic())
    assert (picture["format"], picture["state"], picture["pid"]) == (FORMAT, "setting up", os.getpid())
    if sys.platform == "linux":
        assert picture["rss_bytes"] > 1 << 20
        assert picture["handles"] > 2
    assert picture["threads"] >= 1


def test_metrics_are_served_and_only_here() -> None:
    pytest.importorskip("prometheus_client")
    picture: dict[str, Any] = dict.fromkeys(FIGURES, 7) | {"late_cause": {"link": 3}, "state": "running"}
    server = MetricsServer("0", lambda: picture)
    try:
        assert server.host == "127.0.0.1"
        with urllib.request.urlopen(f"http://{server.host}:{server.port}/metrics", timeout=10) as answer:
            text = answer.read().decode()
        with pytest.raises(UsageError, match="cannot listen"):
            MetricsServer(f"127.0.0.1:{server.port}", lambda: picture)
    finally:
        server.close()
    assert "pans_decisions_total 7.0" in text
    assert 'pans_late_decisions_by_cause_total{cause="link"} 3.0' in text
    assert "pans_running 1.0" in text
    assert "pans_open_handles 7.0" in text


def test_metrics_without_the_library_say_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(UsageError) as caught:
        MetricsServer("0", dict)
    assert "pans-runtime[metrics]" in caught.value.remedy


@pytest.mark.parametrize(
    ("text", "address"),
    [("9464", ("127.0.0.1", 9464)), ("0.0.0.0:1", ("0.0.0.0", 1)), ("[::1]:80", ("::1", 80)), (":5", ("127.0.0.1", 5))],
)
def test_addresses(text: str, address: tuple[str, int]) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["", "host:", "host:x", "1.2.3.4:70000"])
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(UsageError):
        parse_address(text)


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
@pytest.mark.parametrize(("limit", "code"), [([], 0), (["--seconds", "60"], 130)])
def test_sigterm_ends_a_continuous_run_well(bundle_file: Path, tmp_path: Path, limit: list[str], code: int) -> None:
    fixed = ["run", "--device", "sim:ideal?scene=uniform&seed=3", "--no-realtime", "--json", "--rotate-mb", "0.02"]
    words = [*fixed, str(bundle_file), "--out", str(tmp_path / "out"), "--state", str(tmp_path / "state.json"), *limit]
    command = "import sys; from pans.runtime.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen([sys.executable, "-c", command, *words], stdout=subprocess.PIPE, text=True)
    try:
        _wait_for(lambda: _state(tmp_path).get("parts", 0) >= 3)
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    summary = json.loads(out)
    assert (process.returncode, summary["ended"]) == (code, ASKED_TO_STOP if code == 0 else INTERRUPTED)
    state = _state(tmp_path)
    assert (state["state"], state["decisions"]) == ("stopped", summary["decisions"])
    assert all(verdict.ok for verdict in verify_parts(tmp_path / "out"))
    assert sum(read_recording(path).n_decisions for path in parts_in(tmp_path / "out")) == summary["decisions"]


def _state(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / "state.json").read_text()))
    except FileNotFoundError:
        return {}


def _wait_for(condition: Any) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(
    "options",
    [
        ["--keep-mb", "1"],
        ["--rotate-mb", "-1"],
        ["--rotate-mb", "2", "--keep-mb", "3"],
        ["--metrics", "nowhere"],
        ["--rotate-mb", "2", "--on-dark", "abstain"],
    ],
)
def test_what_cannot_be_meant(bundle_file: Path, tmp_path: Path, options: list[str]) -> None:
    words = ["run", str(bundle_file), "--device", "sim:ideal?pace=fast&scene=uniform", "--out", str(tmp_path)]
    try:
        code = main([*words, "--decisions", "4", *options])
    except SystemExit as end:  # by the parser
        code = end.code
    assert code == 2


def test_an_interrupt_that_a_library_turns_into_an_error_of_its_own_stays_an_interrupt(
    bundle_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loading(*_: Any) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as interrupt:
            raise ImportError("initialization failed") from interrupt

    monkeypatch.setattr("pans.runtime.commands.carry_out._prepare", loading)
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
