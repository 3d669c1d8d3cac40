"""Hardware profiles: a TOML file in, frozen facts about one instrument out. docs/reference/profiles.md explains every key.

`load_profile` and `parse_profile` return a `Profile` whose numbers are all possible ones, or raise a ConfigError that starts with
file:line:col. The sections and the rules of single keys are in profile_schema.py; what must hold between keys is here.
`profile_template` writes a commented profile to begin with.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import html_card
from pans.base.errors import ConfigError, UsageError
from pans.base.files import (
    Key,
    KeyPath,
    Position,
    found,
    near,
    position_of,
    read_arrays,
    read_toml,
    toml_text,
    type_remedy,
)
from pans.instrument.optics.model import IDENTITY, Imaging, checked_flat

from .profile_schema import FREE_RUNNING as FREE_RUNNING
from .profile_schema import SCHEMA, SECTIONS, Clock, Detector, Exposure, Projector, Timing
from .profile_schema import ObjectModulator as ObjectModulator
from .profile_schema import Optics as Optics

__all__ = [
    "ObjectModulator",
    "Optics",
    "Profile",
    "load_profile",
    "parse_profile",
    "profile_template",
    "profile_text",
    "shipped_profiles",
]

MAX_PROFILE_BYTES = 1 << 20
WANTED = "a hardware profile"
MAX_FLAT_BYTES = 1 << 26
MOST_AFTERPULSES = 0.6  # of those that come at any time: beyond 1 - 1/e every one would cause another
FARTHEST_CROSSTALK = 8  # channels
MOST_SEQUENTIAL = 4  # channels: the clicks of one exposure are a number of COUNTS
MIN_EXPOSURE_TICKS = 10  # rounding an exposure to whole ticks then changes the photons by 5 % at most
_OPTIONAL_SECTIONS = ("object", "optics", "sources")
_UNIT = re.compile(r"_(?:ps|ns|us|ms|s|sec|hz|khz|mhz|ghz|cps|e|nm|um|mm|m|px|percent|pct)$")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class Profile:
    """One instrument; `sources`: "section.key" -> where the figure comes from, `measure`: the keys to measure oneself."""

    name: str
    mode: str
    projector: Projector
    object_modulator: ObjectModulator | None
    detector: Detector
    exposure: Exposure
    clock: Clock
    timing: Timing
    sources: Mapping[str, str]
    measure: tuple[str, ...]
    text: str = field(repr=False)
    description: str = ""
    optics: Optics | None = None
    folder: Path | None = field(default=None, repr=False, compare=False)  # of the file, where there is one

    @property
    def sha256(self) -> str:
        """Hex digest of the file's text: what a recording stores beside its figures."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the figures that matter most, with their units."""
        shows, clicks = self.projector, self.detector
        rows = {
            "what": self.description,
            "mode": self.mode,
            "projector": f"{shows.kind}, {shows.width_px} x {shows.height_px} px, {shows.levels} levels",
            "patterns per second at most": shows.pattern_rate_max_hz,
            "detector": f"{clicks.kind}, {clicks.channels} channels, efficiency {clicks.efficiency:g}",
            "dark rate (Hz)": clicks.dark_rate_hz,
            "dead time (ns)": f"{clicks.dead_time_ns:g}, {clicks.dead_time_kind}, {clicks.between_exposures} between exposures",
            "exposure (us)": f"{self.exposure.min_us:g} to {self.exposure.max_us:g}, readout {self.exposure.readout_us:g}",
            "decision deadline (us)": self.timing.decision_deadline_us,
            "to be measured": self.measure,
        }
        return html_card(f"Profile {self.name}", rows)

    def imaging(self) -> Imaging:
        """Return the optics as stated, perfect ones where nothing is; ConfigError for a flat field that cannot be read."""
        stated = self.optics
        if stated is None:
            return IDENTITY
        middle = stated.tolerance().middle
        if stated.flat_field_file is None:
            return middle
        return replace(middle, flat=_read_flat((self.folder or Path()) / stated.flat_field_file))

    def exposure_tolerance_us(self, exposure_us: float) -> float:
        """Return by how much start and length of an exposure of `exposure_us` may be off: 1 % or a tick if nothing is stated."""
        tick_us = 1e6 / self.clock.tick_hz
        return self.timing.exposure_tolerance_us or max(0.01 * exposure_us, tick_us + 0.001)

    @property
    def min_transmission(self) -> float:
        """Transmission of a black object pixel: as declared, else 1/contrast of the modulator, 0 without one."""
        modulator = self.object_modulator
        if modulator is None:
            return 0.0
        return 1.0 / modulator.contrast if modulator.black_transmission is None else modulator.black_transmission


