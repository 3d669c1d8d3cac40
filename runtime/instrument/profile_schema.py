"""The rules of a profile file: which keys there are, what they may hold, and what must hold between them.

Owns the schema and the words of its error messages; never reads files and never makes a Profile (profile.py does). `ProfileCheck.facts`
returns the checked values as a dict, or raises a ConfigError that starts with file:line:col.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pans.runtime.errors import ConfigError
from pans.runtime.wire.fields import MAX_STATES

from .checked_toml import Key, KeyPath, Position, found, near, position_of, type_remedy

MODES = ("sequential", "parallel")
NON_PARALYSABLE, PARALYSABLE = "non-paralysable", "paralysable"
GATED, FREE_RUNNING = "gated", "free-running"
MAX_FLUCTUATION = 0.3  # of the light from exposure to exposure: beyond it a Gaussian factor would often be below 0
MOST_AFTERPULSES = 0.6  # of those that come at any time: beyond 1 - 1/e every one would cause another
FARTHEST_CROSSTALK = 8  # channels
MOST_SEQUENTIAL = 4  # channels: the clicks of one exposure are a number of COUNTS
MIN_EXPOSURE_TICKS = 10  # rounding an exposure to whole ticks then changes the photons by 5 % at most


_PROBABILITY = Key("number", 0, 1, required=False)
_OFF = Key("number", 0, 1000, required=False)
SCHEMA: dict[str, dict[str, Key]] = {
    "profile": {
        "name": Key("text"),
        "description": Key("text", required=False),
        "mode": Key("text", choices=MODES),
    },
    "projector": {
        "kind": Key("text"),
        "width_px": Key("whole", 1, 65535),
        "height_px": Key("whole", 1, 65535),
        "levels": Key("whole", 2, 65536),
        "pixel_pitch_um": Key("number", 0, 1e5, above=True),
        "pattern_rate_max_hz": Key("number", 0, 1e9, above=True),
        "pattern_memory": Key("whole", 1, 65535),  # 65535 patterns are 0..0xFFFE: 0xFFFF is the dark pattern
        "peak_photoelectrons_hz": Key("number", 0, 1e15, above=True),
        "automaton_states": Key("whole", 0, MAX_STATES, required=False),
        "dwell_steps": Key("whole", 1, 65535, required=False),
    },
    "object": {
        "contrast": Key("number", 1, 1e12, above=True, infinite=True),
        "levels": Key("whole", 2, 65536),
        "black_transmission": Key("number", 0, 0.99, required=False),
    },
    "optics": {
        "psf_px": Key("number", 0, 1000, required=False),
        "psf_tolerance_px": _OFF,
        "right_px": Key("number", -10_000, 10_000, required=False),
        "down_px": Key("number", -10_000, 10_000, required=False),
        "shift_tolerance_px": _OFF,
        "rotation_deg": Key("number", -360, 360, required=False),
        "rotation_tolerance_deg": Key("number", 0, 360, required=False),
        "scale": Key("number", 0.1, 10, required=False),
        "scale_tolerance": Key("number", 0, 0.9, required=False),
        "dark_pixel": Key("number", 0, 0.99, required=False),
        "gain_tolerance": Key("number", 0, 0.99, required=False),
        "flat_field_file": Key("text", required=False),
        "source_fluctuation": Key("number", 0, MAX_FLUCTUATION, required=False),
        "source_drift_percent_per_hour": Key("number", -100, 100, required=False),
    },
    "detector": {
        "kind": Key("text"),
        "channels": Key("whole", 1, 4096),
        "efficiency": Key("number", 0, 1, above=True),
        "dark_rate_hz": Key("number", 0, 1e9),
        "read_noise_e": Key("number", 0, 3, required=False),  # beyond 3 e- a single photon is not visible at all
        "threshold_e": Key("number", 0, 10, above=True, required=False),
        "dead_time_ns": Key("number", 0, 1e9, required=False),
        "dead_time_kind": Key("text", required=False, choices=(NON_PARALYSABLE, PARALYSABLE)),
        "between_exposures": Key("text", required=False, choices=(GATED, FREE_RUNNING)),
        "afterpulse_probability": _PROBABILITY,
        "afterpulse_time_us": Key("number", 0, 1e9, above=True, required=False),
        "crosstalk_probability": _PROBABILITY,
        "crosstalk_further": Key("numbers", 0, 1, required=False),
        "telegraph_share": Key("number", 0, 1, required=False),
        "telegraph_offset_e": Key("number", -10, 10, required=False),
        "telegraph_time_s": Key("number", 1e-4, 1e9, required=False),
        "threshold_drift_e_per_hour": Key("number", -100, 100, required=False),
        "timing_jitter_ns": Key("number", 0, 1e9, required=False),
        "photon_number_max": Key("whole", 1, 15, required=False),
    },
    "exposure": {
        "min_us": Key("number", 0, 1e9, above=True),
        "max_us": Key("number", 0, 1e9, above=True),
        "readout_us": Key("number", 0, 1e9),
    },
    "clock": {"tick_hz": Key("whole", 1000, 10_000_000_000)},
    "timing": {
        "decision_deadline_us": Key("number", 0, 1e9, above=True),
        "lease_ms": Key("whole", 1, 3_600_000),
        "device_turn_us": Key("number", 0, 1e9, required=False),
        "host_turn_us": Key("number", 0, 1e9, required=False),
    },
}
_OPTIONAL_SECTIONS = ("object", "optics", "sources")
_UNIT = re.compile(r"_(?:ps|ns|us|ms|s|sec|hz|khz|mhz|ghz|cps|e|nm|um|mm|m|px|percent|pct)$")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class ProfileCheck:
    """One file under check; its methods return checked values or raise with the position."""

    tables: dict[str, Any]
    positions: Mapping[KeyPath, Position]
    where: str

    def facts(self) -> dict[str, dict[str, Any]]:
        """Return every section's checked values, with [sources] and, in [profile], `measure` (both empty where the file has none)."""
        self._sections()
        values = {name: self._section(name) for name in SCHEMA if name in self.tables}
        sources, measure = self._sources(values), self._measure(values)
        for check in _CHECKS:
            check(values, self.fault)
        return {**values, "profile": {**values["profile"], "measure": measure}, "sources": sources}

    def fault(self, path: KeyPath, message: str, remedy: str = "") -> ConfigError:
        """The error to raise: `message` with the place of `path` before it."""
        line, column = position_of(path, self.positions)
        return ConfigError(f"{self.where}:{line}:{column}: {message}", remedy=remedy)

    def _sections(self) -> None:
        known = [*SCHEMA, "sources"]
        for name, table in self.tables.items():
            if name not in known:
                owners = [section for section, keys in SCHEMA.items() if name in keys]
                hint = f"[{owners[0]}] has a key of that name" if owners else near(name, known, "[{}]")
                raise self.fault((name,), f"{name} is not a section of a profile; allowed: {_listed(known)}", hint)
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

    def _sources(self, values: _Values) -> dict[str, str]:
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

    def _measure(self, values: _Values) -> tuple[str, ...]:
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

    def _names_a_key(self, path: KeyPath, name: str, values: _Values) -> None:
        known = [f"{section}.{key}" for section, table in values.items() for key in table]
        if name not in known:
            list_name = path[0] if path[0] == "sources" else ".".join(path)
            raise self.fault(
                path, f'{list_name} names "{name}", which is not a key of this profile', near(name, known, "{}")
            )


