"""Numbers in the text of pages: what is one, what it may be, and that a changed figure or text is found."""

import json
import re
import shutil

import pytest
from tree import ROOT

pytest.importorskip("torch", reason="needs the train extra")

from pans.trainer.claims.declared import declared_file, faults, read_entries
from pans.trainer.claims.prose import blocks, numbers
from pans.trainer.claims.sources import Figures, Wrong
from pans.trainer.paper.page import read_rows

RESULTS = ROOT / "docs" / "results"
TEXT = "# Title 3\n\nOurs: 71.76 % at 5.87 clicks (d_f = 10), three rows.\n"


@pytest.fixture
def folder(tmp_path):
    for ending in ("md", "json", "numbers.toml"):
        shutil.copy(RESULTS / f"alpha.{ending}", tmp_path)
    return tmp_path


def page(folder, text, entry):
    (folder / "alpha.md").write_text(text)
    declared_file(folder, "alpha").write_text(entry)
    return faults(Figures(folder), "alpha")


def test_what_counts_as_a_number():
    text = "At d_f = 3, 16 and 32 ours has -3.9 to +0.6 points, 10 000 at 1e-3, of `code 7` in [4](5.md), Fig. 2E, first 200."
    text += " Not 2^25, of seed 1000."
    assert [(one.written, one.label) for one in numbers(text)] == [
        *(("3", "d_f"), ("16", "d_f"), ("32", "d_f"), ("-3.9", ""), ("+0.6", "")),
        *(("10000", ""), ("1e-3", ""), ("4", "")),
    ]
    found = blocks(
        "# Title 1\n\nOne\nline 2.\n\n- a 3\n  and 4\n- five\n\n<!-- table: begin -->\n9\n<!-- table: end -->\n\n| 6 | 7 |\n"
    )
    assert [[one.written for one in block.numbers] for block in found] == [["2"], ["3", "4"], ["five"], ["6", "7"]]


def test_every_number_of_a_text_is_declared_or_found(folder):
    entry = '[[block]]\nbegins = "Ours"\nfrom = [\'"1:all 10 000 %"["d_f = 10"]\', \'"1:clicks"["d_f = 10"]\']\n'
    whole = entry + 'said = { "rows" = "three" }\n'
    assert page(folder, TEXT, whole) == []
    (missing,) = page(folder, TEXT, entry)
    assert missing.startswith('alpha.md: "71.76 % at 5.87 clicks (d_f = 10), three rows.": three is none')
    assert 'declare it in alpha.numbers.toml, [[block]] begins = "Ours"' in missing
    (wrong,) = page(folder, TEXT.replace("71.76", "71.67"), whole)
    assert "71.67 is none of the figures declared. Near: " in wrong
    assert "all 10 000 %" in wrong.partition("Near: ")[2]  # the figure that it is not quite
    (moved,) = page(folder, TEXT.replace("d_f = 10", "d_f = 11"), whole)
    assert "11 is none" in moved
    (idle,) = page(folder, TEXT.replace("71.76 % at ", ""), whole)
    assert "all 10 000 %" in idle
    assert "no number of the block is that: remove it" in idle
    (gone,) = page(folder, "# Title\n\nNothing.\n", whole)
    assert 'no block with numbers begins with "Ours"' in gone


@pytest.mark.parametrize("name", sorted(path.stem for path in RESULTS.glob("*.md")))
def test_the_numbers_of_every_page_are_declared(name):
    assert faults(Figures(RESULTS), name) == []


def test_a_changed_figure_contradicts_the_text(folder):
    assert faults(Figures(folder), "alpha") == []
    rows = read_rows(folder, "alpha")
    next(row for row in rows if row["alpha"] == 1e-3 and row["features"] == 32)["final"]["illumination"] = 125.0
    (folder / "alpha.json").write_text(json.dumps({"rows": rows, "simulated": True}))
    found = faults(Figures(folder), "alpha")
    assert len(found) == 1
    assert "illumination 65 to 115" in found[0]
    assert "115 is none of the figures declared" in found[0]


