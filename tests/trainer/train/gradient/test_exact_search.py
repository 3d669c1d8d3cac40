"""The barcode solved exactly: counts against plain Python, one bar per pattern, descent within the clicks, a head that decides as Bayes."""

import dataclasses
import itertools
from functools import partial

import numpy as np
import pytest
import torch
from trainings import spots_task

from pans.base.errors import UsageError
from pans.instrument.profile import load_profile
from pans_trainer.model.detection import click_probability, click_words, word_probabilities
from pans_trainer.options import Options, check_options
from pans_trainer.reproduce.passive import measure
from pans_trainer.tasks.barcode import all_strings
from pans_trainer.train.gradient import exact_search
from pans_trainer.train.gradient.exact_search import count, joint, search, search_bars, solve


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


def test_the_search_finds_more_than_its_start_and_keeps_to_the_clicks():
    found = search_bars(6, 3.6, seed=0, steps=700)
    accuracy, clicks = count(found)
    assert accuracy > 0.82  # six single bars in a row: 0.797
    assert clicks <= 3.6


def test_a_solved_task_decides_as_bayes_does(monkeypatch):
    monkeypatch.setattr(exact_search, "search_bars", partial(search_bars, steps=400))
    profile = load_profile("ideal")
    trained = solve(Options(features=3, clicks=2.1, dark=0.02, hidden=32), profile)
    strings, labels = all_strings()
    p = click_probability(
        torch.from_numpy(strings).double() @ torch.from_numpy(trained.quantised.patterns()).T, trained.law
    )
    decided = trained.head(click_words(3)).argmax(dim=1)
    right = (word_probabilities(p) * (decided == torch.from_numpy(labels)[:, None])).sum(dim=1).mean()
    assert float(right) == pytest.approx(1 - min(trained.validation_losses), abs=2e-3)
    assert float(p.sum(dim=1).mean()) <= 2.1
    assert trained.law.dark_per_exposure == 0.02
    assert len(trained.validation_losses) == 1


@pytest.fixture(scope="module")
def task():
    return spots_task(1200, 600)


@pytest.mark.parametrize("d_f", [1, 2, 3, 5])
def test_words_and_classes_by_their_definition(d_f):
    random = torch.Generator().manual_seed(d_f)
    p, labels = torch.rand(2, 7, d_f, generator=random, dtype=torch.float64), torch.arange(7) % 2
    found = joint(p, labels)
    assert found.shape == (2, 2**d_f, 2)
    for word, clicks in enumerate(itertools.product((0, 1), repeat=d_f)):
        is_click = torch.tensor(clicks[::-1])  # bit i of the word is pattern i
        chance = torch.where(is_click == 1, p, 1 - p).prod(dim=2)
        for label in (0, 1):
            torch.testing.assert_close(found[:, word, label], chance[:, labels == label].sum(dim=1) / 7)


def test_two_detectors_find_spots_within_their_clicks(task):
    options = Options(
        features=2, alpha=0.0, clicks=0.9, encoder="coherent", dark=0.01, restarts=3, epochs=3, batch=100,
        front_rate=5e-2, light=16.0, hidden=16, head_rate=3e-3, fields=20, search=True,
    )  # fmt: skip
    profile = load_profile("ideal")
    trained = search(task, profile, options)
    assert trained.encoder.matrix().shape == (2, 144)
    assert len(trained.validation_losses) == 3
    found = measure("spots", task, trained)
    assert found["value"] > 85  # by chance a half
    assert found["value"] / 100 == pytest.approx(1 - min(trained.validation_losses), abs=0.05)
    assert found["clicks"] < 0.97


def test_what_a_search_does_not_know_is_refused(task):
    options = Options(features=2, clicks=0.9, encoder="coherent", fields=20, search=True)
    others = ({"fields": 0}, {"clicks": None}, {"conserving": True}, {"polish": 0.4}, {"estimator": "ste"})
    for changed in others:
        with pytest.raises(UsageError, match="--search"):
            check_options(dataclasses.replace(options, **changed), load_profile("ideal"))
    three = dataclasses.replace(task, classes=("clean", "spot", "scratch"))
    with pytest.raises(UsageError, match="3 classes, images of 12 x 12 pixels, allowed: 2 classes, square images"):
        search(three, load_profile("ideal"), options)
