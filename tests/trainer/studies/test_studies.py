"""Pages on single questions: frames in passing, tables of chances, heads for few labels, means over seeds, and parts that are missing."""

# ruff: noqa: E402  (what follows needs torch)
import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")
pytest.importorskip("matplotlib", reason="needs the plot extra")

from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import check_options
from pans.trainer.paper import Asked
from pans.trainer.studies import PAGES, ablations, few_labels, fibre_field, fig_2f, page_of, sequence
from pans.trainer.tasks.registry import Objects, Task

OBJECTS = Objects(np.ones((2, 1, 1), np.uint8), np.zeros(2, np.int64))


def asked(tmp_path, **how):
    said = []
    return Asked("page", tmp_path, report=said.append, collect=True, **how), said


@pytest.mark.parametrize("name", PAGES)
def test_a_page_without_its_parts_says_what_is_missing(name, tmp_path, monkeypatch):
    monkeypatch.setattr(fig_2f, "load_task", lambda *_: Task("two", ("a", "b"), OBJECTS, OBJECTS, "0" * 64, ""))
    page, said = asked(tmp_path)
    made = page_of(name).measure(page)
    assert made.rows == []
    assert any(f"pans reproduce {name}" in line for line in said)
    assert list(tmp_path.iterdir()) == []


# ---- cells in passing ----


def test_a_frame_shows_the_window_that_its_offset_says():
    above, cell, below = (np.full((100, 100), value, np.uint8) for value in (1, 2, 3))
    assert (sequence.frame(above, cell, below, 0) == 2).all()
    down = sequence.frame(above, cell, below, 30)  # the window stands 30 rows lower: the cell leaves at the top
    assert (down[:70] == 2).all()
    assert (down[70:] == 3).all()
    assert (sequence.frame(above, cell, below, -100) == 1).all()
    with pytest.raises(ValueError, match="101 rows"):
        sequence.frame(above, cell, below, 101)


def test_frames_in_passing_hold_what_their_labels_say():
    rng = np.random.default_rng(0)
    labels = np.repeat([0, 1, 2, 3], 12)
    images = np.zeros((48, 100, 100), np.uint8)
    images[labels != 3, 40:60] = 10 * (labels[labels != 3] + 1)[:, None, None]  # a band in the middle of each cell
    order = rng.permutation(48)
    found = sequence.passing(Objects(images[order], labels[order]), seed=1)
    assert np.bincount(found.labels).tolist() == [12, 12, 12, 36]
    for image, label in zip(found.images, found.labels):
        lit = np.flatnonzero(image.any(axis=1))
        if label != 3:
            assert image.max() == 10 * (label + 1)
            assert abs(lit.mean() - 49.5) <= sequence.NEAR_PX
            assert len(lit) == 20
        elif len(lit):  # what is left of a cell is at an end
            assert lit.min() == 0 or lit.max() == 99 or abs(lit.mean() - 49.5) >= sequence.FAR_PX - 10


# ---- readouts on a map ----


def test_the_table_of_words_is_the_sum_over_objects():
    rng = np.random.default_rng(3)
    p, labels = rng.random((7, 3)), np.array([0, 1, 0, 1, 1, 0, 0])
    table = fig_2f.class_table(p, labels, 2)
    for word, bits in enumerate(itertools.product((0, 1), repeat=3)):
        word = sum(bit << i for i, bit in enumerate(bits))
        for label in (0, 1):
            chance = sum(
                np.prod([p[i, j] if bits[j] else 1 - p[i, j] for j in range(3)]) for i in range(7) if labels[i] == label
            )
            assert np.exp(table[word, label]) == pytest.approx(chance / 7, abs=1e-8)


# ---- few labels ----


def case(head: bool):
    """Six channels of 300 objects: three tell the class, three are noise; with a head that knows it, or none."""
    rng = np.random.default_rng(4)
    labels = rng.integers(0, 3, 300)
    p = np.concatenate([0.1 + 0.8 * np.eye(3)[labels], np.full((300, 3), 0.5)], axis=1)
    bits = np.arange(64)[:, None] >> np.arange(6) & 1
    scores = 4.4 * bits[:, :3].astype(float) if head else np.zeros((64, 3))
    light = {"photons": 5.0, "illumination": 9.0}
    return few_labels._case("case", p, labels, scores, light), p, labels


