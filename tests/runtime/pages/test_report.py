"""Report pages: self-contained, escaped, and every figure on them that of the recording."""

import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from browser import browser, clipped, console, look, picture, serious, unreachable
from commands import fixed_run, page_of, words_of

from pans.runtime.bundle.model import load_bundle, write_bundle
from pans.runtime.cli import main
from pans.runtime.core.decision import DECISION_DTYPE
from pans.runtime.intervals import wilson_interval
from pans.runtime.pages.charts import POINTS_MAX, Axis, Curve, _thinned
from pans.runtime.pages.events import sentence_of
from pans.runtime.pages.pixels import heat_png
from pans.runtime.pages.rates import count_rates
from pans.runtime.pages.results import accuracy_bins, sum_decisions
from pans.runtime.pages.timing import CLOCK_MAX, EXACT_MAX, Durations, _probes
from pans.runtime.record import read_recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.timing.clock import CLOCK_DTYPE


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    assert main([*fixed_run(200), "--out", str(folder)]) == 0
    return folder / "run.pansrec"


def test_a_recording_s_page(demo: Path, tmp_path: Path) -> None:
    page = page_of(demo, tmp_path)
    words = words_of(page)
    summary = read_recording(demo).summary
    assert "SIMULATED" in words
    for text in (f"{100 * summary['accuracy']:.2f} %", *(f"{summary[k]:.3f}" for k in ("clicks_mean", "photons_mean"))):
        assert text in words
    error = 1.959964 * summary["accuracy_stderr_objects"]
    ends = [100 * (summary["accuracy"] + sign * error) for sign in (-1, 1)]
    assert f"95 % interval {ends[0]:.2f} to {ends[1]:.2f} %" in words
    assert summary["decisions_sha256"] in words
    assert "All 200 decisions were made within 16.667 ms, no exposure was lost" in words
    sections = ("Accuracy over time", "Decisions by class", "Patterns, and what a click on each means", "Latency")
    for section in (*sections, "Clicks over time", "Dark counts", "Clock", "Events", "What was run"):
        assert f"<h2>{section}</h2>" in page
    assert len(page) < 1_000_000
    outside = re.findall(r'(?:src|href)="(?!data:)[^"]*"|url\(|<script|@import', page)
    assert outside == []


def test_the_confusion_on_the_page_is_that_of_the_decisions(demo: Path, tmp_path: Path) -> None:
    rows = read_recording(demo).decisions()
    (table,) = re.findall(r'<table class="confusion">.*?</table>', page_of(demo, tmp_path), re.DOTALL)
    cells = [int(text or 0) for text in re.findall(r"<td[^>]*>(\d*)</td>", table)]
    expected = np.zeros((10, 10), int)
    np.add.at(expected, (rows["truth"], rows["label"]), 1)
    assert cells == expected.ravel().tolist()


def test_stretches_of_the_accuracy_hold_every_decision_once() -> None:
    rows = np.zeros(300, DECISION_DTYPE)
    rows["object"], rows["tick"] = np.arange(300) // 3, 1000 + 10 * np.arange(300)
    rows["truth"] = np.where(np.arange(300) < 30, -1, 1)
    rows["label"] = np.where(np.arange(300) < 166, 0, 1)
    blocks = [rows[:7], rows[7:120], rows[120:]]
    sums = sum_decisions(lambda: blocks, 2)
    bins = accuracy_bins(lambda: blocks, sums, 100.0)
    assert (sums.known, sums.right, sums.objects) == (270, 134, 90)
    assert sums.confusion.tolist() == [[0, 0], [136, 134]]
    assert bins.objects.tolist() == [23, 24, 23, 23]
    assert bins.accuracy[[0, 1, 3]].tolist() == [0.0, 0.0, 1.0]
    assert bins.low[3] == wilson_interval(23, 23)[0]
    assert (bins.low <= bins.accuracy).all()
    assert (bins.accuracy <= bins.high).all()
    assert 0 < bins.seconds[0] < bins.seconds[-1] < 30.0


def test_what_a_click_means_is_counted_by_true_class(demo: Path) -> None:
    recording = read_recording(demo)
    plan = recorded_plan(recording)
    rates, clicks = count_rates(recording, plan, 10), click_list(recording, plan)
    truth = {int(row["object"]): int(row["truth"]) for row in recording.decisions()}
    lit = clicks.pattern < plan.n_patterns
    expected = np.zeros((plan.n_patterns, 10))
    for pattern, number in zip(clicks.pattern[lit], clicks.object[lit]):
        expected[pattern, truth[int(number)]] += 1
    assert rates.class_clicks.tolist() == expected.tolist()
    assert (rates.class_exposures.sum(axis=1) == recording.n_decisions).all()


def test_the_curve_of_very_many_keeps_the_longest_ones_and_no_others() -> None:
    values = np.random.default_rng(1).lognormal(4, 1, 3 * EXACT_MAX)
    found = Durations()
    for part in np.split(values, 96):
        found.add(part)
    times, share = found.survival()
    np.testing.assert_array_equal(times[-100:], np.sort(values)[-np.round(share[-100:] * len(values)).astype(int)])
    ordered = np.sort(values)[::-1]
    wanted = ordered[np.round(share * len(values)).astype(int) - 1]
    assert (np.abs(times / wanted - 1) < 0.033)[wanted > 1].all()
    assert found.quantiles(0.5)[0] == pytest.approx(np.quantile(values, 0.5), rel=0.033)
    assert sum(map(len, found._kept)) <= EXACT_MAX


