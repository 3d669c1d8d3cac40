"""A bundle in, its bytes out, and back: docs/reference/formats.md in code.

`parse_bundle` raises DamagedFileError for any byte that is not as it was written, and names the part that changed. The container is our
own, not zip: zip leaves bytes that no checksum covers. A part that unpacks to more than memory should hold is refused before.
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

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import FILE_MAX_BYTES, KIND_BYTES, MIB, canonical_json, other_kind, parse_json_object
from pans.base.numbers import Range, demand
from pans.bundle.automaton import CHANNELS_MAX, COUNT_OUTCOMES, Automaton, log_scores
from pans.bundle.heads.layers import Int8Head

from .analyser import Analyser
from .facts import GOLDEN_MAX, GOLDEN_MEANS_MAX, LEVELS_MAX, Bundle, check_bundle, check_pattern_cells, frozen

MAGIC = b"PANSBNDL"
VERSION = 1
HEADER_MAX_BYTES = MIB
_PROLOGUE = struct.Struct("<8sII")
_DIGEST_BYTES = 32
_KEYS = {"name", "task", "encoder", "classes", "image_shape", "levels", "photons_per_level", "provenance", "parts"}
# keys that some have besides
_FIXED_KEYS, _AUTOMATON_KEYS = {"sensor", "picture_shape", "outcomes"}, {"automaton", "expected"}
_PART_KEYS = {"name", "dtype", "shape", "offset", "length", "sha256"}
_PARTS = {  # dtype and axes
    **{"pattern_levels": ("<u2", 2), "pattern_bits": ("|u1", 2), "pattern_bytes": ("|u1", 2)},
    **{"matrix": ("<f4", 2), "matrix_complex": ("<c8", 2)},
    **{"head_onnx": ("|u1", 1), "table": ("<f4", 2), "golden_means": ("<f4", 2), "golden_scores": ("<f4", 2)},
    **{"int8_sizes": ("<u4", 1), "int8_weights": ("|i1", 1), "int8_affine": ("<f4", 2), "int8_onnx": ("|u1", 1)},
    **{"state_pattern": ("<u2", 1), "state_dwell": ("<u2", 1), "successors": ("<u4", 2), "posteriors": ("<f4", 2)},
    **{"golden_words": ("|u1", 2), "golden_walks": ("<u4", 2), "golden_posteriors": ("<f4", 2)},
}
_MODELS = ("head_onnx", "int8_onnx")
_INT8 = ("int8_sizes", "int8_weights", "int8_affine")  # all or none
_OF_AUTOMATON = tuple(_PARTS)[-7:]
_SENSOR_KEYS = ("light", "optics", "full_scale_photoelectrons", "exposure_us")
_OUTCOMES = Range(*COUNT_OUTCOMES, whole=True)
_ROWS_AT_ONCE = 1024
_REMEDY = "take the file from its source again, or export it again with `pans train` or `pans bundle`"


def bundle_bytes(bundle: Bundle) -> bytes:
    """Return the file of `bundle`; the same bundle always gives the same bytes. UsageError above 64 MiB."""
    rows, blobs, offset = [], [], 0
    parts = _fixed_parts(bundle) if bundle.automaton is None else _walk_parts(bundle, bundle.automaton)
    for name, array in parts.items():
        dtype, blob = _PARTS[name][0], array.astype(_PARTS[name][0]).tobytes()
        row = {"name": name, "dtype": dtype, "shape": list(array.shape), "offset": offset, "length": len(blob)}
        rows.append(row | {"sha256": hashlib.sha256(blob).hexdigest()})
        blobs.append(blob)
        offset += len(blob)
    facts = {name: getattr(bundle, name) for name in sorted(_KEYS - {"parts"})} | {"parts": rows}
    header = canonical_json(facts | _more_facts(bundle))
    total = _PROLOGUE.size + len(header) + offset + _DIGEST_BYTES
    if len(header) > HEADER_MAX_BYTES or total > FILE_MAX_BYTES:
        found = f"a header of {len(header)} and {total} bytes in all"
        raise UsageError(f"this bundle would have {found}, allowed: {HEADER_MAX_BYTES} and {FILE_MAX_BYTES}")
    body = b"".join([_PROLOGUE.pack(MAGIC, VERSION, len(header)), header, *blobs])
    return body + hashlib.sha256(body).digest()


def _more_facts(bundle: Bundle) -> dict[str, Any]:
    """The header's keys that only some bundles have."""
    automaton = bundle.automaton
    if automaton is not None:
        more = {"outcomes": automaton.n_outcomes} if automaton.counts else {}
        more |= {"channels": automaton.channels} if automaton.channels > 1 else {}
        expected = {} if bundle.expected is None else {"expected": dict(bundle.expected)}
        return {"automaton": {"dwell_steps": automaton.dwell_steps, **more}, **expected}
    analyser, picture = bundle.analyser, bundle.picture_shape
    sensor = {} if analyser is None else {"sensor": {name: getattr(analyser, name) for name in _SENSOR_KEYS}}
    shape = {} if picture is None else {"picture_shape": list(picture)}
    return sensor | shape | ({"outcomes": bundle.outcomes} if bundle.outcomes > 2 else {})


