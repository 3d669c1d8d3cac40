"""The barcode solved exactly: counts against plain Python, one bar per pattern, descent within the clicks, a head that decides as Bayes."""

import itertools
from functools import partial

import numpy as np
import pytest
import torch

from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.detection import click_probability, click_words, word_probabilities
from pans.trainer.options import Options
from pans.trainer.reproduce.passive import measure
from pans.trainer.tasks.barcode import all_strings
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train import exact_search
from pans.trainer.train.exact_search import count, joint, search, search_bars, solve


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


SIDE = 12


def spots(n, seed):
    """A bright round background of any power; half of them with a bright or dark spot somewhere near the middle."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 2, n)
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    field = np.exp(-(x**2 + y**2) / 30) * rng.uniform(0.5, 0.8, (n, 1, 1))
    cy, cx = rng.uniform(-2, 2, (2, n, 1, 1))
    spot = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 4) * rng.choice([-0.6, 0.4], (n, 1, 1))
    field = field * (1 + spot * labels[:, None, None]) + 0.004 * rng.normal(size=field.shape)
    return Objects(np.rint(255 * field.clip(0, 1)).astype(np.uint8), labels)


@pytest.fixture(scope="module")
def task():
    return Task("spots", ("clean", "spot"), spots(1200, 0), spots(600, 1), "0" * 64, "", light="field")


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
        front_rate=5e-2, light=16.0, hidden=16, head_rate=3e-3,
    )  # fmt: skip
    profile = load_profile("ideal")
    trained = search(task, profile, options, 20)
    assert trained.encoder.matrix().shape == (2, SIDE**2)
    assert len(trained.validation_losses) == 3
    found = measure("spots", task, trained)
    assert found["value"] > 85  # by chance a half
    assert found["value"] / 100 == pytest.approx(1 - min(trained.validation_losses), abs=0.05)
    assert found["clicks"] < 0.97
