"""Training of an automaton on a small task: what it learns, the budget, repeatability, checkpoints, the export, and what is refused."""

import itertools
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from trainings import bars_task

from pans.base.errors import PansError, PlanError, UsageError
from pans.bundle.backends.expectation import expected_walk
from pans.bundle.sensor.bundle import load_bundle
from pans.decide.plan.plan import build_plan
from pans.instrument.optics import Bleaching
from pans.instrument.profile import load_profile
from pans_trainer.commands.trainings import budget_off
from pans_trainer.evaluate.accuracy import outcome_law_of
from pans_trainer.evaluate.dose import within_cap
from pans_trainer.evaluate.held_out import HeldOut
from pans_trainer.evaluate.walks import measured_walks, walks_of
from pans_trainer.export.automaton import bundle_of, compare_walks, demand_within, export_automaton, measure_walks
from pans_trainer.options import AutomatonOptions, Conditions
from pans_trainer.train.automaton.budget import check_automaton_options, started_from
from pans_trainer.train.automaton.machine import machine_of
from pans_trainer.train.automaton.train import train_automaton

IDEAL = load_profile("ideal")
SMALL = AutomatonOptions(photons=4.0, exposures=6, states=12, batch=64, tune_epochs=3, epochs=6, first_price=0.1)


@pytest.fixture(scope="module")
def task():
    return bars_task()


@pytest.fixture(scope="module")
def trained(task):
    return train_automaton(task, IDEAL, SMALL)


def interrupted(at, task, profile, options, **more):
    """A training that is interrupted at the step `at`; what it reported until then."""
    told = []

    def stop(progress):
        told.append(progress)
        if at in (progress.done, progress.stage):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_automaton(task, profile, options, report=stop, **more)
    return told


def test_learns_the_bars_within_its_budget(task, trained):
    found = measure_walks(export_bundle(trained, task), task.test, IDEAL)
    assert found.accuracy_mean > 0.7  # four classes: 0.25 by chance
    assert found.photons_mean < 4.0 * 1.05
    assert trained.held_back.photons == pytest.approx(0.99 * 4.0, rel=0.06)  # of 66 objects
    assert found.expected_calibration_error < 0.1


@pytest.mark.parametrize(("photons", "illumination"), [(None, 16.0), (4.0, 9.0), (3.0, 60.0)])
def test_light_sent_has_a_price_of_its_own(task, photons, illumination):
    """Alone, and beside one for light detected: both hold, and the one that is met first holds the other below its own."""
    done = train_automaton(task, IDEAL, replace(SMALL, photons=photons, illumination=illumination))
    found = measure_walks(export_bundle(done, task), task.test, IDEAL)
    spent = [found.illumination / illumination, *([found.photons_mean / photons] if photons else [])]
    assert max(spent) == pytest.approx(1.0, abs=0.07)
    assert found.accuracy_mean > 0.5
    if photons:
        assert (done.prices[0] > done.prices[1]) == (spent[1] > spent[0])


def export_bundle(trained, task, profile=IDEAL):
    return bundle_of(trained, task, profile, "bars", {})


def test_the_same_seed_gives_the_same_automaton_and_another_seed_another(task, trained):
    again = train_automaton(task, IDEAL, SMALL)
    np.testing.assert_array_equal(again.shown.pattern_levels, trained.shown.pattern_levels)
    for name in ("dwell", "successors", "posteriors"):
        np.testing.assert_array_equal(getattr(again.automaton, name), getattr(trained.automaton, name))
    other = train_automaton(task, IDEAL, replace(SMALL, seed=1))
    assert other.held_back != trained.held_back


@pytest.mark.parametrize(
    ("changes", "name", "at"),
    [
        *(({}, "ideal", at) for at in (7, 8, 11)),
        *(({"photons": None, "dose_cap": 12.0, "bleach": "0.2:mixed", "epochs": 3}, "ideal", at) for at in (8, 11)),
        ({"patterns": 5}, "dmd-spad", 12),
    ],
)
def test_an_interrupted_training_ends_at_the_same_automaton(task, trained, tmp_path, changes, name, at):
    options, profile, path = replace(SMALL, **changes), load_profile(name), tmp_path / "bars.checkpoint"
    interrupted(at, task, profile, options, checkpoint=path)
    assert path.is_file() == (at > 7)  # the first state is kept after the first whole epoch of tuning
    went_on = train_automaton(task, profile, options, checkpoint=path, resume=path.is_file())
    whole = train_automaton(task, profile, options) if changes else trained
    np.testing.assert_array_equal(went_on.shown.pattern_levels, whole.shown.pattern_levels)
    for array in ("dwell", "posteriors"):
        np.testing.assert_array_equal(getattr(went_on.automaton, array), getattr(whole.automaton, array))