_Values = Mapping[str, Mapping[str, Any]]
_Fault = Callable[..., ConfigError]


def _check_channels(values: _Values, fault: _Fault) -> None:
    channels, path = values["detector"]["channels"], ("detector", "channels")
    if values["profile"]["mode"] == "sequential" and channels > MOST_SEQUENTIAL:
        raise fault(
            path,
            f"detector.channels must be from 1 to {MOST_SEQUENTIAL} in sequential mode (detectors that are read at once, each with a "
            f"pattern of its own, one such set after another), found {channels}",
            'set channels = 1, or mode = "parallel" if all patterns are shown at once',
        )
    if values["profile"]["mode"] == "parallel" and channels < 2:
        raise fault(
            path,
            f"detector.channels must be at least 2 in parallel mode (one per pattern), found {channels}",
            'set the number of channels, or mode = "sequential"',
        )
    crosstalk = values["detector"].get("crosstalk_probability", 0.0)
    if crosstalk > 0 and channels < 2:
        raise fault(
            ("detector", "crosstalk_probability"),
            f"detector.crosstalk_probability must be 0 with 1 channel (there is no neighbour), found {crosstalk:g}",
            "remove the line",
        )


def _check_exposure(values: _Values, fault: _Fault) -> None:
    low, high = values["exposure"]["min_us"], values["exposure"]["max_us"]
    if low > high:
        message = f"exposure.min_us must be at most exposure.max_us = {high:g}, found {low:g}"
        raise fault(("exposure", "min_us"), message)


def _check_dead_time(values: _Values, fault: _Fault) -> None:
    dead_ns = values["detector"].get("dead_time_ns", 0.0)
    dead_us = dead_ns / 1000
    spacing_us = values["exposure"]["min_us"] + values["exposure"]["readout_us"]
    if dead_us > spacing_us:
        raise fault(
            ("detector", "dead_time_ns"),
            f"detector.dead_time_ns must be at most exposure.min_us + exposure.readout_us = {1000 * spacing_us:g} ns "
            f"(a click would blind whole exposures after it), found {dead_ns:g}",
            f"raise exposure.min_us or exposure.readout_us by {dead_us - spacing_us:g} us",
        )


