"""The parts of a bundle that holds an automaton, format versions 3, 4 (photon numbers) and 6 (several channels): formats.md in code.

Owns how patterns are packed and how states, posteriors and golden walks lie in the file; the container around them is format.py's. A part
that unpacks to more than memory should hold is refused before it is unpacked.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.ranges import demand

from .automaton import CHANNELS_MAX, Automaton
from .facts import GOLDEN_MAX, GOLDEN_MEANS_MAX, PATTERN_CELLS_MAX, PATTERNS_MAX, Bundle, frozen
from .walks import log_scores

PATTERN_PARTS = {
    "pattern_bits": "|u1",
    "pattern_bytes": "|u1",
    "pattern_levels": "<u2",
}  # one of them, as `levels` asks
STATE_PARTS = {"state_pattern": "<u2", "state_dwell": "<u2", "successors": "<u4", "posteriors": "<f4"}
GOLDEN_PARTS = {"golden_words": "|u1", "golden_walks": "<u4", "golden_posteriors": "<f4"}
PARTS = PATTERN_PARTS | STATE_PARTS | GOLDEN_PARTS
HEADER_KEYS = {"automaton"}
OPTIONAL_KEYS = {"expected"}
_SAYS = {4: "outcomes", 6: "channels"}  # the key of each format version beyond 3
_ROWS_AT_ONCE = 1024


class Golden(NamedTuple):
    """The golden walks as a bundle holds them."""

    means: NDArray[np.float32]
    scores: NDArray[np.float32]
    walks: NDArray[np.uint32]


def pattern_part(levels: int) -> str:
    """Return the part that holds patterns of so many levels: single bits, bytes, or two bytes per pixel."""
    return "pattern_bits" if levels == 2 else "pattern_bytes" if levels <= 256 else "pattern_levels"


def parts_of(bundle: Bundle, automaton: Automaton) -> list[tuple[str, NDArray[Any]]]:
    """Return the parts of a checked bundle in the file's order."""
    name = pattern_part(bundle.levels)
    patterns = bundle.pattern_levels
    walks = np.zeros((0, 0), np.uint32) if bundle.golden_walks is None else bundle.golden_walks
    return [
        (name, _packed(patterns) if name == "pattern_bits" else patterns),
        ("state_pattern", automaton.pattern),
        ("state_dwell", automaton.dwell),
        ("successors", automaton.successors),
        ("posteriors", automaton.posteriors),
        ("golden_words", bundle.golden_means.astype(np.uint8) if automaton.counts else _packed(bundle.golden_means)),
        ("golden_walks", walks),
        ("golden_posteriors", automaton.posteriors[walks[:, -1]]),
    ]


def facts_of(bundle: Bundle, automaton: Automaton) -> dict[str, Any]:
    """Return the header's keys that only such a bundle has."""
    more: dict[str, int] = {"outcomes": automaton.n_outcomes} if automaton.counts else {}
    if automaton.channels > 1:
        more = {"channels": automaton.channels}
    facts: dict[str, Any] = {"automaton": {"dwell_steps": automaton.dwell_steps, **more}}
    return facts if bundle.expected is None else facts | {"expected": dict(bundle.expected)}


def demand_parts(parts: Mapping[str, NDArray[Any]], levels: int) -> None:
    """Raise ValueError unless exactly the parts are there that a bundle of `levels` levels needs."""
    wanted = {pattern_part(levels), *STATE_PARTS, *GOLDEN_PARTS}
    demand(set(parts) == wanted, f"the parts {', '.join(sorted(parts))}, needed: {', '.join(sorted(wanted))}")
    for name, array in parts.items():
        axes = 1 if name in ("state_pattern", "state_dwell") else 2
        demand(array.ndim == axes, f"the part {name} has {array.ndim} axes, allowed: {axes}")


def version_of(facts: Mapping[str, Any]) -> int:
    """Return the lowest format version that can say what a header or `facts_of` says of the automaton."""
    said = facts["automaton"]
    return next((version for version, key in _SAYS.items() if isinstance(said, dict) and key in said), 3)


