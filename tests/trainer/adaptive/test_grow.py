"""Merging by the information bottleneck, against an oracle that recomputes every cost and on known cases; growing of two channels."""

import numpy as np
import pytest
import torch
from naive_adaptive import merged as oracle
from trainings import bars_task

from pans.runtime.instrument.click_law import ClickLaw
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.grow import Growth, merged
from pans.trainer.adaptive.machine import Aim, Sight, forward
from pans.trainer.adaptive.objects import TrainingObjects
from pans.trainer.adaptive.outcomes import WordLaw
from pans.trainer.options import AutomatonOptions
from pans.trainer.tasks.registry import Objects, Task


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
