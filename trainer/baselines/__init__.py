"""The alternatives to trained patterns at equal photons: direct imaging, compressive sensing, conventional end-to-end, exact Bayes.

Owns how photons are dealt out and detected for all of them, their networks, and one row of figures per photon level; never trains a
model of ours. All figures are SIMULATED.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .options import BaselineOptions
    from .rows import baseline_rows

__all__ = ["BaselineOptions", "baseline_rows"]

__getattr__ = lazy_names(
    __name__,
    {
        "BaselineOptions": ".options",
        "baseline_rows": ".rows",
    },
)
