"""How concentrated the light of a pattern is, its gradient, and what its penalty does to trained patterns."""

# ruff: noqa: E402  (what follows needs torch)
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import random_machine

from pans.runtime.instrument.click_law import ClickLaw
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.machine import Aim, Sight, backward, forward
from pans.trainer.model.encoders import concentration, concentration_slope, concentrations
from pans.trainer.options import Options
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.loop import train


def stated(pattern):
    """The brightness that the light of a pattern meets on average, over the mean of all pixels, as a logarithm."""
    return np.log((pattern * pattern / pattern.sum()).sum() / pattern.mean())


@pytest.mark.parametrize("lit", [1, 7, 50])
def test_pixels_that_are_lit_alike_are_counted_and_their_brightness_does_not_matter(lit):
    patterns = torch.zeros(2, 50, dtype=torch.float64)
    patterns[0, :lit], patterns[1, 50 - lit :] = 1e-3, 80.0
    np.testing.assert_allclose(concentrations(patterns).numpy(), np.log(50 / lit), rtol=1e-12, atol=1e-12)


def test_a_pattern_without_light_is_no_fault():
    dark = torch.zeros(3, 9)
    assert bool(torch.isfinite(concentrations(dark)).all())
    assert bool(torch.isfinite(concentration_slope(dark)).all())


def test_slope_is_that_of_the_stated_measure():
    patterns = np.random.default_rng(0).random((3, 12))
    found, step = concentration_slope(torch.from_numpy(patterns)).numpy(), 1e-6
    assert float(concentration(torch.from_numpy(patterns))) == pytest.approx(np.mean([stated(p) for p in patterns]))
    for row, pixel in np.ndindex(*patterns.shape):
        above, below = patterns[row].copy(), patterns[row].copy()
        above[pixel] += step
        below[pixel] -= step
        assert found[row, pixel] == pytest.approx((stated(above) - stated(below)) / (2 * step), rel=1e-6, abs=1e-7)


def test_an_automaton_takes_the_slope_by_how_often_a_state_is_reached():
    machine, sight = random_machine(3), Sight(ClickLaw(), 1 / 255, 0.0, torch.float64)
    grey = torch.tensor([[0, 10, 255, 30, 7], [200, 0, 90, 255, 255]], dtype=torch.float64)
    one_hot = torch.tensor([[1, 0], [0, 1], [0, 0], [0, 0]], dtype=torch.float64)
    passed = forward(machine, sight, grey)
    backward(machine, sight, grey, one_hot, passed, Aim(0.07))
    without = [level.light.root.grad.clone() for level in machine.levels]
    backward(machine, sight, grey, one_hot, passed, Aim(0.07, spread=0.3))
    step = 1e-6
    for level, before, seen in zip(machine.levels, without, passed.steps):
        added = (level.light.root.grad - before).numpy()
        roots, reached = level.light.root.numpy(), seen.alpha.mean(dim=1).numpy()
        for state, pixel in np.ndindex(*roots.shape):
            above, below = roots[state].copy(), roots[state].copy()
            above[pixel] += step
            below[pixel] -= step
            slope = (stated(above**2) - stated(below**2)) / (2 * step)
            wanted = 0.3 / len(machine.levels) * reached[state] * slope
            assert added[state, pixel] == pytest.approx(wanted, rel=1e-4, abs=1e-8)


def test_its_weight_spreads_the_light_of_fixed_patterns(tmp_path):
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 4, 400)
    images = rng.integers(0, 50, (400, 6, 6), dtype=np.uint8)
    images[np.arange(400), :, labels + 1] = 250
    np.savez(tmp_path / "bars.npz", images=images, labels=labels)
    task, profile = load_task(str(tmp_path / "bars.npz")), load_profile("oled-qcmos")
    options = Options(features=3, photons=6.0, epochs=6, hidden=16, batch=64, front_rate=3e-2)
    found = []
    for weight in (0.0, 0.5):
        patterns = train(task, profile, replace(options, spread=weight)).float_patterns.astype(float)
        found.append(np.mean([stated(pattern) for pattern in patterns]))
    assert found[1] < found[0] - 0.1
