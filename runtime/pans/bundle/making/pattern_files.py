"""A bundle's parts as files for other tools, and patterns from such files: PNG pictures, NumPy arrays, the head as ONNX.

White is the highest level.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base import __version__
from pans.base.errors import DamagedFileError, UsageError, refusing
from pans.base.files import levels_png, read_file, read_grey_png
from pans.bundle.heads.onnx_check import protobuf
from pans.bundle.sensor.facts import Bundle

PICTURES_MAX = 65_535
DOC_STRING, METADATA = 6, 14  # fields of ModelProto (onnx.proto)


# ---- out ----


def pattern_pngs(bundle: Bundle) -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of a grey picture per pattern, 8 bits for up to 256 levels, else 16; UsageError without patterns."""
    if not bundle.pattern_levels.size:
        raise UsageError(f"{bundle.name} has no patterns to display: its optics are passive", remedy="use --format npy")
    digits = len(str(len(bundle.pattern_levels) - 1))
    for number, levels in enumerate(bundle.pattern_levels):
        yield f"pattern-{number:0{digits}d}.png", levels_png(levels.reshape(bundle.image_shape), bundle.levels)


def array_parts(bundle: Bundle) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield names and arrays of what a bundle displays and of how it decides, without its head."""
    if bundle.analyser is not None:
        yield "analyser.npy", np.asarray(bundle.analyser.matrix)
    else:
        yield "patterns.npy", bundle.patterns()
    if bundle.table is not None:
        yield "table.npy", bundle.table
    if bundle.automaton is not None:
        for name in ("pattern", "dwell", "successors", "posteriors"):
            yield f"automaton-{name}.npy", getattr(bundle.automaton, name)


def about(bundle: Bundle) -> dict[str, Any]:
    """Return what the files do not say of themselves, JSON-able, units in the keys."""
    return {
        "name": bundle.name,
        "task": bundle.task,
        "classes": list(bundle.classes),
        "encoder": bundle.encoder,
        "image_shape": list(bundle.image_shape),
        "levels": bundle.levels,
        "photons_per_level": bundle.photons_per_level,
        "photons_at_white": bundle.photons_per_level * max(bundle.levels - 1, 0),
        **({"photon_number_max": bundle.largest} if bundle.largest > 1 else {}),
        **({"channels_at_once": bundle.n_channels} if bundle.n_channels > 1 else {}),
    }


def head_with_facts(bundle: Bundle) -> bytes:
    """Return the head as an ONNX file that says what it is, takes and gives; UsageError for a bundle without one."""
    if bundle.head_onnx is None:
        kind = "an automaton" if bundle.automaton is not None else "a table"
        raise UsageError(f"{bundle.name} decides by {kind}, and has no ONNX head", remedy="use --format npy")
    if b"pans.about" in bundle.head_onnx:
        return bundle.head_onnx
    means = f"photons per exposure, 0 to {bundle.largest}" if bundle.largest > 1 else "clicks per exposure, 0 to 1"
    picture = bundle.picture_shape
    gives = (
        "scores of the classes; their softmax is the posterior" if picture is None else f"pixels of {picture}, by rows"
    )
    said = {
        "name": bundle.name,
        "task": bundle.task,
        "classes": json.dumps(bundle.classes),
        "input": f"float32 (decisions, {bundle.n_features}): mean {means}, of each pattern in the bundle's order",
        "output": f"float32 (decisions, {bundle.n_outputs}): {gives}",
        "data_licence": str(bundle.provenance.get("data_licence", "")),
        "data_sha256": str(bundle.provenance.get("data_sha256", "")),
        "pans_version": __version__,
        "pans.about": json.dumps(about(bundle), sort_keys=True),
    }
    doc = f"Head of the pans bundle {bundle.name}. Input: {said['input']}. Output: {said['output']}."
    facts = ((METADATA, protobuf((1, key), (2, value))) for key, value in said.items() if value)
    # fields of a serialised message come in any order, and of a text the last one counts: more may follow the rest
    return bundle.head_onnx + protobuf((DOC_STRING, doc), *facts)


# ---- in ----


def read_pattern_pngs(folder: Path) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """Return the grey pictures of a folder, in the order of their names, as float64 (patterns, pixels) with white 1, and their shape.

    UsageError for a folder without PNG files, DamagedFileError for a picture that is not plain grey or has another shape.
    """
    with refusing(f"{folder}: cannot be read", "name a folder"):
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".png")
    if not 1 <= len(paths) <= PICTURES_MAX:
        raise UsageError(
            f"{folder}: {len(paths)} PNG files, allowed 1 to {PICTURES_MAX}", remedy="one grey PNG for each pattern"
        )
    pictures = [read_grey_png(read_file(path), str(path)) for path in paths]
    for path, picture in zip(paths, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise DamagedFileError(
                f"{path}: {picture.shape[1]} x {picture.shape[0]} pixels, {paths[0].name} has "
                f"{pictures[0].shape[1]} x {pictures[0].shape[0]}",
                remedy="give all patterns one size",
            )
    height, width = pictures[0].shape
    return np.stack(pictures).reshape(len(pictures), -1), (height, width)
