"""Patterns or optics, and what decides, in; a checked `Bundle` with golden vectors out; and bundles written to and read from files.

A read either returns a `Bundle` whose every byte is covered by a checksum and whose table answers the golden vectors, or raises
DamagedFileError. What a bundle is stands in facts.py, its bytes in file_format.py.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base import SHIPPED
from pans.base.errors import UsageError, as_usage_error, refusing
from pans.base.files import canonical_json, open_regular, parse_json_object, write_file
from pans.base.numbers import demand
from pans.bundle.automaton import Automaton, golden_nodes, log_scores, walk_nodes, words_to
from pans.bundle.heads.head import open_head
from pans.bundle.heads.layers import Int8Head

from .analyser import Analyser
from .facts import (
    GOLDEN_MEANS_MAX,
    GOLDEN_SCORES_MAX,
    GOLDEN_WORK_MAX,
    LEVELS_MAX,
    RANGES,
    check_bundle,
    check_expected,
    check_table_shape,
    frozen,
    words_among,
)
from .facts import Bundle as Bundle
from .facts import golden_violation as golden_violation
from .file_format import bundle_bytes as bundle_bytes
from .file_format import parse_bundle as parse_bundle
from .file_format import read_bundle as read_bundle

TABLE_BUILD_ROWS_MAX = 1 << 12


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What an active sensor shows: patterns (d_f, pixels) of any integer dtype, each below `levels`.

    `photons_per_level`: photoelectrons per exposure, per level, per unit transmission.
    """

    levels: int
    pattern_levels: ArrayLike
    photons_per_level: float


@dataclass(frozen=True, slots=True, eq=False)
class BackEnd:
    """What decides: a head, a table (outcomes**d_f, classes) of floats, or both, which must agree; and the head in eight bits.

    With `outcomes` above 2 every exposure is a photon number from 0 to `outcomes` - 1, which stands for that many or more: the head is
    given mean numbers over the largest.
    """

    head_onnx: bytes | None = None
    table: ArrayLike | None = None
    int8_head: Int8Head | None = None
    int8_onnx: bytes | None = None
    outcomes: int = 2


def make_bundle(
    *,
    name: str,
    task: str,
    classes: Sequence[str] = (),
    image_shape: tuple[int, int],
    optics: Shown | Analyser,
    provenance: Mapping[str, Any],
    back_end: BackEnd | None = None,
    picture_shape: tuple[int, int] | None = None,
    automaton: Automaton | None = None,
) -> Bundle:
    """Return a checked bundle with golden vectors, and, among classes, with a table made from the head where it has at most 4096 rows.

    `optics` are the patterns of an active sensor or the analyser of a passive one. The head decides among `classes`, or gives back a
    picture of `picture_shape`; an `automaton` decides by itself (no `back_end`) and brings golden walks. UsageError says what does not
    fit, DamagedFileError what is wrong with the head.

    >>> shown = Shown(levels=2, pattern_levels=[[1, 0], [0, 1]], photons_per_level=3.0)
    >>> table = BackEnd(table=[[0, 0], [1, 0], [0, 1], [1, 1]])
    >>> bundle = make_bundle(
    ...     name="two", task="left or right", classes=("left", "right"), image_shape=(1, 2), optics=shown, back_end=table,
    ...     provenance={},
    ... )
    >>> bundle.n_features, bundle.illumination()
    (2, 6.0)
    """
    try:
        analyser = optics if isinstance(optics, Analyser) else None
        shown = optics if isinstance(optics, Shown) else Shown(0, np.zeros((len(optics.matrix), 0), np.uint16), 0.0)
        patterns = _as_levels(shown) if analyser is None else np.asarray(shown.pattern_levels)
        n_outputs = len(classes) if picture_shape is None else math.prod(picture_shape)
        decided = BackEnd() if back_end is None else back_end
        if automaton is None:
            RANGES["outcomes"].checked(decided.outcomes, "outcomes")
            golden = _golden_of_back_end(decided, len(patterns), n_outputs, decides=picture_shape is None)
        else:
            golden = _golden_of_automaton(automaton, decided)
        bundle = Bundle(
            name=name,
            task=task,
            classes=tuple(classes),
            encoder="automaton" if automaton is not None else "active" if analyser is None else analyser.kind,
            image_shape=(int(image_shape[0]), int(image_shape[1])),
            levels=int(shown.levels),
            pattern_levels=frozen(patterns),
            photons_per_level=float(shown.photons_per_level),
            head_onnx=None if decided.head_onnx is None else bytes(decided.head_onnx),
            table=None if golden.table is None else frozen(golden.table),
            golden_means=frozen(golden.means),
            golden_scores=frozen(golden.scores),
            provenance=parse_json_object(canonical_json(dict(provenance)), "provenance"),
            int8_head=decided.int8_head,
            int8_onnx=None if decided.int8_onnx is None else bytes(decided.int8_onnx),
            analyser=analyser,
            picture_shape=picture_shape,
            automaton=automaton,
            golden_walks=None if golden.walks is None else frozen(golden.walks),
            outcomes=decided.outcomes,
        )
        check_bundle(bundle)
    except (ValueError, TypeError) as error:
        raise UsageError(f"this bundle cannot be made: {error}") from error
    return bundle


