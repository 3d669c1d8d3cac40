"""One instrument as numbers: its profile, the laws of its clicks, its calibration, and tests of whether it still is as it was.

What comes in are TOML profiles, calibration files and counts of clicks; what goes out are frozen facts, probabilities, estimates and
findings. Start with profile.py, then click_law.py (the chance of a click) and dead_time.py (the law of dead
time, for trainer and simulator too); cusum.py, channel_health.py and light_level.py watch a run.

>>> from pans.runtime.instrument import load_profile
>>> load_profile("oled-qcmos").mode
'sequential'
"""

from .calibration import Calibration, load_calibration
from .click_law import ClickLaw, click_law
from .profile import Profile, load_profile, shipped_profiles

__all__ = ["Calibration", "ClickLaw", "Profile", "click_law", "load_calibration", "load_profile", "shipped_profiles"]
