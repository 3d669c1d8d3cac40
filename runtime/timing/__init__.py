"""Time on the host: the device's clock, latencies and why work was late, and a process that runs on time.

Device ticks and host times come in; host times with their uncertainty, latencies and causes go out. Start with `clock.py`.

>>> import numpy as np
>>> from pans.runtime.timing import TimingLedger
>>> ledger = TimingLedger(deadline_ns=1_000_000)
>>> marks_ns = np.array([[0, 200_000, 250_000, 1_300_000, 1_350_000]])  # ended, arrived, decoded, decided, recorded
>>> ledger.judge(marks_ns, np.array([10_000]), np.array([1])).tolist()
[True]
>>> ledger.blame
{'decide': 1}
"""

from .clock import ClockModel
from .ledger import LatencyHistogram, TimingLedger

__all__ = ["ClockModel", "LatencyHistogram", "TimingLedger"]
