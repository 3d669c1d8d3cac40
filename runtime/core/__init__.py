"""The decisions on objects that stand still: a plan, its windows of shots, one message in, decisions and events out.

In come a profile, a bundle and stream messages; out come a `Plan` (`build_plan`) and the outputs of a `Core`. There is no input or
output, no clock and no random number, so that a live run, a replay and a simulation give the same decisions bit for bit. Start with
plan.py, then follower.py (what every core does with a stream) and still.py. Objects in flow are in the package flow.

plan.py checks that a bundle fits the profile: pattern memory, pixels, levels, mode. follower.py says what happens behind a gap (`step`,
`_skip_to`): wire/tracker.py only finds it, window.py knows the windows that it broke, still.py flags them and abstains. The kernels
(stream_kernels.py) never see a gap: they leave the message to `step`.

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
