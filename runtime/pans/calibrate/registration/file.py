"""The registration file: an estimate in; a strict JSON file with a checksum out; and back, to what a run with it shows.

`load_registration` returns a `Registered` whose every figure is possible, or raises DamagedFileError; `in_use` refuses one that a run must
not use, and corrects the bundle's patterns. The bundle's file is recorded as it is: a replay needs no registration.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.errors import ConfigError, UsageError
from pans.base.files import read_file
from pans.base.numbers import Range, demand, number_text
from pans.bundle.sensor import Bundle
from pans.instrument.calibration_file import MAX_AGE_H, MeasuredFile, parse_measured, save_measured
from pans.instrument.optics import IDENTITY, Imaging, tolerance_of
from pans.instrument.profile import Profile

from .correct import Correction, corrected
from .estimate import Estimate
from .parameters import DARK, PARAMETERS, Shape, imaging_of

MAX_BYTES = 1 << 20
SIDE = Range(1, 4096, whole=True)
CLICKS = Range(1, 1 << 53, whole=True)
TOLERATES = "tolerates"  # where a bundle that was trained through optics says which


class Registered(MeasuredFile):
    """What one registration says."""

    __slots__ = ()
    KIND, COMMAND = "registration", "pans calibrate --registration"

    @property
    def shape(self) -> Shape:
        """Rows and columns of the grid."""
        rows, columns = self.values["grid"]
        return rows, columns

    def imaging(self) -> Imaging:
        """Return the measured table, with its flat field."""
        numbers = [self.values["parameters"][one.name]["value"] for one in PARAMETERS]
        return imaging_of(np.array([*numbers, 0.0]), self.shape)

    def applied_to(self, profile: Profile) -> Profile:
        """Return the profile with the measured light, so that plans expose for what is there; unchanged where the interval holds 1."""
        gain = self.values["parameters"]["gain"]
        if gain["low"] <= 1.0 <= gain["high"]:
            return profile
        peak = profile.projector.peak_photoelectrons_hz * gain["value"]
        return replace(profile, projector=replace(profile.projector, peak_photoelectrons_hz=peak))


def registration_values(found: Estimate, shape: Shape) -> dict[str, Any]:
    """Return what a file says of an estimate: values, standard errors, 95 % intervals, and how well it explains the counts."""
    ends = found.intervals()
    rows = zip(PARAMETERS, found.values.tolist(), found.errors.tolist(), ends.tolist())
    parameters = {
        one.name: {"value": max(value, 0.0) if one.name == "black" else value, "error": error, "low": low, "high": high}
        for one, value, error, (low, high) in rows
    }
    return {
        "grid": list(shape),
        "parameters": parameters,
        "dark_per_exposure": float(found.values[DARK]),
        "clicks": found.clicks,
        "exposures": found.exposures,
        "chi2": found.chi2,
        "degrees_of_freedom": found.degrees,
        "p_value": found.p_value,
    }


def save_registration(path: str | Path, values: Mapping[str, Any], *, force: bool = False) -> str:
    """Write `values` whole or not at all; return the file's SHA-256. UsageError if `path` exists, unless `force`."""
    return save_measured(path, values, Registered, check_values, force=force)


def load_registration(path: str | Path) -> Registered:
    """Return what `path` holds; UsageError without a file, else DamagedFileError."""
    return parse_measured(read_file(path, MAX_BYTES), str(path), Registered, check_values)


def is_registration(path: str | Path) -> bool:
    """Return whether the file at `path` says of itself that it is one; UsageError without a file."""
    return b'"pans-registration"' in read_file(path, 4 * MAX_BYTES)


def check_usable(
    registered: Registered, profile: Profile, shape: Shape, now: datetime, max_age_h: float = MAX_AGE_H
) -> None:
    """Raise ConfigError if a run on `profile` with patterns of `shape` must not use it: another profile or grid, or too old."""
    registered.check_made_for(profile, None)
    if registered.shape != tuple(shape):
        rows, columns = registered.shape
        raise ConfigError(
            f"{registered.path}: of a grid of {rows} x {columns} pixels, the bundle's patterns have {shape[0]} x {shape[1]}",
            remedy=f"register with a target of as many pixels: {registered.COMMAND} --target FILE",
        )
    for stale in registered.age_warnings(now, max_age_h):
        raise ConfigError(f"{registered.path}: {stale}", remedy="or allow more with --calibration-max-age-h")


def registration_words(path: str | Path, values: Mapping[str, Any]) -> str:
    """Return a table of the measured numbers for people."""
    banner = "SIMULATED · " if values["device"].get("simulated") else ""
    lines = [f"{banner}{path}"]
    for one in PARAMETERS:
        row = values["parameters"][one.name]
        unit, digits = f" {one.unit}" if one.unit else "", 6 if one.name == "black" else 4
        lines.append(
            f"  {one.name.removesuffix('_px').removesuffix('_deg'):<9} {row['value']:+.{digits}f}{unit:<9} "
            f"95 % {row['low']:+.{digits}f} to {row['high']:+.{digits}f}"
        )
    fit = f"chi-square {values['chi2']:.0f} over {values['degrees_of_freedom']} (p = {values['p_value']:.2g})"
    lines.append(f"  {values['clicks']} clicks in {values['exposures']} exposures; {fit}")
    return "\n".join(lines)


def check_values(values: Mapping[str, Any]) -> None:
    """Raise ValueError, TypeError or KeyError where a figure of a file cannot be."""
    grid = values["grid"]
    demand(isinstance(grid, list) and len(grid) == 2, f"grid is {number_text(grid)}, allowed: rows and columns")
    for size in grid:
        SIDE.checked(size, "grid")
    for one in PARAMETERS:
        row = values["parameters"][one.name]
        Range(one.low, one.high).checked(row["value"], f"{one.name}.value")
        for key in ("low", "high", "error"):
            Range(-1e6, 1e6).checked(row[key], f"{one.name}.{key}")
        fits = row["low"] <= row["value"] <= row["high"]
        demand(fits, f"{one.name} {row['value']} is not within {row['low']} to {row['high']}")
    CLICKS.checked(values["clicks"], "clicks")
    Range(0, 1).checked(values["p_value"], "p_value")
    Registered("", "", dict(values)).imaging()  # refuses a flat field that is negative somewhere


# ---- in use ----


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


def in_use(path: Path, bundle: Bundle, profile: Profile, now: datetime, max_age_h: float) -> InUse:
    """Return what `bundle` shows on the table that `path` measured; ConfigError or UsageError for what must not be used."""
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
    tolerates = bundle.provenance.get(TOLERATES)
    optics = tolerates.get("optics") if isinstance(tolerates, dict) else None
    if not isinstance(optics, str):
        return IDENTITY
    try:
        return tolerance_of(optics).middle
    except ValueError:  # a spelling of another version: what it says is not needed to decide
        return IDENTITY
