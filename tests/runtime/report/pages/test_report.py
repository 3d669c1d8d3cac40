"""Report pages: self-contained, and every figure on them that of the recording."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from browser import browser, clipped, console, look, picture, serious, unreachable
from commands import Pans, fixed_run, page_of, words_of

from pans.app.main import main
from pans.base.numbers.intervals import wilson_interval
from pans.bundle.sensor.bundle import load_bundle, write_bundle
from pans.decide.decision import DECISION_DTYPE
from pans.protocol.wire import DARK_PATTERN
from pans.record.reading import read_recording
from pans.record.reading.decision_log import skim_decisions
from pans.record.reading.exposures import click_list, iter_exposures
from pans.record.reading.format import TIMING_DTYPE
from pans.record.reading.sent_plan import recorded_plan
from pans.report.pages.charts import Axis, Curve, chart
from pans.report.pages.index import accuracy_over
from pans.report.pages.page import sentence_of
from pans.report.pages.rates import BINS, TOLD_APART, Rates, Stretches
from pans.report.pages.run import PHASES, Decisions, advice_on, is_virtual, ledger_of, survival

pytest.importorskip("matplotlib", reason="needs the plot extra")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "one"
    assert main([*fixed_run(200), "--out", str(folder)]) == 0
    return folder / "run.pansrec"


def test_a_recording_s_page(demo: Path, tmp_path: Path) -> None:
    page = page_of(demo, tmp_path)
    words = words_of(page)
    summary = read_recording(demo).summary
    assert "SIMULATED" in words
    for text in (f"{summary['accuracy']:.2%}", *(f"{summary[k]:.3f}" for k in ("clicks_mean", "photons_mean"))):
        assert text in words
    low, high = (float(end) for end in re.findall(r"95 % interval ([\d.]+)% to ([\d.]+)%", words)[0])
    error = (
        100 * 1.959964 * summary["accuracy_stderr_objects"]
    )  # of 200 objects, where Wilson's interval is nearly the usual one
    assert (high - low) / 2 == pytest.approx(error, rel=0.02)
    assert low < 100 * summary["accuracy"] < high
    assert summary["decisions_sha256"] in words
    assert "All 200 decisions were made (how fast is not measured in virtual time), no exposure was lost" in words
    for section in (
        "Accuracy over time",
        "Decisions by class",
        "Patterns, and what",
        "Clicks over time",
        "Dark counts",
    ):
        assert section in words
    assert "Latency" not in words  # in virtual time
    assert len(page) < 1_000_000
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*"|url\((?!#)|<script|@import', page) == []
    assert "docs/" not in words.replace(read_recording(demo).header["command"], "")  # which is that of these tests


def test_the_confusion_on_the_page_is_that_of_the_decisions(demo: Path, tmp_path: Path) -> None:
    rows = read_recording(demo).decisions()
    (table,) = re.findall(r'<table class="confusion">.*?</table>', page_of(demo, tmp_path), re.DOTALL)
    cells = [int(text or 0) for text in re.findall(r"<td[^>]*>(\d*)</td>", table)]
    expected = np.zeros((10, 10), int)
    np.add.at(expected, (rows["truth"], rows["label"]), 1)
    assert cells == expected.ravel().tolist()


def test_sums_over_a_run_of_any_length_hold_everything_once() -> None:
    rng = np.random.default_rng(1)
    numbers = np.sort(rng.integers(0, 70_000, 9000))
    found = Stretches(wide=(3,), things=(TOLD_APART,))
    for part in np.array_split(numbers, 50):
        found.add("n", part)
        np.add.at(found.sums["wide"], found.at(part), [1.0, 0.0, 2.0])
        found.tell_apart("things", part, part // 10)
    wanted = np.bincount(numbers // found.width, minlength=BINS)
    assert found.width == 1024  # the first power of two that holds them
    assert found.sums["n"].tolist() == wanted.tolist() == found.sums["wide"][:, 0].tolist()
    for sums in (found, found.merged(20)):
        different = [len({*(numbers[numbers // sums.width == one] // 10).tolist()}) for one in range(sums.used)]
        assert np.count_nonzero(sums.sums["things"][: sums.used], axis=1).tolist() == different
    few = found.merged(20)
    assert (few.width, few.used) == (4096, 18)
    assert few.sums["n"].sum() == 9000
    assert few.sums["n"][2] == ((numbers // 4096) == 2).sum()


def test_accuracy_over_time_counts_objects_once() -> None:
    rows = np.zeros(300, DECISION_DTYPE)
    rows["index"], rows["object"], rows["tick"] = np.arange(300), np.arange(300) // 3, 1000 + 10 * np.arange(300)
    rows["truth"] = np.where(np.arange(300) < 30, -1, 1)
    rows["label"] = np.where(np.arange(300) < 166, 0, 1)
    found = Decisions({"tick_hz": 100.0}, 300, ("a", "b"))
    for part in (rows[:7], rows[7:120], rows[120:]):
        found.take(part)
    assert (found.judged, found.right) == (270, 134)
    assert found.confusion.tolist() == [[0, 0], [136, 134]]
    over = found.accuracy()
    assert over is not None
    assert over["mean"] == pytest.approx(134 / 270)
    assert [found.when(number) for number in (-1, 300)] == [None, None]
    assert found.when(100) == pytest.approx(10.0, abs=0.2)  # 10 ticks of 10 ms each
    assert 0 < over["objects"][0] <= over["objects"][1] <= 43  # of 128 decisions in a stretch at most
    assert accuracy_over([]) == []


def test_what_a_click_means_is_counted_by_true_class(demo: Path) -> None:
    recording = read_recording(demo)
    plan = recorded_plan(recording)
    rates, clicks = Rates(plan, 10), click_list(recording, plan)
    for item in iter_exposures(recording, plan):
        rates.take(item)
    truth = {int(row["object"]): int(row["truth"]) for row in recording.decisions()}
    lit = clicks.pattern < plan.n_patterns
    expected = np.zeros((plan.n_patterns, 10))
    for pattern, number in zip(clicks.pattern[lit], clicks.object[lit]):
        expected[pattern, truth[int(number)]] += 1
    assert rates.class_clicks.tolist() == expected.tolist()
    assert (rates.class_exposures.sum(axis=1) == recording.n_decisions).all()
    dark = rates.dark()
    assert dark is not None
    assert dark[:2] == (int((~lit).sum()), int(rates.over.sums["dark exposures"].sum()))
    assert dark[2:] == wilson_interval(*dark[:2])


def test_a_rise_of_the_dark_counts_is_told_with_its_begin_and_its_own_rate(tmp_path: Path, pans: Pans) -> None:
    words = [*fixed_run(150), "--dark-slots", "4", "--out", str(tmp_path / "run")]
    words = [word.replace("seed=1", "seed=1&changes=dark:at_s=20:factor=3000") for word in words]
    told = pans(*words, code=None)
    recording = read_recording(tmp_path / "run" / "run.pansrec")
    (event,) = (one for one in recording.events() if one["kind"] == "dark_state")
    plan, config = recorded_plan(recording), recording.header["config"]
    dark = np.concatenate([one.start_tick[one.pattern == DARK_PATTERN] for one in iter_exposures(recording, plan)])
    edges = dark[event["since_dark_exposure"]], dark[event["dark_exposure"] - 1]
    begun, noticed = ((edge - dark[0]) / config["tick_hz"] for edge in edges)
    assert 18 < begun < 22
    phases: dict[str, list[int]] = {}
    shown = " ".join(words_of(page_of(recording.path, tmp_path)).split())
    (found,) = re.findall(
        r"began about ([\d.]+) s .*? noticed at ([\d.]+) s, with ([\d.]+) clicks per dark exposure", shown
    )
    assert [float(one) for one in found] == pytest.approx([begun, noticed, event["rate"]], rel=0.02)
    assert event["rate"] > 2 * told["dark"]["clicks"] / told["dark"]["exposures"]  # of the whole run
    assert f"{told['dark']['exposures']} dark exposures of the whole run" in shown
    for row in recording.decisions():
        (name,) = (
            name
            for name, low, high in zip(PHASES, (0, *edges), (*edges, np.inf), strict=False)
            if low <= row["tick"] < high
        )
        counts = phases.setdefault(name, [0, 0])
        counts[0] += 1
        counts[1] += int(row["label"] == row["truth"])
    assert len(phases) == 3
    for name, (n, right) in phases.items():
        assert f"{name} {n} 0 {right} of {n} {100 * right / n:.1f} % (" in shown
    low, high = wilson_interval(phases[PHASES[0]][1], phases[PHASES[0]][0])  # each object once
    assert f"({100 * low:.1f} to {100 * high:.1f} %, {phases[PHASES[0]][0]} objects)" in shown
    assert f"{phases[PHASES[1]][0]} decisions were made before it was noticed" in shown
    pans("report", tmp_path, "-o", tmp_path / "runs.html")
    listed = words_of((tmp_path / "runs.html").read_text())
    assert all(words in listed for words in (*told["faults"], f"expected {told['dark']['expected']:.3g}"))


def test_advice_fits_the_most_frequent_cause_of_late_decisions() -> None:
    for cause, words in {"host": "--core", "disk": "another disk", "link": "cable"}.items():
        assert words in advice_on(f"7 decisions later than 16 ms (cause: {cause} 6, not certain; decode 1)")


def test_latencies_of_very_many_are_those_of_all() -> None:
    rows = np.zeros(30_000, TIMING_DTYPE)
    rows["decided_ns"] = np.random.default_rng(1).lognormal(11, 1, len(rows)).astype(np.int64)
    found = ledger_of(np.split(rows, 30))
    us = np.sort(rows["decided_ns"]) / 1000
    times, share = survival(found.total)
    assert times[-1] == us[-1]
    assert found.total.summary()["p50"] == pytest.approx(np.quantile(us, 0.5), rel=0.033)
    wanted = [(us >= time / 1.033).mean() for time in times]
    assert (share <= np.array(wanted) + 1e-12).all()
    assert not is_virtual(found)


def test_events_become_sentences_and_foreign_ones_stay_whole() -> None:
    late = sentence_of({"kind": "late", "decision": 7, "latency_us": 23456.0})
    assert late.startswith("Decision 7 ")
    assert "23,456 us" in late
    assert sentence_of({"kind": "strange_thing", "x": "{y}"}) == "strange thing: x {y}"
    part = {"kind": "part", "number": 7, "first_decision": 12, "deleted": {"parts": 3}, "place": {"heard": "AAAA"}}
    assert sentence_of(part) == "Part 7 begins with decision 12; parts deleted by then: 3."
    blame = {"kind": "blame", "what": "missing", "exposures": 40, "cause": "device", "sure": False, "why": "a drop"}
    found = sentence_of(blame | {"first_exposure": 77})
    assert all(word in found for word in ("40", "77", "device, not certain", "a drop"))


def test_a_curve_of_many_points_is_small_and_keeps_its_outliers() -> None:
    y = np.zeros(100_000)
    y[[700, 61_725]] = 50.0, -30.0
    drawn = str(chart("many", Axis("x", 0.0, 100_000.0), Axis("y", -50.0, 50.0), curves=[Curve(np.arange(100_000), y)]))
    assert len(drawn) < 20_000
    (path,) = re.findall(r'<path d="([^"]+)"[^>]*stroke: var\(--a\)', drawn)
    heights = np.array(re.findall(r"[ML] [\d.]+ ([\d.]+)", path), float)
    above, below = np.median(heights) - heights.min(), heights.max() - np.median(heights)
    assert above / below == pytest.approx(50 / 30, rel=0.01)


def test_a_chart_follows_the_page_s_colours_and_says_what_it_shows() -> None:
    axis = Axis("x", 0.0, 1.0)
    drawn = str(chart("what <it> shows", axis, axis, heat=np.array([[0.0, np.nan], [1.0, 0.5]])))
    assert 'role="img" aria-label="what &lt;it&gt; shows"' in drawn
    assert re.findall(r"#fe01|<style|<metadata| id=\"axes", drawn) == []
    assert "var(--soft)" in drawn


def test_pages_in_a_browser(demo: Path, tmp_path: Path) -> None:
    page_of(demo, tmp_path)
    for what, name in ((demo.parents[1], "runs"), ("fashion-adaptive", "bundle")):
        assert main(["report", str(what), "-o", str(tmp_path / f"{name}.html")]) == 0
    with browser(tmp_path) as driver:
        for name in ("page", "runs", "bundle"):
            driver.get((tmp_path / f"{name}.html").as_uri())
            for width, dark in ((1400, False), (390, True)):
                look(driver, width, dark=dark)
                picture(driver, tmp_path / f"{name}-{width}.png")
                assert clipped(driver) == []
                assert serious(driver) == []
                assert unreachable(driver) == []
            assert console(driver) == []


def test_a_folder_of_runs_has_a_line_and_a_picture_each(demo: Path, tmp_path: Path, pans: Pans) -> None:
    for number in range(3):
        (tmp_path / f"run <{number}>").mkdir()
        (tmp_path / f"run <{number}>" / "run.pansrec").write_bytes(demo.read_bytes())
    (tmp_path / "run <1>" / "run.pansrec").write_bytes(demo.read_bytes()[:-5000])  # cut
    assert pans("report", tmp_path, "-o", tmp_path / "all.html")["kind"] == "runs"
    page, summary = (tmp_path / "all.html").read_text(), read_recording(demo).summary
    words = words_of(page)
    assert words.count(f"{100 * summary['accuracy']:.2f} %") == 2
    assert ("cut" in words, page.count('<td class="spark"><svg')) == (True, 3)
    (tmp_path / "run <2>" / "summary.md").write_text("")
    assert pans("report", tmp_path, "-o", tmp_path / "all.html", "--force")["kind"] == "runs"
    page = (tmp_path / "all.html").read_text()
    links = re.findall(r'href="(run[^"]*)"', page)
    assert sorted(links) == ["run%20%3C0%3E", "run%20%3C1%3E", "run%20%3C2%3E/summary.md"]
    assert "accuracy of 2 runs" in page
    low, high = wilson_interval(summary["accuracy"] * 200, 200)
    assert f"{100 * low:.1f} to {100 * high:.1f} %" in words
    rows = read_recording(demo).decisions()
    right = accuracy_over([demo])
    assert np.average(right, weights=[len(p) for p in np.array_split(rows, len(right))]) == pytest.approx(
        summary["accuracy"]
    )
    size = demo.stat().st_size
    for most, read in ((size - 1, 0), (2 * size - 1, 0), (2 * size, 2 * len(rows))):  # of all files together
        paths = [demo] if most < size else [demo, demo]
        assert sum(map(len, skim_decisions(paths, most))) == read
    (tmp_path / "empty").mkdir()
    assert "no runs" in pans.refuses("report", tmp_path / "empty", "-o", tmp_path / "none.html")


def test_a_bundle_s_page(demo: Path, tmp_path: Path) -> None:
    bundle = read_recording(demo).bundle()
    digest = write_bundle(bundle, tmp_path / "a.pans")
    page = page_of(tmp_path / "a.pans", tmp_path)
    assert digest in words_of(page)
    assert page.count("data:image/png") == bundle.n_patterns
    assert load_bundle(tmp_path / "a.pans")[0].name in page


def test_an_automaton_s_page(tmp_path: Path) -> None:
    write_bundle(automaton_bundle(random_automaton(2, slots=6, patterns=9)), tmp_path / "a.pans")
    words = words_of(page_of(tmp_path / "a.pans", tmp_path))
    facts: Any = ("exposures_longest", "states_of_most_used_patterns", "leaf_probability_median", "Automaton")
    for text in (*facts, "Every walk begins in state 0", "click: ", "no click: "):
        assert text in words
