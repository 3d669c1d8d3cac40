"""States that share patterns: the grouping, the light it keeps, and the gradient of the pool."""

# ruff: noqa: E402  (what follows needs torch)
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task, random_machine

from pans.runtime.instrument.click_law import ClickLaw, CountLaw
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive import sweeps as module
from pans.trainer.adaptive.grow import GrowOptions, Growth
from pans.trainer.adaptive.machine import Bits, Sight, as_bits, brought, forward, leaf_losses
from pans.trainer.adaptive.objects import Augmentation, TrainingObjects
from pans.trainer.adaptive.sweeps import choose_patterns, k_means, one_bit, share_patterns
from pans.trainer.adaptive.tune import figures, masses, mean_objects

PRICE = 0.02


def test_k_means_finds_groups_that_are_far_apart():
    random = torch.Generator().manual_seed(0)
    centres = torch.tensor([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    truth = torch.arange(90) % 3
    points = centres[truth] + 0.1 * torch.randn(90, 2, generator=random)
    found = 0
    for seed in range(8):  # from two starts in one group the rounds may end there
        group = k_means(points, torch.ones(90), 3, torch.Generator().manual_seed(seed))
        assert len(group.unique()) == 3
        found += all(len(group[truth == number].unique()) == 1 for number in range(3))
    assert found >= 2


def test_k_means_serves_heavy_points_better():
    points = torch.tensor([[0.0], [1.0], [10.0], [11.0]])
    group = k_means(points, torch.tensor([1000.0, 1000.0, 0.1, 0.1]), 3, torch.Generator().manual_seed(0))
    assert group[2] == group[3]
    assert group[0] != group[1]


def test_states_of_a_group_show_one_pattern_and_keep_their_light():
    machine, sight = random_machine(1, bits=True), Sight(ClickLaw(), 1.0, 0.0, torch.float64)
    mean = torch.tensor([0.2, 0.4, 0.9, 0.5, 0.3], dtype=torch.float64)
    before = [brought(level.light, sight, mean.unsqueeze(0)) for level in machine.levels]
    was_dark = [light.sum() == 0 for level in before for light in level]
    weights = [torch.ones(level.n_states, dtype=torch.float64) for level in machine.levels]
    with torch.no_grad():
        torch.set_default_dtype(torch.float64)
        try:
            own = [mean.expand(level.n_states, 5) for level in machine.levels]
            share_patterns(machine, 3, weights, own, torch.Generator().manual_seed(0))
        finally:
            torch.set_default_dtype(torch.float32)
    masks = torch.cat([level.light.shown()[0] for level in machine.levels])
    assert len(masks.unique(dim=0)) <= 3
    after = [light for level in machine.levels for light in brought(level.light, sight, mean.unsqueeze(0))]
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
    shared.take(slope.clone(), light.clone())
    single.take(slope.clone(), light.clone())
    torch.testing.assert_close(shared.lean.grad[0], single.lean.grad[1])
    torch.testing.assert_close(shared.lean.grad[1], single.lean.grad[0] + single.lean.grad[2])
    torch.testing.assert_close(shared.shown()[0], single.shown()[0])


def test_the_pattern_of_a_group_is_the_one_nearest_in_direction_of_all_there_are():
    random = torch.Generator().manual_seed(3)
    sums = torch.rand(20, 7, generator=random, dtype=torch.float64) ** 3
    every = (torch.arange(1, 128).unsqueeze(1) >> torch.arange(7) & 1).double()
    cosine = sums @ every.T / every.sum(dim=1).sqrt()
    assert torch.equal((one_bit(sums) > 0).double(), every[cosine.argmax(dim=1)])


def test_a_group_of_patterns_that_differ_keeps_many_pixels_lit():
    points = torch.eye(6).repeat_interleave(3, dim=0) + 0.2  # a mean of +1 and -1 would leave no pixel lit
    lit = (one_bit(points.sum(dim=0, keepdim=True)) > 0).sum()
    assert int(lit) == 6


@pytest.fixture
def shared():
    objects = TrainingObjects(bars_task(), load_profile("ideal"), 0, Augmentation())
    blocks, sight = objects.epoch(0, 200, torch.float32), Sight(ClickLaw(), objects.gain)
    return *grown_and_shared(blocks, sight), blocks


def grown_and_shared(blocks, sight):
    """A machine whose states share six patterns, before they have chosen."""
    with torch.no_grad():
        growth = Growth(blocks, sight, GrowOptions(states=8), torch.Generator().manual_seed(0))
        for _ in range(5):
            growth.grow(PRICE)
        machine = growth.machine()
        means = list(mean_objects(machine, sight, blocks))
        for level, mean in zip(machine.levels, means):
            level.light = as_bits(level.light.shown()[0], mean)
        share_patterns(machine, 6, masses(machine, sight, blocks), means, torch.Generator().manual_seed(0))
    return machine, sight


def test_states_choose_the_patterns_that_cost_least(shared, monkeypatch):
    machine, sight, blocks = shared
    monkeypatch.setattr(module, "_use_all", lambda *_: None)  # it changes no figure, but would hide what was chosen

    def cost():
        found = figures(machine, sight, blocks)
        return found.loss + PRICE * found.photons

    for level in machine.levels:
        level.light.rows = torch.zeros_like(level.light.rows)
    spoiled = cost()
    told = [choose_patterns(machine, sight, blocks, PRICE) for _ in range(3)]
    assert told[0] > 0
    assert cost() < spoiled - 0.05
    before = cost()
    choose_patterns(machine, sight, blocks, PRICE)
    assert cost() <= before + 2e-3  # what the sweep keeps is rounded to bfloat16
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


def test_states_of_three_outcomes_choose_too(shared):
    _, click_sight, blocks = shared
    sight = replace(click_sight, law=CountLaw(0.0, 0.0, (0.5, 1.5)))
    machine, _ = grown_and_shared(blocks, sight)
    for level in machine.levels:
        assert len(level.successors) == 3
        level.light.rows.zero_()
    costs = []
    for _ in range(3):
        found = figures(machine, sight, blocks)
        costs.append(found.loss + PRICE * found.photons)
        assert choose_patterns(machine, sight, blocks, PRICE) > 0
    assert costs[0] - 0.05 > costs[1] > costs[2] - 2e-3


def test_light_sent_out_costs_even_where_light_detected_does_not(shared, monkeypatch):
    machine, sight, blocks = shared
    start = [(level.light.rows.clone(), level.light.log_light.clone()) for level in machine.levels]
    lean = machine.levels[0].light.lean.clone()
    sent = []
    for glare in (0.0, 1e-5, 1e-2):
        monkeypatch.setattr(module, "GLARE_MIN", glare)
        for level, (rows, log_light) in zip(machine.levels, start):
            level.light.rows.copy_(rows)
            level.light.log_light.copy_(log_light)
        machine.levels[0].light.lean.copy_(lean)
        choose_patterns(machine, sight, blocks, 0.0)
        sent.append(figures(machine, sight, blocks).illumination)
    assert sent[0] >= sent[1] > 1.2 * sent[2] > 0


def test_the_nearest_are_those_of_the_largest_cosine_and_itself_is_first(monkeypatch):
    monkeypatch.setattr(module, "ROWS_AT_ONCE", 3)
    masks = (torch.rand(8, 30, generator=torch.Generator().manual_seed(2)) < 0.4).float()
    masks[5] = 0  # a dark pattern is like none, and still its own nearest
    found = module.nearest(module.directions(masks), 4)
    for row, near in enumerate(found.tolist()):
        assert near[0] == row
        cosine = {
            other: float(masks[row] @ masks[other]) / float(masks[row].norm() * masks[other].norm() + 1e-9)
            for other in range(8)
            if other != row
        }
        assert (
            sorted((round(cosine[other], 5) for other in near[1:]), reverse=True)
            == sorted((round(value, 5) for value in cosine.values()), reverse=True)[:3]
        )


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


def test_one_brightness_for_all_is_left_as_it_is():
    machine = random_machine(1, bits=True, shared=True)
    means = [torch.ones(level.n_states, 5, dtype=torch.float64) for level in machine.levels]
    weights = [torch.ones(level.n_states, dtype=torch.float64) for level in machine.levels]
    with torch.no_grad():
        share_patterns(machine, 3, weights, means, torch.Generator().manual_seed(0))
    assert [len(level.light.rows) for level in machine.levels] == [level.n_states for level in machine.levels]
    assert all(level.light.log_light.item() == -1.0 for level in machine.levels)
