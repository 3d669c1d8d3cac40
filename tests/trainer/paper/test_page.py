"""Pages: what is generated and what stays, the tables in docs/results against their JSON, and the paper's figures as they are read."""

import dataclasses
import importlib
import json

import numpy as np
import pytest
from tree import ROOT

pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.errors import UsageError
from pans.trainer.evaluate.picture_samples import SAMPLES, Samples
from pans.trainer.paper import PAGES, Made, Page, images, page_of, tables, write_page
from pans.trainer.paper.page import (
    BEGIN,
    END,
    Column,
    Table,
    cached_row,
    check_cached_bundle,
    columns,
    generated,
    is_page_file,
    page_files,
)

RESULTS = ROOT / "docs" / "results"
COLUMNS = (Column("d_f", "{features}"), Column("all", "{all.accuracy:.2f %}"), Column("clicks", "{clicks:.1f}"))
ROW = {"features": 3, "all": {"accuracy": 0.5}}
PAGE = Page("A page", lambda _: Made([]), lambda rows: [Table(COLUMNS, rows, "## Rows")], {"-x": "a picture"})
TABLE = "## Rows\n\n| d_f | all | clicks |\n| --- | --- | --- |\n| 3 | 50.00 | - |\n"


def test_a_new_page_has_a_title_its_command_tables_and_pictures_and_nothing_else(tmp_path):
    write_page(tmp_path, "name", PAGE, Made([ROW], {"-x": lambda path: path.write_bytes(b"png")}))
    assert json.loads((tmp_path / "name.json").read_text()) == {"rows": [ROW], "simulated": True}
    text = f"SIMULATED. Command: `pans reproduce name`.\n\n{TABLE}\n![a picture](name-x.png)\n"
    assert (tmp_path / "name.md").read_text() == f"# A page\n\n{BEGIN}\n\n{text}\n{END}\n"
    assert {path.name for path in tmp_path.iterdir()} == {"name.json", "name.md", "name-x.png"}


def test_what_is_written_by_hand_stays(tmp_path):
    page = tmp_path / "name.md"
    page.write_text(f"# By hand\n\nBefore.\n\n{BEGIN}\nold\n{END}\n\nAfter.\n")
    write_page(tmp_path, "name", PAGE, Made([ROW]))
    before, _, rest = page.read_text().partition(BEGIN)
    middle, _, after = rest.partition(END)
    assert (before, after) == ("# By hand\n\nBefore.\n\n", "\n\nAfter.\n")
    assert "old" not in middle
    assert TABLE in middle
    assert generated(tmp_path, "name", PAGE) == f"{BEGIN}{middle}{END}"


def test_columns_are_put_together_from_groups():
    assert [column.header for column in columns("trained")] == [
        *("d_f", "first 200", "trials", "objects", "all", "trials", "objects", "clicks", "photons", "illumination")
    ]
    assert Column("s", "{seconds:.1f min}").cell({"seconds": 90}) == "1.5"
    assert Column("s", "{a:.1f} ± {b:.1f}").cell({"a": 1, "b": None}) == "-"


def test_every_page_is_found_under_its_name():
    for module in set(PAGES.values()):
        there = importlib.import_module(f"pans.trainer.paper.{module}").PAGES
        assert list(there) == [name for name in PAGES if PAGES[name] == module]
    assert set(PAGES) > {*tables.ACTIVE, *tables.PASSIVE, *tables.UNPRINTED}


@pytest.mark.parametrize("name", PAGES)
def test_the_tables_of_the_results_are_those_of_their_json(name):
    text = (RESULTS / f"{name}.md").read_text(encoding="utf-8")
    assert generated(RESULTS, name, page_of(name)) in text
    title, *rest = text.split("\n")
    assert title == f"# {page_of(name).title}"
    by_hand = "\n".join(rest).partition(BEGIN)[0] + text.partition(END)[2]
    assert by_hand.strip()
    assert "\n| " not in by_hand  # no table that no JSON stands behind


def test_the_papers_rows_are_all_there_and_plausible():
    assert [len(rows) for rows in tables.ACTIVE.values()] == [7, 6]
    for row in (row for rows in tables.ACTIVE.values() for row in rows):
        assert 0 < row.clicks < row.features
        assert list(row.experiment) == sorted(row.experiment, key=lambda value: round(value / 2))  # K helps, to a point
        assert row.simulation[0] < row.simulation[3]
    for table in tables.PASSIVE.values():
        assert all(len(row.values) == len(table.dark) for row in table.rows)
        assert all(list(row.values) == sorted(row.values, reverse=True) for row in table.rows)  # dark counts hurt
        assert all(0 < row.clicks < row.features for row in table.rows)


@pytest.mark.parametrize(
    ("line", "words"),
    [([3, 1.2, 18.1, [1.0, 2.0, 3.0, 4.0]], "4 columns of 4"), ([3, 1.2, 18.1, *[[1.0, 2.0]] * 4], "4 columns of 4")],
)
def test_a_malformed_row_of_the_papers_figures_is_named(line, words):
    with pytest.raises(ValueError, match=f"mnist, d_f = 3: {words}"):
        tables._active("mnist", line)
    with pytest.raises(ValueError, match="cells, d_f = 3: 1 values"):
        tables._passive("cells", {"dark": [0.0], "rows": [line]}, printed=True)


def test_every_model_adds_its_rows_to_the_figure(tmp_path):
    image = pytest.importorskip("matplotlib.image")
    rng = np.random.default_rng(0)
    shown = rng.integers(0, 256, (3, 6, 6), dtype=np.uint8)
    samples = Samples(
        shown, shown[::-1], rng.integers(0, 256, (3, SAMPLES, 6, 6), dtype=np.uint8), np.ones((3, SAMPLES), np.int64)
    )
    heights = []
    for n in (1, 2):
        images.samples(tmp_path / "a.png", "task", [(f"model {i}", dataclasses.replace(samples)) for i in range(n)])
        heights.append(image.imread(tmp_path / "a.png").shape[0])
    assert heights[1] / heights[0] == pytest.approx((2 + 2 * SAMPLES) / (2 + SAMPLES), rel=0.1)


def test_pages_and_rows_that_are_not_ours_are_left_alone(tmp_path):
    assert not any(is_page_file(path) for path in page_files(tmp_path, "name", PAGE))
    write_page(tmp_path, "name", PAGE, Made([ROW], {"-x": lambda path: path.write_bytes(b"png")}))
    assert all(is_page_file(path) for path in page_files(tmp_path, "name", PAGE))
    for text in ("notes", "[1]", '{"rows": 1}'):
        (tmp_path / "name.json").write_text(text)
        (tmp_path / "name.md").write_text(text)
        assert not any(is_page_file(path) for path in page_files(tmp_path, "name", PAGE))
        with pytest.raises(UsageError, match="no finished row"):
            cached_row(tmp_path / "name.json", "made_with")
    (tmp_path / "row.pans").write_bytes(b"somebody's")
    with pytest.raises(UsageError, match="exists already"):
        check_cached_bundle(tmp_path / "row.pans")
    check_cached_bundle(tmp_path / "none.pans")