def automaton_of(header: Mapping[str, Any], parts: Mapping[str, NDArray[Any]]) -> Automaton:
    """Return the automaton of a file; ValueError for what is impossible."""
    facts, version, columns = header["automaton"], version_of(header), parts["successors"].shape[1]
    counts, key = version == 4, _SAYS.get(version)
    known = isinstance(facts, dict) and set(facts) == {"dwell_steps", *([key] if key else [])}
    said = f"automaton is {ascii(facts)[:80]}"
    demand(known, f"{said}, allowed: an object with the keys dwell_steps and perhaps outcomes or channels")
    if key is None:
        demand(columns == 2, f"successors has {columns} columns, allowed without automaton.channels or outcomes: 2")
    else:
        value = facts[key]
        whole = isinstance(value, int) and not isinstance(value, bool) and (counts or 2 <= value <= CHANNELS_MAX)
        same = whole and (value if counts else 1 << value) == columns
        demand(same, f"automaton.{key} is {ascii(value)[:80]}, successors has {columns} columns")
    states = (parts["state_pattern"], parts["state_dwell"], facts["dwell_steps"])
    return Automaton(*states, parts["successors"], parts["posteriors"], counts)


def expected_of(header: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the expected figures, if any; ValueError for what is no object."""
    expected = header.get("expected")
    demand(
        "expected" not in header or isinstance(expected, dict),
        f"expected is {ascii(expected)[:80]}, allowed: an object",
    )
    return expected


def patterns_of(parts: Mapping[str, NDArray[Any]], levels: int, n_pixels: int) -> NDArray[np.uint16]:
    """Return the patterns, uint16 (n, pixels); ValueError for a shape that does not fit or more than memory should hold."""
    name = pattern_part(levels)
    stored = parts[name]
    n, width = stored.shape
    wanted = -(-n_pixels // 8) if name == "pattern_bits" else n_pixels
    demand(width == wanted, f"{name} has rows of {width}, patterns of {n_pixels} pixels need {wanted}")
    demand(n <= PATTERNS_MAX, f"{n} patterns of an automaton, allowed: 1 to {PATTERNS_MAX}")
    demand(n * n_pixels <= PATTERN_CELLS_MAX, f"{n} patterns of {n_pixels} pixels, allowed: {PATTERN_CELLS_MAX} in all")
    return frozen(
        _unpacked(stored, n_pixels, name, np.dtype(np.uint16)) if name == "pattern_bits" else stored.astype(np.uint16)
    )


def golden_of(parts: Mapping[str, NDArray[Any]], automaton: Automaton) -> Golden:
    """Return the golden walks; ValueError unless each leaf's posterior is, bit for bit, the automaton's."""
    stored, walks, posteriors = (parts[name] for name in GOLDEN_PARTS)
    n_bits, rows = automaton.n_bits, len(stored)
    width = n_bits if automaton.counts else -(-n_bits // 8)
    demand(1 <= rows <= GOLDEN_MAX, f"{rows} golden walks, allowed: 1 to {GOLDEN_MAX}")
    demand(rows * n_bits <= GOLDEN_MEANS_MAX, f"{rows} golden words of {n_bits}, allowed: {GOLDEN_MEANS_MAX} in all")
    demand(
        stored.shape[1] == width, f"golden_words has rows of {stored.shape[1]} bytes, {n_bits} outcomes need {width}"
    )
    wanted = (rows, automaton.n_slots + 1)
    demand(walks.shape == wanted, f"golden_walks has shape {walks.shape}, allowed: {wanted}")
    leaves = walks[:, -1]
    low, high = automaton.n_states, len(automaton.posteriors)
    ends = bool((leaves >= low).all() and (leaves < high).all())
    demand(ends, f"a golden walk ends at a node outside {low} to {high - 1}, where the leaves are")
    same = posteriors.shape == (rows, automaton.n_classes) and np.array_equal(posteriors, automaton.posteriors[leaves])
    demand(same, "the golden posteriors are not those of the leaves")
    words = stored.astype(np.float32)
    if not automaton.counts:
        words = _unpacked(stored, n_bits, "golden_words", np.dtype(np.float32))
    return Golden(frozen(words), frozen(log_scores(posteriors)), walks)


def _packed(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Zeros and ones (n, k) as bits: number j is bit j % 8 of byte j // 8."""
    return np.packbits(values.astype(np.bool_), axis=1, bitorder="little")


def _unpacked(stored: NDArray[np.uint8], count: int, name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
    spare = -count % 8
    clean = not spare or not bool((stored[:, -1] >> np.uint8(8 - spare)).any())
    demand(clean, f"{name} has bits behind the last of {count}, allowed: zero")
    out = np.empty((len(stored), count), dtype)
    for start in range(0, len(stored), _ROWS_AT_ONCE):  # one byte per bit for a while: never for all
        part = stored[start : start + _ROWS_AT_ONCE]
        out[start : start + _ROWS_AT_ONCE] = np.unpackbits(part, axis=1, count=count, bitorder="little")
    return out
