"""One list of nasty texts, every kind of output: shown, never obeyed; JSON stays exact."""

import csv
import io
import json
import re
from argparse import Namespace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from nasty import NASTY

from pans.base.console import emit, fail, say
from pans.base.console import text as safe_text
from pans.base.console.text import html_card
from pans.base.errors import UsageError
from pans.report.pages.charts import Axis, Curve, Mark, chart
from pans.report.pages.page import render
from pans_sim.testing import small_setup

nasty = pytest.mark.parametrize("text", NASTY, ids=lambda text: ascii(text)[1:30])


@nasty
def test_lines_markdown_cells_and_file_names_are_inert(text: str, tmp_path: Path) -> None:
    shown, marked = safe_text.one_line(text), safe_text.markdown(text)
    for line, most in ((shown, safe_text.LINE_MAX), (marked, 2 * safe_text.LINE_MAX + 2)):
        assert line.isprintable()
        assert len(line) <= most
    assert shown == text or not text.isprintable() or len(text) > safe_text.LINE_MAX
    assert not re.search(r"(?<!\\)(?:\\\\)*[|<>`*\[\]!#$~]", marked)  # an odd number of backslashes before each
    assert not re.search(r"(?<![\\a-zA-Z0-9])_|(?<!\\)_(?![a-zA-Z0-9])|(?<!\\)&#?\w+;", marked)
    assert not re.match(r"\s*([-+=]|\d+[.)])(\s|$)", marked)
    out = io.StringIO()
    csv.writer(out).writerow([safe_text.csv_cell(text), safe_text.csv_cell(-3), safe_text.csv_cell("-3.5e2"), "end"])
    cell, *others = next(csv.reader(io.StringIO(out.getvalue())))
    assert others == ["-3", "-3.5e2", "end"]
    assert cell.isprintable()
    assert not cell.lstrip().startswith(("=", "+", "-", "@", "＝"))
    name = safe_text.file_name(text)
    assert re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,110}", name)
    (tmp_path / name).write_text("")
    assert [path.name for path in tmp_path.iterdir()] == [name]


@nasty
def test_the_terminal(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(f"pans: {text}")
    emit(Namespace(json=False), {}, f"found {text}")
    assert fail(UsageError(f"the device says {text}", remedy=text), 2) == 2
    found = capsys.readouterr()
    for line in (found.out + found.err).split("\n"):
        assert line.replace("\t", "").isprintable()
    message = found.err.split("the device says")[1].split("\n  remedy")[0]
    assert not re.search(r"^\S", message.split("\n", 1)[1] if "\n" in message else "", re.MULTILINE)


@nasty
def test_json_stays_exact(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    emit(Namespace(json=True), {"serial": text})
    out = capsys.readouterr().out
    assert (json.loads(out), out.isascii(), out.count("\n")) == ({"serial": text}, True, 1)


class Tags(HTMLParser):
    """What a browser sees: elements, their attributes, text."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[Any] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.found.append((tag, tuple(name for name, _ in attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def tags_of(text: str) -> Tags:
    pytest.importorskip("jinja2", reason="needs the plot extra")
    row = {"value": 1.0, "error": 1.0, "low": 0.0, "high": 2.0}
    facts = {text: {"inner": [text]}, "kind": "x", "profile": {"name": text}, "clicks": text, "exposures": text}
    facts |= {"chi2": 1.0, "degrees_of_freedom": 1, "p_value": 1.0}
    shown = {"parameters": [(text, row, text)], "channels": [{text: text}], "pictures": [(text, "data:,", [text])]}
    page = render("measured.html", facts=facts, **shown, charts=[("drawn", text)]).decode()
    tags = Tags()
    tags.feed(page + html_card(text, {text: text}, [(text, b"png")]))
    return tags


def test_a_chart_is_an_image_whatever_its_words_are() -> None:
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    drawn = []
    for words in (NASTY, ["plain"] * len(NASTY)):
        curves, axis = [Curve([0, 1], [0, 1], text or "x") for text in words], Axis(words[-1], 0.0, 1.0)
        drawn.append(chart(words[-2], axis, axis, curves=curves, marks=[Mark(0.5, text) for text in words]))
    found, plain = ([one.tag for one in ElementTree.fromstring(str(svg)).iter()] for svg in drawn)
    assert abs(found.count("text") - plain.count("text")) <= 2  # one empty name
    assert not {*found} - {*plain}


@nasty
def test_html(text: str) -> None:
    found, plain = tags_of(text or "x"), tags_of("plain")
    assert found.found == plain.found
    assert found.text.replace("\n", "").isprintable()


@nasty
def test_the_summary_page_of_a_run(text: str, tmp_path: Path) -> None:
    from dataclasses import replace

    import pans
    from pans.report.summary.words import closing_words, write_markdown

    if not hasattr(test_the_summary_page_of_a_run, "done"):
        done = pans.run(small_setup()[1], "sim:ideal?scene=uniform&seed=1&pace=fast", decisions=2)
        test_the_summary_page_of_a_run.done = done.summary  # type: ignore[attr-defined]
    summary = replace(test_the_summary_page_of_a_run.done, faults=[text], ended=text)  # type: ignore[attr-defined]
    facts = {"bundle": text, "device": text, "command": text}
    plain, found, confusion = tmp_path / "plain.md", tmp_path / "summary.md", np.eye(2, dtype=np.int64)
    write_markdown(plain, replace(summary, faults=["x"], ended="x"), dict.fromkeys(facts, "x"), confusion, "ab")
    write_markdown(found, summary, facts, confusion, [text, "b"])
    assert found.read_text().count("\n") == plain.read_text().count("\n")
    assert all(line.isprintable() for line in found.read_text().split("\n"))
    words = closing_words(summary, text, text)
    assert words.count("\n") == closing_words(replace(summary, faults=["x"]), "x", "x").count("\n")
