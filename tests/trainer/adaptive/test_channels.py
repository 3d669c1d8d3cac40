"""Several detectors at once: chances and gradient against sums over all words, training to a bundle and on from it, what is refused."""

# ruff: noqa: E402  (what follows needs torch)
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task

from pans.runtime.bundle.model import load_bundle
from pans.runtime.errors import PlanError, UsageError
from pans.runtime.instrument.click_law import ClickLaw, click_probability
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.budget import check_automaton_options, started_from
from pans.trainer.adaptive.grow import GrowOptions, Growth
from pans.trainer.adaptive.machine import Aim, Bits, Level, Machine, Sight, as_bits, backward, forward
from pans.trainer.adaptive.objects import Augmentation, TrainingObjects
from pans.trainer.adaptive.outcomes import WordLaw
from pans.trainer.adaptive.train import train_automaton
from pans.trainer.evaluate.walks import measured_walks, walks_of
from pans.trainer.export.automaton import export_automaton
from pans.trainer.options import AutomatonOptions

FOUR = load_profile("dmd-four-snspd")
GREY = torch.tensor([[0, 10, 255, 30, 7], [200, 0, 90, 255, 255], [0, 0, 0, 0, 0]], dtype=torch.float64)
ONE_HOT = torch.tensor([[1, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=torch.float64)
PRICE = 0.05


def small_machine(channels, seed=0):
    """Two exposures of one and two states, smooth patterns of one brightness a state, and three leaves at the end."""
    random = torch.Generator().manual_seed(seed)
    levels, outcomes = [], 1 << channels
    for states, nodes in ((1, 2), (2, 3)):
        lean = torch.randn(states * channels, 5, generator=random, dtype=torch.float64)
        log_light = torch.randn(states, 1, generator=random, dtype=torch.float64) * 0.3
        successors = torch.randint(0, nodes, (outcomes, states), generator=random)
        levels.append(Level(Bits(lean, log_light, parts=channels), successors))
    counts = torch.rand(3, 3, generator=random, dtype=torch.float64) + 0.1
    return Machine(levels, [torch.zeros(0, 3, dtype=torch.float64), counts])


def sums_by_hand(machine, law, i, scales):
    """Loss, photons and clicks of object i, word by word; `scales` are the brightness of the states of each level."""
    channels = law.channels
    posterior = np.log((machine.counts[1] / machine.counts[1].sum(dim=1, keepdim=True)).numpy())
    x = 0.02 + 0.98 * GREY[i].numpy() / 255
    sums = np.zeros(3)
    for words in product(range(1 << channels), repeat=2):
        node, chance, met = 0, 1.0, np.zeros(2)
        for level, scale, word in zip(machine.levels, scales, words):
            rows = level.light.lean[node * channels : (node + 1) * channels].numpy() > 0
            light = scale[node] * (rows @ x)
            click = click_probability(law.click, light)
            bits = [word >> k & 1 for k in range(channels)]
            chance *= float(np.prod([p if bit else 1 - p for p, bit in zip(click, bits)]))
            met += [light.sum(), sum(bits)]
            node = int(level.successors[word, node])
        label = int(ONE_HOT[:, i].argmax())
        sums += chance * np.array([PRICE * met[0] - posterior[node, label], *met])
    return sums


@pytest.mark.parametrize("channels", [2, 3])
def test_a_pass_and_the_gradient_of_brightness_are_sums_over_all_words(channels):
    law = WordLaw(ClickLaw(0.02, 0.3, 0.6), channels)
    machine, sight = small_machine(channels), Sight(law, 0.98 / 255, 0.02, torch.float64)
    passed = forward(machine, sight, GREY)
    scales = [level.light.log_light.exp().flatten().numpy() for level in machine.levels]
    found = np.array([sums_by_hand(machine, law, i, scales) for i in range(3)])
    np.testing.assert_allclose(passed.photons().numpy(), found[:, 1], rtol=1e-12)
    np.testing.assert_allclose(passed.clicks().numpy(), found[:, 2], rtol=1e-12)
    backward(machine, sight, GREY, ONE_HOT, passed, Aim(PRICE))
    for number, level in enumerate(machine.levels):
        for state in range(level.n_states):
            ends = []
            for sign in (1, -1):
                moved = [scale.copy() for scale in scales]
                moved[number][state] *= np.exp(sign * 1e-5)
                ends.append(np.mean([sums_by_hand(machine, law, i, moved)[0] for i in range(3)]))
            slope = (ends[0] - ends[1]) / 2e-5
            assert float(level.light.log_light.grad[state]) == pytest.approx(slope, rel=1e-5, abs=1e-9)


def test_growing_counts_every_object_once_and_spends_what_a_pass_finds():
    task, random = bars_task(60), torch.Generator().manual_seed(1)
    blocks = TrainingObjects(task, FOUR, 0, Augmentation()).epoch(0, 30, torch.float32)
    sight = Sight(WordLaw(ClickLaw(0.01), 2), 1 / 255)
    with torch.no_grad():
        growth = Growth(blocks, sight, GrowOptions(states=6, epochs=1), random)
        for _ in range(3):
            growth.grow(0.02)
        passes = [forward(growth.machine(), sight, block.grey) for block in blocks]
    n = sum(len(block) for block in blocks)
    assert [level.successors.shape[0] for level in growth.levels] == [4, 4, 4]
    assert len(growth.levels[1].light.root) == 2 * growth.levels[1].n_states
    assert float(growth.counts.sum()) == pytest.approx(n, rel=1e-5)
    photons = sum(float(one.photons().sum()) for one in passes) / n
    clicks = sum(float(one.clicks().sum()) for one in passes) / n
    assert growth.spent == pytest.approx((photons, clicks), rel=1e-5)


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


SMALL = AutomatonOptions(
    photons=4.0, exposures=3, states=12, batch=64, tune_epochs=2, epochs=4, first_price=0.1, channels=2, reroutes=1
)


def test_a_training_ends_in_a_bundle_that_is_evaluated_and_trained_on(tmp_path):
    task = bars_task()
    trained = train_automaton(task, FOUR, SMALL)
    made = export_automaton(tmp_path / "bars.pans", trained, task, FOUR, name="bars", provenance={})
    assert made.difference < 1e-6  # of class chances, between the float64 sums of the file and the machine's
    assert made.measured.accuracy_mean > 0.65  # four classes: 0.25 by chance
    assert made.measured.photons_mean == pytest.approx(4.0, rel=0.08)
    bundle, digest = load_bundle(tmp_path / "bars.pans")
    automaton = bundle.automaton
    assert (automaton.channels, automaton.n_outcomes, automaton.n_slots) == (2, 4, 3)
    assert set(automaton.rows.reshape(-1).tolist()) == set(range(bundle.n_patterns))
    drawn = measured_walks(walks_of(bundle, FOUR, task.test.images, task.test.labels, trials=150))
    exact = made.measured
    assert abs(drawn.accuracy_mean - exact.accuracy_mean) < 4 * drawn.accuracy_std / np.sqrt(150)
    assert drawn.clicks_mean == pytest.approx(exact.clicks_mean, rel=0.03)
    assert drawn.illumination == pytest.approx(exact.illumination, rel=0.03)
    options = started_from(replace(SMALL, exposures=0, states=0), bundle, digest, task, FOUR)
    again = train_automaton(task, FOUR, replace(options, epochs=2), start=bundle)
    assert again.held_back.accuracy > trained.held_back.accuracy - 0.03
    with pytest.raises(UsageError, match="--channels is 3, the automaton of --start has 2"):
        started_from(replace(SMALL, channels=3), bundle, digest, task, FOUR)


@pytest.mark.parametrize(
    ("changes", "name", "error", "words"),
    [
        ({"channels": 5}, "dmd-four-snspd", UsageError, "--channels is 5"),
        ({"channels": 0}, "dmd-four-snspd", UsageError, "--channels is 0"),
        ({"channels": 2}, "dmd-spad", PlanError, r"2 channels per exposure, dmd-spad has 1 \(detector.channels\)"),
        ({"outcomes": 3}, "ideal", UsageError, "--channels 2 with --outcomes 3: .*they do not count"),
        ({"patterns": 30}, "dmd-four-snspd", PlanError, "show 2 patterns each, 30 patterns are allowed"),
        ({"photons": None, "clicks": 6.0}, "dmd-four-snspd", UsageError, "--clicks is 6.0, allowed: below 6"),
        ({}, "wdm-snspd", PlanError, "wdm-snspd is a parallel profile"),
    ],
)
def test_what_cannot_be_read_at_once_is_refused(changes, name, error, words):
    with pytest.raises(error, match=words):
        check_automaton_options(replace(SMALL, **changes), bars_task(20), load_profile(name))
