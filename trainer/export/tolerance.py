"""What a bundle tolerates of the optics: accuracy within the tolerance that it was trained through, and at its edge.

Owns these facts of a bundle; the figures are evaluate/optics.py's. Exact expectations over the first held-out objects, SIMULATED.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.imaging import tolerance_of
from pans.runtime.instrument.profile import Profile
from pans.trainer.evaluate.held_out import Conditions, HeldOut
from pans.trainer.evaluate.optics import OverOptics, drawn_tables, over_optics
from pans.trainer.tasks.registry import Task

JUDGED_OBJECTS = 2000
DRAWN_TABLES = 16


def with_tolerance(bundle: Bundle, task: Task, profile: Profile, optics: str | None, dark: float | None) -> Bundle:
    """Return `bundle` with the fact `tolerates`, where it was trained through `optics`; else as it is.

    `within` is over tables drawn uniformly, `edge` over the corners of shift and rotation at the widest blur and lightest black.
    """
    if optics is None or bundle.picture_shape is not None:
        return bundle
    tolerance = tolerance_of(optics)
    held_out = HeldOut(task, task.test.first(JUDGED_OBJECTS), profile)
    told = Conditions(dark=dark)
    tables = {
        "middle": [tolerance.middle],
        "within": drawn_tables(tolerance, DRAWN_TABLES, 0),
        "edge": tolerance.edges(),
    }
    found = {name: _rounded(over_optics(bundle, held_out, which, told)) for name, which in tables.items()}
    fact = {"optics": optics, "words": tolerance.words(), "simulated": True, **found}
    return replace(bundle, provenance={**bundle.provenance, "tolerates": fact})


def _rounded(found: OverOptics) -> dict[str, Any]:
    return {
        "accuracy": round(found.accuracy_mean, 5),
        "accuracy_std_optics": round(found.accuracy_std_optics, 5),
        "accuracy_se_objects": round(found.accuracy_se_objects, 5),
        "accuracy_worst": round(found.accuracy_worst, 5),
        "clicks": round(found.clicks_mean, 4),
        "photons": round(found.photons_mean, 4),
        "illumination": round(found.illumination, 3),
        "objects": found.objects,
        "tables": found.tables,
    }
