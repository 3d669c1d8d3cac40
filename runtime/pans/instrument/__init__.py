"""An instrument as numbers: profile, click law, detector, optics, calibration file.

In: TOML profiles, calibration files, light per exposure. Out: frozen facts, click probabilities, light behind the optics.
Other rooms import profile, click_law, calibration_file, detector and optics.
Start at profile.py (what an instrument is), then click_law.py (the chance of a click).
"""
