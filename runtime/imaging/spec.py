"""The spelling of `--optics`: one table of facts, or how far each of them may be off.

Owns the grammar, `key=value` separated by colons, and the draws within a tolerance; ValueError for what cannot be meant, with what is
allowed. `imaging_of` reads one truth, `tolerance_of` a tolerance.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .model import IDENTITY, Imaging

KEYS = ("shift", "rotate", "scale", "psf", "black", "gain")
TEXT_MAX = 400
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
        for name in _NAMES:
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} is {low:g}..{high:g}, allowed: the lower one first")
        for place in (0, 1):
            _imaging({name: getattr(self, name)[place] for name in _NAMES})  # the ranges of a single table

    @property
    def middle(self) -> Imaging:
        """The optics in the middle of every span."""
        return _imaging({name: (low + high) / 2 for name, (low, high) in self._spans()})

    @property
    def is_exact(self) -> bool:
        """Whether nothing is left to chance."""
        return all(low == high for _, (low, high) in self._spans())

    def draw(self, random: np.random.Generator) -> Imaging:
        """Return optics drawn uniformly within the tolerance."""
        return _imaging({name: float(random.uniform(low, high)) for name, (low, high) in self._spans()})

    def edges(self) -> list[Imaging]:
        """Return the corners of shift and rotation where every other fact is at its high end: up to 8 optics."""
        moved = ("right_px", "down_px", "rotation_deg")
        ends = itertools.product(*(sorted(set(getattr(self, name))) for name in moved))
        worst = _imaging({name: high for name, (_, high) in self._spans()})
        return [_imaging(dict(zip(moved, corner)), worst) for corner in ends]

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
        return [(name, getattr(self, name)) for name in _NAMES]


_NAMES = ("right_px", "down_px", "rotation_deg", "scale", "psf_px", "black", "gain")


def _imaging(facts: Mapping[str, Any], about: Imaging = IDENTITY) -> Imaging:
    return replace(about, **facts)


def is_spec(text: str) -> bool:
    """Whether `text` is written as optics, rather than as the name of a file or bundle."""
    return text.partition("=")[0] in KEYS and "=" in text


def imaging_of(text: str, about: Imaging = IDENTITY) -> Imaging:
    """Return the optics that `text` states, such as `shift=0.7,0.3:rotate=1.5:psf=0.7:black=0.002:gain=5%`.

    `shift` is right and down; `scale` and `gain` are factors, or with % what is added to 1. What is not stated is as in `about`.

    >>> imaging_of("shift=0.7,0.3:gain=5%").words()
    'right_px 0.7, down_px 0.3, gain 1.05'
    """
    words = _words(text)
    facts: dict[str, float] = {}
    for key, value in words.items():
        if key == "shift":
            right, down = _pair(value, key, "shift=RIGHT,DOWN")
            facts |= {"right_px": right, "down_px": down}
        elif key in _FACTORS:
            facts[key] = _factor(value, key)
        else:
            facts[_FACTS[key]] = _number(value, key)
    return _imaging(facts, about)


def tolerance_of(text: str) -> Tolerance:
    """Return the tolerance that `text` states, such as `shift=1:rotate=2:psf=0.5..0.8:black=0.002`.

    `shift`, `rotate`, `scale` and `gain` say by how much they may be off to either side, `psf` and `black` a value or a span. Every
    key takes a span LOW..HIGH, `shift` one for right and down alike.

    >>> tolerance_of("shift=1:psf=0.5..0.8").psf_px
    (0.5, 0.8)
    """
    spans: dict[str, Span] = {}
    for key, value in _words(text).items():
        if key == "shift":
            parts = value.split(",") if "," in value else [value, value]
            if len(parts) != 2:
                raise ValueError(f"shift={value}, allowed: shift=PX, or shift=RIGHT,DOWN")
            spans["right_px"], spans["down_px"] = (_span(part, key, about=0.0) for part in parts)
        else:
            about = {"rotate": 0.0, "scale": 1.0, "gain": 1.0}.get(key)
            spans[_FACTS.get(key, key)] = _span(value, key, about)
    return Tolerance(**spans)


_FACTS: Mapping[str, str] = {"rotate": "rotation_deg", "psf": "psf_px", "black": "black"}
_FACTORS = ("scale", "gain")


def _words(text: str) -> dict[str, str]:
    if not text or len(text) > TEXT_MAX:
        raise ValueError(f"optics of {len(text)} characters, allowed: 1 to {TEXT_MAX}, such as shift=0.7,0.3:psf=0.7")
    found: dict[str, str] = {}
    for part in text.split(":"):
        key, equals, value = part.partition("=")
        if key not in KEYS or not equals or not value:
            raise ValueError(f"optics: {ascii(part)[:60]}, allowed: KEY=VALUE with the keys {', '.join(KEYS)}")
        if key in found:
            raise ValueError(f"optics: {key} is given twice, allowed: once")
        found[key] = value
    return found


def _pair(value: str, key: str, form: str) -> tuple[float, float]:
    parts = value.split(",")
    if len(parts) != 2:
        raise ValueError(f"optics: {key}={value[:60]}, allowed: {form}")
    return _number(parts[0], key), _number(parts[1], key)


def _number(text: str, key: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise ValueError(f"optics: {key} has {ascii(text)[:60]}, allowed: a finite number")
    return value


def _factor(text: str, key: str) -> float:
    return 1 + _number(text[:-1], key) / 100 if text.endswith("%") else _number(text, key)


def _span(text: str, key: str, about: float | None) -> Span:
    """The span of `LOW..HIGH`, of `about` plus or minus a number, or of one value where it is about nothing."""
    low, dots, high = text.partition("..")
    if dots:
        return (_factor(low, key), _factor(high, key)) if key in _FACTORS else (_number(low, key), _number(high, key))
    if about is None:
        return _number(text, key), _number(text, key)
    off = abs(_number(text[:-1], key) / 100 if text.endswith("%") and key in _FACTORS else _number(text, key))
    return about - off, about + off
