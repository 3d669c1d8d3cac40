"""What a notebook shows of bundles, profiles, recordings and runs: well-formed, small, and with every text escaped."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from automata import automaton_bundle

import pans
from pans.runtime.grey_png import read_grey_png
from pans.runtime.html_card import html_card

VOID = {"img"}
NASTY = "<script>alert('x')</script>&\"\x1b[2J"


class Checker(HTMLParser):
    """Every tag that is opened is closed, in order; no tag and no attribute that could do anything."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in ("table", "caption", "b", "tbody", "tr", "th", "td", "div", "img")
        assert {name for name, _ in attrs} <= {"src", "alt", "title", "style"}
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + " "


def words_of(thing: Any) -> str:
    page = thing._repr_html_()
    assert len(page) < 50_000
    return Checker(page).text


def test_texts_are_escaped_and_cut() -> None:
    text = Checker(html_card(NASTY, {NASTY: NASTY, "long": "x" * 10_000}, [(NASTY, b"png")])).text
    assert "<script>alert('x')</script>&" in text
    assert "\x1b" not in text
    assert text.count("x") < 500


def test_a_bundle_shows_its_facts_and_patterns() -> None:
    bundle = pans.load_bundle("fashion10")
    assert "10 of 28 x 28" in words_of(bundle)
    found = re.findall(r"base64,([^\"]+)", bundle._repr_html_())
    pictures = [read_grey_png(base64.b64decode(one), "page") for one in found]
    assert len(pictures) == 10
    assert (pictures[3].ravel() == (bundle.pattern_levels[3] * (255 / (bundle.levels - 1))).round() / 255).all()
    assert "automaton" in words_of(automaton_bundle())
    nasty = replace(bundle, name=NASTY, classes=(NASTY, *bundle.classes[1:]))
    assert "alert('x')" in words_of(nasty)


def test_a_run_and_its_recording(tmp_path: Path) -> None:
    done = pans.run("fashion10", "sim:oled-qcmos?scene=fashion200&seed=1&pace=fast", decisions=20, out=tmp_path / "out")
    assert done.recording is not None
    for shown in (done, pans.load_recording(done.recording)):
        text = words_of(shown)
        assert "SIMULATED" in text
        assert "20" in text


@pytest.mark.parametrize("value", [None, ""])
def test_what_is_not_known_is_left_out(value: Any) -> None:
    assert "<tr>" not in html_card("t", {"a": value})
