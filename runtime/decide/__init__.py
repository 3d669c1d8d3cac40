"""From clicks to a label and its probability, or to a picture: the back ends behind one call, `make_decider`.

A back end answers the bundle's golden vectors before it answers anything else. Scores that are not finite come back with probability 0.
Start with verdict.py (the answer on one object: `Decider`, `Verdict`; the verdict of a run is in report), then backends.py. A new back end
is a file here, a name in `BACKENDS` and a line in `_make` of backends.py, and one in `_choose` if `auto` may choose it; one of another
package is an entry point (`pans.backends`).

>>> import numpy as np
>>> from pans.runtime.bundle import load_bundle
>>> from pans.runtime.decide import make_decider
>>> decider = make_decider(load_bundle("fashion10")[0], backend="table")
>>> decider.decide(np.array([1, 0] * 5), shots=1).label == int(decider.decide_batch([[1, 0] * 5], 1)[0])
True
"""

from .backends import BACKENDS, backend_names, make_decider
from .verdict import Decider, Verdict, Verdicts

__all__ = ["BACKENDS", "Decider", "Verdict", "Verdicts", "backend_names", "make_decider"]
