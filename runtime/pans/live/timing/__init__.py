"""Time in a run: latencies of its stages, deadlines, and the causes of late decisions.

Start at ledger.py.

>>> import numpy as np
>>> from pans.live.timing import TimingLedger
>>> ledger = TimingLedger(deadline_ns=1_000_000)
>>> marks_ns = np.array([[0, 200_000, 250_000, 1_300_000, 1_350_000]])  # ended, arrived, decoded, decided, recorded
>>> ledger.judge(marks_ns, np.array([10_000]), np.array([1])).tolist()
[True]
>>> ledger.blame
{'decide': 1}
"""

from .causes import IDLE, OVERSLEPT, Facts, Verdict
from .ledger import STAGES, LatencyHistogram, TimingLedger, quantiles_us, upper_edge

__all__ = [
    "IDLE",
    "OVERSLEPT",
    "STAGES",
    "Facts",
    "LatencyHistogram",
    "TimingLedger",
    "Verdict",
    "quantiles_us",
    "upper_edge",
]
