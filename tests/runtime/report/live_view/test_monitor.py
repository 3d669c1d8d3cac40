"""The live view beside a run: pictures of it, their history in bounded memory, the terminal's panel and the plain lines."""

import fcntl
import io
import json
import os
import pty
import re
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

from pans.app.main import main
from pans.app.run import one_run
from pans.base import SHIPPED
from pans.base.numbers import FIGURES, Figure, Shown, wilson_interval
from pans.bundle.sensor.bundle import load_bundle
from pans.decide.dark.cusum import ChannelWatch
from pans.live.timing.ledger import LatencyHistogram, upper_edge
from pans.record.reading import read_recording
from pans.report.live_view import History, Monitor
from pans.report.live_view.alarms import Alarms
from pans.report.live_view.figures import headline, health, latest_rows, rows_of, title_of
from pans.report.live_view.history import BINS, LEVELS, SUMS, quantile_us
from pans.report.live_view.monitor import NOTE_CHARACTERS
from pans.report.live_view.snapshot import Snapshots

NUMBERS = (
    *(*SUMS, "abstained", "objects"),
    *("gaps", "late", "reconnects", "contradictions", "latency_max_us", "dark_exposures", "dark_clicks"),
    "clock_uncertainty_us",
)


def picture(elapsed_s: float, **more: Any) -> dict[str, Any]:
    facts = dict.fromkeys(NUMBERS, 0)
    texts = {
        "state": "running",
        "ended": "",
        "last_error": "",
        "clock_drift_ppm": None,
        "walk_light": None,
        "latest": [],
    }
    return {"kind": "picture", "elapsed_s": elapsed_s, "latency": [], **facts, **texts, **more}


def test_a_figure_of_the_table_may_have_a_row_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    new = Figure("abstained_share", "", name="abstentions", short="{:.0%}", shown=Shown.LIVE, live="abstained_share")
    monkeypatch.setitem(FIGURES, new.key, new)
    history = History()
    history.take(picture(1.0))
    assert "abstentions" not in [row.name for row in rows_of(history)]
    history.take(picture(2.0, abstained_share=0.25))
    assert ("abstentions", "25%", "") in rows_of(history)


