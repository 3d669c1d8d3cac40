"""Pages: tables made of rows, files that are written and those that are left alone, parts kept, and docs/results against its JSON."""

import json
import re

import pytest
from tree import ROOT

from pans.base.errors import UsageError
from pans_trainer.reproduce.page import (
    NAMES,
    Asked,
    Column,
    Made,
    Page,
    Table,
    against,
    cached_row,
    check_cached_bundle,
    generated,
    is_page_file,
    page_of,
    read_rows,
    rewrite_page,
    write_page,
)

RESULTS = ROOT / "docs" / "results"
COLUMNS = (Column("d_f", "{features}"), Column("all", "{value:.2f}"), Column("clicks", "{clicks:.1f}"))
ROWS = [
    {"table": "a", "features": 3, "value": 50.0, "unused": 1, "verdict": "above", "ahead": 3.0},
    {"table": "a", "features": 4, "value": 60.0, "clicks": 2.0, "verdict": "level", "ahead": 0.5},
    {"table": "b", "way": "x", "photons": 5, "value": 10.0},
    {"table": "b", "way": "x", "photons": 9, "value": 20.0},
    {"table": "b", "way": "y", "photons": 9, "value": 30.0},
]
TABLES = (
    Table("a", COLUMNS, "Rows", (("Ours", "theirs", "verdict"),)),
    Table("b", (Column("way", "{way}"),), "", (), Column("photons", "{photons}"), "{value:.0f}"),
    Table("a", COLUMNS[:1], "With clicks", needs="clicks"),
)
PAPER = "from the release"
PAGE = Page("name", "A page", "", "one", TABLES, {"-x": "a picture"}, file="file", paper=PAPER)
TEXT = """SIMULATED. Command: `pans reproduce name`. Trainings: one. \
The paper's figures: from the [release](https://doi.org/10.5281/zenodo.19210131).

### Rows

d_f|all|clicks
---|---|---
3|50.00|-
4|60.00|2.0

Ours against theirs: 1 above, 1 level, 0 below, of 2; higher in 2.

way|5|9
---|---|---
x|10|20
y|-|30

### With clicks

d_f
---
4

![a picture](name-x.png)
"""


def made():
    return Made(ROWS, {"-x": lambda path: path.write_bytes(b"png")})


def test_a_new_page_has_a_title_its_command_tables_and_pictures_and_nothing_else(tmp_path):
    write_page(tmp_path, PAGE, made())
    begin, end = PAGE.markers
    assert (tmp_path / "file.md").read_text() == f"# A page\n\n{begin}\n\n{TEXT}\n{end}\n"
    assert {path.name for path in tmp_path.iterdir()} == {"name.json", "file.md", "name-x.png"}
    found = json.loads((tmp_path / "name.json").read_text())
    shown = ["features", "value", "verdict", "ahead", "clicks"]  # what no table shows is left out
    assert found["tables"]["a"]["columns"] == shown
    assert read_rows(tmp_path, "name")[0] == {"table": "a"} | dict(zip(shown, (3, 50.0, "above", 3.0, None)))
    assert generated(tmp_path, PAGE) == f"{begin}\n\n{TEXT}\n{end}"


def test_what_is_written_by_hand_and_other_pages_of_the_file_stay(tmp_path):
    path, (begin, end) = tmp_path / "file.md", PAGE.markers
    path.write_text(f"# By hand\n\nBefore.\n\n{begin}\nold\n{end}\n\nAfter.\n")
    write_page(tmp_path, PAGE, made())
    whole = f"# By hand\n\nBefore.\n\n{begin}\n\n{TEXT}\n{end}\n\nAfter.\n"
    assert path.read_text() == whole
    path.write_text(whole.replace("60.00", "99.99"))
    rewrite_page(tmp_path, PAGE)
    assert path.read_text() == whole
    other = Page("other", "Another page", "", "one", TABLES[:1], file="file")
    write_page(tmp_path, other, Made(ROWS))
    assert path.read_text().startswith(whole)
    assert "# Another page" in path.read_text()


@pytest.mark.parametrize("name", NAMES)
def test_the_tables_of_the_results_are_those_of_their_json(name):
    page = page_of(name)
    text = (RESULTS / page.markdown).read_text(encoding="utf-8")
    block = generated(RESULTS, page)
    assert block in text
    assert all(f"({name}{ending}.png)" in block for ending in page.pictures)
    assert "|" in block


def test_the_results_have_no_file_that_no_page_shows():
    text = "\n".join(path.read_text(encoding="utf-8") for path in RESULTS.glob("*.md"))
    for path in RESULTS.iterdir():
        shown = path.suffix == ".md" or path.stem in NAMES or f"({path.name})" in text
        assert shown, path
    index = (RESULTS / "README.md").read_text(encoding="utf-8")
    assert {page_of(name).markdown.removesuffix(".md") for name in NAMES} == set(
        re.findall(r"\]\(([\w-]+)\.md\)", index)
    )


def test_a_verdict_needs_two_combined_errors():
    assert against(52.0, 50.0, 0.6, 0.8) == {"ahead": 2.0, "error": 1.0, "verdict": "level"}
    assert against(52.1, 50.0, 0.6, 0.8)["verdict"] == "above"
    assert against(47.9, 50.0, 0.6, 0.8, prefix="x_")["x_verdict"] == "below"


def test_a_part_is_made_once_and_again_when_asked_for_otherwise(tmp_path):
    calls = []

    def make():
        calls.append(1)
        return {"value": (1, 2)}

    said = []
    asked, collecting = (Asked("page", tmp_path, collect=collect, report=said.append) for collect in (False, True))
    assert collecting.kept("part", {"n": 1}, make) is None
    assert said == ["page: part is not measured yet"]
    first = asked.kept("part", {"n": 1}, make)
    assert first["value"] == [1, 2]  # as JSON gives it back, from the start
    assert collecting.kept("part", {"n": 1}, make) == first
    assert collecting.kept("part", {"n": 2}, make) is None
    asked.kept("part", {"n": 2}, make)
    assert len(calls) == 2


def test_files_that_are_not_ours_are_left_alone(tmp_path):
    assert not any(is_page_file(path) for path in PAGE.files(tmp_path))
    write_page(tmp_path, PAGE, made())
    assert all(is_page_file(path) for path in PAGE.files(tmp_path))
    for text in ("notes", "[1]", '{"rows": 1}'):
        (tmp_path / "name.json").write_text(text)
        (tmp_path / "file.md").write_text(text)
        assert not any(is_page_file(path) for path in PAGE.files(tmp_path))
        with pytest.raises(UsageError, match="no finished row"):
            cached_row(tmp_path / "name.json", "made_with")
        with pytest.raises(UsageError, match="no page of results"):
            read_rows(tmp_path, "name")
    (tmp_path / "row.pans").write_bytes(b"somebody's")
    with pytest.raises(UsageError, match="exists already"):
        check_cached_bundle(tmp_path / "row.pans")
    check_cached_bundle(tmp_path / "none.pans")