def test_a_draw_judges_every_head_exactly_on_the_other_half():
    known, p, labels = case(head=True)
    found = few_labels.one_draw(known, 60, seed=0)
    assert set(found) == set(few_labels.HEADS)
    order = np.random.default_rng([0, 60]).permutation(300)[150:]
    right = 0.0
    for index in order:  # the old head, one word after the other
        for bits in itertools.product((0, 1), repeat=6):
            chance = np.prod([p[index, j] if bits[j] else 1 - p[index, j] for j in range(6)])
            right += chance * (int(np.argmax(bits[:3])) == labels[index])
    assert found[few_labels.OLD] == (pytest.approx(100 * right / 150), few_labels.OLD)
    assert found[few_labels.ALL][1] == few_labels.OLD  # nothing is better than what is right


def test_where_there_is_no_head_eigentasks_are_chosen_and_learn():
    unknown, _, _ = case(head=False)
    found = few_labels.one_draw(unknown, 80, seed=1)
    assert "eigentasks" in found[few_labels.BESIDE][1]
    assert found[few_labels.OLD][0] < 40
    assert found[few_labels.ALL][0] > 70


# ---- options of a training ----


def test_every_arm_can_be_trained_and_each_study_has_one_reference():
    for arm in ablations.ARMS:
        check_options(arm.options, load_profile("ideal"))
    studies = {arm.study for arm in ablations.ARMS}
    assert [sum(arm.reference for arm in ablations.ARMS if arm.study == one) for one in studies] == [1] * len(studies)
    names = {ablations._name(arm, 0): (arm.images, arm.options) for arm in ablations.ARMS}
    assert len(set(names.values())) == len({(arm.images, arm.options) for arm in ablations.ARMS})  # no two share a part


def test_arms_are_held_against_the_reference_by_both_errors():
    def row(arm, seed, value):
        figures = {"value": value, "first_200": value, "error_objects": 0.3, "clicks": 5.0, "photons": 15.0}
        return {"study": ablations.HEAD, "arm": arm, "seed": seed, **figures, "illumination": 40.0, "cpu_seconds": 1.0}

    plain, other = (arm.name for arm in ablations.ARMS if arm.study == ablations.HEAD)
    rows = [row(plain, s, v) for s, v in enumerate((70.0, 71.0, 72.0))] + [row(other, 0, 73.0), row(other, 1, 74.0)]
    (table,) = ablations.ablations_tables(rows)
    cells = [line.strip("| ").split(" | ") for line in table.lines()[4:6]]
    assert cells[0][:5] == [plain, "3", "71.00", "1.00", "0.30"]
    error = (1.0 / 3 + 0.5 / 2 + 2 * 0.3**2) ** 0.5  # variances of both means, and of the test images
    assert cells[1][:7] == [other, "2", "73.50", "0.71", "0.30", f"+2.50 ± {error:.2f}", "above"]


# ---- digits behind a fibre as a field ----


def test_a_fibre_row_is_compared_at_what_it_detects_and_at_what_must_reach_it():
    direct = [
        {"way": "posterior", "photons": photons, "value": value, "error_objects": 0.3, "clicks": photons / 2}
        for photons, value in ((10.0, 40.0), (1000.0, 90.0))
    ]
    row = {"value": 70.0, "error_objects": 0.4, "photons": 100.0, "reaching": 5000.0}
    found = fibre_field._beside(row, direct)["direct"]
    assert found["detected"]["value"] == pytest.approx(65)  # half way in the logarithm
    assert (found["detected"]["ahead"], found["detected"]["verdict"]) == (pytest.approx(5), "above")
    assert found["detected"]["error"] == pytest.approx(0.5)
    assert (found["reaching"]["photons"], found["reaching"]["verdict"]) == (1000.0, "below")
    assert "detected" not in fibre_field._beside(row | {"photons": 5.0}, direct)["direct"]


def test_recipes_behind_the_fibre_conserve_light() -> None:
    for row in fibre_field.ROWS:
        options = fibre_field.recipe(row.features)
        check_options(options, load_profile("ideal"))
        assert (options.complex_field, options.conserving, options.input_photons) == (True, True, 100.0)
    assert [row.features for row in fibre_field.ROWS] == [4, 5, 6, 8, 10, 16, 24, 32]  # the paper's figure
