"""The trained artifact in one file: quantised patterns, a back end (table, ONNX head or both), golden vectors, provenance.

Owns the file format (docs/FORMATS.md), its limits and its consistency checks; never shows a pattern and never decides.
A read either returns a `Bundle` whose every byte is covered by a checksum and whose table answers the golden vectors,
or raises DamagedFileError. The container is our own, not zip: zip leaves bytes that no checksum covers.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .container import FILE_MAX_BYTES, MIB, canonical_json, parse_json_object, read_file, replace_file
from .errors import DamagedFileError, UsageError
from .head import HEAD_MAX_BYTES, OnnxHead, open_head

MAGIC = b"PANSBNDL"
FORMAT_VERSION = 1
ENCODERS = ("active",)
HEADER_MAX_BYTES = MIB
FEATURES_MAX = 4096
PIXELS_MAX = 1 << 22
LEVELS_MAX = 65536
CLASSES_MAX = 65534  # a label is a u16, and 0xFFFF means "abstained"
TEXT_MAX_CHARACTERS = 200
TABLE_FEATURES_MAX = 20  # beyond it a table is larger than a file may be
TABLE_BUILD_FEATURES_MAX = 12
GOLDEN_MAX = 4096
GOLDEN_TOLERANCE = 1e-5  # of a score, times max(1, |score|)

_PROLOGUE = struct.Struct("<8sII")
_DIGEST_BYTES = 32
_HEADER_KEYS = {
    *("name", "task", "encoder", "classes", "image_shape", "levels", "photons_per_level", "provenance", "parts"),
}
_PART_KEYS = {"name", "dtype", "shape", "offset", "length", "sha256"}
_PARTS = {"pattern_levels": "<u2", "head_onnx": "|u1", "table": "<f4", "golden_means": "<f4", "golden_scores": "<f4"}
_REMEDY = "take the file from its source again, or export it again with `pans train` or `pans bundle`"


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """What a run needs to know of a trained sensor; its arrays are read-only. `make_bundle` makes one."""

    name: str
    task: str
    classes: tuple[str, ...]
    encoder: str
    image_shape: tuple[int, int]
    levels: int
    pattern_levels: NDArray[np.uint16]  # (d_f, pixels), each below `levels`
    photons_per_level: float  # photoelectrons per exposure, per level, per unit transmission
    head_onnx: bytes | None  # float32 (n, d_f) click means in [0, 1] -> float32 (n, classes) scores
    table: NDArray[np.float32] | None  # (2**d_f, classes); bit i of the row index is the click of pattern i
    golden_means: NDArray[np.float32]  # (g, d_f)
    golden_scores: NDArray[np.float32]  # (g, classes)
    provenance: Mapping[str, Any]

    @property
    def n_features(self) -> int:
        """Number of patterns, d_f."""
        return int(self.pattern_levels.shape[0])

    @property
    def n_pixels(self) -> int:
        """Number of pixels of one pattern."""
        return int(self.pattern_levels.shape[1])

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return len(self.classes)

    def patterns(self) -> NDArray[np.float64]:
        """Return the patterns (d_f, pixels), float64, in photoelectrons per exposure per unit transmission."""
        return self.pattern_levels.astype(np.float64) * self.photons_per_level

    def illumination(self) -> float:
        """Return the sum of all pattern intensities of one shot, in photoelectrons per unit transmission."""
        return int(self.pattern_levels.sum(dtype=np.uint64)) * self.photons_per_level


def make_bundle(
    *,
    name: str,
    task: str,
    classes: Sequence[str],
    image_shape: tuple[int, int],
    levels: int,
    pattern_levels: ArrayLike,
    photons_per_level: float,
    head_onnx: bytes | None = None,
    table: ArrayLike | None = None,
    provenance: Mapping[str, Any],
    encoder: str = "active",
) -> Bundle:
    """Return a checked bundle with golden vectors, and with a table made from the head where d_f <= 12.

    `pattern_levels` is (d_f, pixels) of any integer dtype, `table` (2**d_f, classes) floats; one of head and table must
    be given, and where both are they must agree. UsageError says what does not fit, DamagedFileError what is wrong
    with the head.
    """
    try:
        quantised = _as_levels(pattern_levels, levels)
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes inf, and is refused below
            given = None if table is None else np.array(table, dtype=np.float32)
        means, scores, given = _evaluate_back_end(head_onnx, given, len(quantised), len(classes))
        bundle = Bundle(
            name=name,
            task=task,
            classes=tuple(classes),
            encoder=encoder,
            image_shape=(int(image_shape[0]), int(image_shape[1])),
            levels=int(levels),
            pattern_levels=_frozen(quantised),
            photons_per_level=float(photons_per_level),
            head_onnx=None if head_onnx is None else bytes(head_onnx),
            table=None if given is None else _frozen(given),
            golden_means=_frozen(means),
            golden_scores=_frozen(scores),
            provenance=parse_json_object(canonical_json(dict(provenance)), "provenance"),
        )
        _check(bundle)
    except (ValueError, TypeError) as error:
        raise UsageError(f"this bundle cannot be made: {error}") from error
    return bundle


def word_means(words: ArrayLike, n_features: int) -> NDArray[np.float32]:
    """Return click words (n,) as the head's input (n, d_f), float32: bit i becomes feature i; d_f <= 63."""
    bits = np.asarray(words, dtype=np.int64)[:, None] >> np.arange(n_features, dtype=np.int64)
    return (bits & 1).astype(np.float32)


