"""The exact forward pass and its gradient: against all outcome words one by one, and against differences of the loss."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from trainings import assert_slope, random_machine

from pans.instrument.click_law import ClickLaw, CountLaw, click_probability, count_chances
from pans_trainer.train.automaton.machine import WRONG, Aim, Bits, Sight, as_bits, backward, brought, forward
from pans_trainer.train.automaton.objects import Block
from pans_trainer.train.automaton.outcomes import WordLaw, channels_of, clicks_of, readings
from pans_trainer.train.automaton.tune import figures

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")
mp, mpf = mpmath.mp, mpmath.mpf

NOISY = ClickLaw(dark_per_exposure=0.02, read_noise_e=0.3, threshold_e=0.5)
CLICKS = (ClickLaw(), ClickLaw(0.05), NOISY)
COUNTS = (CountLaw(0.0, 0.0, (0.5, 1.5)), CountLaw(0.02, 0.3, (0.5, 1.5)), CountLaw(0.01, 0.0, (0.5, 1.5, 2.5)))
WORDS = (WordLaw(ClickLaw(0.02, 0.3, 0.6), 2), WordLaw(ClickLaw(0.02, 0.3, 0.6), 3))
LAWS = (*CLICKS, *COUNTS, *WORDS)
GREY = torch.tensor([[0, 10, 255, 30, 7], [200, 0, 90, 255, 255], [0, 0, 0, 0, 0]], dtype=torch.float64)
ONE_HOT = torch.tensor([[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0]], dtype=torch.float64)


def wide(law, floor=0.0, gain=1 / 255, **more):
    return Sight(law, gain, floor, torch.float64, **more)


def machine_under(law, seed, bits=False, shared=False):
    """The machine of `random_machine` with as many outcomes and channels as `law`, each outcome leading somewhere."""
    channels = channels_of(law)
    machine, random = random_machine(seed, bits or channels > 1, shared), torch.Generator().manual_seed(seed)
    for number, level in enumerate(machine.levels):
        further = range(1, len(clicks_of(law)) - 1)
        more = [(level.successors[1] + k) % machine.n_nodes(number) for k in further]
        level.successors = torch.stack([*level.successors, *more])
        if channels > 1:
            lean = torch.randn(level.n_states * channels, 5, generator=random, dtype=torch.float64)
            level.light = Bits(lean, level.light.log_light, parts=channels)
    return machine


def even_machine(law, seed, kind=Bits):
    """The same with states that send the same light in each level."""
    machine = machine_under(law, seed, bits=True)
    for level in machine.levels:
        light = level.light
        lean = light.lean.abs() + 0.1 if kind is Soft else light.lean
        level.light = kind(lean, light.log_light[:1].clone() + 1, even=True)
        level.light.settle()  # no state is dark
    return machine


class Soft(Bits):
    """Patterns that are as bright as they lean, so that the gradient of a mask has differences."""

    def displayed(self):
        return self.lean, self.scale()

    def lit(self):
        return self.lean.sum(dim=1, keepdim=True)

    def settle(self):
        pass


def chances_by_hand(law, light):
    """The chance of every outcome of a state, from the light (channels,)."""
    if isinstance(law, CountLaw):
        return count_chances(law, light)[:, 0]
    click = click_probability(law.click if isinstance(law, WordLaw) else law, light)
    words = range(1 << len(light))
    return [np.prod([p if word >> k & 1 else 1 - p for k, p in enumerate(click)]) for word in words]


def walked(machine, sight, law, i):
    """The chance of every leaf, and photons, clicks and exposures of object i, word by word."""
    channels, levels = channels_of(law), machine.levels
    light = [brought(level.light, sight, GREY)[0][:, i].numpy().reshape(-1, channels) for level in levels]
    leaves, sums = {}, np.zeros(3)
    for word in product(range(len(clicks_of(law))), repeat=len(levels)):
        chance, state, met, dose = 1.0, 0, np.zeros(3), 0.0
        for number, (level, outcome) in enumerate(zip(levels, word)):
            of_state = light[number][state]
            if sight.fades < math.inf:
                own = float(level.light.log_light.exp()) / sight.fades
                of_state, dose = of_state * math.exp(-dose) * (1 - math.exp(-own)) / own, dose + own
            chance *= chances_by_hand(law, of_state)[outcome]
            met += of_state.sum(), clicks_of(law)[outcome], 1
            node = int(level.successors[outcome, state])
            n_states = levels[number + 1].n_states if number + 1 < len(levels) else 0
            if node >= n_states:
                break
            state = node
        chance /= len(clicks_of(law)) ** (len(levels) - number - 1)  # words that differ behind the leaf are one walk
        leaves[number, node - n_states] = leaves.get((number, node - n_states), 0.0) + chance
        sums += chance * met
    return leaves, sums


def assert_all_words(machine, sight, law, rel, passed, totals):
    """Leaves and `totals` (photons, clicks and perhaps exposures) are those of all words, object by object."""
    for i in range(len(GREY)):
        leaves, sums = walked(machine, sight, law, i)
        for (number, leaf), chance in leaves.items():
            assert float(passed.leaves[number][leaf, i]) == pytest.approx(chance, rel=rel, abs=1e-300)
        np.testing.assert_allclose([float(each[i]) for each in totals], sums[: len(totals)], rtol=rel)


@pytest.mark.parametrize("bits", [False, True])
@pytest.mark.parametrize("law", LAWS, ids=str)
def test_forward_is_the_sum_over_all_words(law, bits):
    machine, sight, rel = machine_under(law, 1, bits), wide(law, 0.01), 1e-12 if law in (*CLICKS[:2], *WORDS) else 1e-7
    passed = forward(machine, sight, GREY)
    exposures = sum(step.alpha.sum(dim=0) for step in passed.steps)
    np.testing.assert_allclose(torch.cat(passed.leaves).sum(dim=0), 1.0, atol=1e-14)
    assert_all_words(machine, sight, law, rel, passed, (passed.photons(), passed.clicks(), exposures))


@pytest.mark.parametrize("law", [*CLICKS, *COUNTS], ids=str)
def test_where_states_send_the_same_light_bleaching_is_that_of_every_walk(law):
    machine, sight = even_machine(law, 1), wide(law, 0.01, fades=0.8)
    passed = forward(machine, sight, GREY)
    rel = 1e-12 if law in CLICKS[:2] else 1e-7
    assert_all_words(machine, sight, law, rel, passed, (passed.photons(), passed.clicks()))
    for step, level in zip(passed.steps, machine.levels):
        np.testing.assert_allclose(step.sent, float(level.light.log_light.exp()), rtol=1e-12)


@pytest.mark.parametrize("law", COUNTS, ids=str)
def test_chances_and_falls_are_the_runtimes(law):
    light = np.array([0.0, 1e-7, 0.01, 0.5, 1.0, 3.0, 10.0, 40.0])
    chances, falls = readings(torch.from_numpy(light), law)
    np.testing.assert_allclose(torch.stack(chances).numpy(), count_chances(law, light)[:-1], rtol=1e-6, atol=1e-8)
    step = np.minimum(light, 1e-4) / 2
    lit = light > 1e-3
    slopes = (count_chances(law, light + step) - count_chances(law, light - step))[:-1, lit] / (2 * step[lit])
    np.testing.assert_allclose(torch.stack(falls).numpy()[:, lit], -slopes, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("light", [1e-30, 1e-7, 3.0, 50.0, 1e4])
def test_forward_keeps_tiny_and_nearly_certain_chances(light):
    machine, sight = random_machine(2), wide(ClickLaw(), gain=1.0)
    for level in machine.levels:
        level.light.root = torch.full_like(level.light.root, (light / 5) ** 0.5)
    passed = forward(machine, sight, torch.ones(1, 5, dtype=torch.float64))
    mp.dps = 60
    exact = float(mpf(1) - mp.exp(-mpf(light)))
    got = float((passed.steps[0].alpha * (1 - passed.steps[0].chances[0])).sum())
    assert got == pytest.approx(exact, rel=1e-12, abs=2e-16)
    assert torch.cat(passed.leaves).sum().item() == pytest.approx(1.0, abs=1e-15)
    assert all(bool((leaves >= 0).all()) for leaves in passed.leaves)


def loss_of(machine, sight, aim, grey=GREY):
    passed = forward(machine, sight, grey)
    total = aim.price * float(passed.photons().mean()) + aim.sent_price * float(sent_of(machine, sight, grey).mean())
    total += aim.exposure_price * sum(float(step.alpha.sum()) for step in passed.steps) / len(grey)
    for counts, leaves in zip(machine.counts, passed.leaves):
        log = torch.log(counts / counts.sum(dim=1, keepdim=True))
        arrived = leaves @ ONE_HOT.T
        total -= (1 - aim.decide) * float((arrived * log).sum()) / len(grey)
        wrong = arrived.sum() - arrived[torch.arange(len(counts)), counts.argmax(dim=1)].sum()
        total += aim.decide * WRONG * float(wrong) / len(grey)
    return total


def assert_gradients(machine, sight, aim, grey=GREY):
    """The gradient of grey patterns, or of the brightness of bits, is that of the loss."""
    backward(machine, sight, grey, ONE_HOT, forward(machine, sight, grey), aim)
    lights = [level.light for level in machine.levels]
    tensors = [light.log_light if isinstance(light, Bits) else light.root for light in lights]
    for tensor in {id(tensor): tensor for tensor in tensors}.values():
        assert_slope(tensor, lambda: loss_of(machine, sight, aim, grey))


def sent_of(machine, sight, grey):
    """The light sent to each object: what its walk would detect of a clear one, (objects,)."""
    clear = replace(sight, gain=1.0, floor=0.0, dark_pixels=False, fades=math.inf)
    ones = torch.ones(1, grey.shape[1] - sight.dark_pixels, dtype=torch.float64)
    steps = zip(forward(machine, sight, grey).steps, forward(machine, clear, ones).steps)
    return sum((step.alpha * alone.whole).sum(dim=0) for step, alone in steps)


AIMS = [Aim(0.07), Aim(0.07, decide=1.0), Aim(0.05, 0.0, 0.03, 0.6), Aim(0.0, 0.04), Aim(0.03, 0.02, decide=0.5)]


@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("floor", [0.0, 0.02])
@pytest.mark.parametrize("aim", AIMS)
def test_the_gradient_is_that_of_the_loss(law, floor, aim):
    assert_gradients(machine_under(law, 3), wide(law, floor), aim)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("aim", AIMS)
def test_the_gradient_of_the_brightness_of_bits(shared, aim):
    machine = random_machine(4, bits=True, shared=shared)
    assert len({id(level.light.log_light) for level in machine.levels}) == (1 if shared else 3)
    assert_gradients(machine, wide(ClickLaw(0.01), 0.01), aim)


@pytest.mark.parametrize(
    ("law", "fades"), [(ClickLaw(0.01), math.inf), (ClickLaw(0.01), 0.8), (COUNTS[1], 0.8)], ids=str
)
@pytest.mark.parametrize("aim", AIMS)
def test_the_gradient_where_states_send_the_same_light(law, fades, aim):
    sight = wide(law, 0.01, fades=fades)
    assert_gradients(even_machine(law, 4), sight, aim)
    machine = even_machine(law, 4, Soft)
    backward(machine, sight, GREY, ONE_HOT, forward(machine, sight, GREY), aim)
    for level in machine.levels:
        lean = level.light.lean
        lean.grad *= (1 + 2 * lean**2) ** 2  # which stands for the step of a bit
        assert_slope(lean, lambda: loss_of(machine, sight, aim))


def test_the_light_of_an_even_level_is_kept_by_lighting_more_pixels_or_fewer():
    random = torch.Generator().manual_seed(1)
    lean = torch.randn(6, 40, generator=random)
    lean[0], lean[1] = -1.0, 1.0  # dark, and all pixels alike
    bits = Bits(lean.clone(), torch.zeros(1, 1), bottom=0.05, top=0.1, even=True)
    bits.settle()
    mask, scale = bits.displayed()
    torch.testing.assert_close((mask * scale).sum(dim=1), torch.ones(6))
    assert bool((scale >= 0.05 * (1 - 1e-6)).all())
    assert bool((scale <= 0.1 * (1 + 1e-6)).all())
    for kept, before in zip(mask[2:], lean[2:]):
        assert float(before[kept > 0].min()) > float(before[kept == 0].max())  # those that lean to it most


@pytest.mark.parametrize("bits", [False, True])
def test_the_gradient_through_optics_holds_the_light_of_dark_pixels(bits):
    """One more column of grey values: what a pattern's full pixel brings through its dark ones."""
    machine, sight = random_machine(7, bits), wide(ClickLaw(0.01), dark_pixels=True)
    leak = torch.tensor([40.0, 90.0, 10.0], dtype=torch.float64)
    grey = torch.cat([GREY, leak.unsqueeze(1)], dim=1)
    light = machine.levels[1].light
    mask, scale = light.displayed()
    scale = torch.ones(len(mask), 1) if scale is None else scale
    torch.testing.assert_close(brought(light, sight, grey)[0], scale * (mask @ GREY.T + light.full(mask) * leak) / 255)
    assert_gradients(machine, sight, Aim(0.07, 0.02), grey)


