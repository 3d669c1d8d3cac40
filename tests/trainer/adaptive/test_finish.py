"""Posteriors of the nodes: smoothing, calibration on held-back objects, and the calibration error; the budget in the end."""

import math

import numpy as np
import pytest
import torch

from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.finish import calibrated, calibration_error, log_loss, meet_budget, smoothed
from pans.trainer.adaptive.machine import Bits, Level, Machine, Sight
from pans.trainer.adaptive.objects import Block
from pans.trainer.adaptive.outcomes import law_of
from pans.trainer.adaptive.tune import Price, Prices, figures


def test_smoothing_is_that_of_pseudo_objects():
    np.testing.assert_allclose(smoothed(np.array([[3.0, 1.0]]), 0.5), [[3.5 / 5, 1.5 / 5]])
    np.testing.assert_allclose(smoothed(np.array([[3.0, 1.0]]), 1.0, 2.0), [[16 / 20, 4 / 20]])
    np.testing.assert_allclose(smoothed(np.zeros((1, 4)), 0.1), [[0.25] * 4])


def drawn(rng, truth, per_node):
    return np.stack([rng.multinomial(per_node, row) for row in truth]).astype(float)


def test_rare_nodes_are_smoothed_and_the_held_back_loss_falls():
    rng = np.random.default_rng(0)
    truth = rng.dirichlet(np.full(4, 1.0), 400)
    fitted, held_back = drawn(rng, truth, 5), drawn(rng, truth, 50)
    found, stated = calibrated([fitted], [held_back], [0]), smoothed(fitted, 0.003)
    assert found.smoothing >= 0.3
    assert found.loss * held_back.sum() < 0.8 * log_loss(stated, held_back)
    np.testing.assert_allclose(found.levels[0].sum(axis=1), 1.0)
    assert found.calibration_error < 0.3 * calibration_error(stated, held_back)


def test_calibration_error_of_known_cases():
    posterior = np.array([[0.9, 0.1], [0.9, 0.1]])
    assert calibration_error(posterior, np.array([[9.0, 1.0], [90.0, 10.0]])) == pytest.approx(0.0)
    assert calibration_error(posterior, np.array([[5.0, 5.0], [50.0, 50.0]])) == pytest.approx(0.4)


def test_states_are_calibrated_too_but_do_not_choose_the_smoothing():
    rng = np.random.default_rng(1)
    truth = rng.dirichlet(np.full(3, 1.0), 50)
    states, leaves = drawn(rng, truth, 1000), drawn(rng, truth, 1000)
    of_states, of_leaves = drawn(rng, truth, 3), drawn(rng, truth, 1000)
    found, alone = calibrated([states, leaves], [of_states, of_leaves], [50, 0]), calibrated([leaves], [of_leaves], [0])
    assert found.smoothing == alone.smoothing
    np.testing.assert_allclose(found.levels[1], alone.levels[0])
    assert log_loss(found.levels[0], of_states) <= log_loss(smoothed(states, found.smoothing), of_states)


def one_pixel(lean: float) -> Machine:
    """One exposure of one state, which lights its one pixel where `lean` is above 0."""
    light = Bits(torch.tensor([[lean]]), torch.tensor([[math.log(5.0)]]))
    return Machine([Level(light, torch.tensor([[0], [1]]))], [torch.ones(2, 2)])


def test_the_budget_is_met_and_patterns_without_any_light_stay_dark():
    sight = Sight(law_of(load_profile("ideal"), 100.0, 2, 1, None), gain=1.0)
    block = Block(torch.tensor([[0.5], [1.0]]), torch.eye(2))
    for lean, photons in ((1.0, 2.97), (-1.0, 0.0)):  # 99 % of the budget
        machine = one_pixel(lean)
        meet_budget(machine, Prices([Price("photons", 0.1, 3.0)]), None, lambda: sight, [block])
        assert figures(machine, sight, [block]).photons == pytest.approx(photons, rel=0.01)
