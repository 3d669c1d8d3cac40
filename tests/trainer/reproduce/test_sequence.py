"""Cells in passing: frames and their truth, the strip, and the page from a quick training."""

import dataclasses

import numpy as np
import pytest

from pans_trainer.reproduce import sequence
from pans_trainer.reproduce.page import Asked, of_table, page_of, write_page
from pans_trainer.tasks.registry import Objects


def test_a_window_moves_down_from_field_to_field():
    fields = [np.full((100, 100), value, np.uint8) for value in (1, 2, 3)]
    assert (sequence.frame(*fields, 0) == 2).all()
    moved = sequence.frame(*fields, 30)
    assert ((moved == 2).sum(axis=0) == 70).all()
    assert (moved[-30:] == 3).all()


def test_frames_in_passing_have_the_cells_class_or_are_empty():
    images = np.stack([np.full((100, 100), label, np.uint8) for label in (0, 1, 2, 3, 3, 3)])
    part = sequence.passing(Objects(images, np.array([0, 1, 2, 3, 3, 3])), seed=0)
    assert sorted(part.labels) == [0, 1, 2, 3, 3, 3]
    for image, label in zip(part.images, part.labels):
        share = (image != sequence.NULL).mean()
        assert share >= 0.75 if label != sequence.NULL else share <= 0.55


def test_the_page_judges_frames_passages_and_the_cells_of_a_strip(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    monkeypatch.setattr(sequence, "TRAINED", 10)
    monkeypatch.setattr(sequence, "JUDGED", 30)
    monkeypatch.setattr(sequence, "SHOWN", 1)
    monkeypatch.setattr(sequence, "OPTIONS", dataclasses.replace(sequence.OPTIONS, epochs=2, batch=20, hidden=8))
    asked = Asked("sequence", tmp_path, report=lambda _: None)
    assert sequence.sequence_page(dataclasses.replace(asked, collect=True)).rows == []
    made = sequence.sequence_page(asked)
    middle, out, both, passage = of_table(made.rows, "frames")
    assert both["objects"] == middle["objects"] + out["objects"]
    weighed = middle["value"] * middle["objects"] + out["value"] * out["objects"]
    assert both["value"] == pytest.approx(weighed / both["objects"])
    assert passage["illumination"] == pytest.approx(13 * middle["illumination"])
    assert sequence.sequence_page(dataclasses.replace(asked, collect=True)).rows == made.rows
    write_page(tmp_path, page_of("sequence"), made)
    assert (tmp_path / "sequence.png").stat().st_size > 5000
    assert (tmp_path / "sequence-patterns.png").stat().st_size > 5000
