"""An anomaly in a known scene by few detectors: the enumeration against the definition, turns, budgets, and a scene that is solvable."""

# ruff: noqa: E402  (what follows needs torch)
import dataclasses
import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.instrument.click_law import ClickLaw
from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.field_basis import discriminant_basis, turns
from pans.trainer.options import Options
from pans.trainer.reproduce.passive import measure
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train.anomaly_search import descend, joint, judge, search

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


def test_turns_are_the_eight_symmetries_of_a_square():
    image = torch.arange(9).reshape(3, 3)
    views = {tuple(image.flatten()[turn].tolist()) for turn in turns((3, 3))}
    assert len(views) == 8
    assert tuple(image.T.flatten().tolist()) in views
    assert tuple(image.flip(0).flatten().tolist()) in views
    torch.testing.assert_close(turns((3, 3))[0], torch.arange(9))
    with pytest.raises(ValueError, match="3 x 4"):
        turns((3, 4))


def test_turned_fields_are_those_of_all_views():
    objects = spots(400, 2)
    x, labels = torch.from_numpy(objects.images.reshape(400, -1) / 255).float(), torch.from_numpy(objects.labels)
    views = torch.cat([x[:, turn] for turn in turns((SIDE, SIDE))])
    turned = discriminant_basis(x, labels, (SIDE, SIDE), 4, turned=True)[:, 4:]
    of_views = discriminant_basis(views, labels.repeat(8), (SIDE, SIDE), 4)[:, 4:]

    def contrast(basis):
        power = (views @ basis).square()
        return power[labels.repeat(8) == 1].mean(dim=0) / power[labels.repeat(8) == 0].mean(dim=0)

    torch.testing.assert_close(contrast(turned), contrast(of_views), rtol=1e-3, atol=0)


def test_two_detectors_find_spots_within_their_clicks(task):
    options = Options(
        features=2, alpha=0.0, clicks=0.9, encoder="coherent", dark=0.01, restarts=3, epochs=3, batch=100,
        front_rate=5e-2, light=16.0, hidden=16, head_rate=3e-3,
    )  # fmt: skip
    profile = load_profile("ideal")
    trained = search(task, profile, options, 20)
    assert trained.encoder.matrix().shape == (2, SIDE**2)
    assert len(trained.validation_losses) == 3
    assert trained.validation_loss == min(trained.validation_losses)
    found = measure("spots", task, trained)
    assert found["value"] > 85  # by chance a half
    assert found["value"] / 100 == pytest.approx(1 - trained.validation_loss, abs=0.05)
    assert found["clicks"] < 0.97


def test_the_same_seed_descends_to_the_same_encoders():
    random = torch.Generator().manual_seed(3)
    shown, labels = torch.randn(300, 4, generator=random), torch.arange(300) % 2
    options = Options(features=2, clicks=0.9, restarts=2, epochs=2, batch=50, front_rate=5e-2)
    first, again = (descend(shown, labels, ClickLaw(0.0, 0.0, 0.5), options) for _ in range(2))
    assert first.shape == (2, 2, 4)
    assert torch.equal(first, again)
    other = descend(shown, labels, ClickLaw(0.0, 0.0, 0.5), dataclasses.replace(options, seed=1))
    assert not torch.equal(first, other)


def test_starts_above_their_clicks_are_not_chosen():
    random = torch.Generator().manual_seed(0)
    shown, labels = torch.randn(200, 3, generator=random), torch.arange(200) % 2
    shown[labels == 1] *= 5
    weights = torch.stack([torch.eye(3)[:2] * 10, torch.eye(3)[:2] * 0.3])
    wrong = judge(weights, shown, labels, ClickLaw(0.0, 0.0, 0.5), 1.0)
    assert wrong[0] > 1
    assert 0 < wrong[1] < 0.5


def test_what_cannot_be_searched_is_said(task):
    profile = load_profile("ideal")
    with pytest.raises(ValueError, match="clicks None"):
        search(task, profile, Options(features=2, encoder="coherent"), 20)
    with pytest.raises(ValueError, match="13 patterns"):
        search(task, profile, Options(features=13, clicks=2.0, encoder="coherent"), 20)