def _fixed_parts(bundle: Bundle) -> dict[str, NDArray[Any]]:
    """The parts of a bundle of fixed patterns or passive optics, in the file's order."""
    matrix, head = None if bundle.analyser is None else bundle.analyser.matrix, bundle.int8_head
    int8 = (None, None, None) if head is None else (head.sizes, head.weights, head.affine)
    parts = {
        _optics_part(matrix): bundle.pattern_levels if matrix is None else matrix,
        **{"head_onnx": _bytes_of(bundle.head_onnx), "table": bundle.table},
        **{"golden_means": bundle.golden_means, "golden_scores": bundle.golden_scores},
        **dict(zip(_INT8, int8)),
        "int8_onnx": _bytes_of(bundle.int8_onnx),
    }
    return {name: array for name, array in parts.items() if array is not None}


def _bytes_of(model: bytes | None) -> NDArray[np.uint8] | None:
    return None if model is None else np.frombuffer(model, np.uint8)


def _optics_part(matrix: NDArray[Any] | None) -> str:
    return "pattern_levels" if matrix is None else "matrix_complex" if np.iscomplexobj(matrix) else "matrix"


def _pattern_part(levels: int) -> str:
    """The part that holds an automaton's patterns: single bits, bytes, or two bytes per pixel."""
    return "pattern_bits" if levels == 2 else "pattern_bytes" if levels <= 256 else "pattern_levels"


def _walk_parts(bundle: Bundle, automaton: Automaton) -> dict[str, NDArray[Any]]:
    """The parts of a bundle with an automaton, in the file's order."""
    name, patterns, words = _pattern_part(bundle.levels), bundle.pattern_levels, bundle.golden_means
    walks = np.zeros((0, 0), np.uint32) if bundle.golden_walks is None else bundle.golden_walks
    return {
        name: _packed(patterns) if name == "pattern_bits" else patterns,
        **{"state_pattern": automaton.pattern, "state_dwell": automaton.dwell},
        **{"successors": automaton.successors, "posteriors": automaton.posteriors},
        "golden_words": words.astype(np.uint8) if automaton.counts else _packed(words),
        **{"golden_walks": walks, "golden_posteriors": automaton.posteriors[walks[:, -1]]},
    }


