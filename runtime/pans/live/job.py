"""What is to be done in a run."""

from __future__ import annotations

from dataclasses import dataclass

from pans.bundle.sensor import Bundle
from pans.decide.plan import Plan
from pans.instrument.profile import Profile

from .options import RunOptions


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be done: nothing in it changes during a run, and the recording's header holds all of it."""

    profile: Profile
    bundle: Bundle
    plan: Plan
    options: RunOptions
