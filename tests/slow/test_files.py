"""Changed contents under right checksums: `verify` answers within its limits, and what it accepts can be used.

Hypothesis chooses what is changed: a value of JSON, a line of TOML, numbers of an array, a block of a recording.
"""

from __future__ import annotations

import hashlib
import json
import resource
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_files import (
    blocks_of,
    passive_bundle,
    record_automaton,
    record_flow,
    record_passive,
    record_run,
    sealed,
    small_calibration,
    use_file,
)

from pans.firmware_sim import __file__ as SIMULATOR
from pans.firmware_sim.testing import small_automaton_bundle, small_setup
from pans.hw_profiles import __file__ as PROFILES
from pans.runtime import SHIPPED
from pans.runtime.bundle.model import bundle_bytes
from pans.runtime.container import canonical_json
from pans.runtime.errors import PansError
from pans.runtime.record.format import Kind
from pans.runtime.report.verify import verify_file

pytestmark = pytest.mark.slow
ANSWER_S, MEMORY_MIB = 2.0, 400  # of processor time for one answer, and more than before; the files have up to 140 kB
CASE = settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
_HEAD = struct.Struct("<8sII")

NUMBERS = st.one_of(
    st.sampled_from((0, 1, -1, 2, 65536, (1 << 53), (1 << 63) - 1, (1 << 64) - 1, 1 << 64, 5e-324, 1e308, 10**30)),
    st.integers(), st.floats(),
)  # fmt: skip
TEXTS = st.one_of(
    st.sampled_from(("", "a" * 300, "\x1b[2J", "../../x", "9999-12-31T23:59:59+00:00")), st.text(max_size=20)
)
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(TEXTS, inner, max_size=2)),
    max_leaves=4,
)
TOML_VALUES = st.one_of(
    NUMBERS.map(str), st.sampled_from(("true", '"x"', '""', "[]", "{}", "[1, 2]", "1979-05-27", "1e999"))
)


def places_of(tree: Any) -> list[tuple[Any, Any]]:
    """Every place in a tree of objects and lists: its parent, and the key."""
    found, pending = [], [tree]
    while pending:
        one = pending.pop()
        keys = list(one) if isinstance(one, dict) else range(len(one))
        found += [(one, key) for key in keys]
        pending += [one[key] for key in keys if isinstance(one[key], dict | list)]
    return found


@st.composite
def changed_json(draw: st.DrawFn, value: Any) -> Any:
    """`value` with one to three values changed, removed or moved a little."""
    tree = json.loads(json.dumps(value))
    for _ in range(draw(st.integers(1, 3))):
        places = places_of(tree)
        if not places:
            break
        parent, key = draw(st.sampled_from(range(len(places))).map(places.__getitem__))
        how = draw(st.sampled_from(("remove", "near", "any", "any")))
        if how == "remove":
            del parent[key]
        elif how == "near" and isinstance(parent[key], int | float) and not isinstance(parent[key], bool):
            parent[key] = draw(st.sampled_from((parent[key] + 1, parent[key] - 1, -parent[key], parent[key] * 1000)))
        else:
            parent[key] = draw(VALUES)
    return tree


@st.composite
def changed_toml(draw: st.DrawFn, text: str) -> bytes:
    """`text` with one or two lines changed, removed or doubled."""
    lines = text.split("\n")
    for _ in range(draw(st.integers(1, 2))):
        places = [number for number, line in enumerate(lines) if "=" in line and not line.startswith("#")]
        place, how = draw(st.sampled_from(places)), draw(st.sampled_from(("change", "change", "remove", "double")))
        if how == "change":
            lines[place] = f"{lines[place].split('=')[0]}= {draw(TOML_VALUES)}"
        elif how == "remove":
            del lines[place]
        else:
            lines.insert(place, lines[place])
    return "\n".join(lines).encode("utf-8", "replace")


@st.composite
def changed_bytes(draw: st.DrawFn, data: bytes) -> bytes:
    """`data` with some bytes overwritten, cut or doubled."""
    changed, place = bytearray(data), draw(st.integers(0, max(0, len(data) - 1)))
    piece = draw(st.one_of(st.binary(max_size=8), st.sampled_from((b"\xff" * 8, b"\0" * 8, b"\0\0\0\x80"))))
    changed[place : place + draw(st.integers(0, 8))] = piece
    return bytes(changed)