def test_figures_are_means_over_the_objects():
    machine, sight = random_machine(6), wide(ClickLaw(0.02), 0.01)
    found = figures(machine, sight, [Block(GREY[:2], ONE_HOT[:, :2]), Block(GREY[2:], ONE_HOT[:, 2:])])
    passed = forward(machine, sight, GREY)
    right = sum(
        float(leaves[leaf, i])
        for counts, leaves in zip(machine.counts, passed.leaves)
        for leaf in range(len(leaves))
        for i in range(3)
        if int(counts[leaf].argmax()) == int(ONE_HOT[:, i].argmax())
    )
    walked = float(sent_of(machine, sight, GREY).mean())
    wanted = [right / 3, float(passed.clicks().mean()), float(passed.photons().mean()), walked]
    assert [found.accuracy, found.clicks, found.photons, found.illumination] == pytest.approx(wanted)


@pytest.mark.parametrize("top", [1e6, 0.5, 0.3])
def test_bits_made_from_grey_patterns_keep_their_light_within_the_top(top):
    random = torch.Generator().manual_seed(1)
    grey = torch.rand(20, 60, generator=random, dtype=torch.float64) ** 6
    mean = torch.rand(20, 60, generator=random, dtype=torch.float64)
    mask, scale = as_bits(grey, mean, top).displayed()
    torch.testing.assert_close(scale.squeeze(1) * (mask * mean).sum(dim=1), (grey * mean).sum(dim=1))
    assert float(scale.max()) <= top * (1 + 1e-9)
    assert bool((mask.sum(dim=1) >= (grey > 0.2 * grey.amax(dim=1, keepdim=True)).sum(dim=1)).all())
    darkest_lit = torch.where(mask > 0, grey, torch.inf).amin(dim=1)
    brightest_dark = torch.where(mask > 0, 0.0, grey).amax(dim=1)
    assert bool((darkest_lit >= brightest_dark).all())


def test_parts_of_a_state_keep_their_light_under_one_brightness():
    random = torch.Generator().manual_seed(3)
    grey, own = torch.rand(8, 200, generator=random), torch.rand(8, 200, generator=random)
    grey = (grey - 0.6).clamp(min=0)  # patterns that are dark in places, as trained ones are
    grey[::2] *= 0.3
    bits = as_bits(grey, own, parts=2)
    mask, scale = bits.displayed()
    assert (len(bits.log_light), len(scale)) == (4, 8)
    brought, wanted = ((mask * own).sum(dim=1) * scale.flatten()), (grey * own).sum(dim=1)
    assert float(((brought - wanted).abs() / scale.flatten()).max()) <= 1.0  # within one pixel
