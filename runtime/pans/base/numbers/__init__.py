"""Numbers that are checked or uncertain: allowed ranges, confidence intervals and tests.

>>> from pans.base.numbers import wilson_interval
>>> [round(bound, 3) for bound in wilson_interval(8, 10)]
[0.49, 0.943]
"""

from .denominators import GROUPS, group_of, group_words
from .intervals import (
    CHI2_95,
    QUANTILES,
    Z_95,
    beta_quantile,
    binomial_tail,
    bisect,
    chi2_quantile,
    chi2_tail,
    has_quantile,
    jeffreys_interval,
    number,
    wilson_interval,
)
from .ranges import FINITE, WHOLE, Range, demand, number_text

__all__ = [
    "CHI2_95",
    "FINITE",
    "GROUPS",
    "QUANTILES",
    "WHOLE",
    "Z_95",
    "Range",
    "beta_quantile",
    "binomial_tail",
    "bisect",
    "chi2_quantile",
    "chi2_tail",
    "demand",
    "group_of",
    "group_words",
    "has_quantile",
    "jeffreys_interval",
    "number",
    "number_text",
    "wilson_interval",
]
