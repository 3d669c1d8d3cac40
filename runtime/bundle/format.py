"""Bundles as bytes: docs/reference/formats.md in code.

Owns the layout, its checksums and its limits; never touches a file and never makes a bundle. `parse_bundle` raises
DamagedFileError for any byte that is not as it was written, with the part that changed. The container is our own, not zip: zip
leaves bytes that no checksum covers.
"""

from __future__ import annotations

import hashlib
import io
import math
import struct
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pans.runtime.container import FILE_MAX_BYTES, KIND_BYTES, MIB, canonical_json, other_kind, parse_json_object
from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.ranges import Range, demand

from . import automaton_file
from .automaton import COUNT_OUTCOMES
from .facts import LEVELS_MAX, Bundle, check_bundle, frozen
from .layers import Int8Head
from .optics import Analyser

MAGIC = b"PANSBNDL"
VERSIONS = (1, 2, 3, 4, 5, 6)  # a bundle is written in the lowest that can say it
HEADER_MAX_BYTES = MIB
_PROLOGUE = struct.Struct("<8sII")
_DIGEST_BYTES = 32
_HEADER_KEYS = {
    *("name", "task", "encoder", "classes", "image_shape", "levels", "photons_per_level", "provenance", "parts"),
}
_KEYS_OF_VERSION: dict[int, set[str]] = {
    1: set(),
    2: {"sensor", "picture_shape"},
    3: automaton_file.HEADER_KEYS | automaton_file.OPTIONAL_KEYS,
    4: automaton_file.HEADER_KEYS | automaton_file.OPTIONAL_KEYS,
    5: {"outcomes"},
    6: automaton_file.HEADER_KEYS | automaton_file.OPTIONAL_KEYS,
}
_OF_AUTOMATA = (3, 4, 6)
_OUTCOMES = Range(*COUNT_OUTCOMES, whole=True)
_PART_KEYS = {"name", "dtype", "shape", "offset", "length", "sha256"}
_PARTS = {"pattern_levels": "<u2", "head_onnx": "|u1", "table": "<f4", "golden_means": "<f4", "golden_scores": "<f4"}
_MATRIX_PARTS = {"<f4": "matrix", "<c8": "matrix_complex"}  # of a passive sensor, in place of the patterns: one of them
_INT8_PARTS = {"int8_sizes": "<u4", "int8_weights": "|i1", "int8_affine": "<f4"}  # all three or none
_PARTS |= _INT8_PARTS | {"int8_onnx": "|u1"} | {name: dtype for dtype, name in _MATRIX_PARTS.items()}
_ALL_PARTS = _PARTS | automaton_file.PARTS  # no name has two dtypes
_MODELS = ("head_onnx", "int8_onnx")
_SENSOR_KEYS = ("light", "optics", "full_scale_photoelectrons", "exposure_us")
_REMEDY = "take the file from its source again, or export it again with `pans train` or `pans bundle`"


def bundle_bytes(bundle: Bundle) -> bytes:
    """Return the file of `bundle`; the same bundle always gives the same bytes. UsageError above 64 MiB."""
    automaton = bundle.automaton
    parts = _fixed_parts(bundle) if automaton is None else automaton_file.parts_of(bundle, automaton)
    rows, blobs, offset = [], [], 0
    for name, array in parts:
        blob = array.astype(_ALL_PARTS[name]).tobytes()
        digest = hashlib.sha256(blob).hexdigest()
        rows.append(
            {
                **{"name": name, "dtype": _ALL_PARTS[name], "shape": list(array.shape)},
                **{"offset": offset, "length": len(blob), "sha256": digest},
            }
        )
        blobs.append(blob)
        offset += len(blob)
    header = canonical_json(
        {
            "name": bundle.name,
            "task": bundle.task,
            "encoder": bundle.encoder,
            "classes": list(bundle.classes),
            "image_shape": list(bundle.image_shape),
            "levels": bundle.levels,
            "photons_per_level": bundle.photons_per_level,
            "provenance": bundle.provenance,
            "parts": rows,
            **_new_facts(bundle),
        }
    )
    total = _PROLOGUE.size + len(header) + offset + _DIGEST_BYTES
    if len(header) > HEADER_MAX_BYTES or total > FILE_MAX_BYTES:
        allowed = f"{HEADER_MAX_BYTES} and {FILE_MAX_BYTES}"
        raise UsageError(
            f"this bundle would have a header of {len(header)} and {total} bytes in all, allowed: {allowed}"
        )
    version = _version_of(_new_facts(bundle))
    body = b"".join([_PROLOGUE.pack(MAGIC, version, len(header)), header, *blobs])
    return body + hashlib.sha256(body).digest()


