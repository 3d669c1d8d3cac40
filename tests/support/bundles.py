"""Bundles for tests from flat facts: what a test does not name is a toy."""

from __future__ import annotations

from typing import Any

import numpy as np

from pans.runtime.bundle.model import BackEnd, Bundle, Shown, make_bundle


def made_bundle(d_f: int = 2, n_classes: int = 2, **facts: Any) -> Bundle:
    """A bundle of the fields of `make_bundle`, `Shown` and `BackEnd`; patterns are one pixel each unless they are given."""
    toy: dict[str, Any] = {
        "name": "toy",
        "task": "test",
        "classes": [f"c{i}" for i in range(n_classes)],
        "image_shape": (1, 1),
        "levels": 2,
        "pattern_levels": np.ones((d_f, 1), np.int64),
        "photons_per_level": 1.0,
        "provenance": {},
    }
    given = toy | facts
    shown, back_end = (
        part(**{name: given.pop(name) for name in part.__slots__ if name in given}) for part in (Shown, BackEnd)
    )
    return make_bundle(optics=shown, back_end=back_end, **given)
