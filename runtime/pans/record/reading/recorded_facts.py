"""What header, events and summary of a recording must be where they are read: types and ranges of what words, pages and comparisons use.

`checked_summary` and its siblings refuse anything else as damage. A key that is not named here may have any value, and of a summary only
those of a run that ended with a verdict have to be there: recordings of earlier versions lack later ones, a part that was full has none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pans.base.errors import DamagedFileError
from pans.base.numbers import Range, number_text

COUNT = Range(0, 1 << 53, whole=True)
FIGURE = Range(0, 1e26)  # photons, microseconds, seconds; 2^64 ticks of a clock of 1 Hz are 2e25 us
SIGNED = Range(-1e26, 1e26)
SHARE = Range(0, 1)
END_OF_INTERVAL = Range(-1e-9, 1 + 1e-9)  # rounding may lead a little beyond a share
OBJECTS = Range(0, (1 << 32) - 1, whole=True)  # a decision has its object as u32
# used as they are; the others are left out where they are not there
NEEDED = ("decisions", "abstained", "objects", "trials", "latency_us", "clock", "device")


@dataclass(frozen=True, slots=True)
class Each:
    """An object whose values, or a list whose items, all are of one shape; `size` items, None: any number."""

    kind: type[dict[str, Any]] | type[list[Any]]
    shape: Any
    size: int | None = None


# A shape is a Range, a type, None, Each, an object's shapes by key (`+` ends one that must be there), or a tuple of shapes of which one
# must fit.
_SHARES = ("accuracy", "accuracy_labelled", "missed", "doubled", "yield", "purity")
_COUNTS = (
    "decisions",
    "decided",
    "judged",
    "abstained",
    "abstained_below_confidence",
    "objects",
    "trials",
    "photons_known",
)
_MEANS = ("clicks_mean", "photons_mean", "exposures_mean", "passage_clicks_mean", "passage_photons_mean")
_LIGHT = ("illumination", "illumination_mean", "turn_budget_us")
_TEXTS = ("ended", "drive", "busy", "decisions_sha256", "next")
_QUANTILES = {f"{name}+": (None, FIGURE) for name in ("p50", "p99", "p999", "max")}
_DARK = {
    **{"exposures+": COUNT, "clicks+": COUNT, "per_exposure+": SHARE, "expected+": (None, FIGURE)},
    **{"low+": END_OF_INTERVAL, "high+": END_OF_INTERVAL},
}
_SHAPES: dict[str, Any] = {
    **dict.fromkeys((*_COUNTS, "late", "lost", "late_slots", "reconnects", "wrong_patterns"), COUNT),
    **dict.fromkeys((*_SHARES, "accuracy_std_trials", "confidence", "late_allowed"), (None, SHARE)),
    **{f"{name}_ci": (None, Each(list, END_OF_INTERVAL, 2)) for name in _SHARES},
    "accuracy_stderr_objects": (None, Range(0, 0), Range(1e-70, 1)),  # its square divides
    **dict.fromkeys((*_MEANS, *_LIGHT), (None, FIGURE)),
    **dict.fromkeys(("deadline_us", "slot_jitter_us", "armed_after_s", "seconds"), FIGURE),
    "expected_off_stderr": (None, SIGNED),
    **dict.fromkeys(_TEXTS, str),
    **dict.fromkeys(("simulated", "link_lost"), bool),
    **dict.fromkeys(("faults", "warnings", "calibration_warnings"), Each(list, str)),
    "figures_of": Each(dict, str),
    **dict.fromkeys(("late_cause", "stream", "aborted", "gates"), Each(dict, COUNT)),
    "page_faults": Each(dict, FIGURE),
    "realtime": dict,
    "passages": {"alone+": COUNT, "missed+": COUNT},
    "device": {"objects": OBJECTS},
    "clock": {"worst_uncertainty_us+": FIGURE, "drift_ppm": (None, SIGNED)},
    "latency_us": _QUANTILES,
    "stage_latency_us": Each(dict, _QUANTILES),
    "turn_us": (None, _QUANTILES),
    "exposure_timing": {
        **dict.fromkeys(("exposures", "untold"), COUNT),
        **dict.fromkeys(("worst_start_us", "worst_length_us", "tolerance_us"), (None, SIGNED)),
    },
    "expected": (None, {"accuracy": (None, SHARE), "clicks": (None, FIGURE), "photons": (None, FIGURE)}),
    "dark": {**_DARK, "alarm": str, "findings": list, "channels": Each(list, _DARK)},
}

_HEADER = {
    **dict.fromkeys(("created_utc", "command", "device_url"), str),
    **dict.fromkeys(("simulated", "virtual_time"), bool),
    "versions": dict,
    "config": {
        "flow": {"settings": {"gate_classes": Each(list, str)}},
        "dark": (None, {"guard": (None, {"afterpulses": COUNT, "expected": Each(list, SHARE)})}),
    },
}
NUMBER = Range(0, (1 << 64) - 1, whole=True)  # of an exposure, a decision, a tick
_EVENT = {
    "kind+": str,
    **dict.fromkeys(("tick", "decision", "first_decision", "decisions", "exposures"), NUMBER),
    **dict.fromkeys(("dark_exposure", "since_dark_exposure"), NUMBER),
}
_OF_A_KIND = {  # what events of a kind must be besides
    "dark_state": {
        **{"state+": str, "channels+": Each(list, NUMBER), "dark_exposure+": NUMBER},
        **{"rate": FIGURE, "expected": FIGURE, "words": str, "level": str},
    },
    "part": {
        **{"number+": Range(1, 1 << 53, whole=True), "first_decision+": NUMBER},
        **{"before": (None, dict), "deleted": (None, {"parts": COUNT})},
    },
}


def checked_header(header: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the header of a recording; DamagedFileError if it cannot be one."""
    if misfit := _misfit(header, _HEADER, "the header"):
        raise DamagedFileError(f"{where}: {misfit}")
    return header


