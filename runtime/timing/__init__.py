"""Time on the host: the device's clock, latency per stage, why work was late, and a processor that does not fall asleep.

Device ticks and host times come in; host times with their uncertainty, latencies and causes go out. Begin with `clock.py`.

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
from .cpu import busy_core
from .evidence import Attribution, Evidence, Incidents
from .ledger import LatencyHistogram, TimingLedger, arm_realtime, frozen_heap
from .page_faults import ThreadCounts

__all__ = [
    "Attribution",
    "ClockModel",
    "Evidence",
    "Incidents",
    "LatencyHistogram",
    "ThreadCounts",
    "TimingLedger",
    "arm_realtime",
    "busy_core",
    "frozen_heap",
]