def with_expected(bundle: Bundle, expected: Mapping[str, Any]) -> Bundle:
    """Return an automaton's `bundle` with what it is expected to achieve, of the keys `EXPECTED_KEYS`; UsageError for what cannot be.

    `profile`, `task` and `split` say under what conditions; the other figures are exact means per decision over `objects`.
    """
    with as_usage_error():
        if bundle.automaton is None:
            raise ValueError(f"{bundle.name} has no automaton, expected figures belong to one")
        check_expected(expected, bundle.automaton)
    return replace(bundle, expected=parse_json_object(canonical_json(dict(expected)), "expected"))


def word_means(words: ArrayLike, n_features: int, outcomes: int = 2) -> NDArray[np.float32]:
    """Return words (n,) of single shots as the head's input (n, d_f), float32: bit i becomes feature i; d_f <= 63.

    Of photon numbers a word is their number in base `outcomes`, feature 0 the lowest digit, and a feature is its digit over the largest.
    """
    digits = np.asarray(words, dtype=np.int64)[:, None] // outcomes ** np.arange(n_features, dtype=np.int64) % outcomes
    return digits.astype(np.float32) / np.float32(outcomes - 1)


def _as_levels(shown: Shown) -> NDArray[np.uint16]:
    values = np.asarray(shown.pattern_levels)
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.integer) or values.size == 0:
        found = f"shape {values.shape} and dtype {values.dtype}"
        raise ValueError(f"pattern_levels has {found}, allowed: integers (d_f, pixels)")
    low, high = int(values.min()), int(values.max())
    if low < 0 or high >= min(shown.levels, LEVELS_MAX):
        raise ValueError(f"pattern_levels run from {low} to {high}, allowed: 0 to {shown.levels - 1}")
    return values.astype(np.uint16)


class _Golden(NamedTuple):
    means: NDArray[np.float32]
    scores: NDArray[np.float32]
    table: NDArray[np.float32] | None
    walks: NDArray[np.uint32] | None = None


