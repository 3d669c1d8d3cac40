"""The alternatives to trained patterns at equal photons: direct imaging, compressive sensing, conventional end-to-end, exact Bayes.

A task and photon levels come in, one row of figures per level goes out. Start with `rows.py`; light, detection and score are in
`common.py`. All figures are SIMULATED.
"""

from .rows import baseline_rows

__all__ = ["baseline_rows"]
