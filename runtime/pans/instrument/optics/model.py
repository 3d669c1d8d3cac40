"""The facts of one optical table, how far each of them may be off, and how `--optics` spells both.

`imaging_of` reads one truth, `tolerance_of` a tolerance, written as `key=value` separated by colons. ValueError says what was found
and what is allowed.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import Range, demand

SHIFT_PX = Range(-1e4, 1e4)
ROTATION_DEG = Range(-360.0, 360.0)
SCALE = Range(0.1, 10.0)
PSF_PX = Range(0.0, 1e3)
BLACK = Range(0.0, 1.0)
GAIN = Range(0.0, 1e6)
FLAT_MEAN_TOLERANCE = 1e-6
FLAT_PIXELS_MAX = 1 << 22

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Imaging:
    """How an object appears on the pattern grid; lengths are object pixels. ValueError for what is out of range.

    The object is magnified by `scale` and turned counter-clockwise, as seen on screen, by `rotation_deg` about the centre of the grid,
    moved by (`right_px`, `down_px`), and blurred by a Gaussian of standard deviation `psf_px`. `flat` is the light of every pattern
    pixel over the mean of all, float64 (rows, columns) of mean 1. `black` is the light of a dark pattern pixel over that of a full
    one. `gain` multiplies all light.
    """

    right_px: float = 0.0
    down_px: float = 0.0
    rotation_deg: float = 0.0
    scale: float = 1.0
    psf_px: float = 0.0
    black: float = 0.0
    gain: float = 1.0
    flat: F64 | None = None

    def __post_init__(self) -> None:
        for name, allowed in _RANGES.items():
            allowed.checked(getattr(self, name), name)
        demand(self.gain > 0, "gain is 0, allowed: above 0")
        demand(self.black < 1, "black is 1, allowed: below 1 (a dark pixel would be as bright as a full one)")
        if self.flat is not None:
            object.__setattr__(self, "flat", checked_flat(self.flat))

    @property
    def in_place(self) -> bool:
        """Whether the object meets the pattern grid pixel by pixel, without blur."""
        return not (self.right_px or self.down_px or self.rotation_deg or self.psf_px) and self.scale == 1.0

    @property
    def is_identity(self) -> bool:
        """Whether nothing differs from perfect optics."""
        return self.in_place and self.black == 0.0 and self.gain == 1.0 and self.flat is None

    def words(self) -> str:
        """Return the facts that differ from perfect optics, in words."""
        if self.is_identity:
            return "perfect optics"
        said = [f"{name} {value:g}" for name, value in self.numbers().items() if value != getattr(IDENTITY, name)]
        return ", ".join([*said, *(["flat field"] if self.flat is not None else [])])

    def numbers(self) -> dict[str, float]:
        """Return every fact but the flat field, by name."""
        return {name: float(getattr(self, name)) for name in _RANGES}


def checked_flat(flat: F64) -> F64:
    """Return a read-only float64 copy of a flat field (rows, columns); ValueError unless finite, at least 0 and of mean 1."""
    field = np.array(flat, np.float64)
    demand(field.ndim == 2 and 0 < field.size <= FLAT_PIXELS_MAX, f"flat is {field.shape}, allowed: (rows, columns)")
    demand(
        bool(np.isfinite(field).all() and (field >= 0).all()),
        "flat holds numbers below 0 or not finite, allowed: 0 and above",
    )
    mean = float(field.mean())
    demand(abs(mean - 1) <= FLAT_MEAN_TOLERANCE, f"flat has the mean {mean:.9g}, allowed: 1")
    field.flags.writeable = False
    return field


_RANGES = {
    "right_px": SHIFT_PX,
    "down_px": SHIFT_PX,
    "rotation_deg": ROTATION_DEG,
    "scale": SCALE,
    "psf_px": PSF_PX,
    "black": BLACK,
    "gain": GAIN,
}
IDENTITY = Imaging()
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """From where to where every fact may lie, (low, high); a draw takes each of them uniformly and by itself."""

    right_px: Span = (0.0, 0.0)
    down_px: Span = (0.0, 0.0)
    rotation_deg: Span = (0.0, 0.0)
    scale: Span = (1.0, 1.0)
    psf_px: Span = (0.0, 0.0)
    black: Span = (0.0, 0.0)
    gain: Span = (1.0, 1.0)

    def __post_init__(self) -> None:
        for name in _RANGES:
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} is {low:g}..{high:g}, allowed: the lower one first")
        for place in (0, 1):
            self._at(operator.itemgetter(place))  # the ranges of a single table

    @property
    def middle(self) -> Imaging:
        """The optics in the middle of every span."""
        return self._at(lambda span: (span[0] + span[1]) / 2)

    def draw(self, random: np.random.Generator) -> Imaging:
        """Return optics drawn uniformly within the tolerance."""
        return self._at(lambda span: float(random.uniform(*span)))

    def edges(self) -> list[Imaging]:
        """Return the corners of shift and rotation where every other fact is at its high end: up to 8 optics."""
        moved = ("right_px", "down_px", "rotation_deg")
        ends = itertools.product(*(sorted(set(getattr(self, name))) for name in moved))
        worst = self._at(lambda span: span[1])
        return [replace(worst, **dict(zip(moved, corner))) for corner in ends]

    def as_dict(self) -> dict[str, list[float]]:
        """Return every span by name, as lists for JSON."""
        return {name: [low, high] for name, (low, high) in self._spans()}

    def words(self) -> str:
        """Return every span that is not perfect, in words."""
        perfect = Tolerance()
        said = [
            f"{name} {low:g}" + (f" to {high:g}" if high > low else "")
            for name, (low, high) in self._spans()
            if (low, high) != getattr(perfect, name)
        ]
        return ", ".join(said) or "perfect optics"

    def spelled(self) -> str:
        """Return the tolerance as `--optics` spells it; `tolerance_of` reads it back."""
        right, down, turn, scale, psf, black, gain = (f"{low!r}..{high!r}" for _, (low, high) in self._spans())
        return f"shift={right},{down}:rotate={turn}:scale={scale}:psf={psf}:black={black}:gain={gain}"

    def _spans(self) -> list[tuple[str, Span]]:
        return [(name, getattr(self, name)) for name in _RANGES]

    def _at(self, place: Callable[[Span], float]) -> Imaging:
        facts: dict[str, Any] = {name: place(span) for name, span in self._spans()}
        return Imaging(**facts)


# the facts of each key of `--optics`, and from where a tolerance goes to either side; without it, a value is the fact itself
_FACTS = {
    "shift": ("right_px", "down_px"),
    "rotate": ("rotation_deg",),
    "scale": ("scale",),
    "psf": ("psf_px",),
    "black": ("black",),
    "gain": ("gain",),
}
_ABOUT = {"shift": 0.0, "rotate": 0.0, "scale": 1.0, "gain": 1.0}
TEXT_MAX = 400


def is_spec(text: str) -> bool:
    """Whether `text` is written as optics, rather than as the name of a file or bundle."""
    key, equals, _ = text.partition("=")
    return key in _FACTS and bool(equals)


def imaging_of(text: str, about: Imaging = IDENTITY) -> Imaging:
    """Return the optics that `text` states, such as `shift=0.7,0.3:rotate=1.5:psf=0.7:black=0.002:gain=5%`.

    `shift` is right and down; `scale` and `gain` are factors, or with % what is added to 1. What is not stated is as in `about`.

    >>> imaging_of("shift=0.7,0.3:gain=5%").words()
    'right_px 0.7, down_px 0.3, gain 1.05'
    """
    facts: dict[str, Any] = {name: _value(word, key) for key, name, word in _stated(text)}
    return replace(about, **facts)


def tolerance_of(text: str) -> Tolerance:
    """Return the tolerance that `text` states, such as `shift=1:rotate=2:psf=0.5..0.8:black=0.002`.

    `shift`, `rotate`, `scale` and `gain` say by how much they may be off to either side, `psf` and `black` a value or a span. Every
    key takes a span LOW..HIGH, `shift` one for right and down alike.

    >>> tolerance_of("shift=1:psf=0.5..0.8").psf_px
    (0.5, 0.8)
    """
    return Tolerance(**{name: _span(word, key) for key, name, word in _stated(text, alike=True)})


def _stated(text: str, *, alike: bool = False) -> list[tuple[str, str, str]]:
    """Return (key, fact, word) of all that `text` states; `alike`: one word of `shift` is for right and down."""
    if not text or len(text) > TEXT_MAX:
        raise ValueError(f"optics of {len(text)} characters, allowed: 1 to {TEXT_MAX}, such as shift=0.7,0.3:psf=0.7")
    found: dict[str, list[tuple[str, str, str]]] = {}
    for part in text.split(":"):
        key, _, value = part.partition("=")
        if key not in _FACTS or not value:
            raise ValueError(f"optics: {ascii(part)[:60]}, allowed: KEY=VALUE with the keys {', '.join(_FACTS)}")
        if key in found:
            raise ValueError(f"optics: {key} is given twice, allowed: once")
        words, names = value.split(","), _FACTS[key]
        if alike and len(words) == 1:
            words *= len(names)
        if len(words) != len(names):
            form = "shift=RIGHT,DOWN" + (" or shift=PX" if alike else "") if key == "shift" else f"{key}=NUMBER"
            raise ValueError(f"optics: {part[:60]}, allowed: {form}")
        found[key] = [(key, name, word) for name, word in zip(names, words)]
    return [one for several in found.values() for one in several]


def _number(text: str, key: str) -> float:
    """The number that `text` states; of factors, with % a hundredth of it."""
    percent = text.endswith("%") and key in ("scale", "gain")
    try:
        value = float(text.removesuffix("%") if percent else text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise ValueError(f"optics: {key} has {ascii(text)[:60]}, allowed: a finite number")
    return value / 100 if percent else value


def _value(text: str, key: str) -> float:
    return _number(text, key) + (1.0 if text.endswith("%") else 0.0)


def _span(text: str, key: str) -> Span:
    """The span of `LOW..HIGH`, of a number to either side, or of one value where the key has no middle."""
    low, dots, high = text.partition("..")
    if dots:
        return _value(low, key), _value(high, key)
    if key not in _ABOUT:
        return _value(text, key), _value(text, key)
    off = abs(_number(text, key))
    return _ABOUT[key] - off, _ABOUT[key] + off
