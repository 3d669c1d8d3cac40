"""Going on from the automaton of a bundle: the same walks before anything is trained, better ones after, and what is refused."""

# ruff: noqa: E402  (what follows needs torch)
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task

from pans.runtime.bundle.model import load_bundle
from pans.runtime.decide.expectation import expected_walk
from pans.runtime.errors import PlanError, UsageError
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive import train as module
from pans.trainer.adaptive.machine import machine_of
from pans.trainer.adaptive.options import AutomatonOptions, started_from
from pans.trainer.adaptive.train import train_automaton
from pans.trainer.evaluate.accuracy import outcome_law_of
from pans.trainer.export.automaton import bundle_of

IDEAL = load_profile("ideal")
SMALL = AutomatonOptions(
    photons=4.0, exposures=5, states=8, batch=64, grow_epochs=1, tune_epochs=1, epochs=2, reroutes=0, first_price=0.1
)
FREE = replace(SMALL, exposures=0, states=0)


@pytest.fixture(scope="module")
def task():
    return bars_task()


@pytest.fixture(scope="module")
def first(task):
    """A bundle, some of whose walks end early, and a hash for it."""
    trained = train_automaton(task, IDEAL, replace(SMALL, epochs=4, reroutes=2, exposure_price=0.03))
    assert trained.held_back.exposures < 4.9
    return bundle_of(trained, task, IDEAL, "first", {}), "f" * 64


def walks(bundle, task):
    grey = task.test.images.reshape(len(task.test), -1) / 255.0
    return expected_walk(
        bundle.automaton, bundle.pattern_levels, grey, outcome_law_of(bundle, IDEAL), bundle.photons_per_level
    )


def test_a_start_that_is_hardly_trained_walks_as_the_bundle_does(task, first):
    bundle, digest = first
    options = started_from(replace(FREE, epochs=1, rate=0.0), bundle, digest, task, IDEAL)
    assert (options.exposures, options.states, options.start) == (5, 8, digest)
    stages = []
    same = train_automaton(
        task, IDEAL, options, start=bundle, report=lambda told: stages.append((told.stage, told.done))
    )
    assert [stage for stage, _ in stages] == ["shown"]  # nothing grew
    before = walks(bundle, task)
    chances, photons = same.chances(task.test)
    np.testing.assert_allclose(photons, before.photons, rtol=0.03)  # the budget is met again, within 1 %
    wanted = before.leaves @ bundle.automaton.posteriors[bundle.automaton.n_states :]
    np.testing.assert_allclose(chances, wanted, atol=0.05)  # leaves are counted and calibrated anew
    assert same.held_back.exposures < 4.9


def test_training_goes_on_to_fewer_photons_and_repeats_itself(task, first):
    bundle, digest = first
    options = started_from(replace(FREE, photons=3.0, epochs=2, rate=0.1), bundle, digest, task, IDEAL)
    once, again = (train_automaton(task, IDEAL, options, start=bundle) for _ in range(2))
    assert once.held_back.photons == pytest.approx(0.99 * 3.0, rel=0.08)  # of 66 objects
    assert once.held_back == again.held_back
    began = torch.cat([level.light.shown()[0] for level in machine_of(bundle).levels]).numpy()
    assert (
        (once.arrays.pattern_levels[once.arrays.pattern] > 0) != began
    ).any()  # patterns changed, not only brightness


def test_no_class_is_ruled_out_in_a_leaf_that_no_object_reaches(task, first, monkeypatch):
    bundle, digest = first
    sure = np.eye(4, dtype=np.float32)[bundle.automaton.posteriors.argmax(axis=1)]
    bundle = replace(bundle, automaton=replace(bundle.automaton, posteriors=sure))
    run = module._Run(task, IDEAL, started_from(FREE, bundle, digest, task, IDEAL), lambda _: None, 0)
    reached = module.node_counts

    def none_reached(*given):
        return [counts * (number == 0) for number, counts in enumerate(reached(*given))]

    monkeypatch.setattr(module, "node_counts", none_reached)
    run.go_on_from(bundle)
    losses = torch.cat([-torch.log(counts / counts.sum(dim=1, keepdim=True)) for counts in run.machine.counts])
    assert losses.isfinite().all()
    assert losses.min() < 0.01  # what the bundle's leaf was sure of


def test_what_cannot_be_started_from_is_refused(task, first):
    bundle, digest = first
    for changes, words in (
        ({"exposures": 6}, "--exposures is 6, the automaton of --start has 5"),
        ({"states": 7}, "--states is 7"),
        ({"outcomes": 3}, "--outcomes is 3"),
        ({"grey": True}, "not with --grey"),
    ):
        with pytest.raises(UsageError, match=words):
            started_from(replace(FREE, **changes), bundle, digest, task, IDEAL)
    with pytest.raises(PlanError, match="12 are allowed"):
        started_from(replace(FREE, patterns=12), bundle, digest, task, IDEAL)
    with pytest.raises(UsageError, match="same task"):
        started_from(FREE, bundle, digest, replace(task, classes=("one", "other")), IDEAL)
    fixed, digest = load_bundle("fashion10")
    with pytest.raises(UsageError, match="holds no automaton"):
        started_from(FREE, fixed, digest, task, IDEAL)
    bundle = replace(bundle, pattern_levels=bundle.pattern_levels * 0 + np.arange(bundle.pattern_levels.shape[1]) % 3)
    with pytest.raises(UsageError, match="grey patterns"):
        machine_of(bundle)
