"""`pans run` and `pans demo`, from the options to the report. Start at one_run.py."""

from typing import TYPE_CHECKING

from pans.base import loaded_later

if TYPE_CHECKING:
    from .command import DEMO_DEFAULTS, DEMO_SCENE, profile_of
    from .one_run import Outcome, run_once

__all__ = [
    "DEMO_DEFAULTS",
    "DEMO_SCENE",
    "Outcome",
    "profile_of",
    "run_once",
]

__getattr__ = loaded_later(__name__, "command", "one_run")
