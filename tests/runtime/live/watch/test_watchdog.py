"""A run that hangs: it says so within two seconds, its light goes off, and SIGTERM ends it within five, with a word about where it was."""

import os
import signal
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from host_process import HANGS, HANGS_AFTER, lit_instrument, start_host, until

from pans.base.errors import EXIT_INTERRUPTED, EXIT_TIMING
from pans.live.watch import watchdog
from pans.live.watch.state_file import is_stalled
from pans.live.watch.watchers import Notifier
from pans.record.reading import read_recording
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans.report.files.verify import verify_file

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs forkserver, signals and /proc")
STALLED_S, ENDED_S = 2.0, 5.0  # the bars
SLACK_S = 0.5  # two processors, many tests
# the first is so long that the watchdog's STOP comes before it
LEASE_MS = {"python": 20_000, "native": 500, "file": 500}


def hang_and_end(folder: Path, how: str) -> dict[str, Any]:
    """Let a run hang, ask it to end, and return when what happened, in s."""
    folder.mkdir()
    limits = ["--seconds", "600"] if how == "native" else []
    with lit_instrument() as lit:
        host = start_host(folder, lit.url, LEASE_MS[how], limits, hang=how)
        try:
            hung_s = until((folder / "hung").exists)
            until(lambda: host.state().get("state") == "stalled")
            stalled_s = time.perf_counter() - hung_s
            until(lambda: how == "python" or not lit.device.projector_lit)
            lit_s = lit.dark_s() - hung_s
            asked_s = time.perf_counter()
            host.signal(signal.SIGTERM)
            code = host.code()
            ended_s = time.perf_counter() - asked_s
            if how == "python":
                until(lambda: not lit.device.projector_lit)
                lit_s = lit.dark_s() - asked_s
            return {
                **{"stalled_s": stalled_s, "lit_s": lit_s, "ended_s": ended_s, "code": code, "errors": host.errors()},
                **{"state": host.state(), "recording": host.recording},
            }
        finally:
            host.process.kill()


def test_a_run_that_hangs_says_so_goes_dark_and_can_be_ended(tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as pool:
        found = dict(zip(HANGS, pool.map(lambda how: hang_and_end(tmp_path / how, how), HANGS)))
    for how, one in found.items():
        assert one["stalled_s"] < STALLED_S + SLACK_S, how
        assert one["ended_s"] < ENDED_S + SLACK_S, how
        assert one["code"] == (EXIT_INTERRUPTED if how == "native" else EXIT_TIMING), how
        assert one["state"]["state"] == "stalled"
        assert "the run did not end by itself; it was in _hang" in one["state"]["ended"], how
        assert "it was in _hang" in one["errors"]
        # lit until the lease runs out, or until the watchdog says STOP
        assert one["lit_s"] < (2.5 if how == "python" else LEASE_MS[how] / 1000) + SLACK_S, how
        recording = read_recording(one["recording"])
        assert not recording.complete
        assert not verify_file(one["recording"]).damaged
        if how == "file":
            assert replay(recording, recording.bundle()).as_recorded
        else:
            assert recording.n_decisions >= 1
            # decisions are recorded once all of a call are made, but the clicks before them: two messages each
            assert sum(1 for _ in recording.messages()) >= 2 * HANGS_AFTER, "what was buffered is on record"


def test_systemd_hears_of_the_loop_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(address))
        manager.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", str(address))
        monkeypatch.setenv("WATCHDOG_USEC", "30000")
        notifier = Notifier.of_environment()
        run: Any = SimpleNamespace(turned_s=time.monotonic(), outage_ns=None, ended="")
        notifier.begin(run)
        assert [manager.recv(99) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1"]
        run.turned_s -= 10
        assert is_stalled(run)
        manager.settimeout(0.1)
        with pytest.raises(TimeoutError):  # what was sent before, and then nothing
            while True:
                manager.recv(99)
        notifier.close()
        assert manager.recv(99) == b"STOPPING=1"
    monkeypatch.delenv("NOTIFY_SOCKET")
    assert Notifier.of_environment() is None
    assert os.environ["WATCHDOG_USEC"]


class Gone(BaseException):
    """The process has ended."""


@pytest.mark.parametrize("inside", [False, True])
def test_what_is_buffered_is_written_unless_the_run_hangs_while_it_records(
    inside: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorder that is entered twice would tear its own blocks."""

    def gone(code: int) -> None:
        raise Gone(code)

    monkeypatch.setattr(os, "_exit", gone)
    flushed, notes = list[str](), list[str]()
    dog = watchdog.Watchdog(continuous=False)
    dog.recorder, dog.note = SimpleNamespace(flush=lambda: flushed.append("flushed")), notes.append  # type: ignore[assignment]
    with Recorder(tmp_path / "a.pansrec", {}) as recorder, pytest.raises(Gone, match=str(EXIT_INTERRUPTED)):
        if inside:
            recorder.watch_write = lambda *times: dog._end_process(signal.SIGTERM)
            recorder.add_event({"kind": "gap"})
            recorder.flush()
        dog._end_process(signal.SIGTERM)
    assert flushed == ([] if inside else ["flushed"])
    assert "the run did not end by itself; it was in" in notes[0]


def test_a_run_whose_light_is_off_has_time_to_close_its_links_and_files(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = list[int]()
    dog = watchdog.Watchdog(continuous=True)

    class Dark:
        receiver = SimpleNamespace(stops=True)

        @property
        def stopped(self) -> bool:
            dog._done.set()  # it ends while it is waited for
            return True

    dog.run = Dark()  # type: ignore[assignment]
    monkeypatch.setattr(dog, "_end_process", ended.append)
    monkeypatch.setattr(watchdog, "LIGHT_OFF_AFTER_S", 0.0)
    monkeypatch.setattr(watchdog, "END_AFTER_S", 0.0)
    dog._wait_for_end(signal.SIGTERM, time.monotonic())
    assert ended == []
