"""The barcode solved exactly: counts against plain Python, one bar per pattern, descent within the clicks, a head that decides as Bayes."""

# ruff: noqa: E402  (what follows needs torch)
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.detection import ThermalLaw, click_probability, click_words, word_probabilities
from pans.trainer.options import Options
from pans.trainer.tasks.barcode import all_strings
from pans.trainer.train.barcode_search import count, descend, search_bars, solve

PLAIN = ThermalLaw(modes=1e9)  # Poisson


def test_counts_against_plain_python():
    lit = np.zeros((3, 10), bool)
    lit[0, [2, 5]] = lit[1, 3] = lit[2, [0, 9]] = True
    of_word: dict[tuple[bool, ...], list[int]] = {}
    clicks = 0
    for i in range(1024):
        text = f"{i:010b}"
        word = tuple(any(text[bar] == "1" for bar in np.flatnonzero(row)) for row in lit)
        clicks += sum(word)
        of_word.setdefault(word, [0, 0])["1010" in text] += 1
    assert count(lit) == (pytest.approx(sum(map(max, of_word.values())) / 1024), pytest.approx(clicks / 1024))


def test_one_bar_per_pattern_knows_every_string():
    assert count(np.eye(10, dtype=bool)) == (pytest.approx(1.0), pytest.approx(5.0))
    assert count(np.zeros((2, 10), bool))[0] == pytest.approx(667 / 1024)  # no light: the larger class


def test_the_search_finds_more_than_its_start_and_keeps_to_the_clicks():
    found = search_bars(6, 3.6, seed=0, steps=700)
    accuracy, clicks = count(found)
    assert accuracy > 0.82  # six single bars in a row: 0.797
    assert clicks <= 3.6


def test_the_descent_keeps_to_the_clicks_and_loses_nothing():
    start = torch.where(torch.eye(10, dtype=torch.bool)[:6], 3.0, 0.01).double()
    found = descend(start, PLAIN, 2.75)
    strings, labels = all_strings()
    p = click_probability(torch.from_numpy(strings).double() @ found.patterns.T, PLAIN)
    joint = word_probabilities(p).T @ torch.nn.functional.one_hot(torch.from_numpy(labels)).double() / 1024
    assert found.accuracy == pytest.approx(float(joint.amax(dim=1).sum()))
    assert found.clicks == pytest.approx(float(p.sum(dim=1).mean()))
    assert found.clicks <= 2.75


def test_a_solved_task_decides_as_bayes_does():
    profile = load_profile("ideal")
    trained = solve(Options(features=3, clicks=2.1, dark=0.02, hidden=32), profile)
    strings, labels = all_strings()
    p = click_probability(
        torch.from_numpy(strings).double() @ torch.from_numpy(trained.quantised.patterns()).T, trained.law
    )
    decided = trained.head(click_words(3)).argmax(dim=1)
    right = (word_probabilities(p) * (decided == torch.from_numpy(labels)[:, None])).sum(dim=1).mean()
    assert float(right) == pytest.approx(1 - trained.validation_loss, abs=2e-3)
    assert float(p.sum(dim=1).mean()) <= 2.1
    assert trained.law.dark_per_exposure == 0.02
    assert len(trained.validation_losses) == 1