def golden_violation(found: NDArray[np.float32], golden: NDArray[np.float32]) -> str:
    """Return what differs between scores (g, classes) and the golden ones, or "" if nothing does.

    Scores agree within 1e-5 * max(1, |score|), and the decision is the same wherever the golden margin exceeds that.
    """
    if found.shape != golden.shape:
        return f"scores of shape {found.shape}, expected {golden.shape}"
    wanted = golden.astype(np.float64)
    scale = np.maximum(1.0, np.abs(wanted))
    error = np.abs(found.astype(np.float64) - wanted) / scale
    if not np.all(error <= GOLDEN_TOLERANCE):  # a NaN fails too
        row = int(np.argmax(np.where(np.isfinite(error), error, np.inf).max(axis=1)))
        worst = float(error[row].max())
        return f"the scores of vector {row} are off by {worst:.3g} of max(1, |score|), allowed {GOLDEN_TOLERANCE:g}"
    ranked = np.sort(wanted, axis=1)
    clear = ranked[:, -1] - ranked[:, -2] > GOLDEN_TOLERANCE * scale.max(axis=1)
    differs = clear & (found.argmax(axis=1) != golden.argmax(axis=1))
    if differs.any():
        row = int(np.argmax(differs))
        return f"the decision for vector {row} is {int(found[row].argmax())}, expected {int(golden[row].argmax())}"
    return ""


def _as_levels(pattern_levels: ArrayLike, levels: int) -> NDArray[np.uint16]:
    values = np.asarray(pattern_levels)
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.integer) or values.size == 0:
        raise ValueError(
            f"pattern_levels has shape {values.shape} and dtype {values.dtype}, allowed: integers (d_f, pixels)"
        )
    low, high = int(values.min()), int(values.max())
    if low < 0 or high >= min(levels, LEVELS_MAX):
        raise ValueError(f"pattern_levels run from {low} to {high}, allowed: 0 to {levels - 1}")
    return values.astype(np.uint16)


