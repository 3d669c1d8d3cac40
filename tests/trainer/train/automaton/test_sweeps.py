"""A sweep that moves edges: it never raises the loss of its objects, and leaves no node without an edge."""

import pytest
import torch
from trainings import bars_task, random_machine

from pans.instrument.click_law import ClickLaw
from pans.instrument.profile import load_profile
from pans_trainer.options import AutomatonOptions
from pans_trainer.train.automaton import sweeps as module
from pans_trainer.train.automaton.grow import Growth
from pans_trainer.train.automaton.machine import Aim, Bits, Sight, as_bits, brought, forward, leaf_losses
from pans_trainer.train.automaton.objects import TrainingObjects
from pans_trainer.train.automaton.sweeps import choose_patterns, reroute, share_patterns
from pans_trainer.train.automaton.tune import figures, masses, mean_objects

PRICE = 0.02
DEAR = 0.03  # nats per exposure


def grow(levels):
    options = AutomatonOptions()
    objects = TrainingObjects(bars_task(), load_profile("ideal"), options)
    blocks = objects.epoch(0, 200, torch.float32)
    sight = Sight(ClickLaw(), objects.gain)
    with torch.no_grad():
        growth = Growth(blocks, sight, torch.Generator().manual_seed(0), options, 8)
        for _ in range(levels):
            growth.grow(Aim(PRICE))
    return growth.machine(), sight, blocks


@pytest.fixture
def grown():
    return grow(6)


@pytest.fixture
def shared():
    """A machine whose states share six patterns, before they have chosen."""
    machine, sight, blocks = grow(5)
    with torch.no_grad():
        means = list(mean_objects(machine, sight, blocks))
        for level, mean in zip(machine.levels, means):
            level.light = as_bits(level.light.displayed()[0], mean)
        share_patterns(machine, 6, masses(machine, sight, blocks), means, torch.Generator().manual_seed(0))
    return machine, sight, blocks


def cost(machine, sight, blocks):
    found = figures(machine, sight, blocks)
    return found.loss + PRICE * found.photons


def test_edges_spoiled_are_put_right(grown, monkeypatch):
    machine, sight, blocks = grown
    good = cost(machine, sight, blocks)
    for level in machine.levels[2:5]:
        level.successors = level.successors.flip(1)
    spoiled = cost(machine, sight, blocks)
    assert spoiled > good + 0.05
    monkeypatch.setattr(module, "SURE", 0.0)
    for _ in range(3):
        before = cost(machine, sight, blocks)
        assert reroute(machine, sight, blocks, Aim(PRICE)) > 0
        after = cost(machine, sight, blocks)
        # the light is kept in bfloat16, and revived leaves are counted anew by the caller
        assert after <= before + 2e-3
    assert after < good + 0.3 * (spoiled - good)


def test_nodes_without_an_edge_are_revived(grown, monkeypatch):
    machine, sight, blocks = grown
    monkeypatch.setattr(module, "SURE", 1e9)  # so that no other edge moves
    machine.levels[3].successors[:] = 0
    assert reroute(machine, sight, blocks, Aim(PRICE)) == 0
    used = torch.bincount(machine.levels[3].successors.flatten(), minlength=8)
    assert bool((used > 0).all())


def test_walks_end_where_exposures_cost_more_than_they_bring(grown, monkeypatch):
    machine, sight, blocks = grown
    monkeypatch.setattr(module, "SURE", 0.0)

    def dear():
        return cost(machine, sight, blocks) + DEAR * figures(machine, sight, blocks).exposures

    before, all_of_them = dear(), figures(machine, sight, blocks).exposures
    reroute(machine, sight, blocks, Aim(PRICE, exposure_price=DEAR))
    assert all_of_them == pytest.approx(6.0, abs=1e-4)
    assert figures(machine, sight, blocks).exposures < 5.5
    assert before - dear() > 0.01
    first = next(number for number, counts in enumerate(machine.counts) if len(counts))
    early = sum(float(forward(machine, sight, block.grey).leaves[first].sum()) for block in blocks)
    counted = float(machine.counts[first].sum()) - len(machine.counts[first])  # and an object per leaf, for its doubts
    # nothing before it moved after it; the sweep sees light in bfloat16
    assert counted == pytest.approx(early, rel=0.05)