def _fixed_parts(bundle: Bundle) -> list[tuple[str, NDArray[Any]]]:
    parts: list[tuple[str, NDArray[Any]]] = [_optics_part(bundle)]
    if bundle.head_onnx is not None:
        parts.append(("head_onnx", np.frombuffer(bundle.head_onnx, dtype=np.uint8)))
    if bundle.table is not None:
        parts.append(("table", bundle.table))
    parts += [("golden_means", bundle.golden_means), ("golden_scores", bundle.golden_scores)]
    if bundle.int8_head is not None:
        head = bundle.int8_head
        parts += [("int8_sizes", head.sizes), ("int8_weights", head.weights), ("int8_affine", head.affine)]
    if bundle.int8_onnx is not None:
        parts.append(("int8_onnx", np.frombuffer(bundle.int8_onnx, dtype=np.uint8)))
    return parts


def _optics_part(bundle: Bundle) -> tuple[str, NDArray[Any]]:
    if bundle.analyser is None:
        return "pattern_levels", bundle.pattern_levels
    matrix = bundle.analyser.matrix
    return _MATRIX_PARTS["<c8" if np.iscomplexobj(matrix) else "<f4"], matrix


def _new_facts(bundle: Bundle) -> dict[str, Any]:
    """What version 1 cannot say: a passive sensor, a picture instead of classes, an automaton, photon numbers."""
    if bundle.automaton is not None:
        return automaton_file.facts_of(bundle, bundle.automaton)
    facts: dict[str, Any] = {}
    if bundle.analyser is not None:
        facts["sensor"] = {name: getattr(bundle.analyser, name) for name in _SENSOR_KEYS}
    if bundle.picture_shape is not None:
        facts["picture_shape"] = list(bundle.picture_shape)
    if bundle.outcomes > 2:
        facts["outcomes"] = bundle.outcomes
    return facts


def _version_of(facts: Mapping[str, Any]) -> int:
    """The lowest version that can say `facts`, those that version 1 has not."""
    if "automaton" in facts:
        return automaton_file.version_of(facts)
    return 5 if "outcomes" in facts else 2 if facts else 1


def parse_bundle(data: bytes, where: str) -> Bundle:
    """Return the bundle in `data`; DamagedFileError, starting with `where`, for any byte that is not as written."""
    return read_bundle(io.BytesIO(data), len(data), where)[0]


def read_bundle(file: BinaryIO, size: int, where: str) -> tuple[Bundle, str]:
    """Return the bundle in the next `size` bytes of `file` and their SHA-256 as hex; DamagedFileError as `parse_bundle`.

    The bytes are read twice, for the closing checksum and for the parts, and memory holds them once: as the arrays of the bundle.
    """
    source = _Source(file, size)
    try:
        header_end, version, header_bytes = _check_prologue(source)
        digest, closing = source.hashed(size - _DIGEST_BYTES)
        if digest.digest() != closing:
            raise ValueError(_what_changed(source, header_bytes, header_end))
        digest.update(closing)
        header = parse_json_object(header_bytes, "header")
        bundle = _build(header, _read_parts(header, version, source, header_end))
        object.__setattr__(bundle, "sha256", digest.hexdigest())
        return bundle, bundle.sha256
    except DamagedFileError as error:
        raise DamagedFileError(f"{where}: {error.message}", remedy=error.remedy or _REMEDY) from error
    except (ValueError, TypeError, OverflowError) as error:
        raise DamagedFileError(f"{where}: {error}", remedy=_REMEDY) from error


