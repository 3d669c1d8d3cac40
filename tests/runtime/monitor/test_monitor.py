"""The live view beside a run: pictures of it, their history in bounded memory, the terminal's panel and the plain lines."""

import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios
import time
import urllib.request
from collections import Counter, deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import fixed_run

from pans.runtime import SHIPPED
from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import main
from pans.runtime.commands import one_run
from pans.runtime.instrument.cusum import ChannelWatch
from pans.runtime.intervals import wilson_interval
from pans.runtime.monitor import History, Monitor
from pans.runtime.monitor.figures import class_rows, headline, latest_rows, rows_of, series
from pans.runtime.monitor.history import MAX_BINS, quantile_us
from pans.runtime.monitor.snapshot import Snapshots, begin_facts
from pans.runtime.timing.ledger import LatencyHistogram, upper_edge

NUMBERS = (
    *("decisions", "abstained", "known", "right", "objects", "clicks", "photons", "photons_known", "exposures", "lost"),
    *("gaps", "late", "reconnects", "contradictions", "latency_max_us", "dark_exposures", "dark_clicks"),
    "clock_uncertainty_us",
)


def picture(elapsed_s: float, **more: Any) -> dict[str, Any]:
    facts = dict.fromkeys(NUMBERS, 0)
    texts = {"state": "running", "ended": "", "trouble": "", "clock_drift_ppm": None, "walk_light": None, "latest": []}
    return {"kind": "picture", "elapsed_s": elapsed_s, "latency": [], **facts, **texts, **more}


