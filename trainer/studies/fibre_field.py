"""The page `mmf-mnist-field`: digits behind a multimode fibre as a field at fixed scale, which an instrument can measure.

Owns the recipe and the tables. `mmf-mnist` is given the release's input, a normalised intensity taken for a field; here W is complex, sees
the field at the fibre's end and conserves light, with as many photons before it for every number of detectors. Beside each row stands
direct imaging, twice: with as many photons as the row detects, and with as many as must reach its optics at least. SIMULATED on the
profile `ideal`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import EXACT_FEATURES_MAX, Options, differing_options, plain_options
from pans.trainer.paper.page import Asked, Draw, Made, Row, Rows, Table, columns, kept, pages
from pans.trainer.paper.paradigms import accuracy_at
from pans.trainer.paper.passive import PROFILE, direct_rows, measure
from pans.trainer.paper.tables import PASSIVE, PassiveRow
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.loop import train
from pans.trainer.verdicts import against, claim

from . import pictures

NAME, TASK = "mmf-mnist-field", "mmf-mnist"
ROWS = tuple(row for row in PASSIVE[TASK].rows if row.features <= 32)  # those of the paper's figure
LIGHT = 100.0  # photons per digit that reach an encoder that conserves them
DARK = 0.01  # the first dark count of the paper's table
MOST = 1000.0  # photons of direct imaging, of which more tell nothing more: the last level of its curve


def recipe(features: int) -> Options:
    """Return what a row is trained with; rates and copies were chosen on the last 10 000 training images."""
    shared = Options(
        features=features,
        alpha=0.0,
        encoder="coherent",
        complex_field=True,
        conserving=True,
        input_photons=LIGHT,
        dark=DARK,
        epochs=16,
        polish=0.4,
        head_rate=3e-3,
    )
    if features <= EXACT_FEATURES_MAX:
        return replace(shared, estimator="exact", warm=0.4, hidden=128)
    return replace(shared, estimator="local", warm=0.15, hidden=128 if features <= 16 else 256)


def fibre_field_page(asked: Asked) -> Made:
    """Return one row per number of detectors, each beside direct imaging; then direct imaging itself."""
    direct = direct_rows(replace(asked, name=TASK))
    wanted = [row for row in ROWS if asked.wants(row.features)]
    rows = [found | _beside(found, direct) for row in wanted if (found := _trained(asked, row)) is not None]
    drawn: dict[str, Draw] = {"": partial(pictures.fibre_field, rows=rows, direct=direct)}
    return Made(rows + direct, drawn)


def _trained(asked: Asked, row: PassiveRow) -> Row | None:
    options = recipe(row.features)

    def make() -> Row:
        task = replace(
            load_task(TASK, asked.data_dir), name=NAME
        )  # `measure` knows the release's input by the task's name
        found = measure(NAME, task, train(task, load_profile(PROFILE), options))
        asked.report(f"d_f = {row.features}: {found['value']:.2f} % at {found['photons']:.1f} photons")
        return found

    path = asked.cache / f"{NAME}-{row.features}.json"
    found = kept(path, {"options": differing_options(options)}, make, collect=asked.collect)
    if found is None:
        asked.report(f"d_f = {row.features}: not trained yet (pans reproduce {NAME} --rows {row.features})")
        return None
    figures = {key: value for key, value in found.items() if key != "made_with"}
    release = {"release": row.values[0], "release_clicks": row.clicks}  # what the paper prints of its own input
    return {"features": row.features, "dark": DARK, **figures, **release, "options": plain_options(options)}


def _beside(row: Row, direct: Rows) -> Row:
    """Direct imaging with the photons of the row, and with those that must reach its optics; nothing where it was not measured."""
    found = {}
    for key, photons in (("detected", row["photons"]), ("reaching", row["reaching"])):
        light = min(photons, MOST)
        value, error, clicks = (
            accuracy_at(direct, light, "photons", of) for of in ("value", "error_objects", "clicks")
        )
        if value is not None and error is not None:
            compared = against(row["value"], value, row["error_objects"], error)
            found[key] = {"value": value, "photons": light, "clicks": clicks} | compared
    return {"direct": found}


def fibre_field_tables(rows: Rows) -> list[Table]:
    """Return the table of ours and that of direct imaging."""
    tables, mine = [], [row for row in rows if "direct" in row]
    if mine:
        claims = [
            claim("Ours", f"direct imaging with the photons {words}", [row["direct"].get(key) for row in mine])
            for key, words in (("detected", "detected"), ("reaching", "that must reach the optics"))
        ]
        tables.append(Table(columns("fibre_field"), mine, claims=claims))
    direct = [row for row in rows if "way" in row]
    if direct:
        tables.append(Table(columns("direct_frames_of_speckle"), direct, "## Direct imaging"))
    return tables


PAGES = pages({NAME: (fibre_field_page, fibre_field_tables)})