def test_a_month_takes_the_memory_of_an_hour_and_sums_are_exact() -> None:
    history, n = History(), 40_000
    for step in range(1, n + 1):
        sums = {"decisions": 100 * step, "judged": 100 * step, "right": 80 * step, "late": step // 1000}
        history.take(picture(65.0 * step, **sums, latency=[[200 + step % 2, 100]]))
    for level, bins in history.bins.items():
        assert len(bins) <= BINS
        assert all(a.end_s == b.begin_s for a, b in zip(bins, list(bins)[1:]))
        assert all(one.end_s - one.begin_s <= max(level, 65.0) + 65.0 for one in bins)
        steps = round((bins[-1].end_s - bins[0].begin_s) / 65.0)
        assert bins[-1].end_s == 65.0 * n
        for name, more in (("decisions", 100 * steps), ("right", 80 * steps)):
            assert sum(one.sums[SUMS.index(name)] for one in bins) == more
        assert sum((one.latency for one in bins), Counter()).total() == 100 * steps
    assert history.bins[LEVELS[-1]][0].begin_s == 0  # a month is there as a whole
    assert history.latency == Counter({200: 50 * n, 201: 50 * n})


def test_an_alarm_has_a_beginning_an_end_and_a_cause() -> None:
    history, alarms = History(), Alarms()
    history.take({"kind": "begin", "deadline_us": 100.0})
    for k in range(1, 41):
        facts = {"state": "device lost" if 5 <= k < 8 else "running", "late": min(max(k - 9, 0), 4) + 2 * (k > 35)}
        facts |= {"dark_exposures": 10 * k, "dark_clicks": k, "decisions": 100 * k}
        facts |= {"dark_states": [["warning", 5.0, "dim", 290], ["alarm", 9.0, "hot", 255]]} if k >= 30 else {}
        facts |= {"events": [["note", "lamp \x1b[2J moved", None]]} if k == 20 else {}
        facts |= {"events": [["light_changed", "fell", 1850]]} if k == 22 else {}
        history.take(picture(float(k), **facts, last_error="blame: host: it slept" if k > 9 else ""))
        alarms.take(history)
    history.take(picture(41.0, ended="completed", late=6, last_error="", dark_exposures=400, decisions=4000))
    alarms.take(history)
    again = alarms.all.pop()
    assert (again.begin_s, again.end_s, again.cause) == (36, 36, "2 decisions")
    found = {one.name: one for one in alarms.all}
    assert len(found) == len(alarms.all)
    spans = {name: (one.begin_s, one.noticed_s, one.end_s, one.level) for name, one in found.items()}
    assert spans == {
        "state": (5, 5, 8, "bad"),
        "late": (10, 10, 13, "bad"),
        "note": (20, 20, 20, "note"),
        "light": (18.5, 22, 22, "warn"),
        "dark counts": (25.5, 30, None, "warn"),
    }
    assert found["dark counts"].cause == "dim; hot"
    assert found["late"].cause == "4 decisions; host: it slept"
    assert found["note"].cause == "lamp \\x1b[2J moved"


@pytest.mark.parametrize(
    ("facts", "levels", "words"),
    [
        ({}, ["good", "good", "note"], "takes at most"),
        ({"late": 3}, ["bad", "good", "note"], "3 decisions were late in the last minute"),
        ({"lost_exposures": 7, "gaps": 1}, ["good", "bad", "note"], "7 exposures were lost in the last minute"),
        ({"state": "device lost"}, ["good", "bad", "note"], "device lost"),
        (
            {
                "dark_clicks": 8,
                "dark_exposures": 400,
                "dark_expected": 0.001,
                "dark_states": [["alarm", 50.0, "hot", 9]],
            },
            ["good", "good", "bad"],
            "Dark counts 50 times the expected rate since it changed.",
        ),
        (
            {"dark_clicks": 8, "dark_exposures": 400, "dark_expected": 0.001, "dark_high": 0.001, "dark_changed": True},
            ["good", "good", "good"],
            "as expected again",
        ),
    ],
)
def test_health_is_a_sentence_with_a_number(facts: dict[str, Any], levels: list[str], words: str) -> None:
    history = History()
    history.take({"kind": "begin", "deadline_us": 100.0})
    history.take(picture(1.0, decisions=100, latency=[[50_000, 100]], **facts))
    found = health(history)
    assert [name for name, _, _ in found] == ["machine", "link", "detector"]
    assert [level for _, level, _ in found] == levels
    assert words.replace("takes", "took") in " ".join(text for _, _, text in found)


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
    assert history.accuracy({"judged": 500, "right": 400}) == (0.8, *wilson_interval(80, 100))
    assert history.accuracy({"judged": 500, "right": 400}, objects=20) == (0.8, *wilson_interval(16, 20))
    assert np.isnan(history.accuracy({"judged": 0})).all()


def test_what_is_wrong_is_marked_and_in_words() -> None:
    history = History()
    history.take({"kind": "begin", "deadline_us": 1000.0, "classes": ["a\x1b[2J", "b"], "expected": 100})
    late = picture(10.0, decisions=100, decided=60, judged=50, right=25, objects=50, late=3, lost_exposures=7, gaps=2)
    late |= {"abstained": 40, "decisions_clicks": 900, "decided_clicks": 300, "judged_clicks": 100}
    late |= {"disk_free_bytes": 1 << 20, "disk_left_s": 10, "latency": [[1_700_000, 100]], "latency_max_us": 1650.0}
    late |= {"latest": [[49, 3, 0, 0.5, 2, 1, 0]]}
    history.take(late | {"last_error": "lost\n\x1b[31m", "dark_exposures": 100, "dark_clicks": 3})
    rows = {row.name: row for row in rows_of(history)}
    assert rows["late"].level == rows["lost"].level == rows["disk"].level == rows["latency"].level == "bad"
    assert rows["lost"].text == "7 exposures in 2 gaps"
    history.begin["late_allowed"] = 0.03
    assert next(row.level for row in rows_of(history) if row.name == "late") == "note"
    of = "of the 50 decisions with a label and a known true class"
    assert rows["accuracy"].text.startswith(f"50.0% {of}, 95 % interval 36.6% to 63.4%")
    assert rows["light per decision"].text == f"2.00 clicks, photons unknown; {of}"
    assert rows["latency"].text.startswith("p50 1,650 us, p99 1,650 us, longest 1,650 us;")  # no quantile above it
    assert "0.03 per exposure" in rows["dark counts"].text
    assert not any("\x1b" in row.text or "\n" in row.text for row in rows.values())
    assert latest_rows(history)[0]["level"] == "bad"
    assert latest_rows(history)[0]["decision"] == "a\\x1b[2J"
    said = f"100 of 100 decisions, 40 abstained · accuracy 50.0% · 2.00 clicks each ({of}) · p99 1.65 ms"
    assert headline(history) == f"{said} · late 3 · lost 7"


def test_latencies_are_told_of_enough_decisions_in_real_time_alone() -> None:
    told = {}
    for n, more in ((99, {}), (100, {}), (100, {"virtual_time": True})):
        history = History()
        history.take({"kind": "begin", "deadline_us": 1e6})
        history.take(picture(1.0, decisions=n, decided=n, latency=[[50_000, n]], latency_max_us=50.0, **more))
        rows = {row.name: row.text for row in rows_of(history)}
        told[n, bool(more)] = rows.get("latency"), "p99" in headline(history), health(history)[0][2]
    assert told[99, False] == ("p50 50 us, longest 50 us", False, "No decision was late in the last 60 s.")
    assert told[100, False][0] == "p50 50 us, p99 50 us, longest 50 us; p99 takes 0% of 1,000,000 us"
    assert told[100, False][1]
    assert told[100, True] == (None, False, "Time is virtual: latencies are not measured.")


def test_a_device_behind_a_socket_says_that_it_is_simulated() -> None:
    history = History()
    history.take({"kind": "begin", "title": "a bundle on a device", "simulated": False})
    history.take(picture(1.0, simulated=True))
    assert title_of(history) == "SIMULATED · a bundle on a device"


@pytest.mark.parametrize(
    ("told", "words", "level"),
    [
        ((), "not told by the device", "note"),
        ((1.5, -1.5), "start +1.5 us, length -1.5 us at most, allowed 1.5 us", "good"),
        ((0.0, -1.6), "length -1.6 us", "bad"),
    ],
)
def test_exposures_off_the_plan_are_marked(told: tuple[float, ...], words: str, level: str) -> None:
    history = History()
    history.take({"kind": "begin", "exposure_tolerance_us": 1.5})
    history.take(picture(1.0, **dict(zip(("exposure_start_us", "exposure_length_us"), told))))
    row = next(row for row in rows_of(history) if row.name == "exposures")
    assert words in row.text
    assert row.level == level


@pytest.mark.parametrize(
    ("clicks", "exposures", "words", "level"),
    [
        (2, 1000, "higher than expected, not yet sure (alarm after about", "note"),
        # 1.96**2 / (5 + 1.96**2) of 5 may click
        (0, 5, "too few to judge: only a mean above 1.55e+04 times", ""),
        (6, 200_000, "as expected, a mean above 2.34 times", "good"),
    ],
)
def test_dark_counts_are_as_expected_only_where_a_rise_would_have_been_seen(
    clicks: int, exposures: int, words: str, level: str
) -> None:
    watch = ChannelWatch(1, np.array([2.8e-5]))
    dark = np.zeros((exposures, 1), np.uint8)
    dark[:clicks] = 1
    watch.update_words(dark)
    history = History()
    history.take({"kind": "begin"})
    seen = {"dark_exposures": exposures, "dark_clicks": clicks, "dark_expected": 2.8e-5, "dark_high": 2.8e-5}
    history.take(picture(1.0, **seen, dark_low=2.8e-5, dark_alarm_after=watch.alarm_after()))
    row = next(row for row in rows_of(history) if row.name == "dark counts")
    assert words in row.text
    assert (row.level, "as expected" in row.text) == (level, level == "good")
    assert re.split(r" \(|, a mean|:", words)[0] in health(history)[2][2]
    assert ("dark counts" in headline(history)) == (level == "note")


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

    def begin(self, facts: dict[str, Any], stop: Any) -> None:
        self._stop = stop
        self.history, self.pictures = History(), list[dict[str, Any]]()
        self.history.take(json.loads(json.dumps(facts)))

    def prepared(self, run: Any, bundle: Any, look: Any) -> None:
        self.run = self._run = run
        self.snapshots = Snapshots(run, bundle, self._latest, look, words=True)

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
    tally, last = run.accounts.tally, history.picture
    assert last["decisions"] == tally.decisions == 120
    assert last["right"] / last["judged"] == tally.figures().accuracy == tally.confusion.trace() / 120
    assert sum(history.latency.values()) == run.accounts.timing.total.total
    assert [row[0] for row in last["latest"]] == list(range(108, 120))
    bundle, _ = load_bundle(SHIPPED / "fashion10.pans")
    word = last["word"]
    assert word["patterns"] == list(range(bundle.n_patterns))
    assert word["decision"] == last["latest"][-1]
    assert sum(word["clicks"]) == word["decision"][4]
    assert max(word["posterior"]) == pytest.approx(word["decision"][3], abs=1e-3)
    assert int(np.argmax(word["posterior"])) == word["decision"][2]
    assert set(history.pixels) == {str(number) for number in range(bundle.n_patterns)}
    text = " ".join(row.text for row in rows_of(history))
    assert f"{100 * tally.figures().accuracy:.1f}%" in text
    assert "start +0 us, length +0 us at most, allowed 30 us" in text
    light = tally.of["judged"]
    assert f"{light.clicks / 120:.2f} clicks, {light.photons / 120:.2f} photons" in text
    assert (last["simulated"], last["virtual_time"]) == (True, True)


@pytest.mark.parametrize("drive", ["device", "host"])
def test_a_walk_is_told_beside_its_own_decision(watched: Watched, drive: str, tmp_path: Path) -> None:
    assert main(["demo", "--pace", "fast", "--drive", drive, "--seconds", "4", "--out", str(tmp_path / "run")]) == 0
    automaton, found = watched.run.job.plan.automaton, 0
    rows = {int(row["index"]): row for row in read_recording(tmp_path / "run" / "run.pansrec").decisions()}
    for one in watched.pictures:
        if "word" not in one:
            continue
        found += 1
        word, node = one["word"], 0
        number, _, label, probability, clicks, *_ = word["decision"]
        for pattern, click in zip(word["patterns"], word["clicks"]):
            assert automaton.pattern[node] == pattern
            node = automaton.successors[node][click]
        assert node >= automaton.n_states  # at a leaf, the decision's own
        assert int(automaton.posteriors[node].argmax()) == label
        assert max(word["posterior"]) == pytest.approx(probability, abs=1e-3)
        assert sum(word["clicks"]) == clicks == rows[number]["clicks"]
        assert len(word["clicks"]) == rows[number]["exposures"]
    assert found > 0


def test_what_is_asked_for_on_the_page_is_done_and_recorded(watched: Watched, tmp_path: Path) -> None:
    asked = [{"note": "lamp\x1b moved " + "x" * 300}, {"note": " "}, {"stop": "yes"}]

    class Asked(Watched):
        def watch(self, run: Any, output: Any) -> None:
            if run.accounts.tally.decisions >= 20 and asked:
                self._listen(io.StringIO("".join(json.dumps(one) + "\n" for one in asked)))
                asked.clear()
            elif run.accounts.tally.decisions >= 40:
                self._listen(io.StringIO('{"stop": true}\n'))
            super().watch(run, output)

    watched.__class__ = Asked
    assert main([*fixed_run(600), "--out", str(tmp_path / "run")]) == 130
    notes = [one for one in read_recording(tmp_path / "run" / "run.pansrec").events() if one["kind"] == "note"]
    assert [one["text"][:14] for one in notes[:2]] == ["lamp\\x1b moved", "stop was press"]
    assert len(notes[0]["text"]) == NOTE_CHARACTERS
    assert 0 < notes[0]["tick"] < notes[1]["tick"]
    assert watched.run.ended == "interrupted"


@pytest.mark.parametrize("words", ["--serve-control", "--serve 0.0.0.0:0 --serve-public --serve-control"])
def test_controls_are_for_this_machine(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*fixed_run(3), *words.split()]) == 2
    assert "--serve-control" in capsys.readouterr().err


