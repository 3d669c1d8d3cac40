"""Hardware profile: a TOML file -> frozen facts about one instrument. docs/reference/profiles.md explains every key.

Owns the facts, and reading files and shipped profiles (profile_schema.py holds the rules); never holds what a calibration
measured (calibration.py), and never decides whether a bundle fits (plan.py). `load_profile` and `parse_profile` return a
`Profile` whose numbers are all possible ones, or raise a ConfigError that starts with file:line:col. Detector effects that
the file does not declare are 0 and cost nothing.
"""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.runtime.container import other_kind
from pans.runtime.errors import ConfigError, UsageError
from pans.runtime.html_card import html_card
from pans.runtime.imaging import IDENTITY, Imaging, Tolerance, checked_flat
from pans.runtime.npz_file import read_arrays

from .checked_toml import read_toml
from .profile_schema import GATED, NON_PARALYSABLE, ProfileCheck

MAX_PROFILE_BYTES = 1 << 20
MAX_FLAT_BYTES = 1 << 26


@dataclass(frozen=True, slots=True)
class Projector:
    """What shows the patterns; `peak_photoelectrons_hz`: what one pixel at the top level yields through a clear object.

    `automaton_states`: most states of an automaton that the device follows by itself, 0 if it cannot; `dwell_steps`: into how many steps
    it divides the time that the light is on within an exposure, 1 if it cannot.
    """

    kind: str
    width_px: int
    height_px: int
    levels: int
    pixel_pitch_um: float
    pattern_rate_max_hz: float
    pattern_memory: int
    peak_photoelectrons_hz: float
    automaton_states: int = 0
    dwell_steps: int = 1


@dataclass(frozen=True, slots=True)
class ObjectModulator:
    """What shows test images as objects; `contrast` is brightest over darkest transmission, inf for perfect black.

    `black_transmission` is what a black pixel lets through at the object in fact, where that was measured; else 1/contrast.
    """

    contrast: float
    levels: int
    black_transmission: float | None = None


@dataclass(frozen=True, slots=True)
class Optics:
    """Where the object stands on the pattern grid and how sharply, each with what it may be off by to either side.

    `dark_pixel` is the light of a dark projector pixel over that of a full one, `gain_tolerance` relative; `source_fluctuation` is
    the relative standard deviation of the light from exposure to exposure. `flat_field_file` stands beside the profile's file.
    """

    psf_px: float = 0.0
    psf_tolerance_px: float = 0.0
    right_px: float = 0.0
    down_px: float = 0.0
    shift_tolerance_px: float = 0.0
    rotation_deg: float = 0.0
    rotation_tolerance_deg: float = 0.0
    scale: float = 1.0
    scale_tolerance: float = 0.0
    dark_pixel: float = 0.0
    gain_tolerance: float = 0.0
    flat_field_file: str | None = None
    source_fluctuation: float = 0.0
    source_drift_percent_per_hour: float = 0.0

    def tolerance(self) -> Tolerance:
        """Return from where to where every fact may lie."""
        return Tolerance(
            _about(self.right_px, self.shift_tolerance_px),
            _about(self.down_px, self.shift_tolerance_px),
            _about(self.rotation_deg, self.rotation_tolerance_deg),
            _about(self.scale, self.scale_tolerance),
            _about(self.psf_px, self.psf_tolerance_px),
            _about(self.dark_pixel, 0.0),
            _about(1.0, self.gain_tolerance),
        )


def _about(value: float, off: float) -> tuple[float, float]:
    return value - off, value + off


@dataclass(frozen=True, slots=True)
class Detector:
    """What clicks; effects left at 0 are absent. `photon_number_max`: the largest number that a reading can state, 1 of clicks alone.

    `afterpulse_time_us` None: all afterpulses come in the next exposure. `crosstalk_further`: of the second neighbour, the third, ...
    """

    kind: str
    channels: int
    efficiency: float
    dark_rate_hz: float
    read_noise_e: float = 0.0
    threshold_e: float = 0.5
    dead_time_ns: float = 0.0
    dead_time_kind: str = NON_PARALYSABLE
    between_exposures: str = GATED
    afterpulse_probability: float = 0.0
    afterpulse_time_us: float | None = None
    crosstalk_probability: float = 0.0
    crosstalk_further: tuple[float, ...] = ()
    telegraph_share: float = 0.0
    telegraph_offset_e: float = 0.0
    telegraph_time_s: float = 0.0
    threshold_drift_e_per_hour: float = 0.0
    timing_jitter_ns: float = 0.0
    photon_number_max: int = 1


