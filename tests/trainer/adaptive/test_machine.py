"""The exact forward pass and its gradient: against all click words one by one, and against differences of the loss."""

# ruff: noqa: E402  (what follows needs torch)
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from mpmath import mp, mpf
from naive_adaptive import every_word
from trainings import assert_slope, random_machine

from pans.runtime.instrument.click_law import ClickLaw
from pans.trainer.adaptive.machine import WRONG, Aim, Sight, as_bits, backward, brought, forward
from pans.trainer.adaptive.objects import Block
from pans.trainer.adaptive.tune import figures

NOISY = ClickLaw(dark_per_exposure=0.02, read_noise_e=0.3, threshold_e=0.5)
LAWS = (ClickLaw(), ClickLaw(0.05), NOISY)
GREY = torch.tensor([[0, 10, 255, 30, 7], [200, 0, 90, 255, 255], [0, 0, 0, 0, 0]], dtype=torch.float64)
ONE_HOT = torch.tensor([[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0]], dtype=torch.float64)


def wide(law, floor=0.0, gain=1 / 255):
    return Sight(law, gain, floor, torch.float64)


@pytest.mark.parametrize("dark", [0.0, 0.05])
@pytest.mark.parametrize("bits", [False, True])
def test_forward_is_the_sum_over_all_words(dark, bits):
    machine, sight = random_machine(1, bits), wide(ClickLaw(dark), 0.01)
    passed = forward(machine, sight, GREY)
    successors = [level.successors.tolist() for level in machine.levels]
    n_states = [level.n_states for level in machine.levels] + [0]
    for i in range(len(GREY)):
        light = [brought(level.light, sight, GREY)[:, i].tolist() for level in machine.levels]
        leaves, clicks, photons, exposures = every_word(successors, n_states, light, dark)
        assert float(sum(leaves.values())) == pytest.approx(1.0, abs=1e-15)
        for (level, leaf), chance in leaves.items():
            assert float(passed.leaves[level - 1][leaf, i]) == pytest.approx(float(chance), rel=1e-12, abs=1e-300)
        assert float(passed.clicks()[i]) == pytest.approx(float(clicks), rel=1e-12)
        assert float(passed.photons()[i]) == pytest.approx(float(photons), rel=1e-12)
        assert sum(float(step.alpha[:, i].sum()) for step in passed.steps) == pytest.approx(float(exposures), rel=1e-12)


@pytest.mark.parametrize("light", [1e-30, 1e-7, 3.0, 50.0, 1e4])
def test_forward_keeps_tiny_and_nearly_certain_chances(light):
    machine, sight = random_machine(2), wide(ClickLaw(), gain=1.0)
    for level in machine.levels:
        level.light.root = torch.full_like(level.light.root, (light / 5) ** 0.5)
    passed = forward(machine, sight, torch.ones(1, 5, dtype=torch.float64))
    mp.dps = 60
    exact = float(mpf(1) - mp.exp(-mpf(light)))
    got = float((passed.steps[0].alpha * (1 - passed.steps[0].dark)).sum())
    assert got == pytest.approx(exact, rel=1e-12, abs=2e-16)
    assert torch.cat(passed.leaves).sum().item() == pytest.approx(1.0, abs=1e-15)
    assert all(bool((leaves >= 0).all()) for leaves in passed.leaves)


def loss_of(machine, sight, aim):
    passed = forward(machine, sight, GREY)
    total = aim.price * float(passed.photons().mean())
    total += aim.exposure_price * sum(float(step.alpha.sum()) for step in passed.steps) / len(GREY)
    for counts, leaves in zip(machine.counts, passed.leaves):
        log = torch.log(counts / counts.sum(dim=1, keepdim=True))
        arrived = leaves @ ONE_HOT.T
        total -= (1 - aim.decide) * float((arrived * log).sum()) / len(GREY)
        wrong = arrived.sum() - arrived[torch.arange(len(counts)), counts.argmax(dim=1)].sum()
        total += aim.decide * WRONG * float(wrong) / len(GREY)
    return total


