"""The calibration file: what was measured on one instrument, when and how; beside the profile, never a rewrite of it.

The file is strict JSON with a checksum over all of it; `MeasuredFile` and the functions on it serve registrations too. `load_calibration`
returns a `Calibration` whose every figure is possible, or raises DamagedFileError; `check_made_for` raises where a run must not use it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError, DamagedFileError
from pans.base.files import canonical_json, other_kind, parse_json_object, read_file, write_file
from pans.base.numbers import Range, demand, number_text

from .click_law import ClickLaw, log_no_click
from .profile import Profile

MAX_BYTES = 4 << 20
MAX_AGE_H, FUTURE_H = 24.0, 0.1  # how old a file may be, and by how much clocks may differ
F64 = NDArray[np.float64]
CHANNELS_MAX = 4096
CHANCE = Range(0, 1)
COUNTS = Range(0, 1 << 53, whole=True)  # float64 holds them exactly
# What a calibration file may say; docs/reference/formats.md states the same. Light and dark counts in photoelectrons per exposure.
_NUMBERS = {
    "photons_per_level": Range(0, 1e9),
    "dark_per_exposure": Range(0, 1e6),
    "exposure_us": Range(1e-3, 1e9),
    "peak_photoelectrons_hz": Range(0, 1e18),
}
_INTERVALS = {  # whose ends have the range of that number; the upper one may be null
    "photons_per_level_ci": "photons_per_level",
    "dark_ci": "dark_per_exposure",
    "peak_photoelectrons_hz_ci": "peak_photoelectrons_hz",
}


Check = Callable[[Mapping[str, Any]], None]
M = TypeVar("M", bound="MeasuredFile")


@dataclass(frozen=True, slots=True)
class MeasuredFile:
    """A file of something measured; `sha256` is that of its bytes, `values` everything that stands in it."""

    KIND: ClassVar[str] = ""  # its format is pans-KIND
    COMMAND: ClassVar[str] = ""  # that measures it
    path: str
    sha256: str
    values: Mapping[str, Any]

    @property
    def made(self) -> datetime:
        """When it was measured, UTC."""
        return datetime.fromisoformat(self.values["made_utc"])

    def age_h(self, now: datetime) -> float:
        """Its age in hours at `now` (UTC)."""
        return (now - self.made).total_seconds() / 3600

    def age_warnings(self, now: datetime, max_age_h: float = MAX_AGE_H) -> list[str]:
        """Return a sentence about a file that is too old, or from the future."""
        age = self.age_h(now)
        if age > max_age_h:
            return [f"the {self.KIND} is {age:.1f} h old, allowed are {max_age_h:g} h: measure again ({self.COMMAND})"]
        if age < -FUTURE_H:
            return [f"the {self.KIND} is from {-age:.1f} h in the future: check this machine's clock"]
        return []

    def check_made_for(self, profile: Profile, serial: str | None) -> None:
        """Raise ConfigError if it is of another profile or, where the device has told its serial number, of another device."""
        made_for, of_device = self.values["profile"], self.values["device"].get("serial")
        if made_for["sha256"] != profile.sha256:
            raise ConfigError(
                f"{self.path}: made for the profile {made_for['name']} ({made_for['sha256'][:12]}…), this run uses {profile.name} "
                f"({profile.sha256[:12]}…)",
                remedy=f"measure with this profile: {self.COMMAND} --profile {profile.name}",
            )
        if None not in (serial, of_device) and of_device != serial:
            raise ConfigError(
                f"{self.path}: made on the device {of_device}, this is {serial}", remedy="measure this device"
            )


class Calibration(MeasuredFile):
    """The facts of one calibration."""

    __slots__ = ()
    KIND, COMMAND = "calibration", "pans calibrate"

    def dark_probability(self, profile: Profile, exposure_us: float, channels: int) -> tuple[F64, F64, F64]:
        """Click probability of a dark exposure of `exposure_us`, with the ends of its 95 % interval, each float64 (channels,).

        What is above the false clicks of read noise grows with the exposure, as dark counts do.
        """
        rows = self.values["channels"]
        measured = np.array([[row["dark_per_exposure"], *row["dark_ci"]] for row in rows], np.float64)
        law = ClickLaw(0.0, profile.detector.read_noise_e, profile.detector.threshold_e)
        noise = -float(log_no_click(law, 0.0))
        with np.errstate(divide="ignore"):
            excess = np.maximum(-np.log1p(-np.minimum(measured, 1 - 1e-12)) - noise, 0.0)
        scaled = -np.expm1(-(noise + excess * (exposure_us / self.values["exposure_us"])))
        chosen = scaled[np.arange(channels) % len(rows)]
        return chosen[:, 0], chosen[:, 1], chosen[:, 2]

    def dark_clicks(self, channels: int) -> NDArray[np.int64]:
        """How many dark clicks each channel's rate was estimated from, int64 (channels,)."""
        rows = self.values["channels"]
        return np.array([int(row["dark_clicks"]) for row in rows], np.int64)[np.arange(channels) % len(rows)]

    def applied_to(self, profile: Profile) -> Profile:
        """The profile with the projector's measured brightness, so that plans expose for the light that is there.

        Where the profile's own figure lies within the measured interval it stays: the measurement does not contradict it.
        """
        low, high = self.values["peak_photoelectrons_hz_ci"]
        said = profile.projector.peak_photoelectrons_hz
        if low <= said and (high is None or said <= high):
            return profile
        projector = replace(profile.projector, peak_photoelectrons_hz=self.values["peak_photoelectrons_hz"])
        return replace(profile, projector=projector)