def test_a_checkpoint_from_before_an_option_existed_means_its_default(task, trained, tmp_path):
    path = tmp_path / "bars.checkpoint"
    interrupted(8, task, IDEAL, SMALL, checkpoint=path)
    kept = torch.load(path, weights_only=True)
    del kept["identity"]["dose_cap"]
    torch.save(kept, path)
    with pytest.raises(UsageError, match=r"another training: dose_cap None \(now 9.0\)"):
        train_automaton(task, IDEAL, replace(SMALL, dose_cap=9.0), checkpoint=path, resume=True)
    went_on = train_automaton(task, IDEAL, SMALL, checkpoint=path, resume=True)
    np.testing.assert_array_equal(went_on.shown.pattern_levels, trained.shown.pattern_levels)


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
    told = interrupted("grow", task, IDEAL, options, checkpoint=path, teacher=file)
    assert [progress.stage for progress in told] == ["network"] * 3 + ["grow"]
    stages = []
    went_on = train_automaton(
        task, IDEAL, options, checkpoint=path, resume=True, report=lambda p: stages.append(p.stage)
    )
    assert "network" not in stages
    again = train_automaton(task, IDEAL, options, teacher=file, report=lambda p: stages.append(p.stage))
    assert "network" not in stages
    np.testing.assert_array_equal(went_on.automaton.posteriors, again.automaton.posteriors)
    assert went_on.options.soft == 1.0
    with pytest.raises(UsageError, match="another file"):
        train_automaton(task, IDEAL, replace(options, teacher_epochs=4), teacher=file)


@pytest.mark.parametrize("steps", [1, 20])
def test_dwell_is_in_whole_steps_of_the_profile(task, steps):
    """Without steps a one-bit projector shows one brightness."""
    profile = load_profile("dmd-spad")
    profile = replace(profile, projector=replace(profile.projector, dwell_steps=steps))
    found = train_automaton(task, profile, SMALL)
    dwell = found.automaton.dwell
    assert set(np.unique(found.shown.pattern_levels)) <= {0, 1}
    assert found.automaton.dwell_steps == steps
    assert 1 <= dwell.min() <= dwell.max() <= steps
    assert len(set(dwell)) > 3 or steps == 1
    low = profile.projector.peak_photoelectrons_hz * profile.exposure.min_us * 1e-6
    assert found.shown.photons_per_level >= low * (1 - 1e-9)


def test_export_refuses_an_automaton_that_is_not_the_models(task, trained, tmp_path):
    swapped = replace(trained.automaton, successors=trained.automaton.successors[:, ::-1].copy())
    with pytest.raises(PansError, match="differ from the trained automaton"):
        export_automaton(tmp_path / "x.pans", replace(trained, automaton=swapped), task, IDEAL, name="x", provenance={})
    assert not list(tmp_path.iterdir())


CAPPED = replace(SMALL, photons=None, dose_cap=12.0)


def doses_by_word(bundle):
    """What each of the 64 click words of six exposures sends."""
    automaton, light = bundle.automaton, bundle.state_light()
    for word in itertools.product((0, 1), repeat=6):
        node, dose = 0, 0.0
        for click in word:
            if node < automaton.n_states:
                dose, node = dose + light[node], int(automaton.successors[node, click])
        yield dose


@pytest.mark.parametrize("name", ["ideal", "dmd-spad"])
def test_no_walk_passes_the_cap_and_all_come_near(task, name):
    profile = load_profile(name)
    done = train_automaton(task, profile, CAPPED)
    bundle = bundle_of(done, task, profile, "bars", {})
    doses = list(doses_by_word(bundle))
    assert max(doses) <= 12.0
    assert min(doses) >= 0.995 * 12.0
    found = measure_walks(bundle, task.test, profile)
    assert budget_off(CAPPED, found, bundle.illumination())[0] <= 0.0
    free = free_bundle(task, profile)
    cut = within_cap(free, 12.0, HeldOut(task, task.test, profile), None)
    assert found.accuracy_mean > measure_walks(cut.bundle, task.test, profile).accuracy_mean + 0.01
    again = started_from(replace(CAPPED, exposures=0, states=0, epochs=2), free, "f" * 64, task, profile)
    doses = list(doses_by_word(bundle_of(train_automaton(task, profile, again, start=free), task, profile, "on", {})))
    assert max(doses) <= 12.0
    assert min(doses) >= 0.995 * 12.0
    with pytest.raises(PlanError, match="the cap is 11:"):
        demand_within(bundle, 11.0)