AIMS = [Aim(0.07), Aim(0.07, decide=1.0), Aim(0.05, 0.03, 0.6)]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("floor", [0.0, 0.02])
@pytest.mark.parametrize("aim", AIMS)
def test_gradient_of_grey_patterns_is_that_of_the_loss(law, floor, aim):
    machine, sight = random_machine(3), wide(law, floor)
    backward(machine, sight, GREY, ONE_HOT, forward(machine, sight, GREY), aim)
    for level in machine.levels:
        assert_slope(level.light.root, lambda: loss_of(machine, sight, aim))


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("aim", AIMS)
def test_gradient_of_the_brightness_of_bits(shared, aim):
    machine, sight = random_machine(4, bits=True, shared=shared), wide(ClickLaw(0.01), 0.01)
    backward(machine, sight, GREY, ONE_HOT, forward(machine, sight, GREY), aim)
    tensors = {id(level.light.log_light): level.light.log_light for level in machine.levels}
    assert len(tensors) == (1 if shared else 3)
    for tensor in tensors.values():
        assert_slope(tensor, lambda: loss_of(machine, sight, aim))


def test_figures_are_means_over_the_objects():
    machine, sight = random_machine(6), wide(ClickLaw(0.02), 0.01)
    found = figures(machine, sight, [Block(GREY[:2], ONE_HOT[:, :2]), Block(GREY[2:], ONE_HOT[:, 2:])])
    passed = forward(machine, sight, GREY)
    assert found.clicks == pytest.approx(float(passed.clicks().mean()))
    assert found.photons == pytest.approx(float(passed.photons().mean()))
    right = sum(
        float(leaves[leaf, i])
        for counts, leaves in zip(machine.counts, passed.leaves)
        for leaf in range(len(leaves))
        for i in range(3)
        if int(counts[leaf].argmax()) == int(ONE_HOT[:, i].argmax())
    )
    assert found.accuracy == pytest.approx(right / 3)
    clear = forward(machine, Sight(ClickLaw(0.02), 1.0, 0.0, torch.float64), torch.ones(1, 5, dtype=torch.float64))
    shown = [step.light[:, 0] for step in clear.steps]
    walked = sum(float(step.alpha.mean(dim=1) @ light) for step, light in zip(passed.steps, shown))
    assert found.illumination == pytest.approx(walked)


@pytest.mark.parametrize("top", [1e6, 0.5, 0.3])
def test_bits_made_from_grey_patterns_keep_their_light_within_the_top(top):
    random = torch.Generator().manual_seed(1)
    grey = torch.rand(20, 60, generator=random, dtype=torch.float64) ** 6
    mean = torch.rand(20, 60, generator=random, dtype=torch.float64)
    bits = as_bits(grey, mean, top)
    mask, scale = bits.displayed()
    torch.testing.assert_close(scale.squeeze(1) * (mask * mean).sum(dim=1), (grey * mean).sum(dim=1))
    assert float(scale.max()) <= top * (1 + 1e-9)
    lit = mask.sum(dim=1)
    assert bool((lit >= (grey > 0.2 * grey.amax(dim=1, keepdim=True)).sum(dim=1)).all())
    darkest_lit = torch.where(mask > 0, grey, torch.inf).amin(dim=1)
    brightest_dark = torch.where(mask > 0, 0.0, grey).amax(dim=1)
    assert bool((darkest_lit >= brightest_dark).all())


@pytest.mark.parametrize("bits", [False, True])
def test_the_gradient_through_optics_holds_the_light_of_dark_pixels(bits):
    """One more column of grey values: what a pattern's full pixel brings through its dark ones."""
    machine = random_machine(7, bits)
    sight = Sight(ClickLaw(0.01), 1 / 255, 0.0, torch.float64, dark_pixels=True)
    grey = torch.cat([GREY, torch.tensor([[40.0], [90.0], [10.0]], dtype=torch.float64)], dim=1)

    def loss():
        passed = forward(machine, sight, grey)
        total = 0.07 * float(passed.photons().mean())
        for counts, leaves in zip(machine.counts, passed.leaves):
            total -= float(((leaves @ ONE_HOT.T) * torch.log(counts / counts.sum(dim=1, keepdim=True))).sum()) / len(
                grey
            )
        return total

    light = machine.levels[1].light
    mask, scale = light.displayed()
    scale = torch.ones(len(mask), 1) if scale is None else scale
    wanted = scale * (mask @ GREY.T + light.full(mask) * torch.tensor([40.0, 90.0, 10.0])) / 255
    torch.testing.assert_close(brought(light, sight, grey), wanted)
    backward(machine, sight, grey, ONE_HOT, forward(machine, sight, grey), Aim(0.07))
    for level in machine.levels:
        tensor = level.light.log_light if bits else level.light.root
        assert_slope(tensor, loss)