@dataclass(frozen=True, slots=True)
class Exposure:
    """How long the detector may be open; `readout_us` is the time after an exposure before the next may start."""

    min_us: float
    max_us: float
    readout_us: float


@dataclass(frozen=True, slots=True)
class Clock:
    """The device clock: all plan times are whole ticks of it."""

    tick_hz: int


@dataclass(frozen=True, slots=True)
class Timing:
    """A decision follows the last exposure within the deadline; the device goes dark when the lease is not renewed.

    `device_turn_us` and `host_turn_us`: from the end of an exposure until the projector can show the pattern that its click chose, where
    the device chooses it and where the host does.
    """

    decision_deadline_us: float
    lease_ms: int
    device_turn_us: float = 0.0
    host_turn_us: float = 1000.0


@dataclass(frozen=True, slots=True)
class Profile:
    """One instrument; `sources`: "section.key" -> where the figure comes from, `measure`: the keys to measure oneself."""

    name: str
    description: str
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
        shipped = resources.files("pans.hw_profiles").joinpath(f"{name_or_path}.toml")
        return _decoded(shipped.read_bytes(), shipped.name)
    path = Path(name_or_path)
    if not path.is_file():
        known = ", ".join(shipped_profiles())
        near = difflib.get_close_matches(str(name_or_path), shipped_profiles(), n=1)
        raise ConfigError(
            f"there is no profile {str(name_or_path)!r}: neither a file nor one of the shipped profiles ({known})",
            remedy=f"did you mean {near[0]}?" if near else "give a shipped name or the path of a .toml file",
        )
    try:
        with path.open("rb") as file:
            data = file.read(MAX_PROFILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}", remedy="check its permissions") from error
    return _decoded(data, str(path))


def shipped_profiles() -> tuple[str, ...]:
    """Names of the profiles that come with the package, sorted."""
    entries = resources.files("pans.hw_profiles").iterdir()
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in entries if entry.name.endswith(".toml")))


def parse_profile(text: str, where: str) -> Profile:
    """Check the TOML `text` (named `where` in messages) and return its facts; raises ConfigError at the first fault."""
    if len(text.encode()) > MAX_PROFILE_BYTES:
        raise _too_large(where)
    tables, positions = read_toml(text, where)
    facts = ProfileCheck(tables, positions, where).facts()
    return Profile(
        name=facts["profile"]["name"],
        description=facts["profile"].get("description", ""),
        mode=facts["profile"]["mode"],
        projector=Projector(**facts["projector"]),
        object_modulator=ObjectModulator(**facts["object"]) if "object" in facts else None,
        optics=Optics(**facts["optics"]) if "optics" in facts else None,
        detector=Detector(**facts["detector"]),
        exposure=Exposure(**facts["exposure"]),
        clock=Clock(**facts["clock"]),
        timing=Timing(**facts["timing"]),
        sources=facts["sources"],
        measure=facts["profile"]["measure"],
        text=text,
    )


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


def _decoded(data: bytes, where: str) -> str:
    if len(data) > MAX_PROFILE_BYTES:
        raise _too_large(where)
    what, taker = other_kind(data, "profile", "TOML")
    if what:
        raise ConfigError(f"{where}: not a hardware profile: it is {what}", remedy=taker)
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n")  # the same hash and positions whichever system saved it
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        column = error.start - (data.rfind(b"\n", 0, error.start) + 1) + 1
        raise ConfigError(
            f"{where}:{line}:{column}: byte 0x{data[error.start]:02x} is not UTF-8", remedy="save the file as UTF-8"
        ) from error


def _too_large(where: str) -> ConfigError:
    return ConfigError(
        f"{where}:1:1: a profile may hold at most {MAX_PROFILE_BYTES} bytes, found more",
        remedy="is this a profile? see docs/reference/profiles.md",
    )
