"""Above, level or below: whether a difference of two figures exceeds twice their combined standard error.

Owns the rule and the errors that enter it; never measures. Which error belongs to which comparison is written once, in
docs/results/README.md ("Above, level, below"). Accuracies are in percent, errors and differences in points.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

ABOVE, LEVEL, BELOW = "above", "level", "below"
VERDICTS = (ABOVE, LEVEL, BELOW)
ERRORS = 2.0  # combined standard errors that a difference must exceed


@dataclass(frozen=True, slots=True)
class Claim:
    """What one column of a table says: each row of `ours` against `beside`; a verdict of None is a comparison that was not made."""

    ours: str
    beside: str
    verdicts: tuple[str, ...]

    def counts(self) -> tuple[int, int, int]:
        """Return how many are above, level and below."""
        above, level, below = (self.verdicts.count(one) for one in VERDICTS)
        return above, level, below

    def line(self) -> str:
        """Return the counts as a sentence.

        >>> Claim("ours", "the paper", ("level", "above", "level")).line()
        'ours against the paper: 1 above, 2 level, 0 below, of 3.'
        """
        above, level, below = self.counts()
        return (
            f"{self.ours} against {self.beside}: {above} above, {level} level, {below} below, of {len(self.verdicts)}."
        )


def claim(ours: str, beside: str, compared: Iterable[dict[str, Any] | None]) -> Claim:
    """Return the claim of comparisons as `against` gives them; those that are None were not made."""
    return Claim(ours, beside, tuple(found["verdict"] for found in compared if found is not None))


def verdict(ahead: float, error: float) -> str:
    """Return above or below where a difference exceeds twice its standard error, else level.

    >>> verdict(2.1, 1.0), verdict(2.0, 1.0), verdict(-2.1, 1.0)
    ('above', 'level', 'below')
    """
    if abs(ahead) <= ERRORS * error:
        return LEVEL
    return ABOVE if ahead > 0 else BELOW


def against(ours: float, theirs: float, *errors: float) -> dict[str, Any]:
    """Return `ahead`, `error` (the independent `errors` of both sides, added in squares) and `verdict` of one comparison."""
    ahead, error = ours - theirs, math.hypot(*errors)
    return {"ahead": ahead, "error": error, "verdict": verdict(ahead, error)}


def sampling_error(percent: float, objects: int) -> float:
    """Return the binomial standard error of an accuracy on so many objects, in points: of a figure that was printed without one.

    It is that of a single trial, so that it holds the noise of trials too, and bounds the error of a mean over trials from above.

    >>> round(sampling_error(74.31, 200), 2)
    3.09
    """
    share = percent / 100
    return 100 * math.sqrt(share * (1 - share) / objects)


def training_spread(values: Sequence[float]) -> float:
    """Return the spread of one training where there are several, else 0: with one seed it is not known."""
    return statistics.stdev(values) if len(values) > 1 else 0.0
