"""Growing: merging against an oracle and on known cases; finishing: posteriors, their calibration, and the budget."""

import math

import numpy as np
import pytest
import torch
from naive_adaptive import merged as oracle
from trainings import bars_task

from pans.instrument.click_law import ClickLaw
from pans.instrument.profile import load_profile
from pans_trainer.options import AutomatonOptions
from pans_trainer.tasks.registry import Objects, Task
from pans_trainer.train.automaton.finish import calibrated, calibration_error, log_loss, meet_budget, smoothed
from pans_trainer.train.automaton.grow import Growth, merged
from pans_trainer.train.automaton.machine import Aim, Bits, Level, Machine, Sight, forward
from pans_trainer.train.automaton.objects import Block, TrainingObjects
from pans_trainer.train.automaton.outcomes import WordLaw, law_of
from pans_trainer.train.automaton.tune import Price, Prices, figures


@pytest.mark.uncompiled
@pytest.mark.parametrize("seed", range(3))
def test_merges_as_the_oracle(seed):
    rng = np.random.default_rng(seed)
    counts = rng.gamma(0.3, 10, (14, 4))
    for wanted in (13, 6, 2, 1):
        found = merged(counts, wanted)
        groups = [np.flatnonzero(found == group).tolist() for group in range(wanted)]
        assert sorted(groups, key=lambda group: group[0]) == oracle(counts.tolist(), wanted)


def test_what_is_alike_or_empty_is_merged_first_whatever_its_mass():
    counts = np.array([[90.0, 10.0], [1.0, 9.0], [9.0, 1.0], [50.0, 450.0], [5.0, 5.0]])
    assert merged(counts, 3).tolist() == [0, 1, 0, 1, 2]
    found = merged(np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 3.0], [0.0, 0.0]]), 2)
    assert found[1] != found[2]
    assert merged(np.ones((3, 2)), 5).tolist() == [0, 1, 2]


def test_growing_counts_every_object_once_and_spends_what_a_pass_finds():
    options, random = AutomatonOptions(grow_epochs=1), torch.Generator().manual_seed(1)
    blocks = TrainingObjects(bars_task(60), load_profile("dmd-four-snspd"), options).epoch(0, 30, torch.float32)
    sight = Sight(WordLaw(ClickLaw(0.01), 2), 1 / 255)
    with torch.no_grad():
        growth = Growth(blocks, sight, random, options, 6)
        for _ in range(3):
            growth.grow(Aim(0.02, 0.005))
        passes = [forward(growth.machine(), sight, block.grey) for block in blocks]
    n = sum(len(block) for block in blocks)
    assert [level.successors.shape[0] for level in growth.levels] == [4, 4, 4]
    assert len(growth.levels[1].light.root) == 2 * growth.levels[1].n_states
    assert float(growth.counts.sum()) == pytest.approx(n, rel=1e-5)
    photons = sum(float(one.photons().sum()) for one in passes) / n
    clicks = sum(float(one.clicks().sum()) for one in passes) / n
    sent = sum(float(one.illumination().sum()) for one in passes) / n
    assert growth.spent == pytest.approx((clicks, photons, sent), rel=1e-5)


def test_growing_and_what_is_held_back_see_objects_that_are_moved():
    images = np.zeros((600, 5, 7), np.uint8)
    images[:, 2, 3] = 200
    point = Objects(images, np.arange(600) % 2)
    task = Task("point", ("a", "b"), point, point, "0" * 64, "none")
    objects = TrainingObjects(task, load_profile("ideal"), AutomatonOptions(shift_px=1, offset_px=2), 300)
    kinds = (
        objects.epoch(0, 300, torch.float32, plain=True),
        objects.epoch(7, 300, torch.float32),
        objects.held_back(300, torch.float32),
    )
    for blocks in kinds:
        seen = torch.cat([block.grey for block in blocks]).reshape(-1, 5, 7)
        found = np.bincount(5 * seen.amax(dim=1).argmax(dim=1) + seen.amax(dim=2).argmax(dim=1), minlength=35)
        places = found.reshape(7, 5)[2:5]  # columns by rows
        assert places.sum() == len(seen)
        assert ((places > 5) & (places < 40)).all()  # 20 in the mean
    assert not torch.equal(kinds[0][0].grey, kinds[1][0].grey)


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
