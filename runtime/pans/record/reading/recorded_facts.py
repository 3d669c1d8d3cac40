"""What header, events and summary of a recording must be where they are read: types and ranges of what words, pages and comparisons use.

`checked_summary` and its siblings refuse anything else as damage. A key that is not named here may have any value, and of a summary only
those of a run that ended with a verdict have to be there: recordings of earlier versions lack later ones, a part that was full has none.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pans.base.errors import DamagedFileError
from pans.base.numbers import AMOUNT, COUNT, END_OF_INTERVAL, FIGURES, SHARE, Each, Range, number_text

# used as they are; the others are left out where they are not there
NEEDED = ("decisions", "abstained", "objects", "trials", "latency_us", "clock", "device")

# A shape is a Range, a type, None, Each, an object's shapes by key (`+` ends one that must be there), or a tuple of shapes of which one
# must fit.
_SHARES = tuple(one.key for one in FIGURES.values() if one.interval)
_SHAPES: dict[str, Any] = {
    **{key: one.allowed for key, one in FIGURES.items() if one.allowed is not None},
    **{f"{name}_ci": (None, Each(list, END_OF_INTERVAL, 2)) for name in _SHARES},
    "next": str,  # of a part that was full: the file of the next one
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
        **{"rate": AMOUNT, "expected": AMOUNT, "words": str, "level": str},
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