def test_without_a_terminal_there_are_plain_lines(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pans.report.live_view import monitor as module

    monkeypatch.setattr(module, "LINE_EVERY_S", 0.0)
    monkeypatch.setattr(module, "EVERY_S", 0.01)
    shown, pictures = Monitor(panel=False), deque(picture(float(k), decisions=k, decided=k) for k in range(1, 10_000))
    facts = {"kind": "begin", "title": "a bundle on an instrument", "simulated": True, "expected": 500}
    with shown:
        assert shown._child is None
        shown.begin(facts, None)  # type: ignore[arg-type]
        shown._snapshots = SimpleNamespace(take=pictures.popleft)  # type: ignore[assignment]
        give_up_s = time.monotonic() + 30
        while len(pictures) > 9_990 and time.monotonic() < give_up_s:
            time.sleep(0.01)
    lines = capfd.readouterr().err.splitlines()
    figures = "1 of 500 decisions · 0.00 clicks each · late 0 · lost 0"
    assert lines[0] == f"SIMULATED · a bundle on an instrument: {figures}"
    assert len(lines) > 5


def test_a_panel_is_drawn_on_a_terminal_and_removed(tmp_path: Path) -> None:
    own, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 60, 130, 0, 0))
    words = [sys.executable, "-P", "-m", "pans.report.live_view.child", "--panel"]
    environment = os.environ | {"TERM": "xterm-256color"}
    child = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=theirs, text=True, env=environment
    )
    sums = {"decisions": 4, "decided": 4, "judged": 4, "right": 3, "objects": 4, "latest": [[3, 7, 0, 0.9, 2, 0, 0]]}
    begin = {"kind": "begin", "title": "a bundle on a device", "classes": ["shoe", "bag"], "deadline_us": 100.0}
    for message in (begin | {"expected": 10}, picture(3.0, **sums)):
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


def test_the_process_that_draws_loads_little_before_it_names_its_port() -> None:
    loads = "import sys, pans.report.live_view.child; print({'numpy', 'bokeh', 'numba', 'asyncio'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", loads], capture_output=True, text=True).stdout == "set()\n"


def test_a_drawing_process_that_dies_ends_no_run(capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("bokeh", reason="needs the ui extra")
    shown = Monitor(panel=False, address="127.0.0.1:0", lines=False)
    with shown:
        with urllib.request.urlopen(shown.url, timeout=60) as answer:
            assert b"bokeh" in answer.read()
        shown._child.kill()
        shown._child.wait()
        assert shown._tell(picture(1.0) | {"fill": "x" * (1 << 20)}) is False
