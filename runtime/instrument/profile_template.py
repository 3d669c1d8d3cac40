"""A commented profile to begin with: the figures of a shipped one, and at every key what it means and what it may be.

Owns the words at the keys; the rules are profile_schema.py's. `profile_template` returns TOML that `parse_profile` reads.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from .checked_toml import read_toml
from .profile import profile_text
from .profile_schema import SCHEMA

MEANINGS = {
    "profile.name": "name of the instrument",
    "profile.description": "one line for people",
    "profile.mode": "sequential: one detector, pattern after pattern; parallel: one detector per pattern, all at once",
    "projector.kind": "for people: DMD, OLED, LCoS, microLED, ...",
    "projector.width_px": "width of the panel; a pattern pixel is one panel pixel",
    "projector.height_px": "height of the panel",
    "projector.levels": "linear intensity levels, black included; 2: patterns are on or off",
    "projector.pixel_pitch_um": "distance of two pixels",
    "projector.pattern_rate_max_hz": "patterns per second at most",
    "projector.pattern_memory": "patterns that the instrument stores",
    "projector.peak_photoelectrons_hz": "photoelectrons per second of one pixel at full level, object clear: `pans calibrate` measures it",
    "projector.automaton_states": "states of an automaton that the device follows by itself; 0: none",
    "projector.dwell_steps": "steps into which the device divides the light of an exposure; 1: it is on all the time",
    "object.contrast": "brightest over darkest transmission of the object's modulator; inf: perfectly black",
    "object.levels": "levels of the object's modulator",
    "object.black_transmission": "what black lets through where it was measured, in place of 1/contrast; few figures matter more",
    "optics.psf_px": "blur of a point between projector and object: standard deviation of a Gaussian, in object pixels",
    "optics.psf_tolerance_px": "by how much the blur may differ, to either side",
    "optics.right_px": "how far the object stands to the right on the pattern grid, in object pixels",
    "optics.down_px": "how far it stands below",
    "optics.shift_tolerance_px": "by how much either may differ, to either side",
    "optics.rotation_deg": "how far the object is turned counter-clockwise about the middle of the grid",
    "optics.rotation_tolerance_deg": "by how much the rotation may differ, to either side",
    "optics.scale": "magnification of the object on the pattern grid",
    "optics.scale_tolerance": "by how much the magnification may differ, to either side",
    "optics.dark_pixel": "light of a dark projector pixel over that of a full one; the object's black is object.black_transmission",
    "optics.gain_tolerance": "by which part all light may differ from peak_photoelectrons_hz, to either side",
    "optics.flat_field_file": "a .npz with `flat` (rows, columns) of mean 1: light of every pattern pixel over the mean",
    "optics.source_fluctuation": "standard deviation of the light from exposure to exposure, relative",
    "optics.source_drift_percent_per_hour": "slow change of the light",
    "detector.kind": "for people: SPAD, SNSPD, PMT, qCMOS, ...",
    "detector.channels": "detectors that click independently: 1 if sequential, one per pattern if parallel",
    "detector.efficiency": "photoelectrons per photon",
    "detector.dark_rate_hz": "dark photoelectrons per second and channel: `pans calibrate` measures it",
    "detector.read_noise_e": "Gaussian noise of a readout; 0 for detectors that count events",
    "detector.threshold_e": "a readout of at least this is a click",
    "detector.dead_time_ns": "blind time after a click; at most min_us + readout_us",
    "detector.dead_time_kind": "paralysable: a photon that is lost makes the dead time begin again",
    "detector.between_exposures": "gated: off between exposures; free-running: on, and blinded by what it detects there",
    "detector.afterpulse_probability": "that a click causes another: in the next exposure, or at any later time with afterpulse_time_us",
    "detector.afterpulse_time_us": "time constant with which traps release what causes them",
    "detector.crosstalk_probability": "that a click causes one in a neighbouring channel",
    "detector.crosstalk_further": "the same of the second neighbour, the third and so on",
    "detector.telegraph_share": "share of the pixels whose reading jumps between two levels; needs the next two",
    "detector.telegraph_offset_e": "by how much the reading is higher in the second level",
    "detector.telegraph_time_s": "mean time in either level",
    "detector.threshold_drift_e_per_hour": "by how much the reading sinks in an hour, which is as if the threshold rose",
    "detector.timing_jitter_ns": "standard deviation of the time at which a photon is seen: some fall into the exposure before or after",
    "detector.photon_number_max": "largest photon number that a readout can state; 1: a click or none",
    "exposure.min_us": "shortest exposure; at least 10 ticks of the clock",
    "exposure.max_us": "longest exposure",
    "exposure.readout_us": "time after an exposure before the next may start: readout, settling of mirrors",
    "clock.tick_hz": "nominal ticks per second of the device's clock",
    "timing.decision_deadline_us": "a decision later than this after the last exposure is flagged and triggers nothing",
    "timing.lease_ms": "the device goes dark when it has not heard from the host for this long; above the deadline",
    "timing.device_turn_us": "of automata on the device: from an exposure until the next pattern can show; 0: the readout is longer",
    "timing.host_turn_us": "of automata driven by the host: the same with the host's choice, both ways of the link included",
}
_TITLES = {
    "projector": "what shows the patterns",
    "object": "the modulator that shows test images; leave the section out where real objects stand before the detector",
    "optics": "where the object stands on the pattern grid, and how sharply; what is left out is perfect",
    "detector": "what clicks; an effect that is left out is absent",
    "exposure": "",
    "clock": "",
    "timing": "what a run promises",
}
_HEAD = """\
# Hardware profile of an instrument, begun from the shipped profile {base}.
# Go through the keys, put in your figures, and check the file: pans profile check FILE
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
            title = _TITLES[section]
            yield ""
            hidden = "" if section in tables else "# "
            yield f"{hidden}[{section}]{f'  # {title}' if title else ''}"
        else:
            yield "[profile]"
        for key, rule in rules.items():
            full = f"{section}.{key}"
            value = {"profile.name": name, "profile.description": f"begun from {base}"}.get(
                full, tables.get(section, {}).get(key)
            )
            yield f"# {MEANINGS[full]} [{rule.allowed}]"
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