def _check_afterpulses(values: _Values, fault: _Fault) -> None:
    stated = values["detector"]
    probability = stated.get("afterpulse_probability", 0.0)
    if "afterpulse_time_us" in stated and not 0 < probability <= MOST_AFTERPULSES:
        raise fault(
            ("detector", "afterpulse_probability" if probability else "afterpulse_time_us"),
            "detector.afterpulse_probability must be above 0 and at most "
            f"{MOST_AFTERPULSES:g} with afterpulse_time_us, found {probability:g}",
            "it is the chance that a click causes at least one more, at any later time",
        )


def _check_crosstalk(values: _Values, fault: _Fault) -> None:
    channels, path = values["detector"]["channels"], ("detector", "crosstalk_further")
    further, most = values["detector"].get("crosstalk_further", ()), max(0, min(FARTHEST_CROSSTALK, channels - 1) - 1)
    if len(further) > most:
        raise fault(
            path,
            f"detector.crosstalk_further must hold at most {most} numbers "
            f"(of the second neighbour and those after it) with {channels} channels, found {len(further)}",
            "leave out what is hardly there",
        )


def _check_telegraph(values: _Values, fault: _Fault) -> None:
    stated, names = values["detector"], ("telegraph_share", "telegraph_offset_e", "telegraph_time_s")
    missing = [name for name in names if name not in stated]
    if 0 < len(missing) < len(names):
        there = next(name for name in names if name in stated)
        raise fault(("detector", there), f"detector.{there} needs {' and '.join(missing)}", "state all three or none")
    jitter_us, period_us = (
        stated.get("timing_jitter_ns", 0.0) / 1000,
        sum(values["exposure"][name] for name in ("min_us", "readout_us")),
    )
    if jitter_us and (values["profile"]["mode"] != "parallel" or jitter_us > period_us):
        raise fault(
            ("detector", "timing_jitter_ns"),
            f"detector.timing_jitter_ns must be 0 in sequential mode, and at most exposure.min_us + exposure.readout_us = "
            f"{1000 * period_us:g} ns in parallel mode, found {1000 * jitter_us:g}",
            "a click would say nothing of its exposure",
        )
    for name in (there for there in ("telegraph_share", "threshold_drift_e_per_hour") if stated.get(there)):
        if not stated.get("read_noise_e"):
            raise fault(
                ("detector", name),
                f"detector.{name} needs read_noise_e above 0: a detector that counts events has no reading that could shift",
                "remove the line",
            )


def _check_ticks(values: _Values, fault: _Fault) -> None:
    tick_hz, min_us = values["clock"]["tick_hz"], values["exposure"]["min_us"]
    least_us = MIN_EXPOSURE_TICKS * 1e6 / tick_hz
    if min_us < least_us * (1 - 1e-9):
        raise fault(
            ("exposure", "min_us"),
            f"exposure.min_us must be at least {MIN_EXPOSURE_TICKS} ticks = {least_us:g} us at clock.tick_hz = "
            f"{tick_hz}, found {min_us:g}",
            "give the device's true tick rate, or a longer shortest exposure",
        )


def _check_lease(values: _Values, fault: _Fault) -> None:
    lease_ms, deadline_us = values["timing"]["lease_ms"], values["timing"]["decision_deadline_us"]
    if 1000 * lease_ms <= deadline_us:
        raise fault(
            ("timing", "lease_ms"),
            f"timing.lease_ms must be above timing.decision_deadline_us = {deadline_us / 1000:g} ms, found {lease_ms}",
            "the lease is what the device waits before it goes dark: some hundred ms",
        )


def _check_optics(values: _Values, fault: _Fault) -> None:
    stated = values.get("optics", {})
    for name, default in (("psf", 0.0), ("scale", 1.0)):
        key, off = ("psf_px", "psf_tolerance_px") if name == "psf" else ("scale", "scale_tolerance")
        value, tolerance = stated.get(key, default), stated.get(off, 0.0)
        least = 0.0 if name == "psf" else 0.1
        if value - tolerance < least:
            raise fault(
                ("optics", off),
                f"optics.{off} must be at most optics.{key} - {least:g} = {value - least:g}, found {tolerance:g}",
                "state the tolerance to either side of the value",
            )


_CHECKS: tuple[Callable[[_Values, _Fault], None], ...] = (
    _check_channels, _check_exposure, _check_dead_time, _check_afterpulses, _check_crosstalk, _check_telegraph, _check_ticks,
    _check_lease, _check_optics,
)  # fmt: skip


def _listed(names: list[str]) -> str:
    return ", ".join(f"[{name}]" for name in names)
