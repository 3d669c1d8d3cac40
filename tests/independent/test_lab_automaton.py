"""The reader of automata written from the document alone against the package: same meaning, same decisions."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from automata import automaton_bundle, diamond, early_leaf, random_automaton
from lab_automaton import ABSTAINS, read_automaton, walk_again
from lab_bundle import read_bundle
from lab_recording import read_recording

from pans.app.main import main
from pans.bundle.automaton import Automaton
from pans.bundle.backends import make_decider
from pans.bundle.backends.automaton import AutomatonDecider
from pans.bundle.sensor import bundle_bytes, write_bundle

AUTOMATA = [early_leaf(), diamond(), random_automaton(1, slots=12), random_automaton(2, slots=5, channels=2)]
COUNTED = [random_automaton(3, slots=6, outcomes=3), random_automaton(4, slots=4, outcomes=16)]  # photon numbers


@pytest.mark.parametrize("levels", [2, 100, 1000])
@pytest.mark.parametrize("automaton", [*AUTOMATA, *COUNTED])
def test_an_automaton_means_the_same(automaton: Automaton, levels: int) -> None:
    made = automaton_bundle(automaton, levels=levels)
    found = read_automaton(read_bundle(bundle_bytes(made)))
    assert np.array_equal(found.patterns, made.pattern_levels)
    parts = [range(first, first + found.channels) for first in found.shows]
    light = [found.patterns[p].sum() * made.photons_per_level * d for p, d in zip(parts, found.dwell_share)]
    assert light == pytest.approx(made.state_light())
    assert found.counts == automaton.counts
    words = np.random.default_rng(levels).integers(0, automaton.largest + 1, (100, made.n_features))
    decider = make_decider(made)
    for word in words:
        assert found.decide(word.tolist()) == decider.decide(word, 1)


@pytest.mark.parametrize("confidence", [0.4, 0.75, 0.9, 1.0])
@pytest.mark.parametrize("automaton", AUTOMATA[1:])
def test_stopping_means_the_same(automaton: Automaton, confidence: float) -> None:
    made = automaton_bundle(automaton)
    found = read_automaton(read_bundle(bundle_bytes(made)))
    decider = make_decider(made, confidence=confidence)
    assert isinstance(decider, AutomatonDecider)
    words = np.random.default_rng(4).integers(0, 2, (200, made.n_features))
    short = words[:, : decider.n_features]
    exposures = decider.leaves(short)[1]
    for word, bits, length in zip(words.tolist(), short, exposures):
        assert found.decide(word, confidence) == decider.decide(bits, 1)
        assert len(found.walk(word, confidence)) - 1 == length
    assert confidence < 0.9 or ABSTAINS in decider.decide_batch(short, 1)


FAULTS = "loss:0.02,duplicate:0.02,flip:0.01"


@pytest.mark.parametrize(
    ("drive", "outcomes", "faults"),
    [
        *(("device", 0, ""), ("host", 3, ""), ("device", 3, FAULTS), ("host", 0, FAULTS)),
        *(("device", -2, ""), ("host", -2, FAULTS)),
    ],
)
def test_walks_come_out_the_same(tmp_path: Path, drive: str, outcomes: int, faults: str) -> None:
    """A run with an automaton, of clicks, of photon numbers and (below 0) of several channels: every row, bit for bit."""
    more_of_it = {"channels": -outcomes} if outcomes < 0 else {"outcomes": outcomes}
    made = automaton_bundle(random_automaton(7, slots=6, **more_of_it), levels=2, photons_per_level=0.25)
    write_bundle(made, tmp_path / "walk.pans")
    images = np.random.default_rng(2).integers(0, 256, (20, *made.image_shape)).astype(np.uint8)
    np.savez(tmp_path / "tiny.npz", images=images, labels=np.arange(20) % 3, classes=np.array(made.classes))
    more = f"&faults={faults}" if faults else ""
    profile = "dmd-four-snspd" if outcomes < 0 else "dmd-qcmos"
    device = f"sim:{profile}?scene={tmp_path / 'tiny.npz'}&seed=5&pace=fast{more}"
    words = ["--drive", drive, "--decisions", "60", "--trials", "3", "--out", str(tmp_path / "out"), "-q"]
    main(["run", str(tmp_path / "walk.pans"), "--device", device, *words])
    data = (tmp_path / "out" / "run.pansrec").read_bytes()
    assert struct.unpack_from("<I", data, 8) == (1,)
    recording = read_recording(data)
    rows = walk_again(recording, read_automaton(read_bundle(recording.bundle)))
    assert rows.tobytes() == recording.rows.tobytes()
    assert len(rows) == 60
    assert (np.count_nonzero(rows["flags"]) > 0) == bool(faults)