def test_states_of_a_group_show_one_pattern_and_keep_their_light():
    machine, sight = random_machine(1, bits=True), Sight(ClickLaw(), 1.0, 0.0, torch.float64)
    mean = torch.tensor([0.2, 0.4, 0.9, 0.5, 0.3], dtype=torch.float64)
    before = [brought(level.light, sight, mean.unsqueeze(0))[0] for level in machine.levels]
    was_dark = [light.sum() == 0 for level in before for light in level]
    weights = [torch.ones(level.n_states, dtype=torch.float64) for level in machine.levels]
    with torch.no_grad():
        torch.set_default_dtype(torch.float64)
        try:
            own = [mean.expand(level.n_states, 5) for level in machine.levels]
            share_patterns(machine, 3, weights, own, torch.Generator().manual_seed(0))
        finally:
            torch.set_default_dtype(torch.float32)
    masks = torch.cat([level.light.displayed()[0] for level in machine.levels])
    assert len(masks.unique(dim=0)) <= 3
    after = [light for level in machine.levels for light in brought(level.light, sight, mean.unsqueeze(0))[0]]
    for old, new, dark in zip([light for level in before for light in level], after, was_dark):
        if not dark and float(new) > 0:
            assert float(new) == pytest.approx(float(old), rel=1e-9)


def test_the_gradient_of_a_pool_is_the_sum_over_its_states():
    pool = torch.tensor([[0.3, -0.2], [0.1, 0.5]], dtype=torch.float64)
    own = pool[torch.tensor([1, 0, 1])].clone()
    slope = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], dtype=torch.float64)
    light = torch.zeros(3, 1, dtype=torch.float64)
    shared = Bits(pool, light.clone(), rows=torch.tensor([1, 0, 1]))
    single = Bits(own, light.clone())
    for bits in (shared, single):
        bits.set_gradients(slope.clone(), light.clone())
    torch.testing.assert_close(shared.lean.grad[0], single.lean.grad[1])
    torch.testing.assert_close(shared.lean.grad[1], single.lean.grad[0] + single.lean.grad[2])
    torch.testing.assert_close(shared.displayed()[0], single.displayed()[0])


def test_states_choose_the_patterns_that_cost_least(shared, monkeypatch):
    machine, sight, blocks = shared
    monkeypatch.setattr(module, "_use_all", lambda *_: None)  # it changes no figure, but would hide what was chosen
    for level in machine.levels:
        level.light.rows = torch.zeros_like(level.light.rows)
    spoiled = cost(machine, sight, blocks)
    for _ in range(3):
        choose_patterns(machine, sight, blocks, Aim(PRICE))
    assert cost(machine, sight, blocks) < spoiled - 0.05
    before = cost(machine, sight, blocks)
    choose_patterns(machine, sight, blocks, Aim(PRICE))
    assert cost(machine, sight, blocks) <= before + 2e-3  # what the sweep keeps is rounded to bfloat16
    level = machine.levels[-1]  # behind it stands nothing but leaves: by hand, over all patterns and 200 brightnesses
    steps = [forward(machine, sight, block.grey).steps[-1] for block in blocks]
    losses = [leaf_losses(machine.counts[-1], block.one_hot) for block in blocks]
    for state in range(level.n_states):
        alpha = torch.cat([step.alpha[state] for step in steps])
        quiet, click = (torch.cat([loss[level.successors[k, state]] for loss in losses]) for k in (0, 1))

        def of(light, alpha=alpha, quiet=quiet, click=click):
            dark = torch.exp(-light)
            return float((alpha * (dark * quiet + (1 - dark) * click + PRICE * light)).sum())

        masks = (level.light.lean > 0).float()
        seen = torch.cat([sight.light(masks, block.grey) for block in blocks], dim=1)
        least = min(of(row * 10**power) for row in seen for power in torch.linspace(-3, 2, 100).tolist())
        now = of(seen[level.light.rows[state]] * level.light.scale()[state])
        dearest = float((alpha * torch.maximum(quiet, click)).sum())
        assert now <= least + 0.1 * max(0.0, dearest - least) + 5 * module.SURE_OF_PATTERN * float(alpha.sum())


def test_patterns_that_nothing_shows_take_half_of_the_states_of_others(shared):
    machine, sight, blocks = shared
    for level in machine.levels:
        level.light.rows.zero_()
    before = figures(machine, sight, blocks).loss
    lights = [level.light for level in machine.levels]
    module._use_all(lights, masses(machine, sight, blocks))
    shown = torch.cat([light.rows for light in lights]).unique()
    assert len(shown) == 6
    assert figures(machine, sight, blocks).loss == pytest.approx(before, rel=1e-6)  # they are copies
