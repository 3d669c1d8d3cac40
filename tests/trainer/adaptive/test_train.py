"""Training of an automaton on a small task: what it learns, the budget, repeatability, checkpoints, the export, and what is refused."""

# ruff: noqa: E402  (what follows needs torch)
import math
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task

from pans.runtime.bundle.model import load_bundle
from pans.runtime.errors import PansError, PlanError, UsageError
from pans.runtime.instrument.profile import load_profile, parse_profile
from pans.trainer.adaptive.finish import Grid, to_grid
from pans.trainer.adaptive.objects import Augmentation, TrainingObjects
from pans.trainer.adaptive.options import (
    AutomatonOptions,
    check_automaton_options,
    default_size,
    for_task,
    price_at,
    states_at_most,
    tune_epochs_of,
    with_defaults,
)
from pans.trainer.adaptive.train import train_automaton
from pans.trainer.adaptive.tune import Price
from pans.trainer.export.automaton import compare_walks, export_automaton, measure_walks

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


def test_a_budget_of_clicks_is_met(task):
    found = train_automaton(task, IDEAL, replace(SMALL, photons=None, clicks=1.5)).held_back
    assert found.clicks == pytest.approx(0.99 * 1.5, rel=0.06)


def test_the_budget_holds_where_brightness_has_few_steps(task):
    profile = load_profile("dmd-spad")
    profile = replace(profile, projector=replace(profile.projector, dwell_steps=6))
    found = train_automaton(task, profile, SMALL).held_back
    assert found.photons == pytest.approx(0.99 * 4.0, rel=0.06)


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


def test_soft_targets_stand_for_the_labels_of_the_objects_to_fit_alone(task):
    objects = TrainingObjects(task, IDEAL, 0, Augmentation())
    answers = np.full((objects.n_fit, 4), 0.25, np.float32)
    objects.soften(answers, 0.4)
    (fitted,), (back,) = (made(10_000, torch.float32) for made in (partial(objects.epoch, 3), objects.held_back))
    assert torch.allclose(fitted.one_hot.amax(dim=0), torch.tensor(0.7))
    assert torch.allclose(fitted.one_hot.sum(dim=0), torch.tensor(1.0))
    images = {image.tobytes(): label for image, label in zip(task.train.images, task.train.labels)}
    shown = [images[grey.numpy().astype(np.uint8).tobytes()] for grey in fitted.grey]
    assert fitted.one_hot.argmax(dim=0).tolist() == shown  # in the order of the epoch
    assert set(back.one_hot.unique().tolist()) == {0.0, 1.0}
    with pytest.raises(ValueError, match="answers"):
        objects.soften(answers[1:], 1.0)


def test_what_a_task_is_best_served_with_is_the_default_and_can_be_turned_off():
    assert for_task(AutomatonOptions(), "fashion-mnist").soft == 0.5
    assert for_task(AutomatonOptions(), "mnist").copies == 20
    assert for_task(AutomatonOptions(), "cells") == replace(AutomatonOptions(), soft=0.0, copies=0)
    off = AutomatonOptions(soft=0.0, copies=0)
    assert for_task(off, "mnist") == for_task(off, "fashion-mnist") == off


def test_a_checkpoint_of_other_options_is_refused(task, tmp_path):
    path = tmp_path / "bars.checkpoint"
    train_automaton(task, IDEAL, replace(SMALL, epochs=1, tune_epochs=1), checkpoint=path)
    with pytest.raises(UsageError, match="belongs to another training"):
        train_automaton(task, IDEAL, replace(SMALL, epochs=2, tune_epochs=1), checkpoint=path, resume=True)


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


def test_grey_patterns_are_whole_levels(task):
    trained = train_automaton(task, IDEAL, replace(SMALL, grey=True))
    assert len(np.unique(trained.arrays.pattern_levels)) > 50
    compare_walks(export_bundle(trained, task), trained, task, IDEAL)


def test_contrast_and_read_noise_of_a_profile_are_trained_through(task):
    profile = load_profile("oled-qcmos")
    assert profile.min_transmission > 0
    trained = train_automaton(task, profile, SMALL)
    bundle = export_bundle(trained, task, profile)
    compare_walks(bundle, trained, task, profile)
    found = measure_walks(bundle, task.test, profile)
    assert found.accuracy_mean > 0.6
    assert found.clicks_mean == pytest.approx(trained.held_back.clicks, rel=0.1)


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


def test_rounding_to_the_grid_keeps_at_least_one_step(trained):
    from copy import deepcopy

    machine = deepcopy(trained.machine)
    to_grid(machine, Grid(1.0, 4, False))
    light = torch.cat([level.light.scale().flatten() for level in machine.levels])
    assert set(light.numpy().round(6).tolist()) <= {0.25, 0.5, 0.75, 1.0}


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


def test_prices_fall_along_the_levels_and_sizes_grow_with_the_budget():
    prices = [price_at(SMALL, level) for level in range(40)]
    assert prices[0] == SMALL.first_price
    assert all(before >= after for before, after in pairwise(prices))
    sizes = [default_size(photons) for photons in (3.0, 10.0, 40.0)]
    assert sizes == sorted(sizes)
    small = load_profile("dmd-8bit-spad")
    exposures, states = with_defaults(AutomatonOptions(photons=10.0), small)
    assert states_at_most(exposures, states) <= small.projector.automaton_states < states_at_most(exposures, states + 1)
    assert with_defaults(replace(SMALL, photons=10.0), small) == (6, 12)


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


def test_growing_through_optics_is_dearer_where_more_was_spent_than_the_levels_share():
    plain, through = replace(SMALL, optics=None), replace(SMALL, optics="psf=0.6:black=0.002")
    price = Price(0.02, budget=12.0)
    assert price.excess((6.0, 2.0), 0.25) == pytest.approx(2.0)
    assert Price(0.02, budget=4.0, of_clicks=True).excess((6.0, 2.0), 0.25) == pytest.approx(2.0)
    assert price.excess((0.0, 0.0), 0.0) == Price(0.02).excess((6.0, 2.0), 0.25) == 0.0
    for excess in (0.0, 0.5, 1.0, 2.0, 1e9):
        assert price_at(plain, 3, excess) == price_at(plain, 3)
    assert price_at(through, 3, 0.5) == price_at(through, 3, 1.0) == price_at(plain, 3)
    assert price_at(plain, 3) < price_at(through, 3, 1.5) < price_at(through, 3, 3.0) < math.inf
    assert price_at(through, 3, 1e9) == price_at(through, 3, 1e12)
    assert tune_epochs_of(replace(plain, tune_epochs=None)) > tune_epochs_of(replace(through, tune_epochs=None)) == 0
    assert tune_epochs_of(replace(through, tune_epochs=2)) == 2