def _evaluate_back_end(
    head_onnx: bytes | None, table: NDArray[np.float32] | None, n_features: int, n_classes: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32] | None]:
    """Return (golden means, golden scores, table or None); the head answers where there is one, else the table."""
    if table is not None:
        _check_table_shape(table.shape, n_features, n_classes)
    if head_onnx is None:
        if table is None:
            raise ValueError("neither a head nor a table was given, allowed: either or both")
        means = _golden_words(n_features)
        return means, table[_row_index(means)], table
    head = open_head(head_onnx, n_features, n_classes, "head")
    means = np.concatenate([_golden_words(n_features), _golden_shots(n_features)])
    if table is None and n_features <= TABLE_BUILD_FEATURES_MAX:
        table = head.scores(word_means(np.arange(1 << n_features), n_features))
    elif table is not None:
        _demand_agreement(head, table, n_features)
    return means, head.scores(means), table


def _demand_agreement(head: OnnxHead, table: NDArray[np.float32], n_features: int) -> None:
    difference = golden_violation(table, head.scores(word_means(np.arange(1 << n_features), n_features)))
    if difference:
        raise ValueError(f"head and table disagree: {difference} (vector = click word; found = table, expected = head)")


def _golden_words(n_features: int) -> NDArray[np.float32]:
    """No click, all clicks, single clicks (at most 64, evenly spread), 64 random words with a fixed seed."""
    singles = np.unique(np.linspace(0, n_features - 1, min(n_features, 64)).round().astype(np.int64))
    rows = np.zeros((2 + len(singles) + 64, n_features), dtype=np.float32)
    rows[1] = 1.0
    rows[2 + np.arange(len(singles)), singles] = 1.0
    rows[2 + len(singles) :] = np.random.default_rng(20250101).integers(0, 2, size=(64, n_features))
    return rows


def _golden_shots(n_features: int) -> NDArray[np.float32]:
    """Means of 2, 3, 5 and 8 shots, four rows each, divided as a decider divides: float32 counts by float32 shots."""
    rng = np.random.default_rng(20250102)
    rows = [rng.integers(0, k + 1, size=(4, n_features)).astype(np.float32) / np.float32(k) for k in (2, 3, 5, 8)]
    return np.concatenate(rows)


