"""The settings of a flow, checked, as TOML or a recording's header holds them.

`read_flow` returns `FlowSettings` from a TOML file or a shipped name; `flow_limits` turns them, a plan and a dark rate into the whole
numbers that the kernels count with.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from pans.base import SHIPPED
from pans.base.errors import ConfigError, UsageError
from pans.base.files import position_of, read_toml, toml_text
from pans.base.numbers import Range, binomial_tail
from pans.decide.plan.plan import Plan

KINDS = ("cells", "tape")
MAX_FILE_BYTES = 1 << 16
MAX_RING = 1 << 18  # frames that are remembered
BACKGROUND_BITS = 16  # after the point, of the clicks that the background gives per frame
WATCHED_FRAMES = 256  # empty frames that the guard of the dark counts is told of at once
Q = 32  # bits after the point of a bar's alignment, in exposures
QUIET_QUANTILE = 0.05  # the empty field may exceed the release level that often


def _within(default: float, low: float, high: float) -> Any:
    """A number from `low` to `high`; a whole one where `default` is."""
    return field(default=default, metadata={"range": Range(low, high, whole=isinstance(default, int))})


@dataclass(frozen=True, slots=True)
class FlowSettings:
    """What is known of the flow. Times and speeds are the instrument's; `classes_gated` are names of the bundle's classes."""

    kind: str
    block_us: float = _within(250.0, 0.01, 1e6)  # frames of one message: the price is latency
    dark_every: int = _within(0, 0, 65534)  # one dark frame at the end of that many blocks; 0: none
    # cells
    fields_per_s: float = _within(5000.0, 1e-3, 1e9)  # speed: lengths of the illumination field per second
    onset_frames: int = _within(8, 1, 1024)  # frames whose clicks are summed to find an object
    false_onsets_per_s: float = _within(0.01, 1e-12, 1e6)  # the onset level is the lowest that keeps this
    background: float = _within(0.0, 0, 1)  # clicks per channel and frame besides the dark ones
    longest: float = _within(2.2, 0.1, 100)  # fields that one object's light lasts; longer is two
    # depth of a dip between two maxima, in standard deviations of its clicks, that means two objects
    valley_sigma: float = _within(4.0, 1, 1000)
    refractory_frames: int = _within(0, 0, 1 << 20)  # after a release no onset
    pool: int = _within(1, 1, 64)  # windows side by side whose evidence is added
    sure: float = _within(0.0, 0, 1)  # a posterior below is ambiguous: no label
    # tape
    bars_per_s: float = _within(10_000.0, 1e-3, 1e9)
    track: int = _within(0, 0, 8)  # follow phase and speed: an edge corrects 2^-track of its error; 0: not at all
    first_bar: float = _within(1.0, 0, 1e9)  # when the window of bar 0 is aligned, in bar pitches from the start
    # gate
    gate_delay_us: float = _within(900.0, 0, 1e6)  # from leaving to the pulse
    gate_us: float = _within(50.0, 0.01, 1e6)  # length of the pulse
    gate_channel: int = _within(0, 0, 255)
    gate_classes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UsageError(f"flow kind is {self.kind!r}, allowed: {', '.join(KINDS)}")
        try:
            for one in fields(self):
                if "range" in one.metadata:
                    one.metadata["range"].checked(getattr(self, one.name), one.name)
        except ValueError as error:
            raise UsageError(str(error)) from error

    def as_header(self) -> dict[str, Any]:
        """Return the settings as a recording's header holds them."""
        return asdict(self) | {"gate_classes": list(self.gate_classes)}


def flow_of_header(header: dict[str, Any]) -> FlowSettings:
    """Invert `FlowSettings.as_header`; UsageError or TypeError when it says what is not known."""
    return FlowSettings(**(header | {"gate_classes": tuple(header.get("gate_classes", ()))}))


