"""Numbers that are checked or uncertain: allowed ranges, confidence intervals and tests; the table of a run's figures.

>>> from pans.base.numbers import wilson_interval
>>> [round(bound, 3) for bound in wilson_interval(8, 10)]
[0.49, 0.943]
"""

from .denominators import GROUPS, group_of, group_words
from .figures import (
    FIGURES,
    LIGHT,
    DecisionFigures,
    Figure,
    Part,
    Shown,
    Words,
    decision_figures,
    keys_of,
    live_figures,
    shown,
)
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
from .ranges import AMOUNT, COUNT, END_OF_INTERVAL, FINITE, SHARE, WHOLE, Each, Range, demand, number_text

__all__ = [
    "AMOUNT",
    "CHI2_95",
    "COUNT",
    "END_OF_INTERVAL",
    "FIGURES",
    "FINITE",
    "GROUPS",
    "LIGHT",
    "QUANTILES",
    "SHARE",
    "WHOLE",
    "Z_95",
    "DecisionFigures",
    "Each",
    "Figure",
    "Part",
    "Range",
    "Shown",
    "Words",
    "beta_quantile",
    "binomial_tail",
    "bisect",
    "chi2_quantile",
    "chi2_tail",
    "decision_figures",
    "demand",
    "group_of",
    "group_words",
    "has_quantile",
    "jeffreys_interval",
    "keys_of",
    "live_figures",
    "number",
    "number_text",
    "shown",
    "wilson_interval",
]
