"""From counts to what a calibration file says: the level with its interval, channels, non-uniformity, efficiency.

Owns the choice of what is reported and when patterns are taken to differ; the estimates are calibrate.py's, the file calibration.py's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pans.runtime.errors import UsageError
from pans.runtime.instrument.calibration import now_utc
from pans.runtime.instrument.estimate import CountModel, Counts, fit_light, fit_spread
from pans.runtime.instrument.profile import Profile
from pans.runtime.intervals import jeffreys_interval

from .calibration import Design, joined_counts, plan_facts, profile_level

PATTERNS_DIFFER = 0.01  # p-value of the test that they do not, below which the level's interval holds their spread


def calibration_values(parts: Sequence[Counts], model: CountModel, design: Design, profile: Profile) -> dict[str, Any]:
    """Return what a calibration file says of the counts `parts` (one for each channel), but for device, seed and command."""
    together = joined_counts(parts)
    fit = fit_light(together, model)
    if not 0 < fit.level.value < math.inf:
        raise UsageError(
            f"{'no' if fit.level.value <= 0 else 'every'} exposure with light clicked: nothing bounds the photon level on both sides",
            remedy="check the light path; the brightness may have changed since the first stage",
        )
    spread = fit_spread(together, model, fit.level.value, fit.dark.value)
    uniform = spread.p_value >= PATTERNS_DIFFER or spread.patterns < 3
    scale = (1.0, fit.level.low / fit.level.value, fit.level.high / fit.level.value) if uniform else spread.mean
    level, low, high = (fit.level.value * factor for factor in scale)
    exposure_us = design.plan.exposure_us
    to_peak = (profile.projector.levels - 1) / (exposure_us * 1e-6)
    expected = profile_level(profile, exposure_us)
    channels = [_channel(part, model, level) for part in parts]
    dark = sum(row["dark_clicks"] for row in channels), sum(row["dark_exposures"] for row in channels)
    return {
        "made_utc": now_utc().isoformat(),
        "profile": {"name": profile.name, "sha256": profile.sha256},
        "exposure_us": exposure_us,
        "photons_per_level": level,
        "photons_per_level_ci": [low, _bound(high)],
        "peak_photoelectrons_hz": level * to_peak,
        "peak_photoelectrons_hz_ci": [low * to_peak, _bound(high * to_peak)],
        "dark_per_exposure": dark[0] / dark[1] if dark[1] else 0.0,
        "dark_ci": list(jeffreys_interval(*dark)),
        "channels": channels,
        "non_uniformity": {
            "relative": spread.relative.value,
            "relative_ci": [spread.relative.low, _bound(spread.relative.high)],
            "p_value": spread.p_value,
            "patterns": spread.patterns,
            "found": not uniform,
        },
        "efficiency": {
            "relative_to_profile": level / expected,
            "relative_ci": [low / expected, _bound(high / expected)],
            "means": "flux x transmission x efficiency over the profile's; clicks cannot tell the three apart",
        },
        "counts": {"exposures": int(together.exposures.sum()), "clicks": int(together.clicks.sum())},
        "design": plan_facts(design),
    }


def _channel(part: Counts, model: CountModel, level: float) -> dict[str, Any]:
    """One channel's dark rate (exposures behind a silent one alone, where afterpulses cannot lie) and light relative to all."""
    plain = (part.drive == 0) & (part.log_other == part.log_other.max())
    clicks, exposures = int(part.clicks[plain].sum()), int(part.exposures[plain].sum())
    lit = int(part.exposures[part.drive > 0].sum())
    own = fit_light(part, model).level if lit else None
    return {
        "dark_per_exposure": clicks / exposures if exposures else 0.0,
        "dark_ci": list(jeffreys_interval(clicks, exposures)),
        "dark_clicks": clicks,
        "dark_exposures": exposures,
        "level_relative": None if own is None or not math.isfinite(own.value) else own.value / level,
        "level_relative_ci": None if own is None else [own.low / level, _bound(own.high / level)],
    }


def _bound(value: float) -> float | None:
    return value if math.isfinite(value) else None
