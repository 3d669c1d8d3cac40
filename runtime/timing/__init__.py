"""Time on the host: the device's clock, latency per stage, what made work late, and a processor that does not fall asleep.

Owns the conversion of device ticks to host time with its uncertainty, the ledger of latencies, and the attribution of late and missing work
to link, device, host, garbage collection, disk or inference. It acts on nothing: live asks and reports.

>>> from pans.runtime.timing import TimingLedger
>>> ledger = TimingLedger(deadline_ns=1_000_000)
>>> ledger.judge((0, 200_000, 250_000, 1_300_000, 1_350_000), uncertainty_ns=10_000)  # ended, arrived, decoded, decided, recorded
True
>>> ledger.blame
{'decide': 1}
"""

from .attribution import Incidents, LateAttribution, MissingAttribution
from .clock import ClockModel
from .cpu import busy_core
from .evidence import Evidence
from .ledger import LatencyHistogram, TimingLedger, arm_realtime, frozen_heap
from .page_faults import ThreadCounts

__all__ = [
    "ClockModel",
    "Evidence",
    "Incidents",
    "LateAttribution",
    "LatencyHistogram",
    "MissingAttribution",
    "ThreadCounts",
    "TimingLedger",
    "arm_realtime",
    "busy_core",
    "frozen_heap",
]
