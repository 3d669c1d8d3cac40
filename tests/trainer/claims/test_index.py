"""The counts of the index: as the pages' JSON gives them, and written again with them."""

import json

import pytest
from tree import ROOT

pytest.importorskip("torch", reason="needs the train extra")

from pans.trainer.claims.index import BEGIN, END, claims_of, index_counts, rewrite_index
from pans.trainer.frontier.ways import TRAINED
from pans.trainer.paper.page import read_rows

RESULTS = ROOT / "docs" / "results"


def test_the_counts_of_the_index_are_those_of_the_json():
    assert index_counts(RESULTS) in (RESULTS / "README.md").read_text(encoding="utf-8")


def test_a_changed_figure_changes_the_counts(tmp_path):
    rows = read_rows(RESULTS, "transient")
    (before,) = (one for _, one in claims_of("transient", rows))
    rows[0]["value"] = 84.0  # the paper has 85.00 there
    (tmp_path / "transient.json").write_text(json.dumps({"rows": rows, "simulated": True}))
    (tmp_path / "README.md").write_text(f"# By hand\n\n{BEGIN}\nold\n{END}\n\nAfter.\n")
    rewrite_index(tmp_path)
    above, level, below = before.counts()
    words = f"| [transient](transient.md) |  | Ours | the paper | {above - 1} | {level + 1} | {below} | {len(rows)} |"
    text = (tmp_path / "README.md").read_text()
    assert words in text
    assert "old" not in text
    assert text.startswith("# By hand\n\n")
    assert text.endswith("\n\nAfter.\n")


def test_a_folder_without_an_index_stays_as_it_is(tmp_path):
    rewrite_index(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_automata_are_held_against_the_papers_sampling_error():
    (_, budgets), *others = claims_of("frontier", read_rows(RESULTS, "frontier"))
    assert len(budgets.verdicts) == 13
    frame, sure = "exact direct imaging at equal photons", "direct imaging that stops when sure, at equal photons"
    assert {one.beside for _, one in others} == {frame, sure}
    assert {one.ours for _, one in others if one.beside == sure} <= set(TRAINED)
