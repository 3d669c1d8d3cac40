"""Changed contents under right checksums: `verify` answers within its limits, and what it accepts can be used.

Hypothesis chooses what is changed: a value of JSON, a line of TOML, numbers of an array, a block of a recording.
"""

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
import small_files
from bundles import resealed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
def changed_toml(draw: st.DrawFn, data: bytes) -> bytes:
    """A text with one or two lines changed, removed or doubled."""
    lines = data.decode().split("\n")
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
    """A bundle with another header, or other numbers in one of its parts; its checksums fit."""
    start = _HEAD.size + _HEAD.unpack_from(data)[2]
    header = json.loads(data[_HEAD.size : start])
    if draw(st.booleans()):
        other = draw(changed_json(header))
        return resealed(data, lambda header: (header.clear(), header.update(other)))
    number = draw(st.integers(0, len(header["parts"]) - 1))
    row = header["parts"][number]
    part = slice(start + row["offset"], start + row["offset"] + row["length"])
    array = np.frombuffer(data[part], "u1" if row["name"].endswith("onnx") else row["dtype"]).copy()
    edges: tuple[Any, ...] = (np.nan, np.inf, -np.inf, 3.4e38, 1e-45, 0.0, -0.0, 1.0)
    if array.dtype.kind in "iu":
        info = np.iinfo(array.dtype)
        edges = (info.min, info.max, 0, 1, info.max // 2)
    if array.size:
        place = draw(st.one_of(st.just(slice(None)), st.integers(0, array.size - 1)))
        array[place] = np.array(draw(st.sampled_from(edges))).astype(array.dtype)
    changed = data[: part.start] + array.tobytes() + data[part.stop :]
    digest = hashlib.sha256(changed[part]).hexdigest()
    return resealed(changed, lambda header: header["parts"][number].update(sha256=digest))


@st.composite
def changed_recording(draw: st.DrawFn, data: bytes) -> bytes:
    """A recording with one block changed, removed, doubled or moved; chain, index, END and the bundle's digest fit."""
    blocks = small_files.blocks_of(data)
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
    return small_files.sealed(blocks)


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
    """Verify a file and use it where it is accepted; return the processor time that it took. Scenes and flow files are read."""
    started = time.process_time()
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        if kind in ("scene", "flow"):
            with suppress(PansError):
                small_files.use_file(kind, path)
        elif not ((verdict := verify_file(path)).violations or verdict.damaged):
            small_files.use_file(kind, path)
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
def sound(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[bytes]]:
    """Sound files of each kind."""
    small = [small_setup()[1], small_files.passive_bundle(), *(small_automaton_bundle(levels) for levels in (2, 8))]
    makers = (small_files.record_run, small_files.record_passive, small_files.record_flow, small_files.record_automaton)
    shipped = {
        "bundle": [SHIPPED / "fashion10.pans"],
        "recording": [make(tmp_path_factory.mktemp("run")) for make in makers],
        "profile": sorted(Path(PROFILES).parent.glob("*.toml")),
        "scene": sorted((Path(SIMULATOR).parent / "scenes").glob("*.toml")),
        "flow": sorted(SHIPPED.glob("flow-*.toml")),
    }
    files = {kind: [path.read_bytes() for path in paths] for kind, paths in shipped.items()}
    files["bundle"] += map(bundle_bytes, small)
    return files | {"calibration": [small_files.small_calibration(folder)]}


KINDS = {
    "bundle": (".pans", changed_bundle),
    "recording": (".pansrec", changed_recording),
    "calibration": (".json", changed_calibration),
    "profile": (".toml", changed_toml),
    "scene": (".toml", changed_toml),
    "flow": (".toml", changed_toml),
}


@pytest.mark.parametrize("kind", KINDS)
@CASE
@given(data=st.data())
def test_changed_files_are_refused_or_can_be_used(
    kind: str, folder: Path, sound: dict[str, list[bytes]], data: st.DataObject
) -> None:
    suffix, change = KINDS[kind]
    check(kind, suffix, folder, data.draw(change(data.draw(st.sampled_from(sound[kind])))))
