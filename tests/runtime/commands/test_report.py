"""Report pages: self-contained, escaped, and every figure on them that of the recording."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from commands import fixed_run, page_of, words_of

from pans.runtime.bundle.model import load_bundle, write_bundle
from pans.runtime.cli import main
from pans.runtime.record import read_recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.report.page import Page, flat
from pans.runtime.report.page_rates import count_rates

pytest.importorskip("matplotlib", reason="needs the plot extra")


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
    assert summary["decisions_sha256"] in words
    sections = ("Results", "Decisions by class", "Timing", "Clicks over time", "Dark counts", "Clock", "Events")
    for section in (*sections, "What was run"):
        assert f"<h2>{section}</h2>" in page
    assert len(re.findall(r"<img [^>]*src=\"data:image/", page)) == 7
    outside = re.findall(r'(?:src|href)="(?!data:)[^"]*"|url\(|<script|@import', page)
    assert outside == []


def test_the_rates_are_those_of_the_clicks(demo: Path) -> None:
    recording = read_recording(demo)
    plan = recorded_plan(recording)
    rates, clicks = count_rates(recording, plan), click_list(recording, plan)
    assert rates.exposures.sum() + rates.dark_exposures.sum() == clicks.exposures
    lit = clicks.pattern[clicks.pattern < plan.n_patterns]
    assert rates.clicks.sum(axis=0).tolist() == np.bincount(lit, minlength=plan.n_patterns).tolist()
    assert rates.dark_exposures.sum() == plan.dark_slots_per_cycle * recording.n_decisions
    assert (rates.exposures.sum(axis=0) == recording.n_decisions).all()


def test_a_cut_recording_s_page_says_so(demo: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.pansrec").write_bytes(demo.read_bytes()[:-300])
    assert "INCOMPLETE" in words_of(page_of(tmp_path / "cut.pansrec", tmp_path))


def test_a_bundle_s_page(demo: Path, tmp_path: Path) -> None:
    bundle = read_recording(demo).bundle()
    digest = write_bundle(bundle, tmp_path / "a.pans")
    page = page_of(tmp_path / "a.pans", tmp_path)
    assert digest in words_of(page)
    assert page.count("data:image/") == 2
    assert load_bundle(tmp_path / "a.pans")[0].name in page


def test_a_stranger_s_text_stays_text() -> None:
    page = Page("<b>\x1b[2J", simulated=False)
    page.facts({"<script>": "a & b", "inner": {"x": 1.23456789}, "none": None})
    page.table([("x", '"><img src=http://a>')])
    text = page.html().decode()
    assert "<script" not in text
    assert "<img" not in text
    assert "\x1b" not in text
    assert "inner.x" in text
    assert dict(flat({"a": {"b": [1, 2]}})) == {"a.b": "1, 2"}


def test_a_profile_has_no_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "ideal", "-o", str(tmp_path / "a.html")]) == 2
    assert "pans info" in capsys.readouterr().err


def test_without_matplotlib_the_extra_is_named(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import importlib

    right = importlib.import_module

    def without(name: str, *more: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ModuleNotFoundError(name)
        return right(name, *more)

    monkeypatch.setattr(importlib, "import_module", without)
    assert main(["report", str(demo), "-o", str(tmp_path / "a.html")]) == 2
    assert "pans-runtime[plot]" in capsys.readouterr().err


def test_an_automaton_s_page(tmp_path: Path) -> None:
    write_bundle(automaton_bundle(random_automaton(2, slots=6, patterns=9)), tmp_path / "a.pans")
    page = page_of(tmp_path / "a.pans", tmp_path)
    words = words_of(page)
    assert "<h2>Automaton</h2>" in page
    for text in (
        "exposures_longest",
        "states_of_most_used_patterns",
        "every walk begins in state 0",
        "leaf_probability_median",
    ):
        assert text in words
    assert len(re.findall(r"<img [^>]*src=\"data:image/", page)) == 2