def load_profile(name_or_path: str | Path) -> Profile:
    """Read the shipped profile of that name, or the profile file at that path.

    Raises ConfigError if there is neither, or if the file is not a valid profile (then it starts with file:line:col).
    """
    folder = None if _is_shipped(name_or_path) else Path(name_or_path).parent
    return replace(parse_profile(profile_text(name_or_path), _where(name_or_path)), folder=folder)


def _where(name_or_path: str | Path) -> str:
    """Return how messages name a profile: by its file."""
    return f"{name_or_path}.toml" if _is_shipped(name_or_path) else str(name_or_path)


def _is_shipped(name_or_path: str | Path) -> bool:
    return isinstance(name_or_path, str) and name_or_path in shipped_profiles()


def profile_text(name_or_path: str | Path) -> str:
    """Return the TOML text of the shipped profile of that name, or of the file at that path; ConfigError as of `load_profile`."""
    if _is_shipped(name_or_path):
        return toml_text(_profile_folder() / f"{name_or_path}.toml", MAX_PROFILE_BYTES, WANTED, "profile")
    path = Path(name_or_path)
    if not path.is_file():
        known = ", ".join(shipped_profiles())
        near = difflib.get_close_matches(str(name_or_path), shipped_profiles(), n=1)
        raise ConfigError(
            f"there is no profile {str(name_or_path)!r}: neither a file nor one of the shipped profiles ({known})",
            remedy=f"did you mean {near[0]}?" if near else "give a shipped name or the path of a .toml file",
        )
    return toml_text(path, MAX_PROFILE_BYTES, WANTED, "profile")


def shipped_profiles() -> tuple[str, ...]:
    """Names of the profiles that come with the package, sorted."""
    return tuple(sorted(path.stem for path in _profile_folder().glob("*.toml")))


