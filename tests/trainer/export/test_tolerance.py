"""Bundles trained through optics that are not perfect: what they gain there, and what they say of it."""

# ruff: noqa: E402  (what follows needs torch)
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task, short_fits  # noqa: F401 - a fixture

from pans.runtime.errors import UsageError
from pans.runtime.imaging import imaging_of
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.options import AutomatonOptions
from pans.trainer.adaptive.train import train_automaton
from pans.trainer.evaluate.held_out import Conditions, HeldOut
from pans.trainer.evaluate.optics import figures_under, misalignment_curves
from pans.trainer.export.automaton import export_automaton
from pans.trainer.export.writer import export_trained
from pans.trainer.options import Options, check_options
from pans.trainer.train.loop import train

IDEAL = load_profile("ideal")
TABLE = "shift=0.2:psf=0.6:black=0.02"
HIDDEN = imaging_of("psf=0.6:black=0.02")
SMALL = AutomatonOptions(photons=4.0, exposures=5, states=8, batch=64, tune_epochs=2, epochs=4, first_price=0.1, soft=0)


def accuracy(bundle, task):
    return figures_under(bundle, HeldOut(task, task.test, IDEAL), HIDDEN, Conditions()).accuracy_mean


@pytest.mark.slow
def test_an_automaton_trained_through_optics_is_better_there_and_says_what_it_tolerates(tmp_path):
    task = bars_task()
    bundles = {}
    for name, optics in (("perfect", None), ("through", TABLE)):
        trained = train_automaton(task, IDEAL, replace(SMALL, optics=optics))
        made = export_automaton(tmp_path / f"{name}.pans", trained, task, IDEAL, name=name, provenance={})
        bundles[name] = made.bundle
    assert accuracy(bundles["through"], task) > accuracy(bundles["perfect"], task) + 0.03
    assert "tolerates" not in bundles["perfect"].provenance
    told = bundles["through"].provenance["tolerates"]
    assert told["optics"] == TABLE
    assert told["simulated"] is True
    assert (told["edge"]["tables"], told["middle"]["tables"]) == (4, 1)
    middle = figures_under(bundles["through"], HeldOut(task, task.test, IDEAL), HIDDEN, Conditions())
    assert told["middle"]["accuracy"] == pytest.approx(middle.accuracy_mean, abs=1e-5)
    assert told["edge"]["accuracy_worst"] <= told["edge"]["accuracy"]


@pytest.mark.usefixtures("short_fits")
def test_fixed_patterns_are_trained_through_optics_too(tmp_path):
    task = bars_task()
    options = Options(features=3, epochs=6, batch=64, hidden=16, alpha=0.0, optics=TABLE)
    check_options(options, IDEAL)
    trained = train(task, IDEAL, options)
    bundle = export_trained(tmp_path / "fixed.pans", trained, task, IDEAL, name="fixed", provenance={}).bundle
    told = bundle.provenance["tolerates"]
    assert told["within"]["tables"] == 16
    assert (
        told["within"]["accuracy"] > 0.25 + 5 * told["within"]["accuracy_se_objects"]
    )  # of four classes, in six epochs
    curves = misalignment_curves(bundle, HeldOut(task, task.test.first(50), IDEAL), HIDDEN)
    assert curves["black"][0]["value"] == 0.0
    assert np.diff([point["photons_mean"] for point in curves["black"]]).min() > 0  # dark pixels bring light
    with pytest.raises(UsageError, match="coherent encoder shows no patterns"):
        check_options(replace(options, encoder="coherent", optics="psf=0.5"), IDEAL)
