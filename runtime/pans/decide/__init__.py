"""The deterministic core: stream messages in, rows of decisions out; no random number, and in `kernel` alone a clock and a descriptor.

In: a profile and a bundle (`build_plan`), then messages. Out: decisions, events and the alarms of dark counts.
A live run, a replay and a simulation give the same decisions bit for bit.
Other rooms import plan, still, flow, kernel, dark, and from here what all cores share (`Decision`, `Follower`).
Start at plan/plan.py, then follower.py (what every core does with a stream), still/core.py and flow/core.py.
"""

import sys
from types import ModuleType

from pans.bundle.backends import decide_clicks

from .decision import (
    DECISION_DTYPE,
    RUN_DTYPE,
    VERDICT_DTYPE,
    VERDICT_FIELDS,
    Action,
    CoreEvent,
    Decision,
    DecisionFlag,
    Output,
    Passage,
    RowDecisions,
    is_decided,
    is_judged,
    rows_of,
)
from .follower import Follower, Place, Standing, exposure_timing

__all__ = [
    "DECISION_DTYPE",
    "RUN_DTYPE",
    "VERDICT_DTYPE",
    "VERDICT_FIELDS",
    "Action",
    "CoreEvent",
    "Decision",
    "DecisionFlag",
    "Follower",
    "Output",
    "Passage",
    "Place",
    "RowDecisions",
    "Standing",
    "exposure_timing",
    "is_decided",
    "is_judged",
    "rows_of",
]


class _Room(ModuleType):
    """`pans.decide` is this room, and the public call has the same name: `pans.decide(bundle, clicks)`."""

    __call__ = staticmethod(decide_clicks)


sys.modules[__name__].__class__ = _Room