def test_events_become_sentences_and_foreign_ones_stay_whole() -> None:
    late = sentence_of({"kind": "late", "decision": 7, "latency_us": 23456.0})
    assert late.startswith("Decision 7 ")
    assert "23,456 us" in late
    assert sentence_of({"kind": "strange_thing", "x": "{y}"}) == "strange thing: x {y}"
    blame = {"kind": "blame", "what": "missing", "exposures": 40, "cause": "device", "sure": False, "why": "a drop"}
    assert all(word in sentence_of(blame) for word in ("40", "device", "a drop"))


def test_a_curve_of_many_points_keeps_its_outliers() -> None:
    y = np.zeros(20_000)
    y[[7, 12_345]] = 50.0, -30.0
    y[:5] = np.nan
    x, found, low, _ = _thinned(Curve(np.arange(20_000), y, low=y - 1))
    assert low is not None
    assert len(found) <= POINTS_MAX
    assert (np.nanmax(found), np.nanmin(found)) == (50.0, -30.0)
    assert x[[found.argmax(), found.argmin()]].tolist() == [7, 12_345]
    assert (low == found - 1).all()
    assert (np.diff(x) > 0).all()


def test_probes_of_a_long_run_are_bounded_and_keep_the_worst() -> None:
    n = 5 * CLOCK_MAX
    samples = np.zeros(n, CLOCK_DTYPE)
    samples["tick"], samples["host_ns"] = 1000 * np.arange(n), 1_000_000 * np.arange(n)
    samples["host_ns"][n // 3] += 700_000
    blocks = np.split(samples, 40)
    told: Any = SimpleNamespace(header={"config": {"tick_hz": 1_000_000}}, iter_clock_samples=lambda: iter(blocks))
    kept, count = _probes(told)
    assert count == n
    assert len(kept) <= 2 * CLOCK_MAX + n // 40
    assert samples[n // 3] in kept
    assert (np.diff(kept["tick"].astype(np.int64)) > 0).all()
    assert (kept[[0, -1]] == samples[[0, -1]]).all()


def test_ticks_are_round_inside_and_few() -> None:
    for low, high in ((0.0, 45.5), (-3.2, 3.2), (0.0, 1.0), (0.0, 7e-4), (0.0, 0.0)):
        for most in (3, 5, 8):
            ticks = Axis("", low, high).ticks(most)
            assert 1 <= len(ticks) <= most + 2
            assert all(low - 1e-9 <= tick <= high + 1e-9 for tick in ticks)
    assert Axis("", 0.0, 45.5).ticks(3) == [0.0, 20.0, 40.0]
    assert Axis("", 1.0, 3e5, log=True).ticks(8) == [1.0, 10.0, 100.0, 1e3, 1e4, 1e5]


def test_numbers_become_darker_shades_and_nan_is_transparent() -> None:
    image = pytest.importorskip("PIL.Image", reason="needs Pillow")
    heat = np.asarray(image.open(io.BytesIO(heat_png([[0.0, np.nan, 2.0]], 0.0, 2.0))).convert("RGBA"))
    assert heat[0, 1, 3] == 0
    assert heat[0, [0, 2], 3].tolist() == [255, 255]
    assert heat[0, 0, :3].sum() > heat[0, 2, :3].sum()


@pytest.mark.parametrize("dark", [False, True])
def test_the_page_in_a_browser(demo: Path, tmp_path: Path, dark: bool) -> None:
    place = tmp_path / "page.html"
    page_of(demo, tmp_path)
    with browser(tmp_path) as driver:
        look(driver, 1280, dark=dark)
        driver.get(place.as_uri())
        for width, form in ((1280, "wide"), (390, "narrow")):
            look(driver, width, dark=dark)
            picture(driver, tmp_path / f"page-{width}.png")
            assert clipped(driver) == []
            shown = (
                "return [...document.querySelectorAll('figure > div')].filter(e => e.offsetWidth).map(e => e.className)"
            )
            assert set(driver.execute_script(shown)) == {form, "scroll"}
            assert serious(driver) == []
            assert unreachable(driver) == []
        assert console(driver) == []


def test_a_bundle_s_page(demo: Path, tmp_path: Path) -> None:
    bundle = read_recording(demo).bundle()
    digest = write_bundle(bundle, tmp_path / "a.pans")
    page = page_of(tmp_path / "a.pans", tmp_path)
    assert digest in words_of(page)
    assert page.count("data:image/png") == bundle.n_patterns
    assert load_bundle(tmp_path / "a.pans")[0].name in page


def test_an_automaton_s_page(tmp_path: Path) -> None:
    write_bundle(automaton_bundle(random_automaton(2, slots=6, patterns=9)), tmp_path / "a.pans")
    page = page_of(tmp_path / "a.pans", tmp_path)
    words = words_of(page)
    assert "<h2>Automaton</h2>" in page
    facts = ("exposures_longest", "states_of_most_used_patterns", "leaf_probability_median")
    for text in (*facts, "Every walk begins in state 0", "click: ", "no click: "):
        assert text in words
