"""Training of an automaton on a small task: what it learns, the budget, repeatability, checkpoints, the export, and what is refused."""

# ruff: noqa: E402  (what follows needs torch)

import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from dataclasses import replace

import numpy as np
from trainings import bars_task

from pans.runtime.bundle.model import load_bundle
from pans.runtime.decide.expectation import expected_walk
from pans.runtime.errors import PansError, PlanError, UsageError
from pans.runtime.instrument.profile import load_profile, parse_profile
from pans.trainer.adaptive.budget import (
    check_automaton_options,
    started_from,
)
from pans.trainer.adaptive.machine import machine_of
from pans.trainer.adaptive.train import train_automaton
from pans.trainer.evaluate.accuracy import outcome_law_of
from pans.trainer.export.automaton import bundle_of, compare_walks, export_automaton, measure_walks
from pans.trainer.options import AutomatonOptions

IDEAL = load_profile("ideal")
SMALL = AutomatonOptions(photons=4.0, exposures=6, states=12, batch=64, tune_epochs=3, epochs=6, first_price=0.1)


@pytest.fixture(scope="module")
def task():
    return bars_task()


@pytest.fixture(scope="module")
def trained(task):
    return train_automaton(task, IDEAL, SMALL)


def profile_of(name, **changes):
    """A shipped profile with other values."""
    text = load_profile(name).text
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new)
    return parse_profile(text, f"{name}.toml")


def test_learns_the_bars_within_its_budget(task, trained):
    found = measure_walks(export_bundle(trained, task), task.test, IDEAL)
    assert found.accuracy_mean > 0.7  # four classes: 0.25 by chance
    assert found.photons_mean < 4.0 * 1.05
    assert trained.held_back.photons == pytest.approx(0.99 * 4.0, rel=0.06)  # of 66 objects
    assert found.expected_calibration_error < 0.1


def export_bundle(trained, task, profile=IDEAL):
    from pans.trainer.export.automaton import bundle_of

    return bundle_of(trained, task, profile, "bars", {})


def test_the_same_seed_gives_the_same_automaton_and_another_seed_another(task, trained):
    again = train_automaton(task, IDEAL, SMALL)
    for name in ("pattern_levels", "dwell", "successors", "posteriors"):
        np.testing.assert_array_equal(getattr(again.arrays, name), getattr(trained.arrays, name))
    other = train_automaton(task, IDEAL, replace(SMALL, seed=1))
    assert other.held_back != trained.held_back


@pytest.mark.parametrize("stop_at", [7, 8, 11])
def test_an_interrupted_training_ends_at_the_same_automaton(task, trained, tmp_path, stop_at):
    path = tmp_path / "bars.checkpoint"

    def stop(told):
        if told.done == stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_automaton(task, IDEAL, SMALL, checkpoint=path, report=stop)
    resumed = path.is_file()
    went_on = train_automaton(task, IDEAL, SMALL, checkpoint=path, resume=resumed)
    assert resumed == (stop_at > 7)  # the first state is kept after the first whole epoch of tuning
    np.testing.assert_array_equal(went_on.arrays.pattern_levels, trained.arrays.pattern_levels)
    np.testing.assert_array_equal(went_on.arrays.posteriors, trained.arrays.posteriors)


def test_a_price_per_exposure_ends_walks_early(task, trained):
    found = train_automaton(task, IDEAL, replace(SMALL, exposure_price=0.03))
    bundle = export_bundle(found, task)
    walked = measure_walks(bundle, task.test, IDEAL)
    whole = measure_walks(export_bundle(trained, task), task.test, IDEAL)
    assert whole.exposures_mean == pytest.approx(6.0)
    assert walked.exposures_mean < 5.5
    assert walked.exposures_mean == pytest.approx(found.held_back.exposures, rel=0.1)  # of 66 objects
    assert walked.accuracy_mean > whole.accuracy_mean - 0.1
    assert walked.photons_mean < 4.0 * 1.05


def test_soft_targets_are_kept_and_go_on_from_a_checkpoint(task, tmp_path):
    options, file, path = replace(SMALL, soft=1.0, teacher_epochs=3), tmp_path / "answers.npz", tmp_path / "checkpoint"
    told = []

    def stop(progress):
        told.append(progress.stage)
        if progress.stage == "grow":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_automaton(task, IDEAL, options, checkpoint=path, report=stop, teacher=file)
    assert told == ["network"] * 3 + ["grow"]
    stages = []
    went_on = train_automaton(
        task, IDEAL, options, checkpoint=path, resume=True, report=lambda p: stages.append(p.stage)
    )
    assert "network" not in stages
    again = train_automaton(task, IDEAL, options, teacher=file, report=lambda p: stages.append(p.stage))
    assert "network" not in stages
    np.testing.assert_array_equal(went_on.arrays.posteriors, again.arrays.posteriors)
    assert went_on.options.soft == 1.0
    with pytest.raises(UsageError, match="another file"):
        train_automaton(task, IDEAL, replace(options, teacher_epochs=4), teacher=file)


def test_one_bit_projector_without_dwell_shows_one_brightness(task):
    profile = profile_of("dmd-spad", rate=("pattern_memory = 43_690", "pattern_memory = 43_690"))
    profile = replace(profile, projector=replace(profile.projector, dwell_steps=1))
    arrays = train_automaton(task, profile, SMALL).arrays
    assert set(np.unique(arrays.pattern_levels)) <= {0, 1}
    assert arrays.dwell_steps == 1
    assert set(arrays.dwell) == {1}