class _Source:
    """The bytes of one bundle in a file; every read is of the length that was asked for, or ValueError."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._start, self.size = file, file.tell(), size

    def read(self, at: int, length: int) -> bytes:
        self._file.seek(self._start + at)
        data = self._file.read(length)
        if len(data) != length:
            raise ValueError("the file became shorter while it was read")
        return data

    def array(self, at: int, length: int, dtype: str) -> NDArray[Any]:
        """Return `length` bytes as an array of its own, (n,) of `dtype`."""
        found = np.empty(length // np.dtype(dtype).itemsize, dtype)
        self._file.seek(self._start + at)
        if self._file.readinto(memoryview(found).cast("B")) != length:  # type: ignore[attr-defined, arg-type]
            raise ValueError("the file became shorter while it was read")
        return found

    def hashed(self, length: int) -> tuple[hashlib._Hash, bytes]:
        """Return the SHA-256 of the first `length` bytes, and what follows them."""
        digest = hashlib.sha256()
        for at in range(0, length, MIB):
            digest.update(self.read(at, min(MIB, length - at)))
        return digest, self.read(length, self.size - length)


def _check_prologue(source: _Source) -> tuple[int, int, bytes]:
    """Check magic, version and sizes; return where the header ends, the version and the header."""
    size = source.size
    demand(size <= FILE_MAX_BYTES, f"{size} bytes, allowed at most {FILE_MAX_BYTES}")
    start = source.read(0, min(size, _PROLOGUE.size))
    if start[: len(MAGIC)] != MAGIC[: len(start)]:
        what, taker = other_kind(source.read(0, min(size, KIND_BYTES)))
        found = f"it is {what}" if what else f"it starts with {start[:8]!a}, expected {MAGIC!a}"
        raise DamagedFileError(f"not a PANS bundle: {found}", remedy=taker)
    smallest = _PROLOGUE.size + 2 + _DIGEST_BYTES
    demand(size >= smallest, f"truncated: {size} bytes, a bundle has at least {smallest}")
    _, version, header_length = _PROLOGUE.unpack_from(start)
    if version not in VERSIONS:
        raise DamagedFileError(
            f"bundle format version {version}, allowed: {', '.join(map(str, VERSIONS))}",
            remedy="install the pans-runtime that wrote it, or export the bundle again with this one",
        )
    demand(header_length <= HEADER_MAX_BYTES, f"a header of {header_length} bytes, allowed at most {HEADER_MAX_BYTES}")
    header_end = _PROLOGUE.size + header_length
    demand(header_end + _DIGEST_BYTES <= size, f"truncated: {size} bytes, the header alone needs {header_end}")
    return header_end, version, source.read(_PROLOGUE.size, header_length)


def _what_changed(source: _Source, header: bytes, header_end: int) -> str:
    """Say as exactly as possible why the closing checksum does not fit; the header is not trusted here, only quoted."""
    size = source.size
    try:
        rows = parse_json_object(header, "header")["parts"]
        wanted = header_end + sum(int(row["length"]) for row in rows) + _DIGEST_BYTES
        if wanted > size:
            return f"truncated: {size} bytes, the header announces {wanted}"
        if wanted < size:
            return f"{size - wanted} bytes too many: {size}, the header announces {wanted}"
        for row in rows:
            part = source.read(header_end + int(row["offset"]), int(row["length"]))
            if hashlib.sha256(part).hexdigest() != row["sha256"]:
                return f"altered: the part {ascii(row['name'])[:40]} does not have its SHA-256"
    except (DamagedFileError, KeyError, TypeError, ValueError, OverflowError):
        pass
    return "altered: the header or the closing SHA-256 is not as written"


def _read_parts(header: Mapping[str, Any], version: int, source: _Source, header_end: int) -> dict[str, Any]:
    """Return the parts by name, after checking that they fill the file without gap, overlap or rest; models are bytes."""
    new_keys = set(header) & _KEYS_OF_VERSION[version]
    if version in _OF_AUTOMATA:
        new_keys |= automaton_file.HEADER_KEYS
    keys = _HEADER_KEYS | new_keys
    demand(set(header) == keys, f"the header has the keys {_quoted(header)}, allowed: {_quoted(keys)}")
    least = _version_of({key: header[key] for key in new_keys})
    demand(version == least, f"a bundle of format version {version} that says no more than {least}")
    known = automaton_file.PARTS if version in _OF_AUTOMATA else _PARTS
    rows = header["parts"]
    demand(isinstance(rows, list) and len(rows) <= len(known), "the header's parts are not a short list")
    parts: dict[str, Any] = {}
    offset, room = 0, source.size - _DIGEST_BYTES - header_end
    for row in rows:
        _check_row(row, known, parts)
        inside = row["offset"] == offset and offset + row["length"] <= room
        demand(inside, f"{row['name']} lies outside the file or over another part")
        parts[row["name"]] = _read_part(row, source, header_end + offset)
        offset += row["length"]
    demand(offset == room, f"{room - offset} bytes after the last part, allowed: none")
    if version not in _OF_AUTOMATA:
        _demand_fixed_parts(header, parts)
    return parts


def _demand_fixed_parts(header: Mapping[str, Any], parts: Mapping[str, NDArray[Any]]) -> None:
    optics = [name for name in ("pattern_levels", *_MATRIX_PARTS.values()) if name in parts]
    passive = "sensor" in header
    demand(len(optics) <= 1, f"the parts {', '.join(optics)}, allowed: one of them")
    if not (passive and optics):
        optics = ["pattern_levels"]
    for name in (*optics, "golden_means", "golden_scores"):
        demand(np.ndim(parts.get(name, 0)) == 2, f"the part {name} is missing or not a matrix")


def _check_row(row: Any, known: Mapping[str, str], before: Mapping[str, Any]) -> None:
    """Check what the header says of one part, of those that are `known`, behind the parts `before`."""
    demand(isinstance(row, dict) and set(row) == _PART_KEYS, f"a part needs the keys {_quoted(_PART_KEYS)}")
    name, shape, length = row["name"], row["shape"], row["length"]
    demand(isinstance(name, str) and name in known, f"unknown part {ascii(name)[:40]}, allowed: {_quoted(known)}")
    demand(name not in before, f"the part {name} stands twice")
    demand(row["dtype"] == known[name], f"{name} has dtype {ascii(row['dtype'])[:40]}, allowed: {known[name]}")
    good_shape = isinstance(shape, list) and len(shape) in (1, 2) and all(_is_count(n) for n in shape)
    demand(good_shape and _is_count(length), f"{name} has shape {ascii(shape)[:80]}, allowed: one or two sizes")
    wanted = math.prod(shape) * np.dtype(known[name]).itemsize
    demand(length == wanted, f"{name} has {length} bytes, its shape {shape} needs {wanted}")


def _read_part(row: Mapping[str, Any], source: _Source, at: int) -> NDArray[Any] | bytes:
    """Return one part, after its SHA-256 was checked."""
    name, dtype = row["name"], row["dtype"]
    found: NDArray[Any] | bytes
    found = source.read(at, row["length"]) if name in _MODELS else source.array(at, row["length"], dtype)
    digest = hashlib.sha256(found if isinstance(found, bytes) else found.data).hexdigest()
    demand(digest == row["sha256"], f"the part {name} does not have its SHA-256")
    if isinstance(found, bytes):
        return found
    return frozen(found.reshape(row["shape"]).astype(np.dtype(dtype).newbyteorder("="), copy=False))


def _build(header: Mapping[str, Any], parts: Mapping[str, Any]) -> Bundle:
    shape, classes, scale = header["image_shape"], header["classes"], header["photons_per_level"]
    good_shape = isinstance(shape, list) and len(shape) == 2 and all(_is_count(n) for n in shape)
    demand(good_shape, f"image_shape is {ascii(shape)[:80]}, allowed: [height, width]")
    passive = "sensor" in header
    levels = header["levels"]
    levels_fit = _is_count(levels) or (passive and levels == 0 and not isinstance(levels, bool))
    demand(levels_fit, f"levels is {ascii(header['levels'])[:80]}, allowed: 2 to {LEVELS_MAX}")
    good_scale = isinstance(scale, int | float) and not isinstance(scale, bool)
    demand(good_scale, f"photons_per_level is {ascii(scale)[:80]}, allowed: finite and above 0")
    demand(isinstance(classes, list), f"classes is {ascii(classes)[:80]}, allowed: a list of names")
    demand(isinstance(header["provenance"], dict), "provenance is not an object")
    facts: dict[str, Any] = {
        "name": header["name"],
        "task": header["task"],
        "classes": tuple(classes),
        "encoder": header["encoder"],
        "image_shape": (shape[0], shape[1]),
        "levels": header["levels"],
        "photons_per_level": float(scale),
        "provenance": header["provenance"],
    }
    make = _with_automaton if "automaton" in header else _with_back_end
    bundle = make(header, parts, facts)
    check_bundle(bundle)
    return bundle


def _with_automaton(header: Mapping[str, Any], parts: Mapping[str, NDArray[Any]], facts: dict[str, Any]) -> Bundle:
    automaton_file.demand_parts(parts, header["levels"])
    n_pixels = math.prod(facts["image_shape"])
    automaton = automaton_file.automaton_of(header, parts)
    golden = automaton_file.golden_of(parts, automaton)
    return Bundle(
        **facts,
        head_onnx=None,
        table=None,
        pattern_levels=automaton_file.patterns_of(parts, header["levels"], n_pixels),
        golden_means=golden.means,
        golden_scores=golden.scores,
        automaton=automaton,
        golden_walks=golden.walks,
        expected=automaton_file.expected_of(header),
    )


def _with_back_end(header: Mapping[str, Any], parts: Mapping[str, Any], facts: dict[str, Any]) -> Bundle:
    outcomes = _OUTCOMES.checked(header["outcomes"], "outcomes") if "outcomes" in header else 2
    picture = header.get("picture_shape")
    good_picture = isinstance(picture, list) and len(picture) == 2 and all(_is_count(n) for n in picture)
    demand(picture is None or good_picture, f"picture_shape is {ascii(picture)[:80]}, allowed: [height, width]")
    analyser = _analyser(header, parts) if "sensor" in header else None
    patterns = parts["pattern_levels"] if analyser is None else frozen(np.zeros((len(analyser.matrix), 0), np.uint16))
    return Bundle(
        **facts,
        pattern_levels=patterns,
        head_onnx=parts.get("head_onnx"),
        table=parts.get("table"),
        golden_means=parts["golden_means"],
        golden_scores=parts["golden_scores"],
        int8_head=_int8_head(parts),
        int8_onnx=parts.get("int8_onnx"),
        analyser=analyser,
        picture_shape=None if picture is None else (picture[0], picture[1]),
        outcomes=outcomes,
    )


def _analyser(header: Mapping[str, Any], parts: Mapping[str, NDArray[Any]]) -> Analyser:
    facts = header["sensor"]
    demand(
        isinstance(facts, dict) and set(facts) == set(_SENSOR_KEYS),
        f"sensor is {ascii(facts)[:80]}, needed are the keys {', '.join(_SENSOR_KEYS)}",
    )
    matrix = next((parts[name] for name in _MATRIX_PARTS.values() if name in parts), None)
    if matrix is None:
        raise ValueError(f"a passive sensor without its matrix, needed: {' or '.join(_MATRIX_PARTS.values())}")
    numbers = {}
    for name in ("full_scale_photoelectrons", "exposure_us"):
        value = facts[name]
        good = isinstance(value, int | float) and not isinstance(value, bool)
        demand(good, f"sensor.{name} is {ascii(value)[:80]}, allowed: finite and above 0")
        numbers[name] = float(value)
    return Analyser(header["encoder"], matrix, facts["light"], facts["optics"], **numbers)


def _int8_head(parts: Mapping[str, NDArray[Any]]) -> Int8Head | None:
    found = [parts[name] for name in _INT8_PARTS if name in parts]
    demand(len(found) in (0, 3), f"an int8 head needs the parts {', '.join(_INT8_PARTS)}, all of them")
    if not found:
        return None
    sizes, weights, affine = found
    demand((sizes.ndim, weights.ndim, affine.ndim) == (1, 1, 2), "the parts of the int8 head have wrong shapes")
    return Int8Head(frozen(sizes.astype(np.int64)), weights, affine)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= FILE_MAX_BYTES


def _quoted(names: Mapping[str, Any] | set[str]) -> str:
    return ascii(", ".join(sorted(str(name) for name in names))[:200])