def free_bundle(task, profile):
    """An automaton that sends as much on average, some walks more."""
    done = train_automaton(task, profile, replace(CAPPED, dose_cap=None, illumination=12.0))
    return bundle_of(done, task, profile, "free", {})


def test_through_bleaching_the_expectation_is_that_of_sampled_walks(task, tmp_path):
    options, profile = replace(CAPPED, bleach="0.2:mixed"), IDEAL
    trained = train_automaton(task, profile, options)
    facts = {"options": asdict(options)}
    made = export_automaton(tmp_path / "faded.pans", trained, task, profile, name="faded", provenance=facts)
    law, images, labels = Bleaching(0.2, mixed=True), task.test.images, task.test.labels
    assert made.difference < 1e-6
    drawn = measured_walks(walks_of(made.bundle, profile, images, labels, Conditions(bleaching=law), trials=200))
    assert abs(drawn.accuracy_mean - made.measured.accuracy_mean) < 3 * drawn.accuracy_std / np.sqrt(200)
    assert drawn.photons_mean == pytest.approx(made.measured.photons_mean, rel=0.005)
    assert made.bundle.expected["photons"] > 1.5 * made.measured.photons_mean  # of objects that do not bleach
    # a training that knows nothing of it decides worse
    blind = bundle_of(train_automaton(task, profile, CAPPED), task, profile, "blind", {})
    judged = measured_walks(walks_of(blind, profile, images, labels, Conditions(bleaching=law)))
    assert made.measured.accuracy_mean > judged.accuracy_mean + 0.02
    with pytest.raises(ValueError, match="depends on the walk"):  # emitters that stay
        walks_of(blind, profile, images, labels, Conditions(bleaching=Bleaching(0.2)))


TWO = {"channels": 2}


@pytest.mark.parametrize(
    ("changes", "name", "error", "words"),
    [
        ({}, "wdm-snspd", PlanError, "sequential"),
        ({"photons": None}, "ideal", UsageError, "a budget of light"),
        ({"clicks": 2.0}, "ideal", UsageError, "not for both"),
        ({"photons": float("nan")}, "ideal", UsageError, "--photons is nan"),
        ({"exposures": 2000}, "ideal", UsageError, "--exposures is 2000"),
        ({"batch": 1}, "ideal", UsageError, "--batch is 1"),
        ({"photons": None, "clicks": 6.5}, "ideal", UsageError, "--clicks is 6.5"),
        ({"dark": -1.0}, "ideal", UsageError, "--dark is -1.0"),
        ({"patterns": 3}, "dmd-8bit-spad", PlanError, "states cannot share one"),
        ({"exposures": 200, "states": 500}, "ideal", PlanError, "65533"),
        ({"dose_cap": 9.0, "illumination": 9.0}, "ideal", UsageError, "--illumination adds nothing"),
        ({"dose_cap": 9.0, "grey": True}, "dmd-8bit-spad", UsageError, "a brightness of its own"),
        ({"dose_cap": 9.0, "patterns": 30}, "ideal", UsageError, "share no patterns"),
        ({"dose_cap": 9.0, "bleach": "40"}, "ideal", UsageError, "--bleach 40: .* one dose"),
        ({"bleach": "40:mixed"}, "ideal", UsageError, "--bleach 40:mixed: .* one dose"),
        ({"dose_cap": 9.0, "bleach": "0.2:mixed"}, "dmd-spad", PlanError, r"differ by about 1.5% of .* allowed 0.1%"),
        ({"dose_cap": 9.0, "channels": 2}, "dmd-four-snspd", UsageError, "--dose-cap: allowed with one detector only"),
        ({"channels": 5}, "dmd-four-snspd", UsageError, "--channels is 5"),
        ({"channels": 0}, "dmd-four-snspd", UsageError, "--channels is 0"),
        (TWO, "dmd-spad", PlanError, r"2 channels per exposure, dmd-spad has 1 \(detector.channels\)"),
        (TWO | {"outcomes": 3}, "ideal", UsageError, "--channels 2 with --outcomes 3: .*they do not count"),
        (TWO | {"patterns": 30}, "dmd-four-snspd", PlanError, "show 2 patterns each, 30 patterns are allowed"),
        (TWO | {"photons": None, "clicks": 12.0}, "dmd-four-snspd", UsageError, "--clicks is 12.0, allowed: below 12"),
        (TWO, "wdm-snspd", PlanError, "wdm-snspd is a parallel profile"),
    ],
)
def test_options_that_cannot_be(task, changes, name, error, words):
    with pytest.raises(error, match=words):
        check_automaton_options(replace(SMALL, **changes), task, load_profile(name))


