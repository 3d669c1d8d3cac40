"""Accuracy where the table is not perfect: held against images that were moved by hand, and over several tables."""

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bundles import automaton_bundle, made_bundle, six_states

from pans.base.errors import UsageError
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import load_bundle
from pans.instrument.optics import IDENTITY, Imaging, imaging_of, tolerance_of
from pans.instrument.profile import Optics, load_profile
from pans_trainer.commands.evaluate import other_answer
from pans_trainer.evaluate import optics
from pans_trainer.evaluate.accuracy import light_of
from pans_trainer.evaluate.held_out import HeldOut, held_out_of
from pans_trainer.evaluate.walks import measured_walks, walks_of
from pans_trainer.options import Conditions
from pans_trainer.tasks.registry import Objects, Task

IDEAL = load_profile("ideal")
RNG = np.random.default_rng(2)
IMAGES = RNG.integers(0, 256, (30, 2, 3), dtype=np.uint8)
LABELS = RNG.integers(0, 3, 30)
MOVED = np.zeros_like(IMAGES)
MOVED[:, 1:, :-1] = IMAGES[:, :-1, 1:]  # one to the left, one down
TABLE = Imaging(right_px=-1.0, down_px=1.0)
TASK = Task("toy", ("a", "b", "c"), Objects(IMAGES, LABELS), Objects(IMAGES, LABELS), "0" * 64, "none")
HELD_OUT = HeldOut(TASK, TASK.test, IDEAL)


def fixed() -> Bundle:
    levels = RNG.integers(0, 16, (2, 6))
    table = RNG.random((4, 3))
    return made_bundle(2, 3, image_shape=(2, 3), levels=16, pattern_levels=levels, photons_per_level=0.1, table=table)


def test_a_moved_object_brings_the_light_of_moved_pixels() -> None:
    bundle = fixed()
    found = light_of(bundle, IDEAL, IMAGES, imaging=TABLE)
    np.testing.assert_allclose(found.photoelectrons, light_of(bundle, IDEAL, MOVED).photoelectrons, rtol=1e-13)
    lit = light_of(bundle, IDEAL, IMAGES, imaging=Imaging(black=0.1, gain=2.0)).photoelectrons
    sums = IMAGES.reshape(30, -1).sum(axis=1) / 255
    plain = light_of(bundle, IDEAL, IMAGES).photoelectrons
    np.testing.assert_allclose(lit, 2 * (0.9 * plain + 0.1 * 1.5 * sums[:, None]), rtol=1e-12)


@pytest.mark.parametrize("trials", [None, 40])
def test_an_automaton_walks_as_before_moved_objects(trials: int | None) -> None:
    bundle = automaton_bundle(six_states(), photons=1.5)
    moved = measured_walks(walks_of(bundle, IDEAL, IMAGES, LABELS, Conditions(imaging=TABLE), trials=trials))
    by_hand = measured_walks(walks_of(bundle, IDEAL, MOVED, LABELS, trials=trials))
    assert moved.photons_mean == pytest.approx(by_hand.photons_mean, rel=1e-12)
    assert moved.accuracy_mean == pytest.approx(by_hand.accuracy_mean, rel=1e-12)
    assert moved.accuracy_mean != measured_walks(walks_of(bundle, IDEAL, IMAGES, LABELS, trials=trials)).accuracy_mean


def test_several_tables_give_their_mean_and_spread() -> None:
    bundle = fixed()
    tables = [IDENTITY, TABLE, imaging_of("psf=0.8")]
    one_by_one = [optics.figures_under(bundle, HELD_OUT, table, Conditions()).accuracy_mean for table in tables]
    found = optics.over_optics(bundle, HELD_OUT, tables)
    assert found.accuracy_mean == pytest.approx(np.mean(one_by_one))
    assert found.accuracy_std_optics == pytest.approx(np.std(one_by_one, ddof=1))
    assert (found.accuracy_worst, found.tables, found.objects) == (min(one_by_one), 3, 30)
    tolerance = tolerance_of("shift=1:psf=0.5..0.8")
    first, again = optics.drawn_tables(tolerance, 4, 7), optics.drawn_tables(tolerance, 4, 7)
    assert [one.numbers() for one in first] == [one.numbers() for one in again]


def test_all_whole_shifts_are_images_moved_by_hand() -> None:
    bundle, right = automaton_bundle(six_states(), photons=1.5), []
    for down in (-1, 0, 1):
        for along in (0, 1):
            wide = np.pad(IMAGES, ((0, 0), (1, 1), (1, 1)))[:, 1 - down : 3 - down, 1 - along : 4 - along]
            right.append(measured_walks(walks_of(bundle, IDEAL, wide, LABELS)).accuracy_mean)
    found = optics.over_optics(bundle, HELD_OUT, optics.whole_shifts(tolerance_of("shift=-0.5..1.9,-1..1")))
    assert (found.tables, found.accuracy_mean) == (6, pytest.approx(np.mean(right), rel=1e-12))
    for wrong in ("shift=1:psf=0.5..0.8", "shift=0.2..0.8", "shift=1000"):
        with pytest.raises(ValueError, match="allowed"):
            optics.whole_shifts(tolerance_of(wrong))


def test_curves_start_from_the_table_that_they_are_about() -> None:
    bundle = fixed()
    curves = optics.misalignment_curves(bundle, HELD_OUT, TABLE)
    there = optics.figures_under(bundle, HELD_OUT, TABLE, Conditions()).accuracy_mean
    assert {name: tuple(point["value"] for point in points) for name, points in curves.items()} == optics.CURVES
    assert {points[0]["accuracy_mean"] for points in curves.values()} == {there}
    shifted = optics.figures_under(bundle, HELD_OUT, Imaging(0.0, 2.0), Conditions()).accuracy_mean
    assert curves["shift_px"][4]["accuracy_mean"] == shifted


def test_without_optics_a_table_is_as_the_profile_states() -> None:
    stated = replace(IDEAL, optics=Optics(right_px=-1.0, down_px=1.0))
    assert Conditions().imaging_on(stated).numbers() == TABLE.numbers()
    assert Conditions(imaging=IDENTITY).imaging_on(stated).is_identity


@pytest.mark.parametrize(
    "wrong",
    [
        {"draws": 2, "optics": "tolerance"},
        {"optics": "tolerance", "shots": 2},
        {"draws": 2, "trials": 3},
        {"dose_cap": 3.0, "shots": 2},
        {"bleach": "40", "draws": 2},
        {"dose_cap": "curve", "exact": True},
    ],
)
def test_options_that_contradict_each_other_are_refused(wrong: dict[str, Any]) -> None:
    plain = dict.fromkeys(("optics", "draws", "trials", "dose_cap", "bleach")) | {"shots": 1, "exact": False}
    assert other_answer(argparse.Namespace(**plain)) is None
    with pytest.raises(UsageError):
        other_answer(argparse.Namespace(**plain | wrong))


@pytest.mark.data
def test_the_shipped_patterns_lose_what_a_misaligned_image_costs() -> None:
    bundle = load_bundle("fashion10")[0]
    held_out = held_out_of(bundle, None, 500, None, Conditions())
    perfect, moved = (
        optics.figures_under(bundle, held_out, table, Conditions()) for table in (IDENTITY, Imaging(1.0, 1.0))
    )
    assert perfect.accuracy_mean is not None
    assert moved.accuracy_mean is not None
    assert 0.11 < perfect.accuracy_mean - moved.accuracy_mean < 0.21  # about 16 points, of few objects