def _profile_folder() -> Path:
    """Return the folder of the shipped profiles: in the package where it is installed, at the top of a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "hw_profiles"
    return installed if installed.is_dir() else package.parents[1] / "hw_profiles"


def parse_profile(text: str, where: str) -> Profile:
    """Check the TOML `text` (named `where` in messages) and return its facts; raises ConfigError at the first fault."""
    if len(text.encode()) > MAX_PROFILE_BYTES:
        raise ConfigError(
            f"{where}:1:1: a profile may hold at most {MAX_PROFILE_BYTES} bytes, found more",
            remedy="is this a profile? see docs/reference/profiles.md",
        )
    check = ProfileCheck(*read_toml(text, where), where)
    stated, sources, measure = check.values()
    parts = {name: section(**stated[name]) for name, section in SECTIONS.items() if name in stated}
    modulator = parts.pop("object", None)
    profile = Profile(
        **stated["profile"], **parts, object_modulator=modulator, sources=sources, measure=measure, text=text
    )
    for path, message, remedy in (*_detector_faults(profile, stated["detector"]), *_other_faults(profile)):
        raise check.fault(path, f"{'.'.join(path)} {message}", remedy)
    return profile


def _read_flat(path: Path) -> NDArray[np.float64]:
    """Return the array `flat` (rows, columns) of a .npz file; ConfigError."""
    try:
        arrays = read_arrays(path, ("flat",), MAX_FLAT_BYTES)
        if "flat" not in arrays or arrays["flat"].dtype.kind not in "fiu":
            raise ValueError("no array `flat` of numbers in it")
        return checked_flat(arrays["flat"])
    except (ValueError, OSError, UsageError) as error:
        raise ConfigError(
            f"{path}: not a readable flat field: {error}",
            remedy="write it with numpy.savez(FILE, flat=FLAT / FLAT.mean())",
        ) from error


@dataclass(frozen=True, slots=True)
class ProfileCheck:
    """One file under check; its methods return checked values or raise with the position."""

    tables: dict[str, Any]
    positions: Mapping[KeyPath, Position]
    where: str

    def values(self) -> tuple[dict[str, dict[str, Any]], dict[str, str], tuple[str, ...]]:
        """Return every section's checked values, [sources], and `measure` of [profile] (both empty where the file has none)."""
        self._check_sections()
        values = {name: self._section(name) for name in SCHEMA if name in self.tables}
        return values, self._sources(values), self._measure(values)

    def fault(self, path: KeyPath, message: str, remedy: str = "") -> ConfigError:
        """The error to raise: `message` with the place of `path` before it."""
        line, column = position_of(path, self.positions)
        return ConfigError(f"{self.where}:{line}:{column}: {message}", remedy=remedy)

    def _check_sections(self) -> None:
        known = [*SCHEMA, "sources"]
        for name, table in self.tables.items():
            if name not in known:
                owners = [section for section, keys in SCHEMA.items() if name in keys]
                hint = f"[{owners[0]}] has a key of that name" if owners else near(name, known, "[{}]")
                raise self.fault(
                    (name,), f"{name} is not a section of a profile; allowed: [{'], ['.join(known)}]", hint
                )
            if not isinstance(table, dict):
                raise self.fault((name,), f"{name} must be a section, found {found(table)}", f"write [{name}]")
        for name in known:
            if name not in self.tables and name not in _OPTIONAL_SECTIONS:
                keys = ", ".join(key for key, rule in SCHEMA[name].items() if rule.required)
                raise self.fault((), f"section [{name}] is missing", f"add [{name}] with {keys}")

    def _section(self, section: str) -> dict[str, Any]:
        rules = SCHEMA[section]
        table = {key: value for key, value in self.tables[section].items() if (section, key) != ("profile", "measure")}
        for key in table:
            if key not in rules:
                raise self._unknown(section, key)
        for key, rule in rules.items():
            if rule.required and key not in table:
                raise self.fault(
                    (section,), f"{section}.{key} is missing", f"add `{key} = ...` to [{section}]: {rule.allowed}"
                )
        return {key: self._value(section, key, value, rules[key]) for key, value in table.items()}

    def _value(self, section: str, key: str, value: Any, rule: Key) -> str | int | float | tuple[float, ...]:
        if rule.fits(value) and rule.within(value):
            if (section, key) == ("profile", "name"):
                return self._checked_name(value)
            if rule.kind == "numbers":
                return tuple(float(one) for one in value)
            return float(value) if rule.kind == "number" else value
        remedy = "" if rule.fits(value) else type_remedy(value, rule.kind)
        raise self.fault((section, key), f"{section}.{key} must be {rule.allowed}, found {found(value)}", remedy)

    def _checked_name(self, name: str) -> str:
        if not _NAME.fullmatch(name):
            raise self.fault(
                ("profile", "name"),
                "profile.name must be 1 to 64 letters, digits, dots, dashes or underscores and start with a letter or "
                f"digit, found {found(name)}",
            )
        return name

    def _unknown(self, section: str, key: str) -> ConfigError:
        rules = SCHEMA[section]
        stem = _UNIT.sub("", key)
        other = next((name for name in rules if name != key and _UNIT.sub("", name) == stem), None)
        if other is not None:
            unit = other.removeprefix(stem).removeprefix("_")
            return self.fault(
                (section, key),
                f"{section}.{key} is not a key: the unit is part of the name, and this one is {other}",
                f"convert the value to {unit} and name it {other}" if unit else f"name it {other}",
            )
        owner = next((name for name, keys in SCHEMA.items() if key in keys), None)
        hint = f"{key} belongs in [{owner}]" if owner else near(key, list(rules), "{}")
        return self.fault((section, key), f"{section}.{key} is not a key; [{section}] takes {', '.join(rules)}", hint)

    def _sources(self, values: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
        """[sources], each of whose keys names a key in `values`."""
        sources = self.tables.get("sources", {})
        for name, text in sources.items():
            if isinstance(text, dict):
                raise self.fault(
                    ("sources", name),
                    f"sources.{name} must be text, found a table",
                    f'quote the whole key: "{name}.{next(iter(text), "key")}" = "where the figure comes from"',
                )
            if not isinstance(text, str) or not text.strip():
                raise self.fault(("sources", name), f"sources.{name} must be text in quotes, found {found(text)}")
            self._names_a_key(("sources", name), name, values)
        return dict(sources)

    def _measure(self, values: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
        """profile.measure, each of whose entries names a key in `values`."""
        names = self.tables["profile"].get("measure", [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise self.fault(
                ("profile", "measure"),
                f"profile.measure must be a list of keys in quotes, found {found(names)}",
                'for example measure = ["detector.dark_rate_hz"]',
            )
        for name in names:
            self._names_a_key(("profile", "measure"), name, values)
        return tuple(names)

    def _names_a_key(self, path: KeyPath, name: str, values: Mapping[str, Mapping[str, Any]]) -> None:
        known = [f"{section}.{key}" for section, table in values.items() for key in table]
        if name not in known:
            list_name = path[0] if path[0] == "sources" else ".".join(path)
            raise self.fault(
                path, f'{list_name} names "{name}", which is not a key of this profile', near(name, known, "{}")
            )


_Fault = tuple[KeyPath, str, str]  # of which key, what must hold and what was found, what to do


def _detector_faults(profile: Profile, stated: Mapping[str, Any]) -> Iterator[_Fault]:
    """What cannot be between figures of the detector and others; `stated` are the keys that the file has."""
    detector, exposure, channels = profile.detector, profile.exposure, profile.detector.channels
    parallel, period_ns = profile.mode == "parallel", 1000 * (exposure.min_us + exposure.readout_us)

    def of(key: str, message: str, remedy: str) -> _Fault:
        return ("detector", key), message, remedy

    if not parallel and channels > MOST_SEQUENTIAL:
        where = "in sequential mode (detectors that are read at once, each with a pattern of its own, one such set after another)"
        remedy = 'set channels = 1, or mode = "parallel" if all patterns are shown at once'
        yield of("channels", f"must be from 1 to {MOST_SEQUENTIAL} {where}, found {channels}", remedy)
    if parallel and channels < 2:
        message = f"must be at least 2 in parallel mode (one per pattern), found {channels}"
        yield of("channels", message, 'set the number of channels, or mode = "sequential"')
    if detector.crosstalk_probability > 0 and channels < 2:
        found_one = f"found {detector.crosstalk_probability:g}"
        yield of(
            "crosstalk_probability", f"must be 0 with 1 channel (there is no neighbour), {found_one}", "remove the line"
        )
    if detector.dead_time_ns > period_ns:
        most = f"at most exposure.min_us + exposure.readout_us = {period_ns:g} ns (a click would blind whole exposures after it)"
        remedy = f"raise exposure.min_us or exposure.readout_us by {(detector.dead_time_ns - period_ns) / 1000:g} us"
        yield of("dead_time_ns", f"must be {most}, found {detector.dead_time_ns:g}", remedy)
    probability = detector.afterpulse_probability
    if detector.afterpulse_time_us is not None and not 0 < probability <= MOST_AFTERPULSES:
        message = f"needs afterpulse_probability above 0 and at most {MOST_AFTERPULSES:g}, found {probability:g}"
        yield of(
            "afterpulse_time_us", message, "it is the chance that a click causes at least one more, at any later time"
        )
    further, most_further = len(detector.crosstalk_further), max(0, min(FARTHEST_CROSSTALK, channels - 1) - 1)
    if further > most_further:
        message = f"must hold at most {most_further} numbers (of the second neighbour and those after it) with {channels} channels"
        yield of("crosstalk_further", f"{message}, found {further}", "leave out what is hardly there")
    telegraph = ("telegraph_share", "telegraph_offset_e", "telegraph_time_s")
    missing = [key for key in telegraph if key not in stated]
    if 0 < len(missing) < len(telegraph):
        there = next(key for key in telegraph if key in stated)
        yield of(there, f"needs {' and '.join(missing)}", "state all three or none")
    jitter_ns = detector.timing_jitter_ns
    if jitter_ns and (not parallel or jitter_ns > period_ns):
        most = f"0 in sequential mode, and at most exposure.min_us + exposure.readout_us = {period_ns:g} ns in parallel mode"
        yield of(
            "timing_jitter_ns", f"must be {most}, found {jitter_ns:g}", "a click would say nothing of its exposure"
        )
    for key in ("telegraph_share", "threshold_drift_e_per_hour"):
        if getattr(detector, key) and not detector.read_noise_e:
            why = "a detector that counts events has no reading that could shift"
            yield of(key, f"needs read_noise_e above 0: {why}", "remove the line")


def _other_faults(profile: Profile) -> Iterator[_Fault]:
    exposure, timing, optics = profile.exposure, profile.timing, profile.optics or Optics()
    if exposure.min_us > exposure.max_us:
        message = f"must be at most exposure.max_us = {exposure.max_us:g}, found {exposure.min_us:g}"
        yield ("exposure", "min_us"), message, ""
    least_us = MIN_EXPOSURE_TICKS * 1e6 / profile.clock.tick_hz
    if exposure.min_us < least_us * (1 - 1e-9):
        ticks = f"{MIN_EXPOSURE_TICKS} ticks = {least_us:g} us at clock.tick_hz = {profile.clock.tick_hz}"
        remedy = "give the device's true tick rate, or a longer shortest exposure"
        yield ("exposure", "min_us"), f"must be at least {ticks}, found {exposure.min_us:g}", remedy
    if 1000 * timing.lease_ms <= timing.decision_deadline_us:
        deadline = f"timing.decision_deadline_us = {timing.decision_deadline_us / 1000:g} ms"
        remedy = "the lease is what the device waits before it goes dark: some hundred ms"
        yield ("timing", "lease_ms"), f"must be above {deadline}, found {timing.lease_ms}", remedy
    for key, off, least in (("psf_px", "psf_tolerance_px", 0.0), ("scale", "scale_tolerance", 0.1)):
        value, tolerance = getattr(optics, key), getattr(optics, off)
        if value - tolerance < least:
            message = f"must be at most optics.{key} - {least:g} = {value - least:g}, found {tolerance:g}"
            yield ("optics", off), message, "state the tolerance to either side of the value"


_TITLES = {
    "projector": "  # what shows the patterns",
    "object": "  # the modulator that shows test images; leave the section out where real objects stand before the detector",
    "optics": "  # where the object stands on the pattern grid, and how sharply; what is left out is perfect",
    "detector": "  # what clicks; an effect that is left out is absent",
    "timing": "  # what a run promises",
}
_HEAD = """\
# Hardware profile of an instrument, begun from the shipped profile {base}.
# Go through the keys (docs/reference/profiles.md explains them), put in your figures, and check the file: pans profile check FILE
# Each key has its allowed values in brackets. `pans profile show NAME` shows a shipped profile with its sources.
"""


def profile_template(name: str, base: str) -> str:
    """Return the commented TOML of a profile called `name` with the figures of the profile `base` (a shipped name or a file).

    >>> print(profile_template("my-lab", "dmd-spad").split("\\n")[4])
    [profile]
    """
    tables, _ = read_toml(profile_text(base), base)
    return "\n".join([_HEAD.format(base=base), *_lines(name, base, tables)]) + "\n"


def _lines(name: str, base: str, tables: dict[str, Any]) -> Iterator[str]:
    for section, rules in SCHEMA.items():
        if section not in tables and section != "optics":  # which few profiles have, and every table should
            continue
        if section != "profile":
            yield ""
        yield f"{'' if section in tables else '# '}[{section}]{_TITLES.get(section, '')}"
        for key, rule in rules.items():
            full = f"{section}.{key}"
            value = {"profile.name": name, "profile.description": f"begun from {base}"}.get(
                full, tables.get(section, {}).get(key)
            )
            yield f"# {rule.meaning} [{rule.allowed}]"
            # what is absent stays absent, ready to be filled in
            yield f"# {key} =" if value is None else f"{key} = {_toml(value)}"
        if section == "profile":
            yield "# figures that must be measured on your instrument; shorten the list as you go"
            yield "measure = ["
            yield from (f"    {_toml(one)}," for one in _to_measure(tables))
            yield "]"
    yield from ("", "[sources]", "# where each figure comes from, so that others can judge it:")
    yield '# "detector.efficiency" = "data sheet of 2026, 650 nm"'


def _to_measure(tables: dict[str, Any]) -> list[str]:
    wanted = ("projector.peak_photoelectrons_hz", "detector.dark_rate_hz", "object.black_transmission", "clock.tick_hz")
    return [full for full in wanted if full.partition(".")[2] in tables.get(full.partition(".")[0], {})]


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)  # TOML takes JSON's escapes
    return "inf" if value == float("inf") else repr(value)
