"""The deterministic core for objects that stand still: plan, windows of shots, one frame in, decisions out.

Owns what is exposed when, which exposures belong to which decision, what a gap does to it, and what the state of the detector does to it.
It does no input or output, reads no clock and draws no random number, so that a live run, a replay and a simulation give the same
decisions bit for bit. Objects in flow are handled by the package flow, which builds on this package.

>>> from importlib.resources import files
>>> from pans.runtime.bundle import load_bundle
>>> from pans.runtime.core import build_plan
>>> from pans.runtime.instrument import load_profile
>>> bundle, _ = load_bundle(files("pans.runtime") / "shipped" / "fashion10.pans")
>>> plan = build_plan(load_profile("oled-qcmos"), bundle, shots_per_object=2)
>>> plan.n_patterns, plan.shots_per_object
(10, 2)
"""

from .dark_guard import DarkGuard
from .decision import NO_LABEL, Action, Decision, DecisionFlag, Output, Passage
from .follower import Follower
from .plan import Plan, build_plan
from .still import Core

__all__ = [
    "NO_LABEL",
    "Action",
    "Core",
    "DarkGuard",
    "Decision",
    "DecisionFlag",
    "Follower",
    "Output",
    "Passage",
    "Plan",
    "build_plan",
]