def _row_index(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Table rows of means that are all 0 or 1."""
    return means.astype(np.int64) @ (1 << np.arange(means.shape[1], dtype=np.int64))


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


# ---- checks that a made and a read bundle share; ValueError says what, found, allowed ----


def _demand(holds: bool, message: str) -> None:
    if not holds:
        raise ValueError(message)


def _check_text(text: Any, what: str) -> None:
    fine = isinstance(text, str) and 0 < len(text) <= TEXT_MAX_CHARACTERS and text.isprintable()
    _demand(fine, f"{what} is {ascii(text)[:80]}, allowed: 1 to {TEXT_MAX_CHARACTERS} printable characters")


def _check_table_shape(shape: Sequence[int], n_features: int, n_classes: int) -> None:
    _demand(
        n_features <= TABLE_FEATURES_MAX, f"a table for {n_features} patterns, allowed at most {TABLE_FEATURES_MAX}"
    )
    wanted = (1 << n_features, n_classes)
    _demand(tuple(shape) == wanted, f"the table has shape {tuple(shape)}, allowed: (2**d_f, classes) = {wanted}")


def _check_facts(bundle: Bundle) -> None:
    _check_text(bundle.name, "name")
    _check_text(bundle.task, "task")
    _demand(bundle.encoder in ENCODERS, f"encoder is {ascii(bundle.encoder)[:80]}, allowed: {', '.join(ENCODERS)}")
    n_classes = len(bundle.classes)
    _demand(2 <= n_classes <= CLASSES_MAX, f"{n_classes} classes, allowed: 2 to {CLASSES_MAX}")
    for name in bundle.classes:
        _check_text(name, "a class name")
    _demand(len(set(bundle.classes)) == n_classes, "two classes have the same name, allowed: each name once")
    _demand(2 <= bundle.levels <= LEVELS_MAX, f"levels is {bundle.levels}, allowed: 2 to {LEVELS_MAX}")
    scale = bundle.photons_per_level
    _demand(math.isfinite(scale) and scale > 0, f"photons_per_level is {scale}, allowed: finite and above 0")


def _check(bundle: Bundle) -> None:
    """Raise ValueError at the first thing that is impossible in itself or does not fit the rest."""
    _check_facts(bundle)
    d_f, pixels = bundle.pattern_levels.shape
    height, width = bundle.image_shape
    _demand(1 <= d_f <= FEATURES_MAX, f"{d_f} patterns, allowed: 1 to {FEATURES_MAX}")
    _demand(1 <= pixels <= PIXELS_MAX, f"{pixels} pixels, allowed: 1 to {PIXELS_MAX}")
    fits = height > 0 and width > 0 and height * width == pixels
    _demand(fits, f"image_shape is {height}x{width}, but a pattern has {pixels} pixels")
    top = int(bundle.pattern_levels.max())
    _demand(top < bundle.levels, f"a pattern level is {top}, allowed: 0 to {bundle.levels - 1}")
    _demand(
        bundle.head_onnx is not None or bundle.table is not None, "neither a head nor a table, allowed: either or both"
    )
    if bundle.head_onnx is not None:
        size = len(bundle.head_onnx)
        _demand(0 < size <= HEAD_MAX_BYTES, f"the head has {size} bytes, allowed: 1 to {HEAD_MAX_BYTES}")
    if bundle.table is not None:
        _check_table_shape(bundle.table.shape, d_f, bundle.n_classes)
        _demand(bool(np.isfinite(bundle.table).all()), "the table holds scores that are not finite")
    _check_golden(bundle)


def _check_golden(bundle: Bundle) -> None:
    means, scores = bundle.golden_means, bundle.golden_scores
    count = means.shape[0]
    _demand(1 <= count <= GOLDEN_MAX, f"{count} golden vectors, allowed: 1 to {GOLDEN_MAX}")
    _demand(
        means.shape == (count, bundle.n_features), f"golden_means has shape {means.shape}, d_f is {bundle.n_features}"
    )
    wanted = (count, bundle.n_classes)
    _demand(scores.shape == wanted, f"golden_scores has shape {scores.shape}, allowed: {wanted}")
    _demand(bool(((means >= 0) & (means <= 1)).all()), "golden_means leaves [0, 1]")
    _demand(bool(np.isfinite(scores).all()), "the golden scores are not finite (does the head answer NaN?)")
    if bundle.table is not None:
        binary = ((means == 0) | (means == 1)).all(axis=1)
        found = bundle.table[_row_index(means[binary])]
        difference = golden_violation(found, scores[binary])
        _demand(not difference, f"the table does not answer the golden vectors: {difference}")


# ---- bytes ----


def bundle_bytes(bundle: Bundle) -> bytes:
    """Return the file of `bundle`; the same bundle always gives the same bytes. UsageError above 256 MiB."""
    parts: list[tuple[str, NDArray[Any]]] = [("pattern_levels", bundle.pattern_levels)]
    if bundle.head_onnx is not None:
        parts.append(("head_onnx", np.frombuffer(bundle.head_onnx, dtype=np.uint8)))
    if bundle.table is not None:
        parts.append(("table", bundle.table))
    parts += [("golden_means", bundle.golden_means), ("golden_scores", bundle.golden_scores)]
    rows, blobs, offset = [], [], 0
    for name, array in parts:
        blob = array.astype(_PARTS[name]).tobytes()
        digest = hashlib.sha256(blob).hexdigest()
        rows.append(
            {
                **{"name": name, "dtype": _PARTS[name], "shape": list(array.shape)},
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
        }
    )
    total = _PROLOGUE.size + len(header) + offset + _DIGEST_BYTES
    if len(header) > HEADER_MAX_BYTES or total > FILE_MAX_BYTES:
        allowed = f"{HEADER_MAX_BYTES} and {FILE_MAX_BYTES}"
        raise UsageError(
            f"this bundle would have a header of {len(header)} and {total} bytes in all, allowed: {allowed}"
        )
    body = b"".join([_PROLOGUE.pack(MAGIC, FORMAT_VERSION, len(header)), header, *blobs])
    return body + hashlib.sha256(body).digest()


def parse_bundle(data: bytes, where: str) -> Bundle:
    """Return the bundle in `data`; DamagedFileError, starting with `where`, for any byte that is not as written."""
    try:
        header_end = _check_prologue(data)
        if hashlib.sha256(data[:-_DIGEST_BYTES]).digest() != data[-_DIGEST_BYTES:]:
            raise ValueError(_what_changed(data, header_end))
        header = parse_json_object(data[_PROLOGUE.size : header_end], "header")
        return _build(header, _read_parts(header, data, header_end))
    except DamagedFileError as error:
        raise DamagedFileError(f"{where}: {error.message}", remedy=error.remedy or _REMEDY) from error
    except (ValueError, TypeError, OverflowError) as error:
        raise DamagedFileError(f"{where}: {error}", remedy=_REMEDY) from error


def _check_prologue(data: bytes) -> int:
    """Check magic, version and sizes; return where the header ends."""
    _demand(len(data) <= FILE_MAX_BYTES, f"{len(data)} bytes, allowed at most {FILE_MAX_BYTES}")
    if data[: len(MAGIC)] != MAGIC[: len(data)]:
        raise ValueError(f"not a PANS bundle: it starts with {data[:8]!a}, expected {MAGIC!a}")
    smallest = _PROLOGUE.size + 2 + _DIGEST_BYTES
    _demand(len(data) >= smallest, f"truncated: {len(data)} bytes, a bundle has at least {smallest}")
    _, version, header_length = _PROLOGUE.unpack_from(data)
    if version != FORMAT_VERSION:
        raise DamagedFileError(
            f"bundle format version {version}, allowed: {FORMAT_VERSION}",
            remedy="install the pans-runtime that wrote it, or export the bundle again with this one",
        )
    _demand(header_length <= HEADER_MAX_BYTES, f"a header of {header_length} bytes, allowed at most {HEADER_MAX_BYTES}")
    header_end = _PROLOGUE.size + header_length
    _demand(
        header_end + _DIGEST_BYTES <= len(data), f"truncated: {len(data)} bytes, the header alone needs {header_end}"
    )
    return header_end


def _what_changed(data: bytes, header_end: int) -> str:
    """Say as exactly as possible why the closing checksum does not fit; the header is not trusted here, only quoted."""
    try:
        rows = parse_json_object(data[_PROLOGUE.size : header_end], "header")["parts"]
        wanted = header_end + sum(int(row["length"]) for row in rows) + _DIGEST_BYTES
        if wanted > len(data):
            return f"truncated: {len(data)} bytes, the header announces {wanted}"
        if wanted < len(data):
            return f"{len(data) - wanted} bytes too many: {len(data)}, the header announces {wanted}"
        for row in rows:
            start = header_end + int(row["offset"])
            if hashlib.sha256(data[start : start + int(row["length"])]).hexdigest() != row["sha256"]:
                return f"altered: the part {ascii(row['name'])[:40]} does not have its SHA-256"
    except (DamagedFileError, KeyError, TypeError, ValueError, OverflowError):
        pass
    return "altered: the header or the closing SHA-256 is not as written"


def _read_parts(header: Mapping[str, Any], data: bytes, header_end: int) -> dict[str, NDArray[Any]]:
    """Return the parts by name, after checking that they fill the file without gap, overlap or rest."""
    _demand(set(header) == _HEADER_KEYS, f"the header has the keys {_quoted(header)}, allowed: {_quoted(_HEADER_KEYS)}")
    rows = header["parts"]
    _demand(isinstance(rows, list) and len(rows) <= len(_PARTS), "the header's parts are not a short list")
    parts: dict[str, NDArray[Any]] = {}
    offset, room = 0, len(data) - _DIGEST_BYTES - header_end
    for row in rows:
        _demand(isinstance(row, dict) and set(row) == _PART_KEYS, f"a part needs the keys {_quoted(_PART_KEYS)}")
        name, shape, length = row["name"], row["shape"], row["length"]
        _demand(
            isinstance(name, str) and name in _PARTS, f"unknown part {ascii(name)[:40]}, allowed: {_quoted(_PARTS)}"
        )
        _demand(name not in parts, f"the part {name} stands twice")
        _demand(row["dtype"] == _PARTS[name], f"{name} has dtype {ascii(row['dtype'])[:40]}, allowed: {_PARTS[name]}")
        good_shape = isinstance(shape, list) and len(shape) in (1, 2) and all(_is_count(n) for n in shape)
        _demand(good_shape and _is_count(length), f"{name} has shape {ascii(shape)[:80]}, allowed: one or two sizes")
        wanted = math.prod(shape) * np.dtype(_PARTS[name]).itemsize
        _demand(length == wanted, f"{name} has {length} bytes, its shape {shape} needs {wanted}")
        _demand(
            row["offset"] == offset and offset + length <= room, f"{name} lies outside the file or over another part"
        )
        blob = data[header_end + offset : header_end + offset + length]
        _demand(hashlib.sha256(blob).hexdigest() == row["sha256"], f"the part {name} does not have its SHA-256")
        native = np.dtype(_PARTS[name]).newbyteorder("=")
        parts[name] = _frozen(np.frombuffer(blob, dtype=_PARTS[name]).reshape(shape).astype(native))
        offset += length
    _demand(offset == room, f"{room - offset} bytes after the last part, allowed: none")
    for name in ("pattern_levels", "golden_means", "golden_scores"):
        _demand(name in parts and parts[name].ndim == 2, f"the part {name} is missing or not a matrix")
    return parts


def _build(header: Mapping[str, Any], parts: Mapping[str, NDArray[Any]]) -> Bundle:
    shape, classes, scale = header["image_shape"], header["classes"], header["photons_per_level"]
    good_shape = isinstance(shape, list) and len(shape) == 2 and all(_is_count(n) for n in shape)
    _demand(good_shape, f"image_shape is {ascii(shape)[:80]}, allowed: [height, width]")
    _demand(_is_count(header["levels"]), f"levels is {ascii(header['levels'])[:80]}, allowed: 2 to {LEVELS_MAX}")
    good_scale = isinstance(scale, int | float) and not isinstance(scale, bool)
    _demand(good_scale, f"photons_per_level is {ascii(scale)[:80]}, allowed: finite and above 0")
    _demand(isinstance(classes, list), f"classes is {ascii(classes)[:80]}, allowed: a list of names")
    _demand(isinstance(header["provenance"], dict), "provenance is not an object")
    head = parts.get("head_onnx")
    bundle = Bundle(
        name=header["name"],
        task=header["task"],
        classes=tuple(classes),
        encoder=header["encoder"],
        image_shape=(shape[0], shape[1]),
        levels=header["levels"],
        pattern_levels=parts["pattern_levels"],
        photons_per_level=float(scale),
        head_onnx=None if head is None else head.tobytes(),
        table=parts.get("table"),
        golden_means=parts["golden_means"],
        golden_scores=parts["golden_scores"],
        provenance=header["provenance"],
    )
    _check(bundle)
    return bundle


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= FILE_MAX_BYTES


def _quoted(names: Mapping[str, Any] | set[str]) -> str:
    return ascii(", ".join(sorted(str(name) for name in names))[:200])


def write_bundle(bundle: Bundle, path: str | Path) -> str:
    """Write `bundle` beside `path`, sync, rename over it; return the file's SHA-256 as hex."""
    data = bundle_bytes(bundle)
    replace_file(path, data)
    return hashlib.sha256(data).hexdigest()


def load_bundle(path: str | Path) -> tuple[Bundle, str]:
    """Return the bundle in `path` and the file's SHA-256 as hex; UsageError without a file, else DamagedFileError."""
    data = read_file(path)
    return parse_bundle(data, str(path)), hashlib.sha256(data).hexdigest()