def test_dwell_is_in_whole_steps_of_the_profile(task):
    profile = load_profile("dmd-spad")
    profile = replace(profile, projector=replace(profile.projector, dwell_steps=20))
    arrays = train_automaton(task, profile, SMALL).arrays
    assert arrays.dwell_steps == 20
    assert arrays.dwell.min() >= 1
    assert arrays.dwell.max() <= 20
    assert len(set(arrays.dwell)) > 3
    low = profile.projector.peak_photoelectrons_hz * profile.exposure.min_us * 1e-6
    assert arrays.photons_per_level >= low * (1 - 1e-9)


def test_export_writes_a_bundle_that_is_read_back(task, trained, tmp_path):
    path = tmp_path / "bars.pans"
    exported = export_automaton(path, trained, task, IDEAL, name="bars", provenance={})
    bundle, digest = load_bundle(path)
    assert digest == exported.sha256
    assert bundle.expected["accuracy"] == exported.measured.accuracy_mean
    assert bundle.automaton.n_slots == 6
    assert exported.first_200.objects == 200
    with pytest.raises(UsageError):
        export_automaton(path, trained, task, IDEAL, name="bars", provenance={})


def test_export_refuses_an_automaton_that_is_not_the_models(task, trained, tmp_path):
    arrays = trained.arrays
    swapped = replace(arrays, successors=arrays.successors[:, ::-1].copy())
    with pytest.raises(PansError, match="differ from the trained automaton"):
        export_automaton(tmp_path / "x.pans", replace(trained, arrays=swapped), task, IDEAL, name="x", provenance={})
    assert not list(tmp_path.iterdir())


def test_options_that_cannot_be(task):
    with pytest.raises(PlanError, match="sequential"):
        check_automaton_options(SMALL, task, load_profile("wdm-snspd"))
    for changes, error in (
        ({"photons": None}, "one budget"),
        ({"clicks": 2.0}, "one budget"),
        ({"photons": float("nan")}, "--photons is nan"),
        ({"exposures": 2000}, "--exposures is 2000"),
        ({"batch": 1}, "--batch is 1"),
        ({"photons": None, "clicks": 6.5}, "--clicks is 6.5"),
        ({"dark": -1.0}, "--dark is -1.0"),
    ):
        with pytest.raises(UsageError, match=error):
            check_automaton_options(replace(SMALL, **changes), task, IDEAL)
    with pytest.raises(PlanError, match="states cannot share one"):
        check_automaton_options(replace(SMALL, patterns=3), task, load_profile("dmd-8bit-spad"))
    with pytest.raises(PlanError, match="65533"):
        check_automaton_options(replace(SMALL, exposures=200, states=500), task, IDEAL)
    with pytest.raises(UsageError, match="the light is the scene's own"):
        check_automaton_options(SMALL, replace(task, light="field"), IDEAL)
    with pytest.raises(UsageError, match="asks for a picture"):
        check_automaton_options(SMALL, replace(task, target="image"), IDEAL)


def test_states_share_few_patterns_and_a_resumed_training_still_does(task, tmp_path):
    options, path, profile = replace(SMALL, patterns=5), tmp_path / "few.checkpoint", load_profile("dmd-spad")
    whole = train_automaton(task, profile, options)
    assert len(whole.arrays.pattern_levels) <= 5
    assert len(whole.arrays.pattern) > 20
    compare_walks(export_bundle(whole, task, profile), whole, task, profile)
    assert whole.held_back.accuracy > 0.6

    def stop(told):
        if told.done == 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_automaton(task, profile, options, checkpoint=path, report=stop)
    resumed = train_automaton(task, profile, options, checkpoint=path, resume=True)
    np.testing.assert_array_equal(resumed.arrays.pattern_levels, whole.arrays.pattern_levels)
    np.testing.assert_array_equal(resumed.arrays.dwell, whole.arrays.dwell)


def test_one_bright_state_does_not_set_the_exposure(task):
    from pans.trainer.adaptive.train import _Run

    run = _Run(task, load_profile("dmd-spad"), SMALL, lambda _: None, 0)
    run.grow(lambda: None)
    run.start_showing()
    level = run.machine.levels[-1]
    reached = [masses.clone() for masses in run._masses()][-1]
    with torch.no_grad():
        level.light.log_light[int(reached.argmin())] = (
            0.0  # a photoelectron per pixel, and more than 0.4 dark counts at 2 kHz
        )
    run._choose_top()
    assert level.light.top < 0.9
    assert float(level.light.scale().max()) <= level.light.top * (1 + 1e-6)


SMALL_START = AutomatonOptions(
    photons=4.0, exposures=5, states=8, batch=64, grow_epochs=1, tune_epochs=1, epochs=2, reroutes=0, first_price=0.1
)
FREE = replace(SMALL_START, exposures=0, states=0)


@pytest.fixture(scope="module")
def first(task):
    """A bundle, some of whose walks end early, and a hash for it."""
    trained = train_automaton(task, IDEAL, replace(SMALL_START, epochs=4, reroutes=2, exposure_price=0.03))
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
    with pytest.raises(PlanError, match="12 patterns are allowed"):
        started_from(replace(FREE, patterns=12), bundle, digest, task, IDEAL)
    with pytest.raises(UsageError, match="same task"):
        started_from(FREE, bundle, digest, replace(task, classes=("one", "other")), IDEAL)
    fixed, digest = load_bundle("fashion10")
    with pytest.raises(UsageError, match="holds no automaton"):
        started_from(FREE, fixed, digest, task, IDEAL)
    bundle = replace(bundle, pattern_levels=bundle.pattern_levels * 0 + np.arange(bundle.pattern_levels.shape[1]) % 3)
    with pytest.raises(UsageError, match="grey patterns"):
        machine_of(bundle)