def _golden_of_back_end(back_end: BackEnd, n_features: int, n_outputs: int, *, decides: bool) -> _Golden:
    """Return the golden vectors and the table, if any; the head answers where there is one, else the table."""
    outcomes = back_end.outcomes
    largest, n_words = outcomes - 1, outcomes**n_features
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes inf, and is refused later
        table = None if back_end.table is None else np.array(back_end.table, dtype=np.float32)
    if table is not None:
        check_table_shape(table.shape, n_features, n_outputs, outcomes)
    means = _golden_words(n_features, largest)
    if back_end.head_onnx is None:
        if table is None:
            raise ValueError("neither a head nor a table was given, allowed: either or both")
        return _Golden(means, table[words_among(means, outcomes)[1]], table)
    head = open_head(back_end.head_onnx, n_features, n_outputs, "head")
    means = np.concatenate([means, _golden_shots(n_features, largest)])
    means = means[:: -(-len(means) * n_outputs // GOLDEN_SCORES_MAX)]  # fewer of very large pictures
    affordable = head.cost.operations * min(n_words, TABLE_BUILD_ROWS_MAX) <= GOLDEN_WORK_MAX
    if table is not None or (decides and n_words <= TABLE_BUILD_ROWS_MAX and affordable):
        answers = head.scores(word_means(np.arange(n_words), n_features, outcomes))
        difference = "" if table is None else golden_violation(table, answers)
        if difference:
            more = "(vector = click word; found = table, expected = head)"
            raise ValueError(f"head and table disagree: {difference} {more}")
        table = answers if table is None else table
    return _Golden(means, head.scores(means), table)


def _golden_of_automaton(automaton: Automaton, besides: BackEnd) -> _Golden:
    """Words as for any bundle, and words that lead to nodes that few random words would reach."""
    parts = (besides.head_onnx, besides.table, besides.int8_head, besides.int8_onnx)
    demand(all(part is None for part in parts), "an automaton beside a head or a table, allowed: either")
    words = np.concatenate([_golden_words(automaton.n_bits), words_to(automaton, golden_nodes(automaton))])
    if automaton.counts:
        drawn = np.random.default_rng(20250103).integers(0, automaton.n_outcomes, (64, automaton.n_bits))
        words = np.concatenate([words, drawn.astype(np.float32)])
    numbers = max(automaton.n_bits / GOLDEN_MEANS_MAX, automaton.n_classes / GOLDEN_SCORES_MAX)
    words = words[:: math.ceil(len(words) * numbers)]  # fewer of very long ones
    walks = walk_nodes(automaton, words)
    return _Golden(words, log_scores(automaton.posteriors[walks[:, -1]]), None, walks)


def _golden_words(n_features: int, largest: int = 1) -> NDArray[np.float32]:
    """No click, all clicks, single clicks (at most 64, evenly spread), 64 random words with a fixed seed.

    With `largest` above 1 a click is that photon number, and 64 random words of all numbers follow.
    """
    singles = np.unique(np.linspace(0, n_features - 1, min(n_features, 64)).round().astype(np.int64))
    rows = np.zeros((2 + len(singles) + 64, n_features), dtype=np.float32)
    rows[1] = 1.0
    rows[2 + np.arange(len(singles)), singles] = 1.0
    rows[2 + len(singles) :] = np.random.default_rng(20250101).integers(0, 2, size=(64, n_features))
    if largest == 1:
        return rows
    drawn = np.random.default_rng(20250103).integers(0, largest + 1, size=(64, n_features))
    return np.concatenate([rows, drawn.astype(np.float32) / np.float32(largest)])


def _golden_shots(n_features: int, largest: int = 1) -> NDArray[np.float32]:
    """Means of 2, 3, 5 and 8 shots, four rows each, divided as a decider divides: float32 counts by float32 shots (times `largest`)."""
    rng = np.random.default_rng(20250102)
    most = [k * largest for k in (2, 3, 5, 8)]
    rows = [rng.integers(0, k + 1, size=(4, n_features)).astype(np.float32) / np.float32(k) for k in most]
    return np.concatenate(rows)


def write_bundle(bundle: Bundle, path: str | Path, *, force: bool = False) -> str:
    """Write `bundle` to `path` whole or not at all; UsageError if it exists, unless `force`. Return the file's SHA-256 as hex."""
    data = bundle_bytes(bundle)
    write_file(path, data, force=force)
    return hashlib.sha256(data).hexdigest()


def shipped_bundles() -> tuple[str, ...]:
    """Names of the bundles that come with the package, sorted."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.pans")))


def bundle_path(name_or_path: str | Path) -> Path:
    """Return the file of a bundle: that file where there is one, else the shipped bundle of that name, else the path as it is."""
    path = Path(name_or_path)
    if not os.path.lexists(path) and str(name_or_path) in shipped_bundles():
        return SHIPPED / f"{name_or_path}.pans"
    return path


def load_bundle(name_or_path: str | Path) -> tuple[Bundle, str]:
    """Return the bundle in a file, or the shipped one of that name, and the file's SHA-256 as hex.

    UsageError without a file, else DamagedFileError.
    """
    path = bundle_path(name_or_path)
    if not os.path.lexists(path):
        remedy = f"name a .pans file, or a shipped bundle: {', '.join(shipped_bundles())}"
        raise UsageError(f"{path}: there is no such bundle", remedy=remedy)
    with refusing(f"{path}: cannot be read"), open_regular(path) as file:
        return read_bundle(file, os.fstat(file.fileno()).st_size, str(path))
