"""Bundles of automata: every byte comes back, every lie about an automaton is named, small files stay small in memory."""

import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import EXPECTED, automaton_bundle, diamond, early_leaf, random_automaton

from pans.base.errors import DamagedFileError
from pans.bundle.automaton import Automaton
from pans.bundle.sensor import Bundle, bundle_bytes, facts, load_bundle, parse_bundle, with_expected, write_bundle


def taken_apart(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    length = struct.unpack_from("<I", data, 12)[0]
    header = json.loads(data[16 : 16 + length])
    begin = 16 + length
    rows = header["parts"]
    blobs = {row["name"]: data[begin + row["offset"] : begin + row["offset"] + row["length"]] for row in rows}
    arrays = {row["name"]: np.frombuffer(blobs[row["name"]], row["dtype"]).reshape(row["shape"]).copy() for row in rows}
    return header, arrays


def put_together(header: dict[str, Any], arrays: dict[str, np.ndarray], version: int = 1) -> bytes:
    header["parts"], blobs, offset = [], [], 0
    for name, array in arrays.items():
        blob = array.tobytes()
        row = {"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "offset": offset}
        header["parts"].append(row | {"length": len(blob), "sha256": hashlib.sha256(blob).hexdigest()})
        blobs.append(blob)
        offset += len(blob)
    text = json.dumps(header).encode()
    body = struct.pack("<8sII", b"PANSBNDL", version, len(text)) + text + b"".join(blobs)
    return body + hashlib.sha256(body).digest()


def same(one: Bundle, other: Bundle) -> None:
    for owners, names in (
        ((one.automaton, other.automaton), ("pattern", "dwell", "successors", "posteriors", "depth")),
        ((one, other), ("pattern_levels", "golden_means", "golden_scores", "golden_walks")),
    ):
        for name in names:
            a, b = (getattr(owner, name) for owner in owners)
            assert (a.dtype, b.flags.writeable, np.array_equal(a, b)) == (b.dtype, False, True), name
    assert one.automaton.dwell_steps == other.automaton.dwell_steps
    names = ("name", "task", "classes", "encoder", "image_shape", "levels", "photons_per_level", "provenance")
    names += ("expected",)
    assert [getattr(one, name) for name in names] == [getattr(other, name) for name in names]


def counting() -> Automaton:
    """An automaton of four photon numbers."""
    few = random_automaton(4, channels=2)
    return Automaton(few.pattern, few.dwell, few.dwell_steps, few.successors, few.posteriors, counts=True)


COME_BACK = [
    (early_leaf(), {}, 1),
    (random_automaton(3, slots=11), {}, 1),
    (counting(), {"outcomes": 4}, 3),
    (random_automaton(4, slots=4, channels=3), {"channels": 3}, 1),
]


@pytest.mark.parametrize("levels", [2, 3, 256, 257, 65536])
@pytest.mark.parametrize(("automaton", "facts", "largest"), COME_BACK)
def test_every_fact_comes_back(
    tmp_path: Path, automaton: Automaton, facts: dict[str, int], largest: int, levels: int
) -> None:
    plain = automaton_bundle(automaton, levels=levels)
    made = with_expected(plain, EXPECTED | {"exposures": 1.5})
    digest = write_bundle(made, tmp_path / "a.pans")
    read, found = load_bundle(tmp_path / "a.pans")
    assert found == digest
    same(made, read)
    assert (read.automaton.counts, read.automaton.rows.tolist()) == (automaton.counts, automaton.rows.tolist())
    assert (read.n_channels, read.largest) == (facts.get("channels", 1), largest)
    assert bundle_bytes(read) == (tmp_path / "a.pans").read_bytes()
    part = {2: "pattern_bits", 3: "pattern_bytes", 256: "pattern_bytes"}.get(levels, "pattern_levels")
    header, arrays = taken_apart((tmp_path / "a.pans").read_bytes())
    assert list(header) == sorted(header)
    assert header["automaton"] == {"dwell_steps": automaton.dwell_steps} | facts
    assert list(arrays)[:3] == [part, "state_pattern", "state_dwell"]
    assert "expected" not in taken_apart(bundle_bytes(plain))[0]


Change = Callable[[dict[str, Any], dict[str, np.ndarray]], Any]


def put(part: str, place: Any, value: Any) -> Change:
    return lambda header, arrays: arrays[part].__setitem__(place, value)


def replace_part(part: str, make: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda header, arrays: arrays.__setitem__(part, make(arrays[part]))


LIES: list[tuple[Change, str]] = [
    (lambda h, a: h.pop("automaton"), "the parts"),
    (lambda h, a: h.update(sensor={}), "the header has the keys"),
    (lambda h, a: h.update(automaton={}), "automaton is {}"),
    (lambda h, a: h.update(automaton={"dwell_steps": 2.0}), r"dwell_steps is 2\.0"),
    (lambda h, a: h.update(automaton={"dwell_steps": 1}), "dwell runs from 1 to 2"),
    (lambda h, a: h.update(expected=None), "expected is None"),
    (lambda h, a: h.update(expected={}), "expected has the keys"),
    (lambda h, a: h.update(expected=EXPECTED | {"accuracy": 2}), r"expected\.accuracy is 2"),
    (lambda h, a: h.update(expected=EXPECTED | {"clicks": 9.0}), r"expected\.clicks is 9"),
    (lambda h, a: h.update(encoder="active"), "encoder active, and an automaton"),
    (lambda h, a: h.update(levels=2), "the parts .*needed: .*pattern_bits"),
    (lambda h, a: h.update(image_shape=[2, 3]), "patterns of 6 pixels need 6"),
    (lambda h, a: a.pop("golden_walks"), "the parts"),
    (lambda h, a: a.update(table=np.zeros((8, 3), "<f4")), "the parts .*table"),
    (put("state_pattern", 1, 3), "a state shows pattern 3"),
    (put("successors", (0, 0), 0), "state 0 has the successors"),
    (put("successors", (4, 1), 8), "a successor is 8"),
    (put("successors", (1, 0), 5), "a golden walk|golden walk"),
    (put("posteriors", (6, 0), np.nan), "posteriors run from nan"),
    (put("posteriors", 6, [0.3, 0.6, 0.1]), "the golden posteriors are not those"),
    (put("golden_words", (2, 0), 2), "golden walk 2 is at node"),
    (put("golden_words", (0, 0), 8), "bits behind the last of 3"),
    (put("golden_walks", (0, 1), 2), "golden walk 0 is at node 2 after 1"),
    (put("golden_walks", (0, 3), 4), "ends at a node outside 5 to 7"),
    (put("golden_walks", (0, 3), 0xFFFFFFFF), "ends at a node outside 5 to 7"),
    (put("golden_posteriors", (0, 0), 0.69), "the golden posteriors are not those"),
    (replace_part("golden_walks", lambda a: a[:, :3].copy()), "golden_walks has shape"),
    (replace_part("golden_words", lambda a: np.repeat(a, 2, axis=1)), "golden_words has rows of 2 bytes"),
    (replace_part("golden_words", lambda a: np.zeros((4097, 1), np.uint8)), "4097 golden walks"),
    (replace_part("state_dwell", lambda a: a[:4].copy()), r"dwell has shape \(4,\)"),
    (replace_part("successors", lambda a: a.reshape(-1)), "successors has shape"),
    (replace_part("posteriors", lambda a: a[:, :2].copy()), "golden posteriors|sums to 1"),
]

CHANNEL_LIES: list[tuple[Change, str]] = [
    (lambda h, a: h["automaton"].update(channels=3), "channels is 3, successors has 4 columns"),
    (lambda h, a: h["automaton"].update(channels=True), "channels is True, successors"),
    (lambda h, a: h["automaton"].update(outcomes=4), "perhaps outcomes or channels"),
    (lambda h, a: h["automaton"].pop("channels"), "channels is 1, successors has 4 columns"),
    (lambda h, a: a["state_pattern"].__setitem__(0, len(a["pattern_bytes"]) - 1), "a state shows pattern"),
]
COUNT_LIES: list[tuple[Change, str]] = [
    (lambda h, a: h["automaton"].update(outcomes=3), "outcomes is 3, successors has 4 columns"),
    (lambda h, a: h["automaton"].update(outcomes=4.0), r"outcomes is 4\.0, successors"),
    (lambda h, a: h["automaton"].update(more=1), "allowed: dwell_steps"),
    (lambda h, a: h["automaton"].pop("outcomes"), "channels is 1, successors has 4 columns"),
    (lambda h, a: a["golden_words"].__setitem__((0, 0), 4), "other numbers than whole ones from 0 to 3|index 4"),
    (lambda h, a: h["automaton"].update(outcomes=2) or a.update(successors=a["successors"][:, :2]), "2 photon numbers"),
]
ALL_LIES = [
    (made, *lie)
    for made, lies in ((diamond(), LIES), (random_automaton(4, channels=2), CHANNEL_LIES), (counting(), COUNT_LIES))
    for lie in lies
]


@pytest.mark.parametrize(("automaton", "change", "words"), ALL_LIES, ids=[lie[2][:30] for lie in ALL_LIES])
def test_a_lie_with_right_checksums_is_named(automaton: Automaton, change: Change, words: str) -> None:
    header, arrays = taken_apart(bundle_bytes(automaton_bundle(automaton)))
    change(header, arrays)
    with pytest.raises(DamagedFileError, match=words):
        parse_bundle(put_together(header, arrays), "here")


def test_bits_that_would_fill_the_memory_are_refused_before() -> None:
    header, arrays = taken_apart(bundle_bytes(automaton_bundle(levels=2)))
    header["image_shape"] = [1024, 2048]
    arrays["pattern_bits"] = np.zeros((20, 1 << 18), np.uint8)
    with pytest.raises(DamagedFileError, match="20 patterns of 2097152 pixels, allowed: 40000000 in all"):
        parse_bundle(put_together(header, arrays), "here")


def test_long_words_are_fewer_golden_ones() -> None:
    n = 1024
    chain = np.tile(np.arange(1, n + 1)[:, None], (1, 16))
    longest = Automaton(np.zeros(n, int), np.ones(n, int), 1, chain, np.full((n + 1, 2), 0.5))
    made = automaton_bundle(longest, levels=2)
    assert (made.n_features, len(made.golden_means)) == (4096, 214)
    same(made, parse_bundle(bundle_bytes(made), "here"))


def test_patterns_beyond_the_budget_are_refused_before_they_are_unpacked_and_after(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bundle = automaton_bundle(random_automaton(3))
    data, cells = bundle_bytes(bundle), bundle.pattern_levels.size
    for name, limit in (("PATTERN_CELLS_MAX", cells - 1), ("PATTERNS_MAX", len(bundle.pattern_levels) - 1)):
        with monkeypatch.context() as patch:
            patch.setattr(facts, name, limit)
            with pytest.raises(DamagedFileError, match=str(limit)):
                parse_bundle(data, "x")
    parse_bundle(data, "x")