def read_flow(name: str) -> FlowSettings:
    """Read settings from a TOML file, or from the shipped `cells` or `tape`; ConfigError with file:line:col for what is wrong."""
    path = SHIPPED / f"flow-{name}.toml" if name in KINDS else Path(name)
    text = toml_text(path, MAX_FILE_BYTES, "the settings of a flow", remedy="--flow cells, tape or a file")
    tables, positions = read_toml(text, str(path))
    known = {one.name: one for one in fields(FlowSettings)}
    for key, value in tables.items():
        line, column = position_of((key,), positions)
        if key not in known:
            raise ConfigError(f"{path}:{line}:{column}: unknown key {key}, allowed: {', '.join(known)}")
        if key == "gate_classes" and not (isinstance(value, list) and all(isinstance(one, str) for one in value)):
            raise ConfigError(f"{path}:{line}:{column}: gate_classes must be a list of class names, found {value!r}")
    if "kind" not in tables:
        raise ConfigError(f"{path}:1:1: the key kind is missing, allowed: {', '.join(KINDS)}")
    try:
        return flow_of_header(tables)
    except UsageError as error:
        named = next((key for key in tables if error.message.startswith(f"{key} is")), "kind")
        line, column = position_of((named,), positions)
        raise ConfigError(f"{path}:{line}:{column}: {error.message}") from error


def with_gate(settings: FlowSettings, classes: tuple[str, ...], delay_us: float | None) -> FlowSettings:
    """Return `settings` with what the command line says of the gate."""
    changes: dict[str, Any] = {} if delay_us is None else {"gate_delay_us": delay_us}
    return replace(settings, **(changes | ({"gate_classes": classes} if classes else {})))


class FlowLimits(NamedTuple):
    """The settings in whole numbers, for one plan; exposures unless another unit is named."""

    onset_frames: int
    onset_clicks: int  # in `onset_frames`: an object is there
    release_clicks: int  # in `onset_frames`: it has gone
    longest: int
    refractory: int
    background: int  # clicks per frame, times 2**BACKGROUND_BITS
    valley_frames: int
    valley_sigma2: int
    ring: int  # frames remembered, a power of two
    gate_delay_ticks: int
    gate_ticks: int


def flow_limits(settings: FlowSettings, plan: Plan, dark_probability: float) -> FlowLimits:
    """Work out the limits; `dark_probability` of a click per channel and exposure without light. UsageError when no level can do it.

    The onset level is the lowest count whose chance in an empty window, times the windows per second, is at most `false_onsets_per_s`
    (neighbouring windows share frames, so that this bounds the rate from above).
    """
    frames_per_s = 1e6 / (plan.slot_period_ticks * plan.tick_us)
    empty = min(1.0, dark_probability + settings.background)
    trials = settings.onset_frames * plan.n_patterns
    allowed = settings.false_onsets_per_s / frames_per_s
    cells = settings.kind == "cells"
    onset = next((k for k in range(1, trials + 1) if binomial_tail(k, trials, empty) <= allowed), 0)
    if not onset and cells:
        raise UsageError(
            f"an empty field gives {empty * trials:.3g} clicks in {settings.onset_frames} frames: no onset level keeps "
            f"{settings.false_onsets_per_s:g} false onsets per second",
            remedy="raise onset_frames or false_onsets_per_s, or lower the background",
        )
    quiet = next(k for k in range(trials + 1) if binomial_tail(k + 1, trials, empty) <= QUIET_QUANTILE)
    field_frames = frames_per_s / (settings.fields_per_s if cells else settings.bars_per_s)
    longest = max(settings.onset_frames, math.ceil(settings.longest * field_frames * (1 - 1e-12)))
    ring = 1 << (4 * longest + 4 * plan.block_exposures).bit_length()
    if ring > MAX_RING:
        raise UsageError(
            f"an object takes {longest} frames, allowed are {MAX_RING // 8}",
            remedy="longer exposures, or a faster flow",
        )
    per_us = 1 / plan.tick_us
    return FlowLimits(
        settings.onset_frames,
        onset,
        min(quiet, onset - 1),
        longest,
        settings.refractory_frames,
        round(empty * plan.n_patterns * (1 << BACKGROUND_BITS)),
        max(2, round(field_frames / 8)),
        round(settings.valley_sigma**2),
        ring,
        round(settings.gate_delay_us * per_us),
        max(1, round(settings.gate_us * per_us)),
    )