@pytest.mark.parametrize(
    ("changes", "words"), [({"light": "field"}, "the scene's own"), ({"target": "image"}, "asks for a picture")]
)
def test_tasks_that_no_automaton_solves(task, changes, words):
    with pytest.raises(UsageError, match=words):
        check_automaton_options(SMALL, replace(task, **changes), IDEAL)


def test_states_share_few_patterns(task):
    profile = load_profile("dmd-spad")
    whole = train_automaton(task, profile, replace(SMALL, patterns=5))
    assert len(whole.shown.pattern_levels) <= 5
    assert len(whole.automaton.pattern) > 20
    compare_walks(export_bundle(whole, task, profile), whole, task, profile)
    assert whole.held_back.accuracy > 0.6


def test_one_bright_state_does_not_set_the_exposure(task):
    from pans_trainer.train.automaton.train import _Run

    run = _Run(task, load_profile("dmd-spad"), SMALL, lambda _: None, 0)
    run.grow(lambda: None)
    run.start_showing()
    level = run.machine.levels[-1]
    reached = [masses.clone() for masses in run._masses()][-1]
    with torch.no_grad():
        # a photoelectron per pixel, and more than 0.4 dark counts at 2 kHz
        level.light.log_light[int(reached.argmin())] = 0.0
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


def test_dimmed_to_its_budget_no_exposure_is_longer_than_the_brightest_state_needs(task, first):
    bundle, digest = first
    options = started_from(replace(FREE, epochs=1, rate=0.0, photons=2.0), bundle, digest, task, IDEAL)
    found = train_automaton(task, IDEAL, options, start=bundle)
    assert found.shown.photons_per_level < 0.8 * bundle.photons_per_level
    assert found.automaton.dwell.max() == found.automaton.dwell_steps


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


SEVERAL = AutomatonOptions(
    photons=4.0, exposures=4, states=8, batch=64, tune_epochs=1, epochs=3, first_price=0.1, reroutes=1
)


def test_a_training_on_photon_numbers_ends_in_a_bundle_that_is_evaluated(task, tmp_path):
    profile = load_profile("oled-qcmos")
    profile = replace(profile, detector=replace(profile.detector, photon_number_max=3))
    trained = train_automaton(task, profile, replace(SEVERAL, outcomes=3))
    made = export_automaton(tmp_path / "bars.pans", trained, task, profile, name="bars", provenance={})
    automaton = load_bundle(tmp_path / "bars.pans")[0].automaton
    assert (automaton.counts, automaton.n_outcomes, automaton.n_slots) == (True, 3, 4)
    assert made.difference < 1e-5  # of class chances, between the float64 sums of the file and the machine's
    assert made.measured.accuracy_mean > 0.5  # four classes: 0.25 by chance
    assert made.measured.photons_mean == pytest.approx(4.0, rel=0.1)
    clicks_only = replace(profile, detector=replace(profile.detector, photon_number_max=1))
    with pytest.raises(PlanError, match=r"3 outcomes per exposure.*tells 2 apart"):
        build_plan(clicks_only, made.bundle)


def test_a_training_on_two_channels_ends_in_a_bundle_that_is_evaluated_and_trained_on(task, tmp_path):
    options, profile = replace(SEVERAL, channels=2, exposures=3, states=12, epochs=4), load_profile("dmd-four-snspd")
    trained = train_automaton(task, profile, replace(options, tune_epochs=2))
    made = export_automaton(tmp_path / "bars.pans", trained, task, profile, name="bars", provenance={})
    exact = made.measured
    assert made.difference < 1e-6  # of class chances, between the float64 sums of the file and the machine's
    assert exact.accuracy_mean > 0.65  # four classes: 0.25 by chance
    assert exact.photons_mean == pytest.approx(4.0, rel=0.08)
    bundle, digest = load_bundle(tmp_path / "bars.pans")
    automaton = bundle.automaton
    assert (automaton.channels, automaton.n_outcomes, automaton.n_slots) == (2, 4, 3)
    assert set(automaton.rows.reshape(-1).tolist()) == set(range(bundle.n_patterns))
    drawn = measured_walks(walks_of(bundle, profile, task.test.images, task.test.labels, trials=150))
    assert abs(drawn.accuracy_mean - exact.accuracy_mean) < 4 * drawn.accuracy_std / np.sqrt(150)
    assert (drawn.clicks_mean, drawn.illumination) == pytest.approx((exact.clicks_mean, exact.illumination), rel=0.03)
    again = started_from(replace(options, exposures=0, states=0, epochs=2), bundle, digest, task, profile)
    assert train_automaton(task, profile, again, start=bundle).held_back.accuracy > trained.held_back.accuracy - 0.03
    with pytest.raises(UsageError, match="--channels is 3, the automaton of --start has 2"):
        started_from(replace(options, channels=3), bundle, digest, task, profile)
