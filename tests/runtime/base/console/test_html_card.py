"""What a notebook shows of bundles, profiles, recordings and runs: small, and nothing but a table with pictures; see test_safe_text.py."""

import base64
import re
from pathlib import Path
from typing import Any

import pytest
from automata import automaton_bundle
from commands import words_of

import pans
from pans.base.console.text import html_card
from pans.base.files.images import read_grey_png


def card_of(thing: Any) -> str:
    page = thing._repr_html_()
    assert len(page) < 50_000
    assert {*re.findall(r"<(\w+)", page)} <= {"table", "caption", "b", "tbody", "tr", "th", "td", "div", "img"}
    return words_of(page)


def test_a_bundle_shows_its_facts_and_patterns() -> None:
    pytest.importorskip("PIL", reason="needs the train extra")
    bundle = pans.load_bundle("fashion10")
    assert "10 of 28 x 28" in card_of(bundle)
    found = re.findall(r"base64,([^\"]+)", bundle._repr_html_())
    pictures = [read_grey_png(base64.b64decode(one), "page") for one in found]
    assert len(pictures) == 10
    assert (pictures[3].ravel() == (bundle.pattern_levels[3] * (255 / (bundle.levels - 1))).round() / 255).all()
    assert "automaton" in card_of(automaton_bundle())
    assert "dmd-spad" in card_of(pans.load_profile("dmd-spad"))


def test_a_run_and_its_recording(tmp_path: Path) -> None:
    done = pans.run("fashion10", "sim:oled-qcmos?scene=fashion200&seed=1&pace=fast", decisions=20, out=tmp_path / "out")
    assert done.recording is not None
    for shown in (done, pans.load_recording(done.recording)):
        assert {"SIMULATED", "20"} <= {*card_of(shown).split()}


@pytest.mark.parametrize("value", [None, ""])
def test_what_is_not_known_is_left_out_and_long_texts_are_cut(value: Any) -> None:
    assert "<tr>" not in html_card("t", {"a": value})
    assert html_card("t", {"a": "x" * 10_000}).count("x") < 500
