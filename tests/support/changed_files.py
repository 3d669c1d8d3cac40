"""Files and pictures as accidents and strangers change them, as strategies of Hypothesis: some with right checksums, some with none."""

import hashlib
import io
import json
import struct
import warnings
from typing import Any

import numpy as np
import small_files
from bundles import resealed
from hypothesis import strategies as st

from pans.base.files.container import canonical_json
from pans.record.reading.format import Kind

_HEAD = struct.Struct("<8sII")
HEADER_BYTES = 200  # where most formats say what they hold

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
    """`data` with some bytes overwritten, cut or doubled, as often in its header as elsewhere."""
    last = max(0, len(data) - 1)
    changed, place = bytearray(data), draw(st.one_of(st.integers(0, last), st.integers(0, min(last, HEADER_BYTES))))
    if draw(st.integers(0, 9)) == 0:
        return bytes(changed[:place])
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


def pictures() -> dict[str, bytes]:
    """A small picture of each format and pixel format that this Pillow can write, by name."""
    from PIL import Image

    Image.init()
    rng, found = np.random.default_rng(0), {}
    ways: dict[str, dict[str, Any]] = {"JPEG": {"progressive": True}, "TIFF": {"compression": "tiff_deflate"}}
    for form in sorted(Image.SAVE):
        for mode in ("1", "L", "P", "RGB", "RGBA", "CMYK", "I", "I;16", "F"):
            small = rng.integers(0, 255, (24, 32, 3), np.uint8)
            picture = Image.fromarray(small).convert("L" if mode == "I;16" else mode)
            picture = Image.fromarray(np.asarray(picture).astype(np.uint16)) if mode == "I;16" else picture
            for number, way in enumerate(({}, ways.get(form))):
                stream = io.BytesIO()
                if way is None:
                    continue
                try:
                    with warnings.catch_warnings(action="ignore"):  # Pillow 13 will give some formats up
                        picture.save(stream, form, **way)
                except (OSError, ValueError, KeyError, SystemError, AttributeError, TypeError):
                    continue  # what this format cannot hold
                found[f"{form}-{mode.replace(';', '')}-{number}"] = stream.getvalue()
    return found