@st.composite
def changed_bundle(draw: st.DrawFn, data: bytes) -> bytes:
    """A bundle with another header or another part; its checksums fit."""
    magic, version, length = _HEAD.unpack_from(data)
    header, start = json.loads(data[_HEAD.size : _HEAD.size + length]), _HEAD.size + length
    parts = [(row, data[start + row["offset"] : start + row["offset"] + row["length"]]) for row in header["parts"]]
    place, how = draw(st.integers(0, len(parts) - 1)), draw(st.sampled_from(("header", "part", "part", "drop")))
    if how == "drop":
        del parts[place]
    elif how == "part":
        row, blob = parts[place]
        array = np.frombuffer(blob, row["dtype"]).copy()
        if row["name"].endswith("onnx") or not array.size:
            blob = draw(changed_bytes(blob))
            row["shape"] = [len(blob)]
        else:
            edges: tuple[Any, ...] = (np.nan, np.inf, -np.inf, 3.4e38, 1e-45, 0.0, -0.0, 1.0)
            if array.dtype.kind in "iu":
                info = np.iinfo(array.dtype)
                edges = (info.min, info.max, 0, 1, info.max // 2, int(array.flat[0]))
            where = draw(st.one_of(st.just(slice(None)), st.integers(0, array.size - 1)))
            array[where] = np.array(draw(st.sampled_from(edges))).astype(array.dtype)
            blob = array.tobytes()
        parts[place] = row, blob
    rows, offset = [], 0
    for row, blob in parts:
        digest = hashlib.sha256(blob).hexdigest()
        rows.append(row | {"offset": offset, "length": len(blob), "sha256": digest})
        offset += len(blob)
    header["parts"] = rows
    text = json.dumps(draw(changed_json(header))).encode() if how == "header" else canonical_json(header)
    body = b"".join((_HEAD.pack(magic, version, len(text)), text, *(blob for _, blob in parts)))
    return body + hashlib.sha256(body).digest()


@st.composite
def changed_recording(draw: st.DrawFn, data: bytes) -> bytes:
    """A recording with one block changed, removed, doubled or moved; chain, index, END and the bundle's digest fit."""
    blocks = blocks_of(data)
    place, other = draw(st.integers(0, len(blocks) - 1)), draw(st.integers(0, len(blocks) - 1))
    kind, payload = blocks[place]
    how = draw(st.sampled_from(("payload",) * 6 + ("remove", "double", "swap", "cut")))
    if how == "remove":
        del blocks[place]
    elif how == "double":
        blocks.insert(other + 1, (kind, payload))
    elif how == "swap":
        blocks[place], blocks[other] = blocks[other], blocks[place]
    elif how == "cut":
        del blocks[place + 1 :]
    elif kind in (Kind.HEADER, Kind.END):
        blocks[place] = kind, json.dumps(draw(changed_json(json.loads(payload)))).encode()
    elif kind == Kind.BUNDLE:
        blocks[place] = kind, draw(changed_bundle(payload))
    else:
        blocks[place] = kind, draw(changed_bytes(payload))
    return sealed(blocks)


@st.composite
def changed_calibration(draw: st.DrawFn, data: bytes) -> bytes:
    """A calibration that says something else, with its checksum."""
    changed = draw(changed_json({key: value for key, value in json.loads(data).items() if key != "sha256"}))
    try:
        digest = hashlib.sha256(canonical_json(changed)).hexdigest()
    except (ValueError, TypeError):
        digest = "0" * 64
    return json.dumps(changed | {"sha256": digest}).encode()


def answer(kind: str, path: Path) -> float:
    """Verify a file and use it where it is accepted; return the seconds that it took. Scenes and flow files are read."""
    started = time.process_time()
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        if kind in ("scene", "flow"):
            with suppress(PansError):
                use_file(kind, path)
        elif not ((verdict := verify_file(path)).violations or verdict.damaged):
            use_file(kind, path)
    return time.process_time() - started


def check(kind: str, suffix: str, folder: Path, data: bytes) -> None:
    """Write a changed file and have it answered; once more where the first answer was slow: it may have compiled a kernel."""
    path = folder / f"changed{suffix}"
    path.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if answer(kind, path) > ANSWER_S:
        assert answer(kind, path) < ANSWER_S
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before < MEMORY_MIB


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("files")


@pytest.fixture(scope="module")
def bundles() -> list[bytes]:
    small = [small_setup()[1], passive_bundle(), *(small_automaton_bundle(levels) for levels in (2, 8))]
    return [(SHIPPED / "fashion10.pans").read_bytes(), *map(bundle_bytes, small)]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    makers = (record_run, record_passive, record_flow, record_automaton)
    return [make(tmp_path_factory.mktemp("run")).read_bytes() for make in makers]


@pytest.fixture(scope="module")
def calibration(folder: Path) -> bytes:
    return small_calibration(folder)


@CASE
@given(data=st.data())
def test_bundles(folder: Path, bundles: list[bytes], data: st.DataObject) -> None:
    check("bundle", ".pans", folder, data.draw(changed_bundle(data.draw(st.sampled_from(bundles)))))


@CASE
@given(data=st.data())
def test_recordings(folder: Path, recordings: list[bytes], data: st.DataObject) -> None:
    check("recording", ".pansrec", folder, data.draw(changed_recording(data.draw(st.sampled_from(recordings)))))


@CASE
@given(data=st.data())
def test_calibrations(folder: Path, calibration: bytes, data: st.DataObject) -> None:
    check("calibration", ".json", folder, data.draw(changed_calibration(calibration)))


FILES = {
    "profile": sorted(Path(PROFILES).parent.glob("*.toml")),
    "scene": sorted((Path(SIMULATOR).parent / "scenes").glob("*.toml")),
    "flow": sorted(SHIPPED.glob("flow-*.toml")),
}


@pytest.mark.parametrize("kind", FILES)
@CASE
@given(data=st.data())
def test_toml_files(kind: str, folder: Path, data: st.DataObject) -> None:
    text = data.draw(st.sampled_from(FILES[kind])).read_text()
    check(kind, ".toml", folder, data.draw(changed_toml(text)))