def save_calibration(path: str | Path, values: Mapping[str, Any], *, force: bool = False) -> str:
    """Write `values` (JSON-able, with all keys of the format but the checksum) whole or not at all; return the file's SHA-256.

    UsageError if `path` exists, unless `force`.
    """
    return save_measured(path, values, Calibration, _check, force=force)


def load_calibration(path: str | Path) -> Calibration:
    """Return what `path` holds; UsageError without a file, else DamagedFileError."""
    return parse_measured(read_file(path, MAX_BYTES), str(path), Calibration, _check)


def save_measured(
    path: str | Path, values: Mapping[str, Any], kind: type[MeasuredFile], check: Check, *, force: bool
) -> str:
    """Write a file of that `kind` whole or not at all, if `check` finds nothing; return its SHA-256."""
    data = sealed(values, kind.KIND)
    parse_measured(data, str(path), kind, check)
    write_file(path, data, force=force)
    return hashlib.sha256(data).hexdigest()


def parse_measured(data: bytes, where: str, kind: type[M], check: Check) -> M:
    """Return the bytes of a file as `kind`; DamagedFileError names the first thing that cannot be, which `check` raises."""
    values = _unsealed(data, where, kind.KIND)
    try:
        _check_origin(values)
        check(values)
    except KeyError as error:
        raise DamagedFileError(f"{where}: {error.args[0]} is missing", remedy="measure again") from error
    except (TypeError, ValueError, OverflowError, AttributeError) as error:
        raise DamagedFileError(f"{where}: {error}", remedy="measure again") from error
    return kind(where, hashlib.sha256(data).hexdigest(), values)


