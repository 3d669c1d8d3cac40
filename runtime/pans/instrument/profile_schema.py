"""The sections of a profile file: the type, range, default and meaning of every key.

A section is a frozen dataclass whose fields are annotated with the rule of their value; a key without a default is required. `SCHEMA` lists
the rules by section and key. profile.py reads files with them, docs/reference/profiles.md explains every key.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields, replace
from typing import Annotated, Any, get_type_hints

from pans.base.files import Key
from pans.instrument.optics.model import Tolerance

MAX_STATES = 0xFFFD  # of an automaton: two numbers of 16 bits mean "chosen by the clicks" and "dark" (as in protocol/wire/schema.py)

MODES = ("sequential", "parallel")
NON_PARALYSABLE, PARALYSABLE = "non-paralysable", "paralysable"
GATED, FREE_RUNNING = "gated", "free-running"
MAX_FLUCTUATION = 0.3  # of the light from exposure to exposure: beyond it a Gaussian factor would often be below 0


def text(meaning: str, *choices: str) -> Key:
    """Return the rule of a text, one of `choices` where there are any."""
    return Key("text", choices=choices, meaning=meaning)


def whole(low: int, high: int, meaning: str) -> Key:
    """Return the rule of a whole number from `low` to `high`."""
    return Key("whole", low, high, meaning=meaning)


def number(low: float, high: float, meaning: str) -> Key:
    """Return the rule of a number from `low` to `high`."""
    return Key("number", low, high, meaning=meaning)


def above(low: float, high: float, meaning: str, *, infinite: bool = False) -> Key:
    """Return the rule of a number above `low` and at most `high`."""
    return Key("number", low, high, above=True, infinite=infinite, meaning=meaning)


@dataclass(frozen=True, slots=True)
class Projector:
    """The device that displays the patterns."""

    kind: Annotated[str, text("for people: DMD, OLED, LCoS, microLED, ...")]
    width_px: Annotated[int, whole(1, 65535, "width of the panel; a pattern pixel is one panel pixel")]
    height_px: Annotated[int, whole(1, 65535, "height of the panel")]
    levels: Annotated[int, whole(2, 65536, "linear intensity levels, black included; 2: patterns are on or off")]
    pixel_pitch_um: Annotated[float, above(0, 1e5, "distance of two pixels")]
    pattern_rate_max_hz: Annotated[float, above(0, 1e9, "patterns per second at most")]
    # 65535 patterns are 0..0xFFFE: 0xFFFF is the dark pattern
    pattern_memory: Annotated[int, whole(1, 65535, "patterns that the instrument stores")]
    peak_photoelectrons_hz: Annotated[float, above(0, 1e15, "photoelectrons/s of a full pixel, object clear")]
    automaton_states: Annotated[int, whole(0, MAX_STATES, "states of an automaton the device can follow")] = 0
    dwell_steps: Annotated[int, whole(1, 65535, "steps of the light within an exposure")] = 1


@dataclass(frozen=True, slots=True)
class ObjectModulator:
    """The modulator that displays test images as objects."""

    contrast: Annotated[float, above(1, 1e12, "brightest over darkest transmission", infinite=True)]
    levels: Annotated[int, whole(2, 65536, "levels of the object's modulator")]
    black_transmission: Annotated[float | None, number(0, 0.99, "measured, in place of 1/contrast")] = None


@dataclass(frozen=True, slots=True)
class Optics:
    """Where the object stands on the pattern grid and how sharp it is, with the tolerance of each figure."""

    psf_px: Annotated[float, number(0, 1000, "blur: sigma of a Gaussian, in object pixels")] = 0.0
    psf_tolerance_px: Annotated[float, number(0, 1000, "by how much the blur may differ, to either side")] = 0.0
    right_px: Annotated[float, number(-1e4, 1e4, "object to the right on the grid, in its pixels")] = 0.0
    down_px: Annotated[float, number(-1e4, 1e4, "how far it stands below")] = 0.0
    shift_tolerance_px: Annotated[float, number(0, 1000, "by how much either may differ, to either side")] = 0.0
    rotation_deg: Annotated[float, number(-360, 360, "object turned counter-clockwise")] = 0.0
    rotation_tolerance_deg: Annotated[float, number(0, 360, "by how much the rotation may differ, to either side")] = (
        0.0
    )
    scale: Annotated[float, number(0.1, 10, "magnification of the object on the pattern grid")] = 1.0
    scale_tolerance: Annotated[float, number(0, 0.9, "by how much the magnification may differ, to either side")] = 0.0
    dark_pixel: Annotated[float, number(0, 0.99, "light of a dark projector pixel over that of a full one")] = 0.0
    gain_tolerance: Annotated[float, number(0, 0.99, "relative, of all light, to either side")] = 0.0
    flat_field_file: Annotated[str | None, text("a .npz with `flat` (rows, columns) of mean 1")] = None
    source_fluctuation: Annotated[float, number(0, MAX_FLUCTUATION, "relative sigma from exposure to exposure")] = 0.0
    source_drift_percent_per_hour: Annotated[float, number(-100, 100, "slow change of the light")] = 0.0

    def tolerance(self) -> Tolerance:
        """Return from where to where every fact may lie."""

        def about(value: float, off: float) -> tuple[float, float]:
            return value - off, value + off

        return Tolerance(
            about(self.right_px, self.shift_tolerance_px),
            about(self.down_px, self.shift_tolerance_px),
            about(self.rotation_deg, self.rotation_tolerance_deg),
            about(self.scale, self.scale_tolerance),
            about(self.psf_px, self.psf_tolerance_px),
            about(self.dark_pixel, 0.0),
            about(1.0, self.gain_tolerance),
        )


@dataclass(frozen=True, slots=True)
class Detector:
    """The detector; an effect that a profile leaves out is absent."""

    kind: Annotated[str, text("for people: SPAD, SNSPD, PMT, qCMOS, ...")]
    channels: Annotated[int, whole(1, 4096, "detectors: 1 if sequential, one per pattern if parallel")]
    efficiency: Annotated[float, above(0, 1, "photoelectrons per photon")]
    dark_rate_hz: Annotated[float, number(0, 1e9, "dark photoelectrons/s and channel")]
    # beyond 3 e- of noise a single photon is not visible at all
    read_noise_e: Annotated[float, number(0, 3, "Gaussian noise of a readout; 0 for detectors that count events")] = 0.0
    threshold_e: Annotated[float, above(0, 10, "a readout of at least this is a click")] = 0.5
    dead_time_ns: Annotated[float, number(0, 1e9, "blind time after a click; at most min_us + readout_us")] = 0.0
    dead_time_kind: Annotated[
        str,
        text("paralysable: a photon that is lost makes the dead time begin again", NON_PARALYSABLE, PARALYSABLE),
    ] = NON_PARALYSABLE
    between_exposures: Annotated[
        str, text("gated: off between exposures; free-running: on, and blinded by what it detects", GATED, FREE_RUNNING)
    ] = GATED
    afterpulse_probability: Annotated[float, number(0, 1, "that a click causes another")] = 0.0
    afterpulse_time_us: Annotated[float | None, above(0, 1e9, "time constant of the traps")] = None
    crosstalk_probability: Annotated[float, number(0, 1, "that a click causes one in a neighbouring channel")] = 0.0
    crosstalk_further: Annotated[
        tuple[float, ...], Key("numbers", 0, 1, meaning="the same of the second neighbour, the third and so on")
    ] = ()
    telegraph_share: Annotated[float, number(0, 1, "share of pixels with two levels")] = 0.0
    telegraph_offset_e: Annotated[float, number(-10, 10, "by how much the reading is higher in the second level")] = 0.0
    telegraph_time_s: Annotated[float, number(1e-4, 1e9, "mean time in either level")] = 0.0
    threshold_drift_e_per_hour: Annotated[float, number(-100, 100, "by how much readings sink")] = 0.0
    timing_jitter_ns: Annotated[float, number(0, 1e9, "sigma of the detection time")] = 0.0
    photon_number_max: Annotated[int, whole(1, 15, "largest number of a readout; 1: a click or none")] = 1


@dataclass(frozen=True, slots=True)
class Exposure:
    """How long the detector may be open."""

    min_us: Annotated[float, above(0, 1e9, "shortest exposure; at least 10 ticks of the clock")]
    max_us: Annotated[float, above(0, 1e9, "longest exposure")]
    readout_us: Annotated[float, number(0, 1e9, "pause before the next exposure may start")]


@dataclass(frozen=True, slots=True)
class Clock:
    """The device clock: all times of a plan are whole ticks of it."""

    tick_hz: Annotated[int, whole(1000, 10_000_000_000, "nominal ticks per second of the device's clock")]


@dataclass(frozen=True, slots=True)
class Timing:
    """What a run promises."""

    decision_deadline_us: Annotated[float, above(0, 1e9, "later decisions are flagged and trigger nothing")]
    lease_ms: Annotated[int, whole(1, 3_600_000, "the device goes dark when the host is silent for so long")]
    device_turn_us: Annotated[float, number(0, 1e9, "device-driven: from an exposure to the next pattern")] = 0.0
    host_turn_us: Annotated[float, number(0, 1e9, "host-driven automata: the same, both ways of the link included")] = (
        1000.0
    )
    exposure_tolerance_us: Annotated[float, number(0, 1e9, "of an exposure's start and length; 0: 1 % of it")] = 0.0


SECTIONS: dict[str, type[Any]] = {
    "projector": Projector,
    "object": ObjectModulator,
    "optics": Optics,
    "detector": Detector,
    "exposure": Exposure,
    "clock": Clock,
    "timing": Timing,
}


def _rules(section: type[Any]) -> dict[str, Key]:
    hints = get_type_hints(section, include_extras=True)
    return {
        field.name: replace(hints[field.name].__metadata__[0], required=field.default is MISSING)
        for field in fields(section)
    }


SCHEMA: dict[str, dict[str, Key]] = {
    "profile": {
        "name": text("name of the instrument"),
        "description": Key("text", required=False, meaning="one line for people"),
        "mode": text("sequential: one detector, pattern after pattern; parallel: one detector per pattern", *MODES),
    },
    **{name: _rules(section) for name, section in SECTIONS.items()},
}
