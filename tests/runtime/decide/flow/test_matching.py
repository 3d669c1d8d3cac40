"""Decisions matched with the truth afterwards: missed, doubled, in coincidence, in a gap; pulses on target; bounded memory."""

import numpy as np
import pytest

from pans.base.numbers.intervals import wilson_interval
from pans.bundle.backends import NO_LABEL
from pans.decide.decision import Decision, DecisionFlag, Passage
from pans.decide.flow.matching import PassageMatcher, abort_reason
from pans.protocol.wire.messages import Mark

GATED = frozenset({1})


def matcher(touching: bool = False) -> PassageMatcher:
    return PassageMatcher(3, GATED, 50, touching=touching)


def mark(number: int, centre: int, truth: int = 1, half: int = 20) -> Mark:
    return Mark(0, number, truth, centre, 0, 5.0, half)


def decide(to: PassageMatcher, number: int, centre: int, label: int, flags: int = 0) -> None:
    decision = Decision(number, 0, centre, number, 0, 4, label, -1, flags, 0.9, 0)
    to.add_decision(decision, Passage(centre - 10, centre + 10, centre, 0, 40), label in GATED)


def test_each_fate_is_counted_once() -> None:
    found = matcher()
    for number, centre in enumerate((100, 200, 300, 400, 420, 600)):
        found.add_mark(mark(number, centre))
    decide(found, 0, 101, 1)  # right
    decide(found, 1, 199, 2)  # wrong
    decide(found, 2, 205, 1)  # and once more: doubled
    # 400 and 420 in one; 300 is missed
    decide(found, 3, 410, NO_LABEL, DecisionFlag.COINCIDENCE | DecisionFlag.ABSTAINED)
    decide(found, 4, 500, 1)  # nothing was there
    decide(found, 5, 600, NO_LABEL, DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED)
    found.settle(10_000)
    summary = found.figures(1)
    counts = summary.passages
    expected = {
        "marks": 6, "alone": 4, "missed": 1, "doubled": 1, "coincident": 2, "coincident_aborted": 1, "coincident_labelled": 0,
        "in_gaps": 0, "without_mark": 1, "targets": 6, "pulses": 3, "pulses_on_target": 2, "pulses_pure": 2, "decisions": 6, "cut_off": 0,
    }  # fmt: skip
    assert counts == expected
    assert summary.accuracy.value == 1 / 3  # right of three decided alone: an abort is not right
    assert summary.accuracy_labelled.value == 1 / 2
    assert summary.missed.interval == list(wilson_interval(1, 4))
    assert summary.yield_.value == 2 / 6
    assert summary.purity.value == 2 / 3
    assert summary.aborted == {"ambiguous": 1, "coincidence": 1}
    assert found.confusion.tolist() == [[0, 0, 0], [0, 1, 1], [0, 0, 0]]
    assert (summary.clicks_mean, summary.photons_mean, summary.passage_photons_mean) == (4, 5.0, 50.0)


def test_a_gap_takes_its_passages_out_of_the_figures() -> None:
    found = matcher()
    found.add_mark(mark(0, 100))
    found.add_mark(mark(1, 200))
    found.add_gap(115, 130)
    decide(found, 0, 200, 1)
    found.settle(10_000)
    counts = found.figures(1).passages
    assert (counts["in_gaps"], counts["alone"], counts["missed"]) == (1, 1, 0)


def test_bars_that_touch_are_no_coincidence() -> None:
    found = matcher(touching=True)
    for number in range(10):
        found.add_mark(mark(number, 100 + 39 * number, truth=number % 2))
        decide(found, number, 100 + 39 * number, number % 2)
    found.settle(10_000)
    summary = found.figures(1)
    assert (summary.passages["alone"], summary.accuracy.value, summary.purity.value) == (10, 1.0, 1.0)


def test_what_the_end_cuts_off_is_neither_missed_nor_counted() -> None:
    found = matcher()
    found.add_mark(mark(0, 100))
    found.add_mark(mark(1, 190))
    decide(found, 0, 100, 1)
    decide(found, 1, 185, NO_LABEL, DecisionFlag.INCOMPLETE | DecisionFlag.ABSTAINED)
    found.settle(200)
    found.finish()
    counts = found.figures(1).passages
    assert (counts["marks"], counts["cut_off"], counts["missed"], counts["without_mark"]) == (1, 1, 0, 0)


@pytest.mark.parametrize("before", [True, False])
def test_a_pulse_that_was_not_made_is_taken_back_whenever_that_is_known(before: bool) -> None:
    found = matcher()
    found.add_mark(mark(0, 100))
    decide(found, 0, 100, 1)
    if before:
        found.undo(0)
    found.settle(10_000)
    if not before:
        found.undo(0)
    summary = found.figures(1)
    assert (summary.passages["pulses"], summary.yield_.value, summary.purity.value) == (0, 0.0, None)


def test_memory_is_bounded_and_the_order_of_settling_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    centres = np.cumsum(rng.integers(15, 120, 3000)).tolist()
    truths, seen = rng.integers(0, 3, 3000).tolist(), (rng.random(3000) < 0.9).tolist()
    once, often = matcher(), matcher()
    for number, (centre, truth) in enumerate(zip(centres, truths)):
        for one in (once, often):
            one.add_mark(mark(number, centre, truth))
            if seen[number]:
                decide(one, number, centre + 2, (truth + (number % 7 == 0)) % 3)
        often.settle(centre)
        assert len(often._marks) + len(often._rows) < 40
    once.settle(centres[-1] + 1000)
    often.settle(centres[-1] + 1000)
    assert once.figures(1) == often.figures(1)
    assert once.counts["alone"] > 500


def test_without_marks_rows_do_not_pile_up() -> None:
    found = matcher()
    for number in range(1000):
        decide(found, number, 100 * number, 1)
        found.settle(100 * number + 60)
    assert len(found._rows) < 10
    assert found.figures(1).accuracy.value is None


def test_reasons_have_names() -> None:
    reasons = (DecisionFlag.GAP | DecisionFlag.COINCIDENCE, DecisionFlag.DARK_ALARM, DecisionFlag(0))
    assert [abort_reason(flags | DecisionFlag.ABSTAINED) for flags in reasons] == ["gap", "dark counts", "other"]
    assert abort_reason(DecisionFlag.DARK_ALARM) == ""  # decided, with another table
