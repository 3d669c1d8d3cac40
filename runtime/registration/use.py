"""A registration in use: from the file and a bundle to what a run shows, and what its recording and summary say of it.

Owns the refusal of what cannot be used; the file is file.py's, the correction correct.py's. Decisions are those of the bundle, whose file
is recorded as it is: a replay needs no registration.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from pans.runtime.bundle.facts import Bundle
from pans.runtime.errors import UsageError
from pans.runtime.imaging import IDENTITY, Imaging, tolerance_of
from pans.runtime.instrument.calibration import check_made_for
from pans.runtime.instrument.profile import Profile

from .correct import Correction, corrected
from .file import Registered, check_usable, load_registration

TOLERATES = "tolerates"  # where a bundle that was trained through optics says which


@dataclass(frozen=True, slots=True, eq=False)
class InUse:
    """What a run shows on the measured table, the profile with its light, and where that comes from."""

    registered: Registered
    shown: Bundle
    profile: Profile
    correction: Correction

    def header(self) -> dict[str, Any]:
        """What the recording says: the file, the correction, and the hash of the levels that were shown."""
        levels = hashlib.sha256(self.shown.pattern_levels.astype("<u2").tobytes()).hexdigest()
        return {
            "sha256": self.registered.sha256,
            "values": dict(self.registered.values),
            "correction": asdict(self.correction),
            "levels_sha256": levels,
        }

    def facts(self) -> dict[str, Any]:
        """What the summary says."""
        one = self.registered
        where = {"path": one.path, "sha256": one.sha256, "made_utc": one.values["made_utc"]}
        return {**where, **asdict(self.correction)}

    def words(self) -> str:
        """Return a line for people."""
        found = self.correction
        return (
            f"patterns corrected for the table of {self.registered.path} ({self.registered.imaging().words()}): "
            f"error of their light {found.error_before:.1%} before, {found.error_after:.1%} after, light kept {found.light_kept:.1%}"
        )

    def check_device(self, serial: str | None) -> None:
        """Raise ConfigError if the device is another than the one that was measured."""
        one = self.registered
        check_made_for(one.path, one.values, self.profile, serial, "pans calibrate --registration")


def in_use(path: Path | None, bundle: Bundle, profile: Profile, now: datetime, max_age_h: float) -> InUse | None:
    """Return what `bundle` shows on the table that `path` measured; ConfigError or UsageError for what must not be used."""
    if path is None:
        return None
    if bundle.analyser is not None:
        raise UsageError(
            f"{bundle.name} looks through passive optics and shows nothing: a registration has no effect",
            remedy="leave --registration out",
        )
    registered = load_registration(path)
    check_usable(registered, profile, bundle.image_shape, now, max_age_h)
    shown, correction = corrected(bundle, registered.imaging(), trained_optics(bundle), str(path))
    return InUse(registered, shown, registered.applied_to(profile), correction)


def trained_optics(bundle: Bundle) -> Imaging:
    """Return the optics for which `bundle` was trained: the middle of the tolerance that it names, else perfect ones."""
    told = bundle.provenance.get(TOLERATES)
    optics = told.get("optics") if isinstance(told, dict) else None
    if not isinstance(optics, str):
        return IDENTITY
    try:
        return tolerance_of(optics).middle
    except ValueError:  # a spelling of another version: what it says is not needed to decide
        return IDENTITY
