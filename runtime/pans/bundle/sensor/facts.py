"""What a bundle is, and what makes one impossible: facts, limits, consistency, golden vectors, expected figures.

The checks are those of made and of read bundles; they raise ValueError with what, found and allowed, for the caller to say where.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import html_card
from pans.base.errors import UsageError
from pans.base.files import levels_png
from pans.base.numbers import Range, demand
from pans.bundle.automaton import COUNT_OUTCOMES, Automaton, greatest_light, log_scores, walk_difference
from pans.bundle.heads.head import HEAD_MAX_BYTES
from pans.bundle.heads.layers import STEP_MAX, WEIGHT_MAX, Int8Head
from pans.bundle.heads.onnx_check import check_head

from .analyser import LIGHT_RANGE, Analyser, check_analyser

_TEXTS = ("profile", "task", "split")
EXPECTED_RANGES = {
    **{"objects": Range(1, 1 << 53, whole=True), "accuracy": Range(0.0, 1.0), "clicks": Range(0.0, 8 * 1024)},
    **{"photons": Range(0.0, 1e30), "illumination": Range(0.0, 1e30), "exposures": Range(1.0, 1024)},
}
EXPECTED_KEYS = (*_TEXTS, *EXPECTED_RANGES)
EXPECTED_LATER = {"first_state_clicked": Range(0.0, 1.0)}  # which bundles made before do not state
EXPECTED_TOLERANCE = 1e-6  # of an exact figure, times max(1, |figure|): the sums are float64
SHOWN_MAX, SHOWN_PIXELS_MAX = 10, 1 << 14  # patterns and their size in a notebook
ENCODERS = ("active", "coherent", "incoherent", "automaton")  # coherent and incoherent are passive: nothing is shown
PATTERNS_MAX = 65_535  # of an automaton
# Patterns times pixels of an automaton: single bits in the file, two bytes each in the host, one more (two while they are put together)
# in the simulated instrument. 96 levels of 512 states of 28 x 28 pixels are 38 million; a run with as many takes less than 400 MiB.
PATTERN_CELLS_MAX = 40_000_000
FEATURES_MAX = 4096
PIXELS_MAX = 1 << 22
LEVELS_MAX = 65536
CLASSES_MAX = 65534  # a label is a u16, and 0xFFFF means "abstained"
OUTPUTS_MAX = 1 << 18  # pixels of a picture that a head returns
TEXT_MAX_CHARACTERS = 200
TABLE_ROWS_MAX = 1 << 20  # beyond it a table is larger than a file may be
GOLDEN_MAX = 4096
GOLDEN_MEANS_MAX, GOLDEN_SCORES_MAX = 1 << 20, 1 << 22  # numbers
LAYERS_MAX = 16
# Numbers of the header; docs/reference/formats.md states the same.
RANGES = {
    "levels": Range(2, LEVELS_MAX, whole=True),
    "photons_per_level": LIGHT_RANGE,
    "outcomes": Range(2, COUNT_OUTCOMES[1], whole=True),
}
GOLDEN_WORK_MAX = 1 << 36  # multiply-adds for all golden vectors together: about ten seconds
AFFINE_MAX = 1e20  # of an int8 head: its sums, below 2**31, stay finite in float32
GOLDEN_TOLERANCE = 1e-5  # of a score, times max(1, |score|)
_COMPARE_VALUES = 1 << 20  # at once


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """What a run needs to know of a trained sensor; its arrays are read-only. `make_bundle` makes one."""

    name: str
    task: str
    classes: tuple[str, ...]  # empty where a picture is given back
    encoder: str
    image_shape: tuple[int, int]
    levels: int  # 0 of a passive sensor
    pattern_levels: NDArray[np.uint16]  # (d_f, pixels), each below `levels`; (d_f, 0) of a passive sensor
    photons_per_level: float  # photoelectrons per exposure, per level, per unit transmission; 0.0 of a passive sensor
    head_onnx: bytes | None  # float32 (n, d_f) click means in [0, 1] -> float32 (n, outputs) scores or pixels
    table: NDArray[np.float32] | None  # (2**d_f, classes); bit i of the row index is the click of pattern i
    golden_means: NDArray[np.float32]  # (g, d_f)
    golden_scores: NDArray[np.float32]  # (g, outputs)
    provenance: Mapping[str, Any]
    int8_head: Int8Head | None = None  # the head in integers, for our kernels
    int8_onnx: bytes | None = None  # the same as a quantised ONNX model
    analyser: Analyser | None = None  # the optics of a passive sensor
    picture_shape: tuple[int, int] | None = None  # height and width of the picture that the head returns
    automaton: Automaton | None = None  # decides by itself: no head and no table beside it
    golden_walks: NDArray[np.uint32] | None = None  # (g, n_slots + 1) nodes that each golden click word passes
    expected: Mapping[str, Any] | None = None  # of an automaton: its exact expectation, walks.EXPECTED_KEYS
    outcomes: int = 2  # of fixed patterns: readings of an exposure; 3: no photon, one, two or more
    sha256: str = field(default="", init=False)  # of the file that it was read from; `replace` drops it

    @property
    def n_features(self) -> int:
        """Length of a click word, d_f: patterns, detectors behind passive optics, or slots (times channels) of an automaton."""
        return self.n_patterns if self.automaton is None else self.automaton.n_bits

    @property
    def n_patterns(self) -> int:
        """Number of rows of `pattern_levels`: patterns, or detectors behind passive optics."""
        return int(self.pattern_levels.shape[0])

    @property
    def n_pixels(self) -> int:
        """Number of pixels of one pattern; 0 where nothing is shown."""
        return int(self.pattern_levels.shape[1])

    @property
    def n_classes(self) -> int:
        """Number of classes; 0 where a picture is given back."""
        return len(self.classes)

    @property
    def largest(self) -> int:
        """The largest number that an exposure can have: 1 of clicks, more where the detector counts photons."""
        return self.outcomes - 1 if self.automaton is None else self.automaton.largest

    @property
    def n_channels(self) -> int:
        """Number of detectors that each exposure of a walk reads at once; 1 of fixed patterns."""
        return 1 if self.automaton is None else self.automaton.channels

    @property
    def n_outputs(self) -> int:
        """Numbers that the head gives for one object: scores of classes, or pixels of the picture."""
        return self.n_classes if self.picture_shape is None else math.prod(self.picture_shape)

    @property
    def n_shown(self) -> int:
        """Number of patterns that the instrument must hold: none in passive sensing."""
        return 0 if self.analyser is not None else self.n_patterns

    def patterns(self) -> NDArray[np.float64]:
        """Return the patterns (d_f, pixels), float64, in photoelectrons per exposure per unit transmission."""
        return self.pattern_levels.astype(np.float64) * self.photons_per_level

    def illumination(self) -> float:
        """Return the sum of all pattern intensities of one shot, in photoelectrons per unit transmission.

        Of an automaton: of the walk that takes most; what it takes on average depends on the objects (`expected`).
        """
        if self.automaton is not None:
            return greatest_light(self.automaton, self.state_light())
        return int(self.pattern_levels.sum(dtype=np.uint64)) * self.photons_per_level

    def expected_on(self, profile: str, automaton: Automaton | None) -> Mapping[str, Any] | None:
        """Return `expected` where it holds: on the profile of that name, for the whole automaton."""
        found = self.expected
        return found if found is not None and found["profile"] == profile and automaton is self.automaton else None

    def state_light(self) -> NDArray[np.float64]:
        """Return what each state of the automaton shows, float64 (states,): photoelectrons per unit transmission, dwell included."""
        if self.automaton is None:
            raise ValueError(f"{self.name} has no automaton")
        return self.light_of(self.automaton)

    def light_of(self, automaton: Automaton) -> NDArray[np.float64]:
        """Return what each state of an `automaton` over these patterns shows, as `state_light`."""
        whole = self.pattern_levels.sum(axis=1, dtype=np.uint64).astype(np.float64) * self.photons_per_level
        return np.asarray(whole[automaton.rows].sum(axis=1) * (automaton.dwell / automaton.dwell_steps))

    def __repr__(self) -> str:
        """Return the facts in a line."""
        rows, columns = self.image_shape
        outputs = f"{self.n_classes} classes" if self.picture_shape is None else "a picture"
        return (
            f"<Bundle {self.name!r}: {self.task}, {self.n_patterns} patterns of {rows} x {columns} pixels, {outputs}, "
            f"{' and '.join(self._parts()) or 'no back end'}, {f'SHA-256 {self.sha256[:12]}' if self.sha256 else 'of no file'}>"
        )

    def _parts(self) -> list[str]:
        """Return what decides, in words."""
        parts = {"table": self.table, "head": self.head_onnx, "automaton": self.automaton, "int8 head": self.int8_head}
        return [name for name, part in parts.items() if part is not None]

    def _repr_html_(self) -> str:
        """Return what a notebook shows: facts and the first patterns."""
        rows = {
            "task": self.task,
            "classes": self.classes,
            "encoder": self.encoder,
            "patterns": f"{self.n_patterns} of {self.image_shape[0]} x {self.image_shape[1]}, {self.levels} levels",
            "decides by": tuple(self._parts()),
            "illumination per shot (photons)": self.illumination(),
            **{f"expected {name}": value for name, value in (self.expected or {}).items()},
        }
        shown = self.pattern_levels[:SHOWN_MAX] if 0 < self.n_pixels <= SHOWN_PIXELS_MAX else ()
        pictures: list[bytes] = []
        with suppress(UsageError):  # without Pillow the card has no pictures
            pictures = [levels_png(levels.reshape(self.image_shape), self.levels) for levels in shown]
        return html_card(f"Bundle {self.name}", rows, [(f"pattern {at}", one) for at, one in enumerate(pictures)])


def golden_violation(found: NDArray[np.float32], golden: NDArray[np.float32], *, decides: bool = True) -> str:
    """Return what differs between scores (g, outputs) and the golden ones, or "" if nothing does.

    Scores agree within 1e-5 * max(1, |score|), and, where they decide among classes, the decision is the same wherever the golden
    margin exceeds that.
    """
    if found.shape != golden.shape:
        return f"scores of shape {found.shape}, expected {golden.shape}"
    step = max(1, _COMPARE_VALUES // max(1, golden.shape[1]))  # rows at once, so that float64 copies stay small
    for first in range(0, len(golden), step):
        here, wanted = found[first : first + step], golden[first : first + step].astype(np.float64)
        error = (np.abs(here.astype(np.float64) - wanted) / np.maximum(1.0, np.abs(wanted))).max(axis=1)
        row = int(np.argmax(np.where(np.isfinite(error), error, np.inf)))
        if not error[row] <= GOLDEN_TOLERANCE:  # a NaN too
            off = f"off by {float(error[row]):.3g} of max(1, |score|), allowed {GOLDEN_TOLERANCE:g}"
            return f"the scores of vector {first + row} are {off}"
        if decides:
            ranked = np.sort(wanted, axis=1)
            clear = ranked[:, -1] - ranked[:, -2] > GOLDEN_TOLERANCE * np.maximum(1.0, np.abs(wanted).max(axis=1))
            differs = clear & (here.argmax(axis=1) != wanted.argmax(axis=1))
            if differs.any():
                row = int(np.argmax(differs))
                ends = f"{int(here[row].argmax())}, expected {int(wanted[row].argmax())}"
                return f"the decision for vector {first + row} is {ends}"
    return ""


def words_among(means: NDArray[np.float32], outcomes: int = 2) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which of `means` (g, d_f) are readings of one shot, bool (g,), and the table rows of those."""
    largest = np.float32(outcomes - 1)
    numbers = np.rint(means * largest)
    single = np.asarray((numbers / largest == means).all(axis=1))
    return single, numbers[single].astype(np.int64) @ outcomes ** np.arange(means.shape[1], dtype=np.int64)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only, contiguous copy of `array`, or the array itself if it is contiguous."""
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


def _check_text(text: Any, what: str) -> None:
    fine = isinstance(text, str) and 0 < len(text) <= TEXT_MAX_CHARACTERS and text.isprintable()
    demand(fine, f"{what} is {ascii(text)[:80]}, allowed: 1 to {TEXT_MAX_CHARACTERS} printable characters")


def check_table_shape(shape: Sequence[int], n_features: int, n_classes: int, outcomes: int = 2) -> None:
    most = int(math.log(TABLE_ROWS_MAX, outcomes) + 1e-9)
    demand(n_features <= most, f"a table for {n_features} patterns, allowed at most {most} of {outcomes} readings each")
    found, wanted = tuple(shape), (outcomes**n_features, n_classes)
    demand(found == wanted, f"the table has shape {found}, allowed: ({outcomes}**d_f, classes) = {wanted}")


def _check_facts(bundle: Bundle) -> None:
    _check_text(bundle.name, "name")
    _check_text(bundle.task, "task")
    demand(bundle.encoder in ENCODERS, f"encoder is {ascii(bundle.encoder)[:80]}, allowed: {', '.join(ENCODERS)}")
    _check_outputs(bundle)
    counted = bundle.outcomes > 2 and (bundle.encoder != "active" or bundle.picture_shape is not None)
    demand(not counted, f"{bundle.outcomes} outcomes per exposure, allowed where fixed patterns decide among classes")
    shown = bundle.encoder in ("active", "automaton")
    demand(shown == (bundle.analyser is None), f"{bundle.encoder} optics, and an analyser or none")
    walks = bundle.automaton is not None
    demand((bundle.encoder == "automaton") == walks, f"encoder {bundle.encoder}, and an automaton or none")
    if shown:
        for name, allowed in RANGES.items():
            allowed.checked(getattr(bundle, name), name)
    else:
        dark = bundle.levels == 0 and bundle.photons_per_level == 0
        demand(dark, "a passive sensor has no projector: levels and photons_per_level are 0")


def _check_outputs(bundle: Bundle) -> None:
    """Classes, or a picture: one of them."""
    n_classes, picture = len(bundle.classes), bundle.picture_shape
    if picture is not None:
        fits = len(picture) == 2 and min(picture) > 0 and math.prod(picture) <= OUTPUTS_MAX
        demand(n_classes == 0, f"a picture and {n_classes} classes, allowed: either")
        by_head = bundle.table is None and bundle.int8_head is None
        demand(by_head, "a picture from a table or an int8 head, allowed: a head")
        demand(fits, f"picture_shape is {picture}, allowed: height and width, at most {OUTPUTS_MAX} pixels")
        return
    demand(2 <= n_classes <= CLASSES_MAX, f"{n_classes} classes, allowed: 2 to {CLASSES_MAX}")
    for name in bundle.classes:
        _check_text(name, "a class name")
    demand(len(set(bundle.classes)) == n_classes, "two classes have the same name, allowed: each name once")


def check_bundle(bundle: Bundle) -> None:
    """Raise ValueError at the first thing that is impossible in itself or does not fit the rest."""
    _check_facts(bundle)
    d_f, pixels = bundle.n_features, bundle.n_pixels
    height, width = bundle.image_shape
    if bundle.analyser is not None:
        demand(pixels == 0, f"{bundle.encoder} optics show no patterns, found {pixels} pixels of them")
        check_analyser(bundle.analyser)
        demand(bundle.analyser.kind == bundle.encoder, f"encoder {bundle.encoder}, analyser {bundle.analyser.kind}")
        seen, pixels = bundle.analyser.matrix.shape
        demand(seen == d_f, f"the matrix has {seen} rows for {d_f} detectors")
    clicks = "patterns" if bundle.automaton is None else "clicks of a walk"
    demand(1 <= d_f <= FEATURES_MAX, f"{d_f} {clicks}, allowed: 1 to {FEATURES_MAX}")
    demand(1 <= pixels <= PIXELS_MAX, f"{pixels} pixels, allowed: 1 to {PIXELS_MAX}")
    fits = height > 0 and width > 0 and height * width == pixels
    demand(fits, f"image_shape is {height}x{width}, but a pattern has {pixels} pixels")
    top = int(bundle.pattern_levels.max()) if bundle.analyser is None else -1
    demand(top < bundle.levels, f"a pattern level is {top}, allowed: 0 to {bundle.levels - 1}")
    _check_back_ends(bundle)
    _check_golden(bundle)


def _check_back_ends(bundle: Bundle) -> None:
    if bundle.automaton is not None:
        _check_automaton(bundle, bundle.automaton)
        return
    walks = bundle.golden_walks is not None or bundle.expected is not None
    demand(not walks, "golden walks or expected figures, and no automaton")
    decides = bundle.head_onnx is not None or bundle.table is not None
    demand(decides, "neither a head nor a table, allowed: either or both")
    for model, what in ((bundle.head_onnx, "head"), (bundle.int8_onnx, "int8 model")):
        if model is not None:
            size = len(model)
            demand(0 < size <= HEAD_MAX_BYTES, f"the {what} has {size} bytes, allowed: 1 to {HEAD_MAX_BYTES}")
            _check_cost(model, what, bundle)
    if bundle.int8_head is not None:
        _check_int8(bundle.int8_head, bundle.n_features, bundle.n_outputs)
    if bundle.table is not None:
        check_table_shape(bundle.table.shape, bundle.n_features, bundle.n_outputs, bundle.outcomes)
        demand(_finite(bundle.table), "the table holds scores that are not finite")


def check_pattern_cells(patterns: int, pixels: int) -> None:
    """Raise ValueError for more patterns of an automaton than memory should hold."""
    demand(patterns <= PATTERNS_MAX, f"{patterns} patterns of an automaton, allowed: 1 to {PATTERNS_MAX}")
    cells = patterns * pixels <= PATTERN_CELLS_MAX
    demand(cells, f"{patterns} patterns of {pixels} pixels, allowed: {PATTERN_CELLS_MAX} in all")


def _check_automaton(bundle: Bundle, automaton: Automaton) -> None:
    """What binds an automaton to its patterns and its classes."""
    others = (bundle.head_onnx, bundle.table, bundle.int8_head, bundle.int8_onnx, bundle.picture_shape)
    demand(all(part is None for part in others), "an automaton beside a head, a table or a picture, allowed: either")
    check_pattern_cells(*bundle.pattern_levels.shape)
    top = int(automaton.pattern.max()) + automaton.channels - 1
    demand(top < bundle.n_patterns, f"a state shows pattern {top}, allowed: 0 to {bundle.n_patterns - 1}")
    classes = automaton.n_classes
    demand(classes == bundle.n_classes, f"posteriors of {classes} classes, the bundle has {bundle.n_classes}")
    if bundle.expected is not None:
        check_expected(bundle.expected, automaton)


def _check_golden_walks(automaton: Automaton, bundle: Bundle) -> None:
    words, walks, most = bundle.golden_means, bundle.golden_walks, automaton.largest
    fits = bool(((words >= 0) & (words <= most) & (words == np.floor(words))).all())
    demand(fits, f"golden words hold other numbers than whole ones from 0 to {most}")
    if walks is None:
        raise ValueError("an automaton without golden walks")
    difference = walk_difference(automaton, words, walks)
    demand(not difference, difference)
    difference = golden_violation(log_scores(automaton.posteriors[walks[:, -1]]), bundle.golden_scores)
    demand(not difference, f"the leaves do not answer the golden words: {difference}")


def _check_cost(model: bytes, what: str, bundle: Bundle) -> None:
    try:
        cost = check_head(model, bundle.n_features, bundle.n_outputs)
    except ValueError as error:
        raise ValueError(f"the {what} cannot be used: {error}") from None
    work = cost.operations * len(bundle.golden_means)
    demand(work <= GOLDEN_WORK_MAX, f"{work} multiply-adds for the golden vectors, allowed: {GOLDEN_WORK_MAX}")


def _check_int8(head: Int8Head, n_features: int, n_classes: int) -> None:
    sizes = head.sizes.tolist()
    demand(2 <= len(sizes) <= LAYERS_MAX + 1, f"the int8 head has {len(sizes) - 1} layers, allowed: 1 to {LAYERS_MAX}")
    demand(min(sizes) >= 1, f"the int8 head has the sizes {sizes}, allowed: 1 or more")
    ends = (sizes[0], sizes[-1])
    demand(ends == (n_features, n_classes), f"the int8 head maps {ends}, allowed: {(n_features, n_classes)}")
    n_weights = sum(n_in * n_out for n_in, n_out in pairwise(sizes))
    demand(head.weights.shape == (n_weights,), f"the int8 head has {head.weights.size} weights, needs {n_weights}")
    demand(int(head.weights.min()) >= -WEIGHT_MAX, f"an int8 weight is below -{WEIGHT_MAX}")
    wanted = (2, sum(sizes[1:]))
    demand(head.affine.shape == wanted, f"int8_affine has shape {head.affine.shape}, allowed: {wanted}")
    fits = float(head.affine.min()) >= -AFFINE_MAX and float(head.affine.max()) <= AFFINE_MAX  # a NaN is both
    demand(fits, f"the int8 head holds scales beyond {AFFINE_MAX:g}")
    # a sum of integers stays exact: the kernel adds in int32
    largest = max(n_in for n_in in sizes[1:-1]) * STEP_MAX * WEIGHT_MAX if len(sizes) > 2 else 0
    demand(largest < 1 << 31, f"an int8 layer of {max(sizes[1:])} inputs could leave int32")


def _finite(scores: NDArray[np.float32]) -> bool:
    return bool(np.isfinite(scores.min()) and np.isfinite(scores.max()))  # a NaN is minimum and maximum


def _check_golden(bundle: Bundle) -> None:
    means, scores = bundle.golden_means, bundle.golden_scores
    count = means.shape[0]
    demand(1 <= count <= GOLDEN_MAX, f"{count} golden vectors, allowed: 1 to {GOLDEN_MAX}")
    fits = means.shape == (count, bundle.n_features)
    demand(fits, f"golden_means has shape {means.shape}, d_f is {bundle.n_features}")
    wanted = (count, bundle.n_outputs)
    demand(scores.shape == wanted, f"golden_scores has shape {scores.shape}, allowed: {wanted}")
    for what, array, most in (("means", means, GOLDEN_MEANS_MAX), ("scores", scores, GOLDEN_SCORES_MAX)):
        demand(array.size <= most, f"golden_{what} holds {array.size} numbers, allowed at most {most}")
    if bundle.automaton is None:
        demand(bool(((means >= 0) & (means <= 1)).all()), "golden_means leaves [0, 1]")
    demand(_finite(scores), "the golden scores are not finite (does the head answer NaN?)")
    if bundle.automaton is not None:
        _check_golden_walks(bundle.automaton, bundle)
    if bundle.table is not None:
        single, rows = words_among(means, bundle.outcomes)
        difference = golden_violation(bundle.table[rows], scores[single])
        demand(not difference, f"the table does not answer the golden vectors: {difference}")


def check_expected(expected: Mapping[str, Any], automaton: Automaton) -> None:
    """Raise ValueError for figures that are not in range or that no walk of `automaton` can have."""
    keys = f"expected has the keys {ascii(sorted(expected))[:200]}, needed: {EXPECTED_KEYS}"
    demand(set(expected) - set(EXPECTED_LATER) == set(EXPECTED_KEYS), keys)
    for name in _TEXTS:
        _check_text(expected[name], f"expected.{name}")
    for name, allowed in (EXPECTED_RANGES | EXPECTED_LATER).items():
        if name in expected:
            allowed.checked(expected[name], f"expected.{name}")
    exposures, clicks, slack = float(expected["exposures"]), float(expected["clicks"]), 1 + 1e-9  # rounded sums
    slots, most = automaton.n_slots, exposures * automaton.largest * automaton.channels
    demand(exposures <= slots * slack, f"expected.exposures is {exposures:g} of {slots} at most")
    demand(clicks <= most * slack, f"expected.clicks is {clicks:g} of {exposures:g} exposures")


def expected_differences(kept: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """Return which figures of a bundle's `expected` are others now; those of other conditions cannot be compared, and give none."""
    if any(kept[name] != found[name] for name in EXPECTED_KEYS[:4]):
        return []
    return [
        f"expected {name} is {kept[name]:.9g} in the bundle, {found[name]:.9g} here"
        for name in (*EXPECTED_KEYS[4:], *EXPECTED_LATER)
        if name in kept
        and not math.isclose(kept[name], found[name], rel_tol=EXPECTED_TOLERANCE, abs_tol=EXPECTED_TOLERANCE)
    ]