def test_a_month_takes_the_memory_of_an_hour_and_loses_no_decision() -> None:
    history, n = History(), 10_000
    for step in range(1, n + 1):
        sums = {"decisions": 100 * step, "known": 100 * step, "right": 80 * step, "late": step // 1000}
        history.take(picture(65.0 * step, **sums, latency=[[200, 100]]))
    assert len(history.bins) <= MAX_BINS
    assert sum(one.sums["decisions"] for one in history.bins) == 100 * n
    assert sum(one.sums["late"] for one in history.bins) == n // 1000
    assert sum((one.latency for one in history.bins), Counter()) == history.latency == Counter({200: 100 * n})
    assert all(a.end_s == b.begin_s for a, b in zip(history.bins, history.bins[1:]))
    assert set(series(history)["accuracy"]) == {0.8}


def test_quantiles_are_those_of_the_loop_s_histogram() -> None:
    total, rng = LatencyHistogram(), np.random.default_rng(4)
    total.add_many(rng.lognormal(12, 1, 3000).astype(np.int64))
    counts = Counter({upper_edge(bucket): int(count) for bucket, count in enumerate(total.counts) if count})
    for q in (0.001, 0.5, 0.99, 0.999):
        assert quantile_us(counts, q) * 1000 == pytest.approx(total.quantile_ns(q))  # type: ignore[operator]
    assert quantile_us(Counter(), 0.5) is None


def test_trials_of_one_visit_do_not_narrow_the_interval() -> None:
    history = History()
    history.take({"kind": "begin", "trials": 5})
    share, low, high = history.accuracy({"known": 500, "right": 400}) or (0, 0, 0)
    assert (share, low, high) == (0.8, *wilson_interval(80, 100))
    assert history.accuracy({"known": 500, "right": 400}, objects=20) == (0.8, *wilson_interval(16, 20))
    assert history.accuracy({"known": 0}) is None


def test_what_is_wrong_is_marked_and_in_words() -> None:
    history = History()
    history.take({"kind": "begin", "deadline_us": 1000.0, "classes": ["a\x1b[2J", "b"], "expected": 100})
    late = picture(10.0, decisions=50, known=50, right=25, objects=50, clicks=100, late=3, lost=7, gaps=2)
    late |= {"class_decided": [30, 20], "class_truth": [25, 25], "class_right": [20, 10], "latency": [[1_700_000, 50]]}
    late |= {"disk_free_bytes": 1 << 20, "recording_bytes": 1 << 20, "recording": "run.pansrec"}
    late |= {"latest": [[49, 3, 0, 0.5, 2, 1, 0]]}
    history.take(late | {"trouble": "lost\n\x1b[31m", "dark_words": "", "dark_exposures": 100, "dark_clicks": 3})
    rows = {row.name: row for row in rows_of(history)}
    assert rows["late"].level == rows["lost"].level == rows["disk"].level == rows["budget"].level == "bad"
    assert rows["lost"].text == "7 exposures in 2 gaps"
    assert rows["accuracy"].text.startswith("50.0%, 95 % interval 36.6% to 63.4%")
    assert "0.03 per exposure" in rows["dark counts"].text
    assert not any("\x1b" in row.text or "\n" in row.text for row in rows.values())
    assert class_rows(history)[0] == ("a\\x1b[2J", 30, 25, 20)
    assert latest_rows(history)[0]["level"] == "bad"
    assert headline(history).startswith("50 of 100 decisions · accuracy 50.0% · 2.00 clicks each · p99")
    assert headline(history).endswith("late 3 · lost 7")


@pytest.mark.parametrize(
    ("told", "words", "level"),
    [
        (None, "not told by the device", "note"),
        ([0, 0.0, 0.0], "not told yet", "note"),
        ([9, 1.5, -1.5], "start +1.5 us, length -1.5 us at most, allowed 1.5 us", "good"),
        ([9, 0.0, -1.6], "length -1.6 us", "bad"),
    ],
)
def test_exposures_off_the_plan_are_marked(told: list[float] | None, words: str, level: str) -> None:
    history = History()
    history.take({"kind": "begin", "exposure_tolerance_us": 1.5})
    history.take(picture(1.0, exposed=told))
    row = next(row for row in rows_of(history) if row.name == "exposures")
    assert words in row.text
    assert row.level == level


@pytest.mark.parametrize(
    ("clicks", "words", "level"),
    [(2, "higher than expected, not yet sure (alarm after about", "note"), (0, "as expected", "good")],
)
def test_a_rate_whose_interval_excludes_the_expected_one_is_not_called_expected(
    clicks: int, words: str, level: str
) -> None:
    watch = ChannelWatch(1, np.array([2.8e-5]))
    dark = np.zeros((1000, 1), np.uint8)
    dark[:clicks] = 1
    watch.update_words(dark)
    history = History()
    history.take({"kind": "begin"})
    seen = {"dark_exposures": 1000, "dark_clicks": clicks, "dark_expected": 2.8e-5, "dark_high": 2.8e-5}
    history.take(picture(1.0, **seen, dark_low=2.8e-5, dark_words="", dark_alarm_after=watch.alarm_after()))
    row = next(row for row in rows_of(history) if row.name == "dark counts")
    assert words in row.text
    assert (row.level, "as expected" in row.text) == (level, clicks == 0)
    assert ("dark counts" in headline(history)) == (clicks > 0)


@pytest.mark.parametrize("n_channels", [1, 4])
def test_the_alarm_comes_when_it_was_said_to_come(n_channels: int) -> None:
    watch = ChannelWatch(n_channels, np.full(n_channels, 0.001))
    assert watch.alarm_after() is None
    word = np.array([[0], *[[(1 << n_channels) - 1]], *[[0]] * 98], np.uint8)  # each channel clicks in 1 of 100
    assert not watch.update_words(word)
    said = watch.alarm_after()
    assert said is not None
    for block in range(1, 1000):
        if watch.update_words(word):
            assert 100 * (block - 1) <= said <= 100 * (block + 1)
            return
    raise AssertionError("no alarm")


class Watched(Monitor):
    """Takes a picture after every seventh decision and at the end, and draws nothing."""

    def begin(self, bundle: Any, recorder: Any, facts: dict[str, Any]) -> None:
        self.bundle, self.history, self.pictures = bundle, History(), list[dict[str, Any]]()
        self.history.take(json.loads(json.dumps(facts)))

    def prepared(self, run: Any) -> None:
        self.run, self.snapshots = run, Snapshots(run, self.bundle, None, self._latest)

    def watch(self, run: Any, output: Any) -> None:
        super().watch(run, output)
        if output.decisions and output.decisions[-1].number % 7 == 0:
            self.picture()

    def picture(self) -> None:
        self.pictures.append(json.loads(json.dumps(self.snapshots.take(lambda _: None))))
        self.history.take(self.pictures[-1])

    def __exit__(self, *_: Any) -> None:
        self.picture()


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    """The monitor of the next run."""
    made = Watched(panel=False)
    monkeypatch.setattr(one_run, "_monitor_of", lambda job: made)
    return made


def test_the_pictures_of_a_run_add_up_to_its_summary(watched: Watched, tmp_path: Path) -> None:
    assert main([*fixed_run(60, trials=2), "--out", str(tmp_path / "run")]) == 0
    run, history = watched.run, watched.history
    tally, last = run.tally, history.picture
    assert last["decisions"] == tally.decisions == 120
    assert last["right"] / last["known"] == tally.accuracy == tally.confusion.trace() / 120
    assert sum(history.latency.values()) == run.timing.total.total
    assert last["class_right"] == tally.confusion.diagonal().tolist()
    assert [row[0] for row in last["latest"]] == list(range(108, 120))
    bundle, _ = load_bundle(SHIPPED / "fashion10.pans")
    assert last["word"]["patterns"] == list(range(bundle.n_patterns))
    assert sum(last["word"]["clicks"]) == last["latest"][-1][4]
    assert set(history.pixels) == {str(number) for number in range(bundle.n_patterns)}
    text = " ".join(row.text for row in rows_of(history))
    assert f"{100 * tally.accuracy:.1f}%" in text
    assert "start +0 us, length +0 us at most, allowed 30 us" in text
    assert f"{tally.clicks / 120:.2f} clicks, {tally.photons / 120:.2f} photons" in text


def test_a_walk_is_told_pattern_by_pattern(watched: Watched, tmp_path: Path) -> None:
    # the host names each state: what is taken is settled at once, so that a word and the latest decision are of one moment
    assert main(["demo", "--pace", "fast", "--drive", "host", "--seconds", "2", "--out", str(tmp_path / "run")]) == 0
    automaton = watched.run.plan.automaton
    assert len(watched.pictures) > 3
    for one in watched.pictures:
        word, node = one["word"], 0
        for pattern, click in zip(word["patterns"], word["clicks"]):
            assert automaton.pattern[node] == pattern
            node = automaton.successors[node][click]
        assert node >= automaton.n_states  # at a leaf
        assert sum(word["clicks"]) == one["latest"][-1][4]
    assert begin_facts(load_bundle(SHIPPED / "fashion-adaptive.pans")[0])["encoder"] == "automaton"


def test_without_a_terminal_there_are_plain_lines(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pans.runtime.monitor import monitor as module

    monkeypatch.setattr(module, "LINE_EVERY_S", 0.0)
    monkeypatch.setattr(module, "EVERY_S", 0.01)
    shown, pictures = Monitor(panel=False), deque(picture(float(k), decisions=k) for k in range(1, 10_000))
    facts = {"kind": "begin", "title": "a bundle on an instrument", "simulated": True, "expected": 500}
    with shown:
        assert shown._child is None
        shown.begin(None, None, facts)  # type: ignore[arg-type]
        shown._snapshots = SimpleNamespace(take=pictures.popleft)  # type: ignore[assignment]
        give_up_s = time.monotonic() + 30
        while len(pictures) > 9_990 and time.monotonic() < give_up_s:
            time.sleep(0.01)
    lines = capfd.readouterr().err.splitlines()
    figures = "1 of 500 decisions · 0.00 clicks each · p99 0.00 ms · late 0 · lost 0"
    assert lines[0] == f"SIMULATED · a bundle on an instrument: {figures}"
    assert len(lines) > 5


def test_a_panel_is_drawn_on_a_terminal_and_removed(tmp_path: Path) -> None:
    own, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 60, 130, 0, 0))
    words = [sys.executable, "-P", "-m", "pans.runtime.monitor.child", "--panel"]
    environment = os.environ | {"TERM": "xterm-256color"}
    child = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=theirs, text=True, env=environment
    )
    sums = {"decisions": 4, "known": 4, "right": 3, "objects": 4, "clicks": 8, "latest": [[3, 7, 0, 0.9, 2, 0, 0]]}
    classes = {"class_decided": [3, 1], "class_truth": [2, 2], "class_right": [2, 1]}
    begin = {"kind": "begin", "title": "a bundle on a device", "classes": ["shoe", "bag"], "deadline_us": 100.0}
    for message in (begin | {"expected": 10}, picture(3.0, **sums, **classes)):
        child.stdin.write(json.dumps(message) + "\n")
    child.stdin.close()
    assert child.wait(20) == 0
    os.close(theirs)
    shown = b""
    while piece := _rest(own):
        shown += piece
    for text in ("a bundle on a device", "accuracy", "75.0%", "shoe", "✓ 0 decisions", "4 of 10"):
        assert text in shown.decode()
    assert shown.rindex(b"\x1b[?25h") > shown.rindex(b"\x1b[?25l")  # the cursor is back


def _rest(handle: int) -> bytes:
    try:
        return os.read(handle, 1 << 16)
    except OSError:  # the other end is closed, and all is read
        return b""


def test_a_drawing_process_that_dies_ends_no_run(capfd: pytest.CaptureFixture[str]) -> None:
    shown = Monitor(panel=False, address="127.0.0.1:0", lines=False)
    with shown:
        with urllib.request.urlopen(shown.url, timeout=10) as answer:
            assert b"EventSource" in answer.read()
        shown._child.kill()
        shown._child.wait()
        assert shown._tell(picture(1.0) | {"fill": "x" * (1 << 20)}) is False
