"""Three outcomes of an exposure: the exact pass against all words, its gradient, growing, edges; and two, bit for bit as before."""

# ruff: noqa: E402  (what follows needs torch)
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import assert_slope, bars_task, random_machine

from pans.runtime.bundle.model import load_bundle
from pans.runtime.core.plan import build_plan
from pans.runtime.errors import PlanError
from pans.runtime.instrument.click_law import CountLaw, count_chances
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.machine import Aim, Sight, backward, brought, forward
from pans.trainer.adaptive.outcomes import readings
from pans.trainer.adaptive.train import train_automaton
from pans.trainer.export.automaton import export_automaton
from pans.trainer.options import AutomatonOptions

LAWS = [CountLaw(0.0, 0.0, (0.5, 1.5)), CountLaw(0.02, 0.3, (0.5, 1.5)), CountLaw(0.01, 0.0, (0.5, 1.5, 2.5))]
GREY = torch.tensor([[0, 10, 255, 30, 7], [200, 0, 90, 255, 255], [0, 0, 0, 0, 0]], dtype=torch.float64)
ONE_HOT = torch.tensor([[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0]], dtype=torch.float64)


def counting_machine(outcomes, seed=0):
    """The machine of `random_machine`, with more outcomes, each of which leads somewhere."""
    machine = random_machine(seed)
    for number, level in enumerate(machine.levels):
        more = [(level.successors[1] + 1 + k) % machine.n_nodes(number) for k in range(outcomes - 2)]
        level.successors = torch.stack([*level.successors, *more])
    return machine


def wide(law, floor=0.01):
    return Sight(law, 1 / 255, floor, torch.float64)


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_chances_and_falls_are_the_runtimes(law):
    light = np.array([0.0, 1e-7, 0.01, 0.5, 1.0, 3.0, 10.0, 40.0])
    chances, falls = readings(torch.from_numpy(light), law)
    assert len(chances) == len(falls) == law.outcomes - 1
    np.testing.assert_allclose(torch.stack(chances).numpy(), count_chances(law, light)[:-1], rtol=1e-6, atol=1e-8)
    step = np.minimum(light, 1e-4) / 2
    lit = light > 1e-3
    slopes = (count_chances(law, light + step) - count_chances(law, light - step))[:-1, lit] / (2 * step[lit])
    np.testing.assert_allclose(torch.stack(falls).numpy()[:, lit], -slopes, rtol=1e-6, atol=1e-8)


def walked(machine, sight, law, i):
    """The chance of every leaf, photons and counted photons of object i, word by word."""
    light = [brought(level.light, sight, GREY)[:, i].numpy() for level in machine.levels]
    chances = [count_chances(law, of_level) for of_level in light]
    leaves, photons, clicks = {}, 0.0, 0.0
    for word in product(range(law.outcomes), repeat=len(machine.levels)):
        chance, state, spent, seen = 1.0, 0, 0.0, 0
        for number, (level, outcome) in enumerate(zip(machine.levels, word)):
            chance *= chances[number][outcome, state]
            spent, seen = spent + light[number][state], seen + outcome
            node = int(level.successors[outcome, state])
            n_states = machine.levels[number + 1].n_states if number + 1 < len(machine.levels) else 0
            if node >= n_states:
                chance /= law.outcomes ** (
                    len(machine.levels) - number - 1
                )  # words that differ behind the leaf are one walk
                break
            state = node
        place = number, node - n_states
        leaves[place] = leaves.get(place, 0.0) + chance
        photons, clicks = photons + chance * spent, clicks + chance * seen
    return leaves, photons, clicks


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_forward_is_the_sum_over_all_words(law):
    machine, sight = counting_machine(law.outcomes, 1), wide(law)
    passed = forward(machine, sight, GREY)
    for i in range(len(GREY)):
        leaves, photons, clicks = walked(machine, sight, law, i)
        for (number, leaf), chance in leaves.items():
            assert float(passed.leaves[number][leaf, i]) == pytest.approx(chance, rel=1e-7)
        assert float(torch.cat(passed.leaves)[:, i].sum()) == pytest.approx(1.0, abs=1e-14)
        assert float(passed.photons()[i]) == pytest.approx(photons, rel=1e-7)
        assert float(passed.clicks()[i]) == pytest.approx(clicks, rel=1e-7)


def loss_of(machine, sight, aim):
    passed = forward(machine, sight, GREY)
    total = aim.price * float(passed.photons().mean())
    for counts, leaves in zip(machine.counts, passed.leaves):
        log = torch.log(counts / counts.sum(dim=1, keepdim=True))
        total -= float(((leaves @ ONE_HOT.T) * log).sum()) / len(GREY)
    return total


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_gradient_is_that_of_the_loss(law):
    machine, sight, aim = counting_machine(law.outcomes, 3), wide(law), Aim(0.07)
    backward(machine, sight, GREY, ONE_HOT, forward(machine, sight, GREY), aim)
    for level in machine.levels:
        assert_slope(level.light.root, lambda: loss_of(machine, sight, aim))


SMALL = AutomatonOptions(
    photons=4.0, exposures=4, states=8, batch=64, tune_epochs=1, epochs=3, first_price=0.1, outcomes=3, reroutes=1
)


def test_a_training_ends_in_a_bundle_that_is_evaluated(tmp_path):
    task, profile = bars_task(), load_profile("oled-qcmos")
    profile = replace(profile, detector=replace(profile.detector, photon_number_max=3))
    trained = train_automaton(task, profile, SMALL)
    made = export_automaton(tmp_path / "bars.pans", trained, task, profile, name="bars", provenance={})
    automaton = load_bundle(tmp_path / "bars.pans")[0].automaton
    assert automaton.counts
    assert (automaton.n_outcomes, automaton.n_slots) == (3, 4)
    assert made.difference < 1e-5  # of class chances, between the float64 sums of the file and the machine's
    assert made.measured.accuracy_mean > 0.5  # four classes: 0.25 by chance
    assert made.measured.photons_mean == pytest.approx(4.0, rel=0.1)
    clicks_only = replace(profile, detector=replace(profile.detector, photon_number_max=1))
    with pytest.raises(PlanError, match=r"3 outcomes per exposure.*tells 2 apart"):
        build_plan(clicks_only, made.bundle)
