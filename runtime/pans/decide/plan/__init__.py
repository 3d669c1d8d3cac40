"""What will be exposed: slots, patterns, objects and shots; and whether a bundle fits a profile.

plan.py checks that a bundle fits the profile: pattern memory, pixels, levels, mode. plan_codec.py packs a plan into commands.

>>> from pans.bundle.sensor import load_bundle
>>> from pans.decide.plan import build_plan
>>> from pans.instrument.profile import load_profile
>>> plan = build_plan(load_profile("oled-qcmos"), load_bundle("fashion10")[0], shots_per_object=2)
>>> plan.n_patterns, plan.shots_per_object
(10, 2)
"""

from .marks import mark_of, unknown_photons
from .plan import NO_SHOT, Cycle, Plan, build_plan, detector_warnings, exposure_us, lay_out, ticks_of
from .plan_codec import drive_words, plan_chunks, plan_commands, plan_from_chunks, reading_of

__all__ = [
    "NO_SHOT",
    "Cycle",
    "Plan",
    "build_plan",
    "detector_warnings",
    "drive_words",
    "exposure_us",
    "lay_out",
    "mark_of",
    "plan_chunks",
    "plan_commands",
    "plan_from_chunks",
    "reading_of",
    "ticks_of",
    "unknown_photons",
]
