"""`import pans`: what a notebook needs, with the same figures as the commands give."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, diamond, random_automaton

import pans
from pans.runtime.errors import UsageError

DEVICE = "sim:oled-qcmos?scene=fashion200&seed=1&pace=fast"


def test_a_run_leaves_a_recording_that_replays_and_a_page(tmp_path: Path) -> None:
    done = pans.run("fashion10", DEVICE, decisions=40, out=tmp_path)
    assert (done.summary.verdict, done.summary.tally.decisions, done.confusion.sum()) == ("PASS", 40, 40)
    assert "SIMULATED" in done.report.read_text()
    assert done.recording is not None
    recording = pans.load_recording(done.recording)
    again = pans.replay(recording, recording.bundle())
    assert (again.decisions, again.sha256) == (40, done.summary.decisions_sha256)


def test_a_run_without_a_folder_leaves_nothing_and_decides_the_same(tmp_path: Path) -> None:
    bundle = pans.load_bundle("fashion10")
    done = pans.run(bundle, DEVICE, decisions=40, profile=pans.load_profile("oled-qcmos"))
    assert (done.recording, done.report) == (None, None)
    recorded = pans.run(bundle, DEVICE, decisions=40, out=tmp_path)
    np.testing.assert_array_equal(done.confusion, recorded.confusion)


def test_words_and_counts_are_decided_alike_and_checked() -> None:
    bundle = pans.load_bundle("fashion10")
    words = np.arange(1 << bundle.n_features)
    counts = words[:, None] >> np.arange(bundle.n_features) & 1
    found, wanted = pans.decide(bundle, words), pans.decide(bundle, counts)
    np.testing.assert_array_equal(found.labels, wanted.labels)
    np.testing.assert_array_equal(found.probabilities, wanted.probabilities)
    for wrong in ([-1], [1 << bundle.n_features], [[2] * bundle.n_features], [[0, 1]]):
        with pytest.raises(UsageError, match="allowed"):
            pans.decide(bundle, wrong)


def test_an_automaton_decides_on_words_and_long_words_are_counts() -> None:
    short, long = automaton_bundle(diamond()), automaton_bundle(random_automaton(1, slots=70, width=2))
    for clicks in ([0b000, 0b111], [[0, 0, 0], [1, 1, 1]]):
        assert pans.decide(short, clicks).labels.tolist() == [0, 1]
    with pytest.raises(UsageError, match="at most 63 clicks"):
        pans.decide(long, [1])
    assert len(pans.decide(long, np.zeros((2, 70), int)).labels) == 2


def test_without_the_train_extra_evaluate_says_what_to_install() -> None:
    code = "import sys; sys.modules['pans.trainer.evaluate'] = None; import pans; pans.evaluate"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'pans-runtime[train]'" in done.stderr


@pytest.mark.parametrize("clicks", [[0.5], [1.0], ["a"], [None], "abc", {}, [[1, 2], [3]], [[0.5] * 10], [2**70]])
def test_clicks_that_are_no_whole_numbers_are_refused(clicks: Any) -> None:
    with pytest.raises(UsageError, match=r"^clicks are"):
        pans.decide(pans.load_bundle("fashion10"), clicks)


def test_no_clicks_and_true_or_false_are_clicks_too() -> None:
    bundle = pans.load_bundle("fashion10")
    assert len(pans.decide(bundle, []).labels) == 0
    truths = np.array([[True, False] * 5])
    assert pans.decide(bundle, truths).labels == pans.decide(bundle, truths.astype(int)).labels


def test_every_public_name_is_listed_before_it_is_used() -> None:
    code = "import pans; print(sorted({*pans.__all__} - {*dir(pans)}), all(hasattr(pans, name) for name in dir(pans)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[] True\n"