def checked_event(event: dict[str, Any], where: str) -> dict[str, Any]:
    """Return an event of a recording; DamagedFileError if it cannot be one."""
    if misfit := _misfit(event, _EVENT, "the event") or _misfit(event, _OF_A_KIND.get(event["kind"], {}), "the event"):
        raise DamagedFileError(f"{where}: {misfit}")
    return event


def checked_summary(summary: Any, where: str) -> dict[str, Any]:
    """Return the summary of a run as it was read from `where`; DamagedFileError if it cannot be one."""
    if not isinstance(summary, dict):
        raise DamagedFileError(f"{where}: the summary of a run is {ascii(summary)[:40]}, allowed: an object")
    if misfit := _misfit(summary, _SHAPES, "the summary") or next(_contradictions(summary), ""):
        raise DamagedFileError(f"{where}: {misfit}")
    return summary


def _misfit(value: Any, shape: Any, name: str) -> str:
    """Return in words how `value` is not of its shape, "" if it is."""
    if isinstance(shape, tuple):
        *_, last = found = [_misfit(value, one, name) for one in shape]
        return last if all(found) else ""
    if isinstance(shape, Range):
        return "" if shape.holds(value) else f"{name} is {number_text(value)}, allowed: {shape.allowed}"
    if shape is None:
        return "" if value is None else name
    kind = dict if isinstance(shape, dict) else shape.kind if isinstance(shape, Each) else shape
    if not isinstance(value, kind):
        return f"{name} is {ascii(value)[:40]}, allowed: {_NAMES[kind]}"
    return next(filter(None, _misfits_within(value, shape, name)), "")


def _misfits_within(value: Any, shape: Any, name: str) -> Iterator[str]:
    """Yield what is wrong in an object or a list."""
    if isinstance(shape, dict):
        for marked, inner in shape.items():
            key = marked.removesuffix("+")
            if key in value:
                yield _misfit(value[key], inner, f"{name}: {key}")
            elif key != marked:
                yield f"{name} has no {key}"
    elif isinstance(shape, Each):
        if shape.size not in (None, len(value)):
            yield f"{name} has {len(value)} items, allowed: {shape.size}"
        for key, one in value.items() if isinstance(value, dict) else enumerate(value):
            yield _misfit(one, shape.shape, f"{name}: {ascii(key)[:40]}")


_NAMES = {dict: "an object", list: "a list", str: "a text", bool: "true or false"}


def _contradictions(facts: dict[str, Any]) -> Iterator[str]:
    """Yield which keys are missing beside others, and which counts cannot be, of a summary with the right shapes."""
    if "verdict" in facts and facts["verdict"] not in ("PASS", "FAIL"):
        yield f"the summary: verdict is {ascii(facts['verdict'])[:40]}, allowed: PASS or FAIL"
    needs = {"verdict": NEEDED, "judged": ("decisions", "decided", "photons_known"), "passages": ("aborted",)}
    needs |= {f"{name}_ci": (name,) for name in _SHARES}
    yield from (
        f"the summary has {a}, but no {b}"
        for a, wanted in needs.items()
        if a in facts
        for b in wanted
        if b not in facts
    )
    if facts.get("abstained", 0) > facts.get("decisions", COUNT.high):
        yield f"the summary: {facts['abstained']} of {facts['decisions']} decisions abstained"
    dark, timing = facts.get("dark", {}), facts.get("exposure_timing", {})
    rows = [dark, *dark.get("channels", ())] if dark else []
    yield from (
        f"the summary: {row['clicks']} clicks in {row['exposures']} dark exposures"
        for row in rows
        if row["clicks"] > row["exposures"]
    )
    if timing.get("exposures") and None in map(timing.get, ("worst_start_us", "worst_length_us", "tolerance_us")):
        yield "the summary: exposure_timing counts exposures, but does not say how far they were off"
