"""The paper's figures as they are read, and the recipes of our trainings."""

import pytest

from pans.instrument.profile import load_profile
from pans_trainer.options import check_options
from pans_trainer.reproduce import active, curves, passive, sequence
from pans_trainer.reproduce.printed import ACTIVE, PASSIVE, recipe

IDEAL = load_profile("ideal")


def test_the_papers_rows_are_all_there_and_plausible():
    assert [len(rows) for rows in ACTIVE.values()] == [7, 6]
    for row in (row for rows in ACTIVE.values() for row in rows):
        assert 0 < row.clicks < row.features
        assert row.simulation[0] < row.simulation[3]
        assert len(row.simulation) == len(row.experiment) == len(row.simulation_std) == len(row.experiment_std) == 4
        assert all(0 < value < 3 for value in row.simulation_std + row.experiment_std)
    for name, table in PASSIVE.items():
        printed_values = [row.values for row in table.rows if row.values]
        assert all(len(values) == len(table.dark) for values in printed_values)
        assert bool(printed_values) == (name not in ("tissue", "nebula", "cells-4"))
        assert all(list(values) == sorted(values, reverse=True) for values in printed_values)  # dark counts hurt
        assert all(0 < row.clicks < row.features for row in table.rows)


@pytest.mark.parametrize(("name", "row"), [(name, row) for name, rows in ACTIVE.items() for row in rows])
def test_recipes_can_be_trained_and_aim_at_the_papers_clicks(name, row):
    options = active.options_of(name, row)
    check_options(options, IDEAL)
    darker = {"fashion-mnist": 1.0, "mnist": 1.07}[name]  # of the first 200 images, by which clicks are counted
    assert row.clicks <= options.clicks <= 1.05 * darker * row.clicks
    seeds = active.OTHER_SEEDS.get((name, row.features), (1000,))
    assert min(seeds) > (options.restarts + 1) * options.starts  # not a restart of seed 0


def test_recipes_of_the_other_tasks_can_be_trained():
    every = [(n, row, dark) for n, table in PASSIVE.items() for row in table.rows for dark in table.dark]
    for name, row, dark in every:
        options = recipe(name, row, dark)
        check_options(options, IDEAL)
        assert options.dark == dark
        assert options.encoder == ("active" if name in ("barcode", "cells", "cells-4") else "coherent")
        first = recipe(name, row, PASSIVE[name].dark[0])
        assert options.clicks >= first.clicks  # more dark counts take nothing of the light
    for row in PASSIVE["mmf-mnist"].rows[:8]:
        options = recipe(passive.FIELD, row)
        check_options(options, IDEAL)
        assert (options.complex_field, options.conserving, options.input_photons) == (True, True, 100.0)


def test_recipes_of_trainings_that_are_followed_can_be_trained():
    for schedule, cells in curves.CELLS.items():
        for features, alpha in cells:
            check_options(curves.options_of(features, alpha, schedule), IDEAL)
    assert curves.STAGES[-1] == curves.options_of(*curves.SHOWN).epochs
    check_options(sequence.OPTIONS, IDEAL)
