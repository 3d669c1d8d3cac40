"""Bundles for tests from flat facts: what a test does not name is a toy."""

import hashlib
import json
import struct
from typing import Any

import numpy as np

from pans.bundle.automaton import Automaton
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import BackEnd, Shown, make_bundle


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


def two_states() -> Automaton:
    """Two classes, walks of one or two exposures: a click in the first decides at once. One exposure time for all."""
    return Automaton(
        pattern=[0, 1], dwell=[1, 1], dwell_steps=1, successors=[[1, 2], [3, 4]],
        posteriors=[[0.5, 0.5], [0.6, 0.4], [0.1, 0.9], [0.8, 0.2], [0.3, 0.7]],
    )  # fmt: skip


def six_states() -> Automaton:
    """Three classes, walks of two, three or four exposures, three patterns for six states, dwell in quarters of the exposure.

    0 -> 1 | 2      1 -> 3 | 4      2 -> 4 | leaf 0      3 -> 5 | leaf 1      4 -> leaf 2 | 5      5 -> leaf 3 | leaf 4
    """
    leaf = 6
    return Automaton(
        pattern=[0, 1, 2, 0, 1, 2], dwell=[4, 2, 1, 4, 3, 4], dwell_steps=4,
        successors=[[1, 2], [3, 4], [4, leaf], [5, leaf + 1], [leaf + 2, 5], [leaf + 3, leaf + 4]],
        posteriors=[
            [1 / 3, 1 / 3, 1 / 3], [0.4, 0.4, 0.2], [0.2, 0.3, 0.5], [0.5, 0.4, 0.1], [0.3, 0.4, 0.3], [0.45, 0.45, 0.1],
            [0.05, 0.05, 0.9], [0.1, 0.8, 0.1], [0.2, 0.6, 0.2], [0.7, 0.2, 0.1], [0.15, 0.7, 0.15],
        ],
    )  # fmt: skip


def automaton_bundle(automaton: Automaton, photons: float = 1.0, **facts: Any) -> Bundle:
    """A bundle around `automaton` with patterns of 2 x 3 pixels and two levels; a lit pixel gives `photons` per exposure."""
    n_patterns = int(automaton.pattern.max()) + automaton.channels
    masks = np.random.default_rng(5).integers(0, 2, (n_patterns, 6))
    masks[np.arange(n_patterns), np.arange(n_patterns) % 6] = 1  # none is dark
    shown = {"image_shape": (2, 3), "pattern_levels": masks, "photons_per_level": photons}
    return made_bundle(n_classes=automaton.n_classes, **{"automaton": automaton} | shown | facts)


def resealed(data: bytes, change: Any) -> bytes:
    """The file with its header changed by `change(header dict)` and the closing checksum made to fit again."""
    length = struct.unpack_from("<I", data, 12)[0]
    header = json.loads(data[16 : 16 + length])
    change(header)
    text = json.dumps(header).encode()
    body = data[:12] + struct.pack("<I", len(text)) + text + data[16 + length : -32]
    return body + hashlib.sha256(body).digest()