def _packed(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Zeros and ones (n, k) as bits: number j is bit j % 8 of byte j // 8."""
    return np.packbits(values.astype(np.bool_), axis=1, bitorder="little")


def parse_bundle(data: bytes, where: str) -> Bundle:
    """Return the bundle in `data`; DamagedFileError, starting with `where`, for any byte that is not as written."""
    return read_bundle(io.BytesIO(data), len(data), where)[0]


def read_bundle(file: BinaryIO, size: int, where: str) -> tuple[Bundle, str]:
    """Return the bundle in the next `size` bytes of `file` and their SHA-256 as hex; DamagedFileError as `parse_bundle`.

    The bytes are read twice, for the closing checksum and for the parts, and memory holds them once: as the arrays of the bundle.
    """
    source = _Source(file, size)
    try:
        header_end, header_bytes = _check_prologue(source)
        digest, closing = source.hashed(size - _DIGEST_BYTES)
        if digest.digest() != closing:
            raise ValueError(_what_changed(source, header_bytes, header_end))
        digest.update(closing)
        header = parse_json_object(header_bytes, "header")
        bundle = _build(header, _read_parts(header, source, header_end))
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

    def array(self, at: int, length: int, dtype: str) -> NDArray[Any]:
        """Return `length` bytes as an array of its own, (n,) of `dtype`."""
        found = np.empty(length // np.dtype(dtype).itemsize, dtype)
        self._file.seek(self._start + at)
        if self._file.readinto(memoryview(found).cast("B")) != length:  # type: ignore[attr-defined, arg-type]
            raise ValueError("the file became shorter while it was read")
        return found

    def read(self, at: int, length: int) -> bytes:
        return self.array(at, length, "|u1").tobytes()

    def hashed(self, length: int) -> tuple[hashlib._Hash, bytes]:
        """Return the SHA-256 of the first `length` bytes, and what follows them."""
        digest = hashlib.sha256()
        for at in range(0, length, MIB):
            digest.update(self.array(at, min(MIB, length - at), "|u1").data)
        return digest, self.read(length, self.size - length)


def _check_prologue(source: _Source) -> tuple[int, bytes]:
    """Check magic, version and sizes; return where the header ends, and the header."""
    size = source.size
    demand(size <= FILE_MAX_BYTES, f"{size} bytes, allowed at most {FILE_MAX_BYTES}")
    start = source.read(0, min(size, _PROLOGUE.size))
    if start[: len(MAGIC)] != MAGIC[: len(start)]:
        what, remedy = other_kind(source.read(0, min(size, KIND_BYTES)))
        found = f"it is {what}" if what else f"it starts with the bytes {start[:8].hex(' ')}, expected {MAGIC.decode()}"
        raise DamagedFileError(f"not a PANS bundle: {found}", remedy=remedy)
    smallest = _PROLOGUE.size + 2 + _DIGEST_BYTES
    demand(size >= smallest, f"truncated: {size} bytes, a bundle has at least {smallest}")
    _, version, header_length = _PROLOGUE.unpack_from(start)
    if version != VERSION:
        remedy = "install the pans-runtime that wrote it, or export the bundle again with this one"
        raise DamagedFileError(f"bundle format version {version}, allowed: {VERSION}", remedy=remedy)
    demand(header_length <= HEADER_MAX_BYTES, f"a header of {header_length} bytes, allowed at most {HEADER_MAX_BYTES}")
    header_end = _PROLOGUE.size + header_length
    demand(header_end + _DIGEST_BYTES <= size, f"truncated: {size} bytes, the header alone needs {header_end}")
    return header_end, source.read(_PROLOGUE.size, header_length)


def _what_changed(source: _Source, header: bytes, header_end: int) -> str:
    """Say as exactly as possible why the closing checksum does not fit; the header is not trusted here, only quoted."""
    size = source.size
    try:
        rows = parse_json_object(header, "header")["parts"]
        wanted = header_end + sum(int(row["length"]) for row in rows) + _DIGEST_BYTES
        if wanted != size:
            kind = "truncated" if wanted > size else f"{size - wanted} bytes too many"
            return f"{kind}: {size} bytes, the header announces {wanted}"
        for row in rows:
            part = source.read(header_end + int(row["offset"]), int(row["length"]))
            if hashlib.sha256(part).hexdigest() != row["sha256"]:
                return f"altered: the part {ascii(row['name'])[:40]} does not have its SHA-256"
    except (DamagedFileError, KeyError, TypeError, ValueError, OverflowError):
        pass
    return "altered: the header or the closing SHA-256 is not as written"


def _read_parts(header: Mapping[str, Any], source: _Source, header_end: int) -> dict[str, Any]:
    """Return the parts by name, after checking that they fill the file without gap, overlap or rest; models are bytes."""
    keys = _KEYS | set(header) & (_AUTOMATON_KEYS if "automaton" in header else _FIXED_KEYS)
    demand(set(header) == keys, f"the header has the keys {_quoted(header)}, allowed: {_quoted(keys)}")
    rows = header["parts"]
    demand(isinstance(rows, list) and len(rows) <= len(_PARTS), "the header's parts are not a short list")
    parts: dict[str, Any] = {}
    offset, room = 0, source.size - _DIGEST_BYTES - header_end
    for row in rows:
        _check_row(row, parts)
        inside = row["offset"] == offset and offset + row["length"] <= room
        demand(inside, f"{row['name']} lies outside the file or over another part")
        parts[row["name"]] = _read_part(row, source, header_end + offset)
        offset += row["length"]
    demand(offset == room, f"{room - offset} bytes after the last part, allowed: none")
    levels = header["levels"]
    if "automaton" in header:
        needed, more = {_pattern_part(levels if _is_count(levels) else 2), *_OF_AUTOMATON}, set[str]()
    else:
        matrix = "matrix_complex" if "matrix_complex" in parts else "matrix"
        optics = matrix if "sensor" in header else "pattern_levels"
        needed, more = {optics, "golden_means", "golden_scores"}, {*_MODELS, *_INT8, "table"}
    whole = needed <= set(parts) <= needed | more
    demand(whole, f"the parts {_quoted(parts)}, needed: {_quoted(needed)}, allowed besides: {_quoted(more)}")
    return parts


def _check_row(row: Any, before: Mapping[str, Any]) -> None:
    """Check what the header says of one part behind the parts `before`."""
    demand(isinstance(row, dict) and set(row) == _PART_KEYS, f"a part needs the keys {_quoted(_PART_KEYS)}")
    name, shape, length = row["name"], row["shape"], row["length"]
    demand(isinstance(name, str) and name in _PARTS, f"unknown part {ascii(name)[:40]}, allowed: {_quoted(_PARTS)}")
    dtype, axes = _PARTS[name]
    demand(name not in before, f"the part {name} stands twice")
    demand(row["dtype"] == dtype, f"{name} has dtype {ascii(row['dtype'])[:40]}, allowed: {dtype}")
    good_shape = isinstance(shape, list) and len(shape) == axes and all(_is_count(n) for n in shape)
    demand(good_shape and _is_count(length), f"{name} has shape {ascii(shape)[:80]}, allowed: {axes} sizes above 0")
    wanted = math.prod(shape) * np.dtype(dtype).itemsize
    demand(length == wanted, f"{name} has {length} bytes, its shape {shape} needs {wanted}")


def _read_part(row: Mapping[str, Any], source: _Source, at: int) -> NDArray[Any] | bytes:
    """Return one part, after its SHA-256 was checked."""
    found = source.array(at, row["length"], row["dtype"])
    same = hashlib.sha256(found.data).hexdigest() == row["sha256"]
    demand(same, f"the part {row['name']} does not have its SHA-256")
    if row["name"] in _MODELS:
        return found.tobytes()
    return frozen(found.reshape(row["shape"]).astype(found.dtype.newbyteorder("="), copy=False))


def _build(header: Mapping[str, Any], parts: Mapping[str, Any]) -> Bundle:
    classes, scale, levels = header["classes"], header["photons_per_level"], header["levels"]
    levels_fit = _is_count(levels) or ("sensor" in header and levels == 0 and not isinstance(levels, bool))
    demand(levels_fit, f"levels is {ascii(levels)[:80]}, allowed: 2 to {LEVELS_MAX}")
    demand(isinstance(classes, list), f"classes is {ascii(classes)[:80]}, allowed: a list of names")
    demand(isinstance(header["provenance"], dict), "provenance is not an object")
    shape = _size_of(header, "image_shape")
    facts = {name: header[name] for name in ("name", "task", "encoder", "levels", "provenance")}
    facts |= {"classes": tuple(classes), "image_shape": shape, "photons_per_level": _real(scale, "photons_per_level")}
    make = _with_automaton if "automaton" in header else _with_back_end
    bundle = Bundle(**facts, **make(header, parts, math.prod(shape)))
    check_bundle(bundle)
    return bundle


def _with_back_end(header: Mapping[str, Any], parts: Mapping[str, Any], n_pixels: int) -> dict[str, Any]:
    analyser = _analyser(header, parts) if "sensor" in header else None
    none = frozen(np.zeros((0 if analyser is None else len(analyser.matrix), 0), np.uint16))
    int8 = [parts[name] for name in _INT8 if name in parts]
    demand(len(int8) in (0, 3), f"an int8 head needs the parts {', '.join(_INT8)}, all of them")
    same = ("head_onnx", "table", "golden_means", "golden_scores", "int8_onnx")
    return {
        **{name: parts.get(name) for name in same},
        "pattern_levels": parts["pattern_levels"] if analyser is None else none,
        "int8_head": Int8Head(frozen(int8[0].astype(np.int64)), *int8[1:]) if int8 else None,
        "analyser": analyser,
        "picture_shape": _size_of(header, "picture_shape") if "picture_shape" in header else None,
        "outcomes": _OUTCOMES.checked(header["outcomes"], "outcomes") if "outcomes" in header else 2,
    }


def _analyser(header: Mapping[str, Any], parts: Mapping[str, NDArray[Any]]) -> Analyser:
    facts = header["sensor"]
    known = isinstance(facts, dict) and set(facts) == set(_SENSOR_KEYS)
    demand(known, f"sensor is {ascii(facts)[:80]}, needed are the keys {', '.join(_SENSOR_KEYS)}")
    numbers = (_real(facts[name], f"sensor.{name}") for name in _SENSOR_KEYS[2:])
    matrix = parts["matrix_complex" if "matrix_complex" in parts else "matrix"]
    return Analyser(header["encoder"], matrix, facts["light"], facts["optics"], *numbers)


def _with_automaton(header: Mapping[str, Any], parts: Mapping[str, NDArray[Any]], n_pixels: int) -> dict[str, Any]:
    automaton, name = _automaton(header["automaton"], parts), _pattern_part(header["levels"])
    expected = header.get("expected")
    fits = ("expected" in header) == isinstance(expected, dict)
    demand(fits, f"expected is {ascii(expected)[:80]}, allowed: an object")
    check_pattern_cells(len(parts[name]), n_pixels)
    patterns = parts[name] if name != "pattern_bits" else _unpacked(parts[name], n_pixels, name, np.dtype(np.uint16))
    row = patterns.shape[1]
    demand(row == n_pixels, f"{name} has rows of {row}, patterns of {n_pixels} pixels need {n_pixels}")
    return {
        **{"head_onnx": None, "table": None, "automaton": automaton, "expected": expected},
        "pattern_levels": frozen(patterns.astype(np.uint16, copy=False)),
        **_golden_walks(parts, automaton),
    }


def _automaton(facts: Any, parts: Mapping[str, NDArray[Any]]) -> Automaton:
    """The automaton; its outcomes are those of clicks, unless the header says `outcomes` (photon numbers) or `channels`."""
    columns = parts["successors"].shape[1]
    key = next((key for key in ("outcomes", "channels") if isinstance(facts, dict) and key in facts), "")
    known = isinstance(facts, dict) and set(facts) == {"dwell_steps", *filter(None, [key])}
    demand(known, f"automaton is {ascii(facts)[:80]}, allowed: dwell_steps and perhaps outcomes or channels")
    value = facts.get(key, 1)
    whole = isinstance(value, int) and not isinstance(value, bool) and (key != "channels" or 2 <= value <= CHANNELS_MAX)
    wanted = value if key == "outcomes" else 1 << value if whole else 0
    found = f"automaton.{key or 'channels'} is {ascii(value)[:80]}"
    demand(columns == wanted and whole, f"{found}, successors has {columns} columns")
    states = (parts["state_pattern"], parts["state_dwell"], facts["dwell_steps"])
    return Automaton(*states, parts["successors"], parts["posteriors"], key == "outcomes")


def _golden_walks(parts: Mapping[str, NDArray[Any]], automaton: Automaton) -> dict[str, NDArray[Any]]:
    """The golden walks; ValueError unless each leaf's posterior is, bit for bit, the automaton's."""
    stored, walks, posteriors = (parts[name] for name in _OF_AUTOMATON[4:])
    n_bits, rows = automaton.n_bits, len(stored)
    demand(1 <= rows <= GOLDEN_MAX, f"{rows} golden walks, allowed: 1 to {GOLDEN_MAX}")
    demand(rows * n_bits <= GOLDEN_MEANS_MAX, f"{rows} golden words of {n_bits}, allowed: {GOLDEN_MEANS_MAX} in all")
    wanted = (rows, automaton.n_slots + 1)
    demand(walks.shape == wanted, f"golden_walks has shape {walks.shape}, allowed: {wanted}")
    leaves, low, high = walks[:, -1], automaton.n_states, len(automaton.posteriors)
    ends = bool((leaves >= low).all() and (leaves < high).all())
    demand(ends, f"a golden walk ends at a node outside {low} to {high - 1}, where the leaves are")
    same = posteriors.shape == (rows, automaton.n_classes) and np.array_equal(posteriors, automaton.posteriors[leaves])
    demand(same, "the golden posteriors are not those of the leaves")
    words = stored if automaton.counts else _unpacked(stored, n_bits, "golden_words", np.dtype(np.float32))
    demand(words.shape[1] == n_bits, f"golden_words has rows of {words.shape[1]}, a walk has {n_bits} outcomes")
    scores = frozen(log_scores(posteriors))
    return {"golden_means": frozen(words.astype(np.float32)), "golden_scores": scores, "golden_walks": walks}


def _unpacked(stored: NDArray[np.uint8], count: int, name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
    width, spare = stored.shape[1], -count % 8
    demand(width == -(-count // 8), f"{name} has rows of {width} bytes, {count} bits need {-(-count // 8)}")
    clean = not spare or not bool((stored[:, -1] >> np.uint8(8 - spare)).any())
    demand(clean, f"{name} has bits behind the last of {count}, allowed: zero")
    out = np.empty((len(stored), count), dtype)
    for start in range(0, len(stored), _ROWS_AT_ONCE):  # one byte per bit for a while: never for all
        part = stored[start : start + _ROWS_AT_ONCE]
        out[start : start + _ROWS_AT_ONCE] = np.unpackbits(part, axis=1, count=count, bitorder="little")
    return out


def _size_of(header: Mapping[str, Any], name: str) -> tuple[int, int]:
    shape = header[name]
    good = isinstance(shape, list) and len(shape) == 2 and all(_is_count(n) for n in shape)
    demand(good, f"{name} is {ascii(shape)[:80]}, allowed: [height, width]")
    return shape[0], shape[1]


def _real(value: Any, name: str) -> float:
    good = isinstance(value, int | float) and not isinstance(value, bool)
    demand(good, f"{name} is {ascii(value)[:80]}, allowed: finite and above 0")
    return float(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= FILE_MAX_BYTES


def _quoted(names: Mapping[str, Any] | set[str]) -> str:
    return ascii(", ".join(sorted(str(name) for name in names))[:200])