def sealed(values: Mapping[str, Any], kind: str) -> bytes:
    """Return the file's bytes: `values` (JSON-able) with format, version and checksum."""
    body = {"format": f"pans-{kind}", "version": 1, **values}
    whole = {**body, "sha256": hashlib.sha256(canonical_json(body)).hexdigest()}
    return (json.dumps(whole, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def _unsealed(data: bytes, where: str, kind: str) -> dict[str, Any]:
    """Return what the bytes of a file hold; DamagedFileError for another format, or where the checksum does not fit."""
    what, taker = other_kind(data, kind)
    if what:
        raise DamagedFileError(f"{where}: not a {kind}: it is {what}", remedy=taker)
    values = parse_json_object(data, where)
    if values.get("format") != f"pans-{kind}" or values.get("version") != 1:
        found = f"{ascii(values.get('format'))[:40]} {ascii(values.get('version'))[:20]}"
        raise DamagedFileError(f"{where}: format {found}, allowed: pans-{kind} 1")
    body = {key: value for key, value in values.items() if key != "sha256"}
    if values.get("sha256") != hashlib.sha256(canonical_json(body)).hexdigest():
        raise DamagedFileError(f"{where}: altered: its checksum does not fit what it says", remedy="measure again")
    return values


def find_warnings(calibration: Calibration | None, now: datetime, max_age_h: float = MAX_AGE_H) -> list[str]:
    """Return a sentence for the first reason to distrust: none given, contradictory, with silent channels, or stale."""
    if calibration is None:
        return [
            "no calibration: the light and the dark rates are the profile's, not this instrument's (pans calibrate)"
        ]
    if calibration.values.get("contradictions"):
        return ["the calibration is of an instrument whose messages contradicted each other: calibrate again"]
    if silent := calibration.values.get("silent_channels"):
        names = ", ".join(map(str, silent[:8])) + (", ..." if len(silent) > 8 else "")
        return [f"the calibration saw no click of channel {names} in light: check these detectors, and calibrate again"]
    return calibration.age_warnings(now, max_age_h)


def now_utc() -> datetime:
    """This machine's date and time."""
    return datetime.now(UTC)


def _check_origin(values: Mapping[str, Any]) -> None:
    """Check when a file was measured, and of which profile and device."""
    made = values["made_utc"]
    demand(isinstance(made, str), f"made_utc is {number_text(made)}, allowed: a date and time")
    demand(datetime.fromisoformat(made).utcoffset() is not None, f"made_utc {made[:40]!a} has no time zone")
    for part in ("profile", "device"):
        demand(isinstance(values[part], dict), f"{part} holds no facts")
    for key in ("name", "sha256"):
        demand(isinstance(values["profile"][key], str), f"profile.{key} is no text")
    serial = values["device"].get("serial")
    demand(serial is None or isinstance(serial, str), f"device.serial is {number_text(serial)}, allowed: text")


def _check(values: Mapping[str, Any]) -> None:
    for key, allowed in _NUMBERS.items():
        allowed.checked(values[key], key)
    for key, of in _INTERVALS.items():
        _check_interval(values[key], _NUMBERS[of], False, key)
    rows = values["channels"]
    fits = isinstance(rows, list) and 0 < len(rows) <= CHANNELS_MAX
    demand(fits, f"channels is no list of 1 to {CHANNELS_MAX}, allowed: one row for each channel")
    for number, row in enumerate(rows):
        demand(isinstance(row, dict), f"channel {number} is {number_text(row)}, allowed: an object")
        _check_channel(row, f"channel {number}")
    silent = values.get("silent_channels", [])
    demand(isinstance(silent, list), f"silent_channels is {number_text(silent)}, allowed: a list of channels")
    for channel in silent:
        Range(0, len(rows) - 1, whole=True).checked(channel, "silent_channels")


def _check_channel(row: Mapping[str, Any], what: str) -> None:
    for key in ("dark_clicks", "dark_exposures"):
        COUNTS.checked(row[key], f"{what}: {key}")
    clicks, exposures = row["dark_clicks"], row["dark_exposures"]
    demand(clicks <= exposures, f"{what}: {clicks} dark clicks in {exposures} exposures, allowed: at most one in each")
    CHANCE.checked(row["dark_per_exposure"], f"{what}: dark_per_exposure")
    _check_interval(row["dark_ci"], CHANCE, True, f"{what}: dark_ci")
    low, high = row["dark_ci"]
    fine = low <= row["dark_per_exposure"] <= high
    demand(fine, f"{what}: dark rate {row['dark_per_exposure']} not within {low} to {high}")


def _check_interval(value: Any, allowed: Range, bounded: bool, what: str) -> None:
    """Check [low, high], both in the range; high may be null where `bounded` is false."""
    pair = isinstance(value, list) and len(value) == 2
    demand(pair, f"{what} is {number_text(value)}, allowed: low and high, or null where nothing bounds it")
    low, high = value
    allowed.checked(low, f"{what}, low")
    if high is None and not bounded:
        return
    allowed.checked(high, f"{what}, high")
    demand(low <= high, f"{what} goes from {low} to {high}, allowed: low before high")
