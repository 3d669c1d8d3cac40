"""From clicks to a label and its probability, or to a picture: the back ends behind one call, `make_decider`.

A back end answers the bundle's golden vectors before it answers anything else. Scores that are not finite come back with probability 0.
Start with verdict.py (the answer on one object: `Decider`, `Verdict`; the verdict of a run is in report), then backends.py. A new back end
is a file here, a name in `BACKENDS` and a line in `_make` of backends.py, one in `_choose` if `auto` may choose it, and one in
bench/decide.py; one of another package is an entry point (`pans.backends`).

>>> import numpy as np
>>> from pans.runtime.bundle import BackEnd, Shown, make_bundle
>>> from pans.runtime.decide import make_decider
>>> bundle = make_bundle(
...     name="two", task="left or right", classes=("left", "right"), image_shape=(1, 2), provenance={},
...     optics=Shown(levels=2, pattern_levels=[[1, 0], [0, 1]], photons_per_level=3.0),
...     back_end=BackEnd(table=[[0, 0], [2, 0], [0, 2], [0, 0]]),
... )
>>> decider = make_decider(bundle, backend="table")
>>> decider.decide(np.array([0, 1]), shots=1).label
1
>>> decider.decide_batch([[1, 0], [0, 1]], 1).tolist()
[0, 1]
"""

from .backends import BACKENDS, backend_names, make_decider
from .verdict import Decider, Verdict, Verdicts

__all__ = ["BACKENDS", "Decider", "Verdict", "Verdicts", "backend_names", "make_decider"]