@pytest.mark.parametrize("name", ["fig-2c", "equal-photons", "README"])
def test_a_changed_number_contradicts_the_json(name, tmp_path):
    """Every number with decimals that a source of the page's figures stands behind, one after the other."""
    for path in RESULTS.glob("*.*"):
        if path.suffix in (".json", ".md", ".toml"):
            shutil.copy(path, tmp_path)
    figures, path = Figures(tmp_path), tmp_path / f"{name}.md"
    text = path.read_text()
    sourced = [e.begins for e in read_entries(declared_file(tmp_path, name)) if e.sources and not e.constants]
    chosen = [block for block in blocks(text) if any(block.text.startswith(begins) for begins in sourced)]
    written = sorted({one.written for block in chosen for one in block.numbers if one.decimals})
    assert len(written) >= 3
    for one in written:
        changed = f"{float(one) + 3.3:.{len(one.partition('.')[2])}f}"
        path.write_text(re.sub(rf"(?<![\d.]){re.escape(one)}(?![\d.])", changed, text))
        assert any(f"{changed} is none" in fault for fault in faults(figures, name)), one


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ('"no such column"', "has no such column"),
        ('"all 10 000 %"["d_f = 99"]', "no number is found"),
        ('__import__("os")', "not understood"),
        ('"clicks".real', "not understood"),
        ('"clicks"["d_f = 10"] + "clicks"', "do not go together"),
        ('"clicks"["d_f = 10"] ** 2', "not understood"),
        ('"clicks"[', "never closed"),
        ("max", "not understood"),
        ("1 / 0", "division by zero"),
        ('"rows:epochs.illumination"', "at most 40"),
    ],
)
def test_a_source_that_is_none_is_refused(source, words):
    with pytest.raises(Wrong, match=words):
        Figures(RESULTS).values("alpha", source)


def test_what_sources_give():
    def of(name, source):
        return Figures(RESULTS).values(name, source)

    unweighed = [row for row in read_rows(RESULTS, "alpha") if row["alpha"] == 0]
    light = [row["final"]["illumination"] for row in unweighed if "schedule" not in row]  # of the first table
    assert of("alpha", '"1:illumination"["alpha = 0"]') == light
    assert of("alpha", '"rows:final.illumination"["alpha = 0"]') == [r["final"]["illumination"] for r in unweighed]
    assert of("mnist", '"alpha/1:illumination"["alpha = 0"]') == light
    assert of("alpha", 'max("1:illumination"["alpha = 0"]) - 1') == [max(light) - 1]
    assert of("alpha", 'rows("1:illumination"["alpha = 0"])') == [4.0]
    assert of("alpha", 'rows("1:illumination"["alpha = 9"])') == [0.0]
    assert of("alpha", 'count("1:illumination"["alpha = 0"] > 600)') == [sum(one > 600 for one in light)]
    assert of("README", '"counts/level"["page = mnist", "ours = K = 1: ours"]') == [6.0]
    first = read_rows(RESULTS, "fashion-mnist")[0]["first_200"]
    assert of("fashion-mnist", '"1:ours#1"["d_f = 3", 2]') == [pytest.approx(100 * first["3"]["accuracy_mean"])]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("begins = 1", "block"),
        ("[[block]]\nbegin = 'x'", "begins, from, paper and said are wanted"),
        ("[[block]]\nbegins = 'x'\npaper = 'ten 10 x'", "x is no number"),
        ("[[block]]\nbegins = 'x'\nsaid = { 'why' = 3 }", "are wanted"),
        ("[[block]", "Expected"),
    ],
)
def test_a_malformed_file_of_declarations_is_named(folder, text, words):
    declared_file(folder, "alpha").write_text(text)
    (found,) = faults(Figures(folder), "alpha")
    assert words in found
    assert "alpha.numbers.toml" in found
